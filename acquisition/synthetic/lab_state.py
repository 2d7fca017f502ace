"""What all simulated devices share: the stage that is played, the state of arm and fingers, the faults."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from acquisition.devices import (
    JointTrajectory,
    Motion,
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
                return Motion("aborted", self.reason, ticks, 0, self._started_ns)
            if self._over():
                return Motion("done", "", ticks, 0, self._started_ns)
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

    def show_views(self) -> None:
        """Play the views of the board that were set up, the arm going from one to the next."""
        ready = self.stage.ready
        trajectory = getattr(ready.motion.swing, "trajectory", None) if ready is not None else None
        if trajectory is None:
            raise RuntimeError("no views were set up")
        self.arm.move(trajectory)

    def show_views_again(self) -> None:
        """The same views from the beginning: a busy machine may have missed some."""
        self.stage.set_up(self.stage.shown[-1].performance)
        self.show_views()
