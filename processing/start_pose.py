"""A pose that is given for one frame of a toss (`--start truth`)."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

from recordings.geometry import Transform


@dataclass(frozen=True)
class StartPose:
    """A pose given for one frame of a toss (`--start truth`); the track's object frame is then that pose's."""

    frame: int
    camera_from_object: Transform

    @property
    def digest(self) -> str:
        """sha256 of the pose and its frame."""
        return hashlib.sha256(self.camera_from_object.matrix.tobytes() + bytes([self.frame % 256])).hexdigest()
