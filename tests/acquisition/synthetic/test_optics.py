"""Pictures agree with geometry: depth of a plane, outlines, blur, shadows, lens distortion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from acquisition.synthetic.lab import Lab
from acquisition.synthetic.random_draws import exposure_times
from acquisition.synthetic.render.optics import jitters, picture, render_g_buffer


def outline(lab, motion, time_s):
    """The pixels whose centre lies in the hull of the cube's projected corners."""
    corners = (lab.d455.camera_from_world @ motion.object.at(time_s)).points(lab.solid.vertices_m)
    hull = cv2.convexHull(lab.d455.camera.project(corners).astype(np.float32))[:, 0]
    v, u = np.mgrid[: lab.d455.camera.height, : lab.d455.camera.width]
    along = np.roll(hull, -1, axis=0) - hull
    sides = [dx * (v - y) - dy * (u - x) for (x, y), (dx, dy) in zip(hull, along)]
    return np.all(np.array(sides) >= 0, axis=0) | np.all(np.array(sides) <= 0, axis=0)


def overlap(a, b):
    return (a & b).sum() / (a | b).sum()


def test_the_table_lies_at_the_depth_of_its_plane(lab):
    points = lab.still.points_m
    on_table = (np.abs(points[..., 2]) < 1e-4) & (np.abs(points[..., :2]).max(axis=-1) < 0.5)
    assert on_table.mean() > 0.3
    origin, rays = lab.d455.origin_m, lab.d455.camera.pixel_rays() @ lab.world_from_d455.rotation.T
    expected = -origin[2] / rays[..., 2]
    np.testing.assert_allclose(lab.still.depth_m[on_table], expected[on_table], rtol=1e-5)


def test_the_true_mask_is_the_projected_cube(lab, motion):
    for time_s in (0.0, motion.instants.release_s, motion.instants.first_impact_s, motion.instants.end_s):
        assert overlap(lab.g_buffer(motion, time_s).mask([0]), outline(lab, motion, time_s)) > 0.995


def test_the_exact_depth_is_the_objects_surface(lab, motion):
    time_s = motion.instants.first_impact_s - 0.05
    seen = lab.g_buffer(motion, time_s)
    rows, columns = np.nonzero(seen.mask([0]))
    pixels = np.stack([columns, rows], -1).astype(np.float64)
    points = lab.d455.camera.back_project(pixels, seen.depth_m[rows, columns].astype(np.float64))
    inside = (lab.d455.camera_from_world @ motion.object.at(time_s)).inverse().points(points)
    np.testing.assert_allclose(np.abs(inside).max(axis=1), 0.0524, atol=1e-5)


def test_the_picture_shows_the_object_where_the_mask_is(lab, motion):
    time_s = motion.instants.first_impact_s - 0.05
    light = picture(
        lab.d455, lab.still, lab.light, lambda t: lab.placed(motion, t), [time_s] * 4, np.random.default_rng(0)
    )
    changed = np.abs(light - lab.still.radiance).max(axis=-1) > 1e-6
    mask = lab.g_buffer(motion, time_s).mask([0])
    assert changed[mask].mean() > 0.99
    # elsewhere only its shadow changes, and only to darker
    outside = ~cv2.dilate(mask.astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert (light[outside] <= lab.still.radiance[outside] + 1e-6).all()
    shadow = outside & changed
    assert 20 < shadow.sum() < 20 * mask.sum()
    assert np.abs(lab.still.points_m[shadow][:, 2]).max() < 0.31


@pytest.mark.parametrize("exposure_s", [0.001, 0.016])
def test_blur_grows_with_the_exposure_as_the_motion_says(lab, motion, exposure_s):
    time_s = motion.instants.release_s
    times = exposure_times(time_s, exposure_s, 16)
    assert np.ptp(times) == pytest.approx(exposure_s * 15 / 16)
    blurred = picture(lab.d455, lab.still, lab.light, lambda t: lab.placed(motion, t), times, np.random.default_rng(0))
    swept = np.logical_or.reduce([lab.g_buffer(motion, t).mask([0]) for t in times])
    always = np.logical_and.reduce([lab.g_buffer(motion, t).mask([0]) for t in times])
    speed_px = 0.9 * lab.d455.camera.fx / 0.8
    ring = (swept & ~always).sum() / np.sqrt(always.sum())
    assert ring < 12 * exposure_s * speed_px + 1
    if exposure_s > 0.01:
        assert ring > 1
    assert np.isfinite(blurred).all()


def test_the_mean_of_the_jitters_is_the_pixels_centre():
    offsets = np.array(jitters(8))
    np.testing.assert_allclose(offsets.mean(axis=0), 0, atol=1e-9)
    assert np.abs(offsets).max() < 0.6


def test_lens_distortion_bends_mask_and_depth_alike(altered):
    lab = Lab(altered(camera={"distortion": (-0.2, 0.06, 0.001, -0.001, 0.0)}))
    motion = lab.plan(0)
    assert lab.d455.camera.distortion_model == "brown-conrady"
    assert overlap(lab.g_buffer(motion, 0.0).mask([0]), outline(lab, motion, 0.0)) > 0.97


def test_things_that_stand_in_front_hide_the_object(arm_lab):
    motion = arm_lab.plan(0)
    held = arm_lab.g_buffer(motion, 0.0)
    alone = held.mask([0])
    assert alone.sum() > 0
    only_object = arm_lab.placed(motion, 0.0)[:1]
    assert render_g_buffer(arm_lab.d455, arm_lab.still, only_object).mask([0]).sum() >= alone.sum()
    assert (held.owner > 0).sum() > 500
