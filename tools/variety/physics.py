"""What both engines share: the state of a free body, contact with the table, drag, and the path that comes out.

Inside an engine a body is its convex hull's corners about its centre of mass; outside, a `Trajectory` of the mesh's
frame. Only the table is touched, so that the hull is exact for any shape.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.motion import Release, Trajectory
from acquisition.synthetic.objects.shapes import MassProperties
from recordings.geometry import rotation_from_quaternion

STILL_M_S, STILL_RAD_S, STILL_FOR_S = 0.01, 0.15, 0.1
AIR_KG_M3 = 1.2


@dataclass(frozen=True, eq=False)
class Thrown:
    """A body ready to be thrown: hull corners in the mesh's frame, mass, and how the air holds it back.

    `drag_area_m2` is drag coefficient times cross-section: force = -1/2 rho c A |v| v.
    """

    hull_m: Float[Array, "n 3"]
    mass: MassProperties
    drag_area_m2: float


@dataclass(frozen=True, eq=False)
class Ground:
    """The table: Coulomb friction, restitution, rolling resistance; gravity in the table's frame.

    `wave_m`: amplitude of a table that is not quite flat, z = wave sin(k x) cos(k y), k = 2 pi / 0.6 m.
    """

    friction: float
    restitution: float
    rolling_m: float
    gravity_m_s2: Float[Array, "3"]
    wave_m: float = 0.0


@dataclass(frozen=True, eq=False)
class Fall:
    """From the release on. Instants are infinite where they do not happen."""

    path: Trajectory
    impact_s: float
    rest_s: float


class Engine(Protocol):
    """Throws a body onto the ground and follows it until it rests, for `after_s` more, at most `longest_s`."""

    name: str

    def drop(
        self, body: Thrown, ground: Ground, release: Release, start_s: float, longest_s: float, after_s: float
    ) -> Fall: ...


def still_since(speed_m_s: Float[Array, " n"], spin_rad_s: Float[Array, " n"], times_s: Float[Array, " n"]) -> float:
    """When the last stretch began in which the body is slow; infinite where it is not slow at the end."""
    slow = (speed_m_s < STILL_M_S) & (spin_rad_s < STILL_RAD_S)
    if not slow[-1]:
        return float("inf")
    moving = np.flatnonzero(~slow)
    return float(times_s[0] if len(moving) == 0 else times_s[min(moving[-1] + 1, len(times_s) - 1)])


def of_mesh(
    center_m: Float[Array, "3"], times_s: Float[Array, " n"], com_m: Float[Array, "n 3"],
    quaternion_wxyz: Float[Array, "n 4"], com_velocity_m_s: Float[Array, "n 3"], spin_object_rad_s: Float[Array, "n 3"],
) -> Trajectory:  # fmt: skip
    """The mesh origin's path from that of the centre of mass: p = c - R r, v = v_c - R (w x r)."""
    rotations = np.array([rotation_from_quaternion(q) for q in quaternion_wxyz])
    position = com_m - rotations @ center_m
    velocity = com_velocity_m_s - np.einsum("nij,nj->ni", rotations, np.cross(spin_object_rad_s, center_m))
    return Trajectory(times_s, position, quaternion_wxyz, velocity, spin_object_rad_s)


def com_state(release: Release, center_m: Float[Array, "3"]) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Place and velocity of the centre of mass at the release."""
    arm = release.world_from_object.rotation @ center_m
    spin = release.angular_velocity_world_rad_s
    return release.world_from_object.translation_m + arm, release.velocity_world_m_s + np.cross(spin, arm)
