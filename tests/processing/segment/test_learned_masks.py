"""Masks drawn anew by what all of a session's masks show: what one frame got wrong, the others know."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from processing.config import Config
from processing.pipeline.masks import all_masks, masks_anew
from processing.pipeline.start import start_run
from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.foreground import grown
from processing.segment.background.static_scene import StaticScene
from processing.segment.learned.again import AgainSettings, Judged, found_again, overlap, support_of
from processing.segment.learned.masks import LearnedSettings, Look, look, redrawn, sizes_px
from processing.segment.learned.network import NetworkSettings, PixelNetwork, learned, samples_of
from processing.stages.masks.find import find_object
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from processing.variants import TRACKERS
from recordings.progress import Silent
from recordings.records import RgbdFrame
from recordings.results.folder import read_masks
from recordings.session import Session

SIZE = (120, 160)
TABLE_M, BODY_M, ARM_M = 0.80, 0.79, 0.65
WOOD, DARK = (190.0, 140.0, 90.0), (70.0, 56.0, 44.0)
SETTINGS, BACKGROUND = LearnedSettings(), BackgroundSettings()


def table() -> StaticScene:
    grain = np.random.default_rng(0).uniform(0.9, 1.1, (*SIZE, 1)).astype(np.float32)
    far = np.full(SIZE, TABLE_M, np.float32)
    noise = np.full(SIZE, 0.004, np.float32)
    color = np.array(WOOD, np.float32) * grain
    return StaticScene(far, noise, color, np.full(SIZE, 2.0, np.float32), np.ones(SIZE, bool), far)


def box(left: int, top: int, width: int = 36, height: int = 24) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[top : top + height, left : left + width] = True
    return mask


def picture(scene: StaticScene, body: np.ndarray, seed: int, arm: np.ndarray | None = None) -> RgbdFrame:
    """A dark body on the table, which depth hardly tells from it; an arm of the same colour high above."""
    rng = np.random.default_rng(seed)
    rgb, depth = scene.color_rgb.copy(), scene.depth_m + rng.normal(0, 0.004, SIZE).astype(np.float32)
    rgb[body] = DARK
    depth[body] -= TABLE_M - BODY_M
    if arm is not None:
        rgb[arm], depth[arm] = DARK, ARM_M
    return RgbdFrame("d455", 0, 0, 0, (rgb + rng.normal(0, 3, rgb.shape)).clip(0, 255).astype(np.uint8), depth)


def looked(frame: RgbdFrame, scene: StaticScene, mask: np.ndarray, robot: np.ndarray | None = None) -> Look:
    found = look(frame, scene, mask, 29.0, robot, BACKGROUND, SETTINGS)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def scene() -> StaticScene:
    return table()


@pytest.fixture(scope="module")
def network(scene: StaticScene) -> PixelNetwork:
    """Learned from a dark box in ten places, a third of whose masks hold its left half only."""
    rows = []
    for k in range(10):
        body = box(20 + 8 * k, 15 + 7 * k)
        mask = body & box(20 + 8 * k, 15 + 7 * k, 18) if k % 3 == 0 else body
        seen = looked(picture(scene, body, k), scene, mask)
        outside = np.where(seen.mask, 0.0, 3.0).astype(np.float32)
        rows.append(samples_of(seen.features, seen.mask, outside, SETTINGS.network, (0, k)))
    return learned(np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows]), SETTINGS.network)


def test_wrong_labels_of_a_third_of_the_pixels_do_not_teach_it_wrong() -> None:
    rng = np.random.default_rng(0)
    truth = rng.random(6000) < 0.5
    rows = np.where(truth[:, None], 1.0, -1.0) + rng.normal(0, 0.5, (6000, 5))
    wrong = truth & (rng.random(6000) < 0.3)
    found = learned(rows.astype(np.float32), truth & ~wrong, NetworkSettings(steps=300))
    odds = found.log_odds(rows.astype(np.float32)[None])[0]
    assert ((odds > 0) == truth).mean() > 0.99


def test_the_same_pixels_teach_the_same_and_a_file_keeps_it(tmp_path, network: PixelNetwork) -> None:
    rng = np.random.default_rng(1)
    rows, labels = rng.normal(size=(500, 4)).astype(np.float32), rng.random(500) < 0.5
    one, two = (learned(rows, labels, NetworkSettings(steps=20)) for _ in range(2))
    np.testing.assert_array_equal(one.log_odds(rows[None]), two.log_odds(rows[None]))
    np.savez(tmp_path / "kept.npz", **network.arrays("half0"))
    with np.load(tmp_path / "kept.npz", allow_pickle=False) as stored:
        again = PixelNetwork.of({name: stored[name] for name in stored.files}, "half0")
    features = rng.normal(size=(7, 9, len(network.mean))).astype(np.float32)
    np.testing.assert_array_equal(again.log_odds(features), network.log_odds(features))


def test_a_mask_that_was_cut_in_half_is_made_whole(scene: StaticScene, network: PixelNetwork) -> None:
    body, half = box(60, 50), box(60, 50, 18)
    seen = looked(picture(scene, body, 77), scene, half)
    found = redrawn(seen, network, SIZE, BACKGROUND, SETTINGS)
    assert overlap(half, body) == 0.5
    assert overlap(found.mask, body) > 0.95
    assert found.sure > 0.8
    assert found.support > 0.95


def test_a_mask_that_spilled_over_the_table_is_cut_back(scene: StaticScene, network: PixelNetwork) -> None:
    body = box(60, 50)
    spilled = body | box(96, 56, 9, 12)
    found = redrawn(looked(picture(scene, body, 78), scene, spilled), network, SIZE, BACKGROUND, SETTINGS)
    assert overlap(spilled, body) < 0.9
    assert overlap(found.mask, body) > 0.95


def test_a_hand_of_the_objects_color_that_was_left_out_stays_out(scene: StaticScene, network: PixelNetwork) -> None:
    body, arm = box(60, 50), box(97, 55, 63, 12)
    frame = picture(scene, body, 79, arm)
    found = redrawn(looked(frame, scene, body), network, SIZE, BACKGROUND, SETTINGS)
    assert not (found.mask & arm & ~grown(body, 2)).any()
    assert overlap(found.mask, body) > 0.9


def test_a_half_or_a_corner_behind_a_finger_stays_and_a_speck_does_not(
    scene: StaticScene, network: PixelNetwork
) -> None:
    """The corner and the speck are of one size; the speck is of a colour between the object's and the table's."""
    body, finger = box(60, 50), box(76, 46, 6, 32)
    corner, speck = box(60, 84, 8, 6), box(84, 84, 8, 6)
    halves = body & ~finger
    frame = picture(scene, halves | corner | speck, 82, finger)
    frame.color_rgb[speck] = (0.75 * np.array(DARK) + 0.25 * np.array(WOOD)).astype(np.uint8)
    seen = looked(frame, scene, halves | corner | speck)
    odds = network.log_odds(seen.features)
    assert odds[speck[seen.at]].mean() < 0.5 * odds[halves[seen.at]].mean()
    found = redrawn(seen, network, SIZE, BACKGROUND, SETTINGS).mask
    assert not found[speck].any()
    assert found[corner].mean() > 0.8
    assert found[halves & box(60, 50, 14)].mean() > 0.9
    assert found[halves & box(84, 50, 12)].mean() > 0.9


def test_the_robots_pixels_stay_out(scene: StaticScene, network: PixelNetwork) -> None:
    body = box(60, 50)
    robot = box(78, 50, 18)
    seen = looked(picture(scene, body, 80), scene, body & ~robot, robot)
    found = redrawn(seen, network, SIZE, BACKGROUND, SETTINGS)
    assert not (found.mask & robot).any()


def test_a_mask_too_small_to_learn_from_and_a_black_frame_are_left_alone(scene: StaticScene) -> None:
    frame = picture(scene, box(60, 50), 81)
    assert look(frame, scene, box(60, 50, 7, 7), 7.0, None, BACKGROUND, SETTINGS) is None
    black = RgbdFrame("d455", 0, 0, 0, np.zeros_like(frame.color_rgb), frame.depth_m)
    assert look(black, scene, box(60, 50), 29.0, None, BACKGROUND, SETTINGS) is None


def test_a_size_is_that_of_the_frames_around_where_a_mask_is_cut() -> None:
    areas = [900] * 10 + [100] + [900] * 10
    np.testing.assert_allclose(sizes_px(areas, SETTINGS), 30.0)
    assert sizes_px([0, 0], SETTINGS).tolist() == [0.0, 0.0]


def moving(lost: set[int], taken: set[int]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The true masks of a body that moves by eight pixels a frame, and what following made of them: none where it was
    `lost`, a thing that stays at the left where it was `taken`."""
    truth = [box(20 + 8 * k, 40) for k in range(12)]
    seen = [box(0, 90) if k in taken else np.zeros(SIZE, bool) if k in lost else truth[k] for k in range(12)]
    return truth, seen


