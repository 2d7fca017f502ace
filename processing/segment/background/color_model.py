"""How much a colour looks like the object rather than like its surroundings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray as Array

from processing.segment.background.foreground import grown, kernel

BINS = 16
UNSEEN = 2e-3
"""Share at which a colour counts as hardly seen: a colour seen on neither side speaks for none."""
MOST = 2.0
MEMORY = 0.9
"""Share of what is remembered that stays when a new frame is learned."""


@dataclass(frozen=True, eq=False)
class Likeness:
    """Histograms of the object's and its surroundings' colours; `first` is from the given mask and never fades."""

    first: Float[Array, " b"]
    recent: Float[Array, " b"]
    around: Float[Array, " b"]

    @staticmethod
    def of(color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> Likeness:
        inside, around = _histograms(color_rgb, mask)
        return Likeness(inside, inside, around)

    def learned(self, color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> Likeness:
        """With one more frame remembered."""
        inside, around = _histograms(color_rgb, mask)
        return replace(
            self,
            recent=MEMORY * self.recent + (1 - MEMORY) * inside,
            around=MEMORY * self.around + (1 - MEMORY) * around,
        )

    def with_shares(self, shares: Float[Array, " b"]) -> Likeness:
        """With the colours that the object shows elsewhere: it has more sides than one."""
        return replace(self, first=0.5 * (self.first + shares), recent=0.5 * (self.recent + shares))

    @property
    def object_shares(self) -> Float[Array, " b"]:
        """How often each colour is seen on the object."""
        return 0.5 * (self.first + self.recent)

    def log_odds(self, color_rgb: UInt8[Array, "h w 3"], crowded: bool = False) -> Float32[Array, "h w"]:
        """log(P(colour | object) / P(colour | surroundings)), within +-MOST.

        A colour seen on neither side speaks for none; where other things touch the object (`crowded`), it is theirs.
        """
        inside = self.object_shares
        table = np.log((inside + UNSEEN) / (self.around + UNSEEN)).clip(-MOST, MOST)
        if crowded:
            table = np.where(inside + self.around < 0.1 * UNSEEN, -MOST, table)
        return cv2.blur(table.astype(np.float32)[_cells(color_rgb)], (3, 3))


def color_shares(color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> Float[Array, " b"]:
    """How often each colour is seen inside a mask."""
    return _shares(_cells(color_rgb[mask]))


def shares_log_odds(
    color_rgb: UInt8[Array, "h w 3"], inside: Float[Array, " b"], other: Float[Array, " b"]
) -> Float32[Array, "h w"]:
    """log(P(colour | inside) / P(colour | other)), within +-MOST; a colour seen on neither speaks for none."""
    table = np.log((inside + UNSEEN) / (other + UNSEEN)).clip(-MOST, MOST)
    return cv2.blur(table.astype(np.float32)[_cells(color_rgb)], (3, 3))


def _cells(color_rgb: UInt8[Array, "*n 3"]) -> Int[Array, "*n"]:
    c = (color_rgb // (256 // BINS)).astype(np.int32)
    return (c[..., 0] * BINS + c[..., 1]) * BINS + c[..., 2]


def _histograms(color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> tuple[Array, Array]:
    """Shares of each colour inside the mask's core and in a ring around it, a little spread over the neighbours."""
    reach = int(np.clip(0.6 * np.sqrt(mask.sum()), 10, 60))
    part = mask.astype(np.uint8)
    core, near = cv2.erode(part, kernel(2)) > 0, cv2.dilate(part, kernel(3)) > 0
    core = core if core.sum() > 30 else mask
    ring = grown(mask, reach) & ~near
    return color_shares(color_rgb, core), color_shares(color_rgb, ring)


def _shares(cells: Int[Array, " n"]) -> Float[Array, " b"]:
    from scipy.ndimage import gaussian_filter

    counts = np.bincount(cells, minlength=BINS**3).reshape(BINS, BINS, BINS).astype(np.float64)
    spread = gaussian_filter(counts, 0.7, mode="nearest").ravel()
    return spread / max(spread.sum(), 1.0)
