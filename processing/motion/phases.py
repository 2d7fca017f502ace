"""Phases of a toss from its track alone: in hand, flight, contact, rest.

The frames are cut into segments so that the sum of their misfits plus a cost per segment is least (dynamic
programming). A segment is ballistic (free position and velocity, gravity given, torque-free spin) or at rest (one
pose).
What neither fits falls apart into single frames: contact, or a hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.motion.thresholds import LEAST_REST_SIGMA_M, LEAST_REST_SIGMA_RAD
from processing.motion.trajectory import PoseSeries, differences, rotation_vectors
from recordings.constants import GRAVITY_M_S2, MAD_TO_SIGMA

SEGMENT_COST = 30.0
"""Misfit (chi squared) that one more segment must save."""
FLIGHT_FRAMES = 3
"""A shorter ballistic segment proves nothing."""
REST_FRAMES = 4
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 5e-5, 1e-3
"""No track is better than this over a flight (drag, sampling, an inertia that is a guess)."""


@dataclass(frozen=True)
class Noise:
    """Standard deviation of one coordinate of a pose, white from frame to frame."""

    position_m: float
    rotation_rad: float


@dataclass(frozen=True)
class Segment:
    """Frames `first` to `last`, both included."""

    kind: str
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Phases:
    """`release` is the first frame of flight, `first_impact` the first frame after it that flight does not explain,
    `rest` the first frame of the rest at the end; None where there is none. `in_flight` and `at_rest` are per frame."""

    segments: tuple[Segment, ...]
    release: int | None
    first_impact: int | None
    rest: int | None
    in_flight: Bool[Array, " n"]
    at_rest: Bool[Array, " n"]


def pose_noise(series: PoseSeries) -> Noise:
    """From second differences: they vanish horizontally, and for the spin, in flight and at rest. Robust to contact.

    The variance of a second difference of white noise is 6 times the noise's.
    """
    states = differences(series)
    dt = np.diff(series.time_s)[:, None]
    sideways = np.diff(states.velocity_world_m_s[1:, :2], axis=0) * dt[1:]
    turning = np.diff(states.spin_object_rad_s[1:], axis=0) * dt[1:]
    if len(sideways) < 3:
        return Noise(LEAST_SIGMA_M, LEAST_SIGMA_RAD)
    position, rotation = (MAD_TO_SIGMA * float(np.median(np.abs(x))) / 6**0.5 for x in (sideways, turning))
    return Noise(max(position, LEAST_SIGMA_M), max(rotation, LEAST_SIGMA_RAD))


def _line_misfit(t: Float[Array, " n"], y: Float[Array, "n d"], order: int) -> Float[Array, "n n"]:
    """Least sum of squares of y about a constant (order 0) or a line (order 1) over frames i..j, for all i <= j."""

    def sums(values: Float[Array, " n"]) -> Float[Array, "n n"]:
        total = np.concatenate([[0.0], np.cumsum(values)])
        return total[None, 1:] - total[:-1, None]

    count = np.maximum(sums(np.ones(len(t))), 1.0)
    st, stt = sums(t), sums(t * t)
    spread_t = np.maximum(stt - st * st / count, 1e-18)
    misfit = np.zeros((len(t), len(t)))
    for column in (y - y.mean(0)).T:
        sy, syy, sty = sums(column), sums(column * column), sums(t * column)
        misfit += syy - sy * sy / count
        if order:
            misfit -= (sty - st * sy / count) ** 2 / spread_t
    return np.maximum(misfit, 0.0)


def _flight_misfit(series: PoseSeries, inertia: Float[Array, "3 3"], noise: Noise) -> Float[Array, "n n"]:
    t = series.time_s
    lifted = series.position_m + 0.5 * GRAVITY_M_S2 * (t * t)[:, None] * [0.0, 0.0, 1.0]
    misfit = _line_misfit(t, lifted, 1) / noise.position_m**2
    torque = spin_residual(series, inertia)  # of the frames k - 1, k, k + 1
    dt = np.diff(t)
    each = (torque**2).sum(1) / (6 * noise.rotation_rad**2 / dt[1:] ** 2)
    total = np.concatenate([[0.0, 0.0], np.cumsum(each)])
    return misfit + np.maximum(total[None, :] - total[np.minimum(np.arange(len(t)) + 1, len(t) - 1)][:, None], 0.0)


def spin_residual(series: PoseSeries, inertia: Float[Array, "3 3"]) -> Float[Array, "m 3"]:
    """w[k+1] - w[k] + dt I^-1 (w x I w), in object axes, for every three frames: zero where no torque acts."""
    return np.diff(differences(series).spin_object_rad_s[1:], axis=0) - torque_free_change(series, inertia)


def torque_free_change(series: PoseSeries, inertia: Float[Array, "3 3"]) -> Float[Array, "m 3"]:
    """-dt I^-1 (w x I w), in rad/s and object axes, for every three frames: how a free body's spin w changes."""
    spin = differences(series).spin_object_rad_s[1:]
    middle = 0.5 * (spin[1:] + spin[:-1])
    free = -np.linalg.solve(inertia, np.cross(middle, middle @ inertia).T).T
    return np.diff(series.time_s)[1:, None] * free


