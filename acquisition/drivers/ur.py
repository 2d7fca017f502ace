"""Universal Robots e-series (UR3e to UR16e) through ur-rtde: states at 500 Hz, joint trajectories by servoJ.

ur-rtde speaks with Universal Robots' controllers only; it does not drive the Franka Panda, which has a driver of its
own (acquisition.drivers.franka). It runs in a process of its own: it crashes the interpreter when a connection breaks
in the wrong moment, and its servo loop shall not wait for anybody.
servoJ follows with the delay of its look-ahead time (30 ms at least): `Motion.started_host_ns` is later by it.
"""

from __future__ import annotations

import json
from importlib import metadata
from typing import Any

from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.devices import DeviceRefused
from acquisition.drivers.workers.arm import WorkerArm
from recordings.errors import DeviceNotFound

JOINT_NAMES = (
    *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"),
    *("wrist_1_joint", "wrist_2_joint", "wrist_3_joint"),
)
LOOKAHEAD_S = 0.03
GAIN = 1000.0


class UrArm(WorkerArm):
    """The arm at `host`; with `serial`, only that one."""

    joint_names = JOINT_NAMES
    rate_hz = 500.0
    clock = "ur"
    module = "acquisition.drivers.workers.ur"

    def __init__(
        self,
        name: str = "arm",
        host: str = "",
        serial: str | None = None,
        lookahead_s: float = LOOKAHEAD_S,
        gain: float = GAIN,
    ) -> None:
        if not 0.03 <= lookahead_s <= 0.2 or not 100 <= gain <= 2000:
            raise DeviceRefused(
                f"{name}: found lookahead_s {lookahead_s:g}, gain {gain:g}; servoJ takes 0.03 to 0.2 s and 100 to 2000"
            )
        self.name = name
        self._host, self._serial = host, serial
        self._options = {"rate_hz": self.rate_hz, "lookahead_s": lookahead_s, "gain": gain}
        super().__init__([host, json.dumps(self._options)])

    def open(self) -> None:
        if not self._host:
            raise DeviceRefused(f"{self.name}: no address; give the robot's as `address` in the rig")
        super().open()
        found = str(self._about["serial"])
        if self._serial not in (None, found):
            model = self._about["model"]
            self.close()
            raise DeviceNotFound(
                f"{self.name}: found {model} serial {found} at {self._host}; wanted serial {self._serial}; check "
                "`host` and `serial` in the rig"
            )

    def unfit(self) -> str:
        """Safety mode and remote control, asked of the controller now."""
        answer = self.ask_worker({"do": "check"})
        return "its controller did not say whether it may move; check the network" if answer is None else answer

    def set_load(self, mass_kg: float, centre_flange_m: Float[Array, "3"], radius_m: float) -> None:
        """What the hand holds, added to the payload that the controller had when the arm was opened (the gripper's, set
        at the panel). It asks for no inertia, so `radius_m` is not said. Raises DeviceRefused where the controller does
        not take it, and during a motion."""
        answer = self.ask_worker({"do": "load", "mass": mass_kg, "centre": centre_flange_m.tolist()})
        if answer != "":
            raise DeviceRefused(f"{self.name}: the load of {mass_kg:g} kg was not taken: {answer or 'no answer'}")

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "arm",
            "model": f"Universal Robots {self._about.get('model')}",
            "serial": self._about.get("serial"),
            "firmware": self._about.get("firmware"),
            "driver": f"ur-rtde {metadata.version('ur-rtde')}",
            "rate_hz": self.rate_hz,
            "settings": {"host": self._host, **self._options},
            "warnings": ["torques are the controller's targets; the share of commands in time is not told"],
        }

    def not_opened(self, kind: str, reason: str) -> DeviceNotFound | DeviceRefused:
        what = f"{self.name} (Universal Robots arm at {self._host})"
        if kind == "missing":
            return DeviceNotFound(
                f"{what} needs ur-rtde, which is not installed ({reason}); run `pip install -e .[rig-ur]`"
            )
        if "remote control" in reason or "control script" in reason:
            return DeviceRefused(f"{what} runs no control script: {reason}; switch it to remote control on its panel")
        return DeviceNotFound(f"{what} does not answer: {reason}; check the address and that the arm is switched on")
