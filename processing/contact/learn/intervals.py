"""How sure the learned numbers are: a bootstrap over tosses, or the loss's curvature where there is one toss only.

Bootstrap: tosses are drawn with replacement, the fit is repeated from the optimum with those weights; the interval is
the optimum -+ t * standard deviation of the repeats; friction's is widened by what the model leaves.
Curvature: in four directions (friction, and stretching the object along each axis) the loss of every transition is
differenced. With H the mean Hessian and G the variance of the mean gradient, summed over neighbouring frames because
one contact lasts several (Newey and West 1987), the covariance is H^-1 G H^-1 (White 1982), bounded by a wide prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.special import stdtrit

from processing.contact.learn.fit import FRICTION, SHAPE, Model, fit
from processing.contact.physics.loss import StepData, Weights, contact_loss, idle_terms, step_terms

PRIOR_FRICTION, PRIOR_SIZE_M = 0.3, 0.02
"""Standard deviations that nothing was learned from."""
CONTACT_LASTS_S = 0.05
REFIT_SHARE = 0.12
"""Of the fit's iterations, for a repeat from the optimum."""
DIFFERENCE_FRICTION, DIFFERENCE_SIZE = 0.02, 0.03
"""Steps of the numerical derivatives: of friction and of the relative size. They reach over the kinks of the loss,
where another point becomes the lowest: closer by, a kink would pass for certainty."""
MODEL_FRICTION, MODEL_SIZE = 0.020, 0.10
"""Standard deviations (size: relative) that one toss leaves because the model is not the world (a rebound, a tilt of
the plane, corners that never touched): from these on the intervals of 95 % of 191 single real tosses hold the truth.
Of 175 other recordings those of friction then hold it in 99 %, those of edges in 96 % (tools/bench_intervals.py
one)."""


MODEL_SHARE = 0.07
"""Standard deviation of friction, relative, that stays with any number of tosses, because a step of the model is not
the world (a rebound, several contacts in one step). Set after three simulated shapes at 148 Hz missed their bootstrap
(tools/bench_contact.py shapes: .285 and .222 for .25), so it is no independent measurement; tools/bench_intervals.py
fast fits it on one half of many bodies and reports on the other."""


@dataclass(frozen=True, eq=False)
class Spread:
    """95 % half widths: of friction, of the extents along the axes, of each point, and by which method."""

    method: str
    friction: float
    extents_m: Float[Array, "3"]
    points_m: Float[Array, "v 3"] | None
    friction_seen: bool = True
    """Whether the tosses told friction."""


def extents(points_m: Float[Array, "v 3"]) -> Float[Array, "3"]:
    """Size along the three axes."""
    return np.ptp(points_m, axis=0)


def bootstrap(
    model: Model, optimum: Float[Array, " p"], data: StepData, weights: Weights, repeats: int, seed: int
) -> Spread:
    """Repeat the fit on tosses drawn with replacement."""
    rng = np.random.default_rng(seed)
    tosses, owner = np.unique(data.steps.toss, return_inverse=True)
    drawn = []
    for _ in range(repeats):
        counts = rng.multinomial(len(tosses), np.full(len(tosses), 1 / len(tosses)))
        part = data.rows(torch.arange(len(data), device=data.weight.device))
        part.weight = data.weight * torch.as_tensor(counts[owner], dtype=torch.float64, device=data.weight.device)
        drawn.append(fit(model, optimum, part, weights, REFIT_SHARE).parameters)
    values = np.array(drawn)
    # n / (n - 1): drawing with replacement narrows the spread of small samples
    width = float(stdtrit(max(len(tosses) - 1, 1), 0.975)) * (len(tosses) / max(len(tosses) - 1, 1)) ** 0.5
    points = np.array([model.geometry.points(torch.as_tensor(v[SHAPE])).numpy() for v in values])
    return Spread(
        "bootstrap over tosses",
        float(np.hypot(width * (values[:, FRICTION] ** 2).std(ddof=1), 1.96 * MODEL_SHARE * optimum[FRICTION] ** 2)),
        width * np.array([extents(p) for p in points]).std(axis=0, ddof=1),
        width * points.std(axis=0, ddof=1),
    )


