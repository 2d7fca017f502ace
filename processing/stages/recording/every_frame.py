"""Stage `every-frame`: what results say of every frame: masks and poses of those that were not worked on, too, how far
the shape's own error, drift and depth's scale may carry them all, and which of them are sure."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.refine.image_residuals import ALIKE, read_rows
from processing.run import Run
from processing.sensor.still import Kept, whole_session
from processing.store import Done
from processing.track.flags import published, with_drift, with_shape_error
from recordings.constants import MAD_TO_SIGMA
from recordings.results.folder import RobotMasks, read_masks, read_track, write_masks, write_track
from recordings.results.track_notes import FIT, NOTES
from recordings.tracks import ObjectTrack

VERSION = 12


@dataclass(frozen=True)
class EveryFrameResult:
    """Frames of the toss, and those that were worked on."""

    frames: int
    worked_on: int


def poses_in_every_frame(
    run: Run, toss: int, done: Done, first: tuple[int, Done], scale_sigma: float, alone: Done | None, held: bool,
    fit: Done | None,
) -> Done:  # fmt: skip
    """A stage's track of one toss in every frame that was recorded. `first`: the toss that comes first, and its track;
    `scale_sigma`: standard deviation of depth's scale; `alone`: the toss's first pass, where the track rests on a shape
    that was fused from first passes; `held`: whether other tosses' frames hold it; `fit`: each frame's residuals on the
    shape that the track rests on. What the tracker noted of its frames goes with it where these are all frames."""
    kept = run.kept.get(toss)
    inputs = {f"track_{toss:02d}": done.key} if kept is None else {"thinned": done.key, "kept": kept.digest}
    inputs |= {"first": first[1].key} | ({} if alone is None else {"alone": alone.key})
    inputs |= {} if fit is None else {"fit": fit.key}

    def compute(folder: Path) -> EveryFrameResult:
        track = read_track(done.folder, toss)
        if alone is not None:
            track = with_shape_error(track, read_track(alone.folder, toss), held)
        track = with_drift(track, run.noise.coarseness, held)
        if fit is not None:
            track = with_misfit(track, read_rows(fit.folder))
        defined = defining_pose(track, read_track(first[1].folder, first[0]))
        count = len(track.status)
        if kept is None:
            for noted in (FIT.format(toss), NOTES.format(toss)):
                if (done.folder / noted).exists():
                    shutil.copyfile(done.folder / noted, folder / noted)
        else:
            times_ns = whole_session(run.session).toss(toss).rgbd(run.camera.frame).times_ns
            status = tuple(track.status[i] for i in kept.like)
            poses, covariance = (x[kept.like] for x in (track.camera_from_object, track.covariance))
            track = replace(track, time_ns=times_ns, camera_from_object=poses, status=status, covariance=covariance)
        write_track(folder, published(scaled_by_chance(track, defined, scale_sigma)))
        return EveryFrameResult(len(track.status), count)

    config = {"toss": toss, "first": first[0], "scale_sigma": scale_sigma, "coarseness": run.noise.coarseness}
    config |= {"held": held}
    return _stage(run, config, inputs, compute)


def masks_in_every_frame(run: Run, toss: int, done: Done) -> Done:
    """A stage's masks of one toss in every frame that was recorded."""
    if toss not in run.kept:
        return done
    kept = run.kept[toss]

    def compute(folder: Path) -> EveryFrameResult:
        seen = read_masks(done.folder, toss)
        write_masks(folder, toss, [seen[int(i)] for i in kept.like], seen.confidence[kept.like])
        _copy_robot(RobotMasks.of(done.folder, toss), folder / f"toss_{toss:02d}.robot", kept)
        return EveryFrameResult(len(kept.like), len(kept.positions))

    return _stage(run, {"toss": toss, "masks": True}, {"thinned": done.key, "kept": kept.digest}, compute)


def _stage(
    run: Run, config: dict[str, Any], inputs: dict[str, str], compute: Callable[[Path], EveryFrameResult]
) -> Done:
    return run.store.run("every-frame", VERSION, config, inputs, EveryFrameResult, compute)


def defining_pose(track: ObjectTrack, first: ObjectTrack) -> Float[Array, "4 4"]:
    """The pose in which a track's object frame was defined: the first one of the `first` toss, where both share a frame
    and it has any, or else of the track itself; NaN where neither has one."""
    for one in (first, track):
        posed = np.flatnonzero(~one.lost)
        if one.object_frame == track.object_frame and len(posed):
            return one.camera_from_object[posed[0]]
    return np.full((4, 4), np.nan)


OUTLIER = 3.5
"""Modified z-score beyond which one of many does not belong to them (Iglewicz and Hoaglin 1993)."""


def with_misfit(track: ObjectTrack, residuals: Float[Array, "m 6"]) -> ObjectTrack:
    """The track, the standard deviations of frames that the shape explains so much worse than the toss's others that
    chance does not make it as many times as large as their residual of depth or outline is (Birge 1932). `residuals`:
    rows of `Explained` (toss, frame, depth, outline, ...)."""
    if len(residuals) == 0:
        return track
    frames, logs = residuals[:, 1].astype(int), np.log(np.maximum(residuals[:, 2:4], 1e-6))
    above = logs - np.median(logs, axis=0)
    spread = np.maximum(MAD_TO_SIGMA * np.median(np.abs(above), axis=0), ALIKE)
    times = np.where(above > OUTLIER * spread, np.exp(above), 1.0).max(axis=1)
    covariance = track.covariance.copy()
    covariance[frames] *= times[:, None, None] ** 2
    return replace(track, covariance=covariance)


def scaled_by_chance(track: ObjectTrack, defined: Float[Array, "4 4"], sigma: float) -> ObjectTrack:
    """The track, its covariances with what depth's scale, known to `sigma` (standard deviation), adds to them.

    A scale that is wrong by d moves every position p by d p. The object frame is where the pose (R0, p0) that `defined`
    it has it, which takes the shift there away from all others, in object axes: at (R, p) d (p - R R0^T p0) are left.
    """
    posed = ~track.lost
    R, p = track.camera_from_object[posed, :3, :3], track.camera_from_object[posed, :3, 3]
    shift: Float[Array, "m 3"] = p - R @ (defined[:3, :3].T @ defined[:3, 3])
    covariance = track.covariance.copy()
    covariance[posed, 3:, 3:] += sigma**2 * shift[:, :, None] * shift[:, None, :]
    return replace(track, covariance=covariance)


def _copy_robot(robot: RobotMasks | None, to: Path, kept: Kept) -> None:
    if robot is None:
        return
    to.mkdir()
    for position, i in enumerate(kept.like):
        if (source := robot.folder / f"{i:06d}.png").exists():
            shutil.copyfile(source, to / f"{position:06d}.png")
