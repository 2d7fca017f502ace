"""Figures of calibration, each row a function of its own (ground truth's rows: tools/bench_tagslam.py).

python tools/bench_truth.py                          # all rows; TOSSLAB_DATA points to the shared data
python tools/bench_truth.py corners hand-eye         # some
python tools/bench_truth.py time10 --session SYN     # a session of ten synthetic tosses with mono cameras
CPU seconds are this process's and its children's, measured with os.times.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation
from synthetic.infrared_dots import corner_noise_px, dots_advice, with_infrared_dots

from calibration.cameras.extrinsics import board_pose
from calibration.cameras.poses import angle_deg, inverse_poses
from calibration.cameras.targets import Tags, TargetView
from calibration.hand_eye import calibrate_hand_eye
from calibration.tags.detect import detect_tags
from recordings.geometry import CameraModel
from recordings.tracks import RigCalibration

DATA = Path(os.environ.get("TOSSLAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
TAG_M = 0.06140625


@dataclass(frozen=True)
class Given:
    """What a row may need: a scratch folder, and a session of synthetic tosses."""

    scratch: Path
    session: Path | None

    def cube(self) -> Path:
        """cube_dev, imported."""
        out = self.scratch / "cube"
        if not out.exists():
            run("toss-session", "import", "folder", DATA / "cube_dev", out)
        return out


def run(*words: object) -> str:
    """A command of the project; its stdout. A refusal (1) is an answer too."""
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True)
    if done.returncode > 1:
        raise SystemExit(f"{' '.join(map(str, words))}: {done.stderr[-400:]}")
    return done.stdout


def gap(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """mm and deg."""
    off = inverse_poses(true) @ found
    return 1e3 * float(np.linalg.norm(off[:3, 3])), angle_deg(off[:3, :3])


def corners(given: Given) -> list[str]:
    """AprilRobotics' 47 published tags, corners in the +0.5 convention."""
    lines = []
    for search in ("normal", "thorough"):
        errors = []
        for text in sorted((DATA / "apriltag_images_aprilrobotics/test/data").glob("*.txt")):
            image = cv2.imread(str(text.with_suffix(".jpg")), cv2.IMREAD_GRAYSCALE)
            found = detect_tags([image], largest_hamming=2, search=search)[0]
            for line in text.read_text().splitlines():
                tag = np.array(re.findall(r"-?[\d.]+", line.split(",", 1)[1]), dtype=float).reshape(4, 2)
                errors.append(min(np.linalg.norm(t.corners_px + 0.5 - tag, axis=1).max() for t in found))
        near = np.array(errors)
        lines.append(
            f"{search}: {(near < 1).sum()} of {len(near)} within 1 px, {(near < 0.5).sum()} within 0.5 (>= 43)"
        )
    return lines


def cameras(given: Given) -> list[str]:
    """cube_dev's board views: places against truth, focal lengths against those given (which are the true ones)."""
    lines = []
    truth = json.loads((DATA / "cube_dev_truth" / "calibration.json").read_text())["T_d455_mono"]
    ways = {
        "`cameras`": [("cameras",)],
        "`intrinsics`, then `cameras`": [("intrinsics",), ("cameras",)],
        "`cameras --lenses`": [("cameras", "--lenses")],
        "`intrinsics --anew` (lenses from twelve views alone), then `cameras`": [
            ("intrinsics", "--anew"),
            ("cameras",),
        ],
    }
    for number, (label, commands) in enumerate(ways.items()):
        copy = given.scratch / f"cameras{number}"
        if not copy.exists():
            shutil.copytree(given.cube(), copy)
        given_lenses = RigCalibration.read(copy / "calibration.json").cameras
        for command, *options in commands:
            run("toss-calibrate", command, copy, *options)
        found = RigCalibration.read(copy / "calibration.json")
        off = {n: gap(found.transform("d455", n).matrix, np.array(t)) for n, t in truth.items()}
        places = ", ".join(f"{n} {mm:.2f} mm {deg:.3f} deg" for n, (mm, deg) in off.items())
        focal = max(
            abs(getattr(c, f) / getattr(given_lenses[n], f) - 1) for n, c in found.cameras.items() for f in ("fx", "fy")
        )
        lines.append(f"{label}: {places}; focal length off by {100 * focal:.3f} % at most (<= 1 mm, 0.1 deg, 0.3 %)")
    return lines


