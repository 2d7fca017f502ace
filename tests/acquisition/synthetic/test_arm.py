"""The tossing arm: limits, grasp, release, slip, joint states."""

from __future__ import annotations

import numpy as np
import pytest

from acquisition.synthetic.lab import Lab
from acquisition.synthetic.random_draws import generator
from recordings.geometry import rotation_angle_rad
from recordings.robot.arm import PANDA_TOOL, panda


@pytest.fixture(scope="module")
def thrown(arm_lab):
    return arm_lab.plan(0)


def test_joints_stay_within_their_limits_with_a_margin(thrown):
    joints = panda().arm_joints
    for t in np.linspace(0, thrown.instants.end_s, 400):
        q, dq = thrown.swing.q_rad(t), thrown.swing.dq_rad_s(t)
        assert all(j.lower < a < j.upper for j, a in zip(joints, q))
        assert all(abs(v) <= 0.9 * j.fastest for j, v in zip(joints, dq))


def test_the_arm_is_still_while_it_holds_and_moves_smoothly(thrown):
    np.testing.assert_allclose(thrown.swing.dq_rad_s(0.1), 0, atol=1e-9)
    times = np.arange(0, thrown.instants.end_s, 0.001)
    dq = np.array([thrown.swing.dq_rad_s(t) for t in times])
    assert np.abs(np.diff(dq, axis=0)).max() / 0.001 < 25  # rad/s^2


def test_the_tool_is_where_forward_kinematics_says(arm_lab, thrown):
    q = thrown.swing.q_rad(0.5)
    tool = panda().links(q)[PANDA_TOOL]
    expected = arm_lab.arm.world_from_base.points(tool.translation_m)
    np.testing.assert_allclose(arm_lab.arm.world_from_tool(q).translation_m, expected)


def test_the_object_rides_in_the_hand_and_slips_as_far_as_set(arm_lab, thrown):
    def in_hand(t):
        return arm_lab.arm.world_from_tool(thrown.swing.q_rad(t)).inverse() @ thrown.object.at(t)

    start, end = in_hand(0.0), in_hand(thrown.instants.release_s)
    assert np.linalg.norm(end.translation_m - start.translation_m) == pytest.approx(0.01, abs=2e-4)
    assert end.translation_m[1] == pytest.approx(start.translation_m[1], abs=2e-4)  # not through the pads
    assert rotation_angle_rad(start.rotation.T @ end.rotation) < 1e-3
    half = in_hand(0.6)
    np.testing.assert_allclose(half.translation_m, start.translation_m, atol=2e-4)


def test_the_object_leaves_with_the_hands_velocity(thrown):
    row = int(np.searchsorted(thrown.object.times_s, thrown.free_s))
    before = (
        thrown.object.at(thrown.free_s).translation_m - thrown.object.at(thrown.free_s - 0.008).translation_m
    ) / 0.008
    np.testing.assert_allclose(before, thrown.object.velocity_world_m_s[row], atol=0.05)
    assert np.linalg.norm(before[:2]) > 0.3
    assert before[2] > 0.1


def test_the_fingers_open_after_the_release_and_not_before(thrown):
    swing = thrown.swing
    assert swing.finger_width_m(thrown.instants.release_s) == pytest.approx(0.0716, abs=1e-4)
    assert swing.finger_width_m(thrown.free_s) == pytest.approx(0.08)


def test_the_hand_withdraws_from_the_object(arm_lab, thrown):
    gaps = []
    for t in (thrown.free_s, thrown.free_s + 0.2):
        tool = arm_lab.arm.world_from_tool(thrown.swing.q_rad(t))
        gaps.append(np.linalg.norm(tool.translation_m - thrown.object.at(t).translation_m))
    assert gaps[1] > gaps[0] + 0.05


def test_joint_states_are_a_kilohertz_with_the_encoders_noise(arm_lab, thrown):
    states = arm_lab.arm.states(thrown.swing, 1.0, generator(1))
    np.testing.assert_allclose(states[:, 0], np.arange(1000) / 1000)
    exact = np.array([thrown.swing.q_rad(t) for t in states[:, 0]])
    assert (states[:, 1:8] - exact).std() == pytest.approx(2e-5, rel=0.1)
    assert states.shape == (1000, 16)


def test_a_wrong_arm_clock_shifts_the_stamps_only(arm_config, thrown):
    from dataclasses import replace

    late = Lab(replace(arm_config, arm=replace(arm_config.arm, clock_offset_s=0.01)))
    states = late.arm.states(thrown.swing, 0.5, generator(1))
    assert states[0, 0] == pytest.approx(0.01)
    np.testing.assert_allclose(states[0, 1:8], thrown.swing.q_rad(0.0), atol=2e-4)
