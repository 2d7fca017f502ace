"""A UR5e controller as ur-rtde sees it: RTDE, script and dashboard servers on loopback.

    with UrServer("127.0.0.1") as robot:
        robot.inject("protective_stop", at_s=0.5)
        rtde_control.RTDEControlInterface("127.0.0.1")

The control script that ur-rtde uploads is not interpreted: that it arrives starts its counterpart in rtde_body, which
does moveJ, servoJ and the stops; every other command is answered as done. No Cartesian poses, forces or currents (0).
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from typing import Any

import numpy as np

from acquisition.simulators import rtde_wire as wire
from acquisition.simulators.faults import Faults, Faulty
from acquisition.simulators.rtde_body import TICK_S, UrBody
from acquisition.simulators.sockets import Listener, Pacer, loopback, receive

FAULTS = {
    "protective_stop": "the arm stops for protection until unlocked through the dashboard",
    "user_stop": "the emergency stop is pressed, until it is over",
    "freeze": "no states are sent, the connections stay open",
    "nan_state": "actual joints are NaN",
    "unplug": "connections are cut and refused",
    "no_script": "the controller does not run the control script (no remote control)",
    "local_control": "somebody took the control at the panel; the script runs on",
    "reduced": "the dashboard tells the safety mode REDUCED",
}
CONTROLLER_VERSION = (5, 12, 0, 0)
POLYSCOPE = "URSoftware 5.12.0.1101319 (Mar 28 2022)"


class UrServer(Faulty):
    """The controller. `model` and `serial` are what the dashboard tells."""

    def __init__(self, host: str = "127.0.0.1", model: str = "UR5", serial: str = "20195500001") -> None:
        self.body = UrBody()
        self._model, self._serial, self._host = model, serial, loopback(host)
        self._faults = Faults(FAULTS)
        self._lock = threading.RLock()
        self._registers: dict[str, float] = {}
        self._clients: list[_Client] = []
        self._closed = threading.Event()
        self._ticks = 0
        self._counts = {"scripts": 0, "inputs": 0}
        self._stretched_s = 0.0
        servers = (
            (wire.RTDE_PORT, self._rtde),
            (wire.SCRIPT_PORT, self._script),
            (wire.DASHBOARD_PORT, self._dashboard),
        )
        self._listeners: list[Listener] = []
        try:
            for port, serve in servers:
                self._listeners.append(Listener(host, port, serve, lambda: self._faults.active("unplug")))
        except OSError:
            self._close_listeners()
            raise
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def snapshot(self) -> dict[str, Any]:
        with self._lock:
            body = self.body
            return {
                "q": body.q.tolist(),
                "safety": body.safety.name,
                "script_running": body.script_running,
                "moves": body.moves,
                "payload": list(body.payload),
                "ticks": self._ticks,
                "stretched_s": self._stretched_s,
                **self._counts,
            }

    def close(self) -> None:
        self._closed.set()
        self._thread.join(1.0)
        self._close_listeners()

    def _close_listeners(self) -> None:
        for listener in self._listeners:
            listener.close()

    # --- the controller's tick ---------------------------------------------------------------------------------

    def _run(self) -> None:
        pacer, late_s = Pacer(TICK_S), 0.0
        while not self._closed.is_set():
            with self._lock:
                self._apply_faults()
                self.body.step(self._registers, late_s)
                self._ticks += 1
                state = self._state()
                clients = tuple(self._clients)
            if not self._faults.active("freeze"):
                for client in clients:
                    client.send(state, self._ticks)
            late_s = pacer.wait()
            self._stretched_s += late_s

    def _apply_faults(self) -> None:
        if self._faults.take("protective_stop"):
            self.body.stop(wire.SafetyMode.PROTECTIVE_STOP)
        if self._faults.active("user_stop"):
            self.body.stop(wire.SafetyMode.ROBOT_EMERGENCY_STOP)
        elif self.body.safety == wire.SafetyMode.ROBOT_EMERGENCY_STOP:
            self.body.safety = wire.SafetyMode.NORMAL
        if self._faults.active("unplug"):
            for listener in self._listeners:
                listener.drop()
            self._clients.clear()

    def _state(self) -> dict[str, Any]:
        body = self.body
        nan = self._faults.active("nan_state") is not None
        nothing = np.full(wire.JOINTS, np.nan)
        return {
            "timestamp": self._ticks * TICK_S,
            "target_q": body.q_target,
            "target_qd": body.dq_target,
            "actual_q": nothing if nan else body.q,
            "actual_qd": nothing if nan else body.dq,
            "robot_mode": wire.ROBOT_RUNNING,
            "safety_mode": int(body.safety),
            "safety_status_bits": wire.SAFETY_BITS[body.safety],
            "robot_status_bits": wire.POWER_ON_BIT | (wire.PROGRAM_BIT if body.script_running else 0),
            "runtime_state": wire.PLAYING if body.script_running else wire.STOPPED,
            "speed_scaling": 1.0,
            "target_speed_fraction": 1.0,
            "output_int_register_0": body.answer,
            "payload": body.payload[0],
            "payload_cog": body.payload[1:],
        }

    # --- RTDE --------------------------------------------------------------------------------------------------

    def _rtde(self, connection: socket.socket) -> None:
        client = _Client(connection)
        recipes: list[tuple[list[str], struct.Struct]] = []
        try:
            while True:
                size, kind = struct.unpack(">HB", receive(connection, 3))
                payload = receive(connection, size - 3)
                if kind == wire.Package.DATA:
                    self._take_inputs(recipes[payload[0] - 1], payload[1:])
                else:
                    client.reply(kind, self._answer(client, recipes, kind, payload))
        finally:
            with self._lock:
                if client in self._clients:
                    self._clients.remove(client)

    def _answer(
        self, client: _Client, recipes: list[tuple[list[str], struct.Struct]], kind: int, payload: bytes
    ) -> bytes:
        if kind == wire.Package.CONTROLLER_VERSION:
            return struct.pack(">4I", *CONTROLLER_VERSION)
        if kind == wire.Package.SETUP_OUTPUTS:
            names = payload[8:].decode().strip(",").split(",")
            client.set_up(struct.unpack(">d", payload[:8])[0], names)
            return b"\x01" + ",".join(wire.type_of(name) for name in names).encode()
        if kind == wire.Package.SETUP_INPUTS:
            names = payload.decode().strip(",").split(",")
            recipes.append((names, wire.layout(names)[0]))
            return bytes([len(recipes)]) + ",".join(wire.type_of(name) for name in names).encode()
        with self._lock:
            if kind == wire.Package.START and client not in self._clients:
                self._clients.append(client)
            if kind == wire.Package.PAUSE and client in self._clients:
                self._clients.remove(client)
        return b"\x01"

    def _take_inputs(self, recipe: tuple[list[str], struct.Struct], payload: bytes) -> None:
        names, form = recipe
        if any(wire.type_of(name) == "VECTOR6D" for name in names):
            return  # an external force: nothing here feels it
        with self._lock:
            self._counts["inputs"] += 1
            self._registers.update(zip(names, form.unpack(payload)))

    # --- script and dashboard ----------------------------------------------------------------------------------

    def _script(self, connection: socket.socket) -> None:
        """Runs the control script once all of it has come (its last line is `end`)."""
        text = bytearray()
        connection.settimeout(0.05)
        while not self._closed.is_set():
            try:
                part = connection.recv(1 << 16)
            except TimeoutError:
                if b"def " in text and not self._faults.active("no_script"):
                    with self._lock:
                        self._counts["scripts"] += 1
                        self._registers.clear()
                        self.body.load_script()
                text.clear()
                continue
            if not part:
                return
            text += part

    def _dashboard(self, connection: socket.socket) -> None:
        connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
        lines = connection.makefile("r")
        for line in lines:
            connection.sendall(self._dashboard_answer(line.strip()).encode() + b"\n")

    def _dashboard_answer(self, line: str) -> str:
        with self._lock:
            if line == "stop":
                self.body.end_script()
                return "Stopped"
            if line == "unlock protective stop":
                if self.body.safety == wire.SafetyMode.PROTECTIVE_STOP:
                    self.body.safety = wire.SafetyMode.NORMAL
                return "Protective stop releasing"
            local = self._faults.active("no_script") or self._faults.active("local_control")
            safety = "REDUCED" if self._faults.active("reduced") else self.body.safety.name
            answers = {
                "polyscopeversion": POLYSCOPE,
                "get serial number": self._serial,
                "get robot model": self._model,
                "is in remote control": "false" if local else "true",
                "robotmode": "Robotmode: RUNNING",
                "safetystatus": f"Safetystatus: {safety}",
            }
        return answers.get(line.lower(), f"could not understand: '{line}'")


class _Client:
    """One RTDE connection: what it wants to hear, and how often."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
        self._sending = threading.Lock()
        self._names: list[str] = []
        self._form = struct.Struct("")
        self._counts: list[int] = []
        self._every = 1

    def set_up(self, rate_hz: float, names: list[str]) -> None:
        self._names = names
        self._form, self._counts = wire.layout(names)
        self._every = max(1, round(1 / (rate_hz * TICK_S)))

    def reply(self, kind: int, payload: bytes) -> None:
        with self._sending:
            self._connection.sendall(wire.package(kind, payload))

    def send(self, state: dict[str, Any], tick: int) -> None:
        if tick % self._every:
            return
        numbers: list[float] = []
        for name, count in zip(self._names, self._counts):
            value = state.get(name, 0)
            numbers.extend(value if count > 1 and not isinstance(value, int) else [value] * count)
        try:
            self.reply(wire.Package.DATA, b"\x01" + self._form.pack(*numbers))
        except OSError:  # it has just left; its own thread clears up
            time.sleep(0)
