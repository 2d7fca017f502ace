"""Compiled residuals of pairs of views whose depth errs smoothly: unknowns beside the poses are the relative errors of
depth at the nodes of a grid over each view, between which they are bilinear.

The residuals and their weights are those of `track/kernels.py`. Of a pair (i, k), the points of view i are moved along
their rays by its errors, and the surface that view k shows by its own.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.motion.se3_kernels import adjoint, inverse
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
@njit(cache=True, error_model="numpy", nogil=True)
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
def _add(at, J, count, r, weight, H, g):
    """One residual whose derivative by the unknowns `at` is J."""
    for a in range(count):
        w = weight * J[a]
        g[at[a]] += w * r
        for b in range(count):
            H[at[a], at[b]] += w * J[b]


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def _derivatives(slope, moved, x, y, z, share, J):
    """Those of a residual whose derivative by the point is `slope`: by the twist, then by the errors at the point's own
    nodes, whose shares are `share`: it moves by `moved` along its ray."""
    along = slope[0] * moved[0] + slope[1] * moved[1] + slope[2] * moved[2]
    J[0], J[1], J[2] = slope[0], slope[1], slope[2]
    J[3], J[4], J[5] = y * slope[2] - z * slope[1], z * slope[0] - x * slope[2], x * slope[1] - y * slope[0]
    for a in range(CORNERS):
        J[TWIST + a] = share[a] * along


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def pair_terms(  # noqa: C901
    samples, step, pose, maps, row, focal, center, level, s_geo, s_int, s_out, side, boxes, errors, H, g
):
    """Adds normal equations of `samples` of one view seen by another, at its corrected depth.

    pose: 4x4 other_from_sample_camera. boxes (2, 4), errors (2, nodes): grids (`nodes_around`) and relative errors of
    both views' depth. H, g: of the twist of the points in the other camera's frame, of the pair's shading, of the
    sampled view's errors, and of the other one's. Returns cost sum, points counted, points on the surface, violations,
    as `track/kernels.py` does.
    """
    # long because: one compiled loop over points, as in track/kernels.py
    off, u0, v0, w, h = row[OFFSET], row[U0], row[V0], row[WIDTH], row[HEIGHT]
    fx, fy, cx, cy = focal[0], focal[1], center[0], center[1]
    wg, wi, wo = 1.0 / (s_geo * s_geo), 1.0 / (s_int * s_int), 1.0 / (s_out * s_out)
    nodes = side * side
    most = TWIST + 3 + 2 * CORNERS
    at, J = np.arange(most), np.empty(most)
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
            at[TWIST + a] = POSE + own[a]
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
                _derivatives(slope, moved, x, y, z, own_share, J)
                _add(at, J, TWIST + CORNERS, gap, wo / (1.0 + r * r / 4.0), H, g)
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
            toward = nx * x + ny * y + nz * z
            r_m = toward * (1.0 - stretch * zr * iz)
            r = r_m / s_geo
            if abs(r) < 3.0 and nx * mx + ny * my + nz * mz > 0.5:
                fits = True
                slope[0], slope[1], slope[2] = nx, ny, nz
                _derivatives(slope, moved, x, y, z, own_share, J)
                for a in range(CORNERS):
                    at[TWIST + CORNERS + a] = POSE + nodes + other[a]
                    J[TWIST + CORNERS + a] = -toward * zr * iz * other_share[a]
                k = 1.0 - r * r / 9.0
                _add(at, J, TWIST + 2 * CORNERS, r_m, wg * k * k, H, g)
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
                continue
            for c in range(APPEARANCE):
                ch = level * APPEARANCE + c
                e, k, gu, gv = appearance_step(maps, q, w, u - ju, v - jv, ch, p[SSHARP + ch], s_int)
                r = e / s_int
                cost += 0.5 / APPEARANCE * min(r * r / 9.0, 1.0)
                if k > 0.0:
                    slope[0], slope[1] = gu * fx * iz, gv * fy * iz
                    slope[2] = -(slope[0] * x + slope[1] * y) * iz
                    _derivatives(slope, moved, x, y, z, own_share, J)
                    first = TWIST + CORNERS
                    for a in range(3):
                        at[first + a] = TWIST + 3 * c + a
                    J[first], J[first + 1], J[first + 2] = p[SNX] - mx, p[SNY] - my, p[SNZ] - mz
                    _add(at, J, first + 3, e, wi * k, H, g)
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
    B[:, :TWIST], B[:, TWIST:] = H[TWIST:POSE, :TWIST], H[TWIST:POSE, POSE:]
    rest[:TWIST, :TWIST], rest[TWIST:, TWIST:] = H[:TWIST, :TWIST], H[POSE:, POSE:]
    rest[:TWIST, TWIST:], rest[TWIST:, :TWIST] = H[:TWIST, POSE:], H[POSE:, :TWIST]
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
            mine, step, poses[k] @ inverse(poses[i]), maps, table[k], focal, center, int(row[LEVEL]), row[GEOMETRY_M],
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
