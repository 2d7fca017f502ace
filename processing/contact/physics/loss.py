"""The ContactNets loss, term by term, over all transitions at once.

After Pfrommer, Halm and Posa 2020 in the form of dair_pll (Bianchini et al. 2023). For a transition to the state (R, p)
with velocities before and after, its k lowest points i with height phi_i and velocity v_i, and dv the change of
velocity
that free flight does not explain:

    L = min over lam in K of  w_pred [1/2 dv' M dv - lam' J dv + 1/2 lam' (D + eps) lam]     prediction
                            + w_comp sum_i lam_n,i |phi_i|                                   complementarity
                            + w_diss sum_i dt (mu lam_t,i . v_t,i + lam_n,i mu |v_t,i|)      maximal dissipation
                            + w_pen  sum_i max(0, -phi_i)^2                                  non-penetration
    D = J M^-1 J',   J's rows of a contact: (mu t1, mu t2, n),   K = product of {lam_n >= |lam_t|}

Everything is evaluated in the later state. The gradient is the envelope theorem's: lam is a constant in it. The
plane is
z = 0. Mass cannot be observed in tosses, so M is always that of REFERENCE_MASS_KG (the cube of the paper) with the
inertia in proportion: eps and the weights then mean the same for every object.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from processing.contact.physics.solver import in_cone, solve_cones
from processing.motion.trajectory import Steps
from recordings.constants import GRAVITY_M_S2

REFERENCE_MASS_KG = 0.37
EPSILON = 1e-3
"""Regularisation of the impulses (dair_pll's), in 1/kg at the reference mass."""
TINY = 1e-16


@dataclass(frozen=True)
class Weights:
    """Of the four terms. All 1: the paper's."""

    prediction: float = 1.0
    complementarity: float = 1.0
    dissipation: float = 1.0
    penetration: float = 1.0


@dataclass(frozen=True)
class ContactTerms:
    """Weighted mean over transitions, before the terms' own weights. Units: J, N s m, N s m, m^2."""

    prediction: float
    complementarity: float
    dissipation: float
    penetration: float

    def total(self, weights: Weights) -> float:
        return sum(getattr(self, f.name) * getattr(weights, f.name) for f in fields(self))


@dataclass(frozen=True, eq=False)
class Body:
    """What a parameter vector stands for. Points are relative to the prior's centre of mass."""

    points_m: Float[Tensor, "v 3"]
    friction: Float[Tensor, ""]
    inertia_kgm2: Float[Tensor, "3 3"]


@dataclass(frozen=True, eq=False)
class Contacts:
    """The k lowest points of each transition: which, where in object axes from the centre of mass, how high."""

    index: Any
    arm_m: Float[Tensor, "n k 3"]
    height_m: Float[Tensor, "n k"]


class StepData:
    """Transitions as tensors, with a weight for each and the warm start of the inner problem (changes as it is
    used)."""

    def __init__(self, steps: Steps, device: str = "cpu") -> None:
        def tensor(values: Any) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=torch.float64, device=device)

        self.steps = steps
        self.step_s = tensor(steps.step_s)
        self.rotation = tensor(steps.rotation)
        self.position_m = tensor(steps.position_m)
        self.spin = tensor(steps.spin_object_rad_s)
        self.velocity = tensor(steps.velocity_world_m_s)
        self.spin_before = tensor(steps.spin_before_object_rad_s)
        self.velocity_before = tensor(steps.velocity_before_world_m_s)
        self.weight = torch.ones(len(steps), dtype=torch.float64, device=device)
        self.warm = torch.zeros((len(steps), 6), dtype=torch.float64, device=device)

    def __len__(self) -> int:
        return len(self.steps)

    def rows(self, keep: Tensor) -> StepData:
        """A view of some rows (weights and warm starts are copied)."""
        part = object.__new__(StepData)
        for name, value in vars(self).items():
            setattr(part, name, value[keep] if isinstance(value, Tensor) else value)
        return part


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """What flight does not explain of a step's change of velocity: dv = v+ - (v + dt a_free)."""

    spin_change: Float[Tensor, "n 3"]
    velocity_change: Float[Tensor, "n 3"]


def free_motion(data: StepData, body: Body) -> FreeMotion:
    """a_free = (-I^-1 (w x I w), -g e_z), taken with the spin after the step (implicit), as dair_pll does."""
    dt = data.step_s[:, None]
    gyro = torch.linalg.cross(data.spin, data.spin @ body.inertia_kgm2)
    spin_free = -torch.linalg.solve(body.inertia_kgm2, gyro.T).T
    gravity = data.position_m.new_tensor([0.0, 0.0, -GRAVITY_M_S2])
    return FreeMotion(
        data.spin - data.spin_before - dt * spin_free, data.velocity - data.velocity_before - dt * gravity
    )


