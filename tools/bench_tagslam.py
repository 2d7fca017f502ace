"""TagSLAM's own tests and the session truth against the figures asked of them. CPU seconds, never wall.

python tools/bench_tagslam.py                         # TagSLAM's tests in the shared data
python tools/bench_tagslam.py --only 01 16 20
python tools/bench_tagslam.py --session SESSION --truth SESSION_truth --tag-size 0.0614
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from groundtruth.graph import Undetermined
from groundtruth.session_truth import TruthConfig, find_truth
from groundtruth.tagslam.config import TagSlamConfig, read_config
from groundtruth.tagslam.detections import Recording, read_recording
from groundtruth.tagslam.solve import TagSlamResult, run_tag_slam
from groundtruth.tagslam.yaml_pieces import NoisyPose
from recordings.session import Session

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("TOSSLAB_DATA", ROOT.parent / "shared" / "data"))
REFERENCE_PX = {"01": 0.39, "02": 0.34, "07": 0.97, "16": 0.07, "17": 0.08, "23": 0.34}
FRAMES_20, LIMIT_S = 5000, 120.0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", metavar="NN", help="these tests of TagSLAM")
    parser.add_argument("--tests", type=Path, default=DATA / "tagslam_test", help="folder of TagSLAM's tests")
    parser.add_argument("--session", type=Path, help="a session with mono images instead")
    parser.add_argument("--truth", type=Path, help="its *_truth folder")
    parser.add_argument("--tag-size", type=float)
    given = parser.parse_args()
    if given.session is not None:
        return session_rows(given.session, given.truth, given.tag_size)
    for folder in sorted(given.tests.glob("test_*")):
        number = folder.name[5:]
        if given.only is None or number in given.only:
            print(must_fail_row(folder) if number == "20" else test_row(folder, number), flush=True)
    if given.only is None or "20" in given.only:
        for row in speed_rows(given.tests / "test_20"):
            print(row, flush=True)
    return 0


def test_row(folder: Path, number: str) -> str:
    started = time.process_time()
    result = run_tag_slam(read_config(folder), read_recording(folder))
    cpu_s = time.process_time() - started
    with np.load(folder / "reference.npz") as stored:
        name = next(n for n in stored.files if n.startswith("odom|") and n.endswith("stamp_ns"))
        stamps, rows = stored[name], stored[name.replace("stamp_ns", "xyz_qxyzw")]
    body = name.split("|")[1].split("body_")[1]
    gap_m, turn_deg, missing, extra = against(result, body, stamps, rows)
    within = np.mean((gap_m < 0.002 + 0.002 * np.linalg.norm(rows[:, :3], axis=1)[: len(gap_m)]) & (turn_deg < 0.1))
    px = float(np.median(result.reprojection_px))
    reference = f" (TagSLAM {REFERENCE_PX[number]:.2f})" if number in REFERENCE_PX else ""
    poses = f"gap {1e3 * np.median(gap_m):.2f} mm, p95 {1e3 * np.quantile(gap_m, 0.95):.2f}"
    poses += f"; turn {np.median(turn_deg):.3f} deg, p95 {np.quantile(turn_deg, 0.95):.3f}"
    poses += f"; {100 * within:.1f} % within 2 mm + 0.2 % and 0.1 deg; missing {missing}, extra {extra}"
    return f"test {number}: {px:.3f} px{reference}; {poses}; {cpu_s:.1f} CPU-s"


def against(result: TagSlamResult, body: str, stamps: Any, rows: Any) -> tuple[Any, Any, int, int]:
    """Metres and degrees at the stamps of the reference, and how many stamps are missing and extra."""
    ours = dict(zip(*result.bodies[body], strict=True))
    both = [(ours[s], row) for s, row in zip(stamps.tolist(), rows, strict=True) if s in ours]
    poses, wanted = np.array([p for p, _ in both]), np.array([row for _, row in both])
    turn = Rotation.from_matrix(poses[:, :3, :3]).inv() * Rotation.from_quat(wanted[:, 3:])
    gap_m = np.linalg.norm(poses[:, :3, 3] - wanted[:, :3], axis=1)
    return gap_m, np.degrees(turn.magnitude()), len(stamps) - len(both), len(set(ours) - set(stamps.tolist()))


def must_fail_row(folder: Path) -> str:
    try:
        run_tag_slam(read_config(folder), read_recording(folder), most_frames=300)
    except Undetermined as singular:
        return f"test 20: fails as it must: {singular}"
    return "test 20: RAN, and must fail"


def mended(config: TagSlamConfig) -> TagSlamConfig:
    """Test 20 with tag 45's rotation noise at 0.1."""
    body = config.body("pennstock")
    known = body.tags[45].pose
    if known is None:
        raise SystemExit("test 20 has no pose of tag 45")
    pose = NoisyPose(known.pose, np.diag([10.0] * 3 + np.diag(known.root_information)[3:].tolist()))
    changed = replace(body, tags={**body.tags, 45: replace(body.tags[45], pose=pose)})
    return replace(config, bodies=tuple(changed if b is body else b for b in config.bodies))


