"""The process that speaks with a Universal Robots arm. See acquisition.drivers.ur.

ur-rtde keeps the newest state only, updated by a thread of its own: it is looked at twice per state, and a state whose
time stamp changed while its parts were read is read again.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.drivers.workers.arm_rows import BATCH, MODE_NUMBERS, row
from acquisition.drivers.workers.path import Brake, along, from_here
from acquisition.drivers.workers.process import WorkerEnd

JOINTS = 6
STATE = row(JOINTS)
VARIABLES = [
    *("timestamp", "target_q", "target_qd", "actual_q", "actual_qd", "target_moment"),
    *("robot_mode", "safety_mode", "robot_status_bits", "safety_status_bits", "runtime_state"),
    *("payload", "payload_cog"),
]
SILENT_S = 1.0
"""Without a new state for this long the arm counts as gone."""
SCRIPT_S = 1.5
STATE_S = 0.2
CATCH_UP = 1.2
"""So many samples of the path a cycle may go on by, when it was late before."""
SERVO_STOP_RAD_S2 = 10.0
ROBOT_RUNNING = 7
SAFE = "NORMAL"


class ArmLoop:
    """The connections, the states on their way to the driver, and the one motion."""

    def __init__(self, end: WorkerEnd, receive: Any, control: Any, dashboard: Any, options: dict[str, float]) -> None:
        self._end, self._receive, self._control, self._dashboard = end, receive, control, dashboard
        self._period_s = 1 / options["rate_hz"]
        self._options = options
        self._batch = bytearray(STATE.size * BATCH)
        self._filled = 0
        self._stamp = -1.0
        self._came_s = time.monotonic()
        self._mode = -1
        self._gripper = (float(receive.getPayload()), np.array(receive.getPayloadCog()))  # what the panel was told
        self.follower: Follower | None = None

    def run(self) -> None:
        """Read states and servo until the driver says quit. Raises RuntimeError when the arm is gone."""
        quitting = False
        while not (quitting and self.follower is None):
            began_s = time.monotonic()
            for message, blob in self._end.commands():
                quitting |= not self._obey(message, blob)
            self._look()
            if self.follower is not None and self.follower.step():
                self.follower = None
            time.sleep(max(0.0, self._period_s / 2 - (time.monotonic() - began_s)))

    def _obey(self, message: dict[str, Any], blob: bytes) -> bool:
        """Do what the driver asks; false when it asks to quit."""
        if message["do"] == "move":
            path = np.frombuffer(blob, dtype=np.float64).reshape(-1, JOINTS)
            here = np.array(self._receive.getTargetQ())
            self.follower = Follower(self._end, self._control, path, here, self._options, self._stop_reason)
        elif message["do"] in ("halt", "quit"):
            if self.follower is not None:
                self.follower.brake()
        elif message["do"] == "recover":
            self._end.event("answer", reason=self._recover())
        elif message["do"] == "load":
            self._end.event("answer", reason=self._load(message["mass"], message["centre"]))
        elif message["do"] == "check":
            self._end.event("answer", reason=self._unfit())
        return message["do"] != "quit"

    def _load(self, mass_kg: float, centre_flange_m: list[float]) -> str:
        """`set_payload` of the control script: the panel's payload and this one together. A controller that does not
        take it ends the script."""
        if self.follower is not None:
            return "a motion is under way"
        own_kg, own_at = self._gripper
        both_kg = own_kg + mass_kg
        at = (own_kg * own_at + mass_kg * np.array(centre_flange_m)) / max(both_kg, 1e-9)
        try:
            taken = self._control.setPayload(both_kg, at.tolist()) and self._control.isProgramRunning()
        except RuntimeError as error:
            return str(error)
        return "" if taken else self._stop_reason() or "its controller refuses set_payload: more than it carries?"

    def _unfit(self) -> str:
        """What the dashboard says against a motion: the safety mode, the panel's control."""
        try:
            if not self._dashboard.isConnected():
                self._dashboard.connect()
            safety, remote = self._dashboard.safetystatus(), self._dashboard.isInRemoteControl()
        except RuntimeError as error:
            return f"its dashboard server does not answer ({error}); nothing was moved"
        mode = safety.rpartition(":")[2].strip()
        if mode != SAFE:
            return f"its safety mode is {mode}, wanted {SAFE}; nothing was moved. Clear it at the panel"
        if not remote:
            return "it is in local control; nothing was moved. Switch it to remote control at the panel"
        return ""

    def _recover(self) -> str:
        try:
            if not self._dashboard.isConnected():
                self._dashboard.connect()
            self._dashboard.unlockProtectiveStop()
            if not self._control.isProgramRunning():
                self._control.reuploadScript()
            end_s = time.monotonic() + SCRIPT_S
            while not self._control.isProgramRunning():
                if time.monotonic() > end_s:
                    return "the control script does not start; is the arm in remote control?"
                time.sleep(0.01)
        except RuntimeError as error:
            return str(error)
        return ""

    def _look(self) -> None:
        """Pass on the state, if it is a new one."""
        receive = self._receive
        if time.monotonic() - self._came_s > SILENT_S:
            raise RuntimeError(f"no state for {SILENT_S:g} s")
        stamp = receive.getTimestamp()
        if stamp == self._stamp:
            return
        while True:
            parts = (receive.getActualQ(), receive.getActualQd(), receive.getTargetQ(), receive.getTargetQd())
            torque, mode = receive.getTargetMoment(), self._mode_now()
            after = receive.getTimestamp()
            if after == stamp:
                break
            stamp = after
        self._stamp, self._came_s = stamp, time.monotonic()
        self._log(stamp, [value for part in (*parts, torque) for value in part], mode)

    def _log(self, stamp_s: float, joints: list[float], mode: int) -> None:
        number = round(stamp_s / self._period_s)
        time_ns = round(stamp_s * 1e9)
        place = self._filled * STATE.size
        STATE.pack_into(self._batch, place, number, time_ns, time.monotonic_ns(), *joints, float("nan"), mode)
        self._filled += 1
        if mode != self._mode:
            self._mode = mode
            self._end.event("mode", mode=mode, errors=self._stop_reason())
        if self._filled == BATCH:
            self._end.emit(b"S", bytes(self._batch))
            self._filled = 0

    def _mode_now(self) -> int:
        if self._receive.isEmergencyStopped():
            return MODE_NUMBERS["user_stopped"]
        if self._receive.isProtectiveStopped():
            return MODE_NUMBERS["reflex"]
        if self._receive.getRobotMode() != ROBOT_RUNNING:
            return MODE_NUMBERS["error"]
        return MODE_NUMBERS["idle" if self.follower is None else "moving"]

    def _stop_reason(self) -> str:
        if self._receive.isEmergencyStopped():
            return "emergency stop"
        if self._receive.isProtectiveStopped():
            return "protective stop"
        mode = self._receive.getRobotMode()
        return "" if mode == ROBOT_RUNNING else f"robot mode {mode}"


