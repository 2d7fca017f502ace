"""Friction, restitution and size where frames are far apart: the most likely ones (likelihood.py).

At 30 Hz a transition spans several contacts: the slip at its end says little about the slip within, the dissipation
term then prefers too little friction (without any noise: .15 for .25), and pose noise too much. So there the loss
gives the shape, and friction is the one under which each frame follows best from the frames before it, together with
what would be taken for friction otherwise: the rebound, the size along the object's axes, how much of an impulse the
laws leave unexplained, and the pose noise. No weight and no horizon is chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.stats import t as student

from processing.contact.likelihood import Course, RigidBody, Trial, log_likelihoods
from processing.contact.motion import PoseSeries
from processing.contact.segment import Noise
from processing.contact.smooth import Smoothed

SLOW_S = 0.01
"""Frames further apart than this are too far apart for the loss to tell friction."""
LEAST_TOSSES, MOST_TOSSES = 3, 12
LEAST_FRAMES = 4
FRICTIONS, RESTITUTIONS = (0.05, 0.1, 0.17, 0.3, 0.5), (0.0, 0.2, 0.45)
"""Where the search begins: the best pair of these."""
UNEXPLAINED, MOST_UNEXPLAINED = 0.1, 1.0
FIRST_STEPS = np.array([0.25, 0.1, 0.7, 0.25, 0.03, 0.03, 0.03])
"""Of log friction, restitution, log unexplained, log noise, log stretch (3)."""
NARROWER, ROUNDS = 0.6, 4
STRETCH_SIGMA = 0.05
"""How far the loss's size may be off at such rates (standard deviation, relative)."""
PROFILE = np.linspace(-0.4, 0.4, 9)
"""Log frictions about the best, for the interval."""
REPEATS = 300
MODEL_SHARE = 0.1
"""Standard deviation, relative, that stays with any number of tosses: the spread of the estimate beyond its sampling
over simulated bodies of other contact laws (tools/bench_contact.py variety)."""


@dataclass(frozen=True, eq=False)
class LikelyFriction:
    """The friction and half its 95 % interval; what was found with it; log likelihood per friction of PROFILE and
    toss."""

    value: float
    half_width: float
    trial: Trial
    profile: Float[Array, "f n"]


def frames_are_slow(tracks: Sequence[PoseSeries]) -> bool:
    """Whether the frames of most tosses are too far apart for the loss to tell friction."""
    return float(np.median([t.step_s for t in tracks])) > SLOW_S


def likely_friction(
    body: RigidBody, tracks: Sequence[PoseSeries], smoothed: Sequence[Smoothed], seed: int = 0
) -> LikelyFriction | None:
    """The most likely friction of a body whose shape is known but for its size. None where fewer than LEAST_TOSSES
    tosses hit the plane."""
    found = [course for t, s in zip(tracks, smoothed) if (course := _course(t, s)) is not None]
    if len(found) < LEAST_TOSSES:
        return None
    courses = [found[i] for i in np.unique(np.linspace(0, len(found) - 1, MOST_TOSSES).round().astype(int))]
    noise = Noise(*(float(np.median([getattr(s.noise, n) for s in smoothed])) for n in ("position_m", "rotation_rad")))

    def likely(trials: Float[Array, "m 7"]) -> Float[Array, "m n"]:
        return log_likelihoods(courses, body, [_trial(x) for x in trials], noise)

    best = _search(likely)
    moves = PROFILE[:, None] * np.eye(7)[0]
    profile = likely(best + moves)
    best[0] += PROFILE[0] + _peak(profile.sum(1)) * (PROFILE[1] - PROFILE[0])
    value = float(np.exp(best[0]))
    sampling = _sampling(profile, np.random.default_rng(seed)) * value
    return LikelyFriction(value, float(np.hypot(sampling, 1.96 * MODEL_SHARE * value)), _trial(best), profile)


def _course(track: PoseSeries, smoothed: Smoothed) -> Course | None:
    """From the release to just behind the beginning of the rest, where it hits anything."""
    phases = smoothed.phases
    if phases.release is None or phases.first_impact is None:
        return None
    kept = slice(phases.release, len(track) if phases.rest is None else phases.rest + 2)
    course = Course(track.time_s[kept], track.rotation[kept], track.position_m[kept])
    return course if len(course.time_s) >= LEAST_FRAMES else None


def _trial(x: Float[Array, "7"]) -> Trial:
    a, b, c = np.exp(x[4:]).tolist()
    return Trial(float(np.exp(x[0])), float(x[1]), float(np.exp(x[2])), float(np.exp(x[3])), (a, b, c))


def _search(likely: Callable[[Float[Array, "m 7"]], Float[Array, "m n"]]) -> Float[Array, "7"]:
    """The best of a grid, then rounds of a step to either side in every number and of the parabolas' tops, narrower
    from round to round (contact makes the likelihood kinked: no gradient)."""

    def value(points: Float[Array, "m 7"]) -> Float[Array, " m"]:
        held = 0.5 * (points[:, 4:] ** 2).sum(1) / STRETCH_SIGMA**2
        return likely(points).sum(1) - held

    grid = np.array([[np.log(f), e, np.log(UNEXPLAINED), 0.0, 0.0, 0.0, 0.0] for f in FRICTIONS for e in RESTITUTIONS])
    here = value(grid)
    x, top, step = grid[here.argmax()], float(here.max()), FIRST_STEPS
    for _ in range(ROUNDS):
        sides = _inside(np.concatenate([x + np.diag(step), x - np.diag(step)]))
        at = value(sides)
        up, down = at[:7], at[7:]
        bend = up + down - 2 * top
        move = np.where(bend < 0, 0.5 * (up - down) / np.maximum(-bend, 1e-9), np.sign(up - down))
        move = step * np.clip(move, -1, 1)
        tops = _inside(np.array([x + move, x + 0.5 * move]))
        every, values = np.concatenate([sides, tops]), np.concatenate([at, value(tops)])
        if values.max() > top:
            x, top = every[values.argmax()], float(values.max())
        step = NARROWER * step
    return x


def _inside(points: Float[Array, "m 7"]) -> Float[Array, "m 7"]:
    """Restitution at least 0; unexplained at most all."""
    points[:, 1] = np.clip(points[:, 1], 0.0, 0.9)
    points[:, 2] = np.clip(points[:, 2], -5.0, np.log(MOST_UNEXPLAINED))
    return points


def _peak(curve: Float[Array, " f"]) -> float:
    """Where along its index a curve is highest: the top of the parabola through the best entry and its neighbours."""
    i = int(np.clip(curve.argmax(), 1, len(curve) - 2))
    before, here, after = curve[i - 1 : i + 2]
    bend = before + after - 2 * here
    return float(i + np.clip(0.5 * (before - after) / bend, -1, 1)) if bend < 0 else float(curve.argmax())


def _sampling(profile: Float[Array, "f n"], rng: np.random.Generator) -> float:
    """Half the 95 % interval of log friction, from drawing the tosses anew."""
    n = profile.shape[1]
    drawn = rng.multinomial(n, np.full(n, 1 / n), REPEATS)
    spread = float(np.std([_peak(profile @ counts) for counts in drawn], ddof=1)) * float(PROFILE[1] - PROFILE[0])
    return float(student.ppf(0.975, n - 1)) * spread * (n / (n - 1)) ** 0.5
