"""The default tracker as stages see it: what of a toss's track is kept on disk, and how it comes back."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.features.sift import Sift
from processing.motion.motion_prior import gravity_in_camera
from processing.track.beam import Scene, seconds
from processing.track.depth_color_offset import put_at_color_times
from processing.track.track_toss import TossTrack, TrackConfig, views_of
from recordings.geometry import CameraModel, Transform
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.results.folder import read_track, write_track
from recordings.results.stage_files import stage_arrays


def write_toss_track(folder: Path, tracked: TossTrack) -> None:
    """The track, and beside it what registration needs of how it came about."""
    write_track(folder, tracked.track)
    with open(folder / f"toss_{tracked.track.toss:02d}.fit.npz", "wb") as out:
        np.savez(
            out,
            cost=tracked.cost,
            on_surface=tracked.on_surface,
            keyframes=np.array(tracked.keyframes, dtype=np.int64),
            pairs=tracked.pairs,
            center_m=tracked.center_m,
            round_body=np.array(tracked.round_body),
            held=tracked.held,
        )


def read_toss_track(
    folder: Path,
    toss: int,
    frames: Sequence[RgbdFrame],
    masks: Sequence[Bool[Array, "h w"]],
    camera: CameraModel,
    confidence: Float[Array, " n"],
    config: TrackConfig,
    world_from_camera: Transform | None,
) -> TossTrack:
    """A toss's track as `track_toss` gave it, its views cut anew from the frames and depth put where the track's motion
    has it at colour's exposure. The rejected candidates and features are gone."""
    track = read_track(folder, toss)
    store, times_ns, _ = views_of(frames, masks, camera, confidence, config, world_from_camera, Silent())
    with stage_arrays(folder / f"toss_{toss:02d}.fit.npz") as stored:
        tracked = TossTrack(
            track=track,
            cost=stored["cost"],
            on_surface=stored["on_surface"],
            keyframes=tuple(int(i) for i in stored["keyframes"]),
            pairs=stored["pairs"],
            rejected={},
            center_m=stored["center_m"],
            store=store,
            features={},
            round_body=bool(stored["round_body"]),
            held=stored["held"],
        )
    gravity = gravity_in_camera(None if world_from_camera is None else world_from_camera.matrix)
    scene = Scene(store, seconds(times_ns), gravity, tracked.center_m, Sift())
    put_at_color_times(scene, track.camera_from_object, ~track.lost)
    return tracked
