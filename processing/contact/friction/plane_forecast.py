"""How high the plane is where frames are far apart: the height at which a box of the fitting size is forecast best.

At camera rates no frame shows what the plane carries (touch.py needs 100 Hz), but the trajectories show what happens
between frames: of two boxes that rest at the same height, the one that is larger by as much as its plane is lower
strikes with its corners sooner. So the box is kept at its resting height while plane and size are moved together, and
forecasts (forecast.py) under the law that was found are scored. Rounded edges read as in touch.py: higher by the
radius.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.friction.estimate import noise_of, observed_trajectories
from processing.contact.friction.forecast import Forecasts, Law, RigidBody
from processing.contact.learn.data_checks import lowest_point_m
from processing.contact.learn.touch import TouchedPlane
from processing.motion.smoother import Smoothed
from processing.motion.trajectory import PoseSeries

HEIGHTS_M = 0.003 * np.arange(-4, 5)
LEAST_HALF_M = 0.005
REPEATS = 200
MODEL_STD_M = 0.0025
"""What stays with any number of tosses: readings of six simulated bodies and two real groups are that far off where
their own spread is small (tools/bench_plane.py forecast)."""


def plane_by_forecasts(
    box: RigidBody, tracks: Sequence[PoseSeries], smoothed: Sequence[Smoothed], law: Law, seed: int = 0
) -> TouchedPlane | None:
    """The plane of a box (corners about the centre of mass) by its tosses. None where nothing rests."""
    resting = [lowest_point_m(t, box.points_m, s.phases) for t, s in zip(tracks, smoothed)]
    heights = [h for h in resting if h is not None]
    trajectories = observed_trajectories(tracks, smoothed)
    if not heights or len(trajectories) < 2:
        return None
    noise, rest_m, energies = noise_of(smoothed), float(np.median(heights)), []
    for height_m in HEIGHTS_M:
        lowered = [replace(c, position_m=c.position_m - [0.0, 0.0, height_m]) for c in trajectories]
        body = replace(box, points_m=_larger(box.points_m, rest_m - float(height_m)))
        energies.append(Forecasts(lowered, body, noise, box.reach_m).energies([law]))
    scale_m = np.maximum(np.mean([off[0] for _, off in energies], axis=0), noise.position_m)
    scores = np.array([(energy[0] / scale_m).sum(1) for energy, _ in energies])
    rng, n = np.random.default_rng(seed), scores.shape[1]
    drawn = rng.multinomial(n, np.full(n, 1 / n), REPEATS)
    spread = float(np.std([lowest(HEIGHTS_M, scores @ counts) for counts in drawn], ddof=1))
    std_m = float(np.hypot(spread * (n / (n - 1)) ** 0.5, MODEL_STD_M))
    return TouchedPlane(lowest(HEIGHTS_M, scores.sum(1)), std_m, float(n))


def lowest(x: Float[Array, " f"], y: Float[Array, " f"]) -> float:
    """Where a curve on an even grid is lowest: the parabola through the least entry and its neighbours."""
    i = int(np.clip(y.argmin(), 1, len(y) - 2))
    before, here, after = y[i - 1 : i + 2]
    bend = before + after - 2 * here
    if bend <= 0:
        return float(x[y.argmin()])
    return float(x[i] + (x[i + 1] - x[i]) * np.clip(0.5 * (before - after) / bend, -1, 1))


def _larger(corners_m: Float[Array, "8 3"], by_m: float) -> Float[Array, "8 3"]:
    """The box with every face moved outwards."""
    center = corners_m.mean(0)
    half = corners_m - center
    return center + np.sign(half) * np.maximum(np.abs(half) + by_m, LEAST_HALF_M)
