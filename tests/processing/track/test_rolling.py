"""A round body's azimuth from its contact with the table: known motions of a cylinder."""

from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest
from numpy import ndarray as Array

from processing.features.sift import Sift
from processing.sensor.view_store import ViewStore
from processing.track.beam import Scene
from processing.track.revolution.axis import Axis
from processing.track.revolution.azimuth_smoothing import SteadyConfig, _carried
from processing.track.revolution.rolling import ExpectedSteps, Grounded, RollConfig, rolled, sunk
from recordings.geometry import rotation_exp, rotation_log

RADIUS, HALF, STEP_S = 0.04, 0.05, 1 / 30
AXIS = Axis(np.array([0.0, 0.0, 1.0]), np.array([0.003, -0.002, 0.0]))
RINGS = np.array([[-HALF, RADIUS], [0.0, RADIUS], [HALF, RADIUS]])
TABLE = np.array([0.0, 0.0, 1.0, 0.0])
CAMERA = rotation_exp(np.array([2.0, 0.3, -0.4]))
"""Camera from world: the table is the plane z = 0 of the world."""


def lying(turn: Array, middle: Array) -> Array:
    out = np.eye(4)
    out[:3, :3] = CAMERA @ turn
    out[:3, 3] = CAMERA @ (middle - turn @ AXIS.point_m) + [0.1, 0.0, 0.8]
    return out


def beside_table(poses: list[Array]) -> Grounded:
    up = CAMERA @ TABLE[:3]
    plane = np.r_[up, -up @ [0.1, 0.0, 0.8]]
    return Grounded(np.array(poses), [plane] * len(poses), AXIS, RINGS)


def body_up(pose: Array) -> Array:
    return beside_table([pose]).table[0][:3]


def body_foot(pose: Array) -> float:
    plane = beside_table([pose]).table[0]
    return float(plane[:3] @ pose[:3, 3] + plane[3])


def own_turns(poses: list[Array]) -> list[Array]:
    """The poses with turns about the axis that nobody could see."""
    return [p @ AXIS.rotation(a) for p, a in zip(poses, np.random.default_rng(0).uniform(-3, 3, len(poses)))]


def motion(tilt: float, spin: float, precession: float, count: int = 8, substeps: int = 200) -> list[Array]:
    """A cylinder leaning on its rim by `tilt` that rolls without slipping."""
    turn = rotation_exp(np.array([0.0, np.pi / 2 - tilt, 0.0]))
    middle = np.array([0.02, -0.03, RADIUS * np.cos(tilt) + HALF * np.sin(tilt)])
    out = []
    for n in range((count - 1) * substeps + 1):
        if n % substeps == 0:
            out.append(lying(turn, middle))
        along = turn[:, 2]
        down = along * along[2] - [0.0, 0.0, 1.0]
        contact = RADIUS * down / np.linalg.norm(down) - HALF * along
        omega = spin * along + np.array([0.0, 0.0, precession])
        middle = middle - np.cross(omega, contact) * STEP_S / substeps
        turn = rotation_exp(omega * STEP_S / substeps) @ turn
    return out


@pytest.mark.parametrize(("tilt", "precession"), [(0.0, 0.0), (0.5, 3.0), (1.0, -4.0)])
def test_a_cylinder_that_rolls_turns_as_far_as_its_axis_goes(tilt: float, precession: float) -> None:
    spin = 5.0
    poses = motion(tilt, spin, precession)
    found = rolled(beside_table(own_turns(poses)), np.full(len(poses) - 1, STEP_S), RollConfig())
    # the body's own spin about the axis: what it turns by itself and the precession's part along the axis
    wanted = -(spin + precession * np.sin(tilt)) * STEP_S
    np.testing.assert_allclose(found.step_rad, wanted, rtol=0.01)
    assert (found.sigma_rad < np.radians(3)).all()


def test_what_flies_lies_too_long_between_views_or_has_no_table_does_not_roll() -> None:
    poses, steps_s = motion(0.0, 5.0, 0.0), np.full(7, STEP_S)
    high = [p.copy() for p in poses]
    for p in high:
        p[:3, 3] += CAMERA @ [0.0, 0.0, 0.01]
    assert np.isinf(rolled(beside_table(high), steps_s, RollConfig()).sigma_rad).all()
    assert np.isinf(rolled(beside_table(poses), 5 * steps_s, RollConfig()).sigma_rad).all()
    unknown = Grounded(np.array(poses), [None] * len(poses), AXIS, RINGS)
    assert np.isinf(rolled(unknown, steps_s, RollConfig()).sigma_rad).all()


