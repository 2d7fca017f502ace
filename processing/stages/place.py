"""Stage `place`: O moved into p_i's object frame, by the motion that lays P's poses of toss i on p_i's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from processing.run import Run
from processing.store import Done
from recordings.geometry import rotation_angle_rad
from recordings.results.folder import read_shape, read_track, write_shape
from recordings.tracks import ObjectShape, ObjectTrack

VERSION = 3


@dataclass(frozen=True)
class PlaceResult:
    """Frames that both tracks have (0: O stays where it is), and how far they are from agreeing (medians)."""

    toss: int
    frames: int
    rotation_deg: float | None = None
    translation_m: float | None = None


def place_shape(run: Run, toss: int, together: Done, alone: Done, shape: Done) -> Done[PlaceResult]:
    """The shape in the object frame of `alone`, the track of that toss alone."""
    inputs = {"together": together.key, "alone": alone.key, "shape": shape.key, "toss": str(toss)}

    def compute(folder: Path) -> PlaceResult:
        own, shared = read_track(alone.folder, toss), read_track(together.folder, toss)
        own_from_shared, residual = placement(own, shared)
        write_shape(folder, moved_shape(read_shape(shape.folder), own_from_shared, own.object_frame))
        return replace(residual, toss=toss)

    return run.store.run("place", VERSION, {}, inputs, PlaceResult, compute)


def placement(own: ObjectTrack, shared: ObjectTrack) -> tuple[Float[Array, "4 4"], PlaceResult]:
    """own_object_from_shared_object by the frames that both tracked, and how far they are from agreeing.

    The chordal mean of all frames' motions, then once more without the frames further off than three times the median.
    """
    both = np.isfinite(own.camera_from_object[:, 0, 0]) & np.isfinite(shared.camera_from_object[:, 0, 0])
    if not both.any():
        return np.eye(4), PlaceResult(own.toss, 0)
    steps = np.linalg.inv(own.camera_from_object[both]) @ shared.camera_from_object[both]
    use = np.ones(len(steps), dtype=bool)
    mean = np.eye(4)
    for _ in range(2):
        mean[:3, :3] = Rotation.from_matrix(steps[use, :3, :3]).mean().as_matrix()
        mean[:3, 3] = steps[use, :3, 3].mean(0)
        turn = np.array([float(rotation_angle_rad(s[:3, :3] @ mean[:3, :3].T)) for s in steps])
        shift = np.linalg.norm(steps[:, :3, 3] - mean[:3, 3], axis=1)
        use = (turn <= 3 * np.median(turn) + 1e-9) & (shift <= 3 * np.median(shift) + 1e-9)
    return mean, PlaceResult(own.toss, int(both.sum()), float(np.degrees(np.median(turn))), float(np.median(shift)))


def moved_shape(shape: ObjectShape, target_from_source: Float[Array, "4 4"], frame: str) -> ObjectShape:
    """The shape in another object frame."""
    vertices = shape.vertices_m @ target_from_source[:3, :3].T + target_from_source[:3, 3]
    return replace(shape, vertices_m=vertices, object_frame=frame)
