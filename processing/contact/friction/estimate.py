"""Friction and restitution where frames are far apart: a posterior over both, by how well they forecast the tosses.

At 30 Hz a transition spans several contacts: the slip at its end says little about the slip within, the dissipation
term then prefers too little friction (without any noise: .15 for .25), and pose noise too much. So there the loss
gives the shape, and friction is found with the rebound, which would be taken for less friction otherwise, and with
what both leave unexplained. No weight and no horizon is chosen.

After a bounce or two a toss forgets how it began, so its score S over friction mu and restitution e has several valleys
and long plains. A best pair is then a draw, and no width about it is honest. So every pair of a grid is weighed:

    p(mu, e) ~ exp(-S(mu, e)) * p(mu)

a Gibbs posterior (Bissiri, Holmes and Walker 2016), in which a proper score stands for a negative log likelihood.
Values are its marginals' most probable ones, intervals their shortest with 95 %, blurred by what no law knows.
docs/decisions/friction.md has the figures, and what was tried instead.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.interpolate import Akima1DInterpolator
from scipy.special import logsumexp

from processing.contact.friction.forecast import Forecasts, Law, ObservedTrajectory, RigidBody
from processing.motion.phases import Noise
from processing.motion.smoother import Smoothed
from processing.motion.trajectory import PoseSeries

SLOW_S = 0.01
"""Frames further apart than this are too far apart for the loss to tell friction."""
MOST_TOSSES = 16
"""More are thinned out."""
LEAST_FRAMES = 4
FRICTIONS, RESTITUTIONS = np.geomspace(0.03, 1.6, 16), np.linspace(0.0, 0.8, 6)
UNEXPLAINED = (0.08, 0.02, 0.05, 0.12, 0.25)
"""What is tried as the share of an impulse that the laws leave unexplained, the likeliest first."""
PRIOR_MEDIAN, PRIOR_LOG_SIGMA = 0.3, 0.8
"""Of friction before anything was seen, log-normal: 95 % between .06 and 1.4, as dry pairs of everyday solids lie in
tables (Teflon .04, wood .25 to .5, glass .9, rubber 1 and above). Every restitution is as likely."""
MODEL_LOG_FRICTION = 0.15
"""Standard deviation of the logarithm that stays with any number of tosses: rms of estimate / truth - 1 over 14
simulated bodies of other contact laws, shapes and noise, of ten tosses each."""
MODEL_RESTITUTION = 0.1
"""The same of restitution, because Newton's rule is not the world: assumed."""
RESTITUTION_ASSUMED = f"+-{1.96 * MODEL_RESTITUTION:.2f} of it is assumed, not measured"
"""Said wherever the interval of a restitution is."""
FINE = 400
"""Points at which a marginal is looked at."""


@dataclass(frozen=True)
class Interval:
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def to_json(self) -> dict[str, float]:
        return {"value": self.value, "low": self.low, "high": self.high}


FRICTION_UNSEEN = Interval(
    PRIOR_MEDIAN, PRIOR_MEDIAN * math.exp(-1.96 * PRIOR_LOG_SIGMA), PRIOR_MEDIAN * math.exp(1.96 * PRIOR_LOG_SIGMA)
)
"""Friction where nothing tells it."""


@dataclass(frozen=True, eq=False)
class ForecastFriction:
    """Friction and restitution with their intervals, what they leave unexplained, and the score per friction of
    FRICTIONS and toss at the likeliest restitution."""

    friction: Interval
    restitution: Interval
    unexplained: float
    scores: Float[Array, "f n"]

    @property
    def law(self) -> Law:
        return Law(self.friction.value, self.restitution.value, self.unexplained)


def frames_are_slow(tracks: Sequence[PoseSeries]) -> bool:
    """Whether the frames of most tosses are too far apart for the loss to tell friction."""
    return float(np.median([t.step_s for t in tracks])) > SLOW_S


def friction_by_forecasts(
    body: RigidBody, tracks: Sequence[PoseSeries], smoothed: Sequence[Smoothed]
) -> ForecastFriction | None:
    """Friction of a body of known shape. None where no toss is seen to fly and hit the plane."""
    trajectories = observed_trajectories(tracks, smoothed)
    return posterior(Forecasts(trajectories, body, noise_of(smoothed))) if trajectories else None


def posterior(forecasts: Forecasts) -> ForecastFriction:
    """Every pair of friction and restitution weighed; what is left unexplained is that which forecasts best with the
    best pair."""
    grid = [Law(float(f), float(e), UNEXPLAINED[0]) for f in FRICTIONS for e in RESTITUTIONS]
    best = grid[int(forecasts.scores(grid).sum(1).argmin())]
    tried = [replace(best, unexplained=u) for u in UNEXPLAINED]
    unexplained = tried[int(forecasts.scores(tried).sum(1).argmin())].unexplained
    scores = forecasts.scores([replace(law, unexplained=unexplained) for law in grid])
    scores = scores.reshape(len(FRICTIONS), len(RESTITUTIONS), -1)
    log_friction = np.log(FRICTIONS)
    log_weight = -scores.sum(2) - 0.5 * ((log_friction[:, None] - np.log(PRIOR_MEDIAN)) / PRIOR_LOG_SIGMA) ** 2
    of_friction, of_restitution = logsumexp(log_weight, axis=1), logsumexp(log_weight, axis=0)
    friction = Interval(*map(float, np.exp(marginal(log_friction, of_friction, MODEL_LOG_FRICTION))))
    restitution = Interval(*map(float, marginal(RESTITUTIONS, of_restitution, MODEL_RESTITUTION)))
    return ForecastFriction(friction, restitution, unexplained, scores[:, int(of_restitution.argmax())])


def marginal(at: Float[Array, " n"], log_density: Float[Array, " n"], blur: float) -> tuple[float, float, float]:
    """The most probable value of a density whose logarithm is given on an even grid (between, a spline that keeps
    parabolas and does not overshoot: Akima 1970) and which is blurred by a Gaussian within the grid's ends, and the
    ends of the shortest interval that holds 95 % of it: a restitution of 0 can be inside, which no quantile allows."""
    fine = np.linspace(at[0], at[-1], FINE)
    log_fine = Akima1DInterpolator(at, log_density - log_density.max(), method="makima")(fine)
    density = np.exp(log_fine - log_fine.max())
    kernel = np.exp(-0.5 * ((fine[:, None] - fine[None]) / blur) ** 2)
    blurred = kernel / kernel.sum(0) @ density
    return float(fine[blurred.argmax()]), *_shortest(fine, blurred)


def _shortest(at: Float[Array, " n"], density: Float[Array, " n"]) -> tuple[float, float]:
    """The shortest interval that holds 95 % of a density on an even grid."""
    below = np.concatenate([[0.0], np.cumsum(density) / density.sum()])
    begins = np.flatnonzero(below <= 0.05)
    ends = np.minimum(np.searchsorted(below, below[begins] + 0.95), len(at))
    best = int((ends - begins).argmin())
    return float(at[begins[best]]), float(at[ends[best] - 1])


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
