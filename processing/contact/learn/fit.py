"""The parameter vector of a fit, and the optimisers: L-BFGS for a box, Adam with a cosine schedule for free points.

Layout of a parameter vector: shape (lengths in SCALE_M) | square root of friction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from processing.contact.physics.geometry import SCALE_M, Geometry
from processing.contact.physics.loss import Body, LossValue, StepData, Weights, contact_loss

SHAPE, FRICTION = slice(None, -1), -1
"""Where a parameter vector keeps what."""
LOSS_SCALE = 1e4
"""Brings the loss (J) to order one for the optimisers' tolerances."""
TOLERANCE, ROUGH_TOLERANCE = 1e-7, 3e-6
"""L-BFGS ends when the loss falls by less than this, relatively; rough for fits that only compare."""
HOLD_J = 3e-4
"""What a transition's loss varies by for no reason of the shape's (the loss of well fitted tosses is of this size): so
much a move by one sigma of the prior costs in the sum over transitions."""
MOST_MOVE, MOST_FRICTION = 1.5, 2.0
"""How far a parameter may go from its start (a length: 75 mm): a first step of L-BFGS knows no scale."""


@dataclass(frozen=True)
class FitConfig:
    learn_shape: bool = True
    friction_start: float = 0.03
    lbfgs_iterations: int = 40
    """For a box."""
    adam_iterations: int = 160
    """For free points, with a cosine schedule."""
    adam_rate: float = 0.025
    """In units of SCALE_M: the largest move of a coordinate in one iteration."""
    held_rate: float = 0.01
    """The same where a prior holds the points: they start near the optimum."""
    device: str = "cpu"
    """`cpu` or `cuda`; always in float64."""


@dataclass(frozen=True, eq=False)
class Model:
    """A geometry, the body's inertia (at the reference mass) and what of the geometry is learned."""

    geometry: Geometry
    inertia_kgm2: Float[Array, "3 3"]
    config: FitConfig
    sigma_m: Float[Array, " v"] | None = None
    """Free points that a prior holds: how far each may be off. None: nothing holds them."""

    def start(self) -> Float[Array, " p"]:
        return np.append(self.geometry.start(), self.config.friction_start**0.5)

    def learned(self) -> Bool[Array, " p"]:
        return np.array([self.config.learn_shape] * len(self.geometry.start()) + [True])

    def body(self, parameters: Float[Tensor, " p"]) -> Body:
        inertia = torch.as_tensor(self.inertia_kgm2, dtype=parameters.dtype, device=parameters.device)
        return Body(self.geometry.points(parameters[SHAPE]), parameters[FRICTION].square(), inertia)

    def numbers(self, parameters: Float[Array, " p"]) -> Body:
        """The body of a parameter vector, without gradients, on the fit's device."""
        with torch.no_grad():
            return self.body(torch.as_tensor(parameters, dtype=torch.float64, device=self.config.device))

    def hold(self, parameters: Float[Tensor, " p"], transitions: int) -> Float[Tensor, ""]:
        """HOLD_J / transitions * sum |move|^2 / (2 sigma^2), in J: the prior's share of the mean loss."""
        if self.sigma_m is None:
            return parameters.new_zeros(())
        start = torch.as_tensor(self.geometry.start(), dtype=parameters.dtype, device=parameters.device)
        sigma = torch.as_tensor(self.sigma_m, dtype=parameters.dtype, device=parameters.device)
        move = SCALE_M * (parameters[SHAPE] - start).view(-1, 3)
        return HOLD_J / max(transitions, 1) * 0.5 * (move.square().sum(-1) / sigma.square()).sum()

    def loss(self, parameters: Float[Tensor, " p"], data: StepData, weights: Weights) -> LossValue:
        return contact_loss(data, self.body(parameters), self.geometry.contacts, weights)


@dataclass(frozen=True, eq=False)
class Fit:
    """Where an optimiser ended. `failures` counts unsolved inner problems over all evaluations, `last_failures` those
    at the end (they take no part in the loss)."""

    parameters: Float[Array, " p"]
    loss: float
    evaluations: int
    failures: int
    last_failures: int


