"""The thread of one device: it only reads, hands everything on, and brings the device back when it was lost."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable

from acquisition.devices import (
    Arm,
    ArmMode,
    ArmSamples,
    Device,
    DeviceLost,
    Gripper,
    GripperSample,
    Image,
    MonoCamera,
    RgbdCamera,
    RgbdCapture,
)
from acquisition.rig import DeviceEntry
from acquisition.streaming.sequence_check import Level, Trouble
from acquisition.streaming.streams import READS, go_first
from recordings.errors import DeviceNotFound, TosslabError

READ_S = 0.1
REOPEN_EVERY_S = 0.5
STOPPED_MODES: tuple[ArmMode, ...] = ("reflex", "user_stopped", "error")


@runtime_checkable
class Receiver(Protocol):
    """What a reader hands on to. Called from the readers' threads; nothing of it waits."""

    def take_capture(self, entry: DeviceEntry, capture: RgbdCapture) -> None: ...
    def take_image(self, entry: DeviceEntry, image: Image) -> None: ...
    def take_states(self, entry: DeviceEntry, states: ArmSamples) -> None: ...
    def take_width(self, sample: GripperSample) -> None: ...
    def arm_mode(self) -> ArmMode | None: ...
    def report(self, trouble: Trouble) -> None: ...
    def put_away(self, name: str, call: Callable[[], object]) -> None: ...
    def restarted(self, entry: DeviceEntry, away_s: float) -> None: ...


class DeviceReader(threading.Thread):
    """Reads one device and hands everything on; brings it back when it was lost."""

    def __init__(self, receiver: Receiver, entry: DeviceEntry, device: Device, stop: threading.Event) -> None:
        super().__init__(name=f"reader {entry.name}", daemon=True)
        self._receiver, self._entry, self._device, self._stopped = receiver, entry, device, stop

    def run(self) -> None:
        go_first(READS)
        stop = self._stopped
        while not stop.is_set():
            try:
                self._read()
            except (DeviceLost, DeviceNotFound) as lost:
                self._bring_back(str(lost), stop)
            except Exception as fault:
                self._report("fault", f"{type(fault).__name__}: {fault}", "error")
                stop.wait(READ_S)

    def _read(self) -> None:
        device, receiver, entry = self._device, self._receiver, self._entry
        if entry.kind == "rgbd" and isinstance(device, RgbdCamera):
            capture = device.read(READ_S)
            if isinstance(capture, RgbdCapture):
                receiver.take_capture(entry, capture)
        elif entry.kind == "mono" and isinstance(device, MonoCamera):
            picture = device.read(READ_S)
            if picture is not None:
                receiver.take_image(entry, picture)
        elif entry.kind == "arm" and isinstance(device, Arm):
            states = device.read(READ_S)
            if states is not None:
                self._watch_modes(states)
                receiver.take_states(entry, states)
        elif isinstance(device, Gripper):
            sample = device.read(READ_S)
            if sample is not None:
                receiver.take_width(sample)

    def _watch_modes(self, states: ArmSamples) -> None:
        before = self._receiver.arm_mode()
        mode = next((m for m in states.modes if m in STOPPED_MODES), None)
        if mode is not None and before != mode:
            self._report(mode, f"the arm stands in {mode}", "error")

    def _bring_back(self, why: str, stop: threading.Event) -> None:
        gone_ns = time.monotonic_ns()
        self._report("lost", why, "error")
        while not stop.wait(REOPEN_EVERY_S):
            self._receiver.put_away(self._entry.name, self._device.close)
            try:
                self._device.open()
                self._device.start()
            except TosslabError:
                continue
            away_s = (time.monotonic_ns() - gone_ns) / 1e9
            self._receiver.restarted(self._entry, away_s)
            self._report("back", f"is back after {away_s:.1f} s", "info")
            return

    def _report(self, kind: str, text: str, level: Level) -> None:
        self._receiver.report(Trouble(time.monotonic_ns(), self._entry.name, kind, text, level))
