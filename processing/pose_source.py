"""Where contact learning without vision takes its poses: from tracks in a results folder, `/track/pose`, the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from recordings.errors import BadInput

if TYPE_CHECKING:
    from processing.evaluate.truth import Truth
    from processing.motion.trajectory import PoseSeries
    from recordings.session import Session
    from recordings.tracks import ObjectShape

CAMERA = "d455"
DEFAULT_STEPS = 80
"""Steps of a rollout, unless more are asked for."""


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


@dataclass(frozen=True, eq=False)
class PoseSource:
    """Where poses came from, the poses, the shape in their object frame where there is one, what a reader should know
    of them, and whether vision made them (else they were imported)."""

    name: str
    tracks: list[PoseSeries]
    shape: ObjectShape | None
    note: str | None = None
    of_vision: bool = False


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
    from recordings.tracks import ObjectTrack

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
            return PoseSource(f"track of variant {name}", usable, results.shape(name, "all"), of_vision=True)
    return None
