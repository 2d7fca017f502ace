"""Where the object is at any time of a toss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.geometry import Transform, quaternion_from_rotation, rotation_exp, rotation_from_quaternion

Phase = Literal["hold", "leadin", "free", "rest"]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses and velocities of the mesh's frame on a fine, even time grid.

    Rows: `quaternion_wxyz` and `position_m` are world_from_object; angular velocity in the object's axes.
    """

    times_s: Float[Array, " n"]
    position_m: Float[Array, "n 3"]
    quaternion_wxyz: Float[Array, "n 4"]
    velocity_world_m_s: Float[Array, "n 3"]
    angular_velocity_object_rad_s: Float[Array, "n 3"]

    def at(self, time_s: float) -> Transform:
        """world_from_object, interpolated; held at either end."""
        t = float(np.clip(time_s, self.times_s[0], self.times_s[-1]))
        k = int(np.clip(np.searchsorted(self.times_s, t) - 1, 0, len(self.times_s) - 2))
        share = (t - self.times_s[k]) / (self.times_s[k + 1] - self.times_s[k])
        position = (1 - share) * self.position_m[k] + share * self.position_m[k + 1]
        a, b = self.quaternion_wxyz[k], self.quaternion_wxyz[k + 1]
        mixed = (1 - share) * a + share * (b if a @ b >= 0 else -b)
        return Transform("world", "object", rotation_from_quaternion(mixed), position)

    def joined(self, later: Trajectory) -> Trajectory:
        """This one, then `later` from its first instant on."""
        keep = self.times_s < later.times_s[0] - 1e-9
        rows = [
            np.concatenate([getattr(self, name)[keep], getattr(later, name)])
            for name in (
                "times_s",
                "position_m",
                "quaternion_wxyz",
                "velocity_world_m_s",
                "angular_velocity_object_rad_s",
            )
        ]
        return Trajectory(*rows)


@dataclass(frozen=True, eq=False)
class Release:
    """The state at the instant of release."""

    world_from_object: Transform
    velocity_world_m_s: Float[Array, "3"]
    angular_velocity_world_rad_s: Float[Array, "3"]


@dataclass(frozen=True)
class Instants:
    """Times on the toss's clock."""

    lead_in_s: float
    release_s: float
    first_impact_s: float
    rest_s: float
    end_s: float

    def phase(self, time_s: float) -> Phase:
        if time_s < self.lead_in_s:
            return "hold"
        if time_s < self.release_s:
            return "leadin"
        return "free" if time_s < self.rest_s else "rest"


def unseen_hand(release: Release, hold_s: float, lead_in_s: float, step_s: float) -> Trajectory:
    """Rest, then even acceleration and even angular acceleration up to the release state, as if by a hand."""
    times = np.arange(0.0, hold_s + lead_in_s, step_s)
    share = np.clip((times - hold_s) / lead_in_s, 0.0, 1.0)
    left_s = lead_in_s * (1 - share**2) / 2  # seconds at full speed that are still to come
    end = release.world_from_object
    rotations = [rotation_exp(-s * release.angular_velocity_world_rad_s) @ end.rotation for s in left_s]
    spin_object = end.rotation.T @ release.angular_velocity_world_rad_s
    return Trajectory(
        times,
        end.translation_m - left_s[:, None] * release.velocity_world_m_s,
        np.array([quaternion_from_rotation(r) for r in rotations]),
        share[:, None] * release.velocity_world_m_s,
        share[:, None] * spin_object,
    )
