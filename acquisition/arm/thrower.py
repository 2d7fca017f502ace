"""Tosses by a real arm: drawn, planned and checked before anything moves; every motion is said and asked for first."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.arm.approach import plan_approach
from acquisition.arm.asked import ask, stopped, watch_motion
from acquisition.arm.limits import ArmModel, Held, arm_model
from acquisition.arm.toss import ReleaseDelay, TossPlan, TossRefused, draw_target, plan_toss, slowed
from acquisition.arm.workspace import Space
from acquisition.devices import Arm, Gripper, TakesLoad
from acquisition.operator import Operator
from acquisition.rig import Rig, TossConfig
from acquisition.streaming.recorder import Recorder
from recordings.errors import BadInput, TosslabError
from recordings.geometry import Transform, rotation_exp
from recordings.progress import Progress
from recordings.session_writer import toss_name
from recordings.tracks import RigCalibration

TRIES = 12
GRASP_SPEED_M_S = 0.05
OPENS_WITHIN_S = 2.0
MOVED_M = 0.002
LEAST_SIGMA_S = 0.004
THERE_RAD = 1e-3
LEAST_COUNTDOWN_S = 1.0
HEAVIEST_KG = 3.0


class ArmThrower:
    """Where the tosses of a rig with an arm come from. `speed`: the share of their usual speed all motions have."""

    def __init__(
        self,
        model: ArmModel,
        space: Space,
        config: TossConfig,
        recorder: Recorder | None,
        operator: Operator,
        speed: float = 1.0,
        countdown_s: float = 3.0,
    ) -> None:
        """`recorder`: whose arm and gripper move; None plans only."""
        mass_kg = config.held_mass_kg if config.held_mass_kg is not None else Held().mass_kg
        self._held = Held(mass_kg, config.held_centre_m, config.held_radius_m)
        self._model, self._space, self._config = model.holding(self._held), space, config
        devices = recorder.devices.values() if recorder is not None else ()
        self._arm = next((d for d in devices if isinstance(d, Arm)), None)
        self._gripper = next((d for d in devices if isinstance(d, Gripper)), None)
        self._recorder, self._operator = recorder, operator
        self._speed, self._countdown_s = speed, countdown_s
        self.delay = ReleaseDelay(config.release_delay_s, config.release_delay_sigma_s)
        self._measured: list[float] = []

    def plan(self, toss: int, attempt: int = 0) -> TossPlan:
        """The next toss of the rig file that the arm can do; refusals are told. Raises TossRefused after TRIES."""
        refused: TossRefused | None = None
        for one in range(TRIES):
            target = draw_target(self._config, toss, attempt * TRIES + one)
            try:
                return slowed(plan_toss(self._model, self._space, target, self.delay), self._speed)
            except TossRefused as why:
                refused = refused or why
        raise TossRefused(f"none of {TRIES} releases drawn from [toss] is possible; the first one: {refused}")

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan:
        """Plan, move to the start, take the object: each asked for. What the toss will do is said last."""
        plan = self.plan(toss, attempt)
        if self._arm is None or self._recorder is None:
            return plan
        self._load(self._arm, Held(0.0))
        self._go(self._arm, self._recorder, plan, f"to the start of {toss_name(toss)}")
        if self._gripper is not None:
            self._take(self._gripper)
        self._load(self._arm, self._held)
        self._operator.touched()
        self._operator.say(f"next the arm tosses: {toss_text(plan, self._model)}; any key stops it")
        return plan

    def _take(self, gripper: Gripper) -> None:
        """Close the hand on the object that a person holds between its fingers."""
        width_mm, force_n = 1e3 * self._config.object_width_m, self._config.grasp_force_n
        said = f"put the object between the fingers: they close to {width_mm:.0f} mm with {force_n:g} N"
        ask(self._operator, said, self._countdown_s)
        gripper.grasp(self._config.object_width_m, GRASP_SPEED_M_S, force_n)
        self._acknowledged(gripper, "grasp")

    def _go(self, arm: Arm, recorder: Recorder, plan: TossPlan, where: str) -> None:
        """A calm motion from where the arm stands to the plan's start; stopped by a key, it is asked for anew."""
        goal = plan.trajectory.q_rad[0]
        while np.abs((here := self._here(recorder)) - goal).max() > THERE_RAD:
            approach = plan_approach(self._model, self._space, here, goal, self._speed)
            ask(self._operator, f"the arm will move {where}: {approach.text()}; any key stops it", self._countdown_s)
            arm.move(approach.trajectory)
            if not watch_motion(arm, self._operator, approach.trajectory.duration_s, f"the way {where}"):
                continue
            time.sleep(0.05)  # its last states are on their way
            if np.abs(self._here(recorder) - goal).max() < 10 * THERE_RAD:
                return

    def _here(self, recorder: Recorder) -> Float[Array, " j"]:
        here = recorder.joints_at(time.monotonic_ns())
        if here is None:
            raise BadInput("the arm reports no state; is its controller running? See `toss-record --doctor`")
        return here

    def _load(self, arm: Arm, held: Held) -> None:
        """Tell the arm what it carries, where it can be told."""
        if isinstance(arm, TakesLoad):
            at = self._model.tool_in_flange(np.array(held.centre_m))
            arm.set_load(held.mass_kg, at, held.radius_m)

    def get_ready(self) -> dict[str, Any]:
        """Whether the arm may move at all, what it will hold, and the empty hand's delay by some openings."""
        if self._arm is not None:
            self._arm.may_move()
        held = self._weigh()
        openings = self._config.dry_openings
        if self._gripper is not None and self._recorder is not None and openings:
            delays = self._dry(self._gripper, self._recorder, openings)
            self.delay = estimate_delay(delays) or self.delay
            mean_ms, sigma_ms = 1e3 * self.delay.mean_s, 1e3 * self.delay.sigma_s
            said = f"release delay {mean_ms:.0f} ms, sigma {sigma_ms:.0f} ms, of {self.delay.samples} openings"
            self._operator.say(said if self.delay.samples else f"no opening was seen: {said} as the rig file says")
        return {"release_delay": asdict(self.delay), "held": asdict(held), "speed": self._speed}

    def _weigh(self) -> Held:
        """The held object's mass, asked for where the rig file does not say it. Raises BadInput without an answer."""
        if self._config.held_mass_kg is None and self._arm is not None:
            typed = self._operator.line("mass of the object in kg (weigh it), then Enter:")
            try:
                mass_kg = float(typed.replace(",", "."))
            except ValueError:
                mass_kg = float("nan")
            if not 0 < mass_kg <= HEAVIEST_KG:
                raise BadInput(
                    f"the object's mass: found '{typed}', wanted more than 0 and at most {HEAVIEST_KG:g} kg; weigh it "
                    "and give it when asked, or as held_mass_kg in [toss] of the rig file"
                )
            self._held = replace(self._held, mass_kg=mass_kg)
            self._model = replace(self._model, held=self._held)
        return self._held

    def _dry(self, gripper: Gripper, recorder: Recorder, openings: int) -> list[float]:
        """Delays of so many openings of the empty hand; a key ends them, and they are asked for anew."""
        c = self._config
        said = (
            f"the hand will close with {c.grasp_force_n:g} N and open to {1e3 * c.open_width_m:.0f} mm {openings} "
            "times to measure its delay: keep it empty, keep clear of it; any key stops it"
        )
        while True:
            ask(self._operator, said, self._countdown_s)
            delays = []
            for _ in range(openings):
                if stopped(self._operator):
                    break
                delays.append(self._opening(gripper, recorder))
            else:
                return [d for d in delays if d is not None]
            self._operator.say(f"stopped after {len(delays)} openings")

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


