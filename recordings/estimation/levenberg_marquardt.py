"""The method of Levenberg and Marquardt: the one solver of nonlinear least squares, whatever is estimated.

About a state the cost is, to second order in a step s of its tangent space, c + g . s + s' H s / 2, with H the Gauss-
Newton information and g the gradient. The step tried solves (H + d diag H) s = -g (Marquardt 1963). It is taken where
the cost falls, and the damping d then falls; where the cost does not fall the state stays, and d grows. What a state
is, how it moves and how its equations are solved (dense, sparse in an order of elimination, banded) is the caller's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

State = TypeVar("State")

FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e-9, 1e8
"""Share of H's diagonal: that of the first step, near Gauss and Newton's; and the bounds between which it follows. A
step so short that the last one does not help lowers no cost."""
FACTOR = 10.0
"""By which damping falls or grows (Marquardt's)."""


@dataclass(frozen=True, eq=False)
class Expansion:
    """The cost about a state (half the sum of squared residuals, or what robust kernels make of it), its information H
    (d, d; dense or sparse) and its gradient g (d)."""

    cost: float
    information: Any
    gradient: Float[Array, " d"]

    @staticmethod
    def of_residuals(
        residuals: Float[Array, "*n"], jacobian: Float[Array, "*n d"], cost: float | None = None
    ) -> Expansion:
        """Of residuals (each times the root of its weight) with their derivatives; `cost`: what a robust kernel makes
        of them, else half the sum of their squares."""
        r, J = residuals.reshape(-1), jacobian.reshape(-1, jacobian.shape[-1])
        return Expansion(0.5 * float(r @ r) if cost is None else cost, J.T @ J, J.T @ r)

    def with_prior(self, information: Float[Array, "d d"], off: Float[Array, " d"]) -> Expansion:
        """With what else is known of the state, which is `off` from it."""
        pull = information @ off
        return Expansion(self.cost + 0.5 * float(off @ pull), self.information + information, self.gradient + pull)


@dataclass(frozen=True, eq=False)
class Minimum(Generic[State]):
    """Where the cost is least, its expansion there, and how many steps were tried."""

    state: State
    at: Any
    steps: int


Solve = Callable[[Any, Float[Array, " d"], float], Float[Array, " d"]]


def minimised(
    start: State,
    expanded: Callable[[State], Expansion],
    moved: Callable[[State, Float[Array, " d"]], State],
    steps: int,
    least_gain: float,
    solved: Solve | None = None,
) -> Minimum[State]:
    """The state of least cost near `start`, after at most so many steps, or when one lowers the cost by less than this
    share of it. `solved(H, g, d)` solves the damped equations for -s (default: `dense`); whatever it raises where they
    are singular goes to the caller. A cost that is not a number counts as one that does not fall."""
    solved = solved or dense
    state, at, damping, tried = start, expanded(start), FIRST_DAMPING, 0
    while tried < steps and damping <= MOST_DAMPING:
        tried += 1
        candidate = moved(state, -solved(at.information, at.gradient, damping))
        there = expanded(candidate)
        if not there.cost <= at.cost:
            damping *= FACTOR
            continue
        gain = at.cost - there.cost
        state, at, damping = candidate, there, max(damping / FACTOR, LEAST_DAMPING)
        if gain <= least_gain * at.cost:
            break
    return Minimum(state, at, tried)


def dense(information: Float[Array, "d d"], right: Float[Array, " d"], damping: float) -> Float[Array, " d"]:
    """The solution of (H + damping diag H) s = right. An unknown that nothing tells of does not move."""
    diagonal = np.diag(information)
    untold = diagonal <= 0
    return np.linalg.solve(information + np.diag(damping * diagonal + untold), right)