def curvature(model: Model, optimum: Float[Array, " p"], data: StepData, weights: Weights) -> Spread:
    """Intervals of friction and extents from the loss around the optimum."""
    center = [float(optimum[FRICTION] ** 2), 1.0, 1.0, 1.0]
    steps = np.array([DIFFERENCE_FRICTION] + [DIFFERENCE_SIZE] * 3)

    def losses(move: Float[Array, "4"]) -> Float[Array, " n"]:
        return _row_losses(model, optimum, data, weights, np.maximum(np.array(center) + move, 1e-6))

    middle = losses(np.zeros(4))
    unit = np.diag(steps)
    plus, minus = [losses(u) for u in unit], [losses(-u) for u in unit]
    gradient = np.stack([(p - m) / (2 * h) for p, m, h in zip(plus, minus, steps)], 1)
    H = np.diag([float((p + m - 2 * middle).mean()) / h**2 for p, m, h in zip(plus, minus, steps)])
    for i in range(4):
        for j in range(i):
            both = losses(unit[i] + unit[j]) + losses(-unit[i] - unit[j])
            mixed = both - plus[i] - minus[i] - plus[j] - minus[j] + 2 * middle
            H[i, j] = H[j, i] = float(mixed.mean()) / (2 * steps[i] * steps[j])
    size = extents(model.numbers(optimum).points_m.cpu().numpy())
    prior = np.array([PRIOR_FRICTION, *(PRIOR_SIZE_M / size)])
    lasting = max(1, round(CONTACT_LASTS_S / float(np.median(data.steps.step_s))))
    covariance, freedom = _sandwich(H, gradient, data.steps.toss, lasting, prior)
    model_error = np.array([MODEL_FRICTION] + [MODEL_SIZE] * 3)
    curved = float(stdtrit(freedom, 0.975)) * np.sqrt(np.diag(covariance))
    width = np.sqrt(curved**2 + (1.96 * model_error) ** 2)
    return Spread("curvature of the loss", float(width[0]), width[1:] * size, None)


def _sandwich(
    H: Float[Array, "4 4"], gradient: Float[Array, "n 4"], toss: Int[Array, " n"], lag: int, prior: Float[Array, "4"]
) -> tuple[Float[Array, "4 4"], float]:
    """(information of the data + of the prior)^-1, and the degrees of freedom: contacts less parameters. Gradients of
    one contact lie up to `lag` transitions apart."""
    n = len(gradient)
    centered = gradient - gradient.mean(0)
    G = centered.T @ centered
    for k in range(1, lag + 1):
        pairs = (toss[k:] == toss[:-k])[:, None]
        cross = (centered[k:] * pairs).T @ centered[:-k]
        G += (1 - k / (lag + 1)) * (cross + cross.T)
    G = G / n**2
    values, vectors = np.linalg.eigh(H)
    H = vectors @ np.diag(np.maximum(values, 1e-9 * max(values.max(), 0.0))) @ vectors.T
    information = np.zeros((4, 4))  # where nothing touches, nothing depends on friction or size: the prior is left
    if np.trace(G) > 0:
        information = H @ np.linalg.solve(G + 1e-12 * np.trace(G) * np.eye(4), H)
    active = np.abs(gradient).sum(1) > 1e-3 * np.abs(gradient).sum(1).max()
    contacts = int((np.diff(active.astype(int), prepend=0) == 1).sum())
    return np.linalg.inv(information + np.diag(1 / prior**2)), float(max(contacts - 4, 2))


@torch.no_grad()
def _row_losses(
    model: Model, optimum: Float[Array, " p"], data: StepData, weights: Weights, moved: Float[Array, "4"]
) -> Float[Array, " n"]:
    """Loss of every transition with another friction and the object stretched along its axes."""
    parameters = optimum.copy()
    parameters[FRICTION] = moved[0] ** 0.5
    shape = parameters[SHAPE].reshape(-1, 3) * moved[1:]
    parameters[SHAPE] = shape.ravel()
    body = model.numbers(parameters)
    contacts = model.geometry.contacts
    impulses = contact_loss(data, body, contacts, weights).impulses
    out = torch.zeros(len(data), dtype=torch.float64, device=data.weight.device)
    for part in (step_terms(data, body, impulses, contacts), idle_terms(data, body, impulses, contacts)):
        out[part.rows] = part.total(weights)
    return (out * data.weight).cpu().numpy()


def plane_sensitivity(fitted: Model, optimum: Float[Array, " p"], data: StepData, weights: Weights) -> dict[str, float]:
    """What the learned numbers do when the plane is 1 mm higher: metres (or friction) per metre."""
    shift_m = 0.001
    low = data.rows(torch.arange(len(data), device=data.weight.device))
    low.position_m = data.position_m - data.position_m.new_tensor([0.0, 0.0, shift_m])
    moved = fit(fitted, optimum, low, weights, 0.3).parameters

    def size(parameters: Float[Array, " p"]) -> Float[Array, "3"]:
        return extents(fitted.numbers(parameters).points_m.cpu().numpy())

    change = (size(moved) - size(optimum)) / shift_m
    friction = float(moved[FRICTION] ** 2 - optimum[FRICTION] ** 2) / shift_m
    return {
        "mean_extent_m_per_m": float(change.mean()),
        "largest_extent_m_per_m": float(change[np.abs(change).argmax()]),
        "friction_per_m": friction,
    }
