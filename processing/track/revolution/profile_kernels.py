"""Compiled terms of a body of revolution: how samples and outlines of many views differ from one shared profile.

The profile is four curves over equally spaced nodes: radius by height where the surface faces away from the axis
(OUTSIDE) and towards it (INSIDE), height by radius where it faces along it (TOP) and against it (FOOT). Unknowns after
the nodes: height of both ends as outlines show them, the outlines' common bias (px), and by how much outlines see a
larger radius than depth does.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.sensor.view_layout import HEIGHT, OFFSET, PX, PY, PZ, SNX, SNY, SNZ, U0, V0, WIDTH

OUTSIDE, INSIDE, TOP, FOOT = range(4)
LOW, HIGH, BIAS, RADIUS_BIAS = range(-4, 0)
"""Places, from the end, of the unknowns that are no nodes."""
ROW, FIRST_HEIGHT, OFF_M, SIGMA_M, SIGMA_PX, INTO_PX, BEYOND_PX, NEAR_PX, OUTLINE_STEP_PX = range(9)
"""Settings: spacing of nodes, height of the first; residuals beyond OFF_M belong to something else; standard deviations
of depth and outlines; outlines farther inside or beyond are something else's, and so is what lies NEAR_PX beside them;
spacing of an outline's points along the wall."""
ALONG = 0.75
"""Cosine within which a normal counts as one of the four directions."""
RING = 72
"""Points of an end's circle."""
INSET_M = 0.003
"""The ends' radius is that of the outside so far from them."""


@no_type_check
@njit(cache=True, nogil=True)
def _curve(y, seen, sizes, kind, a):
    """Value and slope per node spacing of a curve at `a` (in nodes), its first node, the share of the second; known."""
    first = 0
    for q in range(kind):
        first += sizes[q]
    j = min(max(int(np.floor(a)), 0), sizes[kind] - 2)
    t = min(max(a - j, 0.0), 1.0)
    j += first
    return y[j] * (1.0 - t) + y[j + 1] * t, y[j + 1] - y[j], j, t, seen[j] and seen[j + 1]


