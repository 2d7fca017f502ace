"""The inner loops of align.py, compiled. Imported when depth is first aligned: numba takes half a second to load."""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit

WIDEST_PX = 48.0
"""A triangle that spans more colour pixels than this comes from a pixel seen edge-on: it is not drawn."""


@no_type_check
@njit(cache=True, nogil=True, fastmath=False)
def project(depth_m: Any, rays: Any, shift_m: Any, lens: Any, pixels: Any, z_m: Any) -> None:
    """Pixel and depth in the colour camera of every depth pixel; z 0 where there is none.

    `rays` are already turned into the colour frame. `lens`: fx fy cx cy skew, k1 k2 p1 p2 k3 k4 k5 k6, largest r^2.
    """
    fx, fy, cx, cy, skew = lens[0], lens[1], lens[2], lens[3], lens[4]
    k1, k2, p1, p2, k3, k4, k5, k6, r2_max = (
        lens[5],
        lens[6],
        lens[7],
        lens[8],
        lens[9],
        lens[10],
        lens[11],
        lens[12],
        lens[13],
    )
    height, width = depth_m.shape
    for i in range(height):
        for j in range(width):
            d = depth_m[i, j]
            z = rays[i, j, 2] * d + shift_m[2]
            z_m[i, j] = 0.0
            if not (d > 0.0 and z > 1e-3):
                continue
            x = (rays[i, j, 0] * d + shift_m[0]) / z
            y = (rays[i, j, 1] * d + shift_m[1]) / z
            r2 = x * x + y * y
            if not r2 <= r2_max:  # also a ray that is NaN; beyond the image's own rays the polynomial folds back
                continue
            radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            pixels[i, j, 0] = fx * xd + skew * yd + cx
            pixels[i, j, 1] = fy * yd + cy
            z_m[i, j] = z


@no_type_check
@njit(cache=True, nogil=True)
def _joined(before: float, a: float, b: float, after: float, relative: float, quadratic: float, most: float) -> bool:
    """Whether neighbouring depths a, b lie on one surface: a small step, or one that its neighbours continue."""
    if not (a > 0.0 and b > 0.0):
        return False
    near = min(a, b)
    step = b - a
    size = abs(step)
    if size <= relative * near + quadratic * near * near:
        return True
    if size > most * near:
        return False
    return (before > 0.0 and abs(step - (a - before)) < 0.4 * size) or (
        after > 0.0 and abs(step - (after - b)) < 0.4 * size
    )


@no_type_check
@njit(cache=True, nogil=True)
def draw(depth_m: Any, pixels: Any, z_m: Any, out: Any, limits: Any) -> None:
    """The depth image as a surface into the z-buffer `out` (0 is empty). `limits`: relative, quadratic, most, splat."""
    height, width = depth_m.shape
    relative, quadratic, most, splat = limits[0], limits[1], limits[2], limits[3]
    for i in range(height):
        for j in range(width):
            if z_m[i, j] <= 0.0:
                continue
            right = left = down = up = False
            if j + 1 < width and z_m[i, j + 1] > 0.0:
                before = depth_m[i, j - 1] if j > 0 else 0.0
                after = depth_m[i, j + 2] if j + 2 < width else 0.0
                right = _joined(before, depth_m[i, j], depth_m[i, j + 1], after, relative, quadratic, most)
            if j > 0 and z_m[i, j - 1] > 0.0:
                before = depth_m[i, j - 2] if j > 1 else 0.0
                after = depth_m[i, j + 1] if j + 1 < width else 0.0
                left = _joined(before, depth_m[i, j - 1], depth_m[i, j], after, relative, quadratic, most)
            if i + 1 < height and z_m[i + 1, j] > 0.0:
                before = depth_m[i - 1, j] if i > 0 else 0.0
                after = depth_m[i + 2, j] if i + 2 < height else 0.0
                down = _joined(before, depth_m[i, j], depth_m[i + 1, j], after, relative, quadratic, most)
            if i > 0 and z_m[i - 1, j] > 0.0:
                before = depth_m[i - 2, j] if i > 1 else 0.0
                after = depth_m[i + 1, j] if i + 1 < height else 0.0
                up = _joined(before, depth_m[i - 1, j], depth_m[i, j], after, relative, quadratic, most)
            # each pixel is the right angle of the triangle to its right and below, and of the one to its left and above
            if right and down:
                _triangle(pixels, z_m, i, j, i, j + 1, i + 1, j, out)
            if left and up:
                _triangle(pixels, z_m, i, j, i, j - 1, i - 1, j, out)
            if not ((right or left) and (down or up)):
                _point(pixels[i, j, 0], pixels[i, j, 1], z_m[i, j], splat, out)


@no_type_check
@njit(cache=True, nogil=True)
def _point(u: float, v: float, z: float, half: float, out: Any) -> None:
    rows, columns = out.shape
    y_first, y_last = max(0, int(np.rint(v - half))), min(rows - 1, int(np.rint(v + half)))
    x_first, x_last = max(0, int(np.rint(u - half))), min(columns - 1, int(np.rint(u + half)))
    for y in range(y_first, y_last + 1):
        for x in range(x_first, x_last + 1):
            if out[y, x] == 0.0 or z < out[y, x]:
                out[y, x] = z


@no_type_check
@njit(cache=True, nogil=True)
def _triangle(pixels: Any, z_m: Any, i0: int, j0: int, i1: int, j1: int, i2: int, j2: int, out: Any) -> None:
    """Every pixel centre inside, by barycentric weights; 1/z is linear in the image."""
    rows, columns = out.shape
    u0, v0, u1, v1 = pixels[i0, j0, 0], pixels[i0, j0, 1], pixels[i1, j1, 0], pixels[i1, j1, 1]
    u2, v2 = pixels[i2, j2, 0], pixels[i2, j2, 1]
    low_u, high_u = min(u0, u1, u2), max(u0, u1, u2)
    low_v, high_v = min(v0, v1, v2), max(v0, v1, v2)
    area = (u1 - u0) * (v2 - v0) - (u2 - u0) * (v1 - v0)
    if abs(area) < 1e-9 or high_u - low_u > WIDEST_PX or high_v - low_v > WIDEST_PX:
        return
    if high_u < -1 or high_v < -1 or low_u > columns or low_v > rows:
        return
    q0, q1, q2 = 1.0 / z_m[i0, j0], 1.0 / z_m[i1, j1], 1.0 / z_m[i2, j2]
    x_first, x_last = max(0, int(low_u)), min(columns - 1, int(high_u))
    for y in range(max(0, int(low_v)), min(rows - 1, int(high_v)) + 1):
        for x in range(x_first, x_last + 1):
            w1 = ((x - u0) * (v2 - v0) - (u2 - u0) * (y - v0)) / area
            w2 = ((u1 - u0) * (y - v0) - (x - u0) * (v1 - v0)) / area
            if w1 < -1e-9 or w2 < -1e-9 or w1 + w2 > 1 + 1e-9:
                continue
            z = 1.0 / (q0 + w1 * (q1 - q0) + w2 * (q2 - q0))
            if out[y, x] == 0.0 or z < out[y, x]:
                out[y, x] = z
