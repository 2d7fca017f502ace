"""How much a view counts follows from how sure its pose is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from processing.field.learn import SURE_M, LearnConfig, TossViews, _sure_or_all, chosen_views, surface_sigmas_m
from recordings.errors import BadInput
from recordings.geometry import rotation_exp
from recordings.tracks import ObjectTrack, Status


@pytest.fixture
def seen(tiny_world: Any, toss: Any) -> TossViews:
    """The box at its true poses, each sure to .1 mrad and .1 mm."""
    frames, masks = toss
    poses = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in tiny_world.poses(len(frames))])
    status: tuple[Status, ...] = tuple("tracked" for _ in frames)
    times = np.array([f.time_ns for f in frames])
    covariance = np.tile(1e-8 * np.eye(6), (len(frames), 1, 1))
    return TossViews(frames, times, masks, ObjectTrack(0, "d455", "object", times, poses, status, covariance))


def with_doubt(seen: TossViews, frames: list[int], sigma_rad: float) -> TossViews:
    """These frames as guesses whose rotations may be off by this about each axis."""
    covariance, status = seen.track.covariance.copy(), list(seen.track.status)
    for i in frames:
        covariance[i, :3, :3] = sigma_rad**2 * np.eye(3)
        status[i] = "interpolated"
    return replace(seen, track=replace(seen.track, covariance=covariance, status=tuple(status)))


def weights(seen: TossViews, world: Any, alike: bool = False) -> np.ndarray:
    return np.array([view.weight for view in chosen_views([seen], world.camera, LearnConfig(), alike)])


def doubted(pose: np.ndarray, covariance: np.ndarray) -> ObjectTrack:
    status: tuple[Status, ...] = ("tracked",)
    return ObjectTrack(0, "d455", "object", np.zeros(1, np.int64), pose[None], status, covariance[None])


def test_the_surface_is_as_far_off_along_its_normals_as_poses_drawn_from_the_covariance_put_it(
    tiny_world: Any, toss: Any
) -> None:
    rng = np.random.default_rng(3)
    pose = (tiny_world.world_from_camera.inverse() @ tiny_world.poses(1)[0]).matrix
    points_m = rng.normal(size=(50, 3)) * (0.05, 0.02, 0.03) + (0.01, 0.06, -0.02)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    root = rng.normal(size=(6, 6)) * np.r_[np.full(3, 0.01), np.full(3, 0.001)][:, None]
    track = doubted(pose, root @ root.T)
    moved_m2 = []
    for error in rng.normal(size=(4000, 6)) @ root.T:
        turned = rotation_exp(error[:3]) @ pose[:3, :3]
        moved = points_m @ (turned - pose[:3, :3]).T + error[3:]
        moved_m2.append(np.mean(np.sum(moved * (normals @ pose[:3, :3].T), axis=1) ** 2))
    surface = np.stack([points_m, normals], axis=1)
    found = surface_sigmas_m([(track, 0)], surface)[0]
    assert found == pytest.approx(np.sqrt(3 * np.mean(moved_m2)), rel=0.03)
    unknown = replace(track, covariance=np.full((1, 6, 6), np.nan))
    assert surface_sigmas_m([(unknown, 0)], surface)[0] == 0.0


def test_a_cylinders_turn_about_its_axis_is_no_doubt_about_its_surface() -> None:
    angle, height = np.random.default_rng(4).uniform((0, -0.1), (2 * np.pi, 0.1), (500, 2)).T
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(500)], axis=1)
    surface = np.stack([0.03 * normals + height[:, None] * [0, 0, 1], normals], axis=1)
    about = [doubted(np.eye(4), np.diag([*(w * np.eye(3)[a]), 0, 0, 0])) for a, w in ((2, 4.0), (0, 0.01))]
    along, across = surface_sigmas_m([(track, 0) for track in about], surface)
    assert along < 1e-9
    assert across == pytest.approx(np.sqrt(3 * 0.01 * np.mean((height * normals[:, 1]) ** 2)))


def test_sure_views_count_wholly_and_guesses_by_how_far_off_they_may_be(tiny_world: Any, seen: TossViews) -> None:
    np.testing.assert_allclose(weights(seen, tiny_world), 1.0, atol=0.002)
    doubtful = with_doubt(seen, [1, 3], sigma_rad=1.0)
    found = weights(doubtful, tiny_world)
    assert (found[[1, 3]] < 0.02).all()
    np.testing.assert_allclose(np.delete(found, [1, 3]), 1.0, atol=0.002)
    np.testing.assert_array_equal(weights(doubtful, tiny_world, alike=True), 1.0)


def test_a_view_that_may_be_off_by_what_depth_errs_counts_half(tiny_world: Any, seen: TossViews) -> None:
    off = seen.track.covariance.copy()
    off[2] = np.diag([0.0] * 3 + [SURE_M**2 / 3] * 3)
    found = weights(replace(seen, track=replace(seen.track, covariance=off)), tiny_world)
    assert found[2] == pytest.approx(0.5)


def test_where_all_are_guesses_nothing_is_learned_unless_they_are_taken_alike(tiny_world: Any, seen: TossViews) -> None:
    lost = with_doubt(seen, list(range(len(seen.track.status))), sigma_rad=100.0)
    with pytest.raises(BadInput, match="no frame has a pose that is sure"):
        chosen_views([lost], tiny_world.camera, LearnConfig())
    assert len(chosen_views([lost], tiny_world.camera, LearnConfig(), alike=True)) == len(seen.frames)


def test_frames_that_are_called_tracked_and_claim_nothing_are_learned_from_alike(
    tiny_world: Any, seen: TossViews
) -> None:
    lost = with_doubt(seen, list(range(len(seen.track.status))), sigma_rad=100.0)
    called = replace(lost, track=replace(lost.track, status=seen.track.status))
    for toss, sure in ((seen, True), (lost, False), (called, False)):
        views, found = _sure_or_all([toss], tiny_world.camera, LearnConfig())
        assert found == sure
        assert len(views) == len(seen.frames)
        np.testing.assert_allclose([view.weight for view in views], 1.0, atol=0.002)
