"""Robust kernels: by how much a residual counts, as a function of its size in units of a scale.

A weight w(r) stands in the normal equations J^T w J; it is the derivative of the kernel's cost by r, divided by r
(iteratively reweighted least squares; Zhang, "Parameter Estimation Techniques", 1997, table 1). Compiled kernels have
their own copies inline, held to their cost by `tests/processing/track/test_derivatives.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy import ndarray as Array

TUKEY_95 = 4.685
"""Tukey's scale in standard deviations at which it is 95 % efficient on normal residuals (Holland and Welsch 1977)."""


def huber_weight(size: Array, limit: float) -> Array:
    """Huber's weight of residuals of this size (not negative): 1 up to `limit`, then limit / size."""
    return np.asarray(np.minimum(1.0, limit / np.maximum(size, 1e-12)))


def huber_cost(size: Array, limit: float) -> Array:
    """Huber's cost: size^2 / 2 up to `limit`, then linear."""
    return np.where(size > limit, limit * size - 0.5 * limit * limit, 0.5 * size**2)


def tukey_weight(share: Array) -> Array:
    """Tukey's biweight of residuals as a share of its limit: (1 - share^2)^2, 0 beyond 1."""
    return np.asarray((1 - np.clip(np.abs(share), 0, 1) ** 2) ** 2)


def cauchy_weight(square: Any) -> Any:
    """Cauchy's weight, 1 / (1 + s), of the squared residual in units of its squared scale."""
    return 1 / (1 + square)


def geman_mcclure_weight(square: Any) -> Any:
    """Geman and McClure's weight, 1 / (1 + s)^2, of the squared residual in units of its squared scale: what lies far
    off does not pull at all."""
    return 1 / (1 + square) ** 2
