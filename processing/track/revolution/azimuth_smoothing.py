"""The azimuths of all views at once, off the grid: where the images leave an azimuth open, the motion fixes it.

A round body's spin about its axis is constant in free flight (Euler's equations with two equal moments of inertia), so
that what is seen before and after a stretch in which nothing shows the azimuth fixes that stretch too. On the table it
rolls (rolling.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion.thresholds import AZIMUTH_FLIGHT_M_S, CARRIED_AXIS_M, CARRIED_AXIS_RAD
from processing.track.beam import Scene
from processing.track.revolution.rolling import ExpectedSteps, Grounded, RollConfig, rolled
from recordings.geometry import rotation_log

STARTING = 0.6
"""A start from rest changes the spin over its first step by half of what the same acceleration does later."""
Terms = list[tuple[int, float, Float[Array, " v"]]]
"""View, change of spin there (rad/s), its derivative by all views' azimuths."""
Normal = tuple[Float[Array, "v v"], Float[Array, " v"]]


@dataclass(frozen=True)
class SteadyConfig:
    """How much the spin about the axis changes from view to view (rad/s)."""

    flight_rad_s: float = 0.3
    other_rad_s: float = 1.5
    """In a hand, on the table (Cauchy)."""
    fast_rad_s: float = 34.6
    """At a release and an impact, up to this: 66 degrees a frame at 30 Hz, beyond which hardly anything seen in one
    frame is seen in the next (`FlightConfig.most_turn_deg`)."""
    steps: int = 40
    tails: float = 3.0
    """Those changes have heavy tails: azimuths err by this times what the usual ones make (28 simulated tosses)."""
    most: float = 4.0
    """Cells that a view turns by in one step."""
    flight_weight: float = 4.0
    """Weight of a change of spin in free flight, against one elsewhere."""
    flight_m_s: float = AZIMUTH_FLIGHT_M_S
    """A change of velocity, beyond gravity's, below this is free flight."""
    roll: RollConfig = field(default_factory=RollConfig)
    held_rad: float = CARRIED_AXIS_RAD
    held_m: float = CARRIED_AXIS_M
    """From view to view, an axis that moves as the robot's hand does within these is carried ..."""
    carried_rad: float = 0.004
    """... and turns in it by no more than this (standard deviation)."""


@dataclass(frozen=True, eq=False)
class Pace:
    """Between views: turn about the axis so far (v-1) and seconds, and the turns that rolling on the table or a hand
    lets expect; of views: whether it stands for frames without motion, whether it flies or is where a flight begins or
    ends, and the weight of a change of spin there."""

    base_rad: Float[Array, " r"]
    steps_s: Float[Array, " r"]
    still: Bool[Array, " v"]
    flies: Bool[Array, " v"]
    meets: Bool[Array, " v"]
    spin_weight: Float[Array, " v"]
    expected: ExpectedSteps


def pace_of(
    scene: Scene, poses: Float[Array, "n 4 4"], runs: list[list[int]], views: Int[Array, " v"], body: Grounded,
    config: SteadyConfig,
) -> Pace:  # fmt: skip
    """How the body turns about its axis from view to view, and where it flies freely or rolls; `runs`: the frames that
    each view stands for."""
    t, axis = scene.times_s, body.axis
    # what stands still turns between its last frame and the next one's first
    steps_s = np.array([t[b[0]] - t[a[-1]] for a, b in zip(runs, runs[1:])])
    base = np.array([float(rotation_log(poses[b][:3, :3].T @ poses[a][:3, :3]) @ axis.direction)
                     for a, b in zip(views, views[1:])])  # fmt: skip
    still = np.array([len(run) > 1 for run in runs])
    flies = np.zeros(len(runs), dtype=bool)
    center = axis.point_m + axis.direction * float(axis.direction @ scene.center_m)
    for n in range(1, len(runs) - 1):
        x = [poses[i][:3, :3] @ center + poses[i][:3, 3] for i in views[n - 1 : n + 2]]
        change = (x[2] - x[1]) / steps_s[n] - (x[1] - x[0]) / steps_s[n - 1]
        change = change - 0.5 * (steps_s[n] + steps_s[n - 1]) * scene.gravity_camera_m_s2
        flies[n] = not still[n] and np.linalg.norm(change) < config.flight_m_s
    beside = np.pad(flies, 1)
    meets = ~flies & ~still & (beside[:-2] | beside[2:])
    spin_weight = np.where(flies, config.flight_weight, 1.0)
    expected = _carried(scene, views, body, rolled(body, steps_s, config.roll), config)
    return Pace(base, steps_s, still, flies, meets, spin_weight, expected)


def _carried(
    scene: Scene, views: Int[Array, " v"], body: Grounded, expected: ExpectedSteps, config: SteadyConfig
) -> ExpectedSteps:
    """With the turns of what the robot's hand carries: where the axis moves as the hand does."""
    turn, sigma = expected.step_rad.copy(), expected.sigma_rad.copy()
    center = body.axis.point_m + body.rings[:, 0].mean() * body.axis.direction
    for n, (a, b) in enumerate(pairwise(views)):
        if (moved := scene.carried(int(a), int(b))) is None:
            continue
        pose = moved @ body.poses[n]
        off = (pose - body.poses[n + 1])[:3]
        if np.linalg.norm(off[:, :3] @ body.axis.direction) > config.held_rad:
            continue
        if np.linalg.norm(off[:, :3] @ center + off[:, 3]) < config.held_m:
            turn[n] = rotation_log(pose[:3, :3].T @ body.poses[n, :3, :3]) @ body.axis.direction
            sigma[n] = config.carried_rad
    return ExpectedSteps(turn, sigma)


