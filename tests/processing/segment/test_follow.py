"""One step of following: what a body that spins shows of itself, and what a hand beside it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.segment.background.follow import BackgroundSettings, _is_all_object, follow
from processing.segment.background.foreground import ForegroundSettings, grown
from processing.segment.background.late_depth import LateDepthSettings, at_color_time, way_px
from processing.segment.background.memory import Found, remember
from processing.segment.background.others import things_near
from processing.segment.background.patches import Patches
from processing.segment.background.placement import best_shift
from processing.segment.background.segmenter import BackgroundSegmenter
from processing.segment.background.static_scene import StaticScene
from recordings.records import RgbdFrame

H, W = 120, 160
RED, BLUE, GREY = (200, 30, 30), (30, 30, 200), (120, 120, 120)
BEFORE, TURNED = np.s_[40:70, 50:80], np.s_[40:70, 50:96]


def frame(*sides: tuple[tuple[slice, slice], tuple[int, int, int], float]) -> RgbdFrame:
    color, depth = np.full((H, W, 3), GREY, dtype=np.uint8), np.ones((H, W), dtype=np.float32)
    for at, paint, depth_m in sides:
        color[at], depth[at] = paint, depth_m
    return RgbdFrame("d455", 0, 0, 0, color, depth)


def empty_scene() -> StaticScene:
    empty = frame()
    return StaticScene(
        empty.depth_m, np.full((H, W), 0.001, np.float32), empty.color_rgb.astype(np.float32),
        np.ones((H, W), np.float32), np.ones((H, W), dtype=bool), empty.depth_m,
    )  # fmt: skip


@pytest.mark.parametrize("other_near", [False, True])
def test_a_side_never_seen_before_is_the_bodys_own_unless_something_else_was_near(other_near: bool) -> None:
    scene = empty_scene()
    first = np.zeros((H, W), dtype=bool)
    first[BEFORE] = True
    beside = np.zeros((H, W), dtype=bool)
    beside[40:70, 84:110] = True
    hand = frame((np.s_[40:70, 84:110], BLUE, 0.62), (BEFORE, RED, 0.7))
    memory = remember(None, hand, Found(first, 1.0, beside if other_near else None))
    turned = frame((TURNED, BLUE, 0.62), (BEFORE, RED, 0.66))
    found = follow(turned, scene, memory, None, None, BackgroundSettings())
    body = np.zeros((H, W), dtype=bool)
    body[TURNED] = True
    overlap = (found.mask & body).sum() / (found.mask | body).sum()
    assert overlap < 0.75 if other_near else overlap > 0.95


def test_a_side_never_seen_before_stays_where_the_body_hid_the_table_from_all_frames() -> None:
    """Nothing is known of the scene there but where the table lies."""
    scene, first, body = empty_scene(), np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    hidden = ~scene.known
    hidden[35:75, 45:101] = True
    scene = replace(scene, known=~hidden, color_rgb=np.where(hidden[..., None], np.float32(0), scene.color_rgb))
    first[BEFORE], body[TURNED] = True, True
    memory = remember(None, frame((BEFORE, RED, 0.7)), Found(first, 1.0))
    found = follow(frame((TURNED, BLUE, 0.62), (BEFORE, RED, 0.66)), scene, memory, None, None, BackgroundSettings())
    assert (found.mask & body).sum() / (found.mask | body).sum() > 0.95


def test_late_depth_is_put_where_colour_shows_the_body() -> None:
    color, depth = frame((np.s_[40:70, 50:80], RED, 0.7)), frame((np.s_[44:74, 57:87], RED, 0.7))
    late = replace(color, depth_m=depth.depth_m, depth_time_ns=16_000_000)
    body = depth.depth_m < 0.9
    predicted = way_px(late, np.array([375.0, 312.5]))  # px/s: 6 and 5 px in 16 ms, where 7 and 4 is right
    np.testing.assert_allclose(predicted, [-6, -5])
    found = at_color_time(late, empty_scene(), body, predicted, LateDepthSettings(), ForegroundSettings())
    np.testing.assert_array_equal(found.depth_m, color.depth_m)


def test_late_depth_is_not_put_on_the_bodys_shadow() -> None:
    shadow = (np.s_[60:90, 46:80], (70, 70, 70), 1.0)
    color, depth = frame(shadow, (np.s_[40:70, 50:80], RED, 0.7)), frame((np.s_[44:74, 53:83], RED, 0.7))
    late = replace(color, depth_m=depth.depth_m, depth_time_ns=16_000_000)
    predicted = np.array([-3.0, -1.0])  # there it would cover nothing but itself and its shadow
    found = at_color_time(
        late, empty_scene(), depth.depth_m < 0.9, predicted, LateDepthSettings(), ForegroundSettings()
    )
    np.testing.assert_array_equal(found.depth_m, color.depth_m)


@pytest.mark.parametrize(("way_px", "own"), [(0.0, False), (6.0, True)])
def test_a_body_may_lie_off_the_expected_place_by_its_way_between_the_exposures(way_px: float, own: bool) -> None:
    expected, rough = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    expected[BEFORE], rough[40:70, 50:102] = True, True  # 22 px more; 0.6 of its size are 18
    seen = frame((np.s_[40:70, 50:102], RED, 0.7))
    memory = remember(None, seen, Found(expected, 1.0))
    assert _is_all_object(seen, rough, expected, memory, way_px, BackgroundSettings()) == own


@pytest.mark.parametrize("missed", [0, 3])
def test_a_body_that_an_impact_stopped_is_found_where_it_stopped(missed: int) -> None:
    first = np.zeros((H, W), dtype=bool)
    first[BEFORE] = True
    memory = remember(None, frame((BEFORE, RED, 0.7)), Found(first, 1.0))
    memory = replace(memory, velocity_px=np.array([38.0, 0.0]), missed=missed)
    stopped = frame((np.s_[41:71, 53:83], RED, 0.7))
    found = follow(stopped, empty_scene(), memory, None, None, BackgroundSettings())
    body = np.zeros((H, W), dtype=bool)
    body[41:71, 53:83] = True
    assert (found.mask & body).sum() / (found.mask | body).sum() > 0.9


@pytest.mark.parametrize("moved_px", [(12, 5), (6, 3), (0, 0), (-3, 4)])
def test_a_mask_lies_where_most_of_it_looks_like_the_object_whether_it_flies_on_or_not(
    moved_px: tuple[int, int],
) -> None:
    mask, score = np.zeros((H, W), dtype=bool), np.zeros((H, W), np.float32)
    mask[40:52, 50:70] = True
    score[:20] = 1.0  # something else, out of reach
    score[40 + moved_px[1] : 52 + moved_px[1], 50 + moved_px[0] : 70 + moved_px[0]] = 0.9
    np.testing.assert_array_equal(best_shift(score, mask, np.array([12.0, 5.0]), 1, 13), moved_px)


def test_without_a_trace_of_the_object_its_motion_goes_on() -> None:
    mask, velocity = np.zeros((H, W), dtype=bool), np.array([7.0, -3.0])
    mask[100:115, 5:20] = True
    np.testing.assert_array_equal(best_shift(np.zeros((H, W), np.float32), mask, velocity, 2, 20), 2 * velocity)


SKIN, PAINT = (215, 170, 140), (225, 180, 150)


@pytest.mark.parametrize("paint", [RED, PAINT])
def test_a_hand_that_holds_the_object_is_never_taken_for_it_however_long_it_holds(paint: tuple[int, int, int]) -> None:
    scene, settings = empty_scene(), BackgroundSettings()
    held, hand = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    held[50:80, 40:70], hand[50:80, 70:120] = True, True
    memory = remember(None, picture(held, hand, paint, 0), Found(held, 1.0, hand))
    for k in range(1, 12):  # together, to the right
        mine, other = np.roll(held, 2 * k, 1), np.roll(hand, 2 * k, 1)
        seen = picture(mine, other, paint, k)
        found = follow(seen, scene, memory, None, None, settings)
        assert overlap(found.mask, mine) > 0.9
        memory = remember(memory, seen, found)
    for k in range(1, 5):  # it opens and stays; the object falls
        mine = np.roll(held, (6 * k, 22), (0, 1))
        seen = picture(mine, np.roll(hand, 22 + 4 * k, 1), paint, 12 + k)
        found = follow(seen, scene, memory, None, None, settings)
        assert overlap(found.mask, mine) > 0.8
        memory = remember(memory, seen, found)


def test_one_bad_mask_does_not_make_the_object_small() -> None:
    body, part = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    body[40:70, 50:80], part[40:48, 50:60] = True, True
    seen = frame((BEFORE, RED, 0.7))
    memory = remember(remember(None, seen, Found(body, 1.0)), seen, Found(part, 0.5))
    found = follow(seen, empty_scene(), memory, None, None, BackgroundSettings())
    assert overlap(found.mask, body) > 0.95


def picture(mine: np.ndarray, other: np.ndarray, paint: tuple[int, int, int], seed: int) -> RgbdFrame:
    """An object and a hand at one depth that is fattened by 3 px, with noise."""
    rng = np.random.default_rng(seed)
    seen = frame()
    color, depth = seen.color_rgb.astype(np.float64), seen.depth_m.copy()
    color[other], color[mine] = SKIN, paint
    depth[grown(mine | other, 3)] = 0.7
    return replace(seen, color_rgb=(color + rng.normal(0, 3, color.shape)).clip(0, 255).astype(np.uint8), depth_m=depth)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def striped(mine: np.ndarray, other: np.ndarray, seed: int) -> RgbdFrame:
    """A striped object held by a hand that has the table's colour, which is the mean of the stripes."""
    seen = picture(mine, other, GREY, seed)
    color = seen.color_rgb.astype(np.float64)
    color[other] += np.array(GREY) - np.array(SKIN)
    rows = np.arange(H)[:, None] - int(np.flatnonzero(mine.any(1))[0])
    color[mine] += np.where(rows // 3 % 2 == 0, 60, -60).repeat(W, 1)[mine][:, None]
    return replace(seen, color_rgb=color.clip(0, 255).astype(np.uint8))


def test_a_hand_of_the_tables_colour_is_told_from_the_object_by_its_contrast() -> None:
    scene, settings = empty_scene(), BackgroundSettings()
    held, hand = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    held[50:80, 40:70], hand[20:80, 70:110] = True, True
    memory = remember(None, striped(held, hand, 0), Found(held, 1.0, hand))
    for k in range(1, 14):  # together, down and to the right
        mine, other = (np.roll(m, (2 * k, 2 * k), (0, 1)) for m in (held, hand))
        seen = striped(mine, other, k)
        found = follow(seen, scene, memory, None, None, settings)
        memory = remember(memory, seen, found)
    assert overlap(found.mask, mine) > 0.9
    assert found.others is not None
    assert (found.others & mine).sum() < 0.05 * found.others.sum()


def test_two_that_have_one_mean_colour_are_told_apart_by_their_contrast() -> None:
    left, right = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    left[30:90, 20:75], right[30:90, 80:140] = True, True
    seen, moved = (striped(np.roll(left, k, 0), np.roll(right, k, 0), k) for k in (0, 7))
    patches = Patches.of(seen.color_rgb, left, right)
    assert patches is not None
    odds = patches.log_odds(moved.color_rgb, np.roll(left | right, 7, 0))
    assert (odds[np.roll(left, 7, 0)] > 0).mean() > 0.95
    assert (odds[np.roll(right, 7, 0)] < 0).mean() > 0.95
    assert not odds[:20].any()


def test_what_was_learned_before_changes_nothing_of_what_one_frame_teaches() -> None:
    """Tosses are followed one after another or side by side, and their masks are the same."""
    left, right = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    left[30:90, 20:75], right[30:90, 80:140] = True, True
    seen = picture(left, right, (150, 120, 110), 0)
    one, other = (Patches.of(seen.color_rgb, left, right) for _ in range(2))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(*(p.log_odds(seen.color_rgb, left | right) for p in (one, other)))


def test_the_table_between_a_hands_fingers_is_neither_hand_nor_object() -> None:
    """Stereo gives it the hand's depth; it has a shade that the object shows too, and the hand does not."""
    rng = np.random.default_rng(0)
    seen = frame((np.s_[30:90, 60:120], (225, 180, 150), 0.8), (np.s_[40:80, 76:104], GREY, 0.8))
    mask = np.zeros((H, W), dtype=bool)
    mask[50:100, 80:100] = True
    seen.color_rgb[mask] = np.clip(rng.normal(GREY, 60, (int(mask.sum()), 3)), 0, 255)
    hand = np.zeros_like(mask)
    hand[30:90, 60:120] = True
    hand[40:80, 76:104] = False
    patches = Patches.of(seen.color_rgb, mask, hand & ~mask)
    assert patches is not None
    gap = np.zeros_like(mask)
    gap[42:48, 78:102] = True
    assert np.median(patches.log_odds(seen.color_rgb, gap)[gap]) < -1
    assert np.median(patches.log_odds(seen.color_rgb, mask)[mask]) > 1


def test_a_thing_beside_the_object_is_neither_its_rim_nor_a_side_of_it_that_was_never_seen() -> None:
    scene, s, least = empty_scene(), ForegroundSettings(), 120
    mask = np.zeros((H, W), dtype=bool)
    mask[40:80, 50:90] = True
    rim, hole = grown(mask, 4) & ~mask, np.zeros((H, W), dtype=bool)
    hole[50:70, 60:80] = True
    hand = np.zeros((H, W), dtype=bool)
    hand[30:70, 92:130] = True
    seen = frame((np.s_[:, :], SKIN, 0.7))
    assert things_near(seen, scene, rim, mask, s, least) is None
    assert things_near(seen, scene, hole, mask & ~hole, s, least) is None
    found = things_near(seen, scene, rim | hole | hand, mask & ~hole, s, least)
    assert found is not None
    assert overlap(found, hand) > 0.8
    assert not (found & hole).any()


def test_what_a_hand_cuts_in_two_stays_whole() -> None:
    scene, settings = empty_scene(), BackgroundSettings()
    bar, hand = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    bar[60:74, 30:120], hand[20:80, 66:84] = True, True
    mine = bar & ~hand
    memory = remember(None, picture(mine, hand, RED, 0), Found(mine, 1.0, hand))
    for k in range(1, 6):
        shown, other = np.roll(mine, 3 * k, 0), np.roll(hand, 3 * k, 0)
        seen = picture(shown, other, RED, k)
        found = follow(seen, scene, memory, None, None, settings)
        assert overlap(found.mask, shown) > 0.85
        memory = remember(memory, seen, found)


def test_a_dark_object_that_a_hand_turns_does_not_shrink_to_where_it_was_expected() -> None:
    scene, settings, dark = empty_scene(), BackgroundSettings(), (24, 22, 26)  # a deep shadow on grey is as dark
    body, hand = np.zeros((H, W), dtype=bool), np.zeros((H, W), dtype=bool)
    body[50:80, 60:80], hand[50:80, 84:110] = True, True
    memory = remember(None, picture(body, hand, dark, 0), Found(body, 1.0, hand))
    for k in range(1, 6):  # its broad side comes into view
        wide = body.copy()
        wide[50:80, 60 - 3 * k : 80] = True
        seen = picture(wide, hand, dark, k)
        found = follow(seen, scene, memory, None, None, settings)
        memory = remember(memory, seen, found)
    assert overlap(found.mask, wide) > 0.9


def test_an_object_before_the_bare_table_was_not_learned_as_scene_though_depth_misses_half_of_it() -> None:
    mask = np.zeros((H, W), dtype=bool)
    mask[40:70, 50:80] = True
    half, faint = (np.s_[40:70, 50:66], (128, 120, 120), 0.7), (np.s_[40:70, 66:80], (128, 120, 120), 1.0)
    seen, scene = frame(half, faint), empty_scene()
    segmenter = BackgroundSegmenter(scene, None, BackgroundSettings())
    assert segmenter._scene_without(seen, mask) is scene
    learned = replace(scene, depth_m=np.where(mask, np.float32(0.7), scene.depth_m))  # the scene holds the object
    segmenter = BackgroundSegmenter(learned, None, BackgroundSettings())
    assert not segmenter._scene_without(frame((np.s_[40:70, 50:80], RED, 0.7)), mask).known[mask].any()
