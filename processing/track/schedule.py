"""How an alignment goes from coarse to fine: the scales of its residuals, step by step."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.track import kernels as k

Schedule = tuple[tuple[int, int, float, float, float, float], ...]
"""Rows of kernels.align_view: level (0 sharp, 1 smooth), steps, depth scale (m at 0.8 m), scale of the appearance,
outline scale (m at 0.8 m), share of the samples."""

USUAL_DISTANCE_M = 0.8


def rows(schedule: Schedule, distance_m: float, round_body: bool = False) -> Float[Array, "r 7"]:
    """The schedule's scales for an object at this distance: stereo depth errors grow with its square."""
    out = np.concatenate([np.array(schedule, dtype=np.float64), np.full((len(schedule), 1), float(round_body))], 1)
    ratio = distance_m / USUAL_DISTANCE_M
    out[:, k.GEOMETRY_M] *= np.clip(ratio**2, 0.5, 4.0)
    out[:, k.OUTLINE_M] *= np.clip(ratio, 0.5, 2.0)
    return out
