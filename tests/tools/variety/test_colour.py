"""The pinhole canvas, crops, tone and files of the colour camera."""

import cv2
import numpy as np
import pytest
from variety import camera, colour, scene, seeds, spec

from recordings.geometry import CameraModel

K = np.array([[400.0, 0, 320.5], [0, 400.0, 180.0], [0, 0, 1.0]])
BENT = CameraModel("d455", 640, 360, K, "brown-conrady", (-0.1, 0.05, 5e-4, -5e-4, 0.0))


def test_every_pixel_of_a_bent_lens_lies_inside_the_canvas_where_its_ray_meets_it():
    canvas = colour.Canvas.of(BENT)
    for x, y in ((0, 0), (639, 0), (639, 359), (317, 200)):
        ray = BENT.rays(np.array([[x, y]], float))[0]
        assert canvas.map_x[y, x] == pytest.approx(canvas.focal_px * ray[0] / ray[2] + canvas.cx, abs=1e-3)
        assert canvas.map_y[y, x] == pytest.approx(canvas.focal_px * ray[1] / ray[2] + canvas.cy, abs=1e-3)
    assert canvas.map_x.min() >= 3
    assert canvas.map_x.max() <= canvas.width - 3
    assert canvas.map_y.min() >= 3
    assert canvas.map_y.max() <= canvas.height - 3


def test_a_box_holds_the_points_it_is_around_and_there_is_none_behind_the_camera():
    canvas = colour.Canvas.of(BENT)
    points = np.array([[-0.1, 0.0, 1.0], [0.1, 0.1, 1.2]])
    x0, y0, x1, y1 = canvas.box_of(points)
    for x, y, z in points:
        assert x0 <= canvas.focal_px * x / z + canvas.cx <= x1
        assert y0 <= canvas.focal_px * y / z + canvas.cy <= y1
    assert canvas.box_of(-points) is None


def test_boxes_that_overlap_become_one_and_others_stay():
    assert sorted(colour.together([(0, 0, 4, 4), (10, 0, 14, 4), (3, 3, 11, 6)])) == [(0, 0, 14, 6)]
    assert sorted(colour.together([(0, 0, 4, 4), (4, 0, 8, 4)])) == [(0, 0, 4, 4), (4, 0, 8, 4)]


def test_the_tone_curve_grows_and_stays_between_black_and_white():
    light = np.linspace(-0.1, 20, 5000).astype(np.float32)
    shown = camera.tone(light)
    assert (np.diff(shown) >= 0).all()
    assert shown.min() >= 0
    assert 0.99 < shown.max() <= 1
    assert camera.tone(np.array([0.2140], np.float32))[0] == pytest.approx(0.5, abs=1e-3)  # sRGB: 0.5 is 0.2140


def told(**changed):
    from dataclasses import replace

    c = spec.draw(seeds.Case("choose", 3, 0)).camera
    calm = replace(c, vignette=0.0, blur_px=0.0, noise=0.0, gain_drift=0.0, white_drift=0.0)
    return replace(calm, **changed)


def develop(of, frame=0, light=None):
    flat = np.full((of.height, of.width, 3), 0.3, np.float32) if light is None else light
    made = camera.ColorCamera(of, flat, np.arange(5) / 5.0, np.random.default_rng(0))
    return made.develop(flat, frame, np.random.default_rng(1)).astype(float)


def test_vignetting_darkens_the_corners_by_what_is_told():
    picture = develop(told(vignette=0.3))
    middle, corner = (
        ((p / 255 + 0.055) / 1.055) ** 2.4
        for p in (picture[picture.shape[0] // 2, picture.shape[1] // 2, 0], picture[0, 0, 0])
    )
    assert corner / middle == pytest.approx(0.7, abs=0.02)


def test_exposure_and_white_balance_wander_over_the_frames():
    drifting, tinted = told(gain_drift=0.3), told(white_drift=0.06)
    assert np.ptp([develop(drifting, k).mean() for k in range(5)]) > 3
    shades = np.array([develop(tinted, k).mean(axis=(0, 1)) for k in range(5)])
    assert np.ptp(shades[:, 0] / shades[:, 2]) > 0.005


def test_a_shorter_exposure_is_noisier():
    long, short = (develop(told(noise=1.0, exposure_s=e)).std() for e in (0.012, 0.0015))
    assert short > 2 * long


def test_a_jpeg_of_lower_quality_is_smaller_and_further_off():
    picture = (255 * np.random.default_rng(0).random((120, 160, 3))).astype(np.uint8)
    good, bad = camera.jpeg(picture, 95), camera.jpeg(picture, 60)
    assert len(bad) < len(good)
    off = [
        np.abs(cv2.imdecode(np.frombuffer(d, np.uint8), 1)[..., ::-1].astype(int) - picture).mean() for d in (good, bad)
    ]
    assert off[0] < off[1]


def test_a_small_object_is_looked_at_from_nearer():
    of = told()
    near, far = (scene.world_from_camera(of, size).translation_m for size in (0.04, 0.2))
    assert np.linalg.norm(near - [0, 0, scene.AIM_HEIGHT_M]) < np.linalg.norm(far - [0, 0, scene.AIM_HEIGHT_M])
