"""Disparity, depth, the left-right check, alignment: known answers."""

import cv2
import numpy as np
import pytest
from variety import stereo_depth as stereo

from recordings.geometry import CameraModel, Transform

PRESET = stereo.PRESETS["default"]


def dots(rng, width=stereo.WIDTH + 200):
    picture = cv2.GaussianBlur((rng.random((stereo.HEIGHT, width)) > 0.93).astype(np.float32), (0, 0), 0.8)
    return np.clip(20 + 300 * picture, 0, 255)


def shifted(picture, by_px):
    """What the right imager sees where everything has this disparity."""
    return cv2.warpAffine(picture, np.array([[1.0, 0, -by_px], [0, 1.0, 0]]), picture.shape[::-1])


def pair(by_px, rng):
    wide = dots(rng)
    return (np.round(p[:, 100 : 100 + stereo.WIDTH]).astype(np.uint8) for p in (wide, shifted(wide, by_px)))


@pytest.mark.parametrize("by_px", [12.0, 40.5, 100.25])
def test_a_shifted_picture_has_that_disparity(by_px):
    left, right = pair(by_px, np.random.default_rng(1))
    found = stereo.match(left, right, PRESET)[20:-20, 180:-20]
    assert (found > 0).mean() > 0.95
    assert np.median(found[found > 0]) == pytest.approx(by_px, abs=0.0626)  # a step of 1/16 px


def test_disparities_come_in_sixteenths_of_a_pixel():
    found = stereo.match(*pair(33.3, np.random.default_rng(2)), PRESET)
    steps = 16 * found[found > 0]
    np.testing.assert_array_equal(steps, np.round(steps))


def test_depth_is_focal_length_times_baseline_over_disparity():
    given = np.array([[stereo.FOCAL_PX * 0.095 / 0.8, stereo.NOTHING, 0.0, 1e-4]], np.float32)
    np.testing.assert_allclose(stereo.depth_of(given), [[0.8, 0, 0, 0]], rtol=1e-6)


def test_the_left_right_check_removes_what_the_right_imager_cannot_see():
    """A near block (30 px) before a far wall (10 px): 20 px of wall at its left are hidden from the right."""
    left, right = np.full((4, 200), 10, np.float32), np.full((4, 200), 10, np.float32)
    left[:, 100:140] = 30
    right[:, 70:110] = 30
    found = stereo.left_right_checked(left, right, 1.0)
    assert (found[:, 80:100] == stereo.NOTHING).all()
    assert (found[:, 100:140] == 30).all()
    assert (found[:, 20:80] == 10).all()
    assert (found[:, 140:] == 10).all()


def test_the_left_right_check_knows_no_partner_outside_the_picture():
    left = np.full((1, 20), 10, np.float32)
    assert (stereo.left_right_checked(left, left, 1.0)[0, :10] == stereo.NOTHING).all()


def test_small_islands_are_dropped_and_large_ones_stay():
    disparity = np.full((60, 60), 20.0, np.float32)
    disparity[10:13, 10:13] = 40
    disparity[30:45, 30:45] = 40
    found = stereo.without_speckles(disparity, 60)
    assert (found[10:13, 10:13] == stereo.NOTHING).all()
    assert (found[30:45, 30:45] == 40).all()
    assert found[0, 0] == 20


def test_a_hole_takes_the_value_at_its_left_in_the_dense_preset_only():
    left, right = pair(40.0, np.random.default_rng(3))
    left, right = left.copy(), right.copy()
    left[200:260, 400:460] = right[200:260, 360:420] = 20  # nothing to match
    dense, strict = (
        stereo.match(left, right, stereo.PRESETS[n])[225:235, 425:435] for n in ("high-density", "high-accuracy")
    )
    assert (dense > 0).all()
    assert (strict < 0).all()


def camera(frame, focal=100.0, size=(60, 40)):
    K = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    return CameraModel(frame, *size, K)


def color_from_left(x_m=0.0):
    return Transform("d455", "left", np.eye(3), np.array([x_m, 0.0, 0.0]))


def test_alignment_to_the_same_camera_changes_nothing():
    depth = np.random.default_rng(0).uniform(0.5, 1.5, (40, 60)).astype(np.float32)
    depth[10:20, 10:20] = 0
    there = CameraModel("d455", 60, 40, camera("left").K)
    shrunk = stereo.aligned(depth, camera("left"), there, color_from_left())
    inner = (slice(2, -2), slice(2, -2))
    assert (shrunk[inner] <= depth[inner] + 1e-6)[depth[inner] > 0].all()
    flat = np.full((40, 60), 0.7, np.float32)
    np.testing.assert_allclose(stereo.aligned(flat, camera("left"), there, color_from_left()), 0.7, rtol=1e-6)


def test_where_two_depths_fall_on_one_colour_pixel_the_nearer_wins():
    depth = np.zeros((40, 60), np.float32)
    depth[20, 30], depth[20, 20] = 2.0, 0.5  # 0.1 m to the right: 5 px at 2 m, 20 px at 0.5 m
    depth[20, 35] = 2.0
    found = stereo.aligned(depth, camera("left"), CameraModel("d455", 60, 40, camera("left").K), color_from_left(0.1))
    assert found[20, 40] == pytest.approx(0.5)
    assert found[20, 35] == pytest.approx(2.0)


def test_a_finer_colour_camera_gets_no_holes():
    K = camera("left").K * [[3], [3], [1]]
    found = stereo.aligned(
        np.full((40, 60), 0.8, np.float32), camera("left"), CameraModel("d455", 179, 119, K), color_from_left()
    )
    assert (found > 0).all()


def test_what_is_behind_nothing_stays_empty():
    assert not stereo.aligned(np.zeros((40, 60), np.float32), camera("left"), camera("d455"), color_from_left()).any()


def test_the_spatial_filter_smooths_a_plane_and_keeps_a_step():
    rng = np.random.default_rng(0)
    disparity = np.where(np.arange(80) < 40, 20.0, 30.0)[None] + rng.normal(0, 0.2, (60, 80))
    found = stereo.spatial_filtered(disparity.astype(np.float32), np.float32(0.5), np.float32(1.0))
    assert found[10:-10, 5:30].std() < 0.5 * disparity[10:-10, 5:30].std()
    assert abs(found[:, 39].mean() - 20) < 0.2
    assert abs(found[:, 40].mean() - 30) < 0.2


def test_depth_is_stored_in_the_devices_unit():
    np.testing.assert_array_equal(
        stereo.in_units(np.array([[0.0, 0.5, 0.50012]], np.float32), 0.00025), [[0, 2000, 2000]]
    )
