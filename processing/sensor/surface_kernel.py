"""Smooth depth and normals of one view, compiled: a local plane in inverse depth at every pixel."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.sensor.noise import STEREO_BASELINE_M


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def fit_surface(depth_m, inside, rays, radius, edge_share, out_m, normals):  # noqa: C901 (one hot loop)
    """Local planes, fitted to inverse depth (in which planes stay planes) over a window, twice: the second time
    without what lies off the first plane. Fills small holes. Writes depth and normal, 0 where there is no plane."""
    # long because: one hot loop over pixels whose sums live in registers
    h, w = depth_m.shape
    for v in range(h):
        for u in range(w):
            out_m[v, u] = 0.0
            if not inside[v, u]:
                continue
            z0 = depth_m[v, u]
            if z0 <= 0.0:
                total, n = 0.0, 0
                for dv in range(-1, 2):
                    for du in range(-1, 2):
                        y, x = v + dv, u + du
                        if 0 <= y < h and 0 <= x < w and inside[y, x] and depth_m[y, x] > 0:
                            total += depth_m[y, x]
                            n += 1
                if n < 3:
                    continue
                z0 = total / n
            q0 = 1.0 / z0
            a, b, c = q0, 0.0, 0.0
            good = False
            for again in range(2):
                limit = edge_share * z0 * (1.5 if again == 0 else 0.5)
                s = sx = sy = sxx = sxy = syy = sq = sqx = sqy = 0.0
                for dv in range(-radius, radius + 1):
                    for du in range(-radius, radius + 1):
                        y, x = v + dv, u + du
                        if y < 0 or x < 0 or y >= h or x >= w or not inside[y, x]:
                            continue
                        z = depth_m[y, x]
                        if z <= 0.0:
                            continue
                        q = 1.0 / z
                        gap = (q - (a + b * du + c * dv)) * z * z0
                        if abs(gap) > limit:
                            continue
                        k = 1.0 - (abs(gap) / limit) ** 2
                        s += k
                        sx += k * du
                        sy += k * dv
                        sxx += k * du * du
                        sxy += k * du * dv
                        syy += k * dv * dv
                        e = q - q0
                        sq += k * e
                        sqx += k * e * du
                        sqy += k * e * dv
                if s < 6.0:
                    good = False
                    break
                mx, my, mq = sx / s, sy / s, sq / s
                cxx, cxy, cyy = sxx / s - mx * mx, sxy / s - mx * my, syy / s - my * my
                cqx, cqy = sqx / s - mq * mx, sqy / s - mq * my
                det = cxx * cyy - cxy * cxy
                if det < 0.05:
                    good = False
                    break
                b = (cqx * cyy - cqy * cxy) / det
                c = (cqy * cxx - cqx * cxy) / det
                a = q0 + mq - b * mx - c * my
                good = True
            if not good or a <= 0.0:
                continue
            # 1/z = n . ray / d: the plane's normal follows from the slopes of 1/z per ray coordinate
            dx = rays[0]
            dy = rays[1]
            x = rays[2] + u * dx
            y = rays[3] + v * dy
            n0, n1 = b / dx, c / dy
            n2 = a - n0 * x - n1 * y
            length = np.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
            cosine = a / (length * np.sqrt(x * x + y * y + 1.0))
            if cosine * np.sqrt(1.0 / (a * a) + STEREO_BASELINE_M**2) < STEREO_BASELINE_M:
                continue  # steeper than the disparity gradient limit: flying pixels, not a surface
            out_m[v, u] = 1.0 / a
            normals[v, u, 0] = -n0 / length
            normals[v, u, 1] = -n1 / length
            normals[v, u, 2] = -n2 / length
