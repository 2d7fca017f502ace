"""`toss-process SESSION --variant contact-only`: contact learning on poses that are there already."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recordings.console import Outcome
from recordings.errors import BadInput
from recordings.progress import Progress, Silent
from recordings.tracks import ObjectTrack

if TYPE_CHECKING:
    from processing.evaluate.truth import Truth
    from processing.motion.trajectory import PoseSeries
    from recordings.session import Session
    from recordings.tracks import ObjectShape

STAGE, VERSION = "contact-only", 4
CAMERA = "d455"
DEFAULT_STEPS = 80
MOST_TOSSES_LEARNED = 64
"""Learning from more is possible (--train), but gains nothing."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of `--variant contact-only`."""
    group = parser.add_argument_group("contact from poses alone (--variant contact-only)")
    group.add_argument("--train", metavar="I-J", help="tosses to learn from (default: all but the last)")
    group.add_argument("--test", metavar="I-J", help="tosses to roll out (default: all, the last one marked)")
    group.add_argument(
        "--geometry", choices=("box", "hull", "nonconvex"), help="hull with a shape to start from, else box"
    )
    group.add_argument(
        "--init", metavar="SIDE_M", type=float, help="start from a cube of this side (m), not from a shape"
    )
    group.add_argument(
        "--poses", choices=("truth", "track"), help="the track (default) or, marked in the result, the truth"
    )
    group.add_argument(
        "--steps", metavar="N", type=int, default=DEFAULT_STEPS, help="steps of 1/148 s to roll out (80)"
    )


def run(args: argparse.Namespace, session: Session, out_dir: Path, progress: Progress) -> Outcome:
    """What the command does; its document is what `--json` prints."""
    document, text = contact_only(
        session,
        out_dir,
        train=args.train,
        test=args.test,
        geometry=args.geometry,
        init_m=args.init,
        poses=args.poses,
        steps=args.steps,
        device=getattr(args, "device", "cpu") or "cpu",
        truth=getattr(args, "truth", None),
        progress=progress,
    )
    return Outcome(document, text)


def contact_only(
    session: Session,
    out_dir: Path,
    train: str | None = None,
    test: str | None = None,
    geometry: str | None = None,
    init_m: float | None = None,
    poses: str | None = None,
    steps: int = DEFAULT_STEPS,
    device: str = "cpu",
    progress: Progress | None = None,
    truth: Path | None = None,
) -> tuple[dict[str, Any], str]:
    """Learn from the tosses of `train`, roll out those of `test`, write stage, plot and assets into `out_dir`.

    Returns the JSON document and lines to read. Raises BadInput.
    """
    from processing.contact.stage import run_stage

    if steps < 1:
        raise BadInput(f"--steps {steps}: wanted at least 1")
    if init_m is not None and not 0.005 <= init_m <= 1.0:
        raise BadInput(f"--init {init_m}: wanted the side of a cube in metres, 0.005 to 1; for example --init 0.05")
    began = time.perf_counter()
    learned, tested = _split(session.tosses, train, test)
    source = find_poses(session, out_dir, poses, sorted({*learned, *tested}), truth)
    return run_stage(
        session, out_dir, source, learned, tested, geometry, init_m, steps, device, progress or Silent(), began
    )


def _split(there: Sequence[int], train: str | None, test: str | None) -> tuple[list[int], list[int]]:
    """Tosses to learn from and to roll out. Without --train: all but the last (of --test, all that are not in it)."""
    if train is not None:
        learned = chosen(train, there, "--train")
        tested = (
            chosen(test, there, "--test") if test is not None else [t for t in there if t not in learned] or learned
        )
        return learned, tested
    if test is not None:
        tested = chosen(test, there, "--test")
        learned = [t for t in there if t not in tested]
        if not learned:
            raise BadInput(f"--test {test} takes every toss; wanted some left to learn from, or give --train I-J")
        return learned, tested
    return (list(there[:-1]) or list(there))[:MOST_TOSSES_LEARNED], list(there)


def chosen(given: str, there: Sequence[int], option: str) -> list[int]:
    """`I` or `I-J`: those numbers that exist. Raises BadInput where none does."""
    first, dash, last = given.partition("-")
    if not first.isdigit() or (dash and not last.isdigit()):
        raise BadInput(f"{option} {given}: wanted a toss number or a range, for example {option} 0-15")
    if dash and int(last) < int(first):
        raise BadInput(f"{option} {given}: the range ends before it begins; wanted {option} {last}-{first}")
    found = [t for t in there if int(first) <= t <= int(last or first)]
    if not found:
        raise BadInput(f"{option} {given}: no such tosses; the session has {_span(there)}")
    return found


def _span(there: Sequence[int]) -> str:
    return f"{len(there)} tosses, {there[0]} to {there[-1]}" if there else "no tosses"


