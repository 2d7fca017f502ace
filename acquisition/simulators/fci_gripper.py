"""The Franka Hand as libfranka sees it: requests over TCP 1338, its state over UDP. Started by FciServer."""

from __future__ import annotations

import random
import socket
import struct
import threading
import time
from typing import Any

from acquisition.simulators import fci_wire as wire
from acquisition.simulators.faults import Faults
from acquisition.simulators.sockets import Listener, receive

GRIPPER_FAULTS = {
    "gripper_timeout": "commands are taken and never answered, the fingers stand still",
    "gripper_fail": "the next command fails",
    "gripper_slow": "fingers start later by delay_s=0.3",
    "gripper_freeze": "no gripper states are sent",
    "gripper_unplug": "the gripper's connections are cut and refused",
}
MAX_WIDTH_M = 0.08
STATES_HZ = 30.0
STEP_S = 0.002
START_DELAY_S = (0.03, 0.005)
"""Mean and standard deviation of the time from a command to the fingers' first movement."""


class GripperServer:
    """Two fingers that move at the commanded speed after a delay, and stop at an object between them.

    `object_width_m`: the object's; 0: there is none; None: one as wide as each grasp expects.
    """

    def __init__(self, host: str, faults: Faults, object_width_m: float | None = None, seed: int = 0) -> None:
        self.width_m = MAX_WIDTH_M
        self.object_width_m = object_width_m
        self.grasped = False
        self._faults = faults
        self._host = host
        self._random = random.Random(seed)
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._counts = {"commands": 0, "states": 0}
        self._listener = Listener(host, wire.GRIPPER_PORT, self._serve, lambda: faults.active("gripper_unplug"))

    def snapshot(self) -> dict[str, Any]:
        return {"width_m": self.width_m, "grasped": self.grasped, **self._counts}

    def close(self) -> None:
        self._stopping.set()
        self._listener.close()

    def _serve(self, connection: socket.socket) -> None:
        gone = threading.Event()
        try:
            while True:
                request, command, size = struct.unpack("<HII", receive(connection, 10))
                payload = receive(connection, size - 10)
                if request == wire.GripperRequest.CONNECT:
                    version, port = struct.unpack("<HH", payload)
                    fits = version == wire.GRIPPER_VERSION
                    answer = struct.pack("<HH", 0 if fits else 1, wire.GRIPPER_VERSION)
                    connection.sendall(struct.pack("<HII", request, command, 14) + answer)
                    client = (connection.getpeername()[0], port)
                    threading.Thread(target=self._stream, args=(connection, client, gone), daemon=True).start()
                else:
                    threading.Thread(
                        target=self._run, args=(connection, request, command, payload), daemon=True
                    ).start()
        finally:
            gone.set()

    def _stream(self, connection: socket.socket, client: tuple[str, int], gone: threading.Event) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
            udp.bind((self._host, 0))
            while not gone.wait(1 / STATES_HZ):
                if self._faults.active("gripper_unplug"):
                    connection.shutdown(socket.SHUT_RDWR)
                    return
                self._counts["states"] += 1
                state = (self._counts["states"], self.width_m, MAX_WIDTH_M, self.grasped, 30)
                if not self._faults.active("gripper_freeze"):
                    udp.sendto(struct.pack("<IddBH", *state), client)

    def _run(self, connection: socket.socket, request: int, command: int, payload: bytes) -> None:
        self._counts["commands"] += 1
        if self._faults.active("gripper_timeout"):
            return
        status = wire.GripperAnswer.FAIL if self._faults.take("gripper_fail") else self._obey(request, payload)
        try:
            connection.sendall(struct.pack("<HIIH", request, command, 12, status))
        except OSError:  # the client left before its answer
            pass

    def _obey(self, request: int, payload: bytes) -> wire.GripperAnswer:
        if request == wire.GripperRequest.STOP:
            self._stopping.set()
            return wire.GripperAnswer.SUCCESS
        with self._lock:
            self._stopping.clear()
            slow = self._faults.active("gripper_slow")
            time.sleep(max(0.0, self._random.gauss(*START_DELAY_S)) + (slow.number("delay_s", 0.3) if slow else 0.0))
            if request == wire.GripperRequest.GRASP:
                return self._grasp(*struct.unpack("<5d", payload))
            if request == wire.GripperRequest.MOVE:
                return self._move(*struct.unpack("<dd", payload))
            return self._move(MAX_WIDTH_M, 0.1)

    def _grasp(self, width: float, inner: float, outer: float, speed: float, force: float) -> wire.GripperAnswer:
        self._travel(width if self.object_width_m is None else self.object_width_m, speed)
        held = force > 0 and width - inner <= self.width_m <= width + outer and self.object_width_m != 0
        self.grasped = held
        return wire.GripperAnswer.SUCCESS if held else wire.GripperAnswer.UNSUCCESSFUL

    def _move(self, width: float, speed: float) -> wire.GripperAnswer:
        if not 0 <= width <= MAX_WIDTH_M or speed <= 0:
            return wire.GripperAnswer.FAIL
        self.grasped = False
        self._travel(width, speed)
        return wire.GripperAnswer.ABORTED if self._stopping.is_set() else wire.GripperAnswer.SUCCESS

    def _travel(self, target_m: float, speed_m_s: float) -> None:
        start_m, start_s = self.width_m, time.monotonic()
        way_m = target_m - start_m
        while self.width_m != target_m and not self._stopping.is_set():
            time.sleep(STEP_S)
            gone_m = min((time.monotonic() - start_s) * speed_m_s, abs(way_m))
            self.width_m = target_m if gone_m == abs(way_m) else start_m + (gone_m if way_m > 0 else -gone_m)
