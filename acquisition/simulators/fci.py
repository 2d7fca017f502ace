"""A Panda as libfranka 0.9 sees it: an FCI server (version 5) on loopback, with its gripper.

    with FciServer("127.0.0.1") as arm:
        arm.inject("reflex", at_s=0.5)
        panda_py.libfranka.Robot("127.0.0.1")

The ports are fixed in libfranka (1337, 1338): two arms need two loopback addresses. Simulated are the connection, the
1 kHz state stream over UDP, joint position and joint velocity motions with the arm's supervision of limits, stopping,
error recovery, user stop and the count of commands that came in time. Not simulated: Cartesian and torque control,
dynamics (all torques are 0) and forward kinematics (poses are the identity). During a motion a millisecond lasts until
the client has answered it (PATIENCE_S at most), so that a busy machine stretches time and loses no command.
"""

from __future__ import annotations

import random
import select
import socket
import struct
import threading
from collections import deque
from typing import Any

import numpy as np

from acquisition.simulators import fci_wire as wire
from acquisition.simulators.faults import Faults, Faulty
from acquisition.simulators.fci_body import TICK_S, FciBody
from acquisition.simulators.fci_gripper import GRIPPER_FAULTS, GripperServer
from acquisition.simulators.sockets import Listener, Pacer, loopback, receive
from recordings.errors import BadInput

FAULTS = {
    "reflex": "the arm stops and stands in reflex until recovered; error=joint_reflex (or another of fci_wire.ERRORS)",
    "user_stop": "the user stop is pressed: motion aborted, no recovery, until it is over",
    "lost_packets": "each state and each command is lost with probability share=0.05",
    "no_commands": "commands do not arrive (states do): the arm aborts after 20 missing in a row",
    "freeze": "no states are sent, the connection stays open",
    "nan_state": "measured joints are NaN",
    "unplug": "connections are cut and refused",
    **GRIPPER_FAULTS,
}
COMMUNICATION_MISSES = 20
"""Missing commands in a row at which a Panda aborts."""
FIRST_COMMAND_TICKS = 2000
PATIENCE_S = 0.5
"""So long a motion's millisecond may last when the client has not answered it: only `faults` lose commands here."""
RATE_WINDOW = 100


