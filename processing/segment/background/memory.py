"""What the background segmenter knows of the object when the next frame comes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray as Array

from processing.segment.background.color_model import Likeness
from processing.segment.background.foreground import window_around
from processing.segment.background.patches import Patches
from recordings.records import RgbdFrame

SHRINKS = 0.9
"""The size that is remembered is worth so much less with every frame."""


@dataclass(frozen=True, eq=False)
class Memory:
    """What is known when the next frame comes."""

    mask: Bool[Array, "h w"]
    velocity_px: Float[Array, "2"]
    depth_range_m: tuple[float, float]
    likeness: Likeness
    size_px: float
    """The object's size: the largest of its last masks, worth less by `SHRINKS` a frame: a bad one is small."""
    missed: int = 0
    others: Bool[Array, "h w"] | None = None
    """What else that is not scene was near the object in the last frame, all as one: a hand, a stick."""
    patches: Patches | None = None
    """What the object looks like and what such things do; None while nothing was near."""
    time_ns: int = 0
    speed_px_s: Float[Array, "2"] = field(default_factory=lambda: np.zeros(2))
    """Colour's time when the object was last found, and how fast it then moved in the image."""

    def own_odds(
        self, color_rgb: UInt8[Array, "h w 3"], where: Bool[Array, "h w"], crowded: bool = True
    ) -> Float32[Array, "h w"]:
        """Log-odds of the object in the pixels of a mask: against what is near it where something is (`crowded`), else
        against its surroundings; 0 elsewhere."""
        if crowded and self.patches is not None:
            return self.patches.log_odds(color_rgb, where)
        out, at = np.zeros(where.shape, np.float32), window_around(where, 0)
        if at is not None:
            out[at] = self.likeness.log_odds(color_rgb[at], crowded=crowded) * where[at]
        return out


@dataclass(frozen=True, eq=False)
class Found:
    """The object in one frame. `largest_other_px`: the largest other thing in the picture."""

    mask: Bool[Array, "h w"]
    confidence: float
    others: Bool[Array, "h w"] | None = None
    """Pixels near the object that are neither scene nor robot nor the object."""
    largest_other_px: int = 0


def remember(memory: Memory | None, frame: RgbdFrame, found: Found, learn: bool = True) -> Memory:
    """Memory after a frame. An empty mask leaves everything but the count of misses; colours are learned on request."""
    mask = found.mask
    if memory is not None and not mask.any():
        return replace(memory, missed=memory.missed + 1)
    patches = _patches(None if memory is None else memory.patches, frame, found, learn)
    depth = frame.depth_m[mask & (frame.depth_m > 0)]
    low, high = (float(d) for d in np.quantile(depth, (0.02, 0.98))) if len(depth) > 10 else (0.0, 20.0)
    if memory is None:
        likeness = Likeness.of(frame.color_rgb, mask)
        size = float(mask.sum())
        return Memory(
            mask, np.zeros(2), (low, high), likeness, size, 0, found.others, patches, time_ns=frame.time_ns
        )  # fmt: skip
    way = _center(mask) - _center(memory.mask)
    likeness = memory.likeness.learned(frame.color_rgb, mask) if learn else memory.likeness
    speed = way / ((frame.time_ns - memory.time_ns) * 1e-9) if frame.time_ns != memory.time_ns else np.zeros(2)
    return Memory(
        mask,
        way / (memory.missed + 1),
        (low, high),
        likeness,
        max(float(mask.sum()), SHRINKS * memory.size_px),
        others=found.others,
        patches=patches,
        time_ns=frame.time_ns,
        speed_px_s=speed,
    )


def _patches(before: Patches | None, frame: RgbdFrame, found: Found, learn: bool) -> Patches | None:
    """What object and others look like, after a frame; only where both are seen is anything learned."""
    if found.others is None:
        return before
    if before is None:
        return Patches.of(frame.color_rgb, found.mask, found.others)
    return before.after(frame.color_rgb, found.mask, found.others) if learn else before


def _center(mask: Bool[Array, "h w"]) -> Float[Array, "2"]:
    """Centroid (x, y) in pixels."""
    moments = cv2.moments(mask.astype(np.uint8), binaryImage=True)
    return np.array([moments["m10"], moments["m01"]]) / max(moments["m00"], 1.0)
