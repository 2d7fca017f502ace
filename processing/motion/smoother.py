"""A smoother on SE(3) that is ballistic between contacts and lets go where something touches.

The most probable poses given white pose noise and a velocity that changes as free flight says, up to a small
disturbance:

    min  sum |p_k - p^_k|^2 / s_p^2 + sum |v_{k+1} - v_k - dt g|^2 / s_k^2,     v_{k+1} = (p_{k+1} - p_k) / dt

and likewise for rotations on SO(3) with torque-free spin. s_k is small where two velocities belong to one flight (or to
one rest, where the change is zero) and very large everywhere else, so nothing is smoothed across an impact: with an
impact
between frames j and j+1 the velocities of j, j+1 and j+2 are independent of each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from scipy import sparse
from scipy.linalg import cho_solve_banded, cholesky_banded

from processing.motion.phases import Noise, Phases, find_phases, pose_noise, torque_free_change
from processing.motion.trajectory import (
    PoseSeries,
    States,
    differences,
    rotation_matrices,
    rotation_vectors,
)
from recordings.constants import GRAVITY_M_S2
from recordings.estimation.levenberg_marquardt import Expansion, minimised

FLIGHT_CHANGE_M_S, FLIGHT_CHANGE_RAD_S = 0.004, 0.05
"""What free flight may leave unexplained in the velocities of neighbouring frames (drag, an inertia that is a
guess)."""
TOUCH_CHANGE_M_S, TOUCH_CHANGE_RAD_S = 20.0, 400.0
"""Where something touches: nothing is assumed."""
STEPS, LEAST_GAIN = 8, 1e-10


@dataclass(frozen=True, eq=False)
class Smoothed:
    """States with covariance, the phases they were smoothed in, and the noise that was assumed."""

    states: States
    phases: Phases
    noise: Noise


def smooth(series: PoseSeries, inertia: Float[Array, "3 3"], noise: Noise | None = None) -> Smoothed:
    """Smooth one toss (poses of the centre of mass in a world with z up). Noise and phases come from the track
    itself."""
    noise = pose_noise(series) if noise is None else noise
    phases = find_phases(series, inertia, noise)
    flying, resting = _joined(phases, "flight", len(series)), _joined(phases, "rest", len(series))
    position, position_cov, velocity_cov = _smooth_position(series, noise, flying, resting)
    rotation, rotation_cov, spin_cov = _smooth_rotation(series, inertia, noise, flying, resting)
    clean = differences(PoseSeries(series.toss, series.time_s, rotation, position))
    covariance = np.zeros((len(series), 12, 12))
    for place, block in zip(range(0, 12, 3), (rotation_cov, position_cov, spin_cov, velocity_cov)):
        covariance[:, place : place + 3, place : place + 3] = block
    states = States(
        series.toss,
        series.time_s,
        rotation,
        position,
        clean.spin_object_rad_s,
        clean.velocity_world_m_s,
        covariance,
    )
    return Smoothed(states, phases, noise)


def _joined(phases: Phases, kind: str, n: int) -> Bool[Array, " m"]:
    """For every three frames k, k+1, k+2: do they belong to one segment of this kind?"""
    inside = np.zeros(max(n - 2, 0), dtype=bool)
    for s in phases.segments:
        if s.kind == kind:
            inside[s.first : max(s.last - 1, s.first)] = True
    return inside


def _second_difference(time_s: Float[Array, " n"]) -> sparse.csr_array:
    """The matrix (n - 2, n) that takes positions to changes of velocity: v_{k+2} - v_{k+1}."""
    n, dt = len(time_s), np.diff(time_s)
    bands = [1 / dt[:-1], -(1 / dt[:-1] + 1 / dt[1:]), 1 / dt[1:]]
    return sparse.csr_array(sparse.diags_array(bands, offsets=[0, 1, 2], shape=(n - 2, n)))


def _factor(information: sparse.sparray, width: int) -> Float[Array, "b n"]:
    """The Cholesky factor of a matrix with `width` diagonals on either side, in LAPACK's lower banded form.

    Dense algebra on matrices of this size lets BLAS start threads that cost more CPU than they save.
    """
    n = information.shape[0]
    bands = np.zeros((width + 1, n))
    for k in range(width + 1):
        bands[k, : n - k] = information.diagonal(-k)
    return np.asarray(cholesky_banded(bands, lower=True))


def _banded(information: sparse.sparray, right: Float[Array, " d"], damping: float) -> Float[Array, " d"]:
    damped = information + sparse.diags_array(damping * information.diagonal())
    return np.asarray(cho_solve_banded((_factor(damped, 8), True), right))


def _smooth_position(
    series: PoseSeries, noise: Noise, flying: Bool[Array, " m"], resting: Bool[Array, " m"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"], Float[Array, "n 3 3"]]:
    D = _second_difference(series.time_s)
    sigma = np.where(flying | resting, FLIGHT_CHANGE_M_S, TOUCH_CHANGE_M_S)
    wanted = np.zeros((len(series) - 2, 3))
    wanted[:, 2] = np.where(flying, -GRAVITY_M_S2 * np.diff(series.time_s)[1:], 0.0)
    W = sparse.diags_array(1 / sigma**2) @ D
    information = sparse.eye_array(len(series)) / noise.position_m**2 + D.T @ W
    factor = _factor(information, 2)
    covariance = cho_solve_banded((factor, True), np.eye(len(series)))
    position = cho_solve_banded((factor, True), series.position_m / noise.position_m**2 + W.T @ wanted)
    variance = np.diagonal(covariance)
    speed = _speed_variance(series.time_s, variance, np.diagonal(covariance, 1))
    return position, variance[:, None, None] * np.eye(3), speed[:, None, None] * np.eye(3)


def _speed_variance(
    time_s: Float[Array, " n"], variance: Float[Array, " n"], neighbour: Float[Array, " m"]
) -> Float[Array, " n"]:
    speed = (variance[1:] + variance[:-1] - 2 * neighbour) / np.diff(time_s) ** 2
    return np.concatenate([speed[:1], speed])


def _smooth_rotation(
    series: PoseSeries,
    inertia: Float[Array, "3 3"],
    noise: Noise,
    flying: Bool[Array, " m"],
    resting: Bool[Array, " m"],
) -> tuple[Float[Array, "n 3 3"], Float[Array, "n 3 3"], Float[Array, "n 3 3"]]:
    """Least squares over R_k exp(d_k). The change of spin is taken as linear in d with the turns between frames as they
    are (transported to the middle frame), which further steps correct."""
    n, dt = len(series), np.diff(series.time_s)
    sigma = np.repeat(np.where(flying | resting, FLIGHT_CHANGE_RAD_S, TOUCH_CHANGE_RAD_S), 3)

    def expanded(rotation: Float[Array, "n 3 3"]) -> Expansion:
        here = PoseSeries(series.toss, series.time_s, rotation, series.position_m)
        J = _spin_jacobian(rotation, dt)
        change = np.where(flying[:, None], torque_free_change(here, inertia), 0.0)
        residual = (np.diff(differences(here).spin_object_rad_s[1:], axis=0) - change).ravel() / sigma
        W = sparse.diags_array(1 / sigma) @ J
        moved = rotation_vectors(np.swapaxes(series.rotation, 1, 2) @ rotation).ravel() / noise.rotation_rad
        information = sparse.eye_array(3 * n) / noise.rotation_rad**2 + W.T @ W
        cost = 0.5 * float(moved @ moved + residual @ residual)
        return Expansion(cost, information, moved / noise.rotation_rad + W.T @ residual)

    def moved(rotation: Float[Array, "n 3 3"], step: Float[Array, " d"]) -> Float[Array, "n 3 3"]:
        return rotation @ rotation_matrices(step.reshape(n, 3))

    found = minimised(series.rotation, expanded, moved, STEPS, LEAST_GAIN, _banded)
    rotation, factor = found.state, _factor(found.at.information, 8)
    inverse = cho_solve_banded((factor, True), np.eye(3 * n))
    covariance = inverse.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
    k = np.arange(n - 1)
    own, later, cross = covariance[k, k], covariance[k + 1, k + 1], covariance[k, k + 1]
    turn = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    carried = np.swapaxes(turn, 1, 2) @ cross
    spin = (np.swapaxes(turn, 1, 2) @ own @ turn + later - carried - np.swapaxes(carried, 1, 2)) / dt[
        :, None, None
    ] ** 2
    return rotation, covariance[np.arange(n), np.arange(n)], np.concatenate([spin[:1], spin])


def _spin_jacobian(rotation: Float[Array, "n 3 3"], dt: Float[Array, " m"]) -> sparse.csr_array:
    """d(w_{k+2} - w_{k+1}) / d(d_k, d_{k+1}, d_{k+2}): w = log(R_k' R_{k+1}) / dt moves by Jr^-1 d_{k+1} - Jl^-1
    d_k."""
    n = len(rotation)
    turn = rotation_vectors(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:])
    right = _right_jacobian_inverse(turn) / dt[:, None, None]
    left = np.swapaxes(right, 1, 2)
    k = np.arange(n - 2)
    blocks = np.stack([left[:-1], -right[:-1] - left[1:], right[1:]], 1).reshape(-1, 3, 3)
    columns = np.stack([k, k + 1, k + 2], 1).ravel()
    ends = 3 * np.arange(n - 1)
    return sparse.csr_array(sparse.bsr_array((blocks, columns, ends), shape=(3 * (n - 2), 3 * n)))


def _right_jacobian_inverse(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Jr^-1(v) = 1 + [v]/2 + (1 - |v|/2 cot(|v|/2)) / |v|^2 [v]^2."""
    angle = np.linalg.norm(vectors, axis=1)
    safe = np.maximum(angle, 1e-6)
    factor = np.where(angle > 1e-3, (1 - 0.5 * safe / np.tan(0.5 * safe)) / safe**2, 1 / 12)
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    K = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).reshape(-1, 3, 3)
    return np.eye(3) + 0.5 * K + factor[:, None, None] * (K @ K)
