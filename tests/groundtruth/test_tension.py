"""Whether a bumped camera is called one: the test's level is what it says it is."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from groundtruth import se3
from groundtruth.factors import Prior
from groundtruth.tension import Tension, tension

SIGMA = np.array([1e-3, 1e-3, 1e-3, 5e-4, 5e-4, 5e-4])
SEEN = np.array([0.1, 0.5, 1.0, 3.0, 0.02, 1e3])
"""Variance of what was seen, in units of the prior's; the last direction is hardly seen at all."""


def draws(count, bump=0.0):
    """Tensions of a pose that was drawn from its prior, was then bumped (in its deviations, the first direction) and
    was seen with noise: solved from both, as least squares do."""
    rng = np.random.default_rng(3)
    prior = Prior(0, np.eye(4), np.diag(1 / SIGMA))
    true = rng.normal(size=(count, 6)) + bump * np.eye(6)[0]
    solved = (true + np.sqrt(SEEN) * rng.normal(size=(count, 6))) / (1 + SEEN)
    covariance = np.diag(SIGMA**2 * SEEN / (1 + SEEN))
    return [tension(prior, se3.exp((SIGMA * w)[None]), covariance) for w in solved]


def test_a_direction_that_nothing_tells_of_does_not_count():
    assert {found.directions for found in draws(3)} == {5}
    assert Tension().chance() == 1.0


def test_without_a_bump_every_chance_is_as_frequent_as_it_says():
    assert kstest([found.chance() for found in draws(400)], "uniform").pvalue > 0.01
    worst = [min(triple, key=Tension.chance) for triple in zip(*[iter(draws(600))] * 3, strict=True)]
    assert kstest([found.chance(tested=3) for found in worst], "uniform").pvalue > 0.01


def test_a_bump_of_many_deviations_is_no_chance_at_all():
    assert all(found.chance(tested=3) < 0.02 for found in draws(50, bump=12.0))


def test_more_poses_tested_mislead_more_often():
    found = Tension(float(np.sqrt(chi2.isf(0.02, 6) / 6)), 6)
    assert found.chance() == pytest.approx(0.02)
    assert found.chance(tested=3) == pytest.approx(1 - 0.98**3)
