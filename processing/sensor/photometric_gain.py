"""How bright each frame is against the first: auto exposure drifts during a toss."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray as Array


class PhotometricGain:
    """Brightness of each frame against the first, from pixels that belong to the object in neither (median of ratios).

    1 where the background shows too little. The response is not linear: a ratio of stored values serves small gains
    well.
    """

    def __init__(self, step: int = 8) -> None:
        self._step = step
        self._first: tuple[Float32[Array, "a b"], Bool[Array, "a b"]] | None = None

    def gain(self, color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> float:
        share = 1 / self._step
        small = (
            cv2.resize(color_rgb, None, fx=share, fy=share, interpolation=cv2.INTER_AREA).mean(-1).astype(np.float32)
        )
        size = (small.shape[1], small.shape[0])
        taken = cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0
        free = cv2.dilate(taken.astype(np.uint8), np.ones((3, 3), np.uint8), iterations=2) == 0
        if self._first is None:
            self._first = (small, free)
            return 1.0
        first, first_free = self._first
        use = first_free & free & (first > 15) & (first < 235) & (small > 10) & (small < 240)
        return float(np.median(small[use] / first[use])) if int(use.sum()) > 50 else 1.0