def find_contacts(
    rotation: Float[Tensor, "n 3 3"], position_m: Float[Tensor, "n 3"], body: Body, contacts: int
) -> Contacts:
    """The lowest points at each pose; heights are above the plane."""
    up = rotation[:, 2]
    with torch.no_grad():
        heights = up @ body.points_m.T
        count = min(contacts, heights.shape[1])
        index = torch.topk(heights, count, dim=1, largest=False).indices
    arm = body.points_m[index]
    height = (arm * up[:, None]).sum(-1) + position_m[:, 2:]
    return Contacts(index, arm, height)


def point_velocity(
    rotation: Float[Tensor, "n 3 3"],
    arm: Float[Tensor, "n k 3"],
    spin: Float[Tensor, "n 3"],
    velocity: Float[Tensor, "n 3"],
) -> Float[Tensor, "n k 3"]:
    """v + R (w x s) of points s, world axes."""
    swept = torch.linalg.cross(spin[:, None].expand_as(arm), arm)
    return velocity[:, None] + torch.matmul(swept, rotation.transpose(1, 2))


def jacobian(
    rotation: Float[Tensor, "n 3 3"],
    friction: Float[Tensor, "*f"],
    inertia_kgm2: Float[Tensor, "3 3"],
    arm: Float[Tensor, "n k 3"],
) -> Float[Tensor, "n k 3 6"]:
    """A = J M^-1/2: rows (mu t1, mu t2, n) of each contact; columns are the six directions of momentum.

    `friction` is one number or one per row.
    """
    shape = (*arm.shape[:2], 3, 3)
    rows = torch.linalg.cross(arm[:, :, None, :].expand(shape), rotation[:, None].expand(shape))
    root = torch.linalg.cholesky(torch.linalg.inv(inertia_kgm2))
    linear = torch.eye(3, dtype=arm.dtype, device=arm.device) / REFERENCE_MASS_KG**0.5
    A = torch.cat([rows @ root, linear.expand(shape)], -1)
    A[:, :, :2] *= friction.reshape(-1, 1, 1, 1)
    return A


def prediction(
    data: StepData,
    body: Body,
    free: FreeMotion,
    arm: Float[Tensor, "n k 3"],
    lam: Float[Tensor, "n k 3"],
) -> Float[Tensor, " n"]:
    """1/2 dv' M dv - lam' J dv + 1/2 lam' (D + eps) lam >= 0, in J: the momentum that the impulses do not explain."""
    one = torch.ones_like(body.friction)
    force = lam * torch.stack([body.friction, body.friction, one])
    push = force.sum(1)
    torque = torch.linalg.cross(arm, torch.matmul(force, data.rotation)).sum(1)
    work = (push * free.velocity_change).sum(-1) + (torque * free.spin_change).sum(-1)
    inverse = torch.linalg.inv(body.inertia_kgm2)
    impulses = push.square().sum(-1) / REFERENCE_MASS_KG + ((torque @ inverse) * torque).sum(-1)
    momentum = REFERENCE_MASS_KG * free.velocity_change.square().sum(-1)
    momentum = momentum + ((free.spin_change @ body.inertia_kgm2) * free.spin_change).sum(-1)
    return 0.5 * (momentum + impulses + EPSILON * lam.square().sum((1, 2))) - work


def complementarity(height_m: Float[Tensor, "n k"], lam: Float[Tensor, "n k 3"]) -> Float[Tensor, " n"]:
    """sum lam_n |phi|, in N s m: no impulse at a distance."""
    return (lam[..., 2] * height_m.abs()).sum(-1)


def dissipation(
    body: Body, slip: Float[Tensor, "n k 2"], step_s: Float[Tensor, " n"], lam: Float[Tensor, "n k 3"]
) -> Float[Tensor, " n"]:
    """dt sum (mu lam_t . v_t + lam_n mu |v_t|) >= 0, in N s m: friction of a sliding contact opposes it, in full."""
    speed = (slip.square().sum(-1) + TINY).sqrt()
    power = (lam[..., :2] * slip).sum(-1) + lam[..., 2] * speed
    return step_s * body.friction * power.sum(-1)


def penetration(height_m: Float[Tensor, "n k"]) -> Float[Tensor, " n"]:
    """sum max(0, -phi)^2 over the candidates, in m^2."""
    return torch.relu(-height_m).square().sum(-1)


def linear_cost(
    data: StepData, body: Body, free: FreeMotion, found: Contacts, weights: Weights
) -> Float[Tensor, "n k 3"]:
    """q of the inner problem, divided by w_pred: -J dv + w_comp (0, 0, |phi|) + w_diss dt (mu v_t, mu |v_t|)."""
    slip = point_velocity(data.rotation, found.arm_m, data.spin, data.velocity)[..., :2]
    change = point_velocity(data.rotation, found.arm_m, free.spin_change, free.velocity_change)
    drag = (weights.dissipation / weights.prediction) * data.step_s[:, None, None] * body.friction
    speed = (slip.square().sum(-1, keepdim=True) + TINY).sqrt()
    tangent = -body.friction * change[..., :2] + drag * slip
    near = (weights.complementarity / weights.prediction) * found.height_m.abs()
    return torch.cat([tangent, -change[..., 2:] + near[..., None] + drag * speed], -1)


