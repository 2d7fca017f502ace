"""The robot in every frame of a toss, and a frame's scene with the robot standing in it.

Colour and depth are exposed at their own times, so the robot is drawn for each. What its drawing implies for a pixel is
weighed against the measured depth: an object in front of the robot, or between its fingers, keeps its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray as Array

from processing.segment.background.color_model import Likeness, color_shares, shares_log_odds
from processing.segment.background.foreground import grown, kernel
from processing.segment.background.static_scene import StaticScene
from processing.segment.robot.render import RobotView
from processing.sensor.noise import stereo_sigma_m
from recordings.geometry import Transform
from recordings.records import RgbdFrame
from recordings.robot.arm import PANDA_TOOL, ArmPath

FINGERS = ("panda_leftfinger", "panda_rightfinger")
SAME_TIME_NS = 500_000
"""Colour and depth exposed nearer than this share one drawing."""
WIDEST_M = 0.08
WIDTH_STEPS = 11


@dataclass(frozen=True)
class RobotSettings:
    """How the drawn robot is weighed against what was measured."""

    rim_px: int = 3
    """A stereo camera fattens edges by so much: robot depth this far outside of the drawn outline is the robot's."""
    near_px: int = 6
    """So near to the drawn robot, the object's colours are distinguished from the robot's."""
    agrees_m: float = 0.010
    """Measured depth this near to the drawn one (or 4 standard deviations) is the robot."""
    sampled: int = 5
    """Frames of a toss from which the robot's colours are learned."""


@dataclass(frozen=True, eq=False)
class RobotSeen:
    """The drawn robot in one frame: depth (in the depth camera's own scale, 0: no robot) at the depth image's and at
    the colour image's time, and `certain`: pixels of the colour image that show the robot and nothing in front of it.
    """

    depth_m: Float32[Array, "h w"]
    at_color_m: Float32[Array, "h w"]
    certain: Bool[Array, "h w"]


class CoarseFrames(Sequence[RgbdFrame]):
    """Frames of which only every stride-th pixel of rows and columns is seen."""

    def __init__(self, frames: Sequence[RgbdFrame], stride: int) -> None:
        self._frames, self._stride = frames, stride

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, position: Any) -> Any:
        frame, s = self._frames[position], self._stride
        color = np.ascontiguousarray(frame.color_rgb[::s, ::s])
        return replace(frame, color_rgb=color, depth_m=np.ascontiguousarray(frame.depth_m[::s, ::s]))


