"""How a tossed body moves between frames: ballistic centre, constant spin, and what an impact may cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.motion.interpolate import turn_between
from recordings.constants import GRAVITY_M_S2


@dataclass(frozen=True)
class MotionConfig:
    """What counts as a usual change of motion from frame to frame."""

    usual_turn_rad_s: float = 6.0
    """Change of spin between two frames that costs half of `impact_cost`."""
    impact_cost: float = 0.12
    """Cost of a change of spin, however large: an impact may do anything."""
    fast_turn_rad_s: float = 28.0
    """Spins above this cost still more (an alias of a symmetric body is a fast spin)."""
    usual_shift_m_s: float = 0.6
    """Change of velocity, beyond gravity, that costs half of `shift_cost`."""
    shift_cost: float = 0.04


Some = TypeVar("Some", float, Float[Array, " n"])
"""One, or one of each of many."""
FREE_CHANGE = 0.25
"""No torque turns a flying body, yet its spin changes (Euler's equations): for a rod or a disc that spins askew by up
to half the spin's square in a second. Half of that bound is the standard deviation for a body of unknown inertia."""


def free_change_rad_s(spin_rad_s: Some, step_s: Some) -> Some:
    """Standard deviation of the change of a free body's spin over a step."""
    return FREE_CHANGE * spin_rad_s**2 * step_s


def free_jerk_rad_s(spin_rad_s: Some, step_s: Some) -> Some:
    """Standard deviation of the change of that change over the next step: it turns with the body."""
    return FREE_CHANGE**2 * spin_rad_s**3 * step_s**2


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


def change_cost(
    poses: tuple[Float[Array, "4 4"], Float[Array, "4 4"], Float[Array, "4 4"]],
    steps_s: tuple[float, float],
    center_m: Float[Array, "3"],
    gravity_camera_m_s2: Float[Array, "3"],
    config: MotionConfig,
    spin_rad_s: Float[Array, "3"] | None = None,
    flying: bool = False,
) -> float:
    """Cost of the change of motion over three poses, at most impact_cost + shift_cost (and more for very fast spins);
    of spin without a limit where the body is `flying`, because nothing can hit it there.

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
    turn = turn if flying else turn / (1.0 + turn)
    return config.impact_cost * (turn + excess) + config.shift_cost * shift / (1.0 + shift)


def gravity_in_camera(world_from_camera: Float[Array, "4 4"] | None) -> Float[Array, "3"]:
    """Gravity in the camera's axes; zero where the world is not known."""
    if world_from_camera is None:
        return np.zeros(3)
    return world_from_camera[:3, :3].T @ np.array([0.0, 0.0, -GRAVITY_M_S2])
