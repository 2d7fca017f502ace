"""The Franka Panda (FER) through panda-python, which carries libfranka 0.9.2: FCI server version 5, system >= 4.2.1.

Not covered: the FR3 (FCI server version 6 and up needs franky-control or pylibfranka, which cannot share a process
with panda_py), and Pandas with older firmware (panda-python's other wheels). `open` says which version it found.

The client runs in a process of its own (franka_worker): libfranka's binding holds the interpreter's lock while it
waits. Joint trajectories are sent as joint positions at 1 kHz with libfranka's rate limiter on and its low-pass filter
off; the arm's own joint impedance controller follows them. The FCI tells no serial number: the address is the identity.
"""

from __future__ import annotations

import json
import os
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.devices import DeviceRefused
from acquisition.drivers.workers.arm import WorkerArm
from recordings.errors import DeviceNotFound

REALTIME = Path("/sys/kernel/realtime")
"""Holds 1 on a real-time kernel; where libfranka looks, too."""
COLLISION_NM, COLLISION_N = 20.0, 20.0
MOST_NM, MOST_N = 87.0, 150.0
JOINT_NAMES = tuple(f"panda_joint{i}" for i in range(1, 8))


class FrankaArm(WorkerArm):
    """A Panda at `host`. `realtime="enforce"` refuses to move without a real-time kernel; states are read all the same.

    The arm stops where it feels more than `collision_torque_nm` in a joint or `collision_force_n` at the hand while it
    speeds up or brakes, half of that at constant speed (set when it is opened). It is told its load by `set_load`.
    """

    joint_names = JOINT_NAMES
    rate_hz = 1000.0
    clock = "fci"
    module = "acquisition.drivers.workers.franka"

    def __init__(
        self,
        name: str = "arm",
        host: str = "",
        serial: str | None = None,
        realtime: Literal["ignore", "enforce"] = "enforce",
        collision_torque_nm: float = COLLISION_NM,
        collision_force_n: float = COLLISION_N,
    ) -> None:
        if realtime not in ("ignore", "enforce"):
            raise DeviceRefused(f"{name}: found realtime '{realtime}', wanted enforce or ignore")
        if not (0 < collision_torque_nm <= MOST_NM and 0 < collision_force_n <= MOST_N):
            raise DeviceRefused(
                f"{name}: found collision_torque_nm {collision_torque_nm:g}, collision_force_n {collision_force_n:g}; "
                f"wanted more than 0, at most {MOST_NM:g} Nm and {MOST_N:g} N"
            )
        self.name = name
        self._host, self._serial, self._realtime = host, serial, realtime
        self._collision = {"torque_nm": collision_torque_nm, "force_n": collision_force_n}
        super().__init__([host, realtime, json.dumps(self._collision)])

    def open(self) -> None:
        check_identity(self.name, self._host, self._serial)
        super().open()

    def unfit(self) -> str:
        if self._realtime == "ignore" or realtime_kernel():
            return ""
        return (
            f"this computer's kernel ({os.uname().release}) is not real-time, so that 1 kHz cycles may be missed and "
            "the arm may jerk and stop; nothing was moved. Boot one (apt-get install linux-image-rt-amd64, then see "
            '`toss-record --doctor`), or take that on you: settings = { realtime = "ignore" } in the rig file'
        )

    def set_load(self, mass_kg: float, centre_flange_m: Float[Array, "3"], radius_m: float) -> None:
        """What the hand holds, for the arm's model of itself. Raises DeviceRefused during a motion."""
        inertia = 0.4 * mass_kg * radius_m**2
        message = {"do": "load", "mass": mass_kg, "centre": centre_flange_m.tolist(), "inertia": inertia}
        answer = self.ask_worker(message)
        if answer != "":
            raise DeviceRefused(f"{self.name}: the load of {mass_kg:g} kg was not taken: {answer or 'no answer'}")

    def describe(self) -> dict[str, Any]:
        warnings = []
        if self._realtime == "ignore":
            warnings.append("libfranka runs without a real-time kernel check; watch `missed` and the success rate")
        elif self.unfit():
            warnings.append(f"it cannot be moved: {self.unfit()}")
        return {
            "kind": "arm",
            "model": "Franka Panda (FER)",
            "serial": None,
            "firmware": f"FCI server version {self._about.get('version')}",
            "driver": f"panda-python {metadata.version('panda-python')} (libfranka 0.9.2)",
            "rate_hz": self.rate_hz,
            "settings": {
                **{"host": self._host, "realtime": self._realtime, "limit_rate": True, "cutoff_hz": None},
                "collision": self._collision,
            },
            "warnings": warnings,
        }

    def not_opened(self, kind: str, reason: str) -> DeviceNotFound | DeviceRefused:
        return not_opened(f"{self.name} (Panda at {self._host})", kind, reason)


def realtime_kernel() -> bool:
    return REALTIME.is_file() and REALTIME.read_text().strip() == "1"


def check_identity(name: str, host: str, serial: str | None) -> None:
    """The FCI names no device: it is known by its address, a serial in the rig would be a check that nobody makes."""
    if not host:
        raise DeviceRefused(f"{name}: no address; give the robot's as `address` in the rig")
    if serial is not None:
        raise DeviceRefused(
            f"{name}: found serial '{serial}' in the rig, but the FCI tells no serial number; identify the device by "
            "`host` and remove `serial`"
        )


def not_opened(what: str, kind: str, reason: str) -> DeviceNotFound | DeviceRefused:
    """Why libfranka could not connect, and what to do."""
    if kind == "missing":
        return DeviceNotFound(
            f"{what} needs panda-python, which is not installed ({reason}); run `pip install -e .[rig-franka]`"
        )
    if "ncompatible" in reason or "protocol version" in reason:
        return DeviceRefused(
            f"{what} speaks another FCI version: {reason} Wanted version 5 (Panda, system >= 4.2.1); "
            "for an FR3 or older firmware another libfranka is needed"
        )
    return DeviceNotFound(
        f"{what} does not answer: {reason} Check the address, that FCI is enabled in Desk and the brakes are open"
    )
