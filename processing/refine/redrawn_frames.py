"""Frames for the second pass: the picture as it was taken, with the reprojected depth and mask (D'', M'') in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray as Array

from processing.sensor.render import Occlusion, Renderer, Reprojection, reproject
from recordings.records import RgbdFrame
from recordings.session import Frames

Depth = Literal["rendered", "filled"]
SHADOW_PX = 9
"""Width of the window round a pixel in front of the object in which missing depth is its doing."""


@dataclass(frozen=True)
class RedrawConfig:
    """What the second pass is given for depth and mask."""

    depth: Depth = "filled"
    """`rendered` (the paper): D'' and M'' are the shape's everywhere. `filled`: what the camera measured of the object
    stays, the shape fills what was hidden, missing or wrong."""
    agrees_m: float = 0.006
    """Raw depth nearer than this to the shape's is the object's own."""
    before_m: float = 0.015
    """Raw depth this much nearer than the shape belongs to something in front of it."""
    occlusion: Occlusion = "fill"


@dataclass(frozen=True, eq=False)
class Redrawn:
    """One frame of the second pass. `colorless`: pixels of the mask whose colour is not the object's."""

    frame: RgbdFrame
    mask: Bool[Array, "h w"]
    colorless: Bool[Array, "h w"]


def redraw(
    raw: RgbdFrame,
    raw_mask: Bool[Array, "h w"],
    camera_from_object: Float[Array, "4 4"],
    renderer: Renderer,
    config: RedrawConfig,
) -> Redrawn:
    """One frame with the shape drawn at its pose at the colour's time; the raw frame where there is no pose."""
    if not np.isfinite(camera_from_object).all():
        return Redrawn(raw, raw_mask, np.zeros_like(raw_mask))
    drawn = reproject(renderer, camera_from_object)
    in_front = occluders(raw.depth_m, raw_mask, drawn, config.before_m)
    if config.occlusion == "subtract":
        drawn = reproject(renderer, camera_from_object, in_front, "subtract")
    if config.depth == "rendered":
        mask, depth_m = drawn.mask, np.where(drawn.mask, drawn.depth_m, raw.depth_m)
    else:
        mask, depth_m = _filled(raw.depth_m, raw_mask, drawn, in_front, config)
    shown = replace(raw, depth_m=depth_m.astype(np.float32), depth_time_ns=raw.time_ns)  # drawn at the colour's time
    return Redrawn(shown, mask, mask & ~raw_mask)


def _filled(
    depth_m: Float32[Array, "h w"],
    raw_mask: Bool[Array, "h w"],
    drawn: Reprojection,
    in_front: Bool[Array, "h w"],
    config: RedrawConfig,
) -> tuple[Bool[Array, "h w"], Float32[Array, "h w"]]:
    """Where the camera saw past the shape, it is not there; what it saw of the object stays, also beside the shape.

    Missing depth beside the mask says nothing by itself: the mask saw the colours there.
    """
    import cv2

    shadow = cv2.dilate(in_front.astype(np.uint8), np.ones((SHADOW_PX, SHADOW_PX), np.uint8)) > 0  # shadows of stereo
    unknown = drawn.mask & ~raw_mask & (in_front | (shadow & (depth_m == 0)))
    wrong = raw_mask & drawn.mask & ((depth_m == 0) | (np.abs(depth_m - drawn.depth_m) > config.agrees_m))
    return raw_mask | unknown, np.where(unknown | wrong, drawn.depth_m, depth_m).astype(np.float32)


def occluders(
    depth_m: Float32[Array, "h w"], raw_mask: Bool[Array, "h w"], drawn: Reprojection, before_m: float
) -> Bool[Array, "h w"]:
    """Pixels of the drawn shape where the camera measured something nearer that is not the object."""
    return drawn.mask & ~raw_mask & (depth_m > 0) & (depth_m < drawn.depth_m - before_m)


class SecondFrames(Frames[RgbdFrame]):
    """The frames of one toss for the second pass, drawn when asked for. `masks` and `colorless` go with them."""

    def __init__(
        self,
        frames: Sequence[RgbdFrame],
        times_ns: Int64[Array, " n"],
        raw_masks: Sequence[Bool[Array, "h w"]],
        poses: Float[Array, "n 4 4"],
        renderer: Renderer,
        config: RedrawConfig,
    ) -> None:
        super().__init__(times_ns, lambda i: self.redrawn(i).frame)
        self._frames, self._raw_masks, self._poses = frames, raw_masks, poses
        self._renderer, self._config = renderer, config
        self._last: tuple[int, Redrawn] | None = None
        self.depth_times_ns = times_ns
        self.masks = Frames(times_ns, lambda i: self.redrawn(i).mask)
        self.colorless = Frames(times_ns, lambda i: self.redrawn(i).colorless)

    def redrawn(self, position: int) -> Redrawn:
        """Frame, mask and colourless pixels of one position; the last one asked for is kept."""
        if self._last is None or self._last[0] != position:
            raw, mask = self._frames[position], np.asarray(self._raw_masks[position], dtype=bool)
            self._last = (position, redraw(raw, mask, self._poses[position], self._renderer, self._config))
        return self._last[1]
