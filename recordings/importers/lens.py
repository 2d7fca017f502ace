"""Lens models that `CameraModel` does not have, said in the one that it has."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

GRID = 24


def fit_brown_conrady(
    rays: Callable[[Float[Array, "n 2"]], Float[Array, "n 2"]], K: Float[Array, "3 3"], width: int, height: int
) -> tuple[tuple[float, ...], float]:
    """Coefficients (k1 k2 p1 p2 k3) under which the pixels of a grid are seen along the given rays, and the largest
    error in pixels. `rays` gives (x, y) of the ray (x, y, 1) of each pixel.

    The model is linear in its coefficients: with r^2 = x^2 + y^2 the distorted minus the ideal point is
    (x (k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), y (...) + p1 (r^2 + 2 y^2) + 2 p2 x y).
    """
    u, v = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    x, y = rays(pixels).T
    r2 = x * x + y * y
    columns_x = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], -1)
    columns_y = np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], -1)
    seen_x, seen_y = (pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1]
    system, wanted = np.vstack([columns_x, columns_y]), np.concatenate([seen_x - x, seen_y - y])
    solution = np.linalg.lstsq(system, wanted, rcond=None)[0]
    off = (system @ solution - wanted).reshape(2, -1) * [[K[0, 0]], [K[1, 1]]]
    return tuple(float(k) for k in solution), float(np.linalg.norm(off, axis=0).max())
