"""Where the last mask lies best on the next frame: after an impact the object is not where its motion leads."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.foreground import window_around

PULL = 0.25
"""A place one reach away from all expected ones must show the object in so much more of the mask."""
HALTED = 0.05
"""So must one where the object came to a halt at once: seldom does it."""


def best_shift(
    score: Float32[Array, "h w"], mask: Bool[Array, "h w"], velocity_px: Float[Array, "2"], steps: int, reach_px: int
) -> Float[Array, "2"]:
    """The shift (x, y) in pixels by which a mask lies best on what looks like the object, after `steps` frames.

    `score` (0..1) says how much each pixel does; `velocity_px` is the motion per frame so far. The object has gone on
    as before, or was stopped by an impact in one of these frames; a place near one of those is preferred, and nothing
    farther than the reach is looked at.
    """
    at = window_around(mask, 0)
    onward = velocity_px * steps
    if at is None:
        return onward
    paths = np.arange(steps + 1)[:, None] * velocity_px
    low, high = np.floor(paths.min(0)) - reach_px, np.ceil(paths.max(0)) + reach_px
    first = np.array([at[1].start, at[0].start]) + low
    last = np.array([at[1].stop, at[0].stop]) + high
    overlap = cv2.matchTemplate(_cut(score, first, last), mask[at].astype(np.float32), cv2.TM_CCORR) / mask.sum()
    x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    cost = np.full(overlap.shape, np.inf)
    for k, path in enumerate(paths):
        away = ((x - path[0]) ** 2 + (y - path[1]) ** 2) / reach_px**2
        cost = np.minimum(cost, PULL * away + HALTED * (1 - k / steps))
    row, column = np.unravel_index(int((overlap - cost).argmax()), overlap.shape)
    return np.array([x[row, column], y[row, column]])


def shifted(mask: Bool[Array, "h w"], by_px: Float[Array, "2"]) -> Bool[Array, "h w"]:
    """A mask moved by (x, y) pixels."""
    moved = np.array([[1, 0, by_px[0]], [0, 1, by_px[1]]], dtype=np.float32)
    return cv2.warpAffine(mask.astype(np.uint8), moved, mask.shape[::-1], flags=cv2.INTER_NEAREST) > 0


def _cut(image: Float32[Array, "h w"], first: Float[Array, "2"], last: Float[Array, "2"]) -> Float32[Array, "a b"]:
    """The part of an image between two corners (x, y), zero where there is none."""
    (left, top), (right, bottom) = first.astype(int), last.astype(int)
    inner = image[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    out = np.zeros((bottom - top, right - left), np.float32)
    y, x = max(-top, 0), max(-left, 0)
    out[y : y + inner.shape[0], x : x + inner.shape[1]] = inner
    return out
