"""Trajectory hypotheses: which views are compared, the appearance likelihood ratio of two, depth's motion from pose to
pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import processing.track.pairs as pairs_module
from processing.features.sift import Sift
from processing.motion.interpolate import carried_on
from processing.track.appearance_ratio import AppearanceRatioConfig, log_likelihood_ratio
from processing.track.beam import Hypothesis, Scene, seconds
from processing.track.hypotheses import HypothesisConfig, TrajectoryHypothesis, own_cost
from processing.track.joint_refinement import GraphConfig, Motion, Refined, choose_pairs
from processing.track.pairs import KnownFigures
from processing.track.schedule import rows
from processing.track.track_toss import TrackConfig, views_of
from recordings.geometry import rotation_exp
from recordings.progress import Silent

ONE_COLOR = np.tile([[90, 160, 110]], (6, 1))
SIZE_M = np.array([0.09, 0.07, 0.07])


def turning(angles_deg: list[float]) -> np.ndarray:
    """Poses half a metre before the camera, turned about its vertical axis."""
    poses = np.tile(np.eye(4), (len(angles_deg), 1, 1))
    poses[:, 2, 3] = 0.5
    for pose, angle in zip(poses, angles_deg):
        pose[:3, :3] = rotation_exp(np.array([0, np.radians(angle), 0]))
    return poses


def loops_of(view: int, pairs: np.ndarray) -> set[int]:
    return {int(j) for i, j in pairs if i == view and abs(i - j) > 2}


def pairs_of(angles_deg: list[float], still: list[int]) -> np.ndarray:
    n = len(angles_deg)
    stands = np.isin(np.arange(n), still)
    return choose_pairs(
        turning(angles_deg), np.ones(n, dtype=bool), np.zeros(n, dtype=np.int64), np.zeros(3), stands, GraphConfig()
    )


def test_a_body_that_stands_still_is_compared_with_what_it_showed_before_and_after() -> None:
    angles, still = [0.0] * 12 + [20.0, 40.0, 35.0, 10.0], list(range(1, 12))
    assert loops_of(0, pairs_of(angles, still)) == {12, 13, 14, 15}
    assert loops_of(0, pairs_of(angles, [])) & set(range(12))


def test_views_are_compared_over_wide_turns_only_where_near_ones_are_few() -> None:
    chain = [0.0, 55.0, 100.0, 140.0, 180.0, 220.0, 260.0, 305.0]
    assert loops_of(0, pairs_of(chain, [])) == {7}  # 55 degrees away, the other way round
    near = [0.0, 55.0, 100.0, 140.0, 180.0, 10.0, 220.0, 260.0, 20.0, 240.0]
    assert loops_of(0, pairs_of(near, [])) == {5, 8}


@pytest.mark.parametrize("delay_s", [-0.012, 0.016])
def test_depths_motion_goes_on_changing_as_it_did(delay_s: float) -> None:
    center, step_s = np.array([0.02, -0.01, 0.03]), 1 / 30

    def at(t: float) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3] = rotation_exp(np.array([0, 0, 5 * t + 20 * t * t]))  # a growing spin about one axis
        pose[:3, 3] = np.array([0.4 * t, 0.1, 0.8]) + np.array([0, 2, -3]) * t * t - pose[:3, :3] @ center
        return pose

    three = np.stack([at(-2 * step_s), at(-step_s), at(0.0)])
    moved = carried_on(three, np.array([-2, -1, 0]) * step_s, delay_s, center) @ at(0.0)
    np.testing.assert_allclose(moved, at(delay_s), atol=1e-6)


def test_depths_motion_beyond_an_impact_is_that_after_it() -> None:
    three = turning([0.0, 0.0, 10.0])
    three[2, 0, 3] = 0.04
    moved = carried_on(three, np.array([0, 1, 2]) / 30, 1 / 60, np.zeros(3))
    np.testing.assert_allclose(
        moved @ three[2], turning([15.0])[0] + 0.06 * np.eye(4)[:, :1] @ np.eye(4)[3:], atol=1e-6
    )


def seen_turning(world: Any, faces_rgb: np.ndarray) -> tuple[Scene, np.ndarray]:
    """A nearly square bar on its way over the table, turned about its long axis, and its true poses."""
    frames, masks, poses = [], [], []
    camera_from_world = world.world_from_camera.inverse()
    for i, angle in enumerate([0.0, 15.0, 30.0, 45.0, 60.0, 75.0, 90.0]):
        pose = world.poses(9)[i]
        turn = rotation_exp(np.array([np.radians(angle), 0, 0]))
        pose = type(pose)("world", "object", turn, pose.translation_m)
        frame, mask = world.see(pose, i, box_m=SIZE_M, faces_rgb=faces_rgb)
        frames.append(frame)
        masks.append(mask)
        poses.append((camera_from_world @ pose).matrix)
    store, times_ns, _ = views_of(
        frames, masks, world.camera, np.ones(7), TrackConfig(), world.world_from_camera, Silent()
    )
    return Scene(store, seconds(times_ns), np.zeros(3), np.zeros(3), Sift()), np.stack(poses)


@pytest.mark.parametrize("label", [True, False])
def test_a_label_decides_a_quarter_turn_of_a_square_bar_and_plain_paint_does_not(tiny_world: Any, label: bool) -> None:
    faces = ONE_COLOR.copy()
    faces[4 if label else 0] = ONE_COLOR[0] + [60, -60, 60] if label else ONE_COLOR[0]
    scene, poses = seen_turning(tiny_world, faces)
    flipped = poses.copy()
    flipped[4:, :3, :3] = poses[4:, :3, :3] @ rotation_exp(np.array([np.pi / 2, 0, 0]))
    use, config = np.ones(len(poses), dtype=bool), AppearanceRatioConfig()
    nats = log_likelihood_ratio(scene, poses, flipped, use, config)
    assert nats == pytest.approx(-log_likelihood_ratio(scene, flipped, poses, use, config))
    assert nats > 3 if label else nats == 0


def held_at(scene: Scene, poses: np.ndarray, drawn: int = 0) -> TrajectoryHypothesis:
    """The frames at these poses, and after them so many views of a shape."""
    n, yes, none = len(poses), np.ones(len(poses), dtype=bool), np.full(len(poses), np.nan)
    views = n + drawn
    times_s, toss = np.zeros(views), np.maximum(np.arange(views) - n + 1, 0)
    times_s[:n] = scene.times_s
    posed, fixed = np.concatenate([poses, poses[:drawn]]), np.arange(views) >= n
    joint = Refined(posed, np.zeros((views, 6, 6)), np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)))
    motion = Motion(times_s, toss, np.zeros(3), np.zeros(3), np.zeros(views, dtype=bool))
    estimated = Hypothesis(poses, none, none, tuple(range(n)), (0,), 0.0)
    return TrajectoryHypothesis(estimated, yes, fixed, joint, np.zeros(3), motion, 0.0, np.full(n, -1))


def test_frames_of_which_a_part_is_turned_against_the_rest_cost_their_pairs_more(tiny_world: Any) -> None:
    faces_rgb = np.array([[200, 60, 60], [60, 200, 60], [60, 60, 200], [200, 200, 60], [60, 200, 200], [200, 60, 200]])
    scene, poses = seen_turning(tiny_world, faces_rgb)
    turned = poses.copy()
    turned[4:, :3, :3] = poses[4:, :3, :3] @ rotation_exp(np.array([np.radians(45), 0, 0]))
    right, wrong = (own_cost(scene, held_at(scene, p), HypothesisConfig()) for p in (poses, turned))
    assert 0 < right < wrong - 0.05


def test_a_drawn_shape_takes_no_part_in_what_the_frames_own_pairs_cost(tiny_world: Any) -> None:
    scene, poses = seen_turning(tiny_world, ONE_COLOR)
    alone, on_shape = (own_cost(scene, held_at(scene, poses, drawn), HypothesisConfig()) for drawn in (0, 2))
    assert alone == on_shape > 0


def test_pairs_that_lie_to_each_other_as_others_did_are_compared_once(
    tiny_world: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, poses = seen_turning(tiny_world, ONE_COLOR)
    pairs = np.array([(0, 1), (1, 0), (1, 2), (4, 6)])
    row = rows(HypothesisConfig().graph.schedule, 0.5)[-1]
    asked: list[int] = []

    compared = pairs_module.compared

    def counted(store: Any, at: Any, some: np.ndarray, *more: Any, **kinds: Any) -> Any:
        asked.append(len(some))
        return compared(store, at, some, *more, **kinds)

    monkeypatch.setattr(pairs_module, "compared", counted)
    known = KnownFigures()
    first = known.of(scene.store, poses, pairs, row)
    elsewhere = poses @ turning([25.0])[0]  # all of it in another object frame
    second = known.of(scene.store, elsewhere, pairs, row)
    part = elsewhere.copy()
    part[3:] = part[3:] @ turning([5.0])[0]  # as a child of two parents, of which one pair reaches over the cut
    known.of(scene.store, part, np.concatenate([pairs, [(2, 3)]]), row)
    assert asked == [4, 1]
    np.testing.assert_array_equal(second, first)
    np.testing.assert_array_equal(first, compared(scene.store, poses, pairs, row, True)[2])
