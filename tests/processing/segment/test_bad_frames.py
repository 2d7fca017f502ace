"""Masks where the recording is bad: wrong masks, light, a camera that moves, other things that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from processing.given_masks import chosen_masks
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.moving_camera import refuse_moving_camera
from processing.segment.background.segmenter import BackgroundSegmenter
from processing.segment.background.static_scene import StaticScene, exposure_gain
from recordings.errors import BadInput
from recordings.progress import Silent
from recordings.records import RgbdFrame

COUNT = 12


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


def segment(
    world: Any, scene: StaticScene, frames: Sequence[RgbdFrame], given: dict[int, np.ndarray]
) -> tuple[list[Any], dict[str, int]]:
    segmenter = BackgroundSegmenter(scene, world.camera, BackgroundSettings())
    found = sorted(segmenter.masks(frames, given, None, None, Silent()), key=lambda m: m.position)
    return found, segmenter.counts


def brighter(frame: RgbdFrame, gain: float) -> RgbdFrame:
    return replace(frame, color_rgb=np.clip(gain * frame.color_rgb.astype(float), 0, 255).astype(np.uint8))


def test_a_mask_of_the_table_is_refused(tiny_world: Any, scene: StaticScene, toss: Any) -> None:
    wrong = np.zeros_like(toss[1][0])
    wrong[80:100, 100:140] = True
    assert not (wrong & toss[1][0]).any()
    with pytest.raises(BadInput, match="shows the table.*--masks none"):
        segment(tiny_world, scene, toss[0], {0: wrong})


def test_exposure_that_drifts_by_40_percent_costs_little(tiny_world: Any, scene: StaticScene, toss: Any) -> None:
    frames = [brighter(f, 1 + 0.4 * np.sin(i)) for i, f in enumerate(toss[0])]
    found, counts = segment(tiny_world, scene, frames, {0: toss[1][0]})
    assert min(iou(m.mask, t) for m, t in zip(found, toss[1])) > 0.9
    assert counts["badly_exposed"] == 0


@pytest.mark.parametrize("gain", [0.02, 20.0])
def test_a_black_and_a_white_frame_are_followed_by_depth_and_counted(
    tiny_world: Any, scene: StaticScene, toss: Any, gain: float
) -> None:
    frames = [brighter(f, gain) if i in (4, 5) else f for i, f in enumerate(toss[0])]
    found, counts = segment(tiny_world, scene, frames, {0: toss[1][0]})
    assert counts["badly_exposed"] == 2
    assert min(iou(m.mask, t) for m, t in zip(found, toss[1])) > 0.85


def test_the_gain_of_a_frame_is_measured_on_the_scene(scene: StaticScene, toss: Any) -> None:
    gain, clipped = exposure_gain(brighter(toss[0][3], 0.7), scene)
    assert gain == pytest.approx(0.7, abs=0.02)
    assert clipped == 0


def test_something_else_that_moves_is_counted(tiny_world: Any, scene: StaticScene, toss: Any) -> None:
    frames = list(toss[0])
    for i in (6, 7, 8):
        color, depth = frames[i].color_rgb.copy(), frames[i].depth_m.copy()
        color[100:118, 10 + 5 * i : 40 + 5 * i] = (20, 90, 20)
        depth[100:118, 10 + 5 * i : 40 + 5 * i] -= 0.1
        frames[i] = replace(frames[i], color_rgb=color, depth_m=depth)
    found, counts = segment(tiny_world, scene, frames, {0: toss[1][0]})
    assert counts["others_moving"] == 3
    assert min(iou(m.mask, t) for m, t in zip(found, toss[1])) > 0.9


def test_a_hidden_object_gives_empty_masks_and_is_found_again(tiny_world: Any, scene: StaticScene, toss: Any) -> None:
    frames = list(toss[0])
    for i in (5, 6):  # a board is held before it, over most of the picture
        color, depth = np.full_like(frames[i].color_rgb, 60), np.full_like(frames[i].depth_m, 0.25)
        frames[i] = replace(frames[i], color_rgb=color, depth_m=depth)
    found, _ = segment(tiny_world, scene, frames, {0: toss[1][0]})
    assert max(m.confidence for m in found[5:7]) < 0.7
    assert iou(found[-1].mask, toss[1][-1]) > 0.9


def test_a_camera_that_is_bumped_by_some_pixels_is_refused() -> None:
    rng = np.random.default_rng(0)
    room = np.kron(rng.integers(0, 255, (30, 40, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    still = [room] * 4
    refuse_moving_camera(still, None)
    with pytest.raises(BadInput, match=r"shifts by up to 3.\d px.*in 2 of 4 frames.*--toss I-J"):
        refuse_moving_camera([room, room, *[np.roll(room, 3, axis=1)] * 2][::-1], None)


def test_a_hand_that_moves_before_a_plain_room_is_not_a_camera_that_moves() -> None:
    rng = np.random.default_rng(0)
    hand = np.kron(rng.integers(0, 255, (12, 24, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    things = np.kron(rng.integers(0, 255, (4, 40, 3)), np.ones((6, 6, 1))).astype(np.uint8)
    rooms = []
    for k in range(4):  # a third of the corners stand still: the room's few things
        room = np.full((180, 240, 3), 120, dtype=np.uint8)
        room[:24] = things
        room[60 + 6 * k : 132 + 6 * k, 40 : 40 + 144] = hand
        rooms.append(room)
    refuse_moving_camera(rooms, None)


def test_given_masks_are_chosen_by_name() -> None:
    given = {3: np.ones((2, 2), bool), 0: np.zeros((2, 2), bool)}
    assert list(chosen_masks(given, "first", first_toss=False)) == [0]
    assert list(chosen_masks(given, "first-toss", first_toss=True)) == [0]
    assert chosen_masks(given, "first-toss", first_toss=False) == {}
    assert sorted(chosen_masks(given, "all", first_toss=False)) == [0, 3]
    assert chosen_masks(given, "none", first_toss=True) == {}