def table(given: Given) -> list[str]:
    """The table of cube_dev, whose truth is z = 0 (needs the cameras' places)."""
    copy = given.scratch / "table"
    if not copy.exists():
        shutil.copytree(given.cube(), copy)
    run("toss-calibrate", "cameras", copy)
    run("toss-calibrate", "table", copy, "--tag-size", TAG_M)
    entry = RigCalibration.read(copy / "calibration.json").residuals["table"]
    tilt = np.degrees(np.arccos(np.clip(entry["normal_world"][2], -1, 1)))
    return [
        f"height {1e3 * entry['offset_m']:.3f} mm (said +-{1e3 * entry['std_m']:.3f}), tilt {tilt:.4f} deg (<= 0.5 mm)"
    ]


def time(given: Given) -> list[str]:
    """One toss of cube_dev; its true offset is 0."""
    copy = given.scratch / "time"
    if not copy.exists():
        shutil.copytree(given.cube(), copy)
    run("toss-calibrate", "cameras", copy)
    run("toss-calibrate", "time", copy, "--tag-size", TAG_M)
    entry = RigCalibration.read(copy / "calibration.json").residuals["time"]["offsets"]["mono"]
    return [f"one toss: off by {entry['offset_ns'] / 1e6:.3f} ms, said +-{entry['std_ns'] / 1e6:.3f} ms (<= 1 ms)"]


def time10(given: Given) -> list[str]:
    """Tosses of the synthetic lab, true offset 0 (--session: a folder layout made by tools/make_synthetic.py)."""
    if given.session is None:
        return ["skipped: wants --session (tools/make_synthetic.py --preset mono --tosses 10 --out SYN)"]
    copy = given.scratch / "synthetic"
    if not copy.exists():
        run("toss-session", "import", "folder", given.session, copy)
    run("toss-calibrate", "cameras", copy)
    out = json.loads(run("toss-calibrate", "time", copy, "--json"))["calibrations"][0]
    each = ", ".join(f"{v[0]:.2f}" for v in out["by_toss_ms"].values())
    said = out["uncertainty"]["offset_ms"]
    tosses = out["residuals"]["tosses"]
    return [f"{tosses} tosses: off by {out['residuals']['offset_ms']:.3f} ms, said +-{said:.3f} (<= 0.4); each: {each}"]


def arm_case(seed: int, board_deg: float, arm_m: float) -> tuple[CameraModel, np.ndarray, np.ndarray, list[TargetView]]:
    """Twenty poses up to 45 deg, board 0.5 mm, arm 0.05 deg, corners 0.1 px (all by axis)."""
    from acquisition.synthetic.board import board_tags

    rng = np.random.default_rng(seed)
    tags = board_tags()
    board = Tags("tag36h11", {t.tag_id: t.size_m for t in tags}, {t.tag_id: t.world_from_tag.matrix for t in tags})
    points = np.concatenate([board.corners_m(i) for i in board.size_m])
    model = CameraModel("d455", 848, 480, np.array([[430.0, 0, 424], [0, 430.0, 240], [0, 0, 1]]))

    def pose(turn: np.ndarray, at: np.ndarray) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), at
        return out

    mount = pose(np.array([2.2, 0.3, -0.4]) + 0.2 * rng.normal(size=3), np.array([0.1, 0.2, 1.4]))
    held = pose(0.5 * rng.normal(size=3), np.array([0.05, 0.02, 0.1]))
    robot, views = [], []
    for _ in range(20):
        turn = rng.normal(size=3)
        turn *= np.radians(45) * rng.uniform(0.5, 1) / np.linalg.norm(turn)
        facing = Rotation.from_rotvec(turn) * Rotation.from_euler("x", np.pi)
        seen = pose(facing.as_rotvec(), np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.6, 0.85)]))
        moved = inverse_poses(mount) @ seen @ inverse_poses(held)
        robot.append(moved @ pose(np.radians(0.05) * rng.normal(size=3), arm_m * rng.normal(size=3)))
        wobbly = seen @ pose(np.radians(board_deg) * rng.normal(size=3), 5e-4 * rng.normal(size=3))
        pixels = model.project(points @ wobbly[:3, :3].T + wobbly[:3, 3]) + 0.1 * rng.normal(size=(len(points), 2))
        fine = model.sees(pixels)
        covariance = np.tile(0.01 * np.eye(2), (int(fine.sum()), 1, 1))
        views.append(TargetView(np.flatnonzero(fine), points[fine], pixels[fine], covariance))
    return model, mount, np.array(robot), views


