"""What is reported of frames that no other frame supports."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.flags import (
    FlagConfig,
    camera_covariance,
    contradicting,
    fit_of_sure,
    reflagged,
    unjoined,
    unjoined_uncertainty,
)
from recordings.geometry import rotation_exp
from recordings.tracks import ObjectTrack

GOOD, BAD = (0.03, 0.95, 0.01), (0.2, 0.9, 0.05)


def hanging(pairs: list[tuple[int, int]], figures: list[tuple[float, float, float]], roots: list[int]) -> list[int]:
    use = np.ones(6, dtype=bool)
    use[5] = False
    found = unjoined(
        np.array(pairs, dtype=np.int64).reshape(-1, 2),
        np.array(figures, dtype=np.float64).reshape(-1, 3),
        roots,
        use,
        FlagConfig(),
    )
    return np.flatnonzero(found).tolist()


def test_frames_beyond_a_gap_that_no_pair_bridges_hang_on_nothing() -> None:
    chain = [(0, 1), (1, 2), (2, 3), (3, 4)]
    assert hanging(chain, [GOOD] * 4, [0]) == []
    assert hanging(chain, [GOOD, BAD, GOOD, GOOD], [0]) == [2, 3, 4]
    assert hanging(chain, [GOOD, (0.03, 0.2, 0.0), GOOD, GOOD], [0]) == [2, 3, 4]  # they hardly see the same surface


def test_another_way_round_joins_them_and_so_does_a_known_shape() -> None:
    assert hanging([(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)], [GOOD, BAD, GOOD, GOOD, GOOD], [0]) == []
    assert hanging([(0, 1), (1, 2), (2, 3), (3, 4), (4, 8)], [GOOD, BAD, GOOD, GOOD, GOOD], [0, 7, 8]) == []


def test_a_frame_in_no_pair_hangs_and_one_that_is_not_used_does_not() -> None:
    assert hanging([(0, 1), (1, 2), (2, 3)], [GOOD] * 3, [0]) == [4]
    assert hanging([], [], [0]) == [1, 2, 3, 4]


def test_the_uncertainty_of_a_hanging_frame_is_a_rotation_about_the_center_of_mass() -> None:
    center = np.array([0.02, -0.01, 0.05])
    uncertainty = unjoined_uncertainty(np.array([False, True]), center, FlagConfig(unjoined_sigma_rad=0.5))
    assert not uncertainty[0].any()
    np.testing.assert_allclose(uncertainty[1, 3:, 3:], 0.25 * np.eye(3))
    turn = np.array([1e-5, -2e-5, 3e-5])
    moved = center - rotation_exp(turn) @ center  # where the origin goes when the body turns about its center of mass
    to_origin = uncertainty[1, :3, 3:] / 0.25
    np.testing.assert_allclose(to_origin @ turn, moved, atol=1e-10)
    assert np.linalg.eigvalsh(uncertainty[1])[0] == pytest.approx(0, abs=1e-12)


CARD = np.array([[x, y, 0.8] for x in np.linspace(-0.05, 0.05, 21) for y in np.linspace(-0.01, 0.01, 5)])


def views_of_a_card(quarter_turns: list[int]) -> ViewStore:
    """Views of a long card at 0.8 m that has turned by so many quarters about the optical axis, 61 pixels wide."""
    side = 61
    maps: list[np.ndarray] = []
    samples: list[np.ndarray] = []
    table = []
    for n, quarters in enumerate(quarter_turns):
        points = CARD @ rotation_exp(np.array([0, 0, quarters * np.pi / 2])).T
        half = np.abs(points).max(0)[:2] / 0.8 * 400.0
        v, u = np.indices((side, side)) - side // 2
        pixels = np.zeros((side * side, lay.CHANNELS), dtype=np.float32)
        pixels[:, lay.OUTSIDE] = np.maximum(np.maximum(np.abs(u) - half[0], np.abs(v) - half[1]), 0).ravel()
        rows = np.zeros((len(points), lay.SAMPLE), dtype=np.float32)
        rows[:, :3] = points
        maps, samples = [*maps, pixels], [*samples, rows]
        table.append([n * side * side, -(side // 2), -(side // 2), side, side, n * len(CARD), len(CARD)])
    store: Any = ViewStore.__new__(ViewStore)
    store.maps, store.samples = np.concatenate(maps), np.concatenate(samples)
    store.table, store.rectified = np.array(table), SimpleNamespace(focal=np.array([400.0, 400.0]), center=np.zeros(2))
    return store


def uncertain(shown: list[int], followed: list[int], near: list[int]) -> list[int]:
    poses = np.tile(np.eye(4), (len(shown), 1, 1))
    for pose, quarters in zip(poses, followed):
        pose[:3, :3] = rotation_exp(np.array([0, 0, quarters * np.pi / 2]))
    pairs = np.array([(0, i) for i in near], dtype=np.int64)
    use = np.ones(len(shown), dtype=bool)
    figures = np.array([GOOD] * len(near))
    found = contradicting(views_of_a_card(shown), poses, 0, use, pairs, figures, FlagConfig())
    return np.flatnonzero(found).tolist()


def test_outlines_that_contradict_the_first_one_for_long_make_the_way_there_uncertain_too() -> None:
    shown = [0, 0, 0, 0, 1, 1, 1, 1]
    assert uncertain(shown, [0] * 8, near=[1]) == [2, 3, 4, 5, 6, 7]
    assert uncertain(shown, [0] * 8, near=[1, 2, 3]) == [4, 5, 6, 7]


def test_outlines_of_a_body_that_turned_as_its_poses_say_contradict_nothing() -> None:
    assert uncertain([0, 0, 0, 0, 1, 1, 1, 1], [0, 0, 0, 0, 1, 1, 1, 1], near=[1]) == []


def test_a_wrong_mask_of_a_frame_or_two_contradicts_no_pose() -> None:
    assert uncertain([0, 0, 0, 1, 1, 0, 0, 0], [0] * 8, near=[1]) == []


def test_poses_that_were_solved_for_anew_are_as_sure_as_their_new_covariances() -> None:
    """Frames: sure; unsure now; fits nothing; took no part; lost; unsure before, until other tosses hold it."""
    config, n = FlagConfig(), 6
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[4] = np.nan
    covariance = np.full((n, 6, 6), np.nan)
    covariance[[0, 1, 2, 3, 5]] = 0.3**2 * np.eye(6)
    status = ("tracked", "tracked", "tracked", "tracked", "lost", "interpolated")
    before = ObjectTrack(0, "d455", "object", np.arange(n, dtype=np.int64), poses, status, covariance)
    after = poses.copy()
    after[[0, 1, 2, 3, 5], :3, :3] = rotation_exp(np.array([0.1, 0.2, -0.3]))
    twists = np.full((n, 6, 6), np.nan)
    twists[[0, 1, 2, 5]] = np.diag([1e-3, 2e-3, 3e-3, 0.01, 0.02, 0.03]) ** 2
    twists[1, 3, 3] = 1.0
    cost, nothing = np.array([0.1, 0.1, 1.1 * config.tracked_cost, np.nan, np.nan, 0.1]), np.zeros((n, 6, 6))
    found = reflagged(before, after, twists, cost, np.zeros(n, dtype=bool), nothing, config)
    assert found.status == ("tracked", "interpolated", "tracked", "tracked", "lost", "interpolated")
    np.testing.assert_array_equal(found.camera_from_object, after)
    np.testing.assert_allclose(found.covariance[0], camera_covariance(after[0], config.correlated * twists[0]))
    np.testing.assert_array_equal(found.covariance[2:], covariance[2:])
    held = reflagged(before, after, twists, cost, np.ones(n, dtype=bool), nothing, config)
    assert held.status == (*found.status[:5], "tracked")
    np.testing.assert_array_equal(held.covariance[:5], found.covariance[:5])
    np.testing.assert_allclose(held.covariance[5], camera_covariance(after[5], config.correlated * twists[5]))


def test_other_tosses_do_not_decide_about_an_azimuth_that_no_frame_tells() -> None:
    """Frames: the azimuth known before, open now; open before, and now; open before, known now."""
    poses, axis = np.tile(np.eye(4), (3, 1, 1)), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    doubt = np.radians([40.0, 40.0, 2.0])[:, None, None] ** 2 * np.outer(axis, axis)
    status = ("tracked", "interpolated", "interpolated")
    before = ObjectTrack(0, "d455", "object", np.arange(3, dtype=np.int64), poses, status, np.tile(doubt[0], (3, 1, 1)))
    twists = np.tile(np.diag([1e-3] * 3 + [0.01] * 3) ** 2, (3, 1, 1))
    found = reflagged(before, poses, twists, np.full(3, 0.1), np.ones(3, dtype=bool), doubt, FlagConfig())
    assert found.status == ("interpolated", "interpolated", "tracked")
    spread_deg = np.degrees(np.sqrt(found.covariance[:, 2, 2]))
    assert spread_deg[:2].min() > 39
    assert 2 < spread_deg[2] < 3


def test_what_sure_frames_cost_is_the_most_that_other_ones_may() -> None:
    """Two tosses: sure, sure without a part in the solution, unsure; unsure only."""
    pose, covariance = np.tile(np.eye(4), (3, 1, 1)), np.zeros((3, 6, 6))
    times = np.arange(3, dtype=np.int64)
    one = ObjectTrack(0, "d455", "object", times, pose, ("tracked", "tracked", "interpolated"), covariance)
    other = ObjectTrack(1, "d455", "object", times, pose, ("interpolated",) * 3, covariance)
    costs = [np.array([0.05, np.nan, 0.2]), np.array([0.3, 0.1, np.nan])]
    assert fit_of_sure([one, other], costs) == 0.05
    assert fit_of_sure([other], costs[1:]) == -1.0
