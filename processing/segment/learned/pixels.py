"""What a pixel shows of whether it is the object: its colour, the scene's colour there, and solid depth before it."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray as Array

from processing.segment.background.channels import sum_of_channels
from processing.segment.background.foreground import ForegroundSettings, kernel
from processing.segment.background.static_scene import StaticScene
from processing.sensor.noise import DARK, stereo_sigma_m

BLURS_PX = (0.7, 1.8)
"""Colours are looked at through these blurs: of a pixel, and of what is around it."""
SIGMAS = 4.0
"""Depth before the scene is told in units of so many standard deviations, up to three of them."""


def pixel_features(
    color: Float32[Array, "a b 3"], depth_m: Float32[Array, "a b"], scene: StaticScene, s: ForegroundSettings
) -> Float32[Array, "a b f"]:
    """Features of every pixel of a window (`scene`: the same window), each of order one.

    Colours stand in logarithms (light and shadow are shifts), and as shares of red and green, which shadows keep.
    Depth tells only where it is nearer than the scene all around: stereo matching gives the pixels beside an edge the
    nearer side's depth, as far as its windows reach.
    """
    found = [part for blur in BLURS_PX for part in _colors(color, scene.color_rgb, blur)]
    gray = sum_of_channels(color) / np.float32(3)
    mean = cv2.GaussianBlur(gray, (0, 0), BLURS_PX[1])
    spread = np.maximum(cv2.GaussianBlur(gray**2, (0, 0), BLURS_PX[1]) - mean**2, 1.0)
    solid = cv2.erode(_before(depth_m, scene), kernel(s.band_inside_px))
    single = (np.log(spread + 4.0) / 3 - 1, scene.known, solid, scene.depth_m > 0)
    return np.concatenate([*found, *(x[..., None] for x in single)], axis=-1, dtype=np.float32)


def _colors(
    color: Float32[Array, "a b 3"], scene_rgb: Float32[Array, "a b 3"], blur_px: float
) -> list[Float32[Array, "a b c"]]:
    seen = cv2.GaussianBlur(color, (0, 0), blur_px)
    before = scene_rgb if blur_px < 1 else cv2.GaussianBlur(scene_rgb, (0, 0), blur_px)
    share, share_before = (x[..., :2] / (sum_of_channels(x)[..., None] + 1.5 * DARK) for x in (seen, before))
    bright = np.log(seen + DARK)
    return [bright - 4.5, 2 * (bright - np.log(before + DARK)), 6 * (share - 1 / 3), 10 * (share - share_before)]


def _before(depth_m: Float32[Array, "a b"], scene: StaticScene) -> Float32[Array, "a b"]:
    """How far before the scene depth lies; 0 where one of them is not known."""
    sigma = np.maximum(scene.depth_sigma_m, 0.7 * stereo_sigma_m(scene.depth_m))
    gap = np.clip((scene.depth_m - depth_m) / np.maximum(SIGMAS * sigma, 1e-4), -2.0, 3.0)
    both: Bool[Array, "a b"] = (depth_m > 0) & (scene.depth_m > 0)
    return np.where(both, gap, 0.0).astype(np.float32)