def toss_text(plan: TossPlan, model: ArmModel) -> str:
    """What a toss does, in a line."""
    speed = float(np.linalg.norm(plan.linear_velocity_world_m_s))
    places = np.array([model.base_from_tool(q).translation_m for q in plan.trajectory.q_rad[::20]])
    way_m = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    return (
        f"{plan.trajectory.duration_s:.1f} s, the tool goes {100 * way_m:.0f} cm and lets go at {speed:.2f} m/s "
        f"after {plan.release_s:.2f} s"
    )


def real_thrower(
    rig: Rig, calibration: RigCalibration, recorder: Recorder | None, operator: Operator, speed: float
) -> ArmThrower:
    """The thrower of a rig whose arm is real. Raises BadInput where the arm may not move (safe_to_move).

    Without a recorder nothing moves: what is not known yet is left out of the plans.
    """
    assert rig.toss is not None
    assert rig.robot is not None
    model = arm_model(rig.robot)
    if recorder is not None:
        space = safe_to_move(rig, calibration)
    else:
        base = base_in_world(rig.toss, calibration)
        space = Space.of_table(base) if rig.workspace is None else Space.of_rig(rig, base, calibration)
    return ArmThrower(model, space, rig.toss, recorder, operator, speed, rig.recording.countdown_s)


def safe_to_move(rig: Rig, calibration: RigCalibration) -> Space:
    """The space of an arm that may move in it. Raises BadInput naming what is missing: place, box, countdown."""
    base = calibration.find("world", "base")
    if base is None:
        raise BadInput(
            f"{rig.source}: the arm is not calibrated: nothing was moved. world_from_base in [toss] serves for "
            "--dry-run only. Record views with the board in the hand (toss-record --calibration hand-eye), solve them "
            "(toss-calibrate hand-eye), and give the result as calibration = ... in the rig file"
        )
    if rig.recording.countdown_s < LEAST_COUNTDOWN_S:
        raise BadInput(
            f"{rig.source}: [recording] countdown_s = {rig.recording.countdown_s:g}; an arm that moves wants at least "
            f"{LEAST_COUNTDOWN_S:g} s in which a key can stop it"
        )
    return Space.of_rig(rig, base, calibration)


def base_in_world(config: TossConfig, calibration: RigCalibration) -> Transform:
    """Where the robot stands, for plans: from the calibration, else as the rig file guesses. Raises BadInput."""
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
