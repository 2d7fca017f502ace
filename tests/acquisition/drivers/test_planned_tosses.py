"""Planned tosses, run by the real clients: the arms' own supervision is the judge of the planner."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition import preflight
from acquisition.arm.approach import plan_approach
from acquisition.arm.limits import ArmModel, arm_model
from acquisition.arm.thrower import ArmThrower, base_in_world
from acquisition.arm.toss import ReleaseDelay, TossPlan, TossTarget, plan_toss
from acquisition.arm.workspace import Space
from acquisition.cli import main
from acquisition.devices import Arm, ArmSamples
from acquisition.drivers.franka import FrankaArm
from acquisition.drivers.ur import UrArm
from acquisition.operator import Nobody
from acquisition.rig import find_rig, read_rig
from acquisition.run import Options, SessionRun
from acquisition.setup import NO_CALIBRATION, make_device
from acquisition.simulators.child_process import ChildProcess
from acquisition.streaming.clock import SessionClock
from acquisition.streaming.recorder import Recorder
from recordings.geometry import Transform, rotation_exp
from recordings.progress import Silent
from recordings.session import Session
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration
from recordings.verify.verify import verify

SPACE = Space.of_table(Transform("world", "base", np.eye(3), np.zeros(3)))
DELAY = ReleaseDelay(0.06, 0.01)


def plan(model: ArmModel, q_rad: list[float], dq_rad_s: list[float]) -> TossPlan:
    """The toss whose release is what these joint angles and speeds give; the arm stands in the world's origin."""
    q, dq = np.array(q_rad), np.array(dq_rad_s)
    at = model.base_from_tool(q)
    twist = tool_twist(model, q, dq)
    target = TossTarget(Transform("world", "tool", at.rotation, at.translation_m), twist[:3], twist[3:])
    return plan_toss(model, SPACE, target, DELAY)


def run(arm: Arm, trajectory: Any) -> ArmSamples:
    """Every state logged while the arm follows the trajectory."""
    arm.read(1.0)
    arm.move(trajectory)
    end = time.monotonic() + 20.0
    while arm.motion().status == "moving" and time.monotonic() < end:
        time.sleep(0.02)
    assert arm.motion().status == "done", arm.motion().reason
    states = arm.read(1.0)
    assert states is not None
    return states


def tool_twist(model: ArmModel, q: np.ndarray, dq: np.ndarray) -> np.ndarray:
    """Linear and angular velocity of the tool in the arm's base."""
    return model.jacobian(q, model.base_from_tool(q).translation_m) @ dq


def test_a_planned_toss_of_the_panda_passes_its_supervision_and_releases_as_wanted(
    fci: tuple[str, ChildProcess],
) -> None:
    model = arm_model("panda")
    toss = plan(model, [0.0, -0.2, 0.0, -2.0, 0.0, 2.0, 0.785], [0.0, 0.4, 0.0, 0.7, 0.0, 0.6, 0.0])
    with FrankaArm(host=fci[0], realtime="ignore") as arm:
        arm.start()
        here = arm.read(2.0)
        assert here is not None
        run(arm, plan_approach(model, SPACE, here.q_desired_rad[-1], toss.trajectory.q_rad[0]).trajectory)
        states = run(arm, toss.trajectory)
    # The arm's clock runs on: the trajectory's time counts from the first state in which it is moving.
    moving = np.flatnonzero([mode == "moving" for mode in states.modes])
    since_s = (states.time_ns - states.time_ns[moving[0]]) * 1e-9
    wanted = np.concatenate([toss.linear_velocity_world_m_s, toss.angular_velocity_world_rad_s])
    window = np.abs(since_s - toss.release_s) < 0.3 * toss.window_s
    found = [tool_twist(model, q, dq) for q, dq in zip(states.q_desired_rad[window], states.dq_desired_rad_s[window])]
    assert len(found) > 5
    np.testing.assert_allclose(np.mean(found, axis=0), wanted, atol=0.02 * np.linalg.norm(wanted[:3]))


def test_a_planned_toss_of_the_ur5e_runs_and_reaches_its_speed(rtde: tuple[str, ChildProcess]) -> None:
    model = arm_model("ur5e")
    toss = plan(model, [0.0, -1.4, 1.7, -1.9, -1.57, 0.0], [0.0, 0.5, -0.9, -0.5, 0.0, 0.0])
    with UrArm(host=rtde[0]) as arm:
        arm.start()
        here = arm.read(2.0)
        assert here is not None
        run(arm, plan_approach(model, SPACE, here.q_desired_rad[-1], toss.trajectory.q_rad[0]).trajectory)
        states = run(arm, toss.trajectory)
    np.testing.assert_allclose(states.q_rad[-1], toss.trajectory.q_rad[-1], atol=2e-3)
    # servoJ follows late: the speed is judged where the arm passes the release, over 40 ms
    q_release, dq_release = toss.trajectory.at(toss.release_s)
    passing = int(np.abs(states.q_rad - q_release).max(axis=1).argmin())
    before, after = passing - 10, passing + 10
    span_s = (states.time_ns[after] - states.time_ns[before]) * 1e-9
    found = tool_twist(model, q_release, (states.q_rad[after] - states.q_rad[before]) / span_s)
    wanted = tool_twist(model, q_release, dq_release)
    speed, wanted_speed = float(np.linalg.norm(found[:3])), float(np.linalg.norm(wanted[:3]))
    assert found[:3] @ wanted[:3] / (speed * wanted_speed) > 0.98
    # On a machine that others use, late cycles are caught up with at up to 1.2 times the speed.
    assert 0.7 * wanted_speed < speed < 1.35 * wanted_speed


