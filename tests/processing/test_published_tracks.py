"""What results say of how sure poses are: known answers of a camera whose depth is too long by a known factor, and of
poses on a shape that repeats the errors of those that it was fused from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from processing.pipeline.record import posed_together, sharing
from processing.segment.background.depth_scale import DepthScaleSettings, posterior_sigma
from processing.sensor.noise import FINE, DepthNoise
from processing.stages.recording.every_frame import defining_pose, scaled_by_chance, with_misfit
from processing.store import Done
from processing.track.flags import (
    HELD_SHAPE_DEG,
    SURE_DEG,
    SURE_M,
    camera_covariance,
    published,
    with_drift,
    with_shape_error,
)
from recordings.geometry import rotation_exp
from recordings.results.folder import write_track
from recordings.tracks import ObjectTrack

FRAMES, SIGMA = 12, 0.008


def true_track() -> ObjectTrack:
    """Thrown and turning, half a metre to a metre away; frame 7 is lost."""
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    for i, pose in enumerate(poses):
        pose[:3, :3] = rotation_exp(np.array([0.3, 0.25, -0.1]) * i)
        pose[:3, 3] = [0.02 * i - 0.1, 0.1 - 0.01 * i, 0.5 + 0.04 * i]
    poses[7] = np.nan
    status = tuple("lost" if i == 7 else "tracked" for i in range(FRAMES))
    covariance = np.tile(np.diag([1e-4] * 3 + [1e-6] * 3), (FRAMES, 1, 1))
    return ObjectTrack(0, "d455", "object", np.arange(FRAMES, dtype=np.int64), poses, status, covariance)


def test_the_covariance_grows_by_the_error_that_a_wrong_scale_makes() -> None:
    true, too_long = true_track(), 0.011
    seen = true.camera_from_object.copy()
    seen[:, :3, 3] *= 1 + too_long
    in_first = seen @ np.linalg.inv(seen[0]) @ true.camera_from_object[0]  # in the true object's frame at frame 0
    error_m = in_first[:, :3, 3] - true.camera_from_object[:, :3, 3]
    claimed = scaled_by_chance(replace(true, camera_from_object=seen), seen[0], SIGMA)
    posed = np.flatnonzero(~true.lost)
    grown = claimed.covariance[posed] - true.covariance[posed]
    assert np.linalg.norm(error_m[posed], axis=1).max() > 0.01
    share = SIGMA * (1 + too_long) / too_long  # the claim is made at the seen places
    wanted = share**2 * error_m[posed, :, None] * error_m[posed, None, :]
    np.testing.assert_allclose(grown[:, 3:, 3:], wanted, atol=1e-12)
    assert not grown[:, :3].any()
    np.testing.assert_array_equal(claimed.covariance[0], true.covariance[0])


def test_poses_and_lost_frames_stay_as_they_are() -> None:
    true = true_track()
    claimed = scaled_by_chance(true, true.camera_from_object[0], SIGMA)
    np.testing.assert_array_equal(claimed.camera_from_object, true.camera_from_object)
    np.testing.assert_array_equal(claimed.covariance[7], true.covariance[7])
    nowhere = ObjectTrack.nowhere(0, "d455", true.time_ns)
    np.testing.assert_array_equal(
        scaled_by_chance(nowhere, defining_pose(nowhere, nowhere), SIGMA).covariance, nowhere.covariance
    )


def test_a_toss_in_the_frame_of_another_is_told_from_where_that_one_defined_it() -> None:
    first, too_long = true_track(), 0.011
    poses = first.camera_from_object[::-1].copy()
    poses[:, :3, 3] += [0.15, -0.05, 0.2]
    other = replace(first, toss=1, camera_from_object=poses, status=first.status[::-1])
    seen_first, seen = first.camera_from_object.copy(), poses.copy()
    for scaled in (seen_first, seen):
        scaled[:, :3, 3] *= 1 + too_long
    in_first = seen @ np.linalg.inv(seen_first[0]) @ first.camera_from_object[0]
    error_m = (in_first - poses)[:, :3, 3]
    defined = defining_pose(replace(other, camera_from_object=seen), replace(first, camera_from_object=seen_first))
    claimed = scaled_by_chance(replace(other, camera_from_object=seen), defined, SIGMA * too_long / (1 + too_long))
    posed = ~other.lost
    assert np.linalg.norm(error_m[posed], axis=1).min() > 0.001  # in no frame is it where its own first pose has it
    wanted = SIGMA**2 * error_m[posed, :, None] * error_m[posed, None, :]
    np.testing.assert_allclose((claimed.covariance - other.covariance)[posed, 3:, 3:], wanted, atol=1e-12)


def test_a_frame_of_its_own_is_defined_by_its_own_first_pose() -> None:
    track = true_track()
    alone = replace(track, object_frame="object_toss_01", camera_from_object=track.camera_from_object[::-1].copy(),
                    status=track.status[::-1])  # fmt: skip
    np.testing.assert_array_equal(defining_pose(alone, track), alone.camera_from_object[0])
    np.testing.assert_array_equal(defining_pose(track, ObjectTrack.nowhere(0, "d455", track.time_ns)),
                                  track.camera_from_object[0])  # fmt: skip


def test_the_scales_deviation_is_the_posteriors() -> None:
    settings = DepthScaleSettings(among_cameras=0.01)
    assert posterior_sigma(None, settings) == 0.01
    assert posterior_sigma(0.01, settings) == pytest.approx(0.01 / np.sqrt(2))
    assert posterior_sigma(0.0004, settings) == pytest.approx(0.0004, rel=1e-3)
    assert posterior_sigma(0.0, settings) == 0.0


def test_on_a_shape_a_track_is_as_unsure_as_the_first_passes_that_made_it() -> None:
    """Drawn first passes; the shape lies where they do, and a pose on it where the shape does, in another object
    frame."""
    rng, drawn = np.random.default_rng(2), 4000
    true = true_track()
    twist = np.diag([2e-3, 1e-3, 3e-3, 0.03, 0.05, 0.02]) ** 2  # of the object frame: translation, rotation
    pose, frame_from_own = true.camera_from_object[3], np.eye(4)
    frame_from_own[:3, :3], frame_from_own[:3, 3] = rotation_exp(np.array([0.4, -0.2, 0.9])), [0.05, -0.03, 0.08]
    cov = np.full((FRAMES, 6, 6), np.nan)
    cov[:] = camera_covariance(pose, twist)
    alone = replace(
        true, camera_from_object=np.tile(pose, (FRAMES, 1, 1)), status=("tracked",) * FRAMES, covariance=cov
    )
    on_shape = replace(alone, camera_from_object=np.tile(pose @ frame_from_own, (FRAMES, 1, 1)), covariance=0 * cov)
    errors = np.empty((drawn, 6))
    for k, error in enumerate(rng.multivariate_normal(np.zeros(6), cov[0], size=drawn)):
        turn, shift = error[:3], error[3:]
        lever = (pose @ frame_from_own)[:3, 3] - pose[:3, 3]
        errors[k] = np.r_[turn, shift + rotation_exp(turn) @ lever - lever]
    claimed = with_shape_error(on_shape, alone, held=False).covariance[3]
    scale = np.sqrt(np.outer(claimed.diagonal(), claimed.diagonal()))
    np.testing.assert_allclose(claimed / scale, np.cov(errors.T) / scale, atol=0.08)


def test_what_was_lost_alone_is_as_unsure_as_the_rest_in_the_mean_and_lost_poses_stay_lost() -> None:
    alone = true_track()
    poses = alone.camera_from_object.copy()
    poses[7] = poses[6]
    on_shape = replace(alone, camera_from_object=poses, status=("tracked",) * FRAMES)
    grown = with_shape_error(on_shape, alone, held=False).covariance - on_shape.covariance
    np.testing.assert_allclose(grown[7], grown[np.arange(FRAMES) != 7].mean(axis=0), atol=1e-15)
    still_lost = with_shape_error(alone, alone, held=False)
    np.testing.assert_array_equal(still_lost.covariance[7], alone.covariance[7])
    nowhere = ObjectTrack.nowhere(0, "d455", alone.time_ns)
    assert with_shape_error(alone, nowhere, held=False) is alone


def test_a_toss_that_others_hold_is_no_surer_than_its_shape_and_no_less_sure_by_other_hypotheses() -> None:
    alone = true_track()
    known = ~alone.lost
    sigma_rad = np.where(np.arange(FRAMES) % 2, np.radians(0.4 * HELD_SHAPE_DEG), np.radians(60.0))
    alone = replace(alone, covariance=np.where(known[:, None, None], sigma_rad[:, None, None] ** 2 * np.eye(6), np.nan))
    on_shape = replace(alone, covariance=0 * alone.covariance)
    held, by_itself = (with_shape_error(on_shape, alone, held=h).covariance[known] for h in (True, False))
    turn = np.sqrt(held[:, :3, :3].diagonal(axis1=1, axis2=2))
    np.testing.assert_allclose(
        turn, np.radians(np.where(np.flatnonzero(known) % 2, 0.4, 1.0) * HELD_SHAPE_DEG)[:, None] * np.ones(3)
    )
    np.testing.assert_allclose(by_itself, alone.covariance[known])


def test_a_frame_that_the_shape_explains_worse_than_chance_makes_is_as_much_less_sure() -> None:
    track = true_track()
    posed = np.flatnonzero(~track.lost)
    rng = np.random.default_rng(1)
    rows = np.zeros((len(posed), 6))
    rows[:, 1] = posed
    rows[:, 2:4] = (0.001, 0.08) * np.exp(0.05 * rng.normal(size=(len(posed), 2)))
    rows[2, 3], rows[4, 2] = 0.08 * 1.6, 0.001 * 2.0  # an outline, and depth
    before, after = (np.trace(t.covariance[posed], axis1=1, axis2=2) for t in (track, with_misfit(track, rows)))
    times = np.sqrt(after / before)
    expected = np.ones(len(posed))
    expected[[2, 4]] = 1.6, 2.0
    np.testing.assert_allclose(times, expected, rtol=0.04)
    assert with_misfit(track, rows[:0]) is track


def test_in_coarse_depth_poses_are_as_much_less_sure_as_means_over_it_and_in_fine_depth_no_surer() -> None:
    track = true_track()
    coarse, fine = (DepthNoise(sigma * FINE.sigma_at_1m, 3 * FINE.patch_px).coarseness for sigma in (2, 0.1))
    np.testing.assert_allclose(with_drift(track, coarse, held=False).covariance, 12 * track.covariance)
    np.testing.assert_allclose(with_drift(track, coarse, held=True).covariance, np.cbrt(12) * track.covariance)
    for held in (False, True):
        np.testing.assert_array_equal(with_drift(track, fine, held).covariance, track.covariance)


@pytest.mark.parametrize(
    ("turns", "places", "sure"),
    [((0, 0.9, 0), (0, 0, 0.9), True), ((0, 1.1, 0), (0, 0, 0.1), False), ((0, 0.1, 0), (0, 0, 1.1), False),
     ((0.55,) * 3, (0.55,) * 3, True), ((0.6,) * 3, (0.1,) * 3, False), ((0.1,) * 3, (0.6,) * 3, False)],
)  # fmt: skip
def test_tracked_promises_five_degrees_and_two_centimetres(
    turns: tuple[float, ...], places: tuple[float, ...], sure: bool
) -> None:
    """Shares of the promise about and along each axis: the angle and the distance that are off are over all three."""
    track = true_track()
    covariance = track.covariance.copy()
    covariance[4] = np.diag(np.r_[np.radians(SURE_DEG) * np.array(turns), SURE_M * np.array(places)] ** 2)
    covariance[5] = np.nan  # not known
    said = published(replace(track, covariance=covariance)).status
    assert said[4] == ("tracked" if sure else "interpolated")
    assert [s for i, s in enumerate(said) if i != 4] == [s for i, s in enumerate(track.status) if i != 4]


def test_tosses_hold_each_other_where_they_share_an_object_frame(tmp_path: Path) -> None:
    track, tracks = true_track(), {}
    frames = {0: "object", 1: "object", 2: "object_toss_02", 3: "object"}
    for t, frame in frames.items():
        posed = replace(track, toss=t, object_frame=frame)
        nowhere = replace(ObjectTrack.nowhere(t, "d455", track.time_ns), object_frame=frame)
        (tmp_path / str(t)).mkdir()
        write_track(tmp_path / str(t), nowhere if t == 3 else posed)
        tracks[t] = Done(tmp_path / str(t), f"toss {t}", None, False)
    assert sharing(tracks) == {0, 1}
    assert sharing({t: tracks[t] for t in (0, 2, 3)}) == set()


def test_a_toss_without_a_pose_is_none_of_those_that_the_shape_comes_from(tmp_path: Path) -> None:
    track = true_track()
    for t in (0, 1, 2):
        write_track(tmp_path, replace(track, toss=t) if t != 1 else ObjectTrack.nowhere(1, "d455", track.time_ns))
    alone = {t: Done(tmp_path, f"alone {t}", None, False) for t in range(4)}
    together = Done(tmp_path, "together", None, False)
    assert posed_together({0: together, 1: together, 2: alone[2]}, alone) == [0]
    assert posed_together({0: together, 1: together, 2: together}, alone) == [0, 2]
