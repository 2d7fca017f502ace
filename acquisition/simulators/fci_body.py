"""The simulated Panda's joints: what it desires, what it measures, and what its motion supervision forbids.

Kinematics only: no masses, no torques. Desired joints follow the commands at 1 kHz and are supervised as the real
arm's are; measured joints lag behind by a first-order time constant.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.simulators import fci_wire as wire

TICK_S = 1e-3
LAG_S = 4e-3
BRAKE_PER_TICK = 0.95
READY_RAD = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
TOLERANCE = 1e-3
"""Share by which a limit may be passed before the supervision acts."""
AT_REST_RAD_S = 0.05
"""A motion may be declared finished below this speed."""


class FciBody:
    """Joints of the arm. One call of `follow`, `extrapolate` or `brake` per tick."""

    def __init__(self, q_rad: Float[Array, "7"] | None = None) -> None:
        self.q_d = np.array(READY_RAD if q_rad is None else q_rad, dtype=np.float64)
        self.dq_d = np.zeros(wire.JOINTS)
        self.ddq_d = np.zeros(wire.JOINTS)
        self.q = self.q_d.copy()
        self.dq = np.zeros(wire.JOINTS)

    def follow(self, q_c: Float[Array, "7"]) -> str | None:
        """Take the commanded position; the name of the error when the supervision forbids it."""
        dq = (q_c - self.q_d) / TICK_S
        ddq = (dq - self.dq_d) / TICK_S
        error = _forbidden(q_c, dq, ddq, (ddq - self.ddq_d) / TICK_S)
        if error is None:
            self.q_d, self.dq_d, self.ddq_d = q_c.copy(), dq, ddq
        self._measure()
        return error

    def extrapolate(self) -> None:
        """No command came in time: the arm goes on with the last acceleration, as the real one does."""
        self.dq_d = self.dq_d + self.ddq_d * TICK_S
        self.q_d = self.q_d + self.dq_d * TICK_S
        self._measure()

    def brake(self) -> None:
        """Nothing is commanded: come to rest."""
        self.ddq_d = np.zeros(wire.JOINTS)
        self.dq_d = self.dq_d * BRAKE_PER_TICK
        self.q_d = self.q_d + self.dq_d * TICK_S
        self._measure()

    @property
    def resting(self) -> bool:
        return bool(np.abs(self.dq_d).max() < AT_REST_RAD_S)

    def _measure(self) -> None:
        step = (self.q_d - self.q) * (TICK_S / LAG_S)
        self.q = self.q + step
        self.dq = step / TICK_S


def _forbidden(
    q: Float[Array, "7"], dq: Float[Array, "7"], ddq: Float[Array, "7"], dddq: Float[Array, "7"]
) -> str | None:
    share = 1 + TOLERANCE
    if not np.isfinite(q).all() or (q < wire.Q_MIN).any() or (q > wire.Q_MAX).any():
        return "joint_motion_generator_position_limits_violation"
    if (np.abs(dq) > wire.DQ_MAX * share).any():
        return "joint_motion_generator_velocity_limits_violation"
    if (np.abs(ddq) > wire.DDQ_MAX * share).any():
        return "joint_motion_generator_velocity_discontinuity"
    if (np.abs(dddq) > wire.DDDQ_MAX * share).any():
        return "joint_motion_generator_acceleration_discontinuity"
    return None
