"""What a toss asks of the arm: a trajectory, when the fingers are told to open, the release that it aims at."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.devices import JointTrajectory
from recordings.geometry import Transform


@dataclass(frozen=True, eq=False)
class TossPlan:
    """A toss that the arm can do. Times count from the trajectory's start.

    `release_s` is when the fingers are to begin to open, `command_s` when the gripper has to be told so that they do.
    The velocities are those of the tool at `release_s`, in the world. `delay_sigma_s`: how well the gripper's delay is
    known; around the release the tool's velocity stays constant for at least `window_s`.
    """

    trajectory: JointTrajectory
    release_s: float
    command_s: float
    world_from_tool: Transform
    linear_velocity_world_m_s: Float[Array, "3"]
    angular_velocity_world_rad_s: Float[Array, "3"]
    delay_sigma_s: float = float("nan")
    window_s: float = 0.0