@pytest.mark.slow
def test_the_shipped_ur5e_rig_tosses(rtde: tuple[str, ChildProcess], tmp_path: Path) -> None:
    """Its arm alone, with the toss that the file asks for: to the start, the toss, and what is written of it."""
    shipped = read_rig(find_rig("ur5e"))
    arm = replace(shipped.of_kind("arm")[0], address=rtde[0])
    rig = replace(shipped, devices=(arm,), recording=replace(shipped.recording, countdown_s=0.0))
    assert rig.toss is not None
    recorder = Recorder(rig, {"arm": make_device(arm, rig.source)}, SessionClock(time.monotonic_ns(), time.time_ns()))
    base = base_in_world(rig.toss, NO_CALIBRATION)
    thrower = ArmThrower(arm_model("ur5e"), Space.of_table(base), rig.toss, recorder, Nobody(), countdown_s=0.0)
    with recorder:
        time.sleep(0.5)
        with SessionWriter(tmp_path / "ur", {}) as session:
            whole = SessionRun(recorder, thrower, session, NO_CALIBRATION, Nobody(), Silent())
            report = whole.record(Options(1, fixed_s=2.5))
            session.finish()
    assert report.takes[0].decision == "accept", report.takes[0].verdict.text()
    told = thrower.plan(0).trajectory
    with Session.open(tmp_path / "ur") as session:
        states, command = session.toss(0).arm_states(), session.toss(0).command()
    assert states is not None
    assert command is not None
    since_s = (states.time_ns - command.time_ns) * 1e-9
    during = (since_s > 0) & (since_s < told.duration_s)
    assert during.sum() > 0.5 * 500 * told.duration_s
    # late cycles are caught up with, so the path counts, not the instant: each state is somewhere on it
    nearest = [np.abs(told.q_rad - q).max(axis=1).min() for q in states.q_rad[during]]
    assert max(nearest) < 0.01
    assert np.abs(states.q_rad[-1] - told.q_rad[-1]).max() < 0.01
    assert verify(tmp_path / "ur").ok


PANDA_RIG = """name = "fci"
robot = "panda"
unattended = true
calibration = "calibration.json"
[devices.arm]
kind = "arm"
driver = "franka"
address = "ADDRESS"
rate_hz = 1000
settings = { realtime = "ignore" }
[devices.gripper]
kind = "gripper"
driver = "franka_hand"
address = "ADDRESS"
rate_hz = 10
[recording]
countdown_s = 1
longest_toss_s = 3
longest_gap_s = 5
queue_s = 5
redo_at_most = 5
[toss]
position_m = [0.0, 0.1, 0.35]
velocity_m_s = [0.0, -0.6, 0.5]
spin_rad_s = [-3.0, 0.0, 0.0]
held_mass_kg = 0.2
dry_openings = 4
[workspace]
lower_m = [-0.9, -0.6, -0.05]
upper_m = [0.9, 0.9, 1.3]
posts = []
"""
BASE = Transform("world", "base", rotation_exp(np.array([0.0, 0.0, -np.pi / 2])), np.array([0.0, 0.6, 0.0]))


@pytest.mark.slow
def test_toss_record_tosses_with_a_panda(
    fci: tuple[str, ChildProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Planned, carried out at 1 kHz, released: the fingers' widths tell when, the file holds all of it."""
    monkeypatch.setattr(preflight, "RATE_BAD", 0.9)  # on a busy machine the simulator's seconds are longer than ours
    rig, out = tmp_path / "panda.toml", tmp_path / "out"
    rig.write_text(PANDA_RIG.replace("ADDRESS", fci[0]))
    placed = RigCalibration(cameras={}, transforms=(BASE,))
    (tmp_path / "calibration.json").write_text(json.dumps(placed.to_json()))
    assert main(["--rig", str(rig), "--yes", str(out)]) == 0
    with Session.open(out) as session:
        delay = session.start["release_delay"]
        toss = session.toss(0)
        states, command = toss.arm_states(), toss.command()
        release = next(e for e in toss.events() if e.kind == "release")
    assert states is not None
    assert command is not None
    assert delay["samples"] >= 3
    assert 0 < delay["mean_s"] < 0.5
    assert np.abs(states.dq_rad_s).max() > 0.5
    assert 0 < (release.time_ns - command.time_ns) * 1e-9 < 1.5
    assert release.sigma_s > 0
    assert np.isfinite(states.finger_width_m).any()
    assert verify(out).ok
