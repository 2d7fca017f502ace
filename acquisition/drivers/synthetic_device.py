"""What simulated devices have in common: the lab's state, clocks that drift, the life and faults of a device."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from acquisition.devices import (
    DeviceLost,
    Health,
    JointTrajectory,
    Motion,
    Stamp,
)
from acquisition.simulators.faults import Faults
from acquisition.synthetic.lab_config import SyntheticConfig
from acquisition.synthetic.show import Show
from acquisition.synthetic.world import Stage

FAULTS: Mapping[str, str] = {
    "unplug": "the device is gone; open fails too while it lasts",
    "silence": "frames stop, no error is reported",
    "frozen": "the same picture again and again, under new numbers",
    "duplicate": "every frame comes twice",
    "swap": "two frames come in the wrong order",
    "gap": "frames are lost on the way: numbers jump",
    "lost_trigger": "the cameras are not triggered: no frame, no number",
    "clock_step": "the device's clock is set by `by_s`",
    "late": "frames arrive `by_s` later",
    "nan": "the arm reports NaN",
    "reflex": "the arm stops in reflex",
    "user_stop": "the emergency stop is pressed",
    "gripper_timeout": "the gripper does not answer",
    "hang": "the driver's read does not return while it lasts",
    "wrong_size": "images of another size",
    "no_depth": "captures without depth",
}


class ArmBody:
    """Where the simulated arm and its fingers are at a time."""

    def __init__(self, show: Show, stage: Stage) -> None:
        self._show, self._stage = show, stage
        self._lock = threading.Lock()
        self._trajectory: JointTrajectory | None = None
        self._started_ns = 0
        self._halted_ns: int | None = None
        self.reason = ""

    def move(self, trajectory: JointTrajectory) -> None:
        with self._lock:
            ready = self._stage.ready
            plays = ready is not None and self._show.is_of(ready, trajectory)
            self._started_ns = self._stage.begin() if plays else time.monotonic_ns()
            self._trajectory, self._halted_ns, self.reason = trajectory, None, ""

    def halt(self, reason: str) -> None:
        with self._lock:
            if self._trajectory is not None and self._halted_ns is None and not self._over():
                self._halted_ns, self.reason = time.monotonic_ns(), reason

    def _over(self) -> bool:
        assert self._trajectory is not None
        return time.monotonic_ns() > self._started_ns + self._trajectory.duration_s * 1e9

    def motion(self) -> Motion:
        with self._lock:
            if self._trajectory is None:
                return Motion("none")
            end_ns = self._started_ns + round(self._trajectory.duration_s * 1e9)
            ticks = round(max(min(time.monotonic_ns(), end_ns) - self._started_ns, 0) / 1e6)
            if self._halted_ns is not None:
                return Motion("aborted", self.reason, ticks, 0, self._started_ns, self._halted_ns)
            if self._over():
                return Motion("done", "", ticks, 0, self._started_ns, end_ns)
            return Motion("moving", "", ticks, 0, self._started_ns)

    def states(self, host_ns: Int64[Array, " n"]) -> tuple[Float[Array, "n j"], Float[Array, "n j"]]:
        """True joint angles and speeds."""
        with self._lock:
            stage, trajectory = self._stage, self._trajectory
            if trajectory is None or (self._halted_ns is None and stage.ready is not None):
                q = np.tile(self._show.start_rad(stage.ready), (len(host_ns), 1))
                return q, np.zeros_like(q)
            last_ns = host_ns if self._halted_ns is None else np.minimum(host_ns, self._halted_ns)
            times_s = (last_ns - self._started_ns) / 1e9
            moving = (times_s <= trajectory.duration_s) & (last_ns == host_ns)
            q, dq = (
                np.stack([np.interp(times_s, trajectory.time_s, column) for column in rows.T], axis=1)
                for rows in (trajectory.q_rad, trajectory.dq_rad_s)
            )
            return q, np.where(moving[:, None], dq, 0.0)

    def width_m(self, host_ns: int) -> float:
        playing = self._stage.playing(host_ns)
        if playing is None:
            return self._show.held_width_m
        shown, time_s = playing
        return self._show.width_m(shown.performance, time_s)


class LabState:
    """What all simulated devices share: the stage, the faults, the state of arm and fingers."""

    def __init__(self, config: SyntheticConfig) -> None:
        self.config = config
        self.show = Show(config)
        self.stage = Stage(config.fps, self.show.phases_s())
        self.arm = ArmBody(self.show, self.stage)
        self._faults: dict[str, Faults] = {}

    def faults(self, device: str) -> Faults:
        """The faults of a device, to inject some."""
        return self._faults.setdefault(device, Faults(FAULTS))


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


class SimulatedDevice:
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

    def __enter__(self) -> Any:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

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
