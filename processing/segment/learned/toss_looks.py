"""What a toss's frames show around its masks, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.foreground import Window
from processing.segment.background.static_scene import StaticScene
from processing.segment.learned.masks import LearnedSettings, Look, features_in, look
from recordings.records import RgbdFrame
from recordings.results.folder import Masks, RobotMasks


@dataclass(frozen=True, eq=False)
class TossLooks:
    """What a toss's frames show around its masks."""

    frames: Sequence[RgbdFrame]
    masks: Masks
    scene: StaticScene
    robot: RobotMasks | None
    sizes_px: Float[Array, " n"]
    settings: BackgroundSettings
    learned: LearnedSettings

    def look(self, i: int, mask: Bool[Array, "h w"]) -> Look | None:
        """What there is to judge around a mask; None where there is nothing."""
        robot = None if self.robot is None else self.robot.at(i, mask.shape)
        size = max(float(self.sizes_px[i]), float(np.sqrt(mask.sum())))
        return look(self.frames[i], self.scene, mask, size, robot, self.settings, self.learned)

    def free(self, i: int, mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
        """What of a mask is not the robot's."""
        return mask if self.robot is None else mask & ~self.robot.at(i, mask.shape)

    def features(self, i: int, at: Window) -> Float32[Array, "a b f"]:
        """Of the pixels of a window."""
        return features_in(self.frames[i], self.scene, at, self.settings)
