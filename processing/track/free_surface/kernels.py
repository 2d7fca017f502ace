"""Compiled residuals of two views' colours on one drawn surface that both lie on.

A point of it stays on the surface while the view that shows it moves: it slides along its ray. So its place in the
other view's image changes by what the ray moves along the surface; the other view's own motion counts in full.
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
from processing.track.kernels import SHADING, appearance_step, depth_at

BOTH = 12
"""Unknowns of a pair: the twists of its two views."""
GRAZING = 0.1
"""Cosine of the angle from which on a surface is seen too flat."""


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def slide(drawn, pose, samples):
    """Moves a view's samples along their rays to the surface that it showed when it was drawn at `drawn`, and that lies
    where `pose` has it now (to first order: to the planes of the points)."""
    step = between(pose, drawn)
    for i in range(samples.shape[0]):
        p = samples[i]
        x, y, z = p[PX], p[PY], p[PZ]
        mx = step[0, 0] * p[SNX] + step[0, 1] * p[SNY] + step[0, 2] * p[SNZ]
        my = step[1, 0] * p[SNX] + step[1, 1] * p[SNY] + step[1, 2] * p[SNZ]
        mz = step[2, 0] * p[SNX] + step[2, 1] * p[SNY] + step[2, 2] * p[SNZ]
        ax = step[0, 0] * x + step[0, 1] * y + step[0, 2] * z + step[0, 3]
        ay = step[1, 0] * x + step[1, 1] * y + step[1, 2] * z + step[1, 3]
        az = step[2, 0] * x + step[2, 1] * y + step[2, 2] * z + step[2, 3]
        along = mx * x + my * y + mz * z
        if along < -GRAZING * z:
            share = min(max((mx * ax + my * ay + mz * az) / along, 0.9), 1.1)
            p[PX], p[PY], p[PZ] = share * x, share * y, share * z
        p[SNX], p[SNY], p[SNZ] = mx, my, mz


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True)
def _pair_terms(samples, pose, maps, row, focal, center, reach_m, s_int, H, g, B, N):  # noqa: C901
    """Adds normal equations of `samples` of one view in the image of another (pose: other_from_one), for the twists of
    the points in the other camera's frame by which the one moves them, and by which the other does. B, N: of the
    pair's shading, as in track/kernels.py. Returns cost sum and points compared."""
    # long because: one compiled loop over points, as in track/kernels.py
    off, u0, v0, w, h = row[OFFSET], row[U0], row[V0], row[WIDTH], row[HEIGHT]
    fx, fy, cx, cy = focal[0], focal[1], center[0], center[1]
    J, K = np.empty(BOTH), np.empty(3)
    wi = 1.0 / (s_int * s_int)
    cost, seen = 0.0, 0
    for i in range(samples.shape[0]):
        p = samples[i]
        rx = pose[0, 0] * p[PX] + pose[0, 1] * p[PY] + pose[0, 2] * p[PZ]
        ry = pose[1, 0] * p[PX] + pose[1, 1] * p[PY] + pose[1, 2] * p[PZ]
        rz = pose[2, 0] * p[PX] + pose[2, 1] * p[PY] + pose[2, 2] * p[PZ]
        x, y, z = rx + pose[0, 3], ry + pose[1, 3], rz + pose[2, 3]
        if z < 0.05:
            continue
        iz = 1.0 / z
        u = fx * x * iz + cx - u0
        v = fy * y * iz + cy - v0
        iu, iv = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if iu < 1 or iv < 1 or iu >= w - 2 or iv >= h - 2:
            continue
        near = off + iv * w + iu
        if maps[near, OUTSIDE] != 0.0 or maps[near, Z] <= 0.0:
            continue
        mx = pose[0, 0] * p[SNX] + pose[0, 1] * p[SNY] + pose[0, 2] * p[SNZ]
        my = pose[1, 0] * p[SNX] + pose[1, 1] * p[SNY] + pose[1, 2] * p[SNZ]
        mz = pose[2, 0] * p[SNX] + pose[2, 1] * p[SNY] + pose[2, 2] * p[SNZ]
        toward, along = mx * x + my * y + mz * z, mx * rx + my * ry + mz * rz
        if toward * iz > -GRAZING or along > -GRAZING * p[PZ]:
            continue
        if abs(z - depth_at(maps, row, fx, fy, cx, cy, u, v, x, y, iz)) > reach_m:
            continue
        if maps[near, NX] * mx + maps[near, NY] * my + maps[near, NZ] * mz < 0.5:
            continue
        ju, jv = int(np.floor(u)), int(np.floor(v))
        q = off + jv * w + ju
        ch = SHARP
        foreign = max(max(maps[q, ch], maps[q + 1, ch]), max(maps[q + w, ch], maps[q + w + 1, ch]))
        if max(foreign, p[SSHARP]) > 0.5 * NO_APPEARANCE:
            continue
        seen += 1
        K[0], K[1], K[2] = p[SNX] - mx, p[SNY] - my, p[SNZ] - mz
        for c in range(APPEARANCE):
            e, k, gu, gv = appearance_step(maps, q, w, u - ju, v - jv, c, p[SSHARP + c], s_int)
            r = e / s_int
            cost += min(r * r / 9.0, 1.0) / APPEARANCE
            if k <= 0.0:
                continue
            k *= wi
            sx, sy = gu * fx * iz, gv * fy * iz
            sz = -(sx * x + sy * y) * iz
            slid = (sx * rx + sy * ry + sz * rz) / along
            ax, ay, az = sx - slid * mx, sy - slid * my, sz - slid * mz
            J[0], J[1], J[2] = ax, ay, az
            J[3], J[4], J[5] = y * az - z * ay, z * ax - x * az, x * ay - y * ax
            J[6], J[7], J[8] = -sx, -sy, -sz
            J[9], J[10], J[11] = z * sy - y * sz, x * sz - z * sx, y * sx - x * sy
            for a in range(BOTH):
                ja = k * J[a]
                g[a] += ja * e
                for b in range(a + 1):
                    H[a, b] += ja * J[b]
                for b in range(3):
                    B[a, 3 * c + b] += ja * K[b]
            for a in range(3):
                ka = k * K[a]
                N[-1, 3 * c + a] += ka * e
                for b in range(3):
                    N[3 * c + a, 3 * c + b] += ka * K[b]
    return cost, seen


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def surface_terms(poses, pairs, maps, samples, table, focal, center, reach_m, s_int, H, g, B, N, cost):
    """Normal equations of each pair (i, k): points of view i in view k, for the object frame's twists of i and of k.

    H (m, 12, 12), g (m, 12), B (m, 12, SHADING), N (m, SHADING + 1, SHADING): as `_pair_terms` says. cost (m): mean
    over what is compared, 1 where nothing is.
    """
    full = np.zeros((BOTH, BOTH))
    h, s, b = np.zeros((BOTH, BOTH)), np.zeros(BOTH), np.zeros((BOTH, SHADING))
    for m in range(pairs.shape[0]):
        i, k = pairs[m, 0], pairs[m, 1]
        h[:], s[:], b[:] = 0.0, 0.0, 0.0
        mine = samples[table[i, FIRST] : table[i, FIRST] + table[i, COUNT]]
        total, seen = _pair_terms(
            mine, between(poses[k], poses[i]), maps, table[k], focal, center, reach_m, s_int, h, s, b, N[m]
        )
        cost[m] = total / seen if seen > 0 else 1.0
        A = adjoint(poses[k])
        full[:6, :6], full[6:, 6:] = A, A
        for a in range(BOTH):
            for c in range(a):
                h[c, a] = h[a, c]
        H[m] = full.T @ h @ full
        g[m] = full.T @ s
        B[m] = full.T @ b
