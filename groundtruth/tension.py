"""Whether what was seen contradicts what was known of a pose beforehand."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth.factors import Prior, prior_terms

TOLD = 0.05
"""Share of a prior's variance that the rest must take away for a direction to say anything of it."""


def tension(prior: Prior, poses: Float[Array, "n 4 4"], covariance: Float[Array, "6 6"]) -> float:
    """By how many standard deviations what else is known of a pose contradicts its prior: root of the mean square.

    With the prior whitened to (0, 1), an answer w of covariance C from both leaves w ~ N(0, 1 - C) where they agree
    (the innovation, Bar-Shalom et al. 2001, 5.4). A direction of which nothing else is known (C near 1) tells nothing.
    """
    error = prior_terms([prior], poses)[0][0]
    told, directions = np.linalg.eigh(np.eye(6) - prior.root_information @ covariance @ prior.root_information.T)
    known = told > TOLD
    if not known.any():
        return 0.0
    return float(np.sqrt(((directions.T @ error)[known] ** 2 / told[known]).mean()))