def again(truth: list[np.ndarray], seen: list[np.ndarray], fixed: list[bool] | None = None) -> list[Judged]:
    """Followed by odds that know the truth: a tenth of the body's pixels look like something else."""
    rng = np.random.default_rng(2)
    odds = [np.where(t & (rng.random(SIZE) < 0.9), 3.0, -3.0).astype(np.float32) for t in truth]

    def draw(i: int, mask: np.ndarray) -> Judged:
        return Judged(mask, 1.0, support_of(odds[i], mask))

    judged = [draw(i, mask) for i, mask in enumerate(seen)]
    return found_again(
        judged,
        np.full(len(seen), 36.0 * 24),
        fixed or [False] * len(seen),
        lambda i, at: odds[i][at],
        draw,
        AgainSettings(),
    )


@pytest.mark.parametrize(
    ("lost", "taken"), [({5, 6}, set()), ({9, 10, 11}, set()), ({0, 1}, set()), (set(), {6, 7, 8})]
)
def test_the_object_is_found_again_where_it_was_lost_or_taken_for_another(lost: set[int], taken: set[int]) -> None:
    truth, seen = moving(lost, taken)
    found = again(truth, seen)
    assert min(overlap(j.mask, t) for j, t in zip(found, truth, strict=True)) > 0.9


