"""The Franka Panda (FER) through panda-python, which carries libfranka 0.9.2: FCI server version 5, system >= 4.2.1.

Not covered: the FR3 (FCI server version 6 and up needs franky-control or pylibfranka, which cannot share a process
with panda_py), and Pandas with older firmware (panda-python's other wheels). `open` says which version it found.

The client runs in a process of its own (franka_worker): libfranka's binding holds the interpreter's lock while it
waits. Joint trajectories are sent as joint positions at 1 kHz with libfranka's rate limiter on and its low-pass filter
off; the arm's own joint impedance controller follows them. The FCI tells no serial number: the address is the identity.
"""

from __future__ import annotations

from importlib import metadata
from typing import Any, Literal

from acquisition.devices import DeviceRefused
from acquisition.drivers.worker_arm import WorkerArm
from recordings.errors import DeviceNotFound

JOINT_NAMES = tuple(f"panda_joint{i}" for i in range(1, 8))


class FrankaArm(WorkerArm):
    """A Panda at `host`. `realtime="enforce"` refuses to move without a real-time kernel (libfranka's own check)."""

    joint_names = JOINT_NAMES
    rate_hz = 1000.0
    clock = "fci"
    module = "acquisition.drivers.franka_worker"

    def __init__(
        self,
        name: str = "arm",
        host: str = "",
        serial: str | None = None,
        realtime: Literal["ignore", "enforce"] = "ignore",
    ) -> None:
        self.name = name
        self._host, self._serial, self._realtime = host, serial, realtime
        super().__init__([host, realtime])

    def open(self) -> None:
        check_identity(self.name, self._host, self._serial)
        super().open()

    def describe(self) -> dict[str, Any]:
        warnings = []
        if self._realtime == "ignore":
            warnings.append("libfranka runs without a real-time kernel check; watch `missed` and the success rate")
        return {
            "kind": "arm",
            "model": "Franka Panda (FER)",
            "serial": None,
            "firmware": f"FCI server version {self._about.get('version')}",
            "driver": f"panda-python {metadata.version('panda-python')} (libfranka 0.9.2)",
            "rate_hz": self.rate_hz,
            "settings": {"host": self._host, "realtime": self._realtime, "limit_rate": True, "cutoff_hz": None},
            "warnings": warnings,
        }

    def not_opened(self, kind: str, reason: str) -> DeviceNotFound | DeviceRefused:
        return not_opened(f"{self.name} (Panda at {self._host})", kind, reason)


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
