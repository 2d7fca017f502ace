"""Tosses by a real arm: drawn, planned and checked before anything moves; then to the start, the object handed over."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from acquisition.devices import Arm, Gripper
from acquisition.operator import Operator
from acquisition.recorder import Recorder
from acquisition.rig import TossConfig
from acquisition.toss import ReleaseDelay, TossPlan, TossRefused, draw_target, plan_move, plan_toss
from acquisition.toss_limits import ArmModel
from recordings.errors import BadInput, TosslabError
from recordings.geometry import Transform, rotation_exp
from recordings.progress import Progress
from recordings.tracks import RigCalibration

TRIES = 12
MOVES_WITHIN_S = 30.0
GRASP_SPEED_M_S = 0.05
OPENS_WITHIN_S = 2.0
MOVED_M = 0.002
LEAST_SIGMA_S = 0.004


class ArmThrower:
    """Where the tosses of a rig with an arm come from."""

    def __init__(
        self,
        model: ArmModel,
        world_from_base: Transform,
        config: TossConfig,
        recorder: Recorder | None,
        operator: Operator,
    ) -> None:
        """`recorder`: whose arm and gripper move; None plans only."""
        self._model, self._world_from_base, self._config = model, world_from_base, config
        devices = recorder.devices.values() if recorder is not None else ()
        self._arm = next((d for d in devices if isinstance(d, Arm)), None)
        self._gripper = next((d for d in devices if isinstance(d, Gripper)), None)
        self._recorder, self._operator = recorder, operator
        self.delay = ReleaseDelay(config.release_delay_s, config.release_delay_sigma_s)
        self._measured: list[float] = []

    def plan(self, toss: int, attempt: int = 0) -> TossPlan:
        """The next toss of the rig file that the arm can do; refusals are told. Raises TossRefused after TRIES."""
        refused: TossRefused | None = None
        for one in range(TRIES):
            target = draw_target(self._config, toss, attempt * TRIES + one)
            try:
                return plan_toss(self._model, self._world_from_base, target, self.delay)
            except TossRefused as why:
                refused = refused or why
        raise TossRefused(f"none of {TRIES} releases drawn from [toss] is possible; the first one: {refused}")

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan:
        """Plan, move to the start, take the object."""
        plan = self.plan(toss, attempt)
        if self._arm is None or self._recorder is None:
            return plan
        self._go(self._arm, self._recorder, plan)
        if self._gripper is not None:
            self._operator.say("put the object between the fingers")
            if self._operator.wait_for_start() == "quit":
                raise KeyboardInterrupt
            self._gripper.grasp(self._config.object_width_m, GRASP_SPEED_M_S, self._config.grasp_force_n)
            self._acknowledged(self._gripper, "grasp")
        return plan

    def _go(self, arm: Arm, recorder: Recorder, plan: TossPlan) -> None:
        """A calm motion from where the arm stands to the plan's start."""
        here = recorder.joints_at(time.monotonic_ns())
        if here is None:
            raise BadInput("the arm reports no state; is its controller running? See `toss-record --doctor`")
        if np.abs(here - plan.trajectory.q_rad[0]).max() < 1e-3:
            return
        arm.move(plan_move(self._model, here, plan.trajectory.q_rad[0]))
        ends = time.monotonic() + MOVES_WITHIN_S
        while arm.motion().status == "moving":
            if time.monotonic() > ends:
                arm.halt()
                raise TosslabError(f"the arm did not reach the start within {MOVES_WITHIN_S:g} s; it was halted")
            time.sleep(0.02)
        if arm.motion().status == "aborted":
            raise TosslabError(f"the arm did not reach the start: {arm.motion().reason}")

    def get_ready(self) -> dict[str, Any]:
        """Open the empty hand some times and see how long the fingers take to begin."""
        openings = self._config.dry_openings
        if self._gripper is not None and self._recorder is not None and openings:
            self._operator.say(f"the hand opens {openings} times to measure its delay: keep it empty")
            delays = [d for _ in range(openings) if (d := self._opening(self._gripper, self._recorder)) is not None]
            self.delay = estimate_delay(delays) or self.delay
            mean_ms, sigma_ms = 1e3 * self.delay.mean_s, 1e3 * self.delay.sigma_s
            said = f"release delay {mean_ms:.0f} ms, sigma {sigma_ms:.0f} ms, of {self.delay.samples} openings"
            self._operator.say(said if self.delay.samples else f"no opening was seen: {said} as the rig file says")
        return {"release_delay": asdict(self.delay)}

    def over(self) -> bool:
        return False

    def learn(self, delay_s: float) -> None:
        """The delay of a toss, from its data: each one makes the next plan better."""
        self._measured.append(delay_s)
        learned = estimate_delay(self._measured)
        if learned is not None and learned.samples > self.delay.samples:
            self.delay = learned

    def _opening(self, gripper: Gripper, recorder: Recorder) -> float | None:
        gripper.grasp(self._config.object_width_m, GRASP_SPEED_M_S, self._config.grasp_force_n)
        self._acknowledged(gripper, "grasp")
        sent = time.monotonic_ns()
        gripper.release(self._config.open_width_m, self._config.open_speed_m_s)
        while (time.monotonic_ns() - sent) / 1e9 < OPENS_WITHIN_S:
            time.sleep(0.02)
            seen = [((s.host_ns - sent) / 1e9, s.width_m) for s in list(recorder.widths) if s.host_ns > sent - 5e7]
            if len(seen) > 2 and seen[-1][1] > seen[0][1] + 5 * MOVED_M:
                return onset_s(seen)
        return None

    def _acknowledged(self, gripper: Gripper, kind: str) -> None:
        ends = time.monotonic() + OPENS_WITHIN_S
        while time.monotonic() < ends:
            command = gripper.command()
            if command is not None and command.acknowledged_host_ns is not None:
                return
            time.sleep(0.02)
        raise TosslabError(f"the gripper did not answer a {kind} within {OPENS_WITHIN_S:g} s; is it homed?")


