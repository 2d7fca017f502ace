"""Friction by rollouts, where frames are far apart.

At 30 Hz a transition spans several contacts: the slip at its end says little about the slip within, the dissipation
term then prefers too little friction (without any noise: .15 for .25), and pose noise too much. So there the loss
gives the shape, and the friction is the one whose rollouts in fine steps leave points of the surface least far off.
They are compared from the frame before the first impact to AFTER_S behind it: sooner there is no contact to tell,
much later the tumbling is chaos, in which less friction looks better. On simulated boxes (friction .1 to .5, with and
without rebound, 148 and 30 Hz, noise up to 3 mm) the estimate depends neither on rate nor on noise; it is .83 +- .13 of
the true one (.94 without rebound), on real cubes .95 +- .05. An AFTER_S of .15 is nearer (.93 +- .10), but on real
tosses, of which there are few, it scatters so much (.15 to .21 for .18) that rollouts of half a second suffer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.stats import t as student

from processing.contact.loss import Body
from processing.contact.motion import PoseSeries
from processing.contact.rollout import Start, rollout_errors, simulate
from processing.contact.smooth import Smoothed

SLOW_S = 0.01
"""Frames further apart than this are too far apart for the loss to tell friction."""
STEP_S = 1 / 592
"""Of the rollouts: in steps of 1/148 s friction comes out a tenth lower."""
AFTER_S = 0.3
LEAST_TOSSES = 3
MOST_TOSSES = 40
FRICTIONS = np.geomspace(0.02, 1.2, 27)
REPEATS = 300
MODEL_SHARE = 0.1
"""Standard deviation, relative, that stays with any number of tosses: rollouts know no rebound."""


@dataclass(frozen=True, eq=False)
class RolledFriction:
    """The friction, half its 95 % interval, and the surface error (m) per friction of FRICTIONS and toss."""

    value: float
    half_width: float
    error_m: Float[Array, "f n"]


def frames_are_slow(tracks: Sequence[PoseSeries]) -> bool:
    """Whether the frames of most tosses are too far apart for the loss to tell friction."""
    return float(np.median([t.step_s for t in tracks])) > SLOW_S


def friction_by_rollouts(
    body: Body,
    contacts: int,
    tracks: Sequence[PoseSeries],
    smoothed: Sequence[Smoothed],
    start: Start,
    begin: Sequence[int],
    seed: int = 0,
) -> RolledFriction | None:
    """Friction of a body of known shape; `start` holds the states at the frames `begin`, for rollouts of STEP_S.

    None where fewer than LEAST_TOSSES tosses hit the plane.
    """
    hit = [i for i, s in enumerate(smoothed) if s.phases.first_impact is not None][:MOST_TOSSES]
    if len(hit) < LEAST_TOSSES:
        return None
    spans = [_span_s(smoothed[i], begin[i]) for i in hit]
    errors = _errors_m(body, contacts, [tracks[i] for i in hit], start, hit, [begin[i] for i in hit], spans)
    value = _least(errors.mean(1))
    rng = np.random.default_rng(seed)
    drawn = rng.multinomial(len(hit), np.full(len(hit), 1 / len(hit)), REPEATS)
    spread = float(np.std([_least(errors @ counts) for counts in drawn], ddof=1))
    sampling = float(student.ppf(0.975, len(hit) - 1)) * spread * (len(hit) / (len(hit) - 1)) ** 0.5
    return RolledFriction(value, float(np.hypot(sampling, 1.96 * MODEL_SHARE * value)), errors)


def _span_s(smoothed: Smoothed, begin: int) -> tuple[float, float]:
    """Since the start of the rollout: the frame before the first impact, and AFTER_S behind the impact."""
    time_s, impact = smoothed.states.time_s, smoothed.phases.first_impact or 0
    return float(time_s[max(impact - 1, 0)] - time_s[begin]), float(time_s[impact] - time_s[begin]) + AFTER_S


def _errors_m(
    body: Body,
    contacts: int,
    tracks: Sequence[PoseSeries],
    start: Start,
    rows: Sequence[int],
    begin: Sequence[int],
    spans_s: Sequence[tuple[float, float]],
) -> Float[Array, "f n"]:
    """Mean over each toss's span of position error + mean half extent * rotation error, for every friction."""
    count = len(FRICTIONS)
    bodies = [replace(body, friction=body.friction.new_tensor(f)) for f in FRICTIONS]
    every = Start(*(np.concatenate([values[list(rows)]] * count) for values in vars(start).values()))
    owner = np.repeat(np.arange(count), len(rows)).tolist()
    steps = int(np.ceil(max(end for _, end in spans_s) / STEP_S))
    rolled = simulate(bodies, contacts, every, steps, STEP_S, owner)
    errors = rollout_errors(rolled, list(tracks) * count, list(begin) * count, STEP_S)
    reach_m = 0.5 * float((body.points_m.amax(0) - body.points_m.amin(0)).mean())
    surface = (errors.position_m + reach_m * errors.rotation_rad).reshape(count, len(rows), steps)
    found = []
    for i, (first, last) in enumerate(spans_s):
        part = surface[:, i, max(int(first / STEP_S), 0) : max(int(last / STEP_S), 1)]
        found.append(np.nanmean(part, axis=1) if np.isfinite(part).any() else np.zeros(count))
    return np.stack(found, 1)


def _least(curve_m: Float[Array, " f"]) -> float:
    """The friction of the least error: a parabola in log friction through the best of the grid and its neighbours."""
    i = int(np.clip(curve_m.argmin(), 1, len(curve_m) - 2))
    x, y = np.log(FRICTIONS[i - 1 : i + 2]), curve_m[i - 1 : i + 2]
    bend = y[0] - 2 * y[1] + y[2]
    if bend <= 0:
        return float(FRICTIONS[curve_m.argmin()])
    lowest = x[1] + 0.5 * (x[1] - x[0]) * (y[0] - y[2]) / bend
    return float(np.exp(np.clip(lowest, x[0], x[2])))
