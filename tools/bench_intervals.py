"""The intervals of contact learning: what the model leaves is fitted on one half of the bodies or tosses, and how often
the intervals hold the truth is counted on the other half.

python tools/bench_intervals.py [one] [fast] [slow]      # all by default

`one`: single real tosses (TOSSLAB_DATA/contactnets/tosses_processed), each recording once; numbers below 200 fit, the
others judge. `fast` (148 Hz, bootstrap): simulated bodies of any kind; every second four of them fit. `slow`: the same
at 30 Hz, from one toss, two, three and ten: friction and restitution by forecasts, of either half of the bodies, and
friction by the loss. One thread; `one` takes 200 CPU seconds, the others up to a minute a body.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from bench_contact import CUBE, any_body, held, line, noisy, recorded_once, run_cases, simulated, toss

from processing.contact.friction.estimate import Interval
from processing.contact.learn import intervals
from processing.contact.learn.learn import ContactConfig, ContactLearning, learn_contact
from processing.contact.learn.prior import Prior, prior_from_size
from processing.contact.physics.inertia import Physics, uniform_physics
from processing.motion.trajectory import PoseSeries
from recordings.errors import BadInput
from recordings.tracks import ObjectShape

TRUE_FRICTION, TRUE_EDGE_M = 0.18, 0.1024
"""Of the real cubes: experiment.json's, and the size that poses above a plane 1.2 mm too high have."""
SPLIT = 200
BODIES = 32


@dataclass(frozen=True)
class Reading:
    """An estimate beside its truth; `sampling` is half its 95 % interval without what the model leaves, `scale` what
    the model's deviation is relative to."""

    value: float
    truth: float
    sampling: float
    scale: float = 1.0

    @property
    def wanted(self) -> float:
        """The model's standard deviation from which on the interval holds the truth."""
        beyond = max((self.value - self.truth) ** 2 - self.sampling**2, 0.0) ** 0.5
        return beyond / 1.96 / self.scale

    def holds(self, model: float) -> bool:
        return abs(self.value - self.truth) <= float(np.hypot(self.sampling, 1.96 * model * self.scale))


def told(name: str, fitting: Sequence[Reading], judging: Sequence[Reading], shipped: float) -> None:
    """The 95 % quantile of what the fitting half wants, and the share of either half that is inside."""
    fitted = float(np.quantile([r.wanted for r in fitting], 0.95, method="higher"))

    def inside(readings: Sequence[Reading], model: float) -> str:
        return f"{100 * np.mean([r.holds(model) for r in readings]):.0f} % of {len(readings)}"

    width = float(np.median([np.hypot(r.sampling, 1.96 * shipped * r.scale) for r in judging]))
    line(
        name,
        f"fitted {fitted:.3f}: inside {inside(fitting, fitted)}; on the other half {inside(judging, fitted)}; shipped "
        f"{shipped:g}: {inside(fitting, shipped)} and {inside(judging, shipped)}, median half width {width:.3f}; "
        f"estimate - truth there {np.mean([r.value - r.truth for r in judging]):+.3f} +- "
        f"{np.std([r.value - r.truth for r in judging]):.3f}",
    )


def without(width: float, model: float) -> float:
    """Half an interval without the model's deviation that it was widened by."""
    return max(width**2 - (1.96 * model) ** 2, 0.0) ** 0.5


def one() -> None:
    """Single real tosses: friction, and every edge relative to itself."""
    tracks = [toss(n) for n in recorded_once(range(600))]
    friction: dict[bool, list[Reading]] = {True: [], False: []}
    edges: dict[bool, list[Reading]] = {True: [], False: []}
    for track in tracks:
        found = learn_contact([track], prior_from_size("box", 0.05), CUBE)
        half, f = track.toss < SPLIT, found.friction
        sampling = without(found.spread.friction, intervals.MODEL_FRICTION)
        friction[half].append(Reading(f.value, TRUE_FRICTION, sampling))
        for edge, width in zip(found.extents, found.spread.extents_m):
            left = without(float(width), intervals.MODEL_SIZE * edge.value)
            edges[half].append(Reading(edge.value, TRUE_EDGE_M, left, edge.value))
    told("one toss, friction", friction[True], friction[False], intervals.MODEL_FRICTION)
    told("one toss, edges", edges[True], edges[False], intervals.MODEL_SIZE)