def onset_s(widths: Sequence[tuple[float, float]]) -> float | None:
    """When an opening began: the line through the samples of the motion, back to the width before."""
    times, width = np.array(widths).T
    moving = np.flatnonzero(width > width[0] + MOVED_M)
    if len(moving) == 0:
        return None
    k = int(moving[0])
    if k + 1 < len(width) and width[k + 1] > width[k]:
        speed = (width[k + 1] - width[k]) / (times[k + 1] - times[k])
        return float(max(times[k] - (width[k] - width[0]) / speed, times[max(k - 2, 0)]))
    return float(0.5 * (times[k] + times[max(k - 1, 0)]))


def estimate_delay(delays_s: Sequence[float]) -> ReleaseDelay | None:
    """Mean and spread of at least three delays; the spread is never believed to be smaller than LEAST_SIGMA_S."""
    if len(delays_s) < 3:
        return None
    values = np.array(delays_s)
    middle = float(np.median(values))
    near = values[np.abs(values - middle) < 0.2]
    return ReleaseDelay(float(near.mean()), max(float(near.std(ddof=1)), LEAST_SIGMA_S), len(near))


def base_in_world(config: TossConfig, calibration: RigCalibration) -> Transform:
    """Where the robot stands: from the calibration, else from the rig file. Raises BadInput where neither says it."""
    found = calibration.find("world", "base")
    if found is not None:
        return found
    if config.world_from_base is None or len(config.world_from_base) != 4:
        raise BadInput(
            "nobody says where the robot stands: calibrate it (toss-record --calibration hand-eye), or put "
            "world_from_base = [x, y, z, yaw_deg] into [toss] of the rig file"
        )
    x, y, z, yaw_deg = config.world_from_base
    return Transform("world", "base", rotation_exp(np.array([0.0, 0.0, np.deg2rad(yaw_deg)])), np.array([x, y, z]))
