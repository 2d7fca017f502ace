"""The simulated UR5e: six joints, and the part of ur-rtde's control script that moves them, at 500 Hz.

Kinematics only. `servoJ` follows its target with the delay of its look-ahead; a joint faster than its limit, or a jump
of the target, is a protective stop, as on the arm.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.simulators import rtde_wire as wire

TICK_S = 2e-3
READY_RAD = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)
DQ_MAX_RAD_S = np.pi
BRAKE_RAD_S2 = 10.0
MOST_PAYLOAD_KG = 5.0
GRIPPER = (1.0, 0.0, 0.0, 0.06)
"""The payload that was set at the panel: mass (kg) and centre of mass (m, in the flange's frame)."""


class UrBody:
    """Joints, safety mode and control script. `step` is one tick with the input registers as they stand."""

    def __init__(self) -> None:
        self.q_target = np.array(READY_RAD)
        self.dq_target = np.zeros(wire.JOINTS)
        self.q = self.q_target.copy()
        self.dq = np.zeros(wire.JOINTS)
        self.safety = wire.SafetyMode.NORMAL
        self.script_running = False
        self.answer = 0
        self.moves = 0
        self.payload = list(GRIPPER)
        self._command = 0
        self._servo: tuple[Float[Array, "6"], float] | None = None
        self._move: _Move | None = None

    def load_script(self) -> None:
        """The control script was sent: it runs from its beginning."""
        if self.safety == wire.SafetyMode.NORMAL:
            self.script_running, self.answer, self._command = True, wire.READY, 0
            self._servo = self._move = None

    def stop(self, safety: wire.SafetyMode) -> None:
        """A stop by the safety system ends the script."""
        if self.safety != safety:
            self.safety = safety
            self.end_script()

    def end_script(self) -> None:
        self.script_running, self.answer = False, 0
        self._servo = self._move = None

    def step(self, registers: Mapping[str, float], late_s: float = 0.0) -> None:
        """One tick; `late_s`: by how much the machine made it longer, in which the client's targets went on."""
        if self.script_running:
            self._run_script(registers)
        before = self.q_target
        self.q_target = self._next_target()
        self.dq_target = (self.q_target - before) / (TICK_S + late_s)
        if (np.abs(self.dq_target) > DQ_MAX_RAD_S).any():
            self.q_target, self.dq_target = before, np.zeros(wire.JOINTS)
            self.stop(wire.SafetyMode.PROTECTIVE_STOP)
        lag = 0.5 * (self.q_target - self.q)
        self.q, self.dq = self.q + lag, lag / TICK_S

    def _run_script(self, registers: Mapping[str, float]) -> None:
        """One turn of the control script's loop: real-time commands are ready again at once, others wait for a 0."""
        command = int(registers.get("input_int_register_0", 0))
        numbers = [registers.get(f"input_double_register_{i}", 0.0) for i in range(11)]
        if command == wire.Command.SERVO_J:
            self._servo, self._move = (np.array(numbers[:6]), numbers[9]), None
            self.moves += 1
            self.answer = wire.READY
        elif command == wire.Command.NONE:
            self.answer = wire.READY
        elif command != self._command:
            self._begin(command, numbers, registers)
        self._command = command
        if self._move is not None and self._move.over and not self._move.reported:
            self._move.reported, self.answer = True, wire.DONE

    def _begin(self, command: int, numbers: list[float], registers: Mapping[str, float]) -> None:
        if command == wire.Command.STOP_SCRIPT:
            self.end_script()
        elif command == wire.Command.MOVE_J:
            self._servo = None
            self._move = _Move(self.q_target, np.array(numbers[:6]), numbers[6], numbers[7])
            self._move.reported = registers.get("input_int_register_1", 0) == 1  # asynchronous: done is told at once
            self.answer = wire.DONE if self._move.reported else 0
            self.moves += 1
        elif command == wire.Command.SET_PAYLOAD and not 0 <= numbers[0] <= MOST_PAYLOAD_KG:
            self.end_script()  # set_payload raises, which ends the program
        else:
            if command == wire.Command.SET_PAYLOAD:
                self.payload = numbers[:4]
            if command in (wire.Command.SERVO_STOP, wire.Command.STOP_J):
                self._servo = self._move = None
            self.answer = wire.DONE

    def _next_target(self) -> Float[Array, "6"]:
        if self._move is not None and not self._move.over:
            return self._move.next()
        if self._servo is not None:
            target, lookahead_s = self._servo
            return self.q_target + (target - self.q_target) * min(1.0, TICK_S / max(lookahead_s, TICK_S) * 2)
        slower = np.sign(self.dq_target) * np.maximum(np.abs(self.dq_target) - BRAKE_RAD_S2 * TICK_S, 0)
        return self.q_target + slower * TICK_S


class _Move:
    """moveJ as a minimum-jerk move whose peak speed and acceleration are the asked ones."""

    def __init__(self, start: Float[Array, "6"], goal: Float[Array, "6"], speed: float, acceleration: float) -> None:
        self._start, self._goal = start.copy(), goal
        way = float(np.abs(goal - start).max())
        self._duration_s = max(1.875 * way / max(speed, 1e-3), np.sqrt(5.774 * way / max(acceleration, 1e-3)), TICK_S)
        self._at_s = 0.0
        self.reported = False

    @property
    def over(self) -> bool:
        return self._at_s >= self._duration_s

    def next(self) -> Float[Array, "6"]:
        self._at_s += TICK_S
        u = min(self._at_s / self._duration_s, 1.0)
        return self._start + (self._goal - self._start) * (u**3 * (10 - 15 * u + 6 * u**2))
