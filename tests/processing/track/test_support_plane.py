"""What a body stands on lies in the table's plane: known boxes, standing and seen from below."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.registration.support_plane import SupportPlane, SupportPlaneConfig, support_plane
from recordings.geometry import rotation_exp

HALF = 0.05
ABOVE = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1.0]])
"""Camera from object of a camera that looks down on the box; its table is the plane z = -HALF of the object ..."""
TABLE = np.array([0, 0, -1.0, 0.8 + HALF])
"""... and so in this camera's axes."""
BELOW = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.8], [0, 0, 0, 1.0]])
"""... and of one that sees what the box stands on."""


def seen(pose: Array, points: Array, normals: Array) -> Array:
    """Points of the object as a view has them."""
    out = np.zeros((len(points), lay.SAMPLE), dtype=np.float32)
    out[:, :3], out[:, 3:6] = points @ pose[:3, :3].T + pose[:3, 3], normals @ pose[:3, :3].T
    return out


def side(down: float, count: int = 200) -> tuple[Array, Array]:
    """Points of the box's underside (1) or of its top (-1), and their normals."""
    xy = np.random.default_rng(0).uniform(-HALF, HALF, (count, 2))
    return np.column_stack([xy, np.full(count, -down * HALF)]), np.tile([0, 0, -down], (count, 1))


def store_of(*views: Array) -> Mock:
    """As much of a store as the support plane reads."""
    table = np.zeros((len(views), 7), dtype=np.int64)
    table[:, lay.COUNT] = [len(v) for v in views]
    table[:, lay.FIRST] = np.cumsum([0, *(len(v) for v in views[:-1])])
    return Mock(spec=ViewStore, table=table, samples=np.concatenate(views))


def standing(
    below: Array, *, config: SupportPlaneConfig | None = None, offset_m: float = 0.0, down: float = 1.0
) -> SupportPlane:
    """View 0 looks down on a standing box; view 1, at its true pose `below`, on what it stands on."""
    store = store_of(seen(ABOVE, *side(-1.0)), seen(below, *side(down)))
    planes = np.array([TABLE + [0, 0, 0, offset_m], np.full(4, np.nan)])
    return SupportPlane(store, np.arange(2), np.array([0, -1]), planes, config or SupportPlaneConfig())


def moved(poses: Array, ground: SupportPlane, place: Array, steps: int = 10) -> Array:
    """Poses after Gauss-Newton on the support plane alone (what it leaves open stays)."""
    poses, count = poses.copy(), int(place.max()) + 1
    for _ in range(steps):
        H, g = np.zeros((count, count, 6, 6)), np.zeros((count, 6))
        ground.add(H, g, poses, place)
        flat = H.transpose(0, 2, 1, 3).reshape(6 * count, -1)
        step = -np.linalg.lstsq(flat, g.reshape(-1), rcond=1e-9)[0].reshape(count, 6)
        for i in np.flatnonzero(place >= 0):
            poses[i] = poses[i] @ se3.inverse(se3.exponential(step[place[i]]))
    return poses


def off(pose: Array, turn: tuple[float, float, float], shift_m: float) -> Array:
    """The pose with the object turned and risen in it."""
    error = np.eye(4)
    error[:3, :3], error[2, 3] = rotation_exp(np.array(turn, dtype=np.float64)), shift_m
    return np.asarray(pose @ error)


@pytest.mark.parametrize("free", [1, 0])
def test_the_underside_is_laid_onto_the_table_whichever_view_is_off(free: int) -> None:
    poses = np.array([ABOVE, BELOW])
    poses[free] = off(poses[free], (0.04, -0.03, 0.0), 0.002)
    place = np.array([-1, -1])
    place[free] = 0
    found = moved(poses, standing(BELOW), place)
    gap = found[free] @ np.linalg.inv((ABOVE, BELOW)[free])
    np.testing.assert_allclose(gap[:3, :3], np.eye(3), atol=1e-6)
    back = np.linalg.inv(found[1]) @ BELOW @ [0, 0, -HALF, 1]  # where the underside is found in the object
    down = np.linalg.inv(found[0]) @ ABOVE @ [0, 0, -HALF, 1]  # and where the table is
    assert abs(back[2] - down[2]) < 2e-5


def test_what_the_plane_leaves_open_stays_open() -> None:
    """A turn about the upright and a shift along the table change nothing."""
    ground = standing(BELOW)
    H, g = np.zeros((1, 1, 6, 6)), np.zeros((1, 6))
    ground.add(H, g, np.array([ABOVE, BELOW]), np.array([-1, 0]))
    values = np.linalg.eigvalsh(H[0, 0])
    assert (values[:3] < 1e-6 * values[3]).all()
    for open_twist in np.eye(6)[[0, 1, 5]]:
        assert np.abs(H[0, 0] @ open_twist).max() < 1e-6 * values[-1]


