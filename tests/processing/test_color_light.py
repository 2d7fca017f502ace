"""The room's light is told from what is painted on a body that turns in it. Laws: a known light is found again, and
taken out; pale paint then counts as much as strong paint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.sensor import view_layout as lay
from processing.sensor.color_light import LIGHT_SIGMA, MOST_GAIN, USUAL_CONTRAST, ColorLight
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig, cut
from processing.sensor.view_store import ViewStore
from recordings.geometry import CameraModel, rotation_exp
from recordings.records import RgbdFrame

CAMERA = CameraModel("d455", 160, 120, np.array([[150.0, 0, 80], [0, 150.0, 60], [0, 0, 1]]))
LAMP = np.array([[0.05, -0.02], [-0.06, 0.03], [0.04, 0.05]])
"""Change of the two differences of colour along the normal's x, y, z."""


def ball(turn: np.ndarray, paint: float, lamp: float = 1.0, count: int = 400, seed: int = 0) -> np.ndarray:
    """Samples of a painted ball that has turned so far: patches of it, in its own frame, have another colour."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals[:, 2] = -np.abs(normals[:, 2])
    own = normals @ turn
    stripes = np.sign(np.sin(6 * own[:, 0]) * np.sin(5 * own[:, 1] + 1))
    out = np.zeros((count, lay.SAMPLE), np.float32)
    out[:, lay.SNX : lay.SNZ + 1] = normals
    colors = 0.3 + paint * stripes[:, None] * [1.0, -0.7] + lamp * normals @ LAMP
    for level in (0, 1):
        first = lay.SSHARP + level * lay.APPEARANCE
        out[:, first + 1 : first + lay.APPEARANCE] = colors
    return out


def turns(count: int = 40) -> list[np.ndarray]:
    return [rotation_exp(np.random.default_rng(i).normal(size=3)) for i in range(count)]


def colors_of(samples: np.ndarray) -> np.ndarray:
    return samples[:, lay.SSHARP + lay.APPEARANCE + 1 : lay.SSHARP + 2 * lay.APPEARANCE]


def test_the_light_of_the_room_is_told_from_paint_that_turns_in_it() -> None:
    light = ColorLight.of([ball(turn, 0.02, seed=i) for i, turn in enumerate(turns(200))])
    even = ball(np.eye(3), 0.0)
    before = colors_of(even).std(0)
    replace(light, gain=1.0).paint(even, lay.SNX, lay.SSHARP)
    assert (colors_of(even).std(0) < 0.1 * before).all()


def test_what_is_left_is_the_paint_at_the_usual_contrast() -> None:
    views = [ball(turn, 0.07, seed=i) for i, turn in enumerate(turns(200))]
    light = ColorLight.of(views)
    assert 1.0 < light.gain < MOST_GAIN
    plain = [ball(turn, 0.07, lamp=0.0, seed=i) for i, turn in enumerate(turns(200))]
    for view, paint in zip(views, plain):
        light.paint(view, lay.SNX, lay.SSHARP)
        off = colors_of(view) - light.gain * colors_of(paint)
        assert (off - off.mean(0)).std() < 0.1 * USUAL_CONTRAST
    assert np.sqrt(np.median([colors_of(v).var(0) for v in views], axis=0).mean()) == pytest.approx(
        USUAL_CONTRAST, rel=0.05
    )


def test_strong_paint_is_not_raised_and_a_plain_body_is_not_made_a_pattern_of_its_light() -> None:
    assert ColorLight.of([ball(turn, 0.4, seed=i) for i, turn in enumerate(turns())]).gain == 1.0
    views = [ball(turn, 0.001, seed=i) for i, turn in enumerate(turns())]
    light = ColorLight.of(views)
    before = np.mean([colors_of(v).std() for v in views])
    for view in views:
        light.paint(view, lay.SNX, lay.SSHARP)
    assert light.gain == MOST_GAIN
    assert np.mean([colors_of(v).std(0).max() for v in views]) < 0.15 * USUAL_CONTRAST < before


def test_few_views_say_little_of_the_light() -> None:
    one = ColorLight.of([ball(np.eye(3), 0.3, lamp=0.0)])
    assert np.abs(one.coefficients).max() < LIGHT_SIGMA
    assert ColorLight.of([]).gain == 1.0
    even = ball(np.eye(3), 0.0, lamp=0.0)
    assert not ColorLight.of([even]).coefficients.any()


def test_pixels_of_a_foreign_colour_stay_marked() -> None:
    views = [ball(turn, 0.04, seed=i) for i, turn in enumerate(turns(8))]
    views[0][:50, lay.SSHARP :] = lay.NO_APPEARANCE
    light = ColorLight.of(views)
    light.paint(views[0], lay.SNX, lay.SSHARP)
    assert (views[0][:50, lay.SSHARP :] == lay.NO_APPEARANCE).all()


def crop(difference: float, seed: int = 0) -> Crop:
    """A wall half a metre away, painted in squares of two greys that differ in red and green by so much (of 255)."""
    v, u = np.mgrid[:120, :160]
    light = ((u // 8 + v // 8 + seed) % 2) * 2.0 - 1
    color = np.stack([120 + difference * light, 120 - difference * light, np.full(u.shape, 120.0)], -1)
    color += np.random.default_rng(seed).normal(size=color.shape)
    frame = RgbdFrame("d455", 0, 0, 0, color.clip(0, 255).round().astype(np.uint8), np.full(u.shape, 0.5, np.float32))
    made = cut(frame, (abs(u - 80) < 50) & (abs(v - 60) < 40), 0, Rectification.of(CAMERA), 1.0, ViewConfig())
    assert made is not None
    return made


def filled(crops: list[Crop]) -> ViewStore:
    store = ViewStore(Rectification.of(CAMERA), list(crops), ViewConfig())
    assert all(store.fill(i) for i in range(len(store)))
    return store


def test_a_view_made_again_has_the_same_light_taken_out() -> None:
    store = filled([crop(4.0, seed) for seed in range(4)])
    store.take_light_out(3)
    assert store.color_gain > 1.0
    assert not store.light[3].coefficients.any()
    assert store.light[3].gain == store.color_gain
    maps, samples = store.maps.copy(), store.samples.copy()
    assert all(store.fill(i) for i in range(len(store)))
    np.testing.assert_array_equal(store.maps, maps)
    np.testing.assert_array_equal(store.samples, samples)


def test_views_of_two_tosses_are_joined_with_one_gain() -> None:
    body = crop(4.0)
    one, two = filled([body]), filled([body])
    one.light, two.light = [ColorLight.unknown(2.0)], [ColorLight.unknown(3.0)]
    assert one.fill(0)
    assert two.fill(0)
    two.maps[0, lay.SHARP :] = lay.NO_APPEARANCE
    both = ViewStore.joined([one, two])
    half = len(both.maps) // 2
    np.testing.assert_allclose(both.maps[half + 1 :], both.maps[1:half], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(*np.split(both.samples, 2), rtol=1e-5, atol=1e-6)
    assert (both.maps[half, lay.SHARP :] == lay.NO_APPEARANCE).all()
    assert both.light[1].gain == pytest.approx(one.color_gain)
