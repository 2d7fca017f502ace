"""How a tossed body moves between frames: ballistic centre, constant spin, and what an impact may cost."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.geometry import rotation_exp, rotation_log

GRAVITY_M_S2 = 9.81
IMPACT_M_S = 0.5
IMPACT_RAD_S = 5.0
"""A change of velocity and of spin from frame to frame beyond this is an impact's."""


@dataclass(frozen=True)
class MotionConfig:
    """What counts as a usual change of motion from frame to frame."""

    usual_turn_rad_s: float = 6.0
    """Change of spin between two frames that costs half of an impact's price."""
    impact_cost: float = 0.12
    """Price of a change of spin, however large: an impact may do anything."""
    fast_turn_rad_s: float = 28.0
    """Spins above this are dearer still (an alias of a symmetric body is a fast spin)."""
    usual_shift_m_s: float = 0.6
    """Change of velocity, beyond gravity, that costs half of the price below."""
    shift_cost: float = 0.04


def turn_between(after: Float[Array, "4 4"], before: Float[Array, "4 4"]) -> Float[Array, "3"]:
    """Rotation vector (camera frame) from one pose to a later one."""
    turn = after[:3, :3] @ before[:3, :3].T
    cosine = 0.5 * (turn[0, 0] + turn[1, 1] + turn[2, 2] - 1.0)
    if cosine < -0.9:  # near half a turn the axis is not in the antisymmetric part
        return rotation_log(turn)
    axis = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    sine = math.sqrt(float(axis @ axis))
    return axis * (math.atan2(sine, cosine) / sine) if sine > 1e-9 else axis


def steady_spin(
    poses: Float[Array, "n 4 4"], times_s: Float[Array, " n"], limit_rad_s: float = 1.2, most: int = 5
) -> Float[Array, "3"]:
    """Spin (camera axes, rad/s) over the last poses, as far back as it was steady: a slow error of the poses must not
    become the next prediction's truth. Poses in the order of tracking, at least two."""
    spins = [turn_between(poses[-1 - j], poses[-2 - j]) / (times_s[-1 - j] - times_s[-2 - j])
             for j in range(min(most, len(poses) - 1))]  # fmt: skip
    used = [spins[0]]
    for spin in spins[1:]:
        if np.linalg.norm(spin - np.mean(used, axis=0)) > limit_rad_s:
            break
        used.append(spin)
    return np.asarray(np.mean(used, axis=0))


def moved(
    before: Float[Array, "4 4"],
    now: Float[Array, "4 4"],
    step_s: float,
    next_s: float,
    center_m: Float[Array, "3"],
    gravity_camera_m_s2: Float[Array, "3"],
    spin_rad_s: Float[Array, "3"] | None = None,
) -> Float[Array, "4 4"]:
    """The pose `next_s` after `now`, `before` being `step_s` earlier: constant spin, ballistic centre.

    `center_m` is that of mass in the object frame; `spin_rad_s` (camera axes) replaces the spin between the two."""
    ratio = next_s / step_s
    out = np.eye(4)
    turn = turn_between(now, before) * ratio if spin_rad_s is None else spin_rad_s * next_s
    out[:3, :3] = rotation_exp(turn) @ now[:3, :3]
    x0, x1 = (p[:3, :3] @ center_m + p[:3, 3] for p in (before, now))
    center = x1 + (x1 - x0) * ratio + gravity_camera_m_s2 * (0.5 * next_s * (step_s + next_s))
    out[:3, 3] = center - out[:3, :3] @ center_m
    return out


