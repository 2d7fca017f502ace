"""What stands out from the static scene in one frame: each thing a candidate for the object.

Frames are searched coarsely (every n-th pixel): finding needs no exact outline.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from processing.segment.background.color_model import color_shares
from processing.segment.background.foreground import ForegroundSettings, kernel, moved_pixels
from processing.segment.background.static_scene import StaticScene, colorless, leveled
from processing.segment.robot.frames import RobotFrames, RobotSeen, with_robot
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame

SMALLER = ("depth_m", "depth_sigma_m", "color_rgb", "color_sigma", "known", "table_depth_m")


@dataclass(frozen=True)
class CandidateSettings:
    """What counts as a thing."""

    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    widest_px: int = 330
    """Frames are searched no wider than this."""
    least_px: int = 30
    """A smaller thing (coarse pixels) is noise."""
    largest_share: float = 0.2
    """A thing that covers more of the image is no tossed object."""
    most: int = 8
    """Only so many of the largest things of a frame are considered."""
    least_depth: float = 0.3
    """Share of a thing's pixels with depth."""
    near_px: int = 2
    """What is so near (coarse pixels) touches."""
    robot_near_m: float = 0.1
    """The robot touches a thing only where its depth is that near to the thing's."""
    robot_rim_px: int = 1
    """The drawn robot is so much (coarse pixels) smaller than the real one's blurred picture."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A thing in one frame. `mask` lies within `box` (left, top) of the coarse image; `center_m` is the mean of its
    visible points in the camera frame; `size_m` the root of its visible area; `free` is 1 where nothing touches it, 0
    where the image's border cuts it; `shares`: of its colours."""

    position: int
    time_s: float
    corner: tuple[int, int]
    mask: Bool[Array, "a b"]
    center_m: Float[Array, "3"]
    size_m: float
    free: float
    shares: Float[Array, " n"]

    @property
    def area_px(self) -> int:
        """Coarse pixels."""
        return int(self.mask.sum())

    def picture(self, shape: tuple[int, ...], stride: int) -> Bool[Array, "h w"]:
        """Its mask in the image of full size, of blocks."""
        out = np.zeros(shape, dtype=bool)
        big = np.kron(self.mask, np.ones((stride, stride), dtype=bool))
        top, left = self.corner[1] * stride, self.corner[0] * stride
        part = out[top : top + big.shape[0], left : left + big.shape[1]]
        part |= big[: part.shape[0], : part.shape[1]]
        return out


class Finder:
    """Finds the things in a toss's frames."""

    def __init__(self, scene: StaticScene, camera: CameraModel, settings: CandidateSettings) -> None:
        self.settings = settings
        self.stride = max(1, round(camera.width / settings.widest_px))
        self._rays = camera.pixel_rays()[:: self.stride, :: self.stride].astype(np.float32)
        self.full_size = (camera.height, camera.width)
        self._scene = coarser(scene, self.stride)
        self._pixel_m = self.stride / float(camera.fx)  # a coarse pixel's width at 1 m

    def things(self, frame: RgbdFrame, position: int, robot: RobotFrames | None) -> list[Candidate]:
        """The candidates in a coarse frame, the largest first. `robot`: drawn for coarse frames."""
        s = self.settings
        frame, lit = leveled(frame, self._scene)
        scene = self._scene if lit else colorless(self._scene)
        seen = None if robot is None else robot.seen(frame, position)
        moved, drawn_m = self._moved(frame, scene, seen, robot)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
        order = sorted(range(1, count), key=lambda k: -int(stats[k, cv2.CC_STAT_AREA]))[: s.most]
        found = []
        for k in order:
            if s.least_px <= stats[k, cv2.CC_STAT_AREA] <= s.largest_share * moved.size:
                thing = self._thing(frame, position, labels, k, stats[k, :4], drawn_m)
                found += [] if thing is None else [thing]
        return found

    def _moved(
        self, frame: RgbdFrame, scene: StaticScene, seen: RobotSeen | None, robot: RobotFrames | None
    ) -> tuple[Bool[Array, "h w"], Float32[Array, "h w"]]:
        """What is neither scene nor robot, and the robot's depth (0: none)."""
        drawn_m = np.zeros(scene.known.shape, dtype=np.float32)
        near = np.zeros(scene.known.shape, dtype=bool)
        if seen is not None and robot is not None:
            scene = with_robot(scene, frame, seen, robot.settings)
            near = cv2.dilate(seen.certain.astype(np.uint8), kernel(self.settings.robot_rim_px)) > 0
            drawn_m = np.asarray(cv2.dilate(seen.at_color_m, kernel(self.settings.robot_rim_px)), dtype=np.float32)
        moved = moved_pixels(frame, scene, self.settings.foreground) & ~near
        table = scene.table_depth_m
        below = (table > 0) & (frame.depth_m > table + self.settings.foreground.nearer_m)
        return moved & ~below, drawn_m

    def _thing(
        self,
        frame: RgbdFrame,
        position: int,
        labels: Int[Array, "h w"],
        number: int,
        box: Int[Array, "4"],
        drawn_m: Float32[Array, "h w"],
    ) -> Candidate | None:
        left, top, w, h = (int(v) for v in box)
        at = slice(top, top + h), slice(left, left + w)
        mask = labels[at] == number
        depth = frame.depth_m[at]
        use = mask & (depth > 0)
        if use.sum() < self.settings.least_depth * mask.sum():
            return None
        median_m = float(np.median(depth[use]))
        use &= np.abs(depth - median_m) < 0.3
        center = (self._rays[at][use] * depth[use][:, None]).mean(0).astype(np.float64)
        size = float(np.sqrt(mask.sum())) * self._pixel_m * median_m
        free = self._free(labels, number, at, np.abs(drawn_m - median_m) < self.settings.robot_near_m)
        shares = color_shares(
            frame.color_rgb[at], cv2.erode(np.pad(mask, 1).astype(np.uint8), kernel(1))[1:-1, 1:-1] > 0
        )
        shares = shares if shares.any() else color_shares(frame.color_rgb[at], mask)
        return Candidate(position, frame.time_ns * 1e-9, (left, top), mask, center, size, free, shares)

    def _free(
        self, labels: Int[Array, "h w"], number: int, at: tuple[slice, slice], robot: Bool[Array, "h w"]
    ) -> float:
        """How free a thing stands."""
        if at[0].start == 0 or at[1].start == 0 or at[0].stop == labels.shape[0] or at[1].stop == labels.shape[1]:
            return 0.0
        n = self.settings.near_px
        rows = slice(max(at[0].start - n, 0), at[0].stop + n)
        columns = slice(max(at[1].start - n, 0), at[1].stop + n)
        mine = labels[rows, columns] == number
        around = (cv2.dilate(mine.astype(np.uint8), kernel(n)) > 0) & ~mine
        rim = max(int(around.sum()), 1)
        touched = (around & (robot[rows, columns] | (labels[rows, columns] > 0))).sum() / rim
        unknown = (around & ~self._scene.known[rows, columns]).sum() / rim
        return float(np.clip(1 - 4 * touched - unknown, 0.05, 1))


def coarser(scene: StaticScene, stride: int) -> StaticScene:
    """Every stride-th pixel of the scene."""
    small = {name: np.ascontiguousarray(getattr(scene, name)[::stride, ::stride]) for name in SMALLER}
    return replace(scene, **small)
