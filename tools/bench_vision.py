"""The trackers against the figures of their issue: accuracy, CPU milliseconds a frame, peak memory. Ours and the
baseline side by side, on the same masks.

python tools/bench_vision.py                                       # cube_dev, own masks, both trackers
python tools/bench_vision.py --masks true --trackers ours DIR...   # sessions in the folder layout, truth in DIR_truth
python tools/bench_vision.py --trackers ours --shape DIR...        # the learned shape too, beside its floor: true poses

A frame is wrong where its rotation is off by more than 5 degrees; silent where it is wrong, marked as tracked, and its
covariance does not say so (beyond three standard deviations). Calibrated covariances have a normalised error near 1.

One thread; CPU time, not wall time. Compiling the kernels (once a machine) is not counted.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import trimesh

from processing.baselines.frame_to_model import FrameToModel
from processing.evaluate.metrics import (
    FrameErrors,
    align_first,
    auc_percent,
    chamfer,
    frame_errors,
    icp_align,
    surface_points,
)
from processing.field.learn import LearnConfig, TossViews, learn_shape
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.segmenter import BackgroundSegmenter
from processing.segment.background.static_scene import (
    SceneSettings,
    calibrated_table_depth,
    learn_scene,
    sample_positions,
)
from processing.segment.segmenter import Example
from processing.track.registration.register import register_tosses
from processing.track.track_toss import TossTrack, track_toss
from recordings.geometry import rotation_log
from recordings.importers.folder import import_folder
from recordings.progress import Silent
from recordings.session import Session
from recordings.tracks import ObjectTrack, Status

CAMERA = "d455"
DATA = Path(os.environ.get("TOSSLAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
Masks = list[np.ndarray]


@dataclass(frozen=True)
class Seen:
    """One toss as a tracker gets it, and its truth."""

    number: int
    masks: Masks
    confidence: np.ndarray
    truth: np.ndarray
    moving: np.ndarray


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, default=[DATA / "cube_dev"])
    parser.add_argument("--masks", choices=("own", "true"), default="own")
    parser.add_argument("--trackers", default="ours,frame-to-model", help="comma separated")
    parser.add_argument("--tosses", type=int, help="the first N tosses only")
    parser.add_argument("--shape", action="store_true", help="learn the shape too (ours)")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as place:
        for folder in given.folders:
            import_folder(folder, Path(place) / folder.name, None, None)
            session = Session.open(Path(place) / folder.name)
            seen = look(session, folder, given.masks, given.tosses)
            for tracker in given.trackers.split(","):
                bench(session, folder, seen, tracker, given.shape)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
    return 0


def look(session: Session, folder: Path, kind: str, most: int | None) -> list[Seen]:
    """Masks (found by us, or the true ones) and truth of every toss."""
    numbers = session.tosses[:most]
    masks = own_masks(session, numbers) if kind == "own" else {n: true_masks(folder, n) for n in numbers}
    seen = []
    for n in numbers:
        with np.load(truth_of(folder) / f"toss_{n:02d}" / "poses_camera_object.npz", allow_pickle=False) as stored:
            poses, phase = stored["T_camera_object"], stored["phase"]
        seen.append(Seen(n, *masks[n], poses.reshape(-1, 4, 4), (phase != "hold") & (phase != "rest")))
    return seen


def truth_of(folder: Path) -> Path:
    return folder.with_name(folder.name + "_truth")


def true_masks(folder: Path, number: int) -> tuple[Masks, np.ndarray]:
    files = sorted((truth_of(folder) / f"toss_{number:02d}" / "masks").glob("*.png"))
    masks = [np.asarray(np.asarray(cv2.imread(str(f), cv2.IMREAD_GRAYSCALE)) > 0) for f in files]
    return masks, np.ones(len(masks))


def own_masks(session: Session, numbers: Sequence[int]) -> dict[int, tuple[Masks, np.ndarray]]:
    """From the static scene and each toss's first mask; where it has none, from what another toss's mask shows."""
    streams = {n: session.toss(n).rgbd(CAMERA) for n in numbers}
    settings, camera = SceneSettings(), session.calibration.camera(CAMERA)
    places = sample_positions([len(s) for s in streams.values()], settings.frames)
    table = calibrated_table_depth(session.calibration, CAMERA)
    frames = (list(streams.values())[t][p] for t, p in places)
    scene = learn_scene(frames, table, settings, tosses=[t for t, _ in places])
    out = {}
    start, count = time.process_time(), 0
    for n, stream in streams.items():
        first = dict(sorted(session.toss(n).masks().items())[:1])
        example = None if first else _example(session, numbers)
        found = BackgroundSegmenter(scene, camera, BackgroundSettings()).masks(stream, first, example, None, Silent())
        ordered = sorted(found, key=lambda m: m.position)
        out[n] = ([m.mask for m in ordered], np.array([m.confidence for m in ordered]))
        count += len(stream)
    print(f"{session.name}: own masks, {1000 * (time.process_time() - start) / count:.0f} CPU-ms a frame")
    return out


def _example(session: Session, numbers: Sequence[int]) -> Example:
    number = next(n for n in numbers if session.toss(n).masks())
    position, mask = min(session.toss(number).masks().items())
    return Example(session.toss(number).rgbd(CAMERA)[position], mask)


def bench(session: Session, folder: Path, seen: list[Seen], tracker: str, shape: bool) -> None:
    """Track every toss, register ours, print a line a toss and the totals."""
    points = surface_points(trimesh.load(truth_of(folder) / "mesh.obj", force="mesh", process=False), 2000)
    run: Callable[[Session, Seen], TossTrack | ObjectTrack] = ours if tracker == "ours" else baseline
    run(session, shortened(seen[0]))  # compiles
    cpu_s, frames, errors, full = 0.0, 0, [], []
    for toss in seen:
        start = time.process_time()
        found = run(session, toss)
        cpu_s += time.process_time() - start
        frames += len(toss.masks)
        track = found.track if isinstance(found, TossTrack) else found
        full.append(found)
        errors.append(judged(track.camera_from_object, toss.truth, None, points))
        lost = int(track.lost.sum())
        marks = f"lost {lost} interpolated {track.status.count('interpolated')} {honesty(track, toss.truth)}"
        print(f"  {folder.name} toss {toss.number} {tracker}: {line(errors[-1], toss.moving)} {marks}", flush=True)
    moving = np.concatenate([t.moving for t in seen])
    print(f"{folder.name} {tracker}: {line(joined(errors), moving)}, {1000 * cpu_s / frames:.0f} CPU-ms a frame")
    tracks = [f for f in full if isinstance(f, TossTrack)]
    if len(tracks) > 1:
        start = time.process_time()
        together = register_tosses(tracks)
        cpu_s = time.process_time() - start
        shift = align_first(together.tracks[0].camera_from_object, seen[0].truth)
        errors = [judged(r.camera_from_object, t.truth, shift, points) for r, t in zip(together.tracks, seen)]
        left = [t.track.toss for t, ok in zip(tracks, together.joined) if not ok]
        unsure = [t.track.toss for t, twin in zip(tracks, together.ambiguous) if twin]
        print(f"{folder.name} {tracker}, one alignment for all: {line(joined(errors), moving)}, left out {left}, "
              f"ambiguous {unsure}, {1000 * cpu_s / frames:.0f} CPU-ms a frame more", flush=True)  # fmt: skip
        if shape:
            kept = [i for i, ok in enumerate(together.joined) if ok]
            own = [together.tracks[i] for i in kept]
            learned(session, folder, [seen[i] for i in kept], own, "learned")
            true = [replace(t, camera_from_object=seen[i].truth, status=status_of(seen[i].truth))
                    for i, t in zip(kept, own)]  # fmt: skip
            learned(session, folder, [seen[i] for i in kept], true, "at true poses (floor)")


def status_of(poses: np.ndarray) -> tuple[Status, ...]:
    return tuple("tracked" if np.isfinite(p).all() else "lost" for p in poses)


def learned(session: Session, folder: Path, seen: list[Seen], tracks: Sequence[ObjectTrack], label: str) -> None:
    """The shape from these tracks: Chamfer distance after a rigid ICP, CPU seconds."""
    start = time.process_time()
    views = []
    for toss, track in zip(seen, tracks):
        frames = session.toss(toss.number).rgbd(CAMERA)
        views.append(TossViews(frames, frames.depth_times_ns, toss.masks, track))
    shape, used, _ = learn_shape(views, session.calibration.camera(CAMERA), LearnConfig(), "cpu", Silent())
    cpu_s = time.process_time() - start
    truth = trimesh.load(truth_of(folder) / "mesh.obj", force="mesh", process=False)
    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces, process=False)
    # from first-frame alignment, because a closest-point search alone would not find a turn of 90 degrees
    shift = align_first(tracks[0].camera_from_object, seen[0].truth)
    mesh.apply_transform(np.eye(4) if shift is None else np.linalg.inv(shift))
    mesh.apply_transform(icp_align(surface_points(mesh, 6000), surface_points(truth, 30000)))
    print(
        f"{folder.name} shape {label}: CD {chamfer(mesh, truth).cm:.3f} cm, {used} views, {cpu_s:.1f} CPU-s", flush=True
    )


def honesty(track: ObjectTrack, truth: np.ndarray) -> str:
    """Wrong frames, silent ones among them, and the median normalised squared error of the rotation."""
    shift = align_first(track.camera_from_object, truth)
    wrong, silent, normalised = 0, 0, []
    for i, (e, t) in enumerate(zip(track.camera_from_object @ (np.eye(4) if shift is None else shift), truth)):
        sigma = track.covariance[i, :3, :3]
        if track.status[i] == "lost" or not np.isfinite(e).all() or not np.isfinite(sigma).all() or not sigma.any():
            continue
        turn = rotation_log(t[:3, :3] @ e[:3, :3].T)
        squared = float(turn @ np.linalg.solve(sigma + 1e-12 * np.eye(3), turn)) / 3
        off = bool(np.degrees(np.linalg.norm(turn)) > 5)
        wrong += off
        silent += off and track.status[i] == "tracked" and squared > 9
        normalised.append(squared)
    return f"wrong {wrong} silent {silent} normalised {np.median(normalised) if normalised else np.nan:.1f}"


def ours(session: Session, toss: Seen) -> TossTrack:
    calibration = session.calibration
    frames = session.toss(toss.number).rgbd(CAMERA)[: len(toss.masks)]
    world = calibration.find("world", CAMERA)
    return track_toss(frames, toss.masks, calibration.camera(CAMERA), toss=toss.number, confidence=toss.confidence,
                      world_from_camera=world)  # fmt: skip


def baseline(session: Session, toss: Seen) -> ObjectTrack:
    frames = session.toss(toss.number).rgbd(CAMERA)[: len(toss.masks)]
    camera = session.calibration.camera(CAMERA)
    return FrameToModel().track(toss.number, frames, toss.masks, camera, "object", Silent()).track


def shortened(toss: Seen) -> Seen:
    return Seen(toss.number, toss.masks[:4], toss.confidence[:4], toss.truth[:4], toss.moving[:4])


def judged(estimate: np.ndarray, truth: np.ndarray, shift: np.ndarray | None, points_m: np.ndarray) -> FrameErrors:
    shift = align_first(estimate, truth) if shift is None else shift
    return frame_errors(estimate @ (np.eye(4) if shift is None else shift), truth, points_m)


def joined(errors: Sequence[FrameErrors]) -> FrameErrors:
    return FrameErrors(*(np.concatenate(part) for part in zip(*(vars(e).values() for e in errors))))


def line(e: FrameErrors, moving: np.ndarray) -> str:
    good = 100 * np.mean((e.rotation_deg < 5) & (e.translation_m < 0.05))
    flips = int((np.isfinite(e.rotation_deg) & (e.rotation_deg > 45)).sum())
    return (
        f"ADD {auc_percent(e.add_m):.2f} ADD-S {auc_percent(e.adds_m):.2f} SR {good:.1f} flips {flips} "
        f"moving {np.median(e.rotation_deg[moving]):.2f} deg {1000 * np.median(e.translation_m[moving]):.2f} mm"
    )


if __name__ == "__main__":
    sys.exit(main())
