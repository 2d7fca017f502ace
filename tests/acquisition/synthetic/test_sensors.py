"""A D455's depth errors and a colour sensor's noise: sizes, laws, seeds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from acquisition.synthetic.config import DepthConfig
from acquisition.synthetic.render import sensors
from acquisition.synthetic.render.sensors import DepthSensor, exposed, to_srgb

SHAPE = (240, 320)
Z_M = 0.8
FACING = np.ones(SHAPE, np.float32)
STURDY = np.ones(SHAPE, np.float32)


def sensor(**changes):
    config = replace(DepthConfig(), **changes)
    return DepthSensor(config, SHAPE[1], SHAPE[0], 193.0, np.random.default_rng(1))


def wall(z_m=Z_M):
    return np.full(SHAPE, z_m, np.float32)


def step():
    """A near square before a far wall."""
    depth = wall(1.2)
    depth[80:160, 120:200] = 0.7
    return depth


def measured(depth, seed=0, **changes):
    one = sensor(**changes)
    return one.measure(depth, FACING, STURDY, np.random.default_rng(seed)).astype(np.float64) * one.config.unit_m


def spread(values):
    """Robust standard deviation."""
    return 1.4826 * np.median(np.abs(values - np.median(values)))


def test_the_noise_is_a_disparity_noise():
    for z_m in (0.5, 0.8, 1.2):
        z = measured(wall(z_m), unit_m=1e-4)
        z = z[z > 0]
        # dz = z^2 / (f b) dd: 0.085 px of noise and 1/32 px of quantisation
        expected = z_m**2 / (385 * 0.095) * np.hypot(0.0854, 1 / 32 / np.sqrt(12))
        assert z.std() == pytest.approx(expected, rel=0.15)
        assert z.mean() == pytest.approx(z_m, abs=5e-4)


def test_the_noise_factor_doubles_it():
    once, twice = (measured(wall(), noise=n) for n in (1.0, 2.0))
    assert spread(twice[twice > 0]) / spread(once[once > 0]) == pytest.approx(2, rel=0.1)


def test_half_of_the_variance_is_a_fixed_pattern():
    one = sensor(quantum_px=1e-5, unit_m=1e-4)
    frames = [one.measure(wall(), FACING, STURDY, np.random.default_rng(k)).astype(float) for k in range(2)]
    both = (frames[0] > 0) & (frames[1] > 0)
    a, b = (f[both] - f[both].mean() for f in frames)
    assert np.corrcoef(a, b)[0, 1] == pytest.approx(0.5, abs=0.08)


def test_noise_is_alike_in_neighbouring_pixels_and_not_farther_away():
    z = measured(wall(), quantum_px=1e-5)
    z[z == 0] = np.median(z)
    z -= z.mean()
    assert (z[:, 1:] * z[:, :-1]).mean() / (z * z).mean() > 0.4
    assert abs((z[:, 12:] * z[:, :-12]).mean() / (z * z).mean()) < 0.2


def test_disparities_are_multiples_of_a_thirty_second():
    z = measured(wall(), unit_m=1e-4)
    steps = 385 * 0.095 / z[z > 0] * 32
    assert np.abs(steps - np.round(steps)).max() < 0.15  # the depth unit of 0.1 mm rounds too


def test_the_scale_error_is_a_factor():
    plain, scaled = (np.median(measured(wall(), scale=s, unit_m=1e-4)) for s in (1.0, 1.01))
    assert scaled / plain == pytest.approx(1.01, abs=2e-4)


def test_nothing_comes_back_from_too_near_too_far_and_the_sky():
    for z_m in (0.15, 2.5, np.inf):
        assert (measured(wall(z_m)) == 0).all()


def test_the_pairs_shadow_lies_left_of_what_stands_in_front():
    z = measured(step(), fine_sigma_px=0.0, coarse_sigma_px=0.0)
    rows = slice(90, 150)
    # 385 * 0.095 * (1/0.7 - 1/1.2) px of the sensor, halved at 320 px
    width = 385 * 0.095 * (1 / 0.7 - 1 / 1.2) * 193 / 385
    left, right = z[rows, 105:120] == 0, z[rows, 200:215] == 0
    assert left.sum(axis=1).mean() == pytest.approx(width, abs=3)
    assert right.sum(axis=1).mean() < 2


@pytest.mark.parametrize("preset", ["default", "high-accuracy", "high-density"])
def test_every_preset_leaves_the_inside_of_things_alone(preset):
    z = measured(step(), preset=preset)
    inside = z[90:150, 130:190]
    assert np.abs(inside[inside > 0] - 0.7).max() < 0.01
    assert (inside > 0).mean() > 0.97


def test_a_dense_preset_fattens_edges_and_an_accurate_one_leaves_holes():
    depth, ring = step(), np.zeros(SHAPE, bool)
    ring[76:164, 200:204] = True  # to the right, where no shadow falls
    shares = {p: measured(depth, preset=p)[ring] for p in sensors.MANNERS}
    near = {p: ((z > 0.6) & (z < 0.8)).mean() for p, z in shares.items()}
    valid = {p: (measured(depth, preset=p) > 0).mean() for p in sensors.MANNERS}
    assert near["high-density"] > near["default"] > near["high-accuracy"]
    assert valid["high-density"] > valid["default"] > valid["high-accuracy"]


def test_some_pixels_fly_between_near_and_far():
    z = measured(step(), preset="high-density")
    assert ((z > 0.78) & (z < 1.1)).sum() > 10


def test_surfaces_seen_at_a_grazing_angle_drop_out():
    one = sensor()
    z = one.measure(wall(), np.full(SHAPE, 0.05, np.float32), STURDY, np.random.default_rng(0))
    assert (z == 0).mean() > 0.95


def test_weak_surfaces_are_noisier_and_have_holes():
    one = sensor()
    weak = np.full(SHAPE, 4.0, np.float32)
    z = one.measure(wall(), FACING, weak, np.random.default_rng(0))
    assert (z == 0).mean() > 0.05
    assert spread(z[z > 0]) > 3 * spread(measured(wall())[measured(wall()) > 0] / 0.001)


def test_the_same_seed_gives_the_same_depth_and_another_one_another():
    np.testing.assert_array_equal(measured(step(), 3), measured(step(), 3))
    assert (measured(step(), 3) != measured(step(), 4)).any()


def test_a_shorter_exposure_is_noisier():
    light = np.full((200, 200), 0.2, np.float32)
    noise = [exposed(light, 1.0, s, 1.0, np.random.default_rng(0)).std() for s in (0.001, 0.004, 0.016)]
    assert noise[0] > 1.8 * noise[1] > 3 * noise[2]
    assert noise[1] == pytest.approx(np.sqrt(0.002**2 + 0.0002 * 0.2), rel=0.02)


def test_srgb_has_its_known_values():
    np.testing.assert_allclose(
        to_srgb(np.array([0, 0.0031308, 0.2140, 1], np.float32)), [0, 0.04045, 0.5, 1], atol=1e-3
    )