def carried_on(
    poses: Float[Array, "3 4 4"], times_s: Float[Array, "3"], delay_s: float, center_m: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    """The motion (camera axes) of the last of three poses over `delay_s`: spin and velocity go on changing as they
    did, but for an impact's jump."""
    steps_s = np.diff(times_s)
    spins = [turn_between(poses[j + 1], poses[j]) / steps_s[j] for j in (0, 1)]
    centers = [p[:3, :3] @ center_m + p[:3, 3] for p in poses]
    speeds = [(centers[j + 1] - centers[j]) / steps_s[j] for j in (0, 1)]
    ahead = (steps_s[1] + delay_s) / (steps_s[0] + steps_s[1])
    spin, speed = (
        last + ahead * (last - first) if np.linalg.norm(last - first) < impact else last
        for (first, last), impact in ((spins, IMPACT_RAD_S), (speeds, IMPACT_M_S))
    )
    out = np.eye(4)
    out[:3, :3] = rotation_exp(spin * delay_s)
    out[:3, 3] = centers[2] + speed * delay_s - out[:3, :3] @ centers[2]
    return out


def between(
    before: Float[Array, "4 4"], after: Float[Array, "4 4"], share: float, center_m: Float[Array, "3"]
) -> Float[Array, "4 4"]:
    """The pose at `share` (0..1) of the way: constant spin, straight centre."""
    out = np.eye(4)
    out[:3, :3] = rotation_exp(turn_between(after, before) * share) @ before[:3, :3]
    x0, x1 = (p[:3, :3] @ center_m + p[:3, 3] for p in (before, after))
    out[:3, 3] = x0 + share * (x1 - x0) - out[:3, :3] @ center_m
    return out


def change_cost(
    poses: tuple[Float[Array, "4 4"], Float[Array, "4 4"], Float[Array, "4 4"]],
    steps_s: tuple[float, float],
    center_m: Float[Array, "3"],
    gravity_camera_m_s2: Float[Array, "3"],
    config: MotionConfig,
    spin_rad_s: Float[Array, "3"] | None = None,
) -> float:
    """Price of the change of motion over three poses, at most impact_cost + shift_cost (and more for very fast spins).

    Zero for a body in free flight with constant spin, and (but for gravity's share) for one at rest. `spin_rad_s`
    (camera axes) is the spin before, where it is known better than from the first two poses.
    """
    first, second, third = poses
    spin0 = turn_between(second, first) / steps_s[0] if spin_rad_s is None else spin_rad_s
    spin1 = turn_between(third, second) / steps_s[1]
    x0, x1, x2 = (p[:3, :3] @ center_m + p[:3, 3] for p in poses)
    free = (x2 - x1) / steps_s[1] - (x1 - x0) / steps_s[0]
    flight = gravity_camera_m_s2 * 0.5 * (steps_s[0] + steps_s[1])
    change = min(float(np.linalg.norm(free - flight)), float(np.linalg.norm(free)))
    turn = (float(np.linalg.norm(spin1 - spin0)) / config.usual_turn_rad_s) ** 2
    shift = (change / config.usual_shift_m_s) ** 2
    excess = max(0.0, float(np.linalg.norm(spin1)) / config.fast_turn_rad_s - 1.0)
    return config.impact_cost * (turn / (1.0 + turn) + excess) + config.shift_cost * shift / (1.0 + shift)


def gravity_in_camera(world_from_camera: Float[Array, "4 4"] | None) -> Float[Array, "3"]:
    """Gravity in the camera's axes; zero where the world is not known."""
    if world_from_camera is None:
        return np.zeros(3)
    return world_from_camera[:3, :3].T @ np.array([0.0, 0.0, -GRAVITY_M_S2])


def turn_grid(angles_deg: tuple[float, ...], axes: int) -> Float[Array, "n 3 3"]:
    """Rotations by each angle about axes spread evenly over the sphere (Fibonacci)."""
    n = np.arange(axes) + 0.5
    z, phi = 1 - 2 * n / axes, np.pi * (1 + 5**0.5) * n
    r = np.sqrt(1 - z * z)
    directions = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
    return np.array([rotation_exp(d * np.radians(a)) for a in angles_deg for d in directions])


def all_turns(count: int) -> Float[Array, "n 3 3"]:
    """Rotations spread over all orientations: directions of the axis, and turns about it."""
    about = max(4, round((count * 1.6) ** (1 / 3)))
    axes = max(4, count // about)
    n = np.arange(axes) + 0.5
    height, around = 1 - 2 * n / axes, np.pi * (1 + 5**0.5) * n
    out = []
    for z, phi in zip(height, around):
        tilt = rotation_exp(np.arccos(z) * np.array([-np.sin(phi), np.cos(phi), 0.0]))
        out += [tilt @ rotation_exp(np.array([0, 0, 2 * np.pi * a / about])) for a in range(about)]
    return np.array(out)
