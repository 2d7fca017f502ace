"""What keeps a real arm safe, asked of the real clients on the simulated controllers."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.arm.approach import plan_approach
from acquisition.arm.limits import arm_model
from acquisition.arm.thrower import ArmThrower
from acquisition.arm.workspace import Space
from acquisition.cli import main
from acquisition.devices import ArmSamples, DeviceRefused, JointTrajectory, TakesLoad
from acquisition.drivers import franka
from acquisition.drivers.franka import FrankaArm
from acquisition.drivers.ur import UrArm
from acquisition.operator import Nobody
from acquisition.rig import DeviceEntry, Rig, TossConfig
from acquisition.simulators.child_process import ChildProcess
from acquisition.streaming.clock import SessionClock
from acquisition.streaming.recorder import Recorder
from recordings.errors import TosslabError
from recordings.geometry import Transform
from recordings.progress import Silent
from recordings.tracks import RigCalibration

SPACE = Space.of_table(Transform("world", "base", np.eye(3), np.zeros(3)))


def rest(arm: FrankaArm | UrArm) -> np.ndarray:
    states: ArmSamples | None = arm.read(2.0)
    assert states is not None
    return states.q_desired_rad[-1]


def small_way(name: str, q: np.ndarray) -> JointTrajectory:
    return plan_approach(arm_model(name), SPACE, q, q + np.linspace(0.03, -0.03, len(q))).trajectory


def test_a_ur_is_told_its_load_and_a_load_that_its_controller_refuses_is_named(rtde: tuple[str, ChildProcess]) -> None:
    address, simulator = rtde
    with UrArm(host=address) as arm:
        assert isinstance(arm, TakesLoad)
        gripper_kg, *gripper_at = simulator.snapshot()["payload"]
        assert gripper_kg > 0
        held_at = np.array([0.0, 0.01, 0.11])
        arm.set_load(0.4, held_at, 0.05)
        both = gripper_kg + 0.4
        at = (gripper_kg * np.array(gripper_at) + 0.4 * held_at) / both
        np.testing.assert_allclose(simulator.snapshot()["payload"], [both, *at])
        with pytest.raises(DeviceRefused, match="the load of 9 kg was not taken: .*refuses set_payload"):
            arm.set_load(9.0, np.zeros(3), 0.05)
        assert simulator.snapshot()["payload"][0] == both
        arm.recover()
        arm.set_load(0.0, np.zeros(3), 0.0)
        np.testing.assert_allclose(simulator.snapshot()["payload"], [gripper_kg, *gripper_at])


def test_a_panda_is_told_its_thresholds_and_its_load(fci: tuple[str, ChildProcess]) -> None:
    address, simulator = fci
    with FrankaArm(host=address, realtime="ignore", collision_torque_nm=16.0, collision_force_n=24.0) as arm:
        told = simulator.snapshot()
        assert told["set_collision_behavior"] == [16.0] * 14 + [8.0] * 14 + [24.0] * 12 + [12.0] * 12
        assert told["set_load"] == [0.0] * 13
        arm.set_load(0.4, np.array([0.0, 0.01, 0.11]), 0.05)
        mass, x, y, z, *inertia = simulator.snapshot()["set_load"]
        assert (mass, x, y, z) == (0.4, 0.0, 0.01, 0.11)
        np.testing.assert_allclose(
            np.reshape(inertia, (3, 3)), 0.4 * 0.4 * 0.05**2 * np.eye(3)
        )  # a full ball: 2/5 m r2
    with pytest.raises(DeviceRefused, match="wanted more than 0, at most 87 Nm"):
        FrankaArm(host=address, collision_torque_nm=500.0)


def test_without_a_real_time_kernel_a_panda_is_read_and_not_moved(
    fci: tuple[str, ChildProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = tmp_path / "realtime"
    monkeypatch.setattr(franka, "REALTIME", kernel)
    before = fci[1].snapshot()["motions"]
    with FrankaArm(host=fci[0]) as arm:  # `enforce` is what it is without a word
        arm.start()
        here = rest(arm)
        with pytest.raises(DeviceRefused, match=r"kernel \(.*\) is not real-time.*nothing was moved.*linux-image-rt"):
            arm.move(small_way("panda", here))
        with pytest.raises(DeviceRefused, match="not real-time"):
            arm.may_move()
        assert any("cannot be moved" in text for text in arm.describe()["warnings"])
        kernel.write_text("1\n")
        arm.may_move()
    assert fci[1].snapshot()["motions"] == before


def test_a_reflex_on_the_way_ends_the_session_and_nothing_recovers_it(fci: tuple[str, ChildProcess]) -> None:
    address, simulator = fci
    entry = DeviceEntry("arm", "arm", "franka", address=address, rate_hz=1000.0)
    arm = FrankaArm(host=address, realtime="ignore")
    recorder = Recorder(Rig("t", (entry,), Path("t.toml"), "panda"), {"arm": arm}, SessionClock(time.monotonic_ns(), 0))
    toss = TossConfig(position_m=(0.45, 0.0, 0.4), velocity_m_s=(0.2, 0.0, 0.2), velocity_spread_m_s=0.0)

    class Troubles(Nobody):
        told = False

        def touched(self) -> bool:
            if arm.motion().status == "moving" and not self.told:
                self.told = True
                simulator.inject("reflex", at_s=2.0, error="cartesian_reflex")
            return False

    with recorder:
        time.sleep(0.5)
        before = simulator.snapshot()
        thrower = ArmThrower(arm_model("panda"), SPACE, toss, recorder, Troubles(), speed=0.1, countdown_s=0.0)
        with pytest.raises(TosslabError, match=r"cartesian_reflex.*nothing is recovered or tried again by itself"):
            thrower.prepare(0, 0, Silent())
        time.sleep(0.5)
        after = simulator.snapshot()
        assert after["mode"] == "REFLEX"
        assert after["recoveries"] == before["recoveries"]
        assert after["motions"] == before["motions"] + 1
        arm.recover()  # a person's word
        assert simulator.snapshot()["recoveries"] == before["recoveries"] + 1


def test_a_panda_stands_until_a_key_and_any_key_halts_it(fci: tuple[str, ChildProcess]) -> None:
    address, simulator = fci
    entry = DeviceEntry("arm", "arm", "franka", address=address, rate_hz=1000.0)
    arm = FrankaArm(host=address, realtime="ignore")
    recorder = Recorder(Rig("t", (entry,), Path("t.toml"), "panda"), {"arm": arm}, SessionClock(time.monotonic_ns(), 0))
    toss = TossConfig(position_m=(0.45, 0.0, 0.4), velocity_m_s=(0.2, 0.0, 0.2), velocity_spread_m_s=0.0)

    class Person(Nobody):
        """Starts once, presses a key when the arm has moved for a second, and leaves when asked again."""

        headless = False
        asked_at: list[dict[str, Any]]
        moving_since_s: float | None = None

        def wait_for_start(self) -> Any:
            time.sleep(0.5)
            self.asked_at = [*getattr(self, "asked_at", []), simulator.snapshot()]
            return "start" if len(self.asked_at) == 1 else "quit"

        def touched(self) -> bool:
            if arm.motion().status == "moving":
                self.moving_since_s = self.moving_since_s or time.monotonic()
                return time.monotonic() > self.moving_since_s + 1.0
            return False

    person = Person()
    with recorder:
        time.sleep(0.5)
        if simulator.snapshot()["mode"] == "REFLEX":
            arm.recover()
        before = simulator.snapshot()
        thrower = ArmThrower(arm_model("panda"), SPACE, toss, recorder, person, speed=0.1, countdown_s=1.0)
        goal = thrower.plan(0).trajectory.q_rad[0]
        with pytest.raises(KeyboardInterrupt):
            thrower.prepare(0, 0, Silent())
        first, second = person.asked_at
        assert first["motions"] == before["motions"]  # not a step before the key
        np.testing.assert_allclose(first["q_d"], before["q_d"], atol=1e-9)
        assert second["motions"] == before["motions"] + 1
        stands = np.array(second["q_d"])
        assert np.abs(stands - before["q_d"]).max() > 1e-4
        assert np.abs(stands - goal).max() > 0.01  # halted on its way
        assert arm.motion().reason == "halted"


@pytest.mark.parametrize(
    "fault, says",
    [
        ("local_control", "it is in local control; nothing was moved"),
        ("reduced", "its safety mode is REDUCED, wanted NORMAL"),
    ],
)
def test_a_ur_is_asked_for_safety_mode_and_remote_control_before_it_moves(
    fault: str, says: str, rtde: tuple[str, ChildProcess]
) -> None:
    address, simulator = rtde
    with UrArm(host=address) as arm:
        arm.start()
        way = small_way("ur5e", rest(arm))
        simulator.inject(fault)
        moves = simulator.snapshot()["moves"]
        try:
            with pytest.raises(DeviceRefused, match=says):
                arm.may_move()
            with pytest.raises(DeviceRefused, match=says):
                arm.move(way)
        finally:
            simulator.clear(fault)
        assert simulator.snapshot()["moves"] == moves
        arm.may_move()


RIG = """name = "fci"
robot = "panda"
calibration = "calibration.json"
[devices.arm]
kind = "arm"
driver = "franka"
address = "ADDRESS"
rate_hz = 1000
[toss]
position_m = [0.45, 0.0, 0.4]
velocity_m_s = [0.2, 0.0, 0.2]
held_mass_kg = 0.2
[workspace]
lower_m = [-1.0, -1.0, -0.1]
upper_m = [1.0, 1.0, 1.4]
posts = []
"""


def test_toss_record_moves_no_panda_for_yes_alone_nor_by_a_place_that_was_made_up(
    fci: tuple[str, ChildProcess], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = fci[1].snapshot()
    rig, out = tmp_path / "rig.toml", tmp_path / "out"
    rig.write_text(RIG.replace("ADDRESS", fci[0]))
    placed = RigCalibration(cameras={}, transforms=(SPACE.world_from_base,))
    (tmp_path / "calibration.json").write_text(json.dumps(placed.to_json()))
    assert main(["--rig", str(rig), "--yes", str(out)]) == 2
    assert "--yes would move a real arm without asking" in capsys.readouterr().err
    made_up = RIG.replace('calibration = "calibration.json"\n', "").replace(
        "[toss]", "[toss]\nworld_from_base = [0, 0, 0, 0]"
    )
    rig.write_text(made_up.replace("ADDRESS", fci[0]))
    assert main(["--rig", str(rig), str(out)]) == 2
    assert "the arm is not calibrated: nothing was moved" in capsys.readouterr().err
    assert main(["--rig", str(rig), "--dry-run", str(out)]) == 0
    assert "no arm is moved by it" in capsys.readouterr().out
    after = fci[1].snapshot()
    assert after["motions"] == before["motions"]
    np.testing.assert_allclose(after["q"], before["q"], atol=1e-9)
    assert not out.exists()