def test_a_body_that_seems_off_the_table_rolls_less_surely() -> None:
    poses, steps_s = motion(0.0, 5.0, 0.0), np.full(7, STEP_S)
    deep = [p.copy() for p in poses]
    for p in deep:
        p[:3, 3] -= CAMERA @ [0.0, 0.0, 0.01]
    sure, unsure = (rolled(beside_table(p), steps_s, RollConfig()).sigma_rad for p in (poses, deep))
    assert (unsure > 1.4 * sure).all()


def test_what_the_robots_hand_carries_turns_as_the_hand_does() -> None:
    rng = np.random.default_rng(1)
    hand = np.array([lying(rotation_exp(rng.normal(0, 0.2, 3)), rng.normal(0, 0.02, 3)) for _ in range(6)])
    held = [h @ np.linalg.inv(hand[0]) @ lying(np.eye(3), np.zeros(3)) for h in hand]
    for p in held[4:]:
        p[:3, 3] += 0.02 * (len(held) - 3)  # it slips from frame 4 on
    held[5][:3, 3] += 0.1
    hidden = hand.copy()
    hidden[2] = np.nan
    free = ExpectedSteps(np.zeros(5), np.full(5, np.inf))
    for known, carried in ((hand, [0, 1, 2]), (hidden, [0])):
        scene = Scene(Mock(spec=ViewStore), np.arange(6) / 30, np.zeros(3), np.zeros(3), Sift(), hand=known)
        found = _carried(scene, np.arange(6), beside_table(own_turns(held)), free, SteadyConfig())
        assert np.flatnonzero(np.isfinite(found.sigma_rad)).tolist() == carried
        turned = beside_table(own_turns(held)).poses
        for n in carried:  # the second view's turn that goes with the hand, less its pose's error
            between = rotation_log(turned[n + 1, :3, :3].T @ (hand[n + 1] @ np.linalg.inv(hand[n]) @ turned[n])[:3, :3])
            own = rotation_log(turned[n + 1, :3, :3].T @ turned[n, :3, :3]) @ AXIS.direction
            off = (own - found.step_rad[n] - between @ AXIS.direction + np.pi) % (2 * np.pi) - np.pi
            assert abs(off) < 0.05


def test_a_handle_does_not_sink_into_the_table() -> None:
    pose = lying(rotation_exp(np.array([0.0, np.pi / 2, 0.0])), np.array([0.0, 0.0, RADIUS]))
    up = pose[:3, :3].T @ CAMERA @ [0.0, 0.0, 1.0]
    radii = np.linspace(RADIUS, RADIUS + 0.03, 60)
    handle = AXIS.point_m + radii[:, None] * up  # stands upright
    seen = (handle @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    turns = np.radians([-180.0, -150.0, -60.0, 0.0, 60.0, 150.0, 180.0])
    none = np.zeros((0, 3), dtype=np.float32)
    body = beside_table([pose, pose])
    # the first view's handle in the second one: free where it is level or higher, deep in the table upside down
    said = sunk(body, [seen, none], np.array([[0, 1]]), turns, RollConfig())[0]
    assert (said[2:5] == 0).all()
    assert said[0] == pytest.approx(0.5 * ((0.9 * 0.03 - 0.002) / 0.002) ** 2, rel=0.1)
    np.testing.assert_allclose(said, said[::-1], rtol=1e-4)
    assert said[0] > said[1] > 10
    few = sunk(body, [seen[:5], none], np.array([[0, 1]]), turns, RollConfig())
    assert (few == 0).all()


def test_a_handle_of_either_view_counts_and_the_first_is_turned_by_more_than_the_second() -> None:
    pose = lying(rotation_exp(np.array([0.0, np.pi / 2, 0.0])), np.array([0.0, 0.0, RADIUS]))
    level = pose[:3, :3].T @ CAMERA @ [0.0, 1.0, 0.0]
    handle = AXIS.point_m + np.linspace(RADIUS, RADIUS + 0.03, 60)[:, None] * level
    seen = (handle @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32)
    none, turns = np.zeros((0, 3), dtype=np.float32), np.radians([-60.0, 60.0])
    body = beside_table([pose, pose])
    one = sunk(body, [seen, none], np.array([[0, 1]]), turns, RollConfig())[0]
    other = sunk(body, [none, seen], np.array([[0, 1]]), turns, RollConfig())[0]
    np.testing.assert_allclose(one, other[::-1], rtol=1e-4)
    assert (one > 1).sum() == 1
    for turn, said in zip(turns, one):  # the first view's pose turned by that much: where its handle comes to lie
        there = AXIS.rotation(-float(turn))
        height = (handle @ there[:3, :3].T + there[:3, 3]) @ pose[:3, :3].T @ body_up(pose)
        deep = -np.quantile(height + body_foot(pose), 0.1) - 0.002
        assert said == pytest.approx(0.5 * (max(deep, 0.0) / 0.002) ** 2, rel=1e-3, abs=1e-9)
