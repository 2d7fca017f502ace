"""The space of an arm: every path keeps clear of table, box, posts and cameras, or is refused with the place."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from acquisition.arm.approach import FASTEST_M_S, fastest_m_s, find_way, plan_approach
from acquisition.arm.kinematics import Batch
from acquisition.arm.limits import arm_model
from acquisition.arm.thrower import safe_to_move
from acquisition.arm.toss import ReleaseDelay, Samples, TossRefused, check_limits, draw_target, plan_toss
from acquisition.arm.workspace import STEP_M, TABLE_CLEARANCE_M, PathRefused, Space, dense, reaches_m
from acquisition.rig import Post, Rig, TossConfig, Workspace, find_rig, read_rig
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.tracks import RigCalibration

PANDA = arm_model("panda")
HERE = Transform("world", "base", np.eye(3), np.zeros(3))
TABLE = Space.of_table(HERE)
# Found among random low poses (tool 3 to 12 cm over the table): both ends are clear, the straight way is not.
LOW_PAIRS = (
    ([0.73, 0.74, -0.68, -2.0, 0.76, 2.48, 0.29], [-0.15, 1.04, 1.22, -2.17, -1.26, 2.13, 1.56]),
    ([-0.09, 0.86, -0.67, -1.83, 0.77, 2.4, 0.32], [0.04, 0.73, 0.99, -2.2, -0.97, 2.4, 1.42]),
    ([1.24, 0.78, 1.01, -2.03, -0.9, 2.28, 1.35], [-1.98, 0.36, -1.71, -2.87, 0.86, 2.66, 0.19]),
    ([-1.32, 0.84, 0.63, -1.83, -0.72, 2.42, 1.23], [-1.98, 0.36, -1.71, -2.87, 0.86, 2.66, 0.19]),
    ([1.24, 0.78, 1.01, -2.03, -0.9, 2.28, 1.35], [-1.92, 0.29, -1.79, -2.88, 0.74, 2.71, 0.27]),
    ([0.48, -1.58, 1.8, -2.53, 1.76, 1.69, -0.13], [-0.4, -0.51, 2.6, -2.08, 0.42, 2.48, 0.51]),
)


def lowest_m(path_rad: np.ndarray) -> float:
    """Height of the lowest point of the arm's moving links over the table, by plain forward kinematics."""
    low = np.inf
    for q in path_rad:
        a, b, radius = PANDA.segments(q)
        heights = np.minimum(a[:, 2], b[:, 2]) - radius
        low = min(low, *(h for h, c in zip(heights, PANDA.capsules) if c.link != PANDA.robot.root))
    return float(low)


