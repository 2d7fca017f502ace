"""The infrared dots that a depth camera's projector throws, as a camera without an infrared filter sees them."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

DOT_SIGMA_PX = 0.9


def with_infrared_dots(
    image: UInt8[Array, "h w"], strength: float, spacing_px: float, rng: np.random.Generator
) -> UInt8[Array, "h w"]:
    """The image with dots of light on every surface: each reflects them as it reflects the lamps, so a dot multiplies
    what is there. `strength`: a dot's peak against the lamps' light; `spacing_px`: mean distance of the dots."""
    height, width = image.shape
    count = round(height * width / spacing_px**2)
    pattern = np.zeros((height, width), np.float32)
    at = (rng.uniform(0, height, count).astype(int), rng.uniform(0, width, count).astype(int))
    np.add.at(pattern, at, rng.uniform(0.6, 1.4, count))
    blurred = cv2.GaussianBlur(pattern, (0, 0), DOT_SIGMA_PX) * np.float32(2 * np.pi * DOT_SIGMA_PX**2)
    return np.clip(np.rint(image * (1 + np.float32(strength) * blurred)), 0, 255).astype(np.uint8)
