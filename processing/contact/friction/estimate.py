"""Friction where frames are far apart: the one under which tosses are forecast best (forecast.py).

At 30 Hz a transition spans several contacts: the slip at its end says little about the slip within, the dissipation
term then prefers too little friction (without any noise: .15 for .25), and pose noise too much. So there the loss
gives the shape, and friction is found with the rebound, which would be taken for less friction otherwise, and with
what both leave unexplained. No weight and no horizon is chosen.

On 16 simulated bodies of other contact laws the estimate from ten tosses is .95 of the truth (rms of the ratio's
error .07, from four tosses .12): .99 where nothing rebounds, .89 where it rebounds most. With Anitescu's relaxation
instead of Coulomb's law (steps_cpu.py) these were .91 (.13, .16), .97 and .80: what slides was lifted by every impact.

Tried instead: single rollouts over .15 or .3 s (the span decides the result, and they know no rebound: .73 of the truth
on those bodies, down to .33); the likelihood of each frame given those before it (.97 +- .11 in simulation, but .20 on
real cubes, whose rollouts then slide too short: 17 to 22 mm); scores in metres instead of shares (.69 on one body).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.special import stdtrit

from processing.contact.friction.forecast import Forecasts, Law, ObservedTrajectory, RigidBody
from processing.motion.phases import Noise
from processing.motion.smoother import Smoothed
from processing.motion.trajectory import PoseSeries

SLOW_S = 0.01
"""Frames further apart than this are too far apart for the loss to tell friction."""
ENOUGH_TOSSES, MOST_TOSSES = 3, 16
"""From so many tosses on they say themselves how far the estimate may be off; more than MOST_TOSSES are thinned out."""
FEW_TOSSES = {1: (1.8, 0.3), 2: (0.8, 0.2)}
"""Half the 95 % intervals that fewer leave: of friction, relative to the estimate, and of restitution: the 95 %
quantiles over 85 and 56 fits of simulated bodies (tools/bench_intervals.py few). These estimates are off by a factor of
1.6 and 1.4 (rms of the log), those of the loss by 2.8 and 2.0, and nearly always too low."""
LEAST_FRAMES = 4
FRICTIONS, RESTITUTIONS = np.geomspace(0.04, 0.63, 7), (0.0, 0.15, 0.3)
"""Where the search begins: the best pair of these."""
UNEXPLAINED = 0.08
SPANS = (0.25, 0.1, 0.04)
"""Steps to either side along restitution, log friction (twice) and a third of log unexplained."""
PROFILE = 0.12 * np.arange(-5, 6)
"""Log frictions about the best, for the interval."""
REBOUNDS = np.linspace(0.0, 0.9, 13)
"""Restitutions, for its interval."""
REPEATS = 300
MODEL_RESTITUTION = 0.1
"""Standard deviation that stays with any number of tosses, because Newton's rule is not the world: assumed. What
simulated bodies want is fitted on one half of them and reported on the other by tools/bench_intervals.py slow."""
RESTITUTION_ASSUMED = f"+-{1.96 * MODEL_RESTITUTION:.2f} of it is assumed, not measured"
"""Said wherever the interval of a restitution is."""
MODEL_SHARE = 0.15
"""Standard deviation, relative, that stays with any number of tosses: rms of estimate / truth - 1 over 14 simulated
bodies of other contact laws, shapes and noise is .154, and 13 of the intervals hold the truth: the same bodies, so
no independent judgement (tools/bench_intervals.py slow splits them)."""


@dataclass(frozen=True, eq=False)
class ForecastFriction:
    """The friction and half its 95 % interval, the law it is of and half the interval of its restitution, and the score
    per friction of PROFILE and toss."""

    value: float
    half_width: float
    law: Law
    restitution_half_width: float
    profile: Float[Array, "f n"]


def frames_are_slow(tracks: Sequence[PoseSeries]) -> bool:
    """Whether the frames of most tosses are too far apart for the loss to tell friction."""
    return float(np.median([t.step_s for t in tracks])) > SLOW_S


def friction_by_forecasts(
    body: RigidBody, tracks: Sequence[PoseSeries], smoothed: Sequence[Smoothed], seed: int = 0
) -> ForecastFriction | None:
    """Friction of a body of known shape. None where no toss is seen to fly and hit the plane."""
    trajectories = observed_trajectories(tracks, smoothed)
    if not trajectories:
        return None
    forecasts = Forecasts(trajectories, body, noise_of(smoothed))
    law = best_law(forecasts)
    profile = forecasts.scores([replace(law, friction=float(f)) for f in law.friction * np.exp(PROFILE)])
    value = float(np.exp(np.log(law.friction) + lowest(PROFILE, profile.sum(1))))
    if len(trajectories) in FEW_TOSSES:
        share, rebound = FEW_TOSSES[len(trajectories)]
        return ForecastFriction(value, share * value, replace(law, friction=value), rebound, profile)
    sampling = _sampling(PROFILE, profile, np.random.default_rng(seed)) * value
    half_width = float(np.hypot(sampling, 1.96 * MODEL_SHARE * value))
    law = replace(law, friction=value)
    rebounds = forecasts.scores([replace(law, restitution=float(e)) for e in REBOUNDS])
    rebound = float(np.hypot(_sampling(REBOUNDS, rebounds, np.random.default_rng(seed)), 1.96 * MODEL_RESTITUTION))
    return ForecastFriction(value, half_width, law, rebound, profile)


def observed_trajectories(tracks: Sequence[PoseSeries], smoothed: Sequence[Smoothed]) -> list[ObservedTrajectory]:
    """At most MOST_TOSSES of the tosses that hit anything, spread over all."""
    found = [trajectory for t, s in zip(tracks, smoothed) if (trajectory := _observed_trajectory(t, s)) is not None]
    if not found:
        return []
    return [found[i] for i in np.unique(np.linspace(0, len(found) - 1, MOST_TOSSES).round().astype(int))]


def noise_of(smoothed: Sequence[Smoothed]) -> Noise:
    """The noise of the typical toss."""
    return Noise(*(float(np.median([getattr(s.noise, n) for s in smoothed])) for n in ("position_m", "rotation_rad")))


def _observed_trajectory(track: PoseSeries, smoothed: Smoothed) -> ObservedTrajectory | None:
    """From the release to just behind the beginning of the rest, where it hits anything."""
    phases = smoothed.phases
    if phases.release is None or phases.first_impact is None:
        return None
    kept = slice(phases.release, len(track) if phases.rest is None else phases.rest + 2)
    flight = phases.first_impact - phases.release
    trajectory = ObservedTrajectory(track.time_s[kept], track.rotation[kept], track.position_m[kept], flight)
    return trajectory if len(trajectory.time_s) >= max(LEAST_FRAMES, flight + 1) else None


def best_law(forecasts: Forecasts) -> Law:
    """The best of a grid, then friction and restitution together and unexplained by itself, over narrower spans.

    Together, for more of one asks for less of the other: where one is sought at a time, the search ends beside the
    valley of some tosses' scores (of three tosses with noise of their own size added, .27 to .34 for .2 in 3 of 16).
    """
    grid = [Law(float(f), e, UNEXPLAINED) for f in FRICTIONS for e in RESTITUTIONS]
    law = grid[int(forecasts.scores(grid).sum(1).argmin())]
    sides = np.array([-1.0, 0.0, 1.0])
    for span in SPANS:
        frictions = [float(law.friction * np.exp(2 * span * x)) for x in sides]
        rebounds = [float(np.clip(law.restitution + span * x, 0, 0.9)) for x in sides]
        pairs = [replace(law, friction=f, restitution=e) for e in rebounds for f in frictions]
        at = forecasts.scores(pairs).sum(1).reshape(len(rebounds), len(frictions))
        best = int(at.min(1).argmin())
        friction = float(law.friction * np.exp(lowest(2 * span * sides, at[best])))
        law = replace(law, friction=friction, restitution=rebounds[best])
        shares = np.clip(law.unexplained * np.exp(3 * span * sides), 0.01, 0.6)
        tried = [replace(law, unexplained=float(x)) for x in shares]
        law = tried[int(forecasts.scores(tried).sum(1).argmin())]
    return law


def lowest(x: Float[Array, " f"], y: Float[Array, " f"]) -> float:
    """Where a curve on an even grid is lowest: the parabola through the least entry and its neighbours."""
    i = int(np.clip(y.argmin(), 1, len(y) - 2))
    before, here, after = y[i - 1 : i + 2]
    bend = before + after - 2 * here
    if bend <= 0:
        return float(x[y.argmin()])
    return float(x[i] + (x[i + 1] - x[i]) * np.clip(0.5 * (before - after) / bend, -1, 1))


def _sampling(tried: Float[Array, " f"], profile: Float[Array, "f n"], rng: np.random.Generator) -> float:
    """Half the 95 % interval of where the profile over `tried` is lowest, from drawing the tosses anew."""
    n = profile.shape[1]
    drawn = rng.multinomial(n, np.full(n, 1 / n), REPEATS)
    spread = float(np.std([lowest(tried, profile @ counts) for counts in drawn], ddof=1))
    return float(stdtrit(n - 1, 0.975)) * spread * (n / (n - 1)) ** 0.5
