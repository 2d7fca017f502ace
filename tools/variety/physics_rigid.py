"""An engine of rigid impulses: exact Coulomb cones and Newton's restitution at the hull's corners (not MuJoCo's soft
contact). Free rotation keeps the angular momentum to rounding; its energy by the midpoint rule.

Velocities are stepped by sequential impulses (E. Catto, "Iterative dynamics with temporal coherence", 2005) with the
friction bounded by a disc, restitution after G. Hirota's rule v+ = -e v- where the approach is faster than SLOW_M_S.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numba import njit
from numpy import ndarray as Array

from acquisition.synthetic.motion import Release
from recordings.geometry import quaternion_from_rotation
from variety.physics import AIR_KG_M3, STILL_FOR_S, Fall, Ground, Thrown, com_state, of_mesh, still_since

STEP_S = 0.00025
KEEP = 2
"""Every so many steps one is kept."""
SLOW_M_S = 0.04
SWEEPS = 25
SLOP_M = 0.0001
PUSH_SHARE = 0.08
"""Of the depth beyond SLOP_M, undone in a step by a shift (which gives no speed)."""
WAVE_NUMBER = 2 * np.pi / 0.6


class RigidImpulses:
    """The second engine."""

    name = "rigid impulses, 0.25 ms, Newton restitution, Coulomb disc"

    def drop(
        self, body: Thrown, ground: Ground, release: Release, start_s: float, longest_s: float, after_s: float
    ) -> Fall:
        center = body.mass.center_m
        com, velocity = com_state(release, center)
        steps = int((longest_s + after_s) / STEP_S)
        rows, impact = _run(
            np.ascontiguousarray(body.hull_m - center), body.mass.mass_kg, body.mass.inertia_kgm2,
            np.linalg.inv(body.mass.inertia_kgm2), 0.5 * AIR_KG_M3 * body.drag_area_m2, ground.friction,
            ground.restitution, ground.rolling_m, ground.gravity_m_s2, ground.wave_m, com, velocity,
            np.ascontiguousarray(release.world_from_object.rotation), release.angular_velocity_world_rad_s,
            steps, max(after_s, STILL_FOR_S),
        )  # fmt: skip
        times = start_s + rows[:, 0]
        rotations = rows[:, 7:16].reshape(-1, 3, 3)
        quaternions = np.array([quaternion_from_rotation(_square(r)) for r in rotations])
        spin_object = np.einsum("nji,nj->ni", rotations, rows[:, 16:19])
        path = of_mesh(center, times, rows[:, 1:4], quaternions, rows[:, 4:7], spin_object)
        speeds = np.linalg.norm(rows[:, 4:7], axis=1), np.linalg.norm(spin_object, axis=1)
        return Fall(path, start_s + impact, still_since(*speeds, times))


def _square(rotation: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    u, _, vt = np.linalg.svd(rotation)
    return u @ vt


@njit(cache=True)
def _turned(rotation, turn):
    """exp(turn) rotation, by Rodrigues' formula."""
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    if angle < 1e-14:
        return rotation
    x, y, z = turn / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)) @ rotation


@njit(cache=True)
def _spin(rotation, inverse, momentum):
    return rotation @ (inverse @ (rotation.T @ momentum))


@njit(cache=True)
def _height(x, y, wave):
    return wave * np.sin(WAVE_NUMBER * x) * np.cos(WAVE_NUMBER * y)


@njit(cache=True)
def _contacts(hull, rotation, com, wave):
    """Numbers of the corners below the table, their arms from the centre of mass, and how deep."""
    arms = hull @ rotation.T
    found = np.empty(len(hull), np.int64)
    depth = np.empty(len(hull))
    n = 0
    for i in range(len(hull)):
        below = _height(com[0] + arms[i, 0], com[1] + arms[i, 1], wave) - com[2] - arms[i, 2]
        if below > 0:
            found[n], depth[n] = i, below
            n += 1
    return arms[found[:n]], depth[:n]


@njit(cache=True)
def _solve(arms, mass, inverse_world, velocity, spin, friction, restitution, rolling):
    """Velocity and spin after the impulses of all contacts."""
    n = len(arms)
    wanted, total = np.zeros(n), np.zeros((n, 3))
    for i in range(n):
        approach = velocity[2] + spin[0] * arms[i, 1] - spin[1] * arms[i, 0]
        if approach < -SLOW_M_S:
            wanted[i] = -restitution * approach
    for _ in range(SWEEPS):
        for i in range(n):
            r = arms[i]
            k = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
            m = np.eye(3) / mass - k @ inverse_world @ k
            u = velocity + np.cross(spin, r)
            old = total[i].copy()
            total[i, 2] = max(old[2] + (wanted[i] - u[2]) / m[2, 2], 0.0)
            side = 0.5 * (m[0, 0] + m[1, 1])
            tx, ty = old[0] - u[0] / side, old[1] - u[1] / side
            most, size = friction * total[i, 2], np.sqrt(tx * tx + ty * ty)
            share = 1.0 if size <= most else most / size
            total[i, 0], total[i, 1] = share * tx, share * ty
            change = total[i] - old
            velocity = velocity + change / mass
            spin = spin + inverse_world @ np.cross(r, change)
    pressed = total[:, 2].sum()
    speed = np.sqrt((spin * spin).sum())
    if speed > 1e-9 and pressed > 0:
        slowed = inverse_world @ (spin / speed) * rolling * pressed
        spin = spin - slowed * min(1.0, speed / max(np.sqrt((slowed * slowed).sum()), 1e-12))
    return velocity, spin


@njit(cache=True)
def _run(hull, mass, inertia, inverse, drag, friction, restitution, rolling, gravity, wave, com, velocity, rotation,
         spin, steps, after_s):  # fmt: skip
    """Rows of time, centre, velocity, rotation (9), spin; and the first contact's time (infinite: none)."""
    rows = np.empty((steps // KEEP + 1, 19))
    momentum = rotation @ (inertia @ (rotation.T @ spin))
    dt, kept, impact, slow_s = STEP_S, 0, np.inf, 0.0
    for step in range(steps):
        if step % KEEP == 0:
            rows[kept, 0] = step * dt
            rows[kept, 1:4], rows[kept, 4:7] = com, velocity
            rows[kept, 7:16], rows[kept, 16:19] = rotation.copy().reshape(9), spin
            kept += 1
        speed = np.sqrt((velocity * velocity).sum())
        velocity = velocity + dt * (gravity - drag * speed / mass * velocity)
        arms, depth = _contacts(hull, rotation, com, wave)
        if len(arms) > 0:
            impact = min(impact, step * dt)
            spin = _spin(rotation, inverse, momentum)
            inverse_world = rotation @ inverse @ rotation.T
            velocity, spin = _solve(arms, mass, inverse_world, velocity, spin, friction, restitution, rolling)
            com = com + np.array([0.0, 0.0, PUSH_SHARE * max(depth.max() - SLOP_M, 0.0)])
            momentum = rotation @ (inertia @ (rotation.T @ spin))
        com = com + dt * velocity
        half = _turned(rotation, 0.5 * dt * _spin(rotation, inverse, momentum))
        rotation = _turned(rotation, dt * _spin(half, inverse, momentum))
        spin = _spin(rotation, inverse, momentum)
        slow = speed < 0.01 and np.sqrt((spin * spin).sum()) < 0.15 and len(arms) > 0
        slow_s = slow_s + dt if slow else 0.0
        if slow_s > after_s:
            break
    return rows[:kept], impact