@no_type_check
@njit(cache=True, nogil=True)
def _kind(along, away):
    """Which curve a surface of this normal belongs to; -1: none."""
    if away > ALONG:
        return OUTSIDE
    if away < -ALONG:
        return INSIDE
    if along > ALONG:
        return TOP
    return FOOT if along < -ALONG else -1


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def surface_terms(samples, pose, axes, point, y, seen, sizes, config, scale, weight, H, g, Hy, Hyy, gy):
    """Adds one view's samples. axes (3, 3): across, across, along; scale: of depth errors at this distance; weight: of
    one sample. H (6, 6), g (6): by the twist of the object frame; Hy (6, y), Hyy, gy: by the unknowns y."""
    J, q, rad = np.empty(6), np.empty(3), np.empty(3)
    row, sigma, off = config[ROW], config[SIGMA_M] * scale, config[OFF_M] * scale
    for s in range(samples.shape[0]):
        p = samples[s]
        far = np.sqrt(p[PX] ** 2 + p[PY] ** 2 + p[PZ] ** 2)
        facing = -(p[PX] * p[SNX] + p[PY] * p[SNY] + p[PZ] * p[SNZ]) / far
        if facing < 0.3:
            continue
        x0, x1, x2 = p[PX] - pose[0, 3], p[PY] - pose[1, 3], p[PZ] - pose[2, 3]
        along, away_x, away_y, along_n, n_x, n_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for a in range(3):
            q[a] = pose[0, a] * x0 + pose[1, a] * x1 + pose[2, a] * x2
            n = pose[0, a] * p[SNX] + pose[1, a] * p[SNY] + pose[2, a] * p[SNZ]
            away_x += axes[0, a] * (q[a] - point[a])
            away_y += axes[1, a] * (q[a] - point[a])
            along += axes[2, a] * (q[a] - point[a])
            n_x += axes[0, a] * n
            n_y += axes[1, a] * n
            along_n += axes[2, a] * n
        radius = max(np.sqrt(away_x * away_x + away_y * away_y), 1e-6)
        cx, cy = away_x / radius, away_y / radius
        kind = _kind(along_n, n_x * cx + n_y * cy)
        if kind < 0:
            continue
        by_height = kind < TOP
        value, slope, j, t, known = _curve(
            y, seen, sizes, kind, (along - config[FIRST_HEIGHT]) / row if by_height else radius / row
        )
        if not known:
            continue
        slope = min(max(slope / row, -1.0), 1.0)
        shorter = 1.0 / np.sqrt(1.0 + slope * slope)
        e = ((radius if by_height else along) - value) * shorter
        if abs(e) > off:
            continue
        k = (1.0 - (e / off) ** 2) ** 2 * min(max((facing - 0.3) / 0.4, 0.05), 1.0) * weight / (sigma * sigma)
        for a in range(3):
            rad[a] = cx * axes[0, a] + cy * axes[1, a]
            J[a] = (rad[a] - slope * axes[2, a] if by_height else axes[2, a] - slope * rad[a]) * shorter
        J[3] = q[1] * J[2] - q[2] * J[1]
        J[4] = q[2] * J[0] - q[0] * J[2]
        J[5] = q[0] * J[1] - q[1] * J[0]
        one, two = -(1.0 - t) * shorter, -t * shorter
        for a in range(6):
            ja = k * J[a]
            g[a] += ja * e
            Hy[a, j] += ja * one
            Hy[a, j + 1] += ja * two
            for b in range(6):
                H[a, b] += ja * J[b]
        gy[j] += k * one * e
        gy[j + 1] += k * two * e
        Hyy[j, j] += k * one * one
        Hyy[j + 1, j + 1] += k * two * two
        Hyy[j, j + 1] += k * one * two
        Hyy[j + 1, j] += k * one * two


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def outline_points(pose, axes, point, y, seen, sizes, config, out):
    """Where the camera sees the body's surface end: rows of `out` are height, radius, angle, first node of the radius,
    share of the second, kind (0 the wall, 1 the low end, 2 the high end). Returns how many."""
    row, low, high, radius_bias = config[ROW], y[LOW], y[HIGH], y[RADIUS_BIAS]
    c = np.empty(3)
    for a in range(3):
        c[a] = -(pose[0, a] * pose[0, 3] + pose[1, a] * pose[1, 3] + pose[2, a] * pose[2, 3]) - point[a]
    cx, cy, ch = 0.0, 0.0, 0.0
    for a in range(3):
        cx += axes[0, a] * c[a]
        cy += axes[1, a] * c[a]
        ch += axes[2, a] * c[a]
    off_axis, towards = max(np.sqrt(cx * cx + cy * cy), 1e-6), np.arctan2(cy, cx)
    n = 0
    steps = max(int((high - low) / config[OUTLINE_STEP_PX]), 2)
    for s in range(steps):
        h = low + (s + 0.5) * (high - low) / steps
        r, slope, j, t, known = _curve(y, seen, sizes, OUTSIDE, (h - config[FIRST_HEIGHT]) / row)
        r += radius_bias
        # a normal across the ray: cos(angle) = (r - r' (h - h_camera)) / distance of the camera from the axis
        cosine = (r - min(max(slope / row, -1.0), 1.0) * (h - ch)) / off_axis
        if not known or abs(cosine) >= 1.0:
            continue
        for sign in (-1.0, 1.0):
            out[n, 0], out[n, 1], out[n, 2] = h, r, towards + sign * np.arccos(cosine)
            out[n, 3], out[n, 4], out[n, 5] = j, t, 0.0
            n += 1
    for end in range(2):
        h, sign = (low, -1.0) if end == 0 else (high, 1.0)
        r, slope, j, t, known = _curve(y, seen, sizes, OUTSIDE, (h - sign * INSET_M - config[FIRST_HEIGHT]) / row)
        r += radius_bias
        cap = sign * (ch - h) > 0.0
        for s in range(RING):
            angle = 2.0 * np.pi * s / RING
            if (off_axis * np.cos(angle - towards) - r > 0.0) != cap:  # of wall and cap the camera sees one
                out[n, 0], out[n, 1], out[n, 2] = h, r, angle
                out[n, 3], out[n, 4], out[n, 5] = j, t, end + 1.0
                n += 1
    return n


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _place(found, axes, point, pose, P, rad, X):
    """A point of the outline: in the object frame (P), its direction away from the axis (rad), in camera axes (X)."""
    for a in range(3):
        rad[a] = np.cos(found[2]) * axes[0, a] + np.sin(found[2]) * axes[1, a]
        P[a] = point[a] + found[0] * axes[2, a] + found[1] * rad[a]
    for a in range(3):
        X[a] = pose[a, 0] * P[0] + pose[a, 1] * P[1] + pose[a, 2] * P[2] + pose[a, 3]


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _rim(distance_px, off, w, h, u, v, out):
    """Distance to the mask's rim at (u, v) of a view and its slopes, into out[2:5]; False beyond the crop."""
    out[0], out[1] = u, v
    if not (u > 1 and v > 1 and u < w - 3 and v < h - 3):
        return False
    ju, jv = int(np.floor(u)), int(np.floor(v))
    a, b = u - ju, v - jv
    q = off + jv * w + ju
    s00, s10, s01, s11 = distance_px[q], distance_px[q + 1], distance_px[q + w], distance_px[q + w + 1]
    out[2] = (s00 * (1 - a) + s10 * a) * (1 - b) + (s01 * (1 - a) + s11 * a) * b
    out[3] = (s10 - s00) * (1 - b) + (s11 - s01) * b
    out[4] = (s01 - s00) * (1 - a) + (s11 - s10) * a
    return True


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _odd_points(rim, usable, config):
    """Marks as 2 the points where the outline is something else's or covered, as 1 those beside them, 0 the others."""
    n = len(rim)
    odd = np.zeros(n, np.int64)
    for s in range(n):
        if usable[s] and (rim[s, 2] < -config[INTO_PX] or rim[s, 2] > config[BEYOND_PX]):
            odd[s] = 2
    near = config[NEAR_PX] ** 2
    for s in range(n):
        for o in range(n):
            if odd[s] == 0 and odd[o] == 2 and (rim[o, 0] - rim[s, 0]) ** 2 + (rim[o, 1] - rim[s, 1]) ** 2 < near:
                odd[s] = 1
    return odd


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def outline_terms(
    distance_px, table, focal, center, pose, axes, point, y, seen, sizes, config, weight, H, g, Hy, Hyy, gy
):
    """Adds one view's outline. distance_px: how far all views' pixels lie from the mask's rim (negative inside; far
    where it may be covered). Returns how many points count, of how many, and their squared residuals' sum (px^2)."""
    found = np.empty((2 * max(int((y[HIGH] - y[LOW]) / config[OUTLINE_STEP_PX]), 2) + 2 * RING, 6))
    n = outline_points(pose, axes, point, y, seen, sizes, config, found)
    rim, usable = np.zeros((n, 5)), np.zeros(n, np.bool_)
    P, rad, X, J = np.empty(3), np.empty(3), np.empty(3), np.empty(6)
    for s in range(n):
        _place(found[s], axes, point, pose, P, rad, X)
        u, v = focal[0] * X[0] / X[2] + center[0] - table[U0], focal[1] * X[1] / X[2] + center[1] - table[V0]
        usable[s] = _rim(distance_px, table[OFFSET], table[WIDTH], table[HEIGHT], u, v, rim[s])
        rim[s, 2] -= y[BIAS]
    odd = _odd_points(rim, usable, config)
    count, total, ny = 0, 0.0, len(y)
    for s in range(n):
        if not usable[s] or odd[s] > 0:
            continue
        e = rim[s, 2]
        _place(found[s], axes, point, pose, P, rad, X)
        gu, gv = rim[s, 3] * focal[0] / X[2], rim[s, 4] * focal[1] / X[2]
        gz = -(gu * X[0] + gv * X[1]) / X[2]
        by_radius, by_height = 0.0, 0.0
        for a in range(3):
            J[a] = -(gu * pose[0, a] + gv * pose[1, a] + gz * pose[2, a])
            by_radius -= J[a] * rad[a]
            by_height -= J[a] * axes[2, a]
        J[3] = P[1] * J[2] - P[2] * J[1]
        J[4] = P[2] * J[0] - P[0] * J[2]
        J[5] = P[0] * J[1] - P[1] * J[0]
        k = weight / (1.0 + (e / (2.0 * config[SIGMA_PX])) ** 2) / config[SIGMA_PX] ** 2
        j, t, kind = int(found[s, 3]), found[s, 4], int(found[s, 5])
        places = (j, j + 1, ny + BIAS, ny + RADIUS_BIAS, ny + LOW if kind == 1 else ny + HIGH)
        parts = (by_radius * (1.0 - t), by_radius * t, -1.0, by_radius, by_height if kind > 0 else 0.0)
        for a in range(6):
            ja = k * J[a]
            g[a] += ja * e
            for b in range(6):
                H[a, b] += ja * J[b]
            for c in range(5):
                Hy[a, places[c]] += ja * parts[c]
        for c in range(5):
            gy[places[c]] += k * parts[c] * e
            for d in range(5):
                Hyy[places[c], places[d]] += k * parts[c] * parts[d]
        count += 1
        total += e * e
    return count, usable.sum(), total
