"""The one solver of least squares: laws that it must keep, and problems whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import spsolve

from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight


def of(residuals, jacobian):
    return lambda x: Expansion.of_residuals(residuals(x), jacobian(x))


def test_a_linear_problem_is_solved_as_numpy_solves_it():
    random = np.random.default_rng(0)
    A, b = random.normal(size=(20, 4)), random.normal(size=20)
    found = minimised(np.zeros(4), of(lambda x: A @ x - b, lambda x: A), np.add, 10, 1e-12)
    assert found.state == pytest.approx(np.linalg.lstsq(A, b, rcond=None)[0], abs=1e-9)
    assert found.steps <= 3
    assert found.at.gradient == pytest.approx(0, abs=1e-8)


def test_rosenbrocks_valley_is_followed_to_its_end():
    found = minimised(
        np.array([-1.2, 1.0]),
        of(
            lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]),
            lambda x: np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]),
        ),
        np.add,
        100,
        1e-12,
    )
    assert found.state == pytest.approx([1, 1], abs=1e-6)


def test_a_step_that_raises_the_cost_is_not_taken():
    """From 3, Gauss and Newton's step for arctan overshoots to -9.5 and further every time."""
    tried = []

    def expanded(x):
        tried.append(float(x[0]))
        return Expansion.of_residuals(np.arctan(x), np.array([[1 / (1 + float(x[0]) ** 2)]]))

    found = minimised(np.array([3.0]), expanded, np.add, 60, 0.0)
    assert tried[1] == pytest.approx(3 - 10 * np.arctan(3), rel=1e-3)
    assert found.state == pytest.approx([0.0], abs=1e-6)


def test_costs_that_are_not_numbers_are_steps_back():
    """The logarithm has no value where the first step would go."""
    found = minimised(
        np.array([20.0]),
        lambda x: Expansion.of_residuals(
            np.log(x) if x[0] > 0 else np.array([np.nan]), np.array([[1 / max(float(x[0]), 1e-9)]])
        ),
        np.add,
        60,
        0.0,
    )
    assert found.state == pytest.approx([1.0], abs=1e-6)


def test_no_more_steps_are_tried_than_are_allowed_and_the_start_stays_where_none_helps():
    at = np.array([0.5])
    found = minimised(at, lambda x: Expansion(float(abs(x[0] - 0.5)), np.eye(1), np.ones(1)), np.add, 7, 0.0)
    assert found.steps == 7
    assert found.state is at


def test_an_unknown_that_nothing_tells_of_does_not_move():
    A = np.array([[1.0, 0.0], [2.0, 0.0]])
    found = minimised(np.array([0.0, 4.0]), of(lambda x: A @ x - np.array([1.0, 2.0]), lambda x: A), np.add, 10, 1e-12)
    assert found.state == pytest.approx([1.0, 4.0])


def test_a_prior_makes_it_the_mean_of_two_measurements():
    """A measurement 3 +- 1 and a prior 0 +- 2 are 2.4 together, +- sqrt(.8)."""

    def expanded(x):
        return Expansion.of_residuals(x - 3.0, np.eye(1)).with_prior(np.eye(1) / 4, x)

    found = minimised(np.zeros(1), expanded, np.add, 10, 0.0)
    assert found.state == pytest.approx([2.4])
    assert 1 / found.at.information[0, 0] == pytest.approx(0.8)
    assert found.at.cost == pytest.approx(0.5 * (0.6**2 + 2.4**2 / 4))


def test_a_robust_cost_has_the_gradient_that_its_weights_say():
    random = np.random.default_rng(1)
    A, b = random.normal(size=(30, 3)), 3 * random.normal(size=30)

    def expanded(x):
        r = A @ x - b
        root = np.sqrt(huber_weight(np.abs(r), 1.0))
        return Expansion.of_residuals(root * r, root[:, None] * A, float(huber_cost(np.abs(r), 1.0).sum()))

    x, h = random.normal(size=3), 1e-6
    slopes = [(expanded(x + h * e).cost - expanded(x - h * e).cost) / (2 * h) for e in np.eye(3)]
    assert expanded(x).gradient == pytest.approx(slopes, rel=1e-5)
    found = minimised(np.zeros(3), expanded, np.add, 100, 1e-14)
    assert found.at.gradient == pytest.approx(0, abs=1e-4)


def test_the_equations_may_be_sparse_and_the_state_a_rotation():
    """Whatever moves a state and solves its equations: a turn in the plane onto its target."""
    points = np.random.default_rng(2).normal(size=(10, 2))

    def turned(a):
        return np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])

    wanted = points @ turned(1.9).T

    def expanded(R):
        now = points @ R.T
        return sparse_of(Expansion.of_residuals(now - wanted, np.stack([-now[:, 1], now[:, 0]], -1)[..., None]))

    def sparse_of(at):
        return Expansion(at.cost, sparse.csc_matrix(at.information), at.gradient)

    def solved(information, right, damping):
        return np.atleast_1d(spsolve(information * (1 + damping), right))

    found = minimised(np.eye(2), expanded, lambda R, step: turned(float(step[0])) @ R, 50, 0.0, solved)
    assert found.state == pytest.approx(turned(1.9), abs=1e-6)