def _rest_misfit(series: PoseSeries, noise: Noise) -> Float[Array, "n n"]:
    turned = rotation_vectors(series.rotation[-1].T @ series.rotation)
    position = _line_misfit(series.time_s, series.position_m, 0) / max(noise.position_m, LEAST_REST_SIGMA_M) ** 2
    return position + _line_misfit(series.time_s, turned, 0) / max(noise.rotation_rad, LEAST_REST_SIGMA_RAD) ** 2


def find_phases(series: PoseSeries, inertia: Float[Array, "3 3"], noise: Noise | None = None) -> Phases:
    """Cut a toss into its phases. The series is of the centre of mass, in a world with z up."""
    noise = pose_noise(series) if noise is None else noise
    n = len(series)
    costs = {"flight": _flight_misfit(series, inertia, noise), "rest": _rest_misfit(series, noise)}
    for kind, least in (("flight", 1), ("rest", REST_FRAMES)):
        i, j = np.tril_indices(n, 0)
        costs[kind][i, j] = np.where(i == j, costs[kind][i, j], np.inf)
        if least > 1:
            lengths = np.arange(n)[None] - np.arange(n)[:, None] + 1
            costs[kind][lengths < least] = np.inf
    segments = _cheapest(costs)
    in_flight, at_rest = np.zeros(n, dtype=bool), np.zeros(n, dtype=bool)
    for s in segments:
        if s.kind == "rest":
            at_rest[s.first : s.last + 1] = True
        elif s.last - s.first + 1 >= FLIGHT_FRAMES:
            in_flight[s.first : s.last + 1] = True
    flights = [s for s in segments if in_flight[s.first]]
    release = flights[0].first if flights else None
    impact = flights[0].last + 1 if flights and flights[0].last + 1 < n else None
    rest = segments[-1].first if segments[-1].kind == "rest" else None
    return Phases(tuple(segments), release, impact, rest, in_flight, at_rest)


def _cheapest(costs: dict[str, Float[Array, "n n"]]) -> list[Segment]:
    """The cut with the least total cost, one cost per segment."""
    kinds = list(costs)
    n = len(next(iter(costs.values())))
    best = np.concatenate([[0.0], np.full(n, np.inf)])
    back: list[tuple[int, str]] = [(0, "")] * (n + 1)
    for j in range(n):
        for kind in kinds:
            total = best[: j + 1] + costs[kind][: j + 1, j] + SEGMENT_COST
            i = int(total.argmin())
            if total[i] < best[j + 1]:
                best[j + 1], back[j + 1] = total[i], (i, kind)
    segments: list[Segment] = []
    end = n
    while end > 0:
        first, kind = back[end]
        segments.append(Segment(kind, first, end - 1))
        end = first
    return segments[::-1]