def test_a_mask_that_holds_a_part_of_it_only_is_made_whole_by_those_before() -> None:
    truth, seen = moving(set(), set())
    seen[6] = truth[6] & box(20 + 8 * 6, 40, 12)
    assert overlap(again(truth, seen)[6].mask, truth[6]) > 0.9


def test_where_it_is_not_seen_nothing_is_found() -> None:
    truth, seen = moving({9, 10, 11}, set())
    gone = [t if k < 9 else np.zeros(SIZE, bool) for k, t in enumerate(truth)]
    assert not any(j.mask.any() for j in again(gone, seen)[9:])


def test_given_masks_and_those_that_look_right_stay() -> None:
    truth, seen = moving(set(), {6})
    found = again(truth, seen, [k == 6 for k in range(12)])
    assert all(j.mask is m for j, m in zip(found, seen, strict=True))


def test_masks_of_a_session_that_were_cut_are_made_whole_and_given_ones_stay(
    tiny_world: Any, record_tiny: Any, tmp_path: Path
) -> None:
    session = Session.open(record_tiny())
    run = start_run(session, session.tosses, tmp_path / "out", Config(), TRACKERS[0], lambda _: Silent())
    scene = learn_static_scene(run)
    rig = refine_rig(run, scene)
    masks = all_masks(run, scene, rig, find_object(run, scene, rig))
    followed = {t: list(read_masks(masks[t].folder, t)) for t in run.tosses}
    for i in (2, 5):  # a step of following that lost the lower half of the object
        cut = followed[0][i].copy()
        cut[int(np.nonzero(cut)[0].mean()) :] = False
        assert cv2.imwrite(str(masks[0].folder / "toss_00.masks" / f"{i:06d}.png"), cut.astype(np.uint8) * 255)
    anew = masks_anew(run, scene, masks)
    assert {done.name.rsplit("-", 1)[0] for done in anew.values()} == {"learned-masks"}
    found = read_masks(anew[0].folder, 0)
    given = session.toss(0).masks()
    assert given
    for i, mask in given.items():
        np.testing.assert_array_equal(found[i], mask)
    assert min(overlap(np.asarray(found[i]), followed[0][i]) for i in range(len(found))) > 0.85
    again = masks_anew(run, scene, masks)
    assert all(again[t].reused and again[t].key == anew[t].key for t in anew)
