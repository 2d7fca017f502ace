"""What the pipeline asks of a tracker: the object's pose in every frame of one toss, and its shape as seen there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from jaxtyping import Bool
from numpy import ndarray as Array

from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape, ObjectTrack


@dataclass(frozen=True, eq=False)
class Tracked:
    """One toss's track and the shape in the object frame of that track."""

    track: ObjectTrack
    shape: ObjectShape


class Tracker(Protocol):
    """Model-free tracking of one toss. One class per backend, chosen by `--tracker NAME`."""

    name: str

    def track(
        self,
        toss: int,
        frames: Sequence[RgbdFrame],
        masks: Sequence[Bool[Array, "h w"]],
        camera: CameraModel,
        object_frame: str,
        progress: Progress,
    ) -> Tracked:
        """Poses `camera_from_object` of all frames. The object frame starts parallel to the camera, its origin at the
        middle of the first masked cloud. Raises BadInput where no frame holds enough of the object."""
        ...
