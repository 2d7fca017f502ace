"""The inner problem of the loss, and one step of a rollout: impulses in friction cones, solved in batch.

    minimise over lam in K   1/2 |A' lam|^2 + eps/2 |lam|^2 + q . lam,     K = product of Lorentz cones {n >= |t|}

A' maps the 3k impulse components of k contacts to the 6 directions of momentum, so the problem is solved in those 6
variables (the semi-analytic primal of Castro et al. 2022): v = A' lam is the minimiser of the convex, once
differentiable 1/2 |v|^2 + eps/2 |P_K(-(A v + q)/eps)|^2, found by Newton's method with a line search.
Components of a contact are in the order (tangent, tangent, normal), tangents already scaled by the friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import torch
from jaxtyping import Bool, Float
from torch import Tensor

MOST_ITERATIONS = 100
TOLERANCE = 1e-8
"""Of the momentum balance |v - A' lam|, relative to both."""
FLAT_ENOUGH = 0.5
"""A line search ends where the slope along the line has fallen to this share."""
SEARCH_STEPS = 8


@dataclass(frozen=True, eq=False)
class ConeSolution:
    """`impulse` in the cones, the 6 primal variables (a warm start for the next solve), and what did not converge."""

    impulse: Float[Tensor, "n k 3"]
    primal: Float[Tensor, "n 6"]
    failed: Bool[Tensor, " n"]
    iterations: int