class Follower:
    """One motion: servoJ once a period, at the place on the path that the clock tells."""

    def __init__(
        self,
        end: WorkerEnd,
        control: Any,
        path: Float[Array, "n 6"],
        here: Float[Array, "6"],
        options: dict[str, float],
        stop_reason: Any,
    ) -> None:
        self._end, self._control, self._options, self._stop_reason = end, control, options, stop_reason
        self._rate_hz = options["rate_hz"]
        self._path = from_here(path, here, self._rate_hz)
        self._brake: Brake | None = None
        self._began_s = time.monotonic()
        # the arm passes the path's start when it has caught up with its look-ahead
        self._started = time.monotonic_ns() + round(options["lookahead_s"] * 1e9)
        self._tick = -1
        self._place = 0.0
        self._ticks = self._missed = 0
        end.event("motion", status="moving", started=self._started)

    def brake(self) -> None:
        if self._brake is None:
            self._brake = Brake(self._place, self._rate_hz)

    def step(self) -> bool:
        """Send the next position, when it is due; whether the motion is over.

        After a pause of this process the path is caught up with little by little: a jump would be a protective stop.
        """
        tick = int((time.monotonic() - self._began_s) * self._rate_hz)
        if tick == self._tick:
            return False
        elapsed, self._tick = tick - self._tick, tick
        self._missed += elapsed - 1
        self._ticks += 1
        if self._brake is not None:
            self._brake.advance(1)
            self._place = self._brake.place
        else:
            self._place += min(tick - self._place, CATCH_UP)
        if not self._servo(along(self._path, self._place)):
            return self._over("aborted", self._why_stopped() or "the controller takes no more positions")
        if self._brake is not None and self._brake.standing:
            return self._over("aborted", "halted")
        arrived = self._place > len(self._path) + 3 * self._options["lookahead_s"] * self._rate_hz
        return self._over("done", "") if arrived else False

    def _why_stopped(self) -> str:
        """What the controller's states say of it, which may come a moment later than its refusal."""
        until = time.monotonic() + STATE_S
        while not (reason := self._stop_reason()) and time.monotonic() < until:
            time.sleep(1 / self._rate_hz)
        return str(reason)

    def _servo(self, q: Float[Array, "6"]) -> bool:
        options = self._options
        return bool(
            self._control.servoJ(q.tolist(), 0.0, 0.0, 1 / self._rate_hz, options["lookahead_s"], options["gain"])
        )

    def _over(self, status: str, reason: str) -> bool:
        if not self._stop_reason():
            self._control.servoStop(SERVO_STOP_RAD_S2)
        self._end.event(
            "motion",
            status=status,
            reason=reason,
            ticks=self._ticks,
            missed=self._missed,
            started=self._started,
        )
        return True


def main() -> NoReturn:
    end = WorkerEnd()
    host, options = sys.argv[1], json.loads(sys.argv[2])
    with end.failing("missing", ImportError):
        import dashboard_client
        import rtde_control
        import rtde_receive
    with end.failing("connect", Exception):  # ur-rtde throws what boost throws; whatever it is, the arm was not opened
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        about = {"model": dashboard.getRobotModel(), "serial": dashboard.getSerialNumber()}
        about["firmware"] = f"PolyScope {dashboard.polyscopeVersion()}"
        receive = rtde_receive.RTDEReceiveInterface(host, options["rate_hz"], VARIABLES)
        control = rtde_control.RTDEControlInterface(host, options["rate_hz"])
    end.event("open", **about)
    try:
        ArmLoop(end, receive, control, dashboard, options).run()
    except RuntimeError as error:
        end.event("lost", reason=str(error))
        end.leave()  # ur-rtde would try to reconnect for ever
    control.stopScript()
    end.leave()


if __name__ == "__main__":
    main()
