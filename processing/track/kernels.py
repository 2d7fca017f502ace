"""Compiled residuals of one view against another, and the pose of a view that makes them small.

`sensor/view_layout.py` says how views lie in memory. Poses are 4x4 `camera_from_object`; corrections are twists
(translation, rotation) of the object frame, applied on its left: object_from_camera <- exp(twist) object_from_camera.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.motion.se3_kernels import adjoint, between, exponential, inverse
from processing.motion.twist_terms import add_depth, add_image_residuals, add_residual, add_shading, to_object
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

LEVEL, STEPS, GEOMETRY_M, INTENSITY, OUTLINE_M, SHARE, ROUND = range(7)
"""Columns of a schedule row: intensity channel (0 sharp, 1 smooth), steps, the three scales, share of the samples."""

LEAST_SLOPE, LEAST_BRIGHT_SLOPE = 0.03, 0.1
"""An appearance that changes by less a pixel is shading, which stays with the room: it pulls little; brightness above
all."""
SHADING = 3 * APPEARANCE
"""Unknowns of a pair's shading (processing/track/pairs.py): what each channel gains along the normal's x, y, z."""
NO_SHADING = np.empty((0, 0)), np.empty((0, 0))
"""B and N of pair_terms where it is not sought."""
GRAZING, FACING = 0.3, 0.8
COVERED_COST = 0.12
"""Of a point that faces the other view but lies behind what is seen there: it may be covered."""
ODD_COST = 0.4
"""Of a point beside a surface that faces elsewhere, or in front of a hole."""


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def depth_at(maps, row, fx, fy, cx, cy, u, v, x, y, iz):
    """Depth that a view sees at (u, v) of its crop, where the point (x, y, 1 / iz) projects: between four pixels of one
    surface, else on the plane of the nearest pixel, whose depth is known."""
    off, u0, v0, w = row[OFFSET], row[U0], row[V0], row[WIDTH]
    ju, jv = int(np.floor(u)), int(np.floor(v))
    a, b, q = u - ju, v - jv, off + jv * w + ju
    z00, z10, z01, z11 = maps[q, Z], maps[q + 1, Z], maps[q + w, Z], maps[q + w + 1, Z]
    low = min(min(z00, z10), min(z01, z11))
    high = max(max(z00, z10), max(z01, z11))
    if low > 0.0 and high - low < 0.012:
        return (z00 * (1 - a) + z10 * a) * (1 - b) + (z01 * (1 - a) + z11 * a) * b
    iu, iv = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
    near = off + iv * w + iu
    zr = maps[near, Z]
    nx, ny, nz = maps[near, NX], maps[near, NY], maps[near, NZ]
    top = nx * (iu + u0 - cx) / fx + ny * (iv + v0 - cy) / fy + nz
    bottom = nx * x * iz + ny * y * iz + nz
    if abs(bottom) > 0.05:
        zr = zr * top / bottom
    return zr


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def outline_slope(maps, near, w, aspect, x, y, iz):
    """How the distance (m) of a point to the outline changes with its x, y and z; `aspect`: fy / fx."""
    du = 0.5 * (max(maps[near + 1, OUTSIDE], 0.0) - max(maps[near - 1, OUTSIDE], 0.0))
    dv = 0.5 * (max(maps[near + w, OUTSIDE], 0.0) - max(maps[near - w, OUTSIDE], 0.0)) * aspect
    return du, dv, -(du * x + dv * y) * iz


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def cost_off_surface(ahead, s_geo):
    """Of a point that is not on the surface another view sees: `ahead` (m) of it, a violation; covered; or odd."""
    if ahead > 3.0 * s_geo:
        return min(0.5 + ahead / (12.0 * s_geo), 1.0)
    return COVERED_COST if ahead < -3.0 * s_geo else ODD_COST


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def appearance_step(maps, q, w, a, b, channel, shown, s_int):
    """Of one channel of appearance between the four pixels from q on: residual against what the point `shown`, weight
    (0: another surface's), and its change per pixel along u and v."""
    ch = SHARP + channel
    i00, i10, i01, i11 = maps[q, ch], maps[q + 1, ch], maps[q + w, ch], maps[q + w + 1, ch]
    top, bottom = i00 * (1 - a) + i10 * a, i01 * (1 - a) + i11 * a
    e = top * (1 - b) + bottom * b - shown
    r = e / s_int
    if abs(r) >= 3.0:
        return e, 0.0, 0.0, 0.0
    gu = (i10 - i00) * (1 - b) + (i11 - i01) * b
    gv = bottom - top
    slope = gu * gu + gv * gv
    least = LEAST_BRIGHT_SLOPE if channel % APPEARANCE == 0 else LEAST_SLOPE
    k = (1.0 - r * r / 9.0) * slope / (slope + least * least)
    return e, k * k, gu, gv


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def pair_terms(  # noqa: C901
    samples, step, pose, maps, row, focal, center, level, s_geo, s_int, s_out, round_body, shaded, H, g, Hd, gd, B, N
):
    """Adds normal equations of `samples` (of one camera) seen by another view, in that view's camera frame.

    pose: 4x4 other_from_sample_camera. H (6, 6), g (6): J^T W J and J^T W r for a twist (translation, rotation) of the
    points in the other camera's frame; Hd, gd: the same of depth (they may be H, g). Where `shaded`, B (6, SHADING)
    and N (SHADING + 1, SHADING) get J^T W K, and K^T W K above r^T W K, for derivatives K by the pair's shading.
    Returns cost sum, points counted, points on the surface, violations.
    """
    # long because: one compiled loop over points, the tracker's innermost
    off, u0, v0, w, h = row[OFFSET], row[U0], row[V0], row[WIDTH], row[HEIGHT]
    fx, fy, cx, cy = focal[0], focal[1], center[0], center[1]
    cost = 0.0
    seen = 0
    on = 0
    against = 0
    J, K = np.empty(6), np.zeros(3)
    wg, wi, wo = 1.0 / (s_geo * s_geo), 1.0 / (s_int * s_int), 1.0 / (s_out * s_out)
    for i in range(0, samples.shape[0], step):
        p = samples[i]
        x = pose[0, 0] * p[PX] + pose[0, 1] * p[PY] + pose[0, 2] * p[PZ] + pose[0, 3]
        y = pose[1, 0] * p[PX] + pose[1, 1] * p[PY] + pose[1, 2] * p[PZ] + pose[1, 3]
        z = pose[2, 0] * p[PX] + pose[2, 1] * p[PY] + pose[2, 2] * p[PZ] + pose[2, 3]
        seen += 1
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
                k = wo / (1.0 + r * r / 4.0)
                J[0], J[1], J[2] = outline_slope(maps, near, w, fy / fx, x, y, iz)
                add_residual(J, x, y, z, gap, k, H, g)
            continue
        mx = pose[0, 0] * p[SNX] + pose[0, 1] * p[SNY] + pose[0, 2] * p[SNZ]
        my = pose[1, 0] * p[SNX] + pose[1, 1] * p[SNY] + pose[1, 2] * p[SNZ]
        mz = pose[2, 0] * p[SNX] + pose[2, 1] * p[SNY] + pose[2, 2] * p[SNZ]
        if (mx * x + my * y + mz * z) * iz > -0.1:  # faces away from the other camera: cannot be compared
            seen -= 1
            continue
        zr = maps[near, Z]
        nx, ny, nz = maps[near, NX], maps[near, NY], maps[near, NZ]
        fits = False
        facing = 0.0
        trust = 1.0
        if zr <= 0.0:
            cost += 0.5 * COVERED_COST
            fits = True
        else:
            zr = depth_at(maps, row, fx, fy, cx, cy, u, v, x, y, iz)
            ahead = zr - z  # positive: the point lies in front of what this view sees
            facing = nx * mx + ny * my + nz * mz
            r_m = (nx * x + ny * y + nz * z) * (1.0 - zr * iz)
            r = r_m / s_geo
            if abs(r) < 3.0 and facing > 0.5:
                fits = True
                on += 1
                k = 1.0 - r * r / 9.0
                if round_body:
                    far = 1.0 / np.sqrt(x * x + y * y + z * z)
                    trust = -max(mx * x + my * y + mz * z, nx * x + ny * y + nz * z) * far
                    trust = min(max((trust - GRAZING) / (FACING - GRAZING), 0.0), 1.0)
                    k *= np.sqrt(trust)
                J[0], J[1], J[2] = nx, ny, nz
                add_residual(J, x, y, z, r_m, wg * k * k, Hd, gd)
                cost += 0.5 * min(r * r / 9.0, 1.0)
            else:
                cost += cost_off_surface(ahead, s_geo)
                against += ahead > 3.0 * s_geo
        if fits:
            ju, jv = int(np.floor(u)), int(np.floor(v))
            a, b = u - ju, v - jv
            q = off + jv * w + ju
            ch = SHARP + level * APPEARANCE
            foreign = max(max(maps[q, ch], maps[q + 1, ch]), max(maps[q + w, ch], maps[q + w + 1, ch]))
            if max(foreign, p[SSHARP]) > 0.5 * NO_APPEARANCE:
                cost += 0.5 * COVERED_COST
                continue
            suu = suv = svv = tu = tv = 0.0
            for c in range(APPEARANCE):
                ch = level * APPEARANCE + c
                e, k, gu, gv = appearance_step(maps, q, w, a, b, ch, p[SSHARP + ch], s_int)
                r = e / s_int
                cost += 0.5 / APPEARANCE * min(r * r / 9.0, 1.0)
                if k > 0.0:
                    k *= wi * trust
                    gu *= fx * iz
                    gv *= fy * iz
                    suu, suv, svv = suu + k * gu * gu, suv + k * gu * gv, svv + k * gv * gv
                    tu, tv = tu + k * gu * e, tv + k * gv * e
                    if shaded:
                        K[0], K[1], K[2] = p[SNX] - mx, p[SNY] - my, p[SNZ] - mz
                        J[0], J[1], J[2] = gu, gv, -(gu * x + gv * y) * iz
                        J[3], J[4], J[5] = y * J[2] - z * J[1], z * J[0] - x * J[2], x * J[1] - y * J[0]
                        add_shading(J, e, k, K, 3 * c, B, N)
            add_image_residuals(x, y, z, iz, suu, suv, svv, tu, tv, H, g)
    return cost, seen, on, against


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def view_terms(pose, view, refs, ref_poses, maps, samples, table, focal, center, row, H, g):
    """Normal equations of one view's pose against reference views, both ways: its points in their images, theirs in
    its image. Returns mean cost, share of points on the surface, share of violations."""
    level = int(row[LEVEL])
    step = max(1, int(np.round(1.0 / row[SHARE])))
    mine = samples[table[view, FIRST] : table[view, FIRST] + table[view, COUNT]]
    cost, seen, on, against = 0.0, 0, 0, 0
    h6, g6 = np.empty((6, 6)), np.empty(6)
    none = np.empty((0, 0))
    for k in range(refs.shape[0]):
        ref_pose = ref_poses[k]
        other = table[refs[k]]
        h6[:], g6[:] = 0.0, 0.0
        c, s, o, v = pair_terms(
            mine, step, between(ref_pose, pose), maps, other, focal, center, level, row[GEOMETRY_M], row[INTENSITY],
            row[OUTLINE_M], row[ROUND] > 0.5, False, h6, g6, h6, g6, none, none,
        )  # fmt: skip
        to_object(h6, g6, ref_pose, 1.0, H, g)
        cost, seen, on, against = cost + c, seen + s, on + o, against + v
        theirs = samples[other[FIRST] : other[FIRST] + other[COUNT]]
        h6[:], g6[:] = 0.0, 0.0
        c, s, o, v = pair_terms(
            theirs, 2 * step, between(pose, ref_pose), maps, table[view], focal, center, level, row[GEOMETRY_M],
            row[INTENSITY], row[OUTLINE_M], row[ROUND] > 0.5, False, h6, g6, h6, g6, none, none,
        )  # fmt: skip
        to_object(h6, g6, pose, -1.0, H, g)
        cost, seen, on, against = cost + c, seen + s, on + o, against + v
    n = max(1, seen)
    return cost / n, on / n, against / n


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def align_view(pose, view, refs, ref_poses, maps, samples, table, focal, center, schedule, prior, prior_pose):
    """Gauss-Newton of one view's pose (camera_from_object) against fixed reference views, coarse to fine.

    prior (6,): information of a pull towards prior_pose (translation, rotation, object frame). Returns pose, H of the
    last step, cost, share on the surface, share of violations; the figures are at the last schedule row's scales.
    """
    pose = pose.copy()
    H, g = np.zeros((6, 6)), np.zeros(6)
    cost, on, against = 1.0, 0.0, 0.0
    for level in range(schedule.shape[0]):
        row = schedule[level]
        for _ in range(int(row[STEPS])):
            H[:], g[:] = 0.0, 0.0
            view_terms(pose, view, refs, ref_poses, maps, samples, table, focal, center, row, H, g)
            if prior[0] > 0.0:
                _pull(pose, prior_pose, prior, H, g)
            damp = 0.0
            for a in range(6):
                damp += H[a, a] / 6.0
            for a in range(6):
                H[a, a] += 1e-5 * H[a, a] + 1e-9 * damp + 1e-9
            step = -np.linalg.solve(H, g)
            turn = np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
            shift = np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            scale = min(1.0, min(0.3 / max(turn, 1e-12), 0.04 / max(shift, 1e-12)))
            pose = pose @ inverse(exponential(scale * step))
            if shift < 3e-5 and turn < 3e-4:
                break
    H[:], g[:] = 0.0, 0.0
    row = schedule[schedule.shape[0] - 1]
    cost, on, against = view_terms(pose, view, refs, ref_poses, maps, samples, table, focal, center, row, H, g)
    return pose, H, cost, on, against


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def _pull(pose, wanted, information, H, g):
    """Adds a pull of `pose` towards `wanted`, to first order in their difference (object frame)."""
    gap = inverse(pose) @ wanted  # object_from_object: where the wanted pose's points lie from here
    r = np.empty(6)
    r[0], r[1], r[2] = gap[0, 3], gap[1, 3], gap[2, 3]
    r[3] = 0.5 * (gap[2, 1] - gap[1, 2])
    r[4] = 0.5 * (gap[0, 2] - gap[2, 0])
    r[5] = 0.5 * (gap[1, 0] - gap[0, 1])
    for a in range(6):
        H[a, a] += information[a]
        g[a] += information[a] * r[a]


@no_type_check
def shading_terms(pairs):
    """Places for what graph_terms says of the shading of so many pairs."""
    return np.zeros((pairs, 6, SHADING)), np.zeros((pairs, SHADING + 1, SHADING))


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def graph_terms(
    poses, pairs, maps, samples, table, focal, center, row, turn_share, shaded, blocks, gradients, crossed, among,
    figures,
):  # fmt: skip
    """Normal equations of each pair (i, k): points of view i in view k.

    turn_share: of what depth says of turns (`ViewConfig.turn_share`). blocks (m, 6, 6), gradients (m, 6) for the twist
    of i; that of k has the opposite sign. figures (m, 3): mean cost, share on the surface, share of violations. Where
    `shaded`, crossed (m, 6, SHADING) and among (m, SHADING + 1, SHADING) are the pair's B (for the twist of i) and N.
    """
    level = int(row[LEVEL])
    step = max(1, int(np.round(1.0 / row[SHARE])))
    h6, g6, hd, gd = np.empty((6, 6)), np.empty(6), np.empty((6, 6)), np.empty(6)
    b6, n6 = np.zeros((6, SHADING)), np.zeros((SHADING + 1, SHADING))
    for m in range(pairs.shape[0]):
        i, k = pairs[m, 0], pairs[m, 1]
        h6[:], g6[:], hd[:], gd[:], b6[:], n6[:] = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        mine = samples[table[i, FIRST] : table[i, FIRST] + table[i, COUNT]]
        c, s, o, v = pair_terms(
            mine, step, between(poses[k], poses[i]), maps, table[k], focal, center, level, row[GEOMETRY_M],
            row[INTENSITY], row[OUTLINE_M], row[ROUND] > 0.5, shaded, h6, g6, hd, gd, b6, n6,
        )  # fmt: skip
        add_depth(hd, gd, turn_share, h6, g6)
        blocks[m], gradients[m] = 0.0, 0.0
        to_object(h6, g6, poses[k], 1.0, blocks[m], gradients[m])
        if shaded:
            crossed[m] = adjoint(poses[k]).T @ b6
            among[m] = n6
        n = max(1, s)
        figures[m, 0], figures[m, 1], figures[m, 2] = c / n, o / n, v / n
