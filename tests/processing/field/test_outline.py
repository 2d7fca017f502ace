"""A ball whose outlines are known, and grids that hold it too small, right, or too large."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from processing.field.outline import moved_out
from processing.field.views import MARGIN_PX, FieldView

RADIUS_M, FAR_M = 0.03, 0.5
VOXEL_M, REACH_M = 0.002, 0.006
SIDE = 45
ORIGIN_M = np.full(3, -0.5 * VOXEL_M * (SIDE - 1))


def ball_m(radius_m: float) -> np.ndarray:
    """Signed distances on the grid."""
    at = ORIGIN_M[0] + VOXEL_M * np.arange(SIDE)
    x, y, z = np.meshgrid(at, at, at, indexing="ij")
    return (np.sqrt(x**2 + y**2 + z**2) - radius_m).astype(np.float32)


def view(turn: Rotation, radius_m: float = RADIUS_M) -> FieldView:
    """The ball's exact mask: rays that pass its centre at less than its radius."""
    half = int(400 * radius_m / FAR_M * 1.1) + MARGIN_PX
    K = np.array([[400.0, 0, half], [0, 400.0, half], [0, 0, 1]])
    v, u = np.mgrid[: 2 * half + 1, : 2 * half + 1]
    tangent = np.hypot(u - half, v - half) / 400
    mask = FAR_M * tangent / np.sqrt(1 + tangent**2) < radius_m
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = turn.as_matrix(), FAR_M
    none = np.zeros(mask.shape, np.float32)
    return FieldView(
        K, np.zeros((*mask.shape, 3), np.uint8), none, np.zeros((*mask.shape, 3), np.float32), mask, ~mask, ~mask,
        pose, pose,
    )  # fmt: skip


@pytest.fixture(scope="module")
def views() -> list[FieldView]:
    return [view(turn) for turn in Rotation.random(80, random_state=0)]


def radius_of(sdf_m: np.ndarray) -> float:
    """By the volume inside, to a fraction of a cell."""
    inside = np.clip(0.5 - sdf_m / VOXEL_M, 0, 1).sum() * VOXEL_M**3
    return float((3 * inside / (4 * np.pi)) ** (1 / 3))


@pytest.mark.parametrize("too_small_m", [0.001, 0.002, 0.003])
def test_a_surface_inside_the_outlines_is_moved_out_to_them(views, too_small_m):
    moved = moved_out(ball_m(RADIUS_M - too_small_m), ORIGIN_M, VOXEL_M, REACH_M, views)
    left_m = RADIUS_M - radius_of(moved)
    assert -0.0002 < left_m < 0.3 * too_small_m


def test_a_surface_that_the_outlines_touch_stays(views):
    before = ball_m(RADIUS_M)
    assert radius_of(moved_out(before, ORIGIN_M, VOXEL_M, REACH_M, views)) == pytest.approx(RADIUS_M, abs=0.0003)


def test_what_masks_do_not_show_is_not_cut_off(views):
    """A mask may lack what something hides."""
    before = ball_m(RADIUS_M + 0.002)
    np.testing.assert_allclose(moved_out(before, ORIGIN_M, VOXEL_M, REACH_M, views), before, atol=1e-7)


def test_gaps_wider_than_the_reach_are_of_something_else(views):
    before = ball_m(RADIUS_M - 1.5 * REACH_M)
    np.testing.assert_allclose(moved_out(before, ORIGIN_M, VOXEL_M, REACH_M, views), before, atol=1e-7)


def test_only_the_side_that_outlines_touch_moves():
    """Seen along z alone, the equator is known and the poles are not."""
    before = ball_m(RADIUS_M - 0.002)
    moved = before - moved_out(before, ORIGIN_M, VOXEL_M, REACH_M, [view(Rotation.identity())] * 20)
    middle = SIDE // 2
    equator, pole = moved[middle + int(RADIUS_M / VOXEL_M), middle, middle], moved[middle, middle, -3]
    assert equator == pytest.approx(0.002, abs=0.0004)
    assert pole < 0.0002


def test_where_something_may_hide_the_body_its_outline_says_nothing(views):
    """The right half of each mask is cut away, along a line through the body, where something is known to stand."""

    def half(whole: FieldView) -> FieldView:
        cut = np.arange(whole.inside.shape[1]) > whole.inside.shape[1] // 2
        return replace(whole, inside=whole.inside & ~cut, unmasked=whole.unmasked & ~cut)

    moved = moved_out(ball_m(RADIUS_M - 0.002), ORIGIN_M, VOXEL_M, REACH_M, [half(v) for v in views])
    assert radius_of(moved) == pytest.approx(RADIUS_M, abs=0.0008)  # of 2 mm


def test_a_few_views_move_a_surface_less_than_many(views):
    before = ball_m(RADIUS_M - 0.002)
    few, many = (radius_of(moved_out(before, ORIGIN_M, VOXEL_M, REACH_M, views[:n])) for n in (1, 80))
    assert RADIUS_M - 0.0021 < few < many


def test_no_view_and_an_empty_mask_move_nothing(views):
    before = ball_m(RADIUS_M - 0.002)
    empty = replace(views[0], inside=np.zeros_like(views[0].inside), unmasked=np.ones_like(views[0].unmasked))
    for none in ([], [empty]):
        np.testing.assert_allclose(moved_out(before, ORIGIN_M, VOXEL_M, REACH_M, none), before, atol=1e-7)