@no_type_check  # called thousands of times: checking its shapes costs more than it
def project(y: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Nearest point of the Lorentz cone {y_2 >= |y_01|}."""
    tangent, normal = y[..., :2], y[..., 2]
    length = tangent.norm(dim=-1)
    half = 0.5 * (normal + length)
    edge = torch.cat([tangent * (half / length.clamp_min(1e-300))[..., None], half[..., None]], -1)
    inside, polar = length <= normal, length <= -normal
    out = torch.where(inside[..., None], y, edge)
    return torch.where((polar & ~inside)[..., None], torch.zeros_like(y), out)


@no_type_check
def project_jacobian(y: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3 3"]:
    """Derivative of `project`: on the cone's edge 1/2 [[(1+r) 1 - r u u', u], [u', 1]], r = normal / |tangent|."""
    tangent, normal = y[..., :2], y[..., 2]
    length = tangent.norm(dim=-1)
    inside, polar = length <= normal, length <= -normal
    u = tangent / length.clamp_min(1e-300)[..., None]
    r = torch.where(inside | polar, torch.zeros_like(normal), normal / length.clamp_min(1e-300))
    out = y.new_empty((*y.shape, 3))
    ux, uy = u[..., 0], u[..., 1]
    out[..., 0, 0] = 0.5 * (1 + r - r * ux * ux)
    out[..., 1, 1] = 0.5 * (1 + r - r * uy * uy)
    out[..., 0, 1] = out[..., 1, 0] = -0.5 * r * ux * uy
    out[..., 0, 2] = out[..., 2, 0] = 0.5 * ux
    out[..., 1, 2] = out[..., 2, 1] = 0.5 * uy
    out[..., 2, 2] = 0.5
    out = torch.where(inside[..., None, None], torch.eye(3, dtype=y.dtype, device=y.device), out)
    return torch.where((polar & ~inside)[..., None, None], torch.zeros_like(out), out)


def in_cone(q: Float[Tensor, "n k 3"]) -> Bool[Tensor, " n"]:
    """Whether q lies in K for every contact: then, K being its own dual, lam = 0 is the exact solution."""
    return (q[..., 2] >= q[..., :2].norm(dim=-1)).all(-1)


class _Batch:
    """The problems still being solved: their data, iterate, impulse and value. Rows leave as they converge."""

    def __init__(
        self, A: Float[Tensor, "n k3 6"], q: Float[Tensor, "n k3"], v: Float[Tensor, "n 6"], epsilon: float
    ) -> None:
        self.A, self.q, self.v, self.epsilon = A, q, v, epsilon
        self.rows = torch.arange(len(A), device=A.device)
        self.y, self.impulse, self.value = self.at(A, q, v)

    @no_type_check
    def at(
        self, A: Float[Tensor, "m k3 6"], q: Float[Tensor, "m k3"], v: Float[Tensor, "m 6"]
    ) -> tuple[Float[Tensor, "m k3"], Float[Tensor, "m k3"], Float[Tensor, " m"]]:
        y = -(torch.bmm(A, v[..., None])[..., 0] + q) / self.epsilon
        impulse = project(y.view(len(y), y.shape[1] // 3, 3)).view(y.shape)
        return y, impulse, 0.5 * v.square().sum(-1) + 0.5 * self.epsilon * impulse.square().sum(-1)

    @no_type_check
    def keep(self, rows: Bool[Tensor, " n"]) -> None:
        for name in ("A", "q", "v", "rows", "y", "impulse", "value"):
            setattr(self, name, getattr(self, name)[rows])

    @no_type_check
    def momentum(self) -> Float[Tensor, "n 6"]:
        return torch.bmm(self.A.transpose(1, 2), self.impulse[..., None])[..., 0]

    @no_type_check
    def newton(self, gradient: Float[Tensor, "n 6"]) -> Float[Tensor, "n 6"]:
        n, k3, _ = self.A.shape
        D = project_jacobian(self.y.view(n, -1, 3))
        DA = torch.matmul(D, self.A.view(n, -1, 3, 6)).view(n, k3, 6)
        H = torch.bmm(self.A.transpose(1, 2), DA) / self.epsilon
        H.diagonal(dim1=1, dim2=2).add_(1.0)
        factor, _ = torch.linalg.cholesky_ex(H)
        return -torch.cholesky_solve(gradient[..., None], factor)[..., 0]

    @no_type_check
    def search(self, direction: Float[Tensor, "n 6"], slope: Float[Tensor, " n"]) -> None:
        """Step along a direction to where the slope of the value has nearly vanished.

        The value is convex along the line, so the root of its slope is bracketed by 0 and 1 wherever the full step
        overshoots; it is found by the Illinois form of regula falsi.
        """
        Ad = torch.bmm(self.A, direction[..., None])[..., 0]
        v = self.v + direction
        y, impulse, value = self.at(self.A, self.q, v)
        slope_end = (direction * v).sum(-1) - (Ad * impulse).sum(-1)
        rows = (slope_end > FLAT_ENOUGH * slope.abs()).nonzero()[:, 0]
        low, high = torch.zeros_like(slope[rows]), torch.ones_like(slope[rows])
        at_low, at_high = slope[rows].clone(), slope_end[rows]
        for _ in range(SEARCH_STEPS):
            if len(rows) == 0:
                break
            length = low + (high - low) * (at_low / (at_low - at_high)).clamp(0.05, 0.95)
            v[rows] = self.v[rows] + length[:, None] * direction[rows]
            y[rows], impulse[rows], value[rows] = self.at(self.A[rows], self.q[rows], v[rows])
            here = (direction[rows] * v[rows]).sum(-1) - (Ad[rows] * impulse[rows]).sum(-1)
            left = here < 0
            at_high = torch.where(left, 0.5 * at_high, here)
            at_low = torch.where(left, here, 0.5 * at_low)
            low, high = torch.where(left, length, low), torch.where(left, high, length)
            more = here.abs() > FLAT_ENOUGH * slope[rows].abs()
            rows, low, high, at_low, at_high = (x[more] for x in (rows, low, high, at_low, at_high))
        self.v, self.y, self.impulse, self.value = v, y, impulse, value


@torch.no_grad()
def solve_cones(
    A: Float[Tensor, "n k 3 6"],
    q: Float[Tensor, "n k 3"],
    epsilon: float,
    start: Float[Tensor, "n 6"] | None = None,
    tolerance: float = TOLERANCE,
) -> ConeSolution:
    """Solve n problems of k contacts at once. `start` is the `primal` of an earlier, similar solve.

    A row that is not solved after MOST_ITERATIONS, or whose numbers overflow, is marked in `failed`. On a CPU the rows
    run through compiled code (solver_cpu), on CUDA as one batch (solve_batch).
    """
    if A.device.type != "cpu":
        return solve_batch(A, q, epsilon, start, tolerance)
    from processing.contact.physics.solver_cpu import solve_rows

    n, k = A.shape[:2]
    primal = A.new_zeros((n, 6)) if start is None else start.clone()
    rows, offset = A.reshape(n, 3 * k, 6).contiguous().numpy(), q.reshape(n, 3 * k).contiguous().numpy()
    found, unsolved, iterations = solve_rows(
        rows, offset, epsilon, primal.numpy(), tolerance, MOST_ITERATIONS, FLAT_ENOUGH, SEARCH_STEPS
    )
    impulse, failed = torch.from_numpy(found), torch.from_numpy(unsolved)
    failed |= ~torch.isfinite(impulse).all(-1)
    return ConeSolution(impulse.view(n, k, 3), primal, failed, int(iterations))


@torch.no_grad()
def solve_batch(
    A: Float[Tensor, "n k 3 6"],
    q: Float[Tensor, "n k 3"],
    epsilon: float,
    start: Float[Tensor, "n 6"] | None = None,
    tolerance: float = TOLERANCE,
) -> ConeSolution:
    """The same on any device, all rows at once; rows leave the batch as they converge."""
    n, k = A.shape[:2]
    begin = A.new_zeros((n, 6)) if start is None else start.clone()
    batch = _Batch(A.reshape(n, 3 * k, 6), q.reshape(n, 3 * k), begin, epsilon)
    impulse, primal = A.new_zeros((n, 3 * k)), begin.clone()
    failed = torch.ones(n, dtype=torch.bool, device=A.device)

    def store(rows: Bool[Tensor, " m"]) -> None:
        at = batch.rows[rows]
        impulse[at], primal[at], failed[at] = batch.impulse[rows], batch.v[rows], False
        batch.keep(~rows)

    iterations = 0
    while len(batch.rows) and iterations < MOST_ITERATIONS:
        iterations += 1
        momentum = batch.momentum()
        gradient = batch.v - momentum
        scale = torch.maximum(batch.v.norm(dim=-1), momentum.norm(dim=-1))
        done = gradient.norm(dim=-1) <= 1e-14 + tolerance * scale
        if bool(done.any()):
            store(done)
            gradient = gradient[~done]
        if len(batch.rows) == 0:
            break
        direction = batch.newton(gradient)
        slope = (gradient * direction).sum(-1)
        flat = -slope <= 1e-13 * batch.value + 1e-22  # no further fall within rounding
        if bool(flat.any()):
            store(flat)
            direction, slope = direction[~flat], slope[~flat]
        if len(batch.rows):
            batch.search(direction, slope)
    if len(batch.rows):
        impulse[batch.rows], primal[batch.rows] = batch.impulse, batch.v
    failed |= ~torch.isfinite(impulse).all(-1)
    return ConeSolution(impulse.view(n, k, 3), primal, failed, iterations)
