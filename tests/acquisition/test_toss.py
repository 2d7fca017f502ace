"""Planned tosses: within every limit, through the release that was asked for, refused by name where they are not."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from acquisition.arm.approach import plan_approach
from acquisition.arm.dynamics import torques
from acquisition.arm.kinematics import Batch, segment_distance
from acquisition.arm.limits import SHARE, ArmModel, Held, arm_model
from acquisition.arm.thrower import ArmThrower, base_in_world, estimate_delay, onset_s
from acquisition.arm.toss import ReleaseDelay, Samples, TossRefused, check_limits, draw_target, plan_toss, slowed
from acquisition.arm.workspace import Space
from acquisition.operator import Nobody
from acquisition.rig import TossConfig
from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_exp, rotation_log
from recordings.tracks import RigCalibration

BASE = Transform("world", "base", rotation_exp(np.array([0.0, 0.0, -np.pi / 2])), np.array([0.0, 0.6, 0.0]))
SPACE = Space.of_table(BASE)
CALM = TossConfig(
    position_m=(0.0, 0.1, 0.35), velocity_m_s=(0.05, -0.35, 0.3), position_spread_m=0.02, velocity_spread_m_s=0.05
)
DELAY = ReleaseDelay(0.06, 0.01)
ARMS = ("panda", "ur5e")


@pytest.fixture(params=ARMS)
def model(request: pytest.FixtureRequest) -> ArmModel:
    return arm_model(request.param)


def test_batched_kinematics_agree_with_the_robots_own(model: ArmModel) -> None:
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (3, model.joints)) + model.ready_rad
    batch = Batch(model)
    R, p = batch.tool(q)
    J = batch.jacobian(q)
    for k in range(3):
        tool = model.base_from_tool(q[k])
        np.testing.assert_allclose(R[k], tool.rotation, atol=1e-9)
        np.testing.assert_allclose(p[k], tool.translation_m, atol=1e-9)
        np.testing.assert_allclose(J[k], model.jacobian(q[k], tool.translation_m), atol=1e-9)


def test_the_ur5e_stands_where_its_data_sheet_says() -> None:
    # at zero the arm lies along -x: a2 + a3 = 817.2 mm; the flange is d4 + d6 to the side, d1 - d5 high
    tool = arm_model("ur5e").robot.links(np.zeros(6))["link6"]
    np.testing.assert_allclose(tool.translation_m, [-0.8172, -0.1333 - 0.0996, 0.1625 - 0.0997], atol=1e-9)


def test_the_ur5e_holds_its_weight_with_the_slope_of_its_potential_energy() -> None:
    """Virtual work: at rest, each joint's torque is the change of height times weight that its turn makes."""
    model = arm_model("ur5e")

    def energy_j(q: np.ndarray) -> float:
        links = model.robot.links(q)
        held = model.held.mass_kg * links[model.tool].translation_m[2]
        return 9.81 * (held + sum(b.mass_kg * links[b.link].points(np.array([b.centre_m]))[0, 2] for b in model.bodies))

    q, h, still = np.array([0.3, -1.0, 1.2, -0.5, 0.4, 0.2]), 1e-5, np.zeros((1, 6))
    slope = [(energy_j(q + h * e) - energy_j(q - h * e)) / (2 * h) for e in np.eye(6)]
    np.testing.assert_allclose(torques(model, q[None], still, still)[0], slope, atol=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_a_torque_beyond_its_limit_is_named(name: str) -> None:
    model = arm_model(name)
    weak = replace(model, torque_nm=model.torque_nm * 1e-3)
    t = np.arange(0, 0.1, 0.001)
    q = np.tile(model.ready_rad, (len(t), 1))
    breach = check_limits(weak, Samples(t, q, np.zeros_like(q), np.zeros_like(q)))
    assert breach is not None
    assert (breach.what, breach.unit) == ("torque", "Nm")


def test_inverse_kinematics_find_back(model: ArmModel) -> None:
    q = model.ready_rad + 0.1
    wanted = model.base_from_tool(q)
    found, solved = Batch(model).solve(wanted, np.stack([model.ready_rad, model.ready_rad - 0.2]))
    assert solved.any()
    for one in found[solved]:
        there = model.base_from_tool(one)
        np.testing.assert_allclose(there.translation_m, wanted.translation_m, atol=1e-4)
        assert np.linalg.norm(rotation_log(there.rotation.T @ wanted.rotation)) < 1e-3


def test_a_planned_toss_passes_its_release_with_its_velocity_and_keeps_it(model: ArmModel) -> None:
    plan = plan_toss(model, SPACE, draw_target(CALM, 0), DELAY)
    q, dq = plan.trajectory.at(plan.release_s)
    tool = BASE @ model.base_from_tool(q)
    np.testing.assert_allclose(tool.translation_m, plan.world_from_tool.translation_m, atol=1e-3)
    twist = model.jacobian(q, model.base_from_tool(q).translation_m) @ dq
    np.testing.assert_allclose(BASE.rotation @ twist[:3], plan.linear_velocity_world_m_s, atol=1e-3)
    np.testing.assert_allclose(BASE.rotation @ twist[3:], plan.angular_velocity_world_rad_s, atol=1e-2)
    assert plan.window_s >= 4 * DELAY.sigma_s
    assert plan.release_s - plan.command_s == pytest.approx(DELAY.mean_s)
    for early in (-0.5, 0.5):
        np.testing.assert_allclose(plan.trajectory.at(plan.release_s + early * 0.98 * plan.window_s)[1], dq, atol=1e-4)


@pytest.mark.parametrize("name", ARMS)
def test_every_accepted_plan_stays_within_the_limits(name: str) -> None:
    model, rng, accepted = arm_model(name), np.random.default_rng(1), 0
    for _ in range(6):
        config = replace(CALM, velocity_m_s=tuple(rng.uniform([-0.5, -1.0, -0.2], [0.5, 0.1, 0.8]).tolist()))
        try:
            plan = plan_toss(model, SPACE, draw_target(config, 0), DELAY)
        except TossRefused:
            continue
        accepted += 1
        t = plan.trajectory
        ddq = np.gradient(t.dq_rad_s, t.time_s, axis=0)
        assert check_limits(model, Samples(t.time_s, t.q_rad, t.dq_rad_s, ddq)) is None
        assert np.abs(t.dq_rad_s[[0, -1]]).max() < 1e-9
        gaps, _ = Batch(model).clearances(t.q_rad[::20])
        assert gaps.min() > 0.0
    assert accepted >= 2


@pytest.mark.parametrize(
    "change, says",
    [
        (
            {"velocity_m_s": (0.0, -6.0, 3.0)},
            r"velocity of panda_joint\d at .* rad/s, allowed are .* \(0.9 of the limit\)",
        ),
        ({"position_m": (0.0, -2.0, 0.3)}, "no joint angles of the panda reach the release pose"),
        pytest.param(
            {"position_m": (0.0, 0.1, 0.03)},
            "distance of panda_.* at least .* is wanted",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_toss_that_cannot_be_is_refused_with_what_stands_in_the_way(change: dict, says: str) -> None:
    config = replace(CALM, position_spread_m=0.0, velocity_spread_m_s=0.0, **change)
    with pytest.raises(TossRefused) as refused:
        plan_toss(arm_model("panda"), SPACE, draw_target(config, 0), DELAY)
    assert re.search(says, str(refused.value))


def test_a_limit_that_is_broken_is_named_with_joint_time_and_value() -> None:
    model = arm_model("panda")
    t = np.arange(0, 0.5, 0.001)
    q = np.tile(model.ready_rad, (len(t), 1))
    dq = np.zeros_like(q)
    dq[250, 3] = 2.1
    breach = check_limits(model, Samples(t, q, dq, np.zeros_like(q)))
    assert breach is not None
    assert (breach.what, breach.part, breach.time_s, breach.value) == ("velocity", "panda_joint4", 0.25, 2.1)
    assert breach.limit == pytest.approx(SHARE * 2.175)


def test_a_motion_to_the_start_is_calm_and_ends_there(model: ArmModel) -> None:
    to = model.ready_rad + np.linspace(0.2, -0.2, model.joints)
    way = plan_approach(model, SPACE, model.ready_rad, to).trajectory
    np.testing.assert_allclose(way.q_rad[0], model.ready_rad, atol=1e-9)
    np.testing.assert_allclose(way.q_rad[-1], to, atol=1e-6)
    assert (np.abs(way.dq_rad_s) <= 0.31 * model.velocity).all()


def test_a_slower_toss_takes_the_same_path_and_lets_go_on_time() -> None:
    plan = plan_toss(arm_model("panda"), SPACE, draw_target(CALM, 0), DELAY)
    slow = slowed(plan, 0.1)
    assert slow.trajectory.duration_s == pytest.approx(10 * plan.trajectory.duration_s)
    for share in (0.2, 0.5, 0.9):
        q, dq = plan.trajectory.at(share * plan.trajectory.duration_s)
        there, slower = slow.trajectory.at(share * slow.trajectory.duration_s)
        np.testing.assert_allclose(there, q, atol=1e-9)
        np.testing.assert_allclose(slower, 0.1 * dq, atol=1e-9)
    assert slow.release_s - slow.command_s == pytest.approx(DELAY.mean_s)  # the fingers are as late as ever
    np.testing.assert_allclose(slow.linear_velocity_world_m_s, 0.1 * plan.linear_velocity_world_m_s)


def test_a_heavier_object_asks_for_more_torque_by_its_weight_times_its_arm() -> None:
    model = arm_model("panda")
    q, still = model.ready_rad[None], np.zeros((1, 7))
    light, heavy = (torques(model.holding(Held(kg, (0.0, 0.0, 0.02))), q, still, still)[0] for kg in (0.5, 1.5))
    tool = model.base_from_tool(model.ready_rad)
    J = model.jacobian(model.ready_rad, tool.points(np.array([[0.0, 0.0, 0.02]]))[0])
    np.testing.assert_allclose(heavy - light, 9.81 * J[2], atol=1e-6)


def test_distances_between_segments() -> None:
    a, b = np.array([[0.0, 0, 0], [0, 0, 0]]), np.array([[1.0, 0, 0], [1, 0, 0]])
    c, d = np.array([[0.5, 1.0, -1], [3, 0, 0]]), np.array([[0.5, 1.0, 1], [4, 0, 0]])
    np.testing.assert_allclose(segment_distance(a, b, c, d), [1.0, 2.0])


def test_the_gripper_s_delay_is_read_off_its_widths() -> None:
    widths = [(0.02 * k, 0.05 + max(0.0, 0.02 * k - 0.07) * 0.2) for k in range(20)]
    assert onset_s(widths) == pytest.approx(0.07, abs=0.005)
    assert onset_s([(0.0, 0.05), (0.1, 0.05), (0.2, 0.05)]) is None


def test_the_delay_needs_three_openings_and_forgives_an_outlier() -> None:
    assert estimate_delay([0.05, 0.06]) is None
    found = estimate_delay([0.05, 0.06, 0.055, 0.9])
    assert found is not None
    assert found.mean_s == pytest.approx(0.055)
    assert found.samples == 3


def test_tosses_learn_the_delay_of_the_gripper() -> None:
    thrower = ArmThrower(arm_model("panda"), SPACE, CALM, None, Nobody())
    for delay_s in (0.1, 0.11, 0.12):
        thrower.learn(delay_s)
    plan = thrower.plan(0)
    assert plan.release_s - plan.command_s == pytest.approx(0.11)


def test_where_the_robot_stands_must_be_said() -> None:
    with pytest.raises(BadInput, match="world_from_base"):
        base_in_world(CALM, RigCalibration(cameras={}))
    placed = base_in_world(replace(CALM, world_from_base=(0.0, 0.6, 0.0, -90.0)), RigCalibration(cameras={}))
    np.testing.assert_allclose(placed.matrix, BASE.matrix, atol=1e-12)