@pytest.mark.parametrize("pair", LOW_PAIRS)
def test_a_way_that_dips_below_the_table_is_not_taken(pair: tuple[list[float], list[float]]) -> None:
    start, goal = np.array(pair[0]), np.array(pair[1])
    straight = np.linspace(start, goal, 81)
    assert lowest_m(straight) < -0.04  # centimetres below the table, though
    assert min(lowest_m(start[None]), lowest_m(goal[None])) > TABLE_CLEARANCE_M
    contact = TABLE.contact(PANDA, np.stack([start, goal]))
    assert contact is not None
    assert contact.thing == "the table"
    assert contact.clearance_m == pytest.approx(lowest_m(straight), abs=STEP_M)
    way = plan_approach(PANDA, TABLE, start, goal)
    q = way.trajectory.q_rad
    np.testing.assert_allclose(q[[0, -1]], [start, goal], atol=1e-9)
    assert lowest_m(q[:: len(q) // 100]) > TABLE_CLEARANCE_M - STEP_M / 2
    assert way.stops >= 1


LAB = replace(TABLE, lower_m=np.array([-0.9, -0.9, -0.05]), upper_m=np.array([0.9, 0.9, 1.3]))
LOW_POSES = [np.array(pose) for pair in LOW_PAIRS for pose in pair]


def least_room_m(path_rad: np.ndarray) -> tuple[float, float]:
    """Of the arm's moving links along a path: height over the table, and room to the box's faces, by plain forward
    kinematics."""
    height = room = np.inf
    for q in path_rad:
        a, b, radius = PANDA.segments(q)
        moving = np.array([c.link != PANDA.robot.root for c in PANDA.capsules])
        low, high = (np.minimum(a, b) - radius[:, None])[moving], (np.maximum(a, b) + radius[:, None])[moving]
        height = min(height, float(low[:, 2].min()))
        room = min(room, float((low - LAB.lower_m).min()), float((LAB.upper_m - high).min()))
    return height, room


def approach(start: np.ndarray, goal: np.ndarray) -> np.ndarray | str:
    """The joints along the approach in the lab's box, or why there is none."""
    try:
        return plan_approach(PANDA, LAB, start, goal).trajectory.q_rad
    except PathRefused as refused:
        return str(refused)


def test_an_arm_that_stands_at_its_goal_stays_there() -> None:
    start = LOW_POSES[0]
    way = plan_approach(PANDA, LAB, start, start)
    np.testing.assert_array_equal(way.trajectory.q_rad, np.stack([start, start]))
    assert way.tool_way_m == 0.0


@settings(max_examples=8, deadline=None, derandomize=True)
@given(
    start=st.sampled_from(LOW_POSES),
    goal=st.sampled_from(LOW_POSES),
    off_rad=st.lists(st.floats(-0.25, 0.25), min_size=14, max_size=14),
)
def test_between_any_low_poses_an_approach_keeps_table_and_box_or_is_refused_with_the_place(
    start: np.ndarray, goal: np.ndarray, off_rad: list[float]
) -> None:
    start, goal = start + off_rad[:7], goal + off_rad[7:]
    q = approach(start, goal)
    event("refused" if isinstance(q, str) else "accepted")
    if isinstance(q, str):
        assert re.search(r"distance of \S+ to .+ at \d+ % of the way|allowed are", q), q
        return
    np.testing.assert_allclose(q[[0, -1]], [start, goal], atol=1e-9)
    height_m, room_m = least_room_m(q[:: max(1, len(q) // 150)])
    assert height_m > TABLE_CLEARANCE_M - STEP_M / 2
    assert room_m > -STEP_M / 2


@pytest.mark.slow
def test_where_no_way_leads_round_the_place_is_named() -> None:
    start, goal = PANDA.ready_rad.copy(), PANDA.ready_rad.copy()
    start[0], goal[0] = -1.2, 1.2
    feet = np.array([[x, 0.0, 0.0] for x in np.arange(0.25, 1.0, 0.08)])
    fence = replace(
        TABLE,
        things=tuple(f"post '{k}'" for k in range(len(feet))),
        a_m=feet,
        b_m=feet + [0.0, 0.0, 1.5],
        radius_m=np.full(len(feet), 0.03),
        lower_m=np.array([-0.3, -1.0, -1.0]),
        upper_m=np.array([1.0, 1.0, 1.0]),
    )
    wanted = r"distance of panda_\w+ to post '\d' at \d+ % of the way: [\d.]+ cm inside.*no way round it was found"
    with pytest.raises(PathRefused, match=wanted):
        find_way(PANDA, fence, start, goal)


def test_a_post_and_a_camera_in_the_way_are_gone_round() -> None:
    start, goal = PANDA.ready_rad.copy(), PANDA.ready_rad.copy()
    start[0], goal[0] = -0.8, 0.8
    at = PANDA.base_from_tool(PANDA.ready_rad).translation_m  # the hand passes there
    for thing in ("post 'lamp'", "camera 'mono0'"):
        foot = np.array([at[0], at[1], 0.0]) if thing.startswith("post") else at
        space = replace(TABLE, things=(thing,), a_m=foot[None], b_m=at[None] - [0, 0, 0.03], radius_m=np.array([0.03]))
        contact = space.contact(PANDA, np.stack([start, goal]))
        assert contact is not None
        assert contact.thing == thing
        assert 0.3 < contact.share < 0.7
        way = find_way(PANDA, space, start, goal)
        assert len(way) > 2
        assert all(space.contact(PANDA, np.stack(leg)) is None for leg in zip(way, way[1:]))


def test_no_part_of_the_arm_leaves_the_box() -> None:
    reach = float(PANDA.base_from_tool(PANDA.ready_rad).translation_m[0])
    box = replace(TABLE, lower_m=np.full(3, -1.0), upper_m=np.array([reach, 1.0, 1.5]))
    with pytest.raises(PathRefused, match=r"panda_\w+ to the box's upper x face .* inside"):
        plan_approach(PANDA, box, PANDA.ready_rad, PANDA.ready_rad + 0.1)


def test_between_two_checked_poses_no_point_moves_farther_than_the_step() -> None:
    rng = np.random.default_rng(0)
    path = rng.uniform(-1, 1, (4, 7)) + PANDA.ready_rad
    q, share = dense(PANDA, path)
    assert (np.diff(share) > 0).all()
    a, b = Batch(PANDA).segments(q)
    for ends in (a, b):
        assert np.linalg.norm(np.diff(ends, axis=0), axis=2).max() <= STEP_M
    # and the bound holds for any pose: the arm is nowhere longer than its reach beyond a joint
    for pose in rng.uniform(PANDA.lower_rad, PANDA.upper_rad, (50, 7)):
        links = PANDA.robot.links(pose)
        a, b, _ = PANDA.segments(pose)
        far = max(np.linalg.norm(e, axis=1).max() for e in (a, b))
        assert far <= reaches_m(PANDA)[0] + np.linalg.norm(links["panda_link1"].translation_m)


@pytest.mark.parametrize("speed", [1.0, 0.1])
def test_an_approach_is_slow_and_within_all_limits(speed: float) -> None:
    to = PANDA.ready_rad + np.array([1.2, 0.4, -0.3, 0.5, 0.2, 0.3, 1.0])
    way = plan_approach(PANDA, TABLE, PANDA.ready_rad, to, speed)
    t = way.trajectory
    tool = np.array([PANDA.base_from_tool(t.at(s)[0]).translation_m for s in np.linspace(0, t.duration_s, 200)])
    speeds = np.linalg.norm(np.diff(tool, axis=0), axis=1) / (t.duration_s / 199)
    assert speeds.max() <= speed * FASTEST_M_S * 1.001
    samples = Samples(t.time_s, t.q_rad, t.dq_rad_s, np.gradient(t.dq_rad_s, t.time_s, axis=0))
    assert fastest_m_s(PANDA, samples) <= speed * FASTEST_M_S * 1.001
    assert check_limits(PANDA, samples) is None
    assert "no part faster than" in way.text()
    assert f"in {t.duration_s:.1f} s" in way.text()


def test_a_toss_into_a_camera_is_refused_by_its_name() -> None:
    base = Transform("world", "base", np.eye(3), np.zeros(3))
    calm = TossConfig(position_m=(0.5, 0.0, 0.35), velocity_m_s=(0.35, 0.0, 0.3), velocity_spread_m_s=0.0)
    target, delay = draw_target(calm, 0), ReleaseDelay(0.06, 0.01)
    assert plan_toss(PANDA, Space.of_table(base), target, delay).release_s > 0
    at = target.world_from_tool.translation_m + [0.05, 0.0, 0.05]
    space = replace(TABLE, things=("camera 'd455'",), a_m=at[None], b_m=at[None], radius_m=np.array([0.05]))
    with pytest.raises(TossRefused, match="distance of panda_.* to camera 'd455' at .* inside"):
        plan_toss(PANDA, space, target, delay)


BOX = Workspace((-1.0, -1.0, -0.1), (1.0, 1.0, 1.5), ())
PLACED = RigCalibration(
    cameras={}, transforms=(HERE, *(Transform("world", n, np.eye(3), np.ones(3)) for n in ("d455", "mono0")))
)


def lab(**change: object) -> Rig:
    return replace(read_rig(find_rig("ur5e")), **{"workspace": BOX, **change})


def test_cameras_are_kept_clear_where_the_calibration_puts_them_and_posts_where_the_rig_file_does() -> None:
    space = safe_to_move(
        lab(workspace=replace(BOX, posts=(Post("lamp", (1.0, 0.0, 0.0), (1.0, 0.0, 1.0), 0.02),))), PLACED
    )
    assert space.things == ("post 'lamp'", "camera 'd455'", "camera 'mono0'")
    np.testing.assert_allclose(space.a_m[1], [1, 1, 1])
    assert space.radius_m[1] == 0.1


@pytest.mark.parametrize("name", ["lab", "ur5e"])
def test_a_place_that_was_made_up_moves_no_arm(name: str) -> None:
    shipped = read_rig(find_rig(name))
    assert shipped.toss is not None
    assert shipped.toss.world_from_base is not None
    with pytest.raises(BadInput, match=r"the arm is not calibrated: nothing was moved.*--calibration hand-eye"):
        safe_to_move(replace(shipped, workspace=BOX), RigCalibration(cameras={}))


def test_what_the_space_lacks_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"(?s)no \[workspace\].*lower_m"):
        safe_to_move(lab(workspace=None), PLACED)
    with pytest.raises(BadInput, match="where camera 'mono0' stands"):
        safe_to_move(lab(), RigCalibration(cameras={}, transforms=PLACED.transforms[:2]))
    with pytest.raises(BadInput, match="is not below upper_m"):
        safe_to_move(lab(workspace=replace(BOX, lower_m=(2.0, 0.0, 0.0))), PLACED)
    hasty = replace(lab().recording, countdown_s=0.0)
    with pytest.raises(BadInput, match=r"countdown_s = 0; an arm that moves wants at least 1 s"):
        safe_to_move(lab(recording=hasty), PLACED)
    path = tmp_path / "lab.toml"
    path.write_text(
        'name = "x"\n[devices.a]\nkind = "arm"\ndriver = "ur"\nrate_hz = 500\n[workspace]\nlower_m = [0, 0, 0]\n'
    )
    with pytest.raises(BadInput, match=r"workspace: upper_m, posts missing"):
        read_rig(path)
