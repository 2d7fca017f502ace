"""What depth's scale leaves open of poses: known answers of a camera whose depth is too long by a known factor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.segment.background.depth_scale import DepthScaleSettings, posterior_sigma
from processing.stages.recording.every_frame import scaled_by_chance
from recordings.geometry import rotation_exp
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
    claimed = scaled_by_chance(replace(true, camera_from_object=seen), SIGMA)
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
    claimed = scaled_by_chance(true, SIGMA)
    np.testing.assert_array_equal(claimed.camera_from_object, true.camera_from_object)
    np.testing.assert_array_equal(claimed.covariance[7], true.covariance[7])
    nowhere = ObjectTrack.nowhere(0, "d455", true.time_ns)
    assert scaled_by_chance(nowhere, SIGMA) is nowhere


def test_the_scales_deviation_is_the_posteriors() -> None:
    settings = DepthScaleSettings(among_cameras=0.01)
    assert posterior_sigma(None, settings) == 0.01
    assert posterior_sigma(0.01, settings) == pytest.approx(0.01 / np.sqrt(2))
    assert posterior_sigma(0.0004, settings) == pytest.approx(0.0004, rel=1e-3)
    assert posterior_sigma(0.0, settings) == 0.0
