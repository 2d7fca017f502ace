"""Short windows linked through an impact, and crossovers, from hypotheses that are both wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy import ndarray as Array

from processing.config import Config
from processing.features.sift import Sift
from processing.live.config import light
from processing.motion.motion_prior import gravity_in_camera
from processing.track.beam import Scene, seconds
from processing.track.crossover import crossed, crossed_at, cuts_between
from processing.track.hypotheses import TrajectoryHypothesis, refined
from processing.track.track_toss import TrackConfig, first_pose, started, views_of
from processing.track.windows import WindowConfig, _distinct, _poses, through_windows
from recordings.geometry import Transform, rotation_angle_rad, rotation_exp
from recordings.progress import Silent

STEP_S = 1 / 30
FRAMES, IMPACT = 13, 6
BEFORE, AFTER = np.array([6.0, -9.0, 7.0]), np.array([-5.0, -2.0, 8.0])
"""Spins of 24 and 18 degrees a frame."""


def thrown(i: int) -> Transform:
    """world_from_object: spins one way until the impact, another way after it, and moves across the table."""
    t, t0 = i * STEP_S, IMPACT * STEP_S
    turn = rotation_exp(BEFORE * min(t, t0))
    if t > t0:
        turn = rotation_exp(AFTER * (t - t0)) @ turn
    place = np.array([-0.08, -0.05, 0.14 + 0.3 * abs(t - t0)]) + np.array([0.4, 0.2, 0.0]) * t
    return Transform("world", "object", turn @ rotation_exp(np.array([0.7, 0.5, 0.3])), place)


@pytest.fixture(scope="module")
def scene(tiny_world: Any) -> Scene:
    seen = [tiny_world.see(thrown(i), i) for i in range(FRAMES)]
    frames = [replace(f, time_ns=round(i * STEP_S * 1e9), depth_time_ns=round(i * STEP_S * 1e9))
              for i, (f, _) in enumerate(seen)]  # fmt: skip
    store, times_ns, _ = views_of(
        frames, [m for _, m in seen], tiny_world.camera, np.ones(FRAMES), TrackConfig(), tiny_world.world_from_camera,
        Silent(),
    )  # fmt: skip
    gravity = gravity_in_camera(tiny_world.world_from_camera.matrix)
    return Scene(store, seconds(times_ns), gravity, np.array([0.0, 0.0, 0.03]), Sift())


def sliding(scene: Scene, spin: Array) -> TrajectoryHypothesis:
    """A trajectory that follows the cloud and turns steadily (rad/s, camera axes), whatever the images show: it is not
    refined, only judged."""
    h = started(FRAMES, 0, first_pose(scene.store, 0))
    poses = np.tile(h.poses[0], (FRAMES, 1, 1))
    for i, pose in enumerate(poses):
        pose[:3, :3] = rotation_exp(spin * i * STEP_S) @ pose[:3, :3]
        pose[:3, 3] += scene.store.center_m[i] - scene.store.center_m[0]
    return judged(scene, poses)


def judged(scene: Scene, poses: Array) -> TrajectoryHypothesis:
    """A hypothesis at these poses, not refined."""
    estimated = replace(started(FRAMES, 0, poses[0]), poses=poses, done=tuple(range(FRAMES)))
    graph = replace(TrackConfig().hypotheses.graph, schedule=((0, 1, 0.004, 0.1, 0.004, 0.5),))
    found = refined(scene, estimated, 0, True, replace(TrackConfig().hypotheses, graph=graph))
    return replace(found, joint=replace(found.joint, poses=poses))


def turned(scene: Scene, world_from_camera: Transform, before: Array, after: Array) -> Array:
    """The true poses with spins (rad/s, camera axes) added to those before the impact and after it."""
    poses = np.tile(first_pose(scene.store, 0), (FRAMES, 1, 1))
    camera_from_world = np.linalg.inv(world_from_camera.matrix)
    true = np.stack([camera_from_world @ thrown(i).matrix for i in range(FRAMES)])
    own_from_true = np.linalg.inv(true[0]) @ poses[0]
    for i in range(1, FRAMES):
        added = rotation_exp((before if i <= IMPACT else after) * STEP_S)
        step = true[i] @ np.linalg.inv(true[i - 1])
        poses[i] = step @ poses[i - 1]
        center = (true[i] @ own_from_true)[:3, 3]
        poses[i, :3, :3] = added @ poses[i, :3, :3]
        poses[i, :3, 3] = center
    return poses


def test_windows_find_both_spins_of_an_impact_that_no_hypothesis_has(scene: Scene, tiny_world: Any) -> None:
    wrong = [sliding(scene, np.zeros(3)), sliding(scene, np.array([0.0, 4.0, 0.0]))]
    config = TrackConfig()
    (found,) = through_windows(scene, 0, wrong, config.beam.keyframes, config.windows, config.hypotheses)
    camera = tiny_world.world_from_camera.rotation
    np.testing.assert_array_equal(found.joint.poses[0], wrong[0].joint.poses[0])
    for i in range(1, FRAMES):
        turn = found.joint.poses[i, :3, :3] @ found.joint.poses[0, :3, :3].T
        true = camera.T @ thrown(i).rotation @ thrown(0).rotation.T @ camera
        assert np.degrees(rotation_angle_rad(turn @ true.T)) < 6.0
    assert len(found.estimated.keyframes) > 1


def test_where_all_hypotheses_agree_nothing_is_left_open(scene: Scene) -> None:
    same, config = sliding(scene, np.zeros(3)), TrackConfig()
    for hypotheses in ([same], [same, same]):
        assert through_windows(scene, 0, hypotheses, config.beam.keyframes, config.windows, config.hypotheses) == []


def test_too_few_frames_make_no_window(scene: Scene) -> None:
    wrong, config = [sliding(scene, np.zeros(3)), sliding(scene, np.array([0.0, 4.0, 0.0]))], TrackConfig()
    more = replace(config.windows, frames=FRAMES + 1)
    assert through_windows(scene, 0, wrong, config.beam.keyframes, more, config.hypotheses) == []


def test_the_live_looks_settings_lay_no_windows(scene: Scene) -> None:
    config = light(Config()).track
    wrong = [sliding(scene, np.zeros(3)), sliding(scene, np.array([0.0, 4.0, 0.0]))]
    assert through_windows(scene, 0, wrong, config.beam.keyframes, config.windows, config.hypotheses) == []


@pytest.mark.slow
def test_the_share_that_is_done_grows(scene: Scene) -> None:
    wrong, config = [sliding(scene, np.zeros(3)), sliding(scene, np.array([0.0, 4.0, 0.0]))], TrackConfig()
    told: list[float] = []
    through_windows(scene, 0, wrong, config.beam.keyframes, config.windows, config.hypotheses, told.append)
    assert told[0] == 0.0
    assert told == sorted(told)
    assert 0.6 < told[-1] < 1.0


def test_motions_that_move_the_body_alike_are_one() -> None:
    center, step, far = np.array([0.0, 0.0, 0.8]), np.eye(4), np.eye(4)
    step[:3, 3], far[:3, :3] = [0.0005, 0, 0], rotation_exp(np.array([0.0, 0.1, 0]))
    assert len(_distinct([np.eye(4), step, far], center, WindowConfig())) == 2


def test_linked_motions_pass_through_the_given_pose_and_leave_other_frames_out() -> None:
    steps = [np.eye(4), np.eye(4)]
    steps[0][0, 3], steps[1][:3, :3] = 0.1, rotation_exp(np.array([0.0, 0, 0.5]))
    pose = np.eye(4)
    pose[2, 3] = 0.9
    out = _poses(steps, np.array([0, 2, 3]), 2, pose, 5)
    np.testing.assert_array_equal(out[2], pose)
    np.testing.assert_allclose(steps[0] @ out[0], pose)
    np.testing.assert_allclose(out[3], steps[1] @ pose)
    assert np.isnan(out[[1, 4]]).all()


NONE, WRONG = np.zeros(3), np.array([0.0, 3.0, 2.0])
"""A spin that is wrong by 7 degrees a frame."""


def both_half_wrong(scene: Scene, world: Any) -> list[TrajectoryHypothesis]:
    spins = ((NONE, WRONG), (WRONG, NONE))
    return [judged(scene, turned(scene, world.world_from_camera, *spin)) for spin in spins]


def test_a_crossover_leaves_both_errors_behind(scene: Scene, tiny_world: Any) -> None:
    wrong, config = both_half_wrong(scene, tiny_world), TrackConfig()
    (found,) = crossed(scene, 0, wrong, config.crossover, config.hypotheses)
    assert found.cost < min(h.cost for h in wrong)
    true = turned(scene, tiny_world.world_from_camera, NONE, NONE)
    np.testing.assert_array_equal(found.joint.poses[0], true[0])
    assert max(np.degrees(rotation_angle_rad(a.T @ b)) for a, b in zip(found.joint.poses[:, :3, :3], true[:, :3, :3],
                                                                      strict=True)) < 4.0  # fmt: skip


def test_a_child_is_one_parent_up_to_the_cut_and_moves_as_the_other_from_there_on(
    scene: Scene, tiny_world: Any
) -> None:
    one, other = both_half_wrong(scene, tiny_world)
    other = replace(other, use=np.arange(FRAMES) != IMPACT + 2)
    poses = crossed_at(one, other, IMPACT, 0, one.estimated).estimated.poses
    np.testing.assert_allclose(poses[: IMPACT + 1], one.joint.poses[: IMPACT + 1], atol=1e-12)
    after = [p[IMPACT + 3 :] @ np.linalg.inv(p[IMPACT]) for p in (poses, other.joint.poses)]  # in camera axes
    np.testing.assert_allclose(after[0], after[1], atol=1e-12)
    assert np.flatnonzero(~np.isfinite(poses[:, 0, 0])).tolist() == [IMPACT + 2]
    moved = replace(one.estimated, poses=one.estimated.poses.copy())
    moved.poses[0, :3, :3] = moved.poses[0, :3, :3] @ rotation_exp(np.array([0.1, 0.2, 0.3]))
    np.testing.assert_array_equal(crossed_at(one, other, IMPACT, 0, moved).estimated.poses[0], moved.poses[0])


def test_hypotheses_that_differ_on_one_side_only_are_not_cut(scene: Scene, tiny_world: Any) -> None:
    right, later = (judged(scene, turned(scene, tiny_world.world_from_camera, NONE, s)) for s in (NONE, WRONG))
    config = TrackConfig()
    degrees = config.hypotheses.agreeing_deg
    assert len(cuts_between(right, right, config.crossover, degrees)) == 0
    cuts = cuts_between(right, later, config.crossover, degrees)
    assert all(cut > IMPACT for cut in cuts)  # before the impact they are alike
    first, second = both_half_wrong(scene, tiny_world)
    assert IMPACT in cuts_between(first, second, config.crossover, degrees)


def test_the_live_looks_settings_cross_nothing(scene: Scene, tiny_world: Any) -> None:
    config = light(Config()).track
    assert crossed(scene, 0, both_half_wrong(scene, tiny_world), config.crossover, config.hypotheses) == []
