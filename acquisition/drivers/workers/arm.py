"""What the drivers of arms share whose vendor's client runs in a process of its own."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np

from acquisition.devices import ArmMode, ArmSamples, DeviceLost, DeviceRefused, Health, JointTrajectory, Motion
from acquisition.drivers.inbox import Inbox
from acquisition.drivers.lifecycle import OpenedByContext
from acquisition.drivers.workers.arm_rows import BATCH, MODES, row_dtype, samples
from acquisition.drivers.workers.process import Worker
from recordings.errors import TosslabError

OPEN_S = 15.0
ANSWER_S = 1.9
BUFFER_S = 10.0
START_RAD = 0.02
"""A trajectory may begin this far from where the arm stands; the rest is blended in."""


class WorkerArm(OpenedByContext):
    """An arm behind `python -m module arguments`. A driver gives the texts: `describe`, `not_opened`, `gone`."""

    name: str
    joint_names: tuple[str, ...]
    rate_hz: float
    clock: str
    module: str

    def __init__(self, arguments: list[str]) -> None:
        self._arguments = arguments
        self._worker: Worker | None = None
        self._inbox: Inbox[bytes] = Inbox(1)
        self._row = row_dtype(len(self.joint_names))
        self._clean()

    def _clean(self) -> None:
        self._opened = threading.Event()
        self._answered = threading.Event()
        self._failure: tuple[str, str] | None = None
        self._about: dict[str, Any] = {}
        self._answer = ""
        self._mode: ArmMode = "idle"
        self._errors = ""
        self._motion = Motion("none")
        self._started = False
        self._last_number: int | None = None
        self._q_desired: np.ndarray | None = None
        self._received = self._dropped = 0

    def not_opened(self, kind: str, reason: str) -> TosslabError:
        """The error to raise; `kind` is "missing" (no library), "connect", "silent" or "ended"."""
        raise NotImplementedError

    def open(self) -> None:
        """Connect. Raises DeviceNotFound where nothing answers, DeviceRefused where something unfit does."""
        self.close()
        self._clean()
        self._inbox = Inbox(round(BUFFER_S * self.rate_hz / BATCH))
        self._worker = Worker(self.module, self._arguments, self._on_frame, self._on_end)
        if self._opened.wait(OPEN_S) and self._failure is None:
            return
        kind, reason = self._failure or ("silent", f"no answer within {OPEN_S:g} s")
        self.close()
        raise self.not_opened(kind, reason)

    def start(self) -> None:
        self._inbox.clear()
        self._received = self._dropped = 0
        self._last_number = None
        self._started = True

    def stop(self) -> None:
        """Brake, if the arm moves, and hand over no more states."""
        if self._worker is not None and self._inbox.lost is None:
            self.halt()
        self._started = False

    def close(self) -> None:
        worker, self._worker = self._worker, None
        if worker is not None:
            worker.stop()

    def read(self, timeout_s: float) -> ArmSamples | None:
        batches = self._inbox.take_all(timeout_s)
        return samples(self.clock, len(self.joint_names), b"".join(batches)) if batches else None

    def may_move(self) -> None:
        """Raises DeviceRefused where the arm is not idle, or the driver's own checks (`unfit`) find something."""
        self._ready()
        why = self.unfit()
        if why:
            raise DeviceRefused(f"{self.name}: {why}")

    def unfit(self) -> str:
        """What of arm or computer forbids a motion now, and what to do; empty where nothing does."""
        return ""

    def move(self, trajectory: JointTrajectory) -> None:
        self.may_move()
        worker = self._ready()
        q_now = self._q_desired
        if q_now is None:
            raise DeviceRefused(f"{self.name}: no state has come yet; read() until one does")
        away = np.abs(trajectory.q_rad[0] - q_now)
        if away.max() > START_RAD:
            joint = int(away.argmax())
            raise DeviceRefused(
                f"{self.name}: the trajectory starts {away[joint]:.3f} rad from where {self.joint_names[joint]} stands "
                f"({q_now[joint]:.3f} rad), wanted within {START_RAD:g} rad; move to its start first"
            )
        path = trajectory.sampled(self.rate_hz)
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
        answer = self.ask_worker({"do": "recover"})
        if answer is None:
            raise DeviceRefused(f"{self.name}: still recovering after {ANSWER_S:g} s; ask again")
        if answer:
            raise DeviceRefused(f"{self.name}: the arm does not recover: {answer}")

    def ask_worker(self, message: dict[str, Any]) -> str | None:
        """What the process answers to a request: a reason why not, empty where it did it; None: no answer in time."""
        worker = self._connected()
        self._answered.clear()
        worker.send(message)
        return self._answer if self._answered.wait(ANSWER_S) else None

    def health(self) -> Health:
        dropped = self._dropped + self._inbox.overflowed * BATCH
        received, lost = {self.name: self._received}, {self.name: dropped} if dropped else {}
        if self._inbox.lost is not None:
            return Health("error", self._inbox.lost, received, lost)
        if self._mode in ("reflex", "user_stopped", "error"):
            return Health("error", f"{self._mode}: {self._errors}".rstrip(": "), received, lost)
        return Health("warning" if dropped else "ok", f"{dropped} states lost" if dropped else "", received, lost)

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
        rows = np.frombuffer(payload, dtype=self._row)
        self._q_desired = rows["joints"][-1, 2]
        if not self._started:
            return
        first, last = int(rows["number"][0]), int(rows["number"][-1])
        before = first - 1 if self._last_number is None else self._last_number
        self._dropped += max(0, last - before - len(rows))
        self._received += len(rows)
        self._last_number = last
        self._inbox.put(payload)

    def _on_event(self, event: dict[str, Any]) -> None:
        what = event["event"]
        if what == "open":
            self._about = event
            self._opened.set()
        elif what == "failed":
            self._failure = (event["kind"], event["reason"])
            self._opened.set()
        elif what == "mode":
            self._mode, self._errors = MODES.get(event["mode"], "error"), event["errors"]
        elif what == "answer":
            self._answer = event["reason"]
            self._answered.set()
        elif what == "lost":
            self._on_end(event["reason"])
        elif what == "motion":
            self._motion = _motion(event)

    def _on_end(self, reason: str) -> None:
        where = self._arguments[0]
        self._inbox.lose(f"{self.name}: the arm at {where} is gone: {reason}; check its network, then reopen")
        if self._motion.status == "moving":
            self._motion = replace(self._motion, status="aborted", reason=reason)
        if not self._opened.is_set():
            self._failure = ("ended", reason)
            self._opened.set()


def _motion(event: dict[str, Any]) -> Motion:
    return Motion(
        event["status"],
        event.get("reason", ""),
        event.get("ticks", 0),
        event.get("missed", 0),
        event["started"],
    )
