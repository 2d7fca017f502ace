"""Stage `every-frame`: the masks and poses of the frames that were not worked on."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

from processing.run import Run
from processing.sensor.still import Kept, whole_session
from processing.store import Done
from recordings.results.folder import RobotMasks, read_masks, read_track, write_masks, write_track

VERSION = 2


@dataclass(frozen=True)
class EveryFrameResult:
    """Frames of the toss, and those that were worked on."""

    frames: int
    worked_on: int


def in_every_frame(run: Run, toss: int, done: Done) -> Done:
    """A stage's track and masks of one toss in every frame that was recorded (stage `every-frame`)."""
    if toss not in run.kept:
        return done
    kept, frames = run.kept[toss], whole_session(run.session).toss(toss).rgbd(run.camera.frame)
    stem = f"toss_{toss:02d}"

    def compute(folder: Path) -> EveryFrameResult:
        if (done.folder / f"{stem}.track.npz").exists():
            track = read_track(done.folder, toss)
            status = tuple(track.status[i] for i in kept.like)
            poses, covariance = (x[kept.like] for x in (track.camera_from_object, track.covariance))
            write_track(folder, replace(track, time_ns=frames.times_ns, camera_from_object=poses, status=status,
                                        covariance=covariance))  # fmt: skip
        if (done.folder / f"{stem}.masks").exists():
            seen = read_masks(done.folder, toss)
            write_masks(folder, toss, [seen[int(i)] for i in kept.like], seen.confidence[kept.like])
            _copy_robot(RobotMasks.of(done.folder, toss), folder / f"{stem}.robot", kept)
        return EveryFrameResult(len(kept.like), len(kept.positions))

    inputs = {"thinned": done.key, "kept": kept.digest}
    return run.store.run("every-frame", VERSION, {"toss": toss}, inputs, EveryFrameResult, compute)


def _copy_robot(robot: RobotMasks | None, to: Path, kept: Kept) -> None:
    if robot is None:
        return
    to.mkdir()
    for position, i in enumerate(kept.like):
        if (source := robot.folder / f"{i:06d}.png").exists():
            shutil.copyfile(source, to / f"{position:06d}.png")