@dataclass(frozen=True, eq=False)
class MadeBody:
    """A simulated body of any kind, ten tosses of it, its true friction, and its restitution (of a mass on a damped
    spring: exp(-pi d / sqrt(1 - d^2)))."""

    what: str
    tracks: list[PoseSeries]
    prior: Prior
    physics: Physics
    friction: float
    restitution: float

    def learned(self, tosses: Sequence[int] = range(10), every: int = 5, forecasts: bool = True) -> ContactLearning:
        repeats, penetration = 12 if every == 1 else 2, 1.0 if self.what.startswith("box") else 20.0
        config = ContactConfig(bootstrap_repeats=repeats, penetration=penetration, friction_by_forecasts=forecasts)
        return learn_contact([self.tracks[t] for t in tosses], self.prior, self.physics, config=config)


def made_body(seed: int, every: int) -> MadeBody:
    """At 148 Hz / every."""
    rng = np.random.default_rng([77, seed])
    kind, mu = ("box", "box", "prism", "L-shape")[seed % 4], float(rng.uniform(0.1, 0.5))
    damping, soft_s = (1.0, 1.0, 0.5, 0.25)[rng.integers(4)], float(np.exp(rng.uniform(*np.log([0.0015, 0.006]))))
    mm_noise = (0.5, 1.0, 3.0)[rng.integers(3)] if every > 1 else 0.2
    pieces, truth = any_body(kind, rng)
    shape = ObjectShape("object", "truth", np.asarray(truth.vertices), np.asarray(truth.faces, dtype=np.int64))
    physics = uniform_physics(shape, 0.37)
    made = simulated(pieces, physics, mu, 10, seed, soft_s, damping)
    tracks = [noisy(t, every, 1e-3 * mm_noise, np.radians(0.5 * mm_noise), seed) for t in made]
    prior = prior_from_size("box", 0.05) if kind == "box" else held(shape, physics, rng)
    rebound = 0.0 if damping == 1 else float(np.exp(-np.pi * damping / (1 - damping**2) ** 0.5))
    what = f"{kind}, rebound damping {damping:g}, {1e3 * soft_s:.1f} ms, noise {mm_noise:g} mm"
    return MadeBody(what, tracks, prior, physics, mu, rebound)


def fast() -> None:
    """Friction at 148 Hz, relative to itself."""
    friction: dict[bool, list[Reading]] = {True: [], False: []}
    for seed in range(BODIES):
        body = made_body(seed, 1)
        try:
            f = body.learned(every=1).friction
        except BadInput as wrong:
            line(f"body {seed}", f"refused: {wrong}")
            continue
        line(f"body {seed}", f"{body.what}: friction {of(f)}, true {body.friction:.3f}")
        left = without(f.high - f.value, intervals.MODEL_SHARE * f.value)
        friction[seed // 4 % 2 == 0].append(Reading(f.value, body.friction, left, f.value))
    told("148 Hz, friction", friction[True], friction[False], intervals.MODEL_SHARE)


def of(interval: Interval) -> str:
    return f"{interval.value:.3f} ({interval.low:.3f} .. {interval.high:.3f})"


TOLD = ("friction by forecasts", "friction by the loss", "restitution")


def slow() -> None:
    """Friction and restitution at 30 Hz from few tosses and from ten."""
    found: dict[tuple[int, str, bool], list[tuple[Interval, float]]] = {}
    for seed in range(BODIES):
        body, half = made_body(seed, 5), seed // 4 % 2 == 0
        for tosses in ((0,), (1,), (3, 4), (6, 7, 8), tuple(range(10))):
            for forecasts in (True, False):
                try:
                    learned = body.learned(tosses, forecasts=forecasts)
                except BadInput:  # a box whose size one toss does not tell
                    continue
                found.setdefault((len(tosses), TOLD[not forecasts], half), []).append((learned.friction, body.friction))
                if learned.restitution is not None:
                    readings = found.setdefault((len(tosses), TOLD[2], half), [])
                    readings.append((learned.restitution, body.restitution))
    for (tosses, what, half), pairs in sorted(found.items()):
        inside = np.mean([x.low <= truth <= x.high for x, truth in pairs])
        width = float(np.median([x.high - x.low for x, _ in pairs]))
        off = np.array([x.value - truth for x, truth in pairs])
        if what != TOLD[2]:
            off = np.log([max(x.value, 0.01) / truth for x, truth in pairs])
        line(
            f"{tosses} tosses, {what}, {'even' if half else 'odd'} fours",
            f"{len(pairs)} fits: inside {100 * inside:.0f} %, median width {width:.2f}; "
            f"{'estimate - truth' if what == TOLD[2] else 'log of estimate / truth'} {off.mean():+.2f}, rms "
            f"{np.sqrt(np.mean(off**2)):.2f}",
        )


CASES = {"one": one, "fast": fast, "slow": slow}


if __name__ == "__main__":
    sys.exit(run_cases(CASES, without_data=("fast", "slow")))
