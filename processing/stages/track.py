"""Stage `track`: the poses of one toss, in whichever images it is given and from whatever is known of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from processing.backends import matcher_of
from processing.config import SecondPassStart
from processing.images import Images
from processing.run import CAMERA, Run, matcher_settings
from processing.store import Done
from processing.track.flags import unfit
from processing.track.notes import notes_of
from processing.track.track_file import write_toss_track
from processing.track.track_toss import track_toss
from recordings.geometry import Transform
from recordings.results.folder import read_shape, read_track, write_track
from recordings.results.track_notes import write_notes
from recordings.tracks import ObjectTrack

VERSION = 31


@dataclass(frozen=True)
class TrackResult:
    """Frames of the toss; of them interpolated and lost ones, and those that no pose fits; `cost`: `TossTrack.own_cost`
    (None: nothing to begin with)."""

    frames: int
    interpolated: int
    lost: int
    unfit: int = 0
    cost: float | None = None


def track(
    run: Run, images: Images, model: Done | None = None, before: Done | None = None,
    start_with: SecondPassStart = "shape",
) -> Done[TrackResult]:  # fmt: skip
    """p_i, from the toss alone; with `model` in a learned shape's object frame. `before`: it starts with these poses
    and the `model`, with the poses alone, or `anew` with the first one."""
    inputs = {**images.inputs}
    inputs |= {} if model is None else {"model": model.key}
    inputs |= {} if before is None else {"before": before.key}
    start = run.starts.get(images.toss) if before is None and model is None else None
    inputs |= {} if start is None else {"start": start.digest}

    def compute(folder: Path) -> TrackResult:
        known = _known(run, images.toss, model, before, start_with)
        if known is None:  # nothing to begin the second pass with
            assert before is not None
            lost = read_track(before.folder, images.toss)
            write_track(folder, lost)
            return _result(lost)
        seen = images.open()
        tracked = track_toss(
            seen.frames, seen.masks, run.camera, run.config.track,
            run.progress(f"toss {images.toss}: poses{'' if before is None else ', second pass'}"),
            toss=images.toss, confidence=seen.confidence, world_from_camera=run.world_from_camera,
            matcher=matcher_of(run.config.backends, run.device), colorless=seen.colorless, hand=seen.hand, **known,
        )  # fmt: skip
        write_toss_track(folder, tracked)
        if before is None:
            write_notes(folder, images.toss, *notes_of(tracked, matcher_of(run.config.backends, run.device)))
        unfit_frames = unfit(tracked.store, tracked.cost, run.config.track.flags)
        return _result(tracked.track, unfit_frames, tracked.own_cost)

    config = matcher_settings(run, run.config.track)
    config |= {} if before is None else {"second_pass": start_with}
    return run.store.run("track", VERSION, config, inputs, TrackResult, compute)


def _known(
    run: Run, toss: int, model: Done | None, before: Done | None, start_with: SecondPassStart
) -> dict[str, Any] | None:
    """What `track_toss` is told; None where a second pass has no pose to begin with."""
    if before is not None:
        return _second(toss, model, before, start_with)
    if model is not None:
        shape = read_shape(model.folder)
        return {"model": shape, "object_frame": shape.object_frame}
    start = run.starts.get(toss)
    if start is None:
        return {"object_frame": f"object_toss_{toss:02d}"}
    return {"object_frame": "object", "start": start.camera_from_object, "start_frame": start.frame}


def _second(toss: int, model: Done | None, before: Done, start_with: SecondPassStart) -> dict[str, Any] | None:
    track = read_track(before.folder, toss)
    known = np.flatnonzero(np.isfinite(track.camera_from_object[:, 0, 0]))
    if len(known) == 0:
        return None
    given: dict[str, Any] = {"object_frame": track.object_frame}
    if start_with == "anew":
        start = Transform.from_matrix(CAMERA, track.object_frame, track.camera_from_object[known[0]])
        return {**given, "start": start, "start_frame": int(known[0])}
    shape = {"model": read_shape(model.folder)} if model is not None and start_with == "shape" else {}
    return {**given, "poses": track.camera_from_object, **shape}


def _result(track: ObjectTrack, unfit: int = 0, cost: float | None = None) -> TrackResult:
    interpolated, lost = (track.status.count(status) for status in ("interpolated", "lost"))
    return TrackResult(len(track.status), interpolated, lost, unfit, cost)