class FciServer(Faulty):
    """The arm and its gripper. `version` is the FCI server version it claims; `object_width_m` as in GripperServer."""

    def __init__(
        self, host: str = "127.0.0.1", version: int = wire.ROBOT_VERSION, object_width_m: float | None = None
    ) -> None:
        self.body = FciBody()
        self.mode = wire.RobotMode.IDLE
        self._faults = Faults(FAULTS)
        self._host, self._version = loopback(host), version
        self._random = random.Random(0)
        self._lock = threading.RLock()
        self._counts = {"states": 0, "commands": 0, "missed": 0, "motions": 0, "aborted": 0, "recoveries": 0}
        self._motion = _Motion()
        self._errors = np.zeros(wire.ERROR_FLAGS, dtype=np.uint8)
        self._reflex_reason = np.zeros(wire.ERROR_FLAGS, dtype=np.uint8)
        self._set: dict[wire.Request, list[float]] = {}
        """The numbers of the collision thresholds and of the load, as they were last set."""
        self._stretched_s = 0.0
        self._gripper = GripperServer(self._host, self._faults, object_width_m)
        try:
            self._listener = Listener(self._host, wire.ROBOT_PORT, self._serve, lambda: self._faults.active("unplug"))
        except OSError:
            self._gripper.close()
            raise

    def inject(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **detail: float | str) -> None:
        if kind == "reflex" and detail.get("error", "joint_reflex") not in wire.ERRORS:
            raise BadInput(f"no error '{detail['error']}' here; wanted one of {', '.join(wire.ERRORS)}")
        super().inject(kind, at_s, for_s, **detail)

    def snapshot(self) -> dict[str, Any]:
        """Counts, mode and joints; `stretched_s` is by how much the simulator itself was too slow."""
        with self._lock:
            joints = {"q": self.body.q.tolist(), "q_d": self.body.q_d.tolist()}
            settings = {request.name.lower(): numbers for request, numbers in self._set.items()}
            own = {**settings, "mode": self.mode.name, "stretched_s": self._stretched_s, **self._counts, **joints}
        return own | {"gripper": self._gripper.snapshot()}

    def close(self) -> None:
        self._listener.close()
        self._gripper.close()

    # --- requests over TCP -------------------------------------------------------------------------------------

    def _serve(self, connection: socket.socket) -> None:
        gone = threading.Event()
        try:
            while True:
                request, command, size = struct.unpack("<III", receive(connection, 12))
                payload = receive(connection, size - 12)
                if request == wire.Request.CONNECT:
                    version, port = struct.unpack("<HH", payload)
                    fits = version == self._version
                    _reply(connection, request, command, struct.pack("<BH", 0 if fits else 1, self._version))
                    client = (connection.getpeername()[0], port)
                    if fits:
                        threading.Thread(target=self._stream, args=(connection, client, gone), daemon=True).start()
                else:
                    self._answer(connection, request, command, payload)
        finally:
            gone.set()
            with self._lock:
                self._motion.connection = None if self._motion.connection is connection else self._motion.connection

    def _answer(self, connection: socket.socket, request: int, command: int, payload: bytes) -> None:
        if request == wire.Request.MOVE:
            self._begin(connection, command, payload)
        elif request == wire.Request.STOP_MOVE:
            with self._lock:
                self._end(wire.Answer.PREEMPTED)
            _reply(connection, request, command, b"\x00")
        elif request == wire.Request.AUTOMATIC_ERROR_RECOVERY:
            _reply(connection, request, command, bytes([self._recover()]))
        elif request == wire.Request.LOAD_MODEL_LIBRARY:
            _reply(connection, request, command, b"\x01")  # kError: there are no dynamics here
        elif request in wire.SETTER_NUMBERS:
            _reply(connection, request, command, bytes([self._take(wire.Request(request), payload)]))
        else:  # other setters: taken and not used
            _reply(connection, request, command, b"\x00")

    def _take(self, request: wire.Request, payload: bytes) -> int:
        """Keep what a setter says, for `snapshot`; refused during a motion, as by the arm."""
        with self._lock:
            if self.mode == wire.RobotMode.MOVE:
                return wire.SETTER_NOT_POSSIBLE
            self._set[request] = list(struct.unpack(f"<{wire.SETTER_NUMBERS[request]}d", payload))
            return wire.SETTER_DONE

    def _begin(self, connection: socket.socket, command: int, payload: bytes) -> None:
        controller, generator = struct.unpack("<II", payload[:8])
        with self._lock:
            known = generator + 1 in (wire.Generator.JOINT_POSITION, wire.Generator.JOINT_VELOCITY)
            if self.mode != wire.RobotMode.IDLE or controller != 0 or not known:
                _reply(connection, wire.Request.MOVE, command, bytes([wire.Answer.NOT_POSSIBLE]))
                return
            _reply(connection, wire.Request.MOVE, command, bytes([wire.Answer.MOTION_STARTED]))
            self._motion = _Motion(connection, command, wire.Generator(generator + 1), controller)
            self._reflex_reason[:] = 0
            self.mode = wire.RobotMode.MOVE
            self._counts["motions"] += 1

    def _recover(self) -> wire.RecoveryAnswer:
        with self._lock:
            self._counts["recoveries"] += 1
            if self.mode == wire.RobotMode.USER_STOPPED:
                return wire.RecoveryAnswer.EMERGENCY_ABORTED
            if self.mode == wire.RobotMode.MOVE:
                return wire.RecoveryAnswer.NOT_POSSIBLE
            self._errors[:] = 0
            self.mode = wire.RobotMode.IDLE
            return wire.RecoveryAnswer.SUCCESS

    # --- states and commands over UDP --------------------------------------------------------------------------

    def _stream(self, connection: socket.socket, client: tuple[str, int], gone: threading.Event) -> None:
        state = np.zeros((), dtype=wire.ROBOT_STATE)
        for name in wire.IDENTITY_POSES:
            state[name] = np.eye(4).ravel()
        pacer = Pacer(TICK_S)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.bind((self._host, 0))
            udp.setblocking(False)
            while not gone.is_set():
                if self._faults.active("unplug"):
                    connection.shutdown(socket.SHUT_RDWR)
                    return
                with self._lock:
                    ended = self._tick(self._commands(udp), state)
                sent = not (self._faults.active("freeze") or self._lost())
                if sent:
                    udp.sendto(state.tobytes(), client)
                if ended is not None:  # after the state that shows the motion's end, as the arm does
                    ended.answer()
                if sent:
                    self._wait_for_answer(udp)
                self._stretched_s += pacer.wait()

    def _wait_for_answer(self, udp: socket.socket) -> None:
        """Until a command is there, during a motion whose client has not just let one wait run out."""
        with self._lock:
            motion = self._motion
        if motion.commanded and motion.answering:
            motion.answering = bool(select.select([udp], [], [], PATIENCE_S)[0])

    def _commands(self, udp: socket.socket) -> np.void | None:
        """The newest command since the last tick that was not lost."""
        newest = None
        while True:
            try:
                data = udp.recv(2048)
            except BlockingIOError:
                return newest
            if len(data) != wire.ROBOT_COMMAND.itemsize or self._faults.active("no_commands") or self._lost():
                continue
            self._counts["commands"] += 1
            self._motion.answering = True
            newest = np.frombuffer(data, wire.ROBOT_COMMAND)[0]

    def _lost(self) -> bool:
        fault = self._faults.active("lost_packets")
        return fault is not None and self._random.random() < fault.number("share", 0.05)

    def _tick(self, command: np.void | None, state: Any) -> _Motion | None:
        """One millisecond of the arm. The motion that ended in it, if one did."""
        ended = self._interrupted()
        if self.mode == wire.RobotMode.MOVE:
            ended = self._moved(command)
        else:
            self.body.brake()
        self._counts["states"] += 1
        self._fill(state)
        return ended

    def _interrupted(self) -> _Motion | None:
        reflex = self._faults.take("reflex")
        if self._faults.active("user_stop"):
            ended = self._end(wire.Answer.EMERGENCY_ABORTED, reply=False)
            self.mode = wire.RobotMode.USER_STOPPED
            return ended
        if self.mode == wire.RobotMode.USER_STOPPED:
            self.mode = wire.RobotMode.IDLE
        if reflex is not None:
            return self._reflex(str(reflex.detail.get("error", "joint_reflex")))
        return None

    def _moved(self, command: np.void | None) -> _Motion | None:
        motion = self._motion
        motion.ticks += 1
        if motion.connection is None or not self._in_time(command is not None):
            return self._reflex("communication_constraints_violation")
        if command is None:
            self.body.extrapolate()
            return None
        position = motion.generator == wire.Generator.JOINT_POSITION
        error = self.body.follow(command["q_c"] if position else self.body.q_d + command["dq_c"] * TICK_S)
        if error is None and command["finished"]:
            if self.body.resting:
                return self._end(wire.Answer.SUCCESS, reply=False)
            error = "joint_motion_generator_velocity_discontinuity"
        return self._reflex(error) if error is not None else None

    def _in_time(self, came: bool) -> bool:
        """Count whether a command came; false when so many are missing that the arm aborts."""
        motion = self._motion
        if not motion.commanded and not came:
            return motion.ticks < FIRST_COMMAND_TICKS
        motion.commanded = True
        motion.in_time.append(came)
        motion.missing = 0 if came else motion.missing + 1
        self._counts["missed"] += not came
        return motion.missing < COMMUNICATION_MISSES

    def _reflex(self, error: str) -> _Motion | None:
        ended = self._end(wire.Answer.REFLEX_ABORTED, reply=False)
        for flags in (self._errors, self._reflex_reason):
            flags[:] = 0
            flags[wire.ERRORS[error]] = 1
        self.mode = wire.RobotMode.REFLEX
        return ended

    def _end(self, status: wire.Answer, reply: bool = True) -> _Motion | None:
        """The motion that this ends, if one is on; it is answered now, or later by the caller."""
        if self.mode != wire.RobotMode.MOVE:
            return None
        motion, self._motion = self._motion, _Motion()
        motion.status = status
        self.mode = wire.RobotMode.IDLE
        self._counts["aborted"] += status != wire.Answer.SUCCESS
        if reply:
            motion.answer()
        return motion

    def _fill(self, state: Any) -> None:
        body, motion = self.body, self._motion
        state["message_id"] = self._counts["states"]
        nan = self._faults.active("nan_state") is not None
        state["q"] = state["theta"] = np.nan if nan else body.q
        state["dq"] = state["dtheta"] = np.nan if nan else body.dq
        state["q_d"], state["dq_d"], state["ddq_d"] = body.q_d, body.dq_d, body.ddq_d
        moving = self.mode == wire.RobotMode.MOVE
        state["motion_generator_mode"] = motion.generator if moving else wire.Generator.IDLE
        state["controller_mode"] = motion.controller if moving else wire.CONTROLLER_OTHER
        state["errors"], state["reflex_reason"] = self._errors, self._reflex_reason
        state["robot_mode"] = self.mode
        share = sum(motion.in_time) / len(motion.in_time) if motion.in_time else float(moving)
        state["control_command_success_rate"] = share


class _Motion:
    """A Move from its request to its answer."""

    def __init__(
        self,
        connection: socket.socket | None = None,
        command: int = 0,
        generator: wire.Generator = wire.Generator.IDLE,
        controller: int = wire.CONTROLLER_OTHER,
    ) -> None:
        self.connection, self.command, self.generator, self.controller = connection, command, generator, controller
        self.status = wire.Answer.SUCCESS
        self.ticks = 0
        self.missing = 0
        self.commanded = False
        self.answering = True
        self.in_time: deque[bool] = deque(maxlen=RATE_WINDOW)

    def answer(self) -> None:
        if self.connection is not None:
            _reply(self.connection, wire.Request.MOVE, self.command, bytes([self.status]))


def _reply(connection: socket.socket, request: int, command: int, payload: bytes) -> None:
    connection.sendall(struct.pack("<III", request, command, 12 + len(payload)) + payload)
