"""Simulating the learned body from a toss's first state, and how far that ends from the toss.

One step (Anitescu 2006, as dair_pll rolls out): the impulses are the minimiser of 1/2 f' D f + f'(J v- + phi/dt e_n) in
the friction cones, where v- is the velocity of free flight; then the implicit Euler step of `motion`. Impacts are
inelastic: a penetrating point leaves at phi/dt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from torch import Tensor

from processing.contact.friction.forecast import STEP_S, Law
from processing.contact.physics.loss import REFERENCE_MASS_KG, Body, jacobian, point_velocity
from processing.contact.physics.solver import in_cone, solve_cones
from processing.motion.trajectory import PoseSeries, rotation_matrices, rotation_vectors
from recordings.constants import GRAVITY_M_S2

EPSILON = 1e-4
TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Start:
    """States to roll out from, one row per toss: of the prior's centre of mass, in the world with the plane at z =
    0."""

    rotation: Float[Array, "n 3 3"]
    position_m: Float[Array, "n 3"]
    spin_object_rad_s: Float[Array, "n 3"]
    velocity_world_m_s: Float[Array, "n 3"]


@dataclass(frozen=True, eq=False)
class Rollout:
    """Simulated poses after each step; `failures` counts unsolved steps."""

    rotation: Float[Array, "n t 3 3"]
    position_m: Float[Array, "n t 3"]
    failures: int


@dataclass(frozen=True, eq=False)
class _Bodies:
    """One body per row, of the same inertia."""

    points_m: Float[Tensor, "n v 3"]
    friction: Float[Tensor, " n"]
    inertia_kgm2: Float[Tensor, "3 3"]

    @staticmethod
    def stack(bodies: Sequence[Body], owner: Sequence[int]) -> _Bodies:
        def rows(values: list[Tensor]) -> Tensor:
            return torch.stack(values)[torch.as_tensor(owner, device=values[0].device)]

        return _Bodies(rows([b.points_m for b in bodies]), rows([b.friction for b in bodies]), bodies[0].inertia_kgm2)

    def lowest(
        self, rotation: Float[Tensor, "n 3 3"], position_m: Float[Tensor, "n 3"], contacts: int
    ) -> tuple[Float[Tensor, "n k 3"], Float[Tensor, "n k"]]:
        heights = torch.bmm(self.points_m, rotation[:, 2, :, None])[..., 0] + position_m[:, 2:]
        index = torch.topk(heights, min(contacts, heights.shape[1]), dim=1, largest=False).indices
        return self.points_m.gather(1, index[..., None].expand(-1, -1, 3)), heights.gather(1, index)


@torch.no_grad()
def simulate(
    bodies: Body | Sequence[Body],
    contacts: int,
    start: Start,
    steps: int,
    step_s: float,
    owner: Sequence[int] | None = None,
) -> Rollout:
    """Roll all starts out together. With several bodies (of one inertia), `owner` says which body each start is of."""
    several = [bodies] if isinstance(bodies, Body) else list(bodies)
    body = _Bodies.stack(several, [0] * len(start.position_m) if owner is None else owner)

    def tensor(values: Float[Array, "*n"]) -> Tensor:
        return torch.as_tensor(values, dtype=torch.float64, device=body.points_m.device)

    rotation, spin = tensor(start.rotation), tensor(start.spin_object_rad_s)
    position, velocity = tensor(start.position_m), tensor(start.velocity_world_m_s)
    warm = position.new_zeros((len(position), 6))
    rotations, positions, failures = [], [], 0
    for _ in range(steps):
        spin, velocity, warm, failed = _after_contact(body, contacts, rotation, position, spin, velocity, warm, step_s)
        failures += failed
        rotation = rotation @ _exp(step_s * spin)
        position = position + step_s * velocity
        rotations.append(rotation)
        positions.append(position)
    return Rollout(torch.stack(rotations, 1).cpu().numpy(), torch.stack(positions, 1).cpu().numpy(), failures)


def simulate_law(body: Body, contacts: int, law: Law, start: Start, steps: int, step_s: float) -> Rollout:
    """The same under a law of contact that rebounds, in finer steps of about STEP_S; `start` is for those
    (fine_steps)."""
    from processing.contact.physics.steps_cpu import roll_rows

    points = body.points_m.cpu().numpy()
    rotation, spin = np.array(start.rotation), np.array(start.spin_object_rad_s)
    position, velocity = np.array(start.position_m), np.array(start.velocity_world_m_s)
    laws, owner = np.array([[law.friction, law.restitution]]), np.zeros(len(position), dtype=np.int64)
    inertia, count = body.inertia_kgm2.cpu().numpy(), fine_steps(step_s)
    most = min(contacts, len(points))
    rotations, positions, failures = [], [], 0
    for _ in range(steps):
        state = (rotation, position, spin, velocity)
        _, failed = roll_rows(*state, owner, laws, points, inertia, REFERENCE_MASS_KG, most, count, step_s / count)
        failures += failed
        rotations.append(rotation.copy())
        positions.append(position.copy())
    return Rollout(np.stack(rotations, 1), np.stack(positions, 1), failures)


def fine_steps(step_s: float) -> int:
    """How many steps of about STEP_S a step of a rollout is made of under a law."""
    return max(round(step_s / STEP_S), 1)


def _after_contact(
    body: _Bodies,
    contacts: int,
    rotation: Float[Tensor, "n 3 3"],
    position: Float[Tensor, "n 3"],
    spin: Float[Tensor, "n 3"],
    velocity: Float[Tensor, "n 3"],
    warm: Float[Tensor, "n 6"],
    step_s: float,
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 6"], int]:
    """Velocities after one step of flight and contact, the warm starts of the next one, and how many did not solve."""
    gyro = torch.linalg.cross(spin, spin @ body.inertia_kgm2)
    spin = spin - step_s * torch.linalg.solve(body.inertia_kgm2, gyro.T).T
    velocity = velocity + step_s * position.new_tensor([0.0, 0.0, -GRAVITY_M_S2])
    arm, height = body.lowest(rotation, position, contacts)
    q = point_velocity(rotation, arm, spin, velocity)
    q[..., :2] *= body.friction[:, None, None]
    q[..., 2] += height / step_s
    rows = (~in_cone(q)).nonzero()[:, 0]
    if len(rows) == 0:
        return spin, velocity, torch.zeros_like(warm), 0
    A = jacobian(rotation[rows], body.friction[rows], body.inertia_kgm2, arm[rows])
    solved = solve_cones(A, q[rows], EPSILON, warm[rows], TOLERANCE)
    momentum = torch.einsum("nkij,nki->nj", A, solved.impulse)
    root = torch.linalg.cholesky(torch.linalg.inv(body.inertia_kgm2))
    spin = spin.index_add(0, rows, momentum[:, :3] @ root.T)
    velocity = velocity.index_add(0, rows, momentum[:, 3:] / REFERENCE_MASS_KG**0.5)
    warm = torch.zeros_like(warm).index_copy(0, rows, solved.primal)
    return spin, velocity, warm, int(solved.failed.sum())


def _exp(vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    zero = torch.zeros_like(vectors[:, 0])
    x, y, z = vectors.unbind(-1)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).view(-1, 3, 3)
    angle = vectors.norm(dim=-1)[:, None, None]
    eye = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    return eye + torch.sinc(angle / torch.pi) * K + 0.5 * torch.sinc(angle / (2 * torch.pi)) ** 2 * (K @ K)


def resampled(series: PoseSeries, times_s: Float[Array, " t"]) -> PoseSeries:
    """Poses at given times: positions linear, rotations along the geodesic between neighbours."""
    after = np.clip(np.searchsorted(series.time_s, times_s), 1, len(series) - 1)
    before = after - 1
    share = ((times_s - series.time_s[before]) / (series.time_s[after] - series.time_s[before]))[:, None]
    p = series.position_m
    turn = rotation_vectors(np.swapaxes(series.rotation[before], 1, 2) @ series.rotation[after])
    return PoseSeries(
        series.toss,
        times_s,
        series.rotation[before] @ rotation_matrices(share * turn),
        p[before] + share * (p[after] - p[before]),
    )


@dataclass(frozen=True, eq=False)
class RolloutErrors:
    """Errors of a rollout against the track, step by step; NaN where a toss has ended."""

    tosses: tuple[int, ...]
    step_s: float
    position_m: Float[Array, "n t"]
    rotation_rad: Float[Array, "n t"]
    failures: int

    @property
    def per_toss_m(self) -> Float[Array, " n"]:
        return np.nanmean(self.position_m, axis=1)

    @property
    def per_toss_rad(self) -> Float[Array, " n"]:
        return np.nanmean(self.rotation_rad, axis=1)


def rollout_errors(rolled: Rollout, series: Sequence[PoseSeries], begin: Sequence[int], step_s: float) -> RolloutErrors:
    """Compare with the tracks (of the same point), each from its frame `begin` on."""
    steps = rolled.position_m.shape[1]
    position = np.full((len(series), steps), np.nan)
    rotation = np.full((len(series), steps), np.nan)
    for i, (track, first) in enumerate(zip(series, begin)):
        times = track.time_s[first] + step_s * np.arange(1, steps + 1)
        count = int((times <= track.time_s[-1] + 0.1 * step_s).sum())
        if count == 0:
            continue
        true = resampled(track, np.minimum(times[:count], track.time_s[-1]))
        position[i, :count] = np.linalg.norm(rolled.position_m[i, :count] - true.position_m, axis=1)
        turn = np.swapaxes(true.rotation, 1, 2) @ rolled.rotation[i, :count]
        rotation[i, :count] = np.linalg.norm(rotation_vectors(turn), axis=1)
    return RolloutErrors(tuple(s.toss for s in series), step_s, position, rotation, rolled.failures)


def started(keep: Bool[Array, " n"], start: Start) -> Start:
    """Some rows of the starts."""
    return Start(*(value[keep] for value in vars(start).values()))
