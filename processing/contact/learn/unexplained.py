"""Impacts that the plane cannot explain: a finger, the table's edge, a second surface.

A change of velocity is explained when impulses at points within reach of the plane, in a generous friction cone,
produce
it. What is left, over sqrt(mass), is a speed; above a threshold the transition is left out and counted.
"""

from __future__ import annotations

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from processing.contact.physics.loss import (
    REFERENCE_MASS_KG,
    Body,
    StepData,
    find_contacts,
    free_motion,
    jacobian,
    point_velocity,
)
from processing.contact.physics.solver import solve_cones
from processing.motion.thresholds import UNEXPLAINED_IMPACT_M_S
from recordings.constants import MAD_TO_SIGMA

REACH_M = 0.01
"""A point this high above the plane after the step may still have touched it during the step."""
GENEROUS_FRICTION = 1.2
SIGMAS = 6.0
FAR = 1e3
"""Cost of an impulse per metre beyond the reach."""


@torch.no_grad()
def unexplained_m_s(data: StepData, body: Body, contacts: int) -> Float[Tensor, " n"]:
    """The change of velocity per transition that no impulses from the plane produce, as a speed of the mass."""
    generous = dataclasses.replace(body, friction=torch.clamp(body.friction, min=GENEROUS_FRICTION))
    free = free_motion(data, generous)
    found = find_contacts(data.rotation, data.position_m, generous, max(contacts, 8))
    speed = data.velocity.norm(dim=-1) * data.step_s
    q = -point_velocity(data.rotation, found.arm_m, free.spin_change, free.velocity_change)
    q[..., :2] *= generous.friction
    q[..., 2] += FAR * torch.relu(found.height_m - REACH_M - 0.5 * speed[:, None])
    A = jacobian(data.rotation, generous.friction, generous.inertia_kgm2, found.arm_m)
    solved = solve_cones(A, q, 1e-4)
    root = torch.linalg.cholesky(torch.linalg.inv(generous.inertia_kgm2))
    wanted = torch.cat(
        [torch.linalg.solve(root, free.spin_change.T).T, REFERENCE_MASS_KG**0.5 * free.velocity_change], -1
    )
    left = wanted - torch.einsum("nkij,nki->nj", A, solved.impulse)
    return left.norm(dim=-1) / REFERENCE_MASS_KG**0.5


def unexplained_rows(data: StepData, body: Body, contacts: int) -> Bool[Tensor, " n"]:
    """Transitions that the plane cannot explain: beyond UNEXPLAINED_IMPACT_M_S and SIGMAS of what is usual here."""
    left = unexplained_m_s(data, body, contacts)
    usual = MAD_TO_SIGMA * left.median()
    return left > torch.clamp(SIGMAS * usual, min=UNEXPLAINED_IMPACT_M_S)
