"""What simulated devices have in common: clocks that drift, their life and their faults."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import Any

from acquisition.devices import (
    DeviceLost,
    Health,
    Stamp,
)
from acquisition.drivers.lifecycle import OpenedByContext
from acquisition.synthetic.lab_state import LabState


class DeviceClock:
    """A device's clock: drifts, starts anywhere, wraps, may be set by a fault."""

    def __init__(self, name: str, epoch_ns: int, skew: float, offset_ns: int, tick_ns: int, wrap: int | None) -> None:
        self.name, self.skew, self.tick_ns, self.wrap = name, skew, tick_ns, wrap
        self._epoch_ns, self._offset_ns = epoch_ns, offset_ns

    def stamp(self, true_ns: int, moved_ns: int = 0) -> Stamp:
        passed = true_ns - self._epoch_ns
        ticks = (self._offset_ns + moved_ns + passed + round(self.skew * passed)) // self.tick_ns
        return Stamp(self.name, ticks % self.wrap if self.wrap else ticks, self.tick_ns, self.wrap)


@dataclass
class _Counts:
    received: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)


class SimulatedDevice(OpenedByContext):
    """Life and faults of every simulated device."""

    def __init__(self, lab: LabState, name: str) -> None:
        self.name = name
        self._lab = lab
        self._faults = lab.faults(name)
        self._stop = threading.Event()
        self._open = self._running = False
        self._counts = _Counts()

    def open(self) -> None:
        if self._faults.active("unplug") is not None:
            raise DeviceLost(f"{self.name} is unplugged (simulated)")
        self._open = True

    def start(self) -> None:
        self._stop.clear()
        self._running = True
        self._counts = _Counts()
        self._begin()

    def _begin(self) -> None:
        """What a device does first when it starts."""

    def stop(self) -> None:
        self._running = False
        self._stop.set()

    def close(self) -> None:
        self.stop()
        self._open = False

    def health(self) -> Health:
        received, dropped = dict(self._counts.received), dict(self._counts.dropped)
        if self._faults.active("unplug") is not None:
            return Health("error", f"{self.name} was unplugged (simulated)", received, dropped)
        return Health(received=received, dropped=dropped)

    def _described(self, model: str, rate_hz: float) -> dict[str, Any]:
        return {
            "kind": "synthetic",
            "model": model,
            "serial": f"synthetic-{self.name}",
            "firmware": "",
            "driver": "synthetic",
            "rate_hz": rate_hz,
            "settings": {},
            "warnings": [],
        }

    def _ready(self, timeout_s: float) -> bool:
        """Whether `read` may go on; plays the faults that every device has."""
        if not self._running:
            self._stop.wait(min(timeout_s, 0.02))
            return False
        if self._faults.active("unplug") is not None:
            raise DeviceLost(f"{self.name} was unplugged (simulated)")
        while self._faults.active("hang") is not None and not self._stop.wait(0.01):
            pass
        return True

    def _wait_until(self, due_ns: int, timeout_s: float) -> bool:
        left_s = (due_ns - time.monotonic_ns()) / 1e9
        if left_s > 0:
            self._stop.wait(min(left_s, timeout_s))
        return time.monotonic_ns() >= due_ns and not self._stop.is_set()

    def _dropped(self, stream: str, count: int = 1) -> None:
        self._counts.dropped[stream] = self._counts.dropped.get(stream, 0) + count

    def _received(self, stream: str, count: int = 1) -> None:
        self._counts.received[stream] = self._counts.received.get(stream, 0) + count