def find_poses(
    session: Session, out_dir: Path, poses: str | None, tosses: Sequence[int], truth: Path | None = None
) -> PoseSource:
    """The poses of some tosses: those of vision where the results folder holds them, else `/track/pose`, or the
    truth."""
    from processing.motion.trajectory import PoseSeries

    vision = _vision(out_dir)
    if poses == "truth":
        return _truth_poses(session, tosses, truth, vision)
    if vision is not None:
        return vision
    found = {t: session.toss(t).poses("/track/pose") for t in tosses}
    empty = [t for t, p in found.items() if not p]
    if empty:
        raise BadInput(
            f"toss {empty[0]} of {session.path} has no poses (no track in {out_dir}, nothing on /track/pose); "
            "wanted a tracked "
            "session: run `toss-process SESSION` first, or import poses with `toss-session import contactnets`"
        )
    note = (
        None if poses is None else f"--poses track: no track of vision in {out_dir}; the poses on /track/pose were used"
    )
    return PoseSource("/track/pose", [PoseSeries.from_poses(t, p) for t, p in found.items()], None, note)


class PoseSource:
    """Where poses came from, the poses, the shape in their object frame where there is one, and what a reader should
    know of them."""

    def __init__(self, name: str, tracks: list[PoseSeries], shape: ObjectShape | None, note: str | None = None) -> None:
        self.name, self.tracks, self.shape, self.note = name, tracks, shape, note


def _truth_poses(session: Session, tosses: Sequence[int], given: Path | None, vision: PoseSource | None) -> PoseSource:
    """True poses, in the truth's own object frame; vision's shape is brought into it where there is one."""
    from processing.evaluate.truth import open_truth

    truth = open_truth(given, session, session.calibration)
    if truth is None:
        raise BadInput(
            f"--poses truth: {session.path} has no truth/; give one by --truth DIR, or make it: `toss-truth SESSION`"
        )
    tracks = [t for toss in tosses if (t := _true_series(truth, session, toss)) is not None]
    if not tracks:
        raise BadInput(f"--poses truth: {truth.folder} has no poses of the tosses {list(tosses)}")
    name = "truth (only because --poses truth asks for it)"
    if vision is None or vision.shape is None:
        return PoseSource(f"{name}; the origin of its object frame is taken for the centre of mass", tracks, None)
    return PoseSource(name, tracks, in_frame_of(tracks, vision))


def _true_series(truth: Truth, session: Session, toss: int) -> PoseSeries | None:
    from processing.motion.trajectory import PoseSeries
    from recordings.session import Toss
    from recordings.session_writer import toss_name

    own = truth.folder / f"{toss_name(toss)}.mcap"
    if CAMERA not in session.calibration.cameras:
        return PoseSeries.from_poses(toss, Toss(own).poses("/groundtruth/pose")) if own.exists() else None
    empty = ObjectTrack.nowhere(toss, CAMERA, session.toss(toss).rgbd(CAMERA).times_ns)
    poses = truth.camera_from_object(empty)
    return None if poses is None else PoseSeries.from_camera(toss, empty.time_ns, poses, CAMERA, session.calibration)


def in_frame_of(tracks: Sequence[PoseSeries], vision: PoseSource) -> ObjectShape:
    """Vision's shape in the truth's object frame: the median of truth_from_track over all frames that both have."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    estimated = {t.toss: t for t in vision.tracks}
    turns, shifts = [], []
    for true in tracks:
        track = estimated.get(true.toss)
        if track is None:
            continue
        for i, time_s in enumerate(track.time_s):
            j = int(np.abs(true.time_s - time_s).argmin())
            if abs(true.time_s[j] - time_s) < 1e-3:
                turns.append(true.rotation[j].T @ track.rotation[i])
                shifts.append(true.rotation[j].T @ (track.position_m[i] - true.position_m[j]))
    if not turns or vision.shape is None:
        raise BadInput("--poses truth: no frame has both a tracked and a true pose, so vision's shape cannot be moved")
    turn, shift = Rotation.from_matrix(np.array(turns)).mean().as_matrix(), np.median(shifts, axis=0)
    shape = vision.shape
    moved = shape.vertices_m @ turn.T + shift
    return replace(shape, object_frame="object", vertices_m=moved)


def _vision(out_dir: Path) -> PoseSource | None:
    """Tracks and shape of the best variant in a results folder whose tosses share an object frame."""
    from processing.motion.trajectory import PoseSeries
    from recordings.results.folder import Results

    if not Results.is_results(out_dir):
        return None
    results = Results.open(out_dir)
    for name in ("joint", "converged", "ours", "bundlesdf-10"):
        if (name, "all") in results.variants():
            record = results.find(name, "all")
            tracks = [PoseSeries.from_track(t, record.calibration) for t in results.tracks(name, "all").values()]
            usable = [t for t in tracks if len(t) >= 5]
            return PoseSource(f"track of variant {name}", usable, results.shape(name, "all"))
    return None
