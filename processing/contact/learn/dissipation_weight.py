"""Choosing the weight of the dissipation term by rollouts of tosses that were not learned from.

With the paper's equal weights, pose noise reads as friction. The ratio of dissipation to complementarity cures that,
but how large it must be depends on the noise; so it is searched: at each candidate the model is fitted to all tosses
but one fold and rolled out on that fold. The best one by the mean way of surface points is taken.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.learn.fit import Fit, Model, fit
from processing.contact.physics.loss import Body, StepData, Weights
from processing.contact.physics.rollout import Start, rollout_errors, simulate
from processing.motion.trajectory import PoseSeries, Steps


@dataclass(frozen=True)
class SweepConfig:
    first: tuple[float, ...] = (30.0, 100.0, 10.0)
    """Dissipation weights tried at once."""
    further: tuple[float, ...] = (17.0, 55.0, 3.0, 1.0)
    """Tried when they lie beside the best one so far."""
    folds: int = 3
    share: float = 0.2
    """Of a full fit's iterations, for the fits of the folds (they start at the fit to all tosses)."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Everything a rollout of the training tosses needs: tracks, the states they start from, frames they start at."""

    tracks: Sequence[PoseSeries]
    start: Start
    begin: Sequence[int]
    steps: int
    step_s: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """One weight of the dissipation: the fit to all tosses, and the held-out position error of each toss."""

    dissipation: float
    fit: Fit
    error_m: Float[Array, " n"]
    rotation_rad: Float[Array, " n"]


@dataclass(frozen=True, eq=False)
class Sweep:
    """All candidates and the chosen one."""

    candidates: tuple[Candidate, ...]
    chosen: Candidate

    def table(self) -> list[dict[str, Any]]:
        """Rows for the result."""
        return [
            {
                "dissipation": c.dissipation,
                "held_out_position_m": float(c.error_m.mean()),
                "held_out_rotation_rad": float(c.rotation_rad.mean()),
                "chosen": c is self.chosen,
            }
            for c in self.candidates
        ]


def sweep_weights(
    model: Model,
    steps: Steps,
    held_out: HeldOut,
    config: SweepConfig,
    progress: Callable[[int, int], None] = lambda done, total: None,
    base: Weights | None = None,
) -> Sweep:
    """Search the grid: the first candidates, then those beside the best until no better neighbour is left."""
    found: list[Candidate] = []
    reach_m = 0.0
    grid = sorted({*config.first, *config.further})
    todo = list(config.first)
    while todo:
        near = min(found, key=lambda c: abs(np.log(c.dissipation / todo[0])), default=None)
        begin = model.start() if near is None else near.fit.parameters
        found.append(_try(model, steps, held_out, config, todo.pop(0), begin, near is None, base))
        progress(len(found), len(grid))
        if len(found) == 1:
            points = model.numbers(found[0].fit.parameters).points_m
            reach_m = 0.5 * float((points.amax(0) - points.amin(0)).mean())
        if not todo:
            best = choose(found, reach_m)
            tried = {c.dissipation for c in found}
            at = grid.index(best.dissipation)
            todo = [w for w in grid[max(at - 1, 0) : at + 2] if w not in tried]
    return Sweep(tuple(sorted(found, key=lambda c: c.dissipation)), choose(found, reach_m))


def choose(candidates: Sequence[Candidate], reach_m: float) -> Candidate:
    """The weight whose held-out rollouts leave points of the surface least far off: position + reach * angle, mean over
    tosses. Too much weight shows in the angle first, too little in the position."""
    return min(candidates, key=lambda c: float((c.error_m + reach_m * c.rotation_rad).mean()))


def _try(
    model: Model,
    steps: Steps,
    held_out: HeldOut,
    config: SweepConfig,
    dissipation: float,
    begin: Float[Array, " p"],
    first: bool,
    base: Weights | None,
) -> Candidate:
    weights = replace(base or Weights(), dissipation=dissipation)
    device = model.config.device
    whole = fit(model, begin, StepData(steps, device), weights, 1.0 if first else config.share)
    tosses = [t.toss for t in held_out.tracks]
    folds = min(config.folds, len(tosses))
    owner = [i % folds for i in range(len(tosses))]
    bodies: list[Body] = []
    for k in range(folds):
        left_out = [t for t, fold in zip(tosses, owner) if fold == k]
        data = StepData(steps.only(~np.isin(steps.toss, left_out)), device)
        bodies.append(model.numbers(fit(model, whole.parameters, data, weights, config.share).parameters))
    rolled = simulate(bodies, model.geometry.contacts, held_out.start, held_out.steps, held_out.step_s, owner)
    errors = rollout_errors(rolled, held_out.tracks, held_out.begin, held_out.step_s)
    return Candidate(dissipation, whole, errors.per_toss_m, errors.per_toss_rad)
