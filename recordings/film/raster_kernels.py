"""The inner loop of raster.py, compiled. Imported when something is first drawn: numba takes half a second to load."""

from __future__ import annotations

from typing import Any, no_type_check

from numba import njit


@no_type_check
@njit(cache=True, nogil=True, fastmath=False)
def fill(corners: Any, rgb: Any, depth: Any, image: Any) -> None:
    """Draw triangles into a z-buffer: the nearest surface at every pixel centre (integer coordinates).

    `corners` (f, 3, 3) are u, v in pixels and depth; `rgb` (f, 3, 3) the colour at every corner. `depth` (h, w) starts
    at infinity and `image` (h, w, 3) with the background. Depth is interpolated as 1/z, which is linear in the image.
    """
    height, width = depth.shape
    for f in range(corners.shape[0]):
        ax, ay, az = corners[f, 0, 0], corners[f, 0, 1], corners[f, 0, 2]
        bx, by, bz = corners[f, 1, 0], corners[f, 1, 1], corners[f, 1, 2]
        cx, cy, cz = corners[f, 2, 0], corners[f, 2, 1], corners[f, 2, 2]
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if area == 0.0:
            continue
        left, right = min(ax, bx, cx), max(ax, bx, cx)
        top, bottom = min(ay, by, cy), max(ay, by, cy)
        if right < 0.0 or left > width - 1.0 or bottom < 0.0 or top > height - 1.0:
            continue
        for i in range(int(max(top, 0.0) + 0.999999), int(min(bottom, height - 1.0)) + 1):
            for j in range(int(max(left, 0.0) + 0.999999), int(min(right, width - 1.0)) + 1):
                wb = ((j - ax) * (cy - ay) - (i - ay) * (cx - ax)) / area
                wc = ((bx - ax) * (i - ay) - (by - ay) * (j - ax)) / area
                wa = 1.0 - wb - wc
                if wa < 0.0 or wb < 0.0 or wc < 0.0:
                    continue
                z = 1.0 / (wa / az + wb / bz + wc / cz)
                if z >= depth[i, j]:
                    continue
                depth[i, j] = z
                for k in range(3):
                    image[i, j, k] = wa * rgb[f, 0, k] + wb * rgb[f, 1, k] + wc * rgb[f, 2, k]
