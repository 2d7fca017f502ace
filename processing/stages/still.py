"""Stages `still` and `every-frame`: which frames of a toss are worked on; the masks and poses of the others."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.run import Run, each
from processing.sensor.still import Kept, ThinnedSession, kept_of, still_stretches, whole_session
from processing.store import Done
from recordings.results.folder import RobotMasks, read_masks, read_track, write_masks, write_track
from recordings.results.stage_files import stage_document

VERSION = 2


@dataclass(frozen=True)
class StillResult:
    """Frames of the toss, those that are worked on, and the stretches (first, last) in which nothing moves."""

    frames: int
    kept: int
    stretches: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class EveryFrameResult:
    """Frames of the toss, and those that were worked on."""

    frames: int
    worked_on: int


def without_waiting(run: Run) -> Run:
    """The run with few frames of every still stretch; the very same run where there is none."""
    kept = {t: k for t, k in each(run, run.tosses, lambda t: _kept(run, t)).items() if k is not None}
    if not kept:
        return run
    keys = {f"toss_{t:02d}": hashlib.sha256((run.keys[f"toss_{t:02d}"] + k.digest).encode()).hexdigest()
            for t, k in kept.items()}  # fmt: skip
    return replace(run, session=ThinnedSession(run.session, kept), keys={**run.keys, **keys}, kept=kept)


def _kept(run: Run, toss: int) -> Kept | None:
    """Stage `still` of one toss; None where all its frames are worked on."""
    frames, settings, name = run.session.toss(toss).rgbd(run.camera.frame), run.config.still, f"toss_{toss:02d}"
    if len(frames) < settings.least:
        return None

    def compute(folder: Path) -> StillResult:
        found = still_stretches(frames, settings, run.progress(f"toss {toss}: what moves"))
        kept = kept_of(found, len(frames), settings)
        document = {"positions": kept.positions.tolist(), "like": kept.like.tolist()}
        (folder / "still.json").write_text(json.dumps(document) + "\n")
        return StillResult(len(frames), len(kept.positions), tuple(found))

    done = run.store.run("still", VERSION, settings, {name: run.keys[name]}, StillResult, compute)
    if done.result.kept == done.result.frames:
        return None
    stored = stage_document(done.folder / "still.json")
    return Kept(*(np.array(stored[k], dtype=np.int64) for k in ("positions", "like")))


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
            write_masks(folder, toss, list(_masks(seen, kept)), seen.confidence[kept.like])
            _copy_robot(RobotMasks.of(done.folder, toss), folder / f"{stem}.robot", kept)
        return EveryFrameResult(len(kept.like), len(kept.positions))

    inputs = {"thinned": done.key, "kept": kept.digest}
    return run.store.run("every-frame", VERSION, {"toss": toss}, inputs, EveryFrameResult, compute)


def _masks(seen: Sequence[Bool[Array, "h w"]], kept: Kept) -> Iterator[Bool[Array, "h w"]]:
    for i in kept.like:
        yield seen[int(i)]


def _copy_robot(robot: RobotMasks | None, to: Path, kept: Kept) -> None:
    if robot is None:
        return
    to.mkdir()
    for position, i in enumerate(kept.like):
        if (source := robot.folder / f"{i:06d}.png").exists():
            shutil.copyfile(source, to / f"{position:06d}.png")