class RobotFrames(Sequence[Bool[Array, "h w"]]):
    """The robot in each frame of one toss, drawn when asked for. As a sequence: its `certain` pixels."""

    def __init__(
        self,
        frames: Sequence[RgbdFrame],
        view: RobotView,
        path: ArmPath,
        camera_from_base: Transform,
        delay_s: float = 0.0,
        depth_scale: float = 1.0,
        settings: RobotSettings | None = None,
    ) -> None:
        self._frames, self._view, self._path = frames, view, path
        self._placed = camera_from_base, delay_s, depth_scale
        self._base = camera_from_base @ Transform.identity(camera_from_base.source, path.robot.root)
        self._delay_ns = int(delay_s * 1e9)
        self._scale = depth_scale
        self.settings = settings or RobotSettings()
        self._last: tuple[int, RobotSeen | None] = (-1, None)
        self._kept: dict[int, UInt8[Array, " b"]] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, position: Any) -> Any:
        if isinstance(position, slice):
            return [self[i] for i in range(len(self))[position]]
        seen = self.seen(self._frames[position], position % len(self))
        return np.zeros(self._view.rays.shape[:2], dtype=bool) if seen is None else seen.certain

    def seen(self, frame: RgbdFrame, position: int) -> RobotSeen | None:
        """The robot in a frame; None where its joints are not known at that time."""
        if self._last[0] != position:
            self._last = (position, self._draw(frame))
            if (drawn := self._last[1]) is not None:
                self._kept[position] = np.packbits(drawn.certain)
        return self._last[1]

    def coarser(self, stride: int) -> RobotFrames:
        """The same robot for frames of which only every stride-th pixel of rows and columns is looked at."""
        frames = CoarseFrames(self._frames, stride)
        return RobotFrames(frames, self._view.coarser(stride), self._path, *self._placed, self.settings)

    def hand(self, times_ns: Int[Array, " n"]) -> Float[Array, "n 4 4"]:
        """camera_from_hand at each time; NaN where the joints are not known or the fingers moved since the start: what
        was held may be gone."""
        out = np.full((len(times_ns), 4, 4), np.nan)
        for i, time_ns in enumerate(times_ns + self._delay_ns):
            if self._path.covers(int(time_ns)) and self._path.may_hold(int(time_ns)):
                out[i] = (self._base @ self._path.links(int(time_ns))[PANDA_TOOL]).matrix
        return out

    def write(self, folder: Path) -> None:
        """The `certain` pixels of every frame that was looked at, as PNG by position (0 or 255), for the viewer."""
        folder.mkdir(parents=True, exist_ok=True)
        height, width = self._view.rays.shape[:2]
        for position, bits in self._kept.items():
            mask = np.unpackbits(bits, count=height * width).reshape(height, width) * np.uint8(255)
            cv2.imwrite(str(folder / f"{position:06d}.png"), mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])

    @cached_property
    def shares(self) -> Float[Array, " b"]:
        """How often each colour is seen on the robot, over some frames of the toss."""
        found = []
        for i in np.unique(np.linspace(0, len(self) - 1, self.settings.sampled).round().astype(int)):
            frame = self._frames[int(i)]
            seen = self._draw(frame)
            if seen is not None and (inner := cv2.erode(seen.certain.astype(np.uint8), kernel(3)) > 0).any():
                found.append(color_shares(frame.color_rgb, inner))
        return np.mean(found, axis=0) if found else np.zeros(0)

    def _links(self, time_ns: int, width_m: float) -> dict[str, Transform]:
        return {name: self._base @ link for name, link in self._path.links(time_ns + self._delay_ns, width_m).items()}

    def _draw(self, frame: RgbdFrame) -> RobotSeen | None:
        if not self._path.covers(frame.time_ns + self._delay_ns):
            return None
        width = self._path.finger_width_m(frame.time_ns + self._delay_ns)
        width = self._fitted_width(frame) if not np.isfinite(width) else width
        color = self._scaled(frame.time_ns, width)
        apart = abs(frame.depth_time_ns - frame.time_ns) > SAME_TIME_NS
        depth = self._scaled(frame.depth_time_ns, width) if apart else color
        near = np.maximum(self.settings.agrees_m, 4 * stereo_sigma_m(depth))
        in_front = (frame.depth_m > 0) & (depth > 0) & (frame.depth_m < depth - near)
        beyond = (frame.depth_m > depth + 3 * near) & (depth > 0)
        return RobotSeen(depth, color, (color > 0) & ~in_front & ~beyond)

    def _scaled(self, time_ns: int, width_m: float) -> Float32[Array, "h w"]:
        return self._view.draw(self._links(time_ns, width_m)).depth_m * np.float32(self._scale)

    def _fitted_width(self, frame: RgbdFrame) -> float:
        """The finger width, where the gripper reports none, at which the drawn fingers agree best with the depth."""
        others = tuple(p for p in self._view.parts if p not in FINGERS)
        best, best_score = 0.0, -np.inf
        for width in np.linspace(0.0, WIDEST_M, WIDTH_STEPS):
            drawn = self._view.draw(self._links(frame.depth_time_ns, float(width)), others).depth_m * self._scale
            on = (drawn > 0) & (frame.depth_m > 0)
            apart = frame.depth_m[on] - drawn[on]
            score = float((np.abs(apart) < 0.01).sum()) - 2.0 * float((apart > 0.02).sum())
            if score > best_score:
                best, best_score = float(width), score
        return best


def with_robot(scene: StaticScene, frame: RgbdFrame, seen: RobotSeen, s: RobotSettings) -> StaticScene:
    """The scene of one frame with the robot standing in it: what is not the object.

    Inside of the drawing the robot's depth replaces the scene's and its colour is not the scene's; around it a measured
    depth that continues the robot's is the robot's too.
    """
    drawn = np.where(seen.at_color_m > 0, np.where(seen.depth_m > 0, seen.depth_m, seen.at_color_m), 0)
    behind = (scene.depth_m > 0) & scene.known & (scene.depth_m < drawn - 0.03)  # something that stands before it
    drawn = np.where(behind, 0, drawn).astype(np.float32)
    spread = _carried_over_outline(seen.depth_m, s.rim_px)
    agrees = np.abs(frame.depth_m - spread) < np.maximum(s.agrees_m, 4 * stereo_sigma_m(spread))
    rim = (drawn == 0) & (spread > 0) & (frame.depth_m > 0) & agrees & ~behind
    depth = np.where(drawn > 0, drawn, np.where(rim, spread, scene.depth_m)).astype(np.float32)
    stays = np.abs(scene.depth_m - drawn) < np.maximum(s.agrees_m, 4 * stereo_sigma_m(drawn))  # its base
    return replace(scene, depth_m=depth, known=scene.known & ((drawn == 0) | stays))


def _carried_over_outline(depth_m: Float32[Array, "h w"], radius_px: int) -> Float32[Array, "h w"]:
    """Depth carried over the outline: the nearest within the radius."""
    far = np.where(depth_m > 0, depth_m, np.float32(100))
    least = cv2.erode(far, kernel(radius_px), borderType=cv2.BORDER_REPLICATE)
    return np.where(least < 50, least, 0).astype(np.float32)


def robot_likeness(
    frame: RgbdFrame, seen: RobotSeen, likeness: Likeness, shares: Float[Array, " b"], s: RobotSettings
) -> Float32[Array, "h w"]:
    """log(P(colour | object) / P(colour | robot)) at and near the drawn robot, 0 elsewhere."""
    near = grown((seen.at_color_m > 0) | (seen.depth_m > 0), s.near_px)
    if len(shares) == 0:
        return np.zeros(near.shape, dtype=np.float32)
    odds = shares_log_odds(frame.color_rgb, likeness.object_shares, shares)
    return np.where(near, odds, 0).astype(np.float32)
