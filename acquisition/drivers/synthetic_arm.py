"""The simulated Panda and its hand."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray as Array

from acquisition.devices import (
    ArmMode,
    ArmSamples,
    DeviceRefused,
    GripperCommand,
    GripperSample,
    JointTrajectory,
    Motion,
)
from acquisition.drivers.synthetic_device import DeviceClock, SimulatedDevice
from acquisition.synthetic.lab_state import LabState
from acquisition.synthetic.random_draws import generator

ARM_NOISE = (2e-5, 1.5e-3)
WIDTH_NOISE_M = 2e-5


class SyntheticArm(SimulatedDevice):
    """The Panda of the scene; 1 kHz, its own clock."""

    joint_names = tuple(f"panda_joint{i}" for i in range(1, 8))

    def __init__(self, lab: LabState, name: str, rate_hz: float) -> None:
        super().__init__(lab, name)
        self.rate_hz = rate_hz
        skew = lab.config.skew_ppm[-1] * 1e-6
        self._clock = DeviceClock("arm", lab.stage.epoch_ns, skew, 123 * 10**9, 1, None)
        self._number = 0
        self._rng = generator(lab.config.seed, 78)
        self._moved_ns = 0
        self._reflex = False

    def _begin(self) -> None:
        self._number = self._count(time.monotonic_ns())

    def _count(self, host_ns: int) -> int:
        return int((host_ns - self._lab.stage.epoch_ns) * self.rate_hz / 1e9)

    def _mode(self) -> ArmMode:
        if self._faults.active("user_stop") is not None:
            self._lab.arm.halt("user stop")
            return "user_stopped"
        if self._faults.active("reflex") is not None:
            self._faults.clear("reflex")
            self._reflex = True
            self._lab.arm.halt("reflex: collision (simulated)")
        if self._reflex:
            return "reflex"
        return "moving" if self._lab.arm.motion().status == "moving" else "idle"

    def read(self, timeout_s: float) -> ArmSamples | None:
        if not self._ready(timeout_s):
            return None
        due_ns = self._lab.stage.epoch_ns + round((self._number + 10) * 1e9 / self.rate_hz)
        if self._faults.active("silence") is not None:
            self._number = max(self._number, self._count(time.monotonic_ns()))
            self._wait_until(due_ns + 10**9, timeout_s)
            return None
        if not self._wait_until(due_ns, timeout_s):
            return None
        host_ns = time.monotonic_ns()
        last = self._count(host_ns - 200_000)
        numbers = np.arange(self._number + 1, last + 1, dtype=np.int64)
        self._number = last
        self._received("states", len(numbers))
        return self._samples(numbers, host_ns) if len(numbers) else None

    def _samples(self, numbers: Array, host_ns: int) -> ArmSamples:
        step = self._faults.active("clock_step")
        if step is not None:
            self._moved_ns += round(step.number("by_s", 1.0) * 1e9)
            self._faults.clear("clock_step")
        true_ns = [self._lab.stage.epoch_ns + round(n * 1e9 / self.rate_hz) for n in numbers.tolist()]
        q, dq = self._lab.arm.states(np.array(true_ns, dtype=np.int64))
        noise = self._rng.standard_normal((2, *q.shape)) * np.array(ARM_NOISE)[:, None, None]
        if self._faults.active("nan") is not None:
            noise = np.full_like(noise, np.nan)
        mode = self._mode()
        return ArmSamples(
            self._clock.name,
            numbers,
            np.array([self._clock.stamp(t, self._moved_ns).device_ns for t in true_ns], dtype=np.int64),
            np.minimum(np.array(true_ns, dtype=np.int64) + 200_000, host_ns),
            q + noise[0],
            dq + noise[1],
            q,
            dq,
            np.full_like(q, np.nan),
            np.ones(len(numbers)),
            (mode,) * len(numbers),
        )

    def move(self, trajectory: JointTrajectory) -> None:
        if self._mode() in ("reflex", "user_stopped"):
            raise DeviceRefused(f"{self.name} stands in {self._mode()}; release the stop, then recover")
        self._lab.arm.move(trajectory)

    def may_move(self) -> None:
        """A simulated arm hurts nobody."""

    def motion(self) -> Motion:
        return self._lab.arm.motion()

    def halt(self) -> None:
        self._lab.arm.halt("halted")

    def recover(self) -> None:
        if self._faults.active("user_stop") is not None:
            raise DeviceRefused(f"{self.name}: the user stop is pressed; release it, then recover")
        self._reflex = False

    def describe(self) -> dict[str, Any]:
        return {**self._described("simulated Panda", self.rate_hz), "robot": "panda"}


class SyntheticGripper(SimulatedDevice):
    """The Panda's hand: opens some time after it is told to."""

    def __init__(self, lab: LabState, name: str, rate_hz: float) -> None:
        super().__init__(lab, name)
        self.rate_hz = rate_hz
        self._number = 0
        self._command: GripperCommand | None = None
        self._rng = generator(lab.config.seed, 79)

    def _begin(self) -> None:
        self._number = self._count(time.monotonic_ns())

    def _count(self, host_ns: int) -> int:
        return int((host_ns - self._lab.stage.epoch_ns) * self.rate_hz / 1e9)

    def read(self, timeout_s: float) -> GripperSample | None:
        if not self._ready(timeout_s):
            return None
        if not self._wait_until(self._lab.stage.epoch_ns + round((self._number + 1) * 1e9 / self.rate_hz), timeout_s):
            return None
        host_ns = time.monotonic_ns()
        self._number = self._count(host_ns)
        self._settle(host_ns)
        self._received("width")
        width = self._lab.arm.width_m(host_ns) + float(self._rng.normal(0, WIDTH_NOISE_M))
        return GripperSample(self._number, "host", host_ns, host_ns, width, 0.08, width < 0.075)

    def grasp(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        self._command = GripperCommand("grasp", width_m, time.monotonic_ns())

    def release(self, width_m: float, speed_m_s: float) -> None:
        self._command = GripperCommand("move", width_m, time.monotonic_ns())

    def _settle(self, host_ns: int) -> None:
        """A command is acknowledged when the fingers have arrived."""
        command = self._command
        if command is None or command.acknowledged_host_ns is not None or command.error:
            return
        if self._faults.active("gripper_timeout") is not None:
            if host_ns - command.sent_host_ns > 1.5e9:
                self._command = replace(command, succeeded=False, error="no answer within 1.5 s (simulated)")
        elif host_ns - command.sent_host_ns > 0.25e9:
            self._command = replace(command, acknowledged_host_ns=host_ns, succeeded=True)

    def command(self) -> GripperCommand | None:
        self._settle(time.monotonic_ns())
        return self._command

    def describe(self) -> dict[str, Any]:
        return {**self._described("simulated Franka Hand", self.rate_hz)}
