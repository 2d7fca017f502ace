"""Compiled residuals of pairs of views whose depth errs smoothly: unknowns beside the poses are the relative errors of
depth at the nodes of a grid over each view, between which they are bilinear.

The residuals and their weights are those of `track/kernels.py`. Of a pair (i, k), the points of view i are moved along
their rays by its errors, and the surface that view k shows by its own.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.motion.se3_kernels import adjoint, between
from processing.sensor.view_layout import (
    APPEARANCE,
    COUNT,
    FIRST,
    HEIGHT,
    NO_APPEARANCE,
    NX,
    NY,
    NZ,
    OFFSET,
    OUTSIDE,
    PX,
    PY,
    PZ,
    SHARP,
    SNX,
    SNY,
    SNZ,
    SSHARP,
    U0,
    V0,
    WIDTH,
    Z,
)
from processing.track.kernels import (
    COVERED_COST,
    GEOMETRY_M,
    INTENSITY,
    LEVEL,
    OUTLINE_M,
    SHADING,
    SHARE,
    appearance_step,
    cost_off_surface,
    depth_at,
    outline_slope,
)

TWIST = 6
POSE = TWIST + SHADING
"""Unknowns of a pair before the nodes of its two views: the twist of the points, and the pair's shading."""
CORNERS = 4
"""Nodes around a pixel."""


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def nodes_around(u, v, box, side, at, share):
    """The nodes around a pixel of the image, and each one's share there (bilinear). box: first node (u, v), and the
    nodes' distances (pixels)."""
    x = min(max((u - box[0]) / box[2], 0.0), side - 1.000001)
    y = min(max((v - box[1]) / box[3], 0.0), side - 1.000001)
    a, b = int(x), int(y)
    fx, fy = x - a, y - b
    at[0] = b * side + a
    at[1], at[2], at[3] = at[0] + 1, at[0] + side, at[0] + side + 1
    share[0], share[1], share[2], share[3] = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def add_shares(samples, focal, center, box, side, out):
    """What each node adds to the mean error of a view's samples."""
    at, share = np.empty(CORNERS, np.int64), np.empty(CORNERS)
    for p in samples:
        u, v = focal[0] * p[PX] / p[PZ] + center[0], focal[1] * p[PY] / p[PZ] + center[1]
        nodes_around(u, v, box, side, at, share)
        for a in range(CORNERS):
            out[at[a]] += share[a] / samples.shape[0]


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def _add_twist(sx, sy, sz, x, y, z, H, row):
    """Adds to a row of H the derivative by the twist of what changes with the point (x, y, z) by (sx, sy, sz)."""
    H[row, 0], H[row, 1], H[row, 2] = H[row, 0] + sx, H[row, 1] + sy, H[row, 2] + sz
    H[row, 3] += y * sz - z * sy
    H[row, 4] += z * sx - x * sz
    H[row, 5] += x * sy - y * sx


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def _add_slope(slope, r, weight, among):
    """One residual's share in its point's sums (`_add_point`)."""
    wx, wy, wz = weight * slope[0], weight * slope[1], weight * slope[2]
    among[0], among[1], among[2] = among[0] + wx * slope[0], among[1] + wx * slope[1], among[2] + wx * slope[2]
    among[3], among[4], among[5] = among[3] + wy * slope[1], among[4] + wy * slope[2], among[5] + wz * slope[2]
    among[6], among[7], among[8] = among[6] + wx * r, among[7] + wy * r, among[8] + wz * r


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def _add_shading(slope, along, K, r, weight, x, y, z, first, H, g, with_own):
    """What a residual adds whose derivatives by three unknowns of the pair's shading, from `first` on, are K; `along`:
    that by the point's own error, whose products with shading are summed in `with_own`."""
    for a in range(3):
        w = weight * K[a]
        g[first + a] += w * r
        with_own[first + a] += w * along
        _add_twist(w * slope[0], w * slope[1], w * slope[2], x, y, z, H, first + a)
        H[first + a, first] += w * K[0]
        H[first + a, first + 1] += w * K[1]
        H[first + a, first + 2] += w * K[2]


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def _add_other(slope, along, by_error, r, weight, x, y, z, at, share, own_at, own_share, H, g):
    """What a residual adds whose derivative by the other view's error, whose nodes are `at`, is `by_error`."""
    for a in range(CORNERS):
        w = weight * by_error * share[a]
        g[at[a]] += w * r
        _add_twist(w * slope[0], w * slope[1], w * slope[2], x, y, z, H, at[a])
        w_along, w_error = w * along, w * by_error
        for b in range(CORNERS):
            H[at[a], own_at[b]] += w_along * own_share[b]
            H[at[a], at[b]] += w_error * share[b]


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def _add_point(among, x, y, z, moved, at, share, with_own, H, g):
    """All residuals of one point, by the twist and by the point's own error, by which it moves by `moved` along its ray
    and whose nodes are `at`. among: of the weights w, values r and slopes s the sums w s s' (xx, xy, xz, yy, yz, zz)
    and w s r; it and `with_own` begin anew."""
    xx, xy, xz, yy, yz, zz = among[0], among[1], among[2], among[3], among[4], among[5]
    tx, ty, tz = among[6], among[7], among[8]
    _add_twist(xx, xy, xz, x, y, z, H, 0)
    _add_twist(xy, yy, yz, x, y, z, H, 1)
    _add_twist(xz, yz, zz, x, y, z, H, 2)
    _add_twist(y * xz - z * xy, y * yz - z * yy, y * zz - z * yz, x, y, z, H, 3)
    _add_twist(z * xx - x * xz, z * xy - x * yz, z * xz - x * zz, x, y, z, H, 4)
    _add_twist(x * xy - y * xx, x * yy - y * xy, x * yz - y * xz, x, y, z, H, 5)
    g[0], g[1], g[2] = g[0] + tx, g[1] + ty, g[2] + tz
    g[3], g[4], g[5] = g[3] + y * tz - z * ty, g[4] + z * tx - x * tz, g[5] + x * ty - y * tx
    mx, my, mz = moved[0], moved[1], moved[2]
    qx, qy, qz = xx * mx + xy * my + xz * mz, xy * mx + yy * my + yz * mz, xz * mx + yz * my + zz * mz
    own, of_own = mx * qx + my * qy + mz * qz, mx * tx + my * ty + mz * tz
    for a in range(CORNERS):
        part = share[a]
        g[at[a]] += part * of_own
        _add_twist(part * qx, part * qy, part * qz, x, y, z, H, at[a])
        for b in range(TWIST, POSE):
            H[at[a], b] += part * with_own[b]
        part *= own
        for b in range(CORNERS):
            H[at[a], at[b]] += part * share[b]
    among[:] = 0.0
    with_own[:] = 0.0


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def pair_terms(  # noqa: C901
    samples, step, pose, maps, row, focal, center, level, s_geo, s_int, s_out, side, boxes, errors, H, g
):
    """Adds normal equations of `samples` of one view seen by another, at its corrected depth.

    pose: 4x4 other_from_sample_camera. boxes (2, 4), errors (2, nodes): grids (`nodes_around`) and relative errors of
    both views' depth. H (its lower triangle), g: of the twist of the points in the other camera's frame, of the pair's
    shading, of the sampled view's errors, and of the other one's. Returns cost sum, points counted, points on the
    surface, violations, as `track/kernels.py` does.
    """
    # long because: one compiled loop over points, as in track/kernels.py
    off, u0, v0, w, h = row[OFFSET], row[U0], row[V0], row[WIDTH], row[HEIGHT]
    fx, fy, cx, cy = focal[0], focal[1], center[0], center[1]
    wg, wi, wo = 1.0 / (s_geo * s_geo), 1.0 / (s_int * s_int), 1.0 / (s_out * s_out)
    nodes = side * side
    among, with_own, K = np.zeros(9), np.zeros(POSE), np.empty(3)
    own, own_share = np.empty(CORNERS, np.int64), np.empty(CORNERS)
    other, other_share = np.empty(CORNERS, np.int64), np.empty(CORNERS)
    slope, moved = np.empty(3), np.empty(3)
    cost, seen, on, against = 0.0, 0, 0, 0
    for i in range(0, samples.shape[0], step):
        p = samples[i]
        seen += 1
        nodes_around(fx * p[PX] / p[PZ] + cx, fy * p[PY] / p[PZ] + cy, boxes[0], side, own, own_share)
        longer = 1.0
        for a in range(CORNERS):
            longer += own_share[a] * errors[0, own[a]]
            own[a] += POSE
        for a in range(3):
            moved[a] = pose[a, 0] * p[PX] + pose[a, 1] * p[PY] + pose[a, 2] * p[PZ]
        x, y, z = longer * moved[0] + pose[0, 3], longer * moved[1] + pose[1, 3], longer * moved[2] + pose[2, 3]
        if z < 0.05:
            cost += 1.0
            continue
        iz = 1.0 / z
        u = fx * x * iz + cx - u0
        v = fy * y * iz + cy - v0
        iu, iv = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if iu < 1 or iv < 1 or iu >= w - 2 or iv >= h - 2:
            cost += 1.0
            against += 1
            continue
        near = off + iv * w + iu
        out = maps[near, OUTSIDE]
        if out < 0.0:
            seen -= 1
            continue
        if out > 0.0:
            gap = out * z / fx
            r = gap / s_out
            cost += min(r * r / 9.0, 1.0)
            against += 1
            if r < 6.0 and s_out < 1.0:
                slope[0], slope[1], slope[2] = outline_slope(maps, near, w, fy / fx, x, y, iz)
                _add_slope(slope, gap, wo / (1.0 + r * r / 4.0), among)
                _add_point(among, x, y, z, moved, own, own_share, with_own, H, g)
            continue
        mx = pose[0, 0] * p[SNX] + pose[0, 1] * p[SNY] + pose[0, 2] * p[SNZ]
        my = pose[1, 0] * p[SNX] + pose[1, 1] * p[SNY] + pose[1, 2] * p[SNZ]
        mz = pose[2, 0] * p[SNX] + pose[2, 1] * p[SNY] + pose[2, 2] * p[SNZ]
        if (mx * x + my * y + mz * z) * iz > -0.1:  # faces away from the other camera: cannot be compared
            seen -= 1
            continue
        fits = maps[near, Z] <= 0.0
        if fits:
            cost += 0.5 * COVERED_COST
        else:
            nx, ny, nz = maps[near, NX], maps[near, NY], maps[near, NZ]
            nodes_around(u + u0, v + v0, boxes[1], side, other, other_share)
            zr = depth_at(maps, row, fx, fy, cx, cy, u, v, x, y, iz)
            stretch = 1.0
            for a in range(CORNERS):
                stretch += other_share[a] * errors[1, other[a]]
                other[a] += POSE + nodes
            toward = nx * x + ny * y + nz * z
            r_m = toward * (1.0 - stretch * zr * iz)
            r = r_m / s_geo
            if abs(r) < 3.0 and nx * mx + ny * my + nz * mz > 0.5:
                fits = True
                slope[0], slope[1], slope[2] = nx, ny, nz
                k = 1.0 - r * r / 9.0
                k *= wg * k
                along = nx * moved[0] + ny * moved[1] + nz * moved[2]
                _add_slope(slope, r_m, k, among)
                _add_other(
                    slope, along, -toward * zr * iz, r_m, k, x, y, z, other, other_share, own, own_share, H, g
                )  # fmt: skip
                on += 1
                cost += 0.5 * min(r * r / 9.0, 1.0)
            else:
                ahead = stretch * zr - z  # positive: the point lies in front of what this view sees
                cost += cost_off_surface(ahead, s_geo)
                against += ahead > 3.0 * s_geo
        if fits:
            ju, jv = int(np.floor(u)), int(np.floor(v))
            q = off + jv * w + ju
            ch = SHARP + level * APPEARANCE
            foreign = max(max(maps[q, ch], maps[q + 1, ch]), max(maps[q + w, ch], maps[q + w + 1, ch]))
            if max(foreign, p[SSHARP]) > 0.5 * NO_APPEARANCE:
                cost += 0.5 * COVERED_COST
                _add_point(among, x, y, z, moved, own, own_share, with_own, H, g)
                continue
            K[0], K[1], K[2] = p[SNX] - mx, p[SNY] - my, p[SNZ] - mz
            for c in range(APPEARANCE):
                ch = level * APPEARANCE + c
                e, k, gu, gv = appearance_step(maps, q, w, u - ju, v - jv, ch, p[SSHARP + ch], s_int)
                r = e / s_int
                cost += 0.5 / APPEARANCE * min(r * r / 9.0, 1.0)
                if k > 0.0:
                    slope[0], slope[1] = gu * fx * iz, gv * fy * iz
                    slope[2] = -(slope[0] * x + slope[1] * y) * iz
                    k *= wi
                    along = slope[0] * moved[0] + slope[1] * moved[1] + slope[2] * moved[2]
                    _add_slope(slope, e, k, among)
                    _add_shading(slope, along, K, e, k, x, y, z, TWIST + 3 * c, H, g, with_own)
            _add_point(among, x, y, z, moved, own, own_share, with_own, H, g)
    return cost, seen, on, against


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def _without_shading(H, g, sigma):
    """The normal equations of a pair whatever its shading is (Schur complement): twist, then both views' errors."""
    S = H[TWIST:POSE, TWIST:POSE].copy()
    for a in range(SHADING):
        S[a, a] += 1.0 / (sigma * sigma)
    n = H.shape[0] - SHADING
    B, rest = np.empty((SHADING, n)), np.empty((n, n))
    B[:, :TWIST], B[:, TWIST:] = H[TWIST:POSE, :TWIST], H[POSE:, TWIST:POSE].T
    rest[:TWIST, :TWIST] = H[:TWIST, :TWIST]
    for a in range(TWIST, n):
        for b in range(a + 1):
            rest[a, b] = H[a + SHADING, b if b < TWIST else b + SHADING]
            rest[b, a] = rest[a, b]
    gain = np.linalg.solve(S, B)
    left = np.empty(n)
    left[:TWIST], left[TWIST:] = g[:TWIST], g[POSE:]
    return rest - B.T @ gain, left - gain.T @ g[TWIST:POSE]


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def add_pairs(
    poses, pairs, sure_cost, places, grids, side, boxes, errors, sigma, maps, samples, table, focal, center, row, H, g,
    figures,
):  # fmt: skip
    """Adds normal equations of pairs (i, k) of views: points of view i in view k, both of whose depth errs.

    A pair that costs more than `sure_cost` counts less. figures (m, 3): mean cost, share on the surface, share of
    violations. places (v), grids (v): first unknown of a view's twist (of the object frame; -1: fixed)
    and number of its grid among `boxes` (c, 4) and `errors` (c, nodes); errors come after all twists, in H and g.
    sigma: standard deviation of a pair's shading.
    """
    nodes = side * side
    step = max(1, int(np.round(1.0 / row[SHARE])))
    first = H.shape[0] - errors.shape[0] * nodes
    count = 2 * TWIST + 2 * nodes  # the twists of both views' object frames, then the errors of both
    source, place, sign = np.empty(count, np.int64), np.empty(count, np.int64), np.ones(count)
    source[:TWIST] = np.arange(TWIST)
    source[TWIST:] = np.arange(count - TWIST)
    sign[TWIST : 2 * TWIST] = -1.0
    both_boxes, both = np.empty((2, 4)), np.empty((2, nodes))
    H1, g1 = np.empty((POSE + 2 * nodes, POSE + 2 * nodes)), np.empty(POSE + 2 * nodes)
    for m in range(pairs.shape[0]):
        i, k = pairs[m, 0], pairs[m, 1]
        both_boxes[0], both_boxes[1] = boxes[grids[i]], boxes[grids[k]]
        both[0], both[1] = errors[grids[i]], errors[grids[k]]
        mine = samples[table[i, FIRST] : table[i, FIRST] + table[i, COUNT]]
        H1[:], g1[:] = 0.0, 0.0
        cost, seen, on, against = pair_terms(
            mine, step, between(poses[k], poses[i]), maps, table[k], focal, center, int(row[LEVEL]), row[GEOMETRY_M],
            row[INTENSITY], row[OUTLINE_M], side, both_boxes, both, H1, g1,
        )  # fmt: skip
        n = max(1, seen)
        figures[m, 0], figures[m, 1], figures[m, 2] = cost / n, on / n, against / n
        H2, g2 = _without_shading(H1, g1, sigma)
        A = adjoint(poses[k])  # the twist of the points is A times that of i's object frame less that of k's
        H2[:TWIST] = A.T @ np.ascontiguousarray(H2[:TWIST])
        H2[:, :TWIST] = np.ascontiguousarray(H2[:, :TWIST]) @ A
        g2[:TWIST] = A.T @ g2[:TWIST].copy()
        for a in range(TWIST):
            place[a] = places[i] + a if places[i] >= 0 else -1
            place[TWIST + a] = places[k] + a if places[k] >= 0 else -1
        for a in range(nodes):
            place[2 * TWIST + a] = first + grids[i] * nodes + a
            place[2 * TWIST + nodes + a] = first + grids[k] * nodes + a
        for a in range(count):
            if place[a] < 0:
                continue
            weight = sign[a] / (1.0 + (figures[m, 0] / sure_cost) ** 2)
            g[place[a]] += weight * g2[source[a]]
            for b in range(count):
                if place[b] >= 0:
                    H[place[a], place[b]] += weight * sign[b] * H2[source[a], source[b]]
