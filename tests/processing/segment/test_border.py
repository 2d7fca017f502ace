"""The border of a mask where depth is fattened, where a shadow falls and where the object looks like the scene."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from processing.segment.background.follow import BackgroundSettings, follow
from processing.segment.background.foreground import (
    FATTENED_RAD,
    ForegroundSettings,
    grown,
    moved_pixels,
    refine_border,
)
from processing.segment.background.memory import Found as Mask
from processing.segment.background.memory import remember
from processing.segment.background.static_scene import StaticScene
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame

SIZE = (120, 160)
TABLE_M, BODY_M = 0.80, 0.74
WOOD, WHITE = (190.0, 140.0, 90.0), (225.0, 225.0, 220.0)
CAMERA = CameraModel("d455", 160, 120, np.array([[390.0, 0, 80], [0, 390.0, 60], [0, 0, 1]]))
SETTINGS = ForegroundSettings().for_camera(CAMERA)


def wooden_table() -> StaticScene:
    rng = np.random.default_rng(0)
    color = np.array(WOOD, np.float32) * rng.uniform(0.9, 1.1, (*SIZE, 1)).astype(np.float32)
    far = np.full(SIZE, TABLE_M, np.float32)
    noise = np.full(SIZE, 0.0015, np.float32)
    return StaticScene(far, noise, color, np.full(SIZE, 2.0, np.float32), np.ones(SIZE, bool), far)


def body() -> np.ndarray:
    mask = np.zeros(SIZE, np.uint8)
    cv2.ellipse(mask, (80, 60), (28, 18), 20, 0, 360, 1, -1)
    return mask > 0


def picture(scene: StaticScene, color: tuple[float, float, float], fattened_px: int, shade: float | None) -> RgbdFrame:
    """The body above the table; its depth reaches too far outside, and its shadow lies below it."""
    rng, mask = np.random.default_rng(1), body()
    rgb, depth = scene.color_rgb.copy(), scene.depth_m + rng.normal(0, 0.0015, SIZE).astype(np.float32)
    if shade is not None:
        shadow = np.roll(mask, (7, 5), (0, 1))
        rgb[shadow] *= np.float32(shade)
    rgb[mask] = color
    near = grown(mask, fattened_px)
    depth[near] = BODY_M + rng.normal(0, 0.0015, int(near.sum())).astype(np.float32)
    rgb = cv2.GaussianBlur(rgb, (0, 0), 0.6) + rng.normal(0, 2, (*SIZE, 3))
    return RgbdFrame("d455", 0, 0, 0, rgb.clip(0, 255).astype(np.uint8), depth.astype(np.float32))


def overlap(found: np.ndarray) -> float:
    return float((found & body()).sum() / (found | body()).sum())


@pytest.mark.parametrize("shade", [None, 0.8, 0.4, 0.15])
def test_neither_fattened_depth_nor_a_shadow_of_any_darkness_is_the_object(shade: float | None) -> None:
    scene = wooden_table()
    frame = picture(scene, WHITE, 5, shade)
    rough = moved_pixels(frame, scene, SETTINGS)
    assert overlap(rough) < 0.8
    found, _ = refine_border(frame, scene, rough, None, SETTINGS)
    assert overlap(found) > 0.95


def test_an_object_of_the_scenes_colours_has_the_border_that_depth_shows() -> None:
    scene = wooden_table()
    frame = picture(scene, WOOD, 0, None)
    found, _ = refine_border(frame, scene, moved_pixels(frame, scene, SETTINGS), None, SETTINGS)
    assert overlap(found) > 0.93


def test_a_white_label_on_wood_does_not_cost_the_wooden_border() -> None:
    scene = wooden_table()
    frame = picture(scene, WOOD, 0, None)
    color = frame.color_rgb.copy()
    color[52:68, 68:92] = 225
    frame = replace(frame, color_rgb=color)
    found, _ = refine_border(frame, scene, moved_pixels(frame, scene, SETTINGS), None, SETTINGS)
    assert overlap(found) > 0.93


def test_the_border_is_sought_as_far_as_stereo_fattens_in_this_cameras_pixels() -> None:
    sharper = replace(CAMERA, width=320, height=240, K=CAMERA.K * np.array([[2.0], [2.0], [1.0]]))
    assert SETTINGS.band_inside_px == round(FATTENED_RAD * 390)
    assert ForegroundSettings().for_camera(sharper).band_inside_px == round(FATTENED_RAD * 780)
    assert ForegroundSettings().for_camera(None) == ForegroundSettings()


@pytest.mark.parametrize("painted", [True, False])
def test_depth_that_flickers_where_the_scene_looks_as_ever_is_nothing_that_moves(painted: bool) -> None:
    scene, mask = wooden_table(), body()
    frame = picture(scene, WHITE, 0, None)
    depth, color = frame.depth_m.copy(), frame.color_rgb.copy()
    depth[5:25, 5:45] = 0.5
    if painted:
        color[5:25, 5:45] = (30, 60, 200)
    found = follow(
        replace(frame, depth_m=depth, color_rgb=color), scene, remember(None, frame, Mask(mask, 1.0)), None, None,
        BackgroundSettings(),
    )  # fmt: skip
    assert (found.largest_other_px > 500) == painted


def striped_wood(scene: StaticScene) -> StaticScene:
    """Grain whose dark and light stripes lie as far from each other as from a brown object."""
    across = np.sin(np.arange(SIZE[1]) / 2.5).astype(np.float32)[None, :, None]
    return replace(
        scene, color_rgb=np.broadcast_to(np.array(WOOD) * (1 + 0.09 * across), (*SIZE, 3)).astype(np.float32)
    )


@pytest.mark.parametrize("fattened_px", [3, 5])
def test_a_brown_object_on_brown_grain_has_its_own_border(fattened_px: int) -> None:
    """Its colour is within 30 of the scene's at every pixel: what counts is that the scene is known pixel by pixel, and
    the object by its inside."""
    scene = striped_wood(wooden_table())
    frame = picture(scene, (175.0, 130.0, 84.0), fattened_px, None)
    found, _ = refine_border(frame, scene, grown(body(), 4), None, SETTINGS)
    assert overlap(found) > 0.9