def opencv_answers(boards: list[np.ndarray], robot: np.ndarray) -> dict[str, np.ndarray]:
    """camera_from_base by every method of OpenCV."""
    out = {}
    turns, places = [a[:3, :3] for a in boards], [a[:3, 3] for a in boards]
    back = [inverse_poses(b) for b in robot]
    for name in ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS"):
        method = getattr(cv2, f"CALIB_HAND_EYE_{name}")
        R, t = cv2.calibrateHandEye([b[:3, :3] for b in back], [b[:3, 3] for b in back], turns, places, method=method)
        out[name] = inverse_poses(np.vstack([np.hstack([R, t.reshape(3, 1)]), [0, 0, 0, 1]]))
    for name in ("SHAH", "LI"):
        method = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}")
        *_, R, t = cv2.calibrateRobotWorldHandEye(
            turns, places, [b[:3, :3] for b in robot], [b[:3, 3] for b in robot], method=method
        )
        out[name] = np.vstack([np.hstack([R, t.reshape(3, 1)]), [0, 0, 0, 1]])
    return out


def hand_eye(given: Given) -> list[str]:
    """Against every OpenCV method in the same runs: the issue's noise, then with an unsteady board and arm as well."""
    stated = _hand_eye(32, 0.0, 0.0, "board 0.5 mm, arm 0.05 deg by axis")
    return [*stated, *_hand_eye(12, 0.1, 2e-4, "and board 0.1 deg, arm 0.2 mm")]


def _hand_eye(runs: int, board_deg: float, arm_m: float, label: str) -> list[str]:
    errors: dict[str, list[tuple[float, float]]] = {}
    for seed in range(runs):
        model, mount, robot, views = arm_case(seed, board_deg, arm_m)
        boards = [board_pose(model, v)[0] for v in views]
        answers = {"ours": calibrate_hand_eye(model, views, robot, "eye-to-hand").camera_from_mount}
        for name, answer in {**answers, **opencv_answers(boards, robot)}.items():
            errors.setdefault(name, []).append(gap(answer, mount))
    means = {n: np.mean(e, axis=0) for n, e in errors.items()}
    table = ", ".join(f"{n} {mm:.2f} mm {deg:.3f} deg" for n, (mm, deg) in means.items())
    worst = np.max(errors["ours"], axis=0)
    others = min(np.max(e, axis=0)[0] for n, e in errors.items() if n != "ours")
    best = all(means["ours"][0] <= m[0] for m in means.values())
    return [
        f"{label}; mean of {runs} runs: {table}",
        f"  ours at worst {worst[0]:.2f} mm {worst[1]:.3f} deg (<= 1.5 mm, 0.15 deg; the best other's worst "
        f"{others:.2f} mm); best of all in mm: {best}",
    ]


def dots(given: Given) -> list[str]:
    """Infrared dots rendered into cube_dev's first board view of each mono camera: how far they move corners."""
    lines, rng = [], np.random.default_rng(0)
    for camera in ("mono0", "mono1", "mono2"):
        image = cv2.imread(str(DATA / "cube_dev/calibration/view_00" / f"{camera}.png"), cv2.IMREAD_GRAYSCALE)
        without = detect_tags([image])
        row = []
        for strength in (0.15, 0.5, 1.0, 2.0):
            found = detect_tags([with_infrared_dots(image, strength, 7.0, rng) for _ in range(2)])
            advice = dots_advice(camera, found, without)
            row.append(f"{strength:g}: {corner_noise_px(found, without):.3f} px{' (advice given)' if advice else ''}")
        lines.append(f"{camera}: dots of strength {', '.join(row)} (<= 0.2 px, or advice)")
    return lines


ROWS: dict[str, Callable[[Given], list[str]]] = {
    "corners": corners,
    "cameras": cameras,
    "table": table,
    "time": time,
    "time10": time10,
    "hand-eye": hand_eye,
    "dots": dots,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", choices=[[], *ROWS], metavar="ROW", help=f"{', '.join(ROWS)}; default: all")
    parser.add_argument("--session", type=Path, help="folder layout of ten synthetic tosses, for time10")
    given = parser.parse_args()
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with tempfile.TemporaryDirectory() as scratch:
        for name in given.rows or ROWS:
            before = os.times()
            lines = ROWS[name](Given(Path(scratch), given.session))
            after = os.times()
            seconds = sum(after[:4]) - sum(before[:4])
            print(f"{name} ({seconds:.1f} CPU-s)", *lines, sep="\n  ", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
