"""The vision stages of the pipeline: tracks of one toss, tosses in one object frame, the field and its shape."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from processing.field.learn import LearnConfig, TossViews, learn_shape
from processing.store import Counts, Done
from processing.track.notes import notes_of
from processing.track.registration.register import register_tosses
from processing.track.track_file import read_toss_track, write_toss_track
from processing.track.track_toss import track_toss
from recordings.results.folder import (
    RobotMasks,
    read_hand,
    read_masks,
    read_shape,
    read_track,
    write_shape,
    write_track,
)
from recordings.results.track_notes import write_notes
from recordings.session_writer import file_sha256
from recordings.tracks import ObjectTrack

if TYPE_CHECKING:
    from processing.pipeline import Run

CAMERA = "d455"


def track_stage(run: Run, toss: int, masks: Done) -> Done:
    """Stage `track`: p_i, the poses of one toss from that toss alone."""
    name = f"toss_{toss:02d}"
    inputs = {"masks": masks.key, name: run.keys[name], "calibration": run.keys["calibration"]}
    start = run.starts.get(toss)
    if start is not None:
        inputs["start"] = start.digest

    def compute(folder: Path) -> Counts:
        frames = run.frames(toss)
        seen = read_masks(masks.folder, toss)
        tracked = track_toss(
            frames,
            seen,
            run.camera,
            run.config.track,
            run.progress(f"toss {toss}: poses"),
            toss=toss,
            object_frame=f"object_{name}" if start is None else "object",
            confidence=seen.confidence,
            world_from_camera=run.session.calibration.find("world", CAMERA),
            matcher=run.matcher,
            start=None if start is None else start.camera_from_object,
            start_frame=None if start is None else start.frame,
            hand=read_hand(masks.folder, toss),
        )
        write_toss_track(folder, tracked)
        write_notes(folder, toss, *notes_of(tracked, run.matcher))
        return {**_count(tracked.track), "unfit": tracked.unfit}

    return run.store.run("track", 9, run.matcher_settings(run.config.track), inputs, compute)


def model_stage(run: Run, model: Path) -> Done:
    """Stage `model`: a shape that was learned before, brought into this results folder."""
    shape = read_shape(model)
    inputs = {"shape": file_sha256(model / "shape.ply")}

    def compute(folder: Path) -> Counts:
        write_shape(folder, shape)
        return {"from": model.name, "vertices": len(shape.vertices_m)}

    return run.store.run("model", 1, {}, inputs, compute)


def model_track_stage(run: Run, toss: int, masks: Done, model: Done) -> Done:
    """Stage `track` against a learned shape, in that shape's object frame."""
    name = f"toss_{toss:02d}"
    inputs = {"masks": masks.key, name: run.keys[name], "calibration": run.keys["calibration"], "model": model.key}

    def compute(folder: Path) -> Counts:
        seen, shape = read_masks(masks.folder, toss), read_shape(model.folder)
        tracked = track_toss(
            run.frames(toss),
            seen,
            run.camera,
            run.config.track,
            run.progress(f"toss {toss}: poses with the learned shape"),
            toss=toss,
            object_frame=shape.object_frame,
            confidence=seen.confidence,
            world_from_camera=run.session.calibration.find("world", CAMERA),
            matcher=run.matcher,
            model=shape,
            hand=read_hand(masks.folder, toss),
        )
        write_toss_track(folder, tracked)
        write_notes(folder, toss, *notes_of(tracked, run.matcher))
        return {**_count(tracked.track), "unfit": tracked.unfit}

    return run.store.run("track", 9, run.matcher_settings(run.config.track), inputs, compute)


def register_stage(run: Run, tracks: dict[int, Done], masks: dict[int, Done]) -> Done:
    """Stage `register`: P, the poses of all tosses in one object frame, refined together.

    A toss that cannot be brought into that frame is lost in P, frame by frame, and counted.
    """
    inputs = {f"track_{t:02d}": tracks[t].key for t in run.tosses}

    def compute(folder: Path) -> Counts:
        camera = run.camera
        world = run.session.calibration.find("world", CAMERA)
        tosses = []
        for toss in run.tosses:
            frames, seen = run.frames(toss), read_masks(masks[toss].folder, toss)
            tosses.append(
                read_toss_track(
                    tracks[toss].folder, toss, frames, seen, camera, seen.confidence, run.config.track, world
                )
            )
        progress = run.progress("one object frame")
        together = register_tosses(tosses, run.config.register, progress, run.matcher, together=bool(run.starts))
        counts = {
            "not_joined": [t for t, joined in zip(run.tosses, together.joined, strict=True) if not joined],
            "ambiguous": [t for t, unsure in zip(run.tosses, together.ambiguous, strict=True) if unsure],
        }
        for track, joined in zip(together.tracks, together.joined, strict=True):
            # a pose in another object frame is no pose in this one
            kept = track if joined else ObjectTrack.nowhere(track.toss, track.camera, track.time_ns)
            write_track(folder, replace(kept, object_frame="object"))
        return {**counts, "fit": [round(float(f), 4) if np.isfinite(f) else None for f in together.fit]}

    return run.store.run("register", 5, run.matcher_settings(run.config.register), inputs, compute)


def field_stage(run: Run, name: str, tracks: dict[int, Done], masks: dict[int, Done]) -> Done:
    """Stage `field`: the shape that the tracked frames of these tosses show, in the frame that their tracks share."""
    inputs = {"for": name}
    for toss in tracks:
        inputs |= {f"track_{toss:02d}": tracks[toss].key, f"masks_{toss:02d}": masks[toss].key}
    config: LearnConfig = run.config.shape

    def compute(folder: Path) -> Counts:
        views = []
        for toss, track in tracks.items():
            frames = run.frames(toss)
            seen, robot = read_masks(masks[toss].folder, toss), RobotMasks.of(masks[toss].folder, toss)
            own = read_track(track.folder, toss)
            views.append(TossViews(frames, frames.depth_times_ns, seen, own, robot=robot))
        camera = run.camera
        shape, used = learn_shape(views, camera, config, run.device, run.progress(f"{name}: shape"))
        write_shape(folder, shape)
        unseen = 0.0 if shape.observed is None else float((~shape.observed).mean())
        return {"views": used, "vertices": len(shape.vertices_m), "unobserved_share": round(unseen, 4)}

    return run.store.run("field", 5, config, inputs, compute)


def _count(track: ObjectTrack) -> Counts:
    return {"frames": len(track.status), **{kind: track.status.count(kind) for kind in ("interpolated", "lost")}}
