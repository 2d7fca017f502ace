import clarabel
import numpy as np
import pytest
import scipy.sparse
import torch

from processing.contact.physics.solver import in_cone, project, project_jacobian, solve_batch, solve_cones


def problems(count, contacts, seed):
    """As J M^-1/2 is (loss.jacobian): what moves the body as a whole moves each point along the same axis alone."""
    rng = np.random.default_rng(seed)
    A = torch.as_tensor(rng.standard_normal((count, contacts, 3, 6)))
    A[..., 3:] *= torch.eye(3)
    return A, torch.as_tensor(rng.standard_normal((count, contacts, 3)))


def by_clarabel(A, q, epsilon):
    """The same program, one at a time, by an interior-point method: least value and its impulses."""
    k = len(q)
    rows = A.reshape(3 * k, 6)
    P = scipy.sparse.triu(rows @ rows.T + epsilon * np.eye(3 * k)).tocsc()
    order = np.concatenate([[3 * i + 2, 3 * i, 3 * i + 1] for i in range(k)])
    G = scipy.sparse.csc_matrix(-np.eye(3 * k)[order])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    cones = [clarabel.SecondOrderConeT(3)] * k
    solution = clarabel.DefaultSolver(P, q.ravel(), G, np.zeros(3 * k), cones, settings).solve()
    x = np.array(solution.x)
    return 0.5 * np.sum((rows.T @ x) ** 2) + 0.5 * epsilon * x @ x + q.ravel() @ x, x.reshape(k, 3)


def value(A, q, epsilon, impulse):
    momentum = np.einsum("kij,ki->j", A, impulse)
    return 0.5 * momentum @ momentum + 0.5 * epsilon * np.sum(impulse**2) + np.sum(q * impulse)


@pytest.mark.parametrize("solve", [solve_cones, solve_batch])
@pytest.mark.parametrize("contacts", [1, 4, 10])
def test_agrees_with_an_interior_point_solver_to_1e_6(contacts, solve):
    A, q = problems(40, contacts, seed=contacts)
    solved = solve(A, q, 1e-3)
    assert not solved.failed.any()
    for i in range(len(A)):
        wanted, impulse = by_clarabel(A[i].numpy(), q[i].numpy(), 1e-3)
        reached = value(A[i].numpy(), q[i].numpy(), 1e-3, solved.impulse[i].numpy())
        assert reached <= wanted + max(1e-6, 1e-7 * abs(wanted))  # among feasible impulses the lower is the better one
        assert (solved.impulse[i, :, 2] - solved.impulse[i, :, :2].norm(dim=-1)).min() > -1e-9
        np.testing.assert_allclose(solved.impulse[i], impulse, atol=2e-4 * max(1.0, np.abs(impulse).max()))


@pytest.mark.parametrize("contacts", [1, 4, 10])
def test_compiled_rows_and_the_batch_are_one_algorithm(contacts):
    A, q = problems(300, contacts, seed=5)
    start = torch.as_tensor(np.random.default_rng(1).standard_normal((300, 6)))
    rows, batch = (solve(A, q, 1e-3, start) for solve in (solve_cones, solve_batch))
    torch.testing.assert_close(rows.impulse, batch.impulse, rtol=1e-7, atol=1e-8)
    torch.testing.assert_close(rows.primal, batch.primal, rtol=1e-7, atol=1e-8)
    assert rows.iterations == batch.iterations


def test_impulses_lie_in_their_cones():
    A, q = problems(200, 4, seed=7)
    impulse = solve_cones(A, q, 1e-3).impulse
    assert (impulse[..., 2] - impulse[..., :2].norm(dim=-1)).min() > -1e-9


def test_screening_is_exact():
    A, q = problems(2000, 2, seed=3)
    q[..., 2] += 1.5
    free = in_cone(q)
    assert 0 < free.sum() < len(q)
    pushed = solve_cones(A, q, 1e-3).impulse.norm(dim=(1, 2)) > 1e-9
    assert torch.equal(pushed, ~free)


def test_a_warm_start_gives_the_same_answer_sooner():
    A, q = problems(30, 4, seed=11)
    cold = solve_cones(A, q, 1e-3)
    warm = solve_cones(A, q * 1.001, 1e-3, cold.primal)
    again = solve_cones(A, q * 1.001, 1e-3)
    torch.testing.assert_close(warm.impulse, again.impulse, atol=1e-3, rtol=1e-4)
    assert warm.iterations < cold.iterations


def test_what_cannot_be_solved_is_said():
    A, q = problems(3, 2, seed=5)
    q[1, 0, 0] = float("nan")
    assert solve_cones(A, q, 1e-3).failed.tolist() == [False, True, False]


def test_no_problems_are_no_trouble():
    A, q = problems(0, 4, seed=0)
    assert solve_cones(A, q, 1e-3).impulse.shape == (0, 4, 3)


def test_projection_is_nearest_and_its_jacobian_its_derivative():
    rng = np.random.default_rng(0)
    y = torch.as_tensor(rng.standard_normal((500, 3)))
    p = project(y)
    torch.testing.assert_close(project(p), p)
    assert ((y - p) * p).sum(-1).abs().max() < 1e-12  # Moreau: what is left is at right angles
    h = 1e-6
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = h
        difference = (project(y + step) - project(y - step)) / (2 * h)
        assert (difference - project_jacobian(y)[..., axis]).abs().max() < 1e-4
