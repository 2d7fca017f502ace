"""The process that speaks with a Panda: logs every state, follows joint trajectories. See acquisition.drivers.franka.

One thread: libfranka's binding holds the interpreter's lock during `read` and `control`, so commands are looked for
between two states, in the callback.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.drivers.workers.arm_rows import row
from acquisition.drivers.workers.path import Brake, along, from_here
from acquisition.drivers.workers.process import WorkerEnd

JOINTS = 7
RATE_HZ = 1000.0
STATE = row(JOINTS)
BATCH = 10
LOOK_EVERY = 5
NO_FILTER_HZ = 1000.0
"""libfranka's low-pass filter is off from here on: it would delay the toss by its phase."""


class ArmLoop:
    """The connection, and the states on their way to the driver."""

    def __init__(self, end: WorkerEnd, libfranka: Any, robot: Any) -> None:
        self._end, self._lib, self._robot = end, libfranka, robot
        self._batch = bytearray(STATE.size * BATCH)
        self._filled = 0
        self._ticks = 0
        self._mode = -1

    def run(self) -> None:
        """Read states until the driver says quit. Raises RuntimeError when the arm is gone."""
        while True:
            self._robot.read(self._log_and_look)
            for message, blob in self._end.commands():
                if not self._obey(message, blob):
                    return

    def _obey(self, message: dict[str, Any], blob: bytes) -> bool:
        """Do what the driver asks; false when it asks to quit."""
        if message["do"] == "move":
            path = np.frombuffer(blob, dtype=np.float64).reshape(-1, JOINTS)
            return Follower(self._end, self._lib, self._robot, self._log, path).run()
        if message["do"] == "recover":
            self._answer(self._robot.automatic_error_recovery)
        elif message["do"] == "load":
            ball = (message["inertia"] * np.eye(3)).ravel().tolist()
            self._answer(lambda: self._robot.set_load(message["mass"], message["centre"], ball))
        return message["do"] != "quit"

    def _answer(self, call: Callable[[], object]) -> None:
        """Do it, and tell the driver why not."""
        reason = ""
        try:
            call()
        except RuntimeError as error:
            reason = str(error)
        self._end.event("answer", reason=reason)

    def _log_and_look(self, state: Any) -> bool:
        self._log(state)
        return self._ticks % LOOK_EVERY != 0 or not self._end.waiting()

    def _log(self, state: Any) -> None:
        mode, time_ms = state.robot_mode.value, state.time.to_msec()
        STATE.pack_into(
            self._batch,
            self._filled * STATE.size,
            time_ms,
            time_ms * 1_000_000,
            time.monotonic_ns(),
            *state.q,
            *state.dq,
            *state.q_d,
            *state.dq_d,
            *state.tau_J,
            state.control_command_success_rate,
            mode,
        )
        self._ticks += 1
        self._filled += 1
        if mode != self._mode:
            self._mode = mode
            self._end.event("mode", mode=mode, errors=_reason(state))
        if self._filled == BATCH:
            self._end.emit(b"S", bytes(self._batch))
            self._filled = 0


class Follower:
    """One motion along a path sampled at 1 kHz."""

    def __init__(self, end: WorkerEnd, libfranka: Any, robot: Any, log: Any, path: Float[Array, "n 7"]) -> None:
        self._end, self._lib, self._robot, self._log = end, libfranka, robot, log
        self._path = path
        self._commands: list[Any] = []
        self._at_ms = 0
        self._calls = 0
        self._missed = 0
        self._quit = False
        self._brake: Brake | None = None

    def run(self) -> bool:
        """Move, and tell how it went; false when the driver asked to quit meanwhile."""
        started, reason = time.monotonic_ns(), ""
        self._end.event("motion", status="moving", started=started)
        try:
            self._prepare(np.array(self._robot.read_once().q_d))
            self._robot.control_joint_position(self._next, limit_rate=True, cutoff_frequency=NO_FILTER_HZ)
        except RuntimeError as error:
            reason = " ".join(str(error).split())
        if not reason and self._brake is not None:
            reason = "halted"
        self._end.event(
            "motion",
            status="aborted" if reason else "done",
            reason=reason,
            ticks=self._calls,
            missed=self._missed,
            started=started,
        )
        return not self._quit

    def _prepare(self, q_desired: Float[Array, "7"]) -> None:
        """The path from where the arm's controller stands (encoder noise apart from the planned start), as commands."""
        self._path = from_here(self._path, q_desired, RATE_HZ)
        self._commands = [self._lib.JointPositions(q) for q in self._path.tolist()]
        self._commands[-1].motion_finished = True

    def _next(self, state: Any, step: Any) -> Any:
        elapsed_ms = step.to_msec()
        self._missed += max(0, elapsed_ms - 1)
        self._calls += 1
        self._at_ms += elapsed_ms
        if self._brake is None and self._calls % LOOK_EVERY == 0 and self._end.waiting():
            self._look(elapsed_ms)
        command = self._braking(elapsed_ms) if self._brake else self._commands[min(self._at_ms, len(self._path) - 1)]
        self._log(state)
        return command

    def _look(self, elapsed_ms: int) -> None:
        for message, _ in self._end.commands():
            if message["do"] in ("halt", "quit"):
                self._brake = self._brake or Brake(float(self._at_ms - elapsed_ms), RATE_HZ)
            self._quit |= message["do"] == "quit"

    def _braking(self, elapsed_ms: int) -> Any:
        assert self._brake is not None
        self._brake.advance(elapsed_ms)
        command = self._lib.JointPositions(along(self._path, self._brake.place).tolist())
        command.motion_finished = self._brake.standing
        return command


def _reason(state: Any) -> str:
    """Names of the errors that hold, or of those that ended the last motion when the arm stands in reflex."""
    errors = state.last_motion_errors if state.robot_mode.name == "kReflex" else state.current_errors
    flags = [name for name in dir(errors) if not name.startswith("_") and getattr(errors, name) is True]
    return ", ".join(flags)


def guard(robot: Any, torque_nm: float, force_n: float) -> None:
    """Where the arm stops by itself: this much while it speeds up or brakes, half at constant speed; no load yet."""
    torque, force = [torque_nm] * JOINTS, [force_n] * 6
    half_torque, half_force = [torque_nm / 2] * JOINTS, [force_n / 2] * 6
    robot.set_collision_behavior(torque, torque, half_torque, half_torque, force, force, half_force, half_force)
    robot.set_load(0.0, [0.0] * 3, [0.0] * 9)


def main() -> NoReturn:
    end = WorkerEnd()
    host, realtime = sys.argv[1], sys.argv[2]
    with end.failing("missing", ImportError):
        from panda_py import libfranka
    with end.failing("connect", RuntimeError):
        config = {"ignore": libfranka.RealtimeConfig.kIgnore, "enforce": libfranka.RealtimeConfig.kEnforce}[realtime]
        robot = libfranka.Robot(host, config)
        guard(robot, **json.loads(sys.argv[3]))
    end.event("open", version=robot.server_version())
    try:
        ArmLoop(end, libfranka, robot).run()
    except RuntimeError as error:
        end.event("lost", reason=str(error))
    end.leave()


if __name__ == "__main__":
    main()
