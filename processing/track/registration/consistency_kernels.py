"""Compiled comparison of views from everywhere around a body: not only of those that see the same side.

Every point of a view's surface says something to every other view, whichever way it faces: it must not lie beside the
other's outline, nor in front of what is seen there. Where both see the surface well, depth and appearance must agree
too.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.motion import se3_kernels as se3
from processing.motion.twist_terms import add_image_residuals, add_residual, to_object
from processing.sensor import view_layout as lay
from processing.track import kernels as k

COUNTED, OUTSIDE, BEFORE, SHARED, DEPTH, APPEARANCE_WEIGHT, APPEARANCE_COST = range(7)
"""Columns of a pair's figures: points; sums of what they cost beside the outline and before the surface; weight of the
points whose surface both see, and their depths' cost; weight of those with an appearance, and their appearance cost."""
FIGURES = 7

GRAZING, PLAIN = 0.2, 0.6
"""A surface that faces a camera by less than the first cosine is not compared, by the second in full."""
SAME_SIDE = 0.7
"""Least cosine between two normals of one surface."""
PULLED = 8.0
"""Points that are inconsistent by more scales than this pull no more."""


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def consistency_terms(  # noqa: C901 (one hot loop)
    poses, pairs, maps, points, first, count, table, focal, center, row, rim, blocks, gradients, figures
):
    """Normal equations and figures of each pair (i, k): points of view i in view k.

    row: a schedule row as kernels.py has it. rim: the points are the body's extremes in their picture and have neither
    normals nor appearance; only the outline judges them, and not within a pixel. blocks (m, 6, 6), gradients (m, 6) for
    the twist of i; that of k has the opposite sign. figures (m, FIGURES)."""
    # long because: one compiled loop over points
    fx, fy, cx, cy = focal[0], focal[1], center[0], center[1]
    s_depth, s_appearance, s_out = row[k.GEOMETRY_M], row[k.INTENSITY], row[k.OUTLINE_M]
    w_depth, w_appearance, w_out = 1.0 / (s_depth * s_depth), 1.0 / (s_appearance * s_appearance), 1.0 / (s_out * s_out)
    level = int(row[k.LEVEL])
    step = max(1, int(np.round(1.0 / row[k.SHARE])))
    J, H, g = np.empty(6), np.empty((6, 6)), np.empty(6)
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        pose = se3.between(poses[j], poses[i])
        off, u0, v0, w, h = (
            table[j, lay.OFFSET],
            table[j, lay.U0],
            table[j, lay.V0],
            table[j, lay.WIDTH],
            table[j, lay.HEIGHT],
        )
        H[:], g[:] = 0.0, 0.0
        f = figures[m]
        f[:] = 0.0
        for n in range(first[i], first[i] + count[i], step):
            p = points[n]
            x = pose[0, 0] * p[0] + pose[0, 1] * p[1] + pose[0, 2] * p[2] + pose[0, 3]
            y = pose[1, 0] * p[0] + pose[1, 1] * p[1] + pose[1, 2] * p[2] + pose[1, 3]
            z = pose[2, 0] * p[0] + pose[2, 1] * p[1] + pose[2, 2] * p[2] + pose[2, 3]
            f[COUNTED] += 1.0
            if z < 0.05:
                f[OUTSIDE] += 1.0
                continue
            iz = 1.0 / z
            u = fx * x * iz + cx - u0
            v = fy * y * iz + cy - v0
            iu, iv = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
            if iu < 1 or iv < 1 or iu >= w - 2 or iv >= h - 2:
                f[OUTSIDE] += 1.0
                continue
            near = off + iv * w + iu
            out = maps[near, lay.OUTSIDE]
            if out < 0.0:  # something nearer may stand there
                f[COUNTED] -= 1.0
                continue
            if out > 0.0:
                gap = (max(out - 1.0, 0.0) if rim else out) * z / fx
                r = gap / s_out
                f[OUTSIDE] += min(r * r / 9.0, 1.0)
                if 0.0 < r < PULLED:
                    du = 0.5 * (max(maps[near + 1, lay.OUTSIDE], 0.0) - max(maps[near - 1, lay.OUTSIDE], 0.0))
                    dv = 0.5 * (max(maps[near + w, lay.OUTSIDE], 0.0) - max(maps[near - w, lay.OUTSIDE], 0.0))
                    J[0], J[1] = du, dv * fy / fx
                    J[2] = -(du * x + dv * fy / fx * y) * iz
                    add_residual(J, x, y, z, gap, w_out / (1.0 + r * r / 4.0), H, g)
                continue
            zr = maps[near, lay.Z]
            if rim or zr <= 0.0:
                continue
            nx, ny, nz = maps[near, lay.NX], maps[near, lay.NY], maps[near, lay.NZ]
            mx = pose[0, 0] * p[3] + pose[0, 1] * p[4] + pose[0, 2] * p[5]
            my = pose[1, 0] * p[3] + pose[1, 1] * p[4] + pose[1, 2] * p[5]
            mz = pose[2, 0] * p[3] + pose[2, 1] * p[4] + pose[2, 2] * p[5]
            px, py = (iu + u0 - cx) / fx, (iv + v0 - cy) / fy
            top, bottom = nx * px + ny * py + nz, nx * x * iz + ny * y * iz + nz
            if abs(bottom) > 0.05:  # the seen plane, followed from its pixel to the point's own ray
                zr *= top / bottom
            ahead_m = (nx * x + ny * y + nz * z) * (1.0 - zr * iz)
            far = 1.0 / np.sqrt(x * x + y * y + z * z)
            here, there = -(mx * x + my * y + mz * z) * far, -(nx * x + ny * y + nz * z) * far
            trust = min(max((min(here, there) - GRAZING) / (PLAIN - GRAZING), 0.0), 1.0)
            r = ahead_m / s_depth
            if trust > 0.0 and nx * mx + ny * my + nz * mz > SAME_SIDE and abs(r) < 3.0:
                f[SHARED] += trust
                f[DEPTH] += trust * r * r / 9.0
                kept = 1.0 - r * r / 9.0
                J[0], J[1], J[2] = nx, ny, nz
                add_residual(J, x, y, z, ahead_m, w_depth * kept * kept * trust, H, g)
                ju, jv = int(np.floor(u)), int(np.floor(v))
                a, b = u - ju, v - jv
                q = off + jv * w + ju
                c0 = lay.SHARP + level * lay.APPEARANCE
                foreign = max(max(maps[q, c0], maps[q + 1, c0]), max(maps[q + w, c0], maps[q + w + 1, c0]))
                if max(foreign, p[lay.SSHARP]) > 0.5 * lay.NO_APPEARANCE:
                    continue
                f[APPEARANCE_WEIGHT] += trust
                suu = suv = svv = tu = tv = 0.0
                for c in range(lay.APPEARANCE):
                    i00, i10, i01, i11 = (
                        maps[q, c0 + c],
                        maps[q + 1, c0 + c],
                        maps[q + w, c0 + c],
                        maps[q + w + 1, c0 + c],
                    )
                    above, below = i00 * (1 - a) + i10 * a, i01 * (1 - a) + i11 * a
                    e = above * (1 - b) + below * b - p[lay.SSHARP + level * lay.APPEARANCE + c]
                    r = e / s_appearance
                    f[APPEARANCE_COST] += trust * min(r * r / 9.0, 1.0) / lay.APPEARANCE
                    if abs(r) < 3.0:
                        gu, gv = (i10 - i00) * (1 - b) + (i11 - i01) * b, below - above
                        slope = gu * gu + gv * gv
                        kept = trust * (1.0 - r * r / 9.0) * slope / (slope + k.LEAST_SLOPE * k.LEAST_SLOPE)
                        gu, gv, kept = gu * fx * iz, gv * fy * iz, w_appearance * kept * kept
                        suu, suv, svv = suu + kept * gu * gu, suv + kept * gu * gv, svv + kept * gv * gv
                        tu, tv = tu + kept * gu * e, tv + kept * gv * e
                add_image_residuals(x, y, z, iz, suu, suv, svv, tu, tv, H, g)
            elif ahead_m > 0.0 and zr > z and there > GRAZING:
                r = ahead_m / s_out
                f[BEFORE] += min(r * r / 9.0, 1.0)
                if r < PULLED:
                    J[0], J[1], J[2] = nx, ny, nz
                    add_residual(J, x, y, z, ahead_m, w_out / (1.0 + r * r / 4.0), H, g)
        blocks[m], gradients[m] = 0.0, 0.0
        to_object(H, g, poses[j], 1.0, blocks[m], gradients[m])
