"""The Franka Panda (FER) through panda-python, which carries libfranka 0.9.2: FCI server version 5, system >= 4.2.1.

Not covered: the FR3 (FCI server version 6 and up needs franky-control or pylibfranka, which cannot share a process
with panda_py), and Pandas with older firmware (panda-python's other wheels). `open` says which version it found.

The client runs in a process of its own (franka_worker): libfranka's binding holds the interpreter's lock while it
waits. Joint trajectories are sent as joint positions at 1 kHz with libfranka's rate limiter on and its low-pass filter
off; the arm's own joint impedance controller follows them. The FCI tells no serial number: the address is the identity.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from importlib import metadata
from typing import Any, Literal, Self

import numpy as np

from acquisition.devices import ArmMode, ArmSamples, DeviceLost, DeviceRefused, Health, JointTrajectory, Motion
from acquisition.drivers.franka_worker import STATE
from acquisition.drivers.inbox import Inbox
from acquisition.drivers.worker import Worker
from recordings.errors import DeviceNotFound

JOINT_NAMES = tuple(f"panda_joint{i}" for i in range(1, 8))
RATE_HZ = 1000.0
OPEN_S = 10.0
ANSWER_S = 1.9
BUFFER_S = 10.0
START_RAD = 0.02
"""A trajectory may begin this far from where the arm stands; the rest is blended in."""
BATCH = 10

MODES: Mapping[int, ArmMode] = {
    0: "error",
    1: "idle",
    2: "moving",
    3: "guiding",
    4: "reflex",
    5: "user_stopped",
    6: "recovering",
}
_ROW = np.dtype(
    [("ms", "<u8"), ("host", "<i8"), ("joints", "<f8", (5, 7)), ("rate", "<f8"), ("mode", "u1")],
)
assert _ROW.itemsize == STATE.size


class FrankaArm:
    """A Panda at `host`. `realtime="enforce"` refuses to move without a real-time kernel (libfranka's own check)."""

    joint_names = JOINT_NAMES
    rate_hz = RATE_HZ

    def __init__(
        self,
        name: str = "arm",
        host: str = "172.16.0.2",
        serial: str | None = None,
        realtime: Literal["ignore", "enforce"] = "ignore",
    ) -> None:
        self.name = name
        self._host, self._serial, self._realtime = host, serial, realtime
        self._worker: Worker | None = None
        self._inbox: Inbox[bytes] = Inbox(1)
        self._clean()

    def _clean(self) -> None:
        self._opened = threading.Event()
        self._recovered = threading.Event()
        self._failure: tuple[str, str] | None = None
        self._answer = ""
        self._version = 0
        self._mode: ArmMode = "idle"
        self._errors = ""
        self._motion = Motion("none")
        self._started = False
        self._last_number: int | None = None
        self._q_desired: np.ndarray | None = None
        self._received = self._dropped = 0

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.stop()
        self.close()

    def open(self) -> None:
        """Connect. Raises DeviceNotFound where nothing answers, DeviceRefused for another FCI version."""
        if self._serial is not None:
            raise DeviceRefused(
                f"{self.name}: found serial '{self._serial}' in the rig, but the FCI tells no serial number; "
                "identify a Panda by `host` and remove `serial`"
            )
        self.close()
        self._clean()
        self._inbox = Inbox(round(BUFFER_S * RATE_HZ / BATCH))
        arguments = [self._host, self._realtime]
        self._worker = Worker("acquisition.drivers.franka_worker", arguments, self._on_frame, self._on_end)
        if self._opened.wait(OPEN_S) and self._failure is None:
            return
        kind, reason = self._failure or ("silent", f"no answer within {OPEN_S:g} s")
        self.close()
        raise not_opened(f"{self.name} (Panda at {self._host})", kind, reason)

    def start(self) -> None:
        self._inbox.clear()
        self._received = self._dropped = 0
        self._last_number = None
        self._started = True

    def stop(self) -> None:
        """Brake, if the arm moves, and hand over no more states."""
        if self._worker is not None and self._motion.status == "moving":
            self.halt()
        self._started = False

    def close(self) -> None:
        if self._worker is not None:
            self._worker.stop()
            self._worker = None

    def read(self, timeout_s: float) -> ArmSamples | None:
        batches = self._inbox.take_all(timeout_s)
        return _samples(b"".join(batches)) if batches else None

    def move(self, trajectory: JointTrajectory) -> None:
        worker = self._ready()
        q_now = self._q_desired
        if q_now is None:
            raise DeviceRefused(f"{self.name}: no state has come yet; call start() and read() first")
        away = float(np.abs(trajectory.q_rad[0] - q_now).max())
        if away > START_RAD:
            joint = int(np.abs(trajectory.q_rad[0] - q_now).argmax())
            raise DeviceRefused(
                f"{self.name}: the trajectory starts {away:.3f} rad from where joint {joint + 1} stands "
                f"({q_now[joint]:.3f} rad), wanted within {START_RAD:g} rad; move to its start first"
            )
        ticks = int(np.ceil(trajectory.duration_s * RATE_HZ)) + 1
        path = np.stack([trajectory.at(k / RATE_HZ)[0] for k in range(ticks)])
        self._motion = Motion("moving", started_host_ns=time.monotonic_ns())
        worker.send({"do": "move"}, path.astype("<f8").tobytes())

    def motion(self) -> Motion:
        return self._motion

    def halt(self) -> None:
        """Brake along the path within 0.7 s. No replacement for the emergency stop."""
        if self._worker is None or self._motion.status != "moving":
            return
        self._worker.send({"do": "halt"})
        end = time.monotonic() + ANSWER_S
        while self._motion.status == "moving" and time.monotonic() < end:
            time.sleep(0.005)

    def recover(self) -> None:
        if self._mode == "user_stopped":
            raise DeviceRefused(f"{self.name}: the user stop is pressed; release it, then recover again")
        worker = self._connected()
        self._recovered.clear()
        worker.send({"do": "recover"})
        if not self._recovered.wait(ANSWER_S):
            raise DeviceRefused(f"{self.name}: still recovering after {ANSWER_S:g} s; ask again")
        if self._answer:
            raise DeviceRefused(f"{self.name}: the arm does not recover: {self._answer}")

    def describe(self) -> dict[str, Any]:
        warnings = []
        if self._realtime == "ignore":
            warnings.append("libfranka runs without a real-time kernel check; watch `missed` and the success rate")
        return {
            "kind": "arm",
            "model": "Franka Panda (FER)",
            "serial": None,
            "firmware": f"FCI server version {self._version}",
            "driver": f"panda-python {metadata.version('panda-python')} (libfranka 0.9.2)",
            "rate_hz": RATE_HZ,
            "settings": {"host": self._host, "realtime": self._realtime, "limit_rate": True, "cutoff_hz": None},
            "warnings": warnings,
        }

    def health(self) -> Health:
        dropped = self._dropped + self._inbox.overflowed * BATCH
        received, lost = {self.name: self._received}, {self.name: dropped}
        if self._inbox.lost is not None:
            return Health("error", self._inbox.lost, received, lost)
        if self._mode in ("reflex", "user_stopped", "error"):
            return Health("error", f"{self._mode}: {self._errors}".rstrip(": "), received, lost)
        return Health("warning" if dropped else "ok", "", received, lost)

    def _connected(self) -> Worker:
        if self._worker is None:
            raise DeviceRefused(f"{self.name} is not open; call open() first")
        if self._inbox.lost is not None:
            raise DeviceLost(self._inbox.lost)
        return self._worker

    def _ready(self) -> Worker:
        worker = self._connected()
        if self._motion.status == "moving":
            raise DeviceRefused(f"{self.name} is moving; halt() it first")
        if self._mode != "idle":
            hint = "release the stop" if self._mode == "user_stopped" else "recover() it"
            raise DeviceRefused(f"{self.name} stands in '{self._mode}' ({self._errors or 'no error named'}); {hint}")
        return worker

    # --- the worker's thread -----------------------------------------------------------------------------------

    def _on_frame(self, kind: bytes, payload: bytes) -> None:
        if kind == b"S":
            self._on_states(payload)
        else:
            self._on_event(json.loads(payload))

    def _on_states(self, payload: bytes) -> None:
        rows = np.frombuffer(payload, dtype=_ROW)
        self._q_desired = rows["joints"][-1, 2]
        if not self._started:
            return
        first, last = int(rows["ms"][0]), int(rows["ms"][-1])
        before = first - 1 if self._last_number is None else self._last_number
        self._dropped += max(0, last - before - len(rows))
        self._received += len(rows)
        self._last_number = last
        self._inbox.put(payload)

    def _on_event(self, event: dict[str, Any]) -> None:
        what = event["event"]
        if what == "open":
            self._version = event["version"]
            self._opened.set()
        elif what == "failed":
            self._failure = (event["kind"], event["reason"])
            self._opened.set()
        elif what == "mode":
            self._mode, self._errors = MODES.get(event["mode"], "error"), event["errors"]
        elif what == "recovered":
            self._answer = event["reason"]
            self._recovered.set()
        elif what == "lost":
            self._on_end(event["reason"])
        elif what == "motion":
            self._motion = _motion(event)

    def _on_end(self, reason: str) -> None:
        self._inbox.lose(f"{self.name}: the Panda at {self._host} is gone: {reason}; check its network, then reopen")
        if self._motion.status == "moving":
            self._motion = replace(self._motion, status="aborted", reason=reason, ended_host_ns=time.monotonic_ns())
        if not self._opened.is_set():
            self._failure = ("ended", reason)
            self._opened.set()


def not_opened(what: str, kind: str, reason: str) -> DeviceNotFound | DeviceRefused:
    """Why libfranka could not connect, and what to do."""
    if kind == "missing":
        return DeviceNotFound(
            f"{what} needs panda-python, which is not installed ({reason}); run `pip install -e .[rig-franka]`"
        )
    if "ncompatible" in reason:
        return DeviceRefused(
            f"{what} speaks another FCI version: {reason} Wanted version 5 (Panda, system >= 4.2.1); "
            "for an FR3 or older firmware another libfranka is needed"
        )
    return DeviceNotFound(
        f"{what} does not answer: {reason} Check the address, that FCI is enabled in Desk and the brakes are open"
    )


def _motion(event: dict[str, Any]) -> Motion:
    return Motion(
        event["status"],
        event.get("reason", ""),
        event.get("ticks", 0),
        event.get("missed", 0),
        event["started"],
        event.get("ended"),
    )


def _samples(data: bytes) -> ArmSamples:
    rows = np.frombuffer(data, dtype=_ROW)
    q, dq, q_desired, dq_desired, torque = (rows["joints"][:, i] for i in range(5))
    number = rows["ms"].astype(np.int64)
    return ArmSamples(
        clock="fci",
        number=number,
        time_ns=number * 1_000_000,
        host_ns=rows["host"].astype(np.int64),
        q_rad=q,
        dq_rad_s=dq,
        q_desired_rad=q_desired,
        dq_desired_rad_s=dq_desired,
        torque_nm=torque,
        success_rate=rows["rate"].copy(),
        modes=tuple(MODES.get(int(mode), "error") for mode in rows["mode"]),
    )