def speed_rows(folder: Path) -> list[str]:
    """Cost per frame must not grow with the recording."""
    config, recording = mended(read_config(folder)), read_recording(folder)
    cameras = len(config.cameras)
    rows = []
    for frames in (FRAMES_20 // 4, FRAMES_20 // 2, FRAMES_20):
        cpu_s, result = timed(config, recording, frames // cameras)
        limit = f" (limit {LIMIT_S:.0f})" if frames == FRAMES_20 else ""
        px = float(np.median(result.reprojection_px))
        rows.append(
            f"test 20 mended, first {frames} frames: {cpu_s:.1f} CPU-s{limit}, {1e3 * cpu_s / frames:.1f} ms a frame, "
            f"median {px:.2f} px"
        )
    return rows


def timed(config: TagSlamConfig, recording: Recording, stamps: int) -> tuple[float, TagSlamResult]:
    started = time.process_time()
    result = run_tag_slam(config, recording, most_frames=stamps)
    return time.process_time() - started, result


def session_rows(path: Path, truth: Path | None, tag_size_m: float | None) -> int:
    """Poses at the mono cameras' and at the D455's instants against exact ones, after one body-frame offset a toss."""
    started, wall = os.times(), time.monotonic()
    with Session.open(path) as session:
        tosses = [t for t in session.tosses if any(n.startswith("mono") for n in session.toss(t).cameras())]
        found = find_truth(session, tosses, TruthConfig(tag_size_m=tag_size_m))
    ended = os.times()
    cpu_s = sum(ended[:4]) - sum(started[:4])
    print(
        f"{len(tosses)} tosses: {cpu_s:.1f} CPU-s, detector's processes included; {time.monotonic() - wall:.0f} s wall"
    )
    for toss in tosses if truth is not None else []:
        folder = truth / f"toss_{toss:02d}"  # type: ignore[operator]
        ours, track = found.tosses[toss], found.solved.tracks[toss]
        known = np.array([s != "lost" for s in ours.status])
        sure = np.array([s == "tracked" for s in ours.status])
        with np.load(folder / "poses_camera_object.npz") as stored:
            exact = stored["T_world_object"]
        print(pose_row(f"toss {toss}, D455 frames", ours.world_from_tagged[known], exact[known]))
        print(pose_row(f"toss {toss}, D455 frames that are tracked", ours.world_from_tagged[sure], exact[sure]))
        if (folder / "poses_at_mono_times.npz").exists():
            with np.load(folder / "poses_at_mono_times.npz") as stored:
                times_s, exact = stored["t"], stored["T_world_object"]
            first_ns = int(ours.time_ns[0])
            at = [int(np.abs(times_s - (t - first_ns) / 1e9).argmin()) for t in track.time_ns.tolist()]
            print(pose_row(f"toss {toss}, mono instants", track.world_from_tagged, exact[at]))
    print(json.dumps(found.verdict.document(), indent=1))
    return 0


def pose_row(name: str, poses: Any, exact: Any) -> str:
    offsets = np.linalg.inv(poses) @ exact
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_matrix(offsets[:, :3, :3]).mean().as_matrix()
    offset[:3, 3] = np.median(offsets[:, :3, 3], axis=0)
    moved = poses @ offset
    gap = 1e3 * np.linalg.norm(moved[:, :3, 3] - exact[:, :3, 3], axis=1)
    turn = np.degrees(
        (Rotation.from_matrix(moved[:, :3, :3]).inv() * Rotation.from_matrix(exact[:, :3, :3])).magnitude()
    )
    return (
        f"{name} ({len(gap)}): rms {np.sqrt((gap**2).mean()):.3f} mm, {np.sqrt((turn**2).mean()):.3f} deg; "
        f"largest {gap.max():.2f} mm, {turn.max():.2f} deg; flips {int((turn > 20).sum())}"
    )


if __name__ == "__main__":
    sys.exit(main())
