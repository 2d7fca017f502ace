"""Metrics against known answers. What is made of them over a session: test_score.py."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from processing.evaluate.metrics import (
    align_first,
    auc_percent,
    chamfer,
    frame_errors,
    icp_align,
    rollout_errors,
    surface_points,
)
from recordings.geometry import rotation_exp

CORNERS_M = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05


def pose(
    turn_rad: tuple[float, float, float] = (0, 0, 0), at_m: tuple[float, float, float] = (0, 0, 0.8)
) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_exp(np.array(turn_rad, dtype=np.float64)), at_m
    return out


def test_add_of_a_pure_shift_is_its_length() -> None:
    errors = frame_errors(pose(at_m=(0.03, 0.04, 0.8))[None], pose()[None], CORNERS_M)
    assert errors.add_m[0] == pytest.approx(0.05)
    assert errors.translation_m[0] == pytest.approx(0.05)
    assert errors.rotation_deg[0] == pytest.approx(0)


def test_add_s_forgives_a_cubes_quarter_turn_and_add_does_not() -> None:
    errors = frame_errors(pose((0, 0, np.pi / 2))[None], pose()[None], CORNERS_M)
    assert errors.adds_m[0] == pytest.approx(0, abs=1e-12)
    assert errors.add_m[0] == pytest.approx(0.1)
    assert errors.rotation_deg[0] == pytest.approx(90)
    assert errors.success[0] == 0


def test_a_lost_frame_is_an_infinite_error_and_a_frame_without_truth_is_none() -> None:
    estimate, truth = np.stack([pose(), np.full((4, 4), np.nan), pose()]), np.stack([pose()] * 3)
    truth[2] = np.nan
    errors = frame_errors(estimate, truth, CORNERS_M)
    assert errors.add_m.tolist() == [0.0, np.inf]
    assert errors.success.tolist() == [1.0, 0.0]


def test_auc_of_known_errors() -> None:
    assert auc_percent(np.zeros(50)) == pytest.approx(100)
    assert auc_percent(np.full(50, 0.2)) == 0
    assert auc_percent(np.full(50, np.inf)) == 0
    assert auc_percent(np.array([0.0, np.inf])) == pytest.approx(50)


@given(st.lists(st.floats(0, 0.2), min_size=200, max_size=300))
def test_auc_is_the_mean_of_what_is_left_of_the_limit_up_to_one_frame(errors: list[float]) -> None:
    e = np.array(errors)
    mean = 100 * np.clip(1 - e / 0.1, 0, 1).mean()
    assert mean - 1e-9 <= auc_percent(e) <= mean + 100 / len(e)


def test_alignment_by_the_first_frame_takes_the_object_frame_away() -> None:
    truth = np.stack([pose(), pose((0.2, 0.1, 0), (0.1, 0, 0.7)), pose((0.5, 0, 0), (0.1, 0.2, 0.7))])
    estimate = truth @ pose((1.0, -0.4, 0.3), (0.02, 0.01, 0.03))
    shift = align_first(estimate, truth)
    assert shift is not None
    np.testing.assert_allclose(estimate @ shift, truth, atol=1e-12)


def test_a_lost_first_frame_is_not_forgiven_by_aligning_at_a_later_one() -> None:
    truth = np.stack([pose(), pose((0.2, 0.1, 0), (0.1, 0, 0.7)), pose((0.5, 0, 0), (0.1, 0.2, 0.7))])
    estimate = truth @ pose((1.0, -0.4, 0.3), (0.02, 0.01, 0.03))
    estimate[0] = np.nan
    assert align_first(estimate, truth) is None
    truth[0] = np.nan  # the first frame that counts is then the second one
    assert align_first(estimate, truth) is not None


def test_chamfer_of_a_larger_box_is_its_margin() -> None:
    small, large = trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.102, 0.102, 0.102))
    found = chamfer(large, small)
    assert found.truth_to_estimate_m == pytest.approx(0.001, abs=2e-5)
    assert found.cm == pytest.approx(0.1, abs=0.01)
    assert found.f_score_5mm == 1
    assert chamfer(small, small).cm < 1e-5


def test_icp_finds_a_small_motion_back() -> None:
    points = surface_points(trimesh.creation.box((0.1, 0.08, 0.05)), 4000)
    moved = pose((0.05, 0.02, -0.04), (0.003, -0.002, 0.004))
    there = points @ moved[:3, :3].T + moved[:3, 3]
    np.testing.assert_allclose(icp_align(points, there, share=1.0), moved, atol=2e-3)


def test_a_rollout_that_follows_the_truth_has_no_error_and_ends_with_it() -> None:
    true_s = np.arange(10) / 30
    true = np.tile(np.eye(4), (10, 1, 1))
    true[:, 0, 3], true[:, 2, 3] = 0.6 * true_s, 1.0
    true_from_estimated = np.eye(4)
    true_from_estimated[:3, :3] = rotation_exp(np.array([0.2, -0.4, 0.9]))
    true_from_estimated[:3, 3] = [0.02, -0.01, 0.03]
    rolled_s = 0.1 + np.arange(40) / 148
    rolled = np.tile(np.eye(4), (40, 1, 1))
    rolled[:, 0, 3], rolled[:, 2, 3] = 0.6 * rolled_s, 1.0
    rolled = rolled @ true_from_estimated
    found = rollout_errors(rolled, rolled_s, true, true_s, np.array([0.01, 0.0, 0.0]))
    assert found is not None
    reached = np.isfinite(found[0])
    assert reached.sum() == (rolled_s[1:] <= true_s[-1] + 0.1 / 148).sum()
    assert found[0][reached].max() < 1e-9
    assert found[1][reached].max() < 1e-7
    assert rollout_errors(rolled, rolled_s + 1.0, true, true_s, np.zeros(3)) is None
