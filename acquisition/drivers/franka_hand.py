"""The Franka Hand through panda-python: commands with the times at which they were sent and acknowledged, its width.

The hand is no real-time device: between a command and the fingers' first movement lie tens of milliseconds, with a
spread, and its state comes at 10 to 30 Hz. What is logged here (sent, acknowledged, width over time) bounds the release
from both sides; the release itself is estimated from the recorded images.
"""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from importlib import metadata
from typing import Any

from acquisition.devices import DeviceLost, DeviceRefused, GripperCommand, GripperSample, Health
from acquisition.drivers.franka import check_identity, not_opened
from acquisition.drivers.inbox import Inbox
from acquisition.drivers.lifecycle import OpenedByContext
from acquisition.drivers.workers.franka_hand import SAMPLE
from acquisition.drivers.workers.process import Worker

OPEN_S = 10.0
BUFFER = 1000
EPSILON_M = 0.01
"""A grasp succeeds within this of the expected width."""
SHORTEST_NS = 15_000_000
SILENT_PERIODS = 4


class FrankaHand(OpenedByContext):
    """The gripper of the Panda at `host`."""

    def __init__(self, name: str = "gripper", host: str = "", serial: str | None = None) -> None:
        self.name = name
        self._host, self._serial = host, serial
        self._worker: Worker | None = None
        self._inbox: Inbox[GripperSample] = Inbox(1)
        self._clean()

    def _clean(self) -> None:
        self._opened = threading.Event()
        self._failure: tuple[str, str] | None = None
        self._version = 0
        self._command: GripperCommand | None = None
        self._started = False
        self._last_host_ns: int | None = None
        self._period_ns: int | None = None
        self._received = self._dropped = 0

    def open(self) -> None:
        """Connect. Raises DeviceNotFound where nothing answers."""
        check_identity(self.name, self._host, self._serial)
        self.close()
        self._clean()
        self._inbox = Inbox(BUFFER)
        module = "acquisition.drivers.workers.franka_hand"
        self._worker = Worker(module, [self._host], self._on_frame, self._on_end)
        if self._opened.wait(OPEN_S) and self._failure is None:
            return
        kind, reason = self._failure or ("silent", f"no answer within {OPEN_S:g} s")
        self.close()
        raise not_opened(f"{self.name} (Franka Hand at {self._host})", kind, reason)

    def start(self) -> None:
        self._inbox.clear()
        self._received = self._dropped = 0
        self._last_host_ns = None
        self._started = True

    def stop(self) -> None:
        self._started = False

    def close(self) -> None:
        if self._worker is not None:
            self._worker.stop()
            self._worker = None

    def read(self, timeout_s: float) -> GripperSample | None:
        return self._inbox.take(timeout_s)

    def grasp(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        self._send({"do": "grasp", "width": width_m, "speed": speed_m_s, "force": force_n, "epsilon": EPSILON_M})

    def release(self, width_m: float, speed_m_s: float) -> None:
        self._send({"do": "move", "width": width_m, "speed": speed_m_s})

    def homing(self) -> None:
        """Find the largest width; needed once after the hand was switched on or its fingers changed."""
        self._send({"do": "homing"})

    def command(self) -> GripperCommand | None:
        return self._command

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "gripper",
            "model": "Franka Hand",
            "serial": None,
            "firmware": f"gripper server version {self._version}",
            "driver": f"panda-python {metadata.version('panda-python')} (libfranka 0.9.2)",
            "settings": {"host": self._host, "grasp_epsilon_m": EPSILON_M},
            "warnings": ["acknowledgements are late by up to one state period; no release time is taken from them"],
        }

    def health(self) -> Health:
        received, dropped = {self.name: self._received}, {self.name: self._dropped + self._inbox.overflowed}
        if self._inbox.lost is not None:
            return Health("error", self._inbox.lost, received, dropped)
        if self._command is not None and self._command.error:
            return Health("error", self._command.error, received, dropped)
        return Health("warning" if dropped[self.name] else "ok", "", received, dropped)

    def _send(self, message: dict[str, Any]) -> None:
        if self._worker is None:
            raise DeviceRefused(f"{self.name} is not open; call open() first")
        if self._inbox.lost is not None:
            raise DeviceLost(self._inbox.lost)
        self._worker.send(message)

    # --- the worker's thread -----------------------------------------------------------------------------------

    def _on_frame(self, kind: bytes, payload: bytes) -> None:
        if kind == b"S":
            self._on_state(payload)
        else:
            self._on_event(json.loads(payload))

    def _on_state(self, payload: bytes) -> None:
        number, host_ns, width_m, max_width_m, grasped = SAMPLE.unpack(payload)
        if not self._started:
            return
        self._count_silence(host_ns)
        # whether the hand's number counts milliseconds or states is not documented: states are placed by their receipt
        self._inbox.put(GripperSample(number, "host", host_ns, host_ns, width_m, max_width_m, bool(grasped)))

    def _count_silence(self, host_ns: int) -> None:
        """A gap of several periods (the shortest gap seen) holds states that were lost."""
        self._received += 1
        before_ns, self._last_host_ns = self._last_host_ns, host_ns
        if before_ns is None:
            return
        gap_ns = max(host_ns - before_ns, SHORTEST_NS)
        self._period_ns = gap_ns if self._period_ns is None else min(self._period_ns, gap_ns)
        if gap_ns > SILENT_PERIODS * self._period_ns:
            self._dropped += round(gap_ns / self._period_ns) - 1

    def _on_event(self, event: dict[str, Any]) -> None:
        what = event["event"]
        if what == "open":
            self._version = event["version"]
            self._opened.set()
        elif what == "failed":
            self._failure = (event["kind"], event["reason"])
            self._opened.set()
        elif what == "sent":
            self._command = GripperCommand(event["kind"], event["width"], event["sent"])
        elif what == "acknowledged":
            self._on_acknowledged(event)
        elif what == "lost":
            self._on_end(event["reason"])

    def _on_acknowledged(self, event: dict[str, Any]) -> None:
        if self._command is None or self._command.sent_host_ns != event["sent"]:
            return  # a newer command has taken over
        self._command = replace(
            self._command,
            acknowledged_host_ns=event["acknowledged"],
            succeeded=event["succeeded"],
            error=event["error"],
        )

    def _on_end(self, reason: str) -> None:
        self._inbox.lose(f"{self.name}: the Franka Hand at {self._host} is gone: {reason}; check it, then reopen")
        if not self._opened.is_set():
            self._failure = ("ended", reason)
            self._opened.set()