class _Objective:
    """Loss and gradient over the learned entries of a parameter vector, counting as it goes."""

    def __init__(self, model: Model, start: Float[Array, " p"], data: StepData, weights: Weights) -> None:
        device = model.config.device
        self.model, self.data, self.weights = model, data, weights
        self.full = torch.as_tensor(start, dtype=torch.float64, device=device)
        self.learned = torch.as_tensor(model.learned(), device=device)
        self.free = self.full[self.learned].clone().requires_grad_(True)
        self.evaluations = self.failures = self.last_failures = 0

    def parameters(self) -> Float[Tensor, " p"]:
        return self.full.masked_scatter(self.learned, self.free)

    def __call__(self) -> Float[Tensor, ""]:
        value = self.model.loss(self.parameters(), self.data, self.weights)
        self.free.grad = None
        scaled = (value.loss + self.model.hold(self.parameters(), len(self.data))) * LOSS_SCALE
        if scaled.requires_grad:
            scaled.backward()
        self.evaluations += 1
        self.last_failures = int(value.impulses.failed.sum())
        self.failures += self.last_failures
        return scaled.detach()

    def gradient(self) -> Float[Tensor, " q"]:
        return torch.zeros_like(self.free) if self.free.grad is None else self.free.grad

    def ended(self, free: Float[Array, " q"], loss: float) -> Fit:
        with torch.no_grad():
            self.free.copy_(torch.as_tensor(free))
        found = self.parameters().detach().cpu().numpy()
        return Fit(found, loss / LOSS_SCALE, self.evaluations, self.failures, self.last_failures)


def fit_lbfgs(
    model: Model,
    start: Float[Array, " p"],
    data: StepData,
    weights: Weights,
    iterations: int,
    tolerance: float = TOLERANCE,
) -> Fit:
    """Full-batch L-BFGS (scipy's: importing torch.optim costs a CPU second)."""
    from scipy.optimize import minimize

    objective = _Objective(model, start, data, weights)

    def value(free: Float[Array, " q"]) -> tuple[float, Float[Array, " q"]]:
        with torch.no_grad():
            objective.free.copy_(torch.as_tensor(free))
        loss = float(objective())
        return loss, objective.gradient().cpu().numpy()

    begin = objective.free.detach().cpu().numpy().copy()
    friction = int(model.learned()[:FRICTION].sum())
    bounds = [(x - MOST_MOVE, x + MOST_MOVE) for x in begin]
    bounds[friction] = (0.0, MOST_FRICTION**0.5)
    options = {"maxiter": iterations, "ftol": tolerance, "gtol": 1e-5, "maxcor": 20}
    found = minimize(value, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return objective.ended(found.x, float(found.fun))


def fit_adam(
    model: Model,
    start: Float[Array, " p"],
    data: StepData,
    weights: Weights,
    iterations: int,
    rate: float,
) -> Fit:
    """Full-batch Adam (Kingma and Ba 2015) with a cosine schedule: free points make the loss too kinked for L-BFGS."""
    objective = _Objective(model, start, data, weights)
    mean, square = torch.zeros_like(objective.free), torch.zeros_like(objective.free)
    loss = float("nan")
    for i in range(iterations):
        loss = float(objective())
        slope = objective.gradient()
        mean = 0.9 * mean + 0.1 * slope
        square = 0.999 * square + 0.001 * slope * slope
        now = 0.5 * rate * (1 + math.cos(math.pi * i / iterations))
        step = (mean / (1 - 0.9 ** (i + 1))) / ((square / (1 - 0.999 ** (i + 1))).sqrt() + 1e-8)
        with torch.no_grad():
            objective.free.sub_(now * step)
    return objective.ended(objective.free.detach().cpu().numpy(), loss)


def fit(model: Model, start: Float[Array, " p"], data: StepData, weights: Weights, share: float = 1.0) -> Fit:
    """Fit with the optimiser of the geometry. `share` of the iterations is enough from a start near the optimum."""
    config = model.config
    if model.geometry.name == "box":
        tolerance = TOLERANCE if share == 1.0 else ROUGH_TOLERANCE
        return fit_lbfgs(model, start, data, weights, max(4, round(config.lbfgs_iterations * share)), tolerance)
    iterations = max(8, round(config.adam_iterations * share))
    rate = config.adam_rate if model.sigma_m is None else config.held_rate
    return fit_adam(model, start, data, weights, iterations, rate * (1.0 if share == 1.0 else 0.3))