def steadied(
    costs: Float[Array, "m d"], pairs: Int[Array, "m 2"], standing: Normal, pace: Pace, cell_rad: float, first: int,
    config: SteadyConfig,
) -> tuple[Float[Array, " v"], Float[Array, " v"]]:  # fmt: skip
    """Angles to add to each view's azimuth, and their standard deviations (rad); view `first` stays.

    costs: of each pair by the difference of its views' angles, in cells around 0 (d odd); `standing`: normal equations
    of the same angles at 0 (`standing_terms`). Gauss-Newton with each curve's own slope and (if any) upward bend."""
    reach = costs.shape[1] // 2
    wide = np.pad(costs, ((0, 0), (2, 2)), mode="edge")
    smooth = sum(w * wide[:, s : s + costs.shape[1]] for s, w in enumerate((0.1, 0.2, 0.4, 0.2, 0.1)))
    angle = np.zeros(len(pace.still))
    H = np.eye(len(angle))
    for _ in range(config.steps):
        H, g = _of_pairs(np.asarray(smooth), pairs, angle / cell_rad, reach, cell_rad)
        H, g = H + standing[0], g + standing[1] + standing[0] @ angle
        for view, change, slope in _changes(angle, pace):
            usual = config.flight_rad_s if pace.flies[view] else config.other_rad_s
            usual = config.fast_rad_s if pace.meets[view] else usual * (STARTING if pace.still[view] else 1.0)
            weight = pace.spin_weight[view] / (1 + (change / (2 * usual)) ** 2) / usual**2
            g += weight * change * slope
            H += weight * np.outer(slope, slope)
        _add_expected(H, g, angle, pace)
        g[first], H[first], H[:, first] = 0.0, 0.0, 0.0
        H[first, first] = 1e9
        step = -np.linalg.solve(H + 1e-7 * np.diag(np.diag(H)) + 1e-6 * np.eye(len(H)), g)
        largest = float(np.abs(step).max())
        angle = angle + step / max(largest / (config.most * cell_rad), 1.0)
        if largest < 2e-3:
            break
    spread = np.sqrt(np.maximum(np.diag(np.linalg.inv(H + 1e-6 * np.eye(len(H)))), 0.0))
    spread[first] = 0.0
    return angle, config.tails * np.asarray(spread)


def _of_pairs(
    costs: Float[Array, "m d"], pairs: Int[Array, "m 2"], cells: Float[Array, " v"], reach: int, cell_rad: float
) -> tuple[Float[Array, "v v"], Float[Array, " v"]]:
    """Normal equations of the pairs' costs at these angles (in cells)."""
    i, j = pairs.T
    between = cells[i] - cells[j]
    at = np.clip(np.round(between).astype(int), 1 - reach, reach - 1) + reach
    m = np.arange(len(pairs))
    before, here, after = costs[m, at - 1], costs[m, at], costs[m, at + 1]
    slope = 0.5 * (after - before)
    bend = np.maximum(after - 2 * here + before, 0.0) + 0.02 * np.abs(slope)
    pull = (slope + bend * np.clip(between - (at - reach), -1, 1)) / cell_rad
    stiff = bend / cell_rad**2
    H, g = np.zeros((len(cells), len(cells))), np.zeros(len(cells))
    np.add.at(g, i, pull)
    np.add.at(g, j, -pull)
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(H, (a, b), sign * stiff)
    return H, g


def _add_expected(H: Float[Array, "v v"], g: Float[Array, " v"], angle: Float[Array, " v"], pace: Pace) -> None:
    """Adds to the normal equations the turns from view to view that are expected."""
    off = pace.base_rad - np.diff(angle) - pace.expected.step_rad
    weight = 1 / (pace.expected.sigma_rad**2 + (off / 2) ** 2)
    before = np.arange(len(off))
    np.add.at(g, before, weight * off)
    np.add.at(g, before + 1, -weight * off)
    for a, b, sign in ((0, 0, 1), (1, 1, 1), (0, 1, -1), (1, 0, -1)):
        np.add.at(H, (before + a, before + b), sign * weight)


def _changes(angle: Float[Array, " v"], pace: Pace) -> Terms:
    """All changes of spin: between the steps before and after a view, and to and from standing still."""
    rates = (pace.base_rad - np.diff(angle)) / pace.steps_s
    v = len(angle)
    slopes = np.zeros((v - 1, v))
    slopes[np.arange(v - 1), np.arange(v - 1)] = 1 / pace.steps_s
    slopes[np.arange(v - 1), np.arange(1, v)] = -1 / pace.steps_s
    out: Terms = []
    for t in range(v):
        before = (float(rates[t - 1]), slopes[t - 1]) if t > 0 else None
        after = (float(rates[t]), slopes[t]) if t < v - 1 else None
        if pace.still[t]:
            out += [(t, s[0], s[1]) for s in (before, after) if s is not None]
        elif before is not None and after is not None:
            out.append((t, after[0] - before[0], after[1] - before[1]))
    return out
