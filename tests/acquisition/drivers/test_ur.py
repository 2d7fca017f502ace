"""The Universal Robots driver: the real ur-rtde against the RTDE, script and dashboard servers."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from acquisition.devices import ArmSamples, DeviceRefused, JointTrajectory
from acquisition.drivers import ur
from acquisition.drivers.ur import UrArm
from acquisition.simulators.child_process import ChildProcess
from recordings.errors import DeviceNotFound

SWING_RAD = np.array([0.3, 0.4, 0.0, 0.6, 0.0, 0.3])
SWING_S = 1.0


@pytest.fixture(scope="module")
def arm(rtde: tuple[str, ChildProcess]) -> Iterator[UrArm]:
    with UrArm(host=rtde[0]) as opened:
        opened.start()
        yield opened


def swing(q_start: np.ndarray, way_rad: np.ndarray = SWING_RAD) -> JointTrajectory:
    time_s = np.linspace(0, SWING_S, 101)
    u = time_s / SWING_S
    rise, slope = u**3 * (10 - 15 * u + 6 * u**2), 30 * u**2 * (1 - u) ** 2 / SWING_S
    return JointTrajectory(time_s, q_start + rise[:, None] * way_rad, slope[:, None] * way_rad)


def rest(arm: UrArm) -> np.ndarray:
    states = arm.read(1.0)
    assert states is not None
    return states.q_desired_rad[-1]


def go(arm: UrArm, trajectory: JointTrajectory) -> ArmSamples:
    arm.move(trajectory)
    end = time.monotonic() + 3.0
    while arm.motion().status == "moving" and time.monotonic() < end:
        time.sleep(0.02)
    time.sleep(0.05)
    states = arm.read(1.0)
    assert states is not None
    return states


def test_a_ur5e_follows_a_joint_trajectory(arm: UrArm) -> None:
    trajectory = swing(rest(arm))
    states = go(arm, trajectory)
    assert arm.motion().status == "done", arm.motion().reason
    np.testing.assert_allclose(states.q_rad[-1], trajectory.q_rad[-1], atol=1e-3)
    assert arm.motion().ticks > 300
    assert (np.diff(states.number) >= 1).all()
    np.testing.assert_allclose(np.diff(states.time_ns) / np.diff(states.number), 2e6)
    # servoJ follows late by about its look-ahead, never ahead, and along the path
    moving = np.array([mode == "moving" for mode in states.modes])
    share = (states.q_desired_rad[moving] - trajectory.q_rad[0])[:, 3] / SWING_RAD[3]
    assert (np.diff(share) >= -1e-6).all()
    assert share.min() >= -1e-6
    assert share.max() <= 1 + 1e-6


def test_a_protective_stop_ends_the_motion_and_can_be_left(arm: UrArm, rtde: tuple[str, ChildProcess]) -> None:
    trajectory = swing(rest(arm), -SWING_RAD)
    rtde[1].inject("protective_stop", at_s=0.3)
    states = go(arm, trajectory)
    assert arm.motion().status == "aborted"
    assert arm.motion().reason == "protective stop"
    assert "reflex" in states.modes
    with pytest.raises(DeviceRefused, match=r"\(protective stop\); recover"):
        arm.move(trajectory)
    arm.recover()
    time.sleep(0.1)
    go(arm, swing(rest(arm), 0.3 * SWING_RAD))
    assert arm.motion().status == "done", arm.motion().reason


def test_the_emergency_stop_forbids_recovery_until_it_is_over(arm: UrArm, rtde: tuple[str, ChildProcess]) -> None:
    rtde[1].inject("user_stop", for_s=0.5)
    time.sleep(0.2)
    assert "emergency stop" in arm.health().message
    with pytest.raises(DeviceRefused, match="user stop is pressed"):
        arm.recover()
    time.sleep(0.5)
    arm.recover()
    time.sleep(0.1)
    rest(arm)
    arm.move(swing(rest(arm), -0.5 * SWING_RAD))
    time.sleep(0.3)
    arm.halt()
    assert arm.motion().reason == "halted"


def test_without_remote_control_it_is_refused(free_host: str) -> None:
    with ChildProcess("rtde", host=free_host) as controller:
        controller.inject("no_script")
        with pytest.raises(DeviceRefused, match="remote control"):
            UrArm(host=free_host).open()


def test_what_it_is_for_is_said(free_host: str) -> None:
    assert "does not drive the Franka Panda" in str(ur.__doc__).replace("\n", " ")
    with pytest.raises(DeviceRefused, match="look"):
        UrArm(lookahead_s=0.5)
    with pytest.raises(DeviceRefused, match="no address"):
        UrArm().open()
    with pytest.raises(DeviceNotFound, match="does not answer"):
        UrArm(host=free_host).open()
