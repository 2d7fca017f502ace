"""Compiled: one parabola and one spin fitted to all pairs of a flight's views, for many starts."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.motion.twist_terms import add_by_others
from processing.track.kernels import STEPS, graph_terms

UNKNOWNS = 9
"""Of a flight: the centre's place (m) and velocity (m/s) at time zero, and its spin (rad/s); camera axes."""
PLACE, VELOCITY, SPIN = 0, 3, 6
SURE_COST = 0.15
"""A pair that fits worse counts less: one of its views may not be of the flight."""


@no_type_check
@njit(cache=True, nogil=True)
def fit_flights(starts, pairs, tau, gravity, maps, samples, table, focal, center, schedule, turn_share):
    """Gauss-Newton from each start (c, UNKNOWNS); returns solutions and the mean cost of their pairs.

    pairs (m, 2): views compared; tau (n): time of each view, s. The object frame's origin is the centre of mass.
    """
    found, costs = starts.copy(), np.empty(len(starts))
    used = np.unique(pairs)
    poses, J = np.zeros((len(tau), 4, 4)), np.zeros((len(tau), 6, UNKNOWNS))
    blocks, gradients = np.zeros((len(pairs), 6, 6)), np.zeros((len(pairs), 6))
    figures = np.zeros((len(pairs), 3))
    none = np.empty((0, 0, 0))
    for c in range(len(starts)):
        x = found[c]
        for level in range(schedule.shape[0]):
            row = schedule[level]
            for _ in range(int(row[STEPS])):
                for i in used:
                    _place(x, tau[i], gravity, poses[i], J[i])
                graph_terms(poses, pairs, maps, samples, table, focal, center, row, turn_share, False, blocks,
                            gradients, none, none, figures)  # fmt: skip
                H, g = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
                for m in range(len(pairs)):
                    sure = 1.0 / (1.0 + (figures[m, 0] / SURE_COST) ** 2)
                    by_unknowns = J[pairs[m, 0]] - J[pairs[m, 1]]
                    add_by_others(blocks[m], gradients[m], by_unknowns, sure, sure, H, g)
                for a in range(UNKNOWNS):
                    H[a, a] += 1e-4 * H[a, a] + 1e-9
                step = -np.linalg.solve(H, g)
                turn, shift = np.sqrt((step[SPIN:] ** 2).sum()), np.sqrt((step[:VELOCITY] ** 2).sum())
                scale = min(1.0, min(3.0 / max(turn, 1e-12), 0.02 / max(shift, 1e-12)))
                x += scale * step
                if turn < 0.02 and shift < 1e-4:
                    break
        for i in used:
            _place(x, tau[i], gravity, poses[i], J[i])
        graph_terms(poses, pairs, maps, samples, table, focal, center, schedule[schedule.shape[0] - 1], turn_share,
                    False, blocks, gradients, none, none, figures)  # fmt: skip
        costs[c] = figures[:, 0].mean()
    return found, costs


@no_type_check
@njit(cache=True, nogil=True)
def _place(x, t, gravity, pose, J):
    """Writes the pose at time t, and what the unknowns do to it: twists of the object frame, by each unknown."""
    R, left = _turned(x[SPIN:] * t)
    pose[:] = 0.0
    pose[3, 3] = 1.0
    J[:] = 0.0
    spin = -t * (np.ascontiguousarray(R.T) @ left)
    for a in range(3):
        pose[a, 3] = x[PLACE + a] + x[VELOCITY + a] * t + 0.5 * gravity[a] * t * t
        for b in range(3):
            pose[a, b] = R[a, b]
            J[a, PLACE + b] = -R[b, a]
            J[a, VELOCITY + b] = -t * R[b, a]
            J[3 + a, SPIN + b] = spin[a, b]


@no_type_check
@njit(cache=True, nogil=True)
def _turned(turn):
    """Rotation matrix of a rotation vector, and its left Jacobian."""
    angle = np.sqrt((turn**2).sum())
    small = angle < 1e-4
    sine = 1.0 - angle**2 / 6.0 if small else np.sin(angle) / angle
    half = 0.5 - angle**2 / 24.0 if small else (1.0 - np.cos(angle)) / angle**2
    rest = 1.0 / 6.0 - angle**2 / 120.0 if small else (angle - np.sin(angle)) / angle**3
    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -turn[2], turn[1], -turn[0]
    K[1, 0], K[2, 0], K[2, 1] = turn[2], -turn[1], turn[0]
    KK = K @ K
    return np.eye(3) + sine * K + half * KK, np.eye(3) + half * K + rest * KK
