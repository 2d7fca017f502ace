"""Whether what was seen contradicts what was known of a pose beforehand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.stats import chi2

from groundtruth.factors import Prior, prior_terms

LEAST_SHARE = 0.05
"""Share of a prior's variance that the rest must take away for a direction to say anything of it."""


@dataclass(frozen=True)
class Tension:
    """By how many standard deviations a prior is contradicted: root of the mean square over directions that tell."""

    deviations: float = 0.0
    directions: int = 0

    def chance(self, tested: int = 1) -> float:
        """How likely the most pulled of so many poses is pulled as far where none is wrong: the squares add up to a
        chi-square of as many degrees of freedom as there are directions, and every pose tested may mislead (Sidak)."""
        if not self.directions:
            return 1.0
        alone = float(chi2.sf(self.directions * self.deviations**2, self.directions))
        return float(-np.expm1(tested * np.log1p(-alone))) if alone < 1 else 1.0


def tension(prior: Prior, poses: Float[Array, "n 4 4"], covariance: Float[Array, "6 6"]) -> Tension:
    """How far what else is known of a pose pulls it from its prior.

    With the prior whitened to (0, 1), an answer w of covariance C from both leaves w ~ N(0, 1 - C) where they agree
    (the innovation, Bar-Shalom et al. 2001, 5.4). A direction of which nothing else is known (C near 1) tells nothing.
    """
    error = prior_terms([prior], poses)[0][0]
    share, directions = np.linalg.eigh(np.eye(6) - prior.root_information @ covariance @ prior.root_information.T)
    known = share > LEAST_SHARE
    if not known.any():
        return Tension()
    squares = (directions.T @ error)[known] ** 2 / share[known]
    return Tension(float(np.sqrt(squares.mean())), int(known.sum()))