def test_a_plane_is_no_better_known_than_its_calibration() -> None:
    """However many points there are: a plane 3 mm too high pulls with its own uncertainty."""
    config = SupportPlaneConfig(point_m=1e-5)
    ground = standing(BELOW, config=config, offset_m=0.003)
    H, g = np.zeros((1, 1, 6, 6)), np.zeros((1, 6))
    ground.add(H, g, np.array([ABOVE, BELOW]), np.array([-1, 0]))
    assert H[0, 0, 2, 2] == pytest.approx(config.plane_m**-2, rel=1e-3)
    assert np.linalg.lstsq(H[0, 0], g[0], rcond=1e-9)[0][2] == pytest.approx(0.003, rel=1e-2)
    other = 10.0 * config.plane_m**-2  # what else is known of the height
    H[0, 0] += other * np.diag([1, 1, 1, 1e-4, 1e-4, 1e-4])
    assert np.abs(np.linalg.solve(H[0, 0], g[0])).max() < 0.0004


@pytest.mark.parametrize(
    ("below", "down"), [(off(BELOW, (0.6, 0.0, 0.0), 0.0), 1.0), (off(BELOW, (0, 0, 0), 0.03), 1.0), (BELOW, -1.0)],
    ids=["tilted", "high above", "looks up"],
)  # fmt: skip
def test_what_does_not_lie_on_the_table_says_nothing(below: Array, down: float) -> None:
    ground = standing(below, down=down)
    H, g = np.zeros((1, 1, 6, 6)), np.zeros((1, 6))
    ground.add(H, g, np.array([ABOVE, BELOW]), np.array([-1, 0]))
    assert not H.any()
    assert not g.any()


def test_views_that_move_as_one_are_not_pulled() -> None:
    H, g = np.zeros((1, 1, 6, 6)), np.zeros((1, 6))
    standing(BELOW).add(H, g, np.array([ABOVE, off(BELOW, (0.04, 0, 0), 0.002)]), np.array([0, 0]))
    np.testing.assert_allclose(H, 0, atol=1e-6)
    np.testing.assert_allclose(g, 0, atol=1e-6)


def test_two_free_views_share_what_one_pulls() -> None:
    """Equal and opposite: the pair's own place stays open."""
    H, g = np.zeros((2, 2, 6, 6)), np.zeros((2, 6))
    standing(BELOW).add(H, g, np.array([ABOVE, off(BELOW, (0.04, 0, 0), 0.002)]), np.array([0, 1]))
    np.testing.assert_allclose(g[0], -g[1])
    np.testing.assert_allclose(H[0, 0], -H[0, 1])
    assert np.linalg.eigvalsh(H.transpose(0, 2, 1, 3).reshape(12, 12)).min() > -1e-6 * np.abs(H).max()


def crops(heights_m: list[float], table: bool = True) -> Mock:
    """A store whose crops show a table and a body whose lowest pixels are so high above it."""
    v, u = np.indices((40, 40))
    out = []
    for height in heights_m:
        depth = (np.where(u > 20, TABLE[3] - height, TABLE[3]) - 0.001 * (v % 7)).astype(np.float32)
        rise = (TABLE[2] * depth + TABLE[3]).astype(np.float32)
        out.append(SimpleNamespace(corner=(0, 0), depth_m=depth, mask=u > 20, height_m=rise if table else None))
    rectified = SimpleNamespace(focal=np.array([400.0, 400.0]), center=np.array([20.0, 20.0]))
    store = Mock(spec=ViewStore, rectified=rectified, crops=out)
    store.__len__ = Mock(return_value=len(out))
    return store


def found(heights_m: list[float], poses: list[Array], table: bool = True) -> SupportPlane:
    return support_plane(crops(heights_m, table), np.array(poses), np.arange(len(poses)), SupportPlaneConfig())


def test_a_body_stands_where_it_stays_and_reaches_the_table() -> None:
    moving = [off(ABOVE, (0, 0, 0), 0.01 * n) for n in (5, 3, 1)]
    ground = found([0.05, 0.03, 0.01, 0.002, 0.002, 0.002, 0.002], [*moving, *[ABOVE] * 4])
    np.testing.assert_array_equal(ground.stand >= 0, [False] * 3 + [True] * 4)
    assert len(set(ground.stand[3:])) == 1
    np.testing.assert_allclose(ground.planes[3:], np.tile(TABLE, (4, 1)), atol=1e-5)


def test_a_body_that_is_held_still_above_the_table_does_not_stand() -> None:
    assert (found([0.03] * 4, [ABOVE] * 4).stand < 0).all()


def test_two_views_may_look_alike_by_chance() -> None:
    away = off(ABOVE, (0.1, 0, 0), 0.0)
    assert (found([0.002] * 4, [ABOVE, ABOVE, away, away]).stand < 0).all()


def test_where_the_table_is_not_known_nothing_stands() -> None:
    assert (found([0.002] * 4, [ABOVE] * 4, table=False).stand < 0).all()
