"""Compiled comparison of two views over all turns about one line: what a round body's depth cannot tell.

The usual residuals (kernels.py) pull a round body towards no turn at all: its limb, its shading and the noise of its
normals stay with the picture. Here a turn is judged only by what contradicts it: points beside the other view's
outline, points in front of what it sees, and looks that differ where both views face the surface well. What is hidden
counts for nothing.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.track import kernels as k

OFFSET, U0, V0, WIDTH, HEIGHT, FIRST, COUNT = range(7)
BRIGHT_SHARE = 0.3
FACING_LOW, FACING_HIGH = 0.3, 0.8
"""Looks of a surface that faces the camera by less than the first cosine count nothing, by the second in full."""
HIDDEN = 0.1
"""Of a point off the round body, where it is hidden: what is seen there once should be seen again."""
LEAST_LOOKS = 20.0
"""Points whose looks must be comparable; fewer tell less."""


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def contradictions(samples, odd, step, pose, maps, row, focal, center, depth_m, outline_m, looks, out):
    """Adds to `out` (violations, points that could violate, differences of looks, their weight) what `samples` say
    against `pose` (4x4 other_from_sample camera). looks: scales of brightness and of colour differences."""
    # long because: one compiled loop over points
    off, u0, v0, w, h = row[OFFSET], row[U0], row[V0], row[WIDTH], row[HEIGHT]
    for i in range(0, samples.shape[0], step):
        p = samples[i]
        x = pose[0, 0] * p[k.PX] + pose[0, 1] * p[k.PY] + pose[0, 2] * p[k.PZ] + pose[0, 3]
        y = pose[1, 0] * p[k.PX] + pose[1, 1] * p[k.PY] + pose[1, 2] * p[k.PZ] + pose[1, 3]
        z = pose[2, 0] * p[k.PX] + pose[2, 1] * p[k.PY] + pose[2, 2] * p[k.PZ] + pose[2, 3]
        if z < 0.05:
            continue
        u, v = focal[0] * x / z + center[0] - u0, focal[1] * y / z + center[1] - v0
        iu, iv = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if iu < 1 or iv < 1 or iu >= w - 2 or iv >= h - 2:
            out[0] += 1.0
            continue
        near = off + iv * w + iu
        outside = maps[near, k.OUTSIDE]
        if outside < 0.0:
            out[0] += HIDDEN * odd[i]
            continue
        if outside > 0.0:
            out[0] += min(max(outside * z / (focal[0] * outline_m) - 0.6, 0.0) / 2.0, 1.0)
            continue
        zr = maps[near, k.Z]
        if zr <= 0.0:
            out[0] += 0.5 * HIDDEN * odd[i]
            continue
        far = 1.0 / np.sqrt(x * x + y * y + z * z)
        nx, ny, nz = maps[near, k.NX], maps[near, k.NY], maps[near, k.NZ]
        theirs = -(nx * x + ny * y + nz * z) * far
        ahead = (zr - z) / depth_m
        if ahead > 3.0:
            out[0] += min((ahead - 3.0) / 3.0, 1.0)
            continue
        if ahead < -3.0 / max(theirs, 0.3):
            out[0] += HIDDEN * odd[i]
            continue
        mx = pose[0, 0] * p[k.SNX] + pose[0, 1] * p[k.SNY] + pose[0, 2] * p[k.SNZ]
        my = pose[1, 0] * p[k.SNX] + pose[1, 1] * p[k.SNY] + pose[1, 2] * p[k.SNZ]
        mz = pose[2, 0] * p[k.SNX] + pose[2, 1] * p[k.SNY] + pose[2, 2] * p[k.SNZ]
        mine = -(mx * x + my * y + mz * z) * far
        if mine < 0.1:
            out[0] += HIDDEN * odd[i]
            continue
        own = -(p[k.SNX] * p[k.PX] + p[k.SNY] * p[k.PY] + p[k.SNZ] * p[k.PZ])
        own /= np.sqrt(p[k.PX] ** 2 + p[k.PY] ** 2 + p[k.PZ] ** 2)
        trust = (min(min(mine, theirs), own) - FACING_LOW) / (FACING_HIGH - FACING_LOW)
        if trust <= 0.0 or p[k.SSHARP] > 0.5 * k.NO_LOOK:
            continue
        trust = min(trust, 1.0)
        ju, jv = int(np.floor(u)), int(np.floor(v))
        a, b = u - ju, v - jv
        q = off + jv * w + ju
        if max(max(maps[q, k.SHARP], maps[q + 1, k.SHARP]), max(maps[q + w, k.SHARP], maps[q + w + 1, k.SHARP])) > 50.0:
            continue
        apart = 0.0
        for c in range(k.LOOKS):
            ch = k.SMOOTH + c
            there = (maps[q, ch] * (1 - a) + maps[q + 1, ch] * a) * (1 - b)
            there += (maps[q + w, ch] * (1 - a) + maps[q + w + 1, ch] * a) * b
            e = (there - p[k.SSHARP + k.LOOKS + c]) / looks[min(c, 1)]
            apart += (BRIGHT_SHARE if c == 0 else 1.0) * min(e * e, 1.0)
        out[2] += trust * apart / k.LOOKS
        out[3] += trust


@no_type_check
@njit(cache=True, nogil=True)
def turn_costs(poses, pairs, turns, maps, samples, odd, table, focal, center, step, depth_m, outline_m, looks, gains):
    """(m, d): what speaks against turning view i of each pair (i, j) by turns[m, d] (4x4, object frame) against j."""
    out = np.zeros((pairs.shape[0], turns.shape[1]))
    sums = np.zeros(4)
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        mine = samples[table[i, FIRST] : table[i, FIRST] + table[i, COUNT]]
        theirs = samples[table[j, FIRST] : table[j, FIRST] + table[j, COUNT]]
        first_i, first_j = table[i, FIRST], table[j, FIRST]
        all_of_them = float(mine.shape[0] // step + theirs.shape[0] // step)
        back = k.inverse(poses[j])
        for d in range(turns.shape[1]):
            sums[:] = 0.0
            pose = poses[i] @ turns[m, d]
            other = poses[j] @ k.inverse(pose)
            contradictions(
                mine, odd[first_i:], step, other, maps, table[j], focal, center, depth_m, outline_m, looks, sums
            )
            contradictions(
                theirs, odd[first_j:], step, pose @ back, maps, table[i], focal, center, depth_m, outline_m, looks, sums
            )
            out[m, d] = sums[0] / all_of_them + gains[m] * sums[2] / max(sums[3], LEAST_LOOKS)
    return out