@dataclass(frozen=True, eq=False)
class Impulses:
    """The solved inner problems: `rows` of the data that are not settled by screening, their impulses, failures."""

    rows: Any
    impulse: Float[Tensor, "m k 3"]
    failed: Bool[Tensor, " m"]
    iterations: int


@torch.no_grad()
def solve_impulses(data: StepData, body: Body, contacts: int, weights: Weights) -> Impulses:
    """The impulses of every transition; lam = 0 exactly where q is in K. Updates the data's warm starts."""
    free = free_motion(data, body)
    found = find_contacts(data.rotation, data.position_m, body, contacts)
    q = linear_cost(data, body, free, found, weights)
    rows = (~in_cone(q)).nonzero()[:, 0]
    part = data.rows(rows)
    A = jacobian(part.rotation, body.friction, body.inertia_kgm2, found.arm_m[rows])
    solved = solve_cones(A, q[rows], EPSILON, part.warm)
    data.warm[rows] = torch.where(solved.failed[:, None], 0.0, solved.primal)
    return Impulses(rows, solved.impulse, solved.failed, solved.iterations)


@dataclass(frozen=True, eq=False)
class StepTerms:
    """The four terms of some rows of the data, and those rows."""

    rows: Any
    prediction: Float[Tensor, " m"]
    complementarity: Float[Tensor, " m"]
    dissipation: Float[Tensor, " m"]
    penetration: Float[Tensor, " m"]

    def total(self, weights: Weights) -> Float[Tensor, " m"]:
        return (
            weights.prediction * self.prediction
            + weights.complementarity * self.complementarity
            + weights.dissipation * self.dissipation
            + weights.penetration * self.penetration
        )


def step_terms(data: StepData, body: Body, impulses: Impulses, contacts: int) -> StepTerms:
    """The terms of the rows at their impulses (constants). A failed row's impulse lies in the cones too, so its terms
    are an upper bound and it stays in (and is counted); only numbers that overflowed are left out."""
    finite = torch.isfinite(impulses.impulse).all(-1).all(-1)
    rows, lam = impulses.rows[finite], impulses.impulse[finite]
    part = data.rows(rows)
    free = free_motion(part, body)
    found = find_contacts(part.rotation, part.position_m, body, contacts)
    slip = point_velocity(part.rotation, found.arm_m, part.spin, part.velocity)[..., :2]
    return StepTerms(
        rows,
        prediction(part, body, free, found.arm_m, lam),
        complementarity(found.height_m, lam),
        dissipation(body, slip, part.step_s, lam),
        penetration(found.height_m),
    )


def idle_terms(data: StepData, body: Body, impulses: Impulses, contacts: int) -> StepTerms:
    """The terms of the rows that screening settled: no impulse, so only dv' M dv / 2 and penetration are left."""
    idle = torch.ones(len(data), dtype=torch.bool, device=data.weight.device)
    idle[impulses.rows] = False
    rows = idle.nonzero()[:, 0]
    part = data.rows(rows)
    free = free_motion(part, body)
    spin_energy = ((free.spin_change @ body.inertia_kgm2) * free.spin_change).sum(-1)
    energy = 0.5 * (REFERENCE_MASS_KG * free.velocity_change.square().sum(-1) + spin_energy)
    none = torch.zeros_like(energy)
    return StepTerms(
        rows, energy, none, none, penetration(find_contacts(part.rotation, part.position_m, body, contacts).height_m)
    )


@dataclass(frozen=True, eq=False)
class LossValue:
    """The weighted mean loss (with its graph), its terms, and the inner problems behind it."""

    loss: Float[Tensor, ""]
    terms: ContactTerms
    impulses: Impulses


def contact_loss(data: StepData, body: Body, contacts: int, weights: Weights) -> LossValue:
    """The loss over all transitions. Rows where nothing touches take no part in the gradient: exact where none of them
    penetrates."""
    fixed = Body(*(getattr(body, f.name).detach() for f in fields(Body)))
    impulses = solve_impulses(data, fixed, contacts, weights)
    solved = step_terms(data, body, impulses, contacts)
    with torch.no_grad():
        idle = idle_terms(data, fixed, impulses, contacts)
    total_weight = data.weight.sum().clamp_min(TINY)
    loss = data.weight.new_zeros(())
    means = {f.name: 0.0 for f in fields(ContactTerms)}
    for part in (solved, idle):
        weight = data.weight[part.rows] / total_weight
        loss = loss + (weight * part.total(weights)).sum()
        for name in means:
            means[name] += float((weight * getattr(part, name)).sum().detach())
    return LossValue(loss, ContactTerms(**means), impulses)
