"""A round body's axis and its turns: known answers."""

from __future__ import annotations

import numpy as np
import pytest

from processing.track import kernels as k
from processing.track.beam import Scene
from processing.track.features import Sift
from processing.track.round_axis import Axis, AxisConfig, open_axis
from processing.track.turns import TurnConfig, Turned, _Field, doubted
from processing.track.views import Optics, ViewConfig, ViewStore
from recordings.geometry import CameraModel, rotation_exp

CAMERA = CameraModel("d455", 640, 480, np.array([[386.0, 0, 320], [0, 386, 240], [0, 0, 1]]))


def seen(points_m: np.ndarray, normals: np.ndarray, turns: int = 6) -> tuple[Scene, np.ndarray]:
    """A body's surface as several views see it whose camera goes around it: the part that faces each camera."""
    poses, samples, table = [], [], []
    for n in range(turns):
        pose = np.eye(4)
        pose[:3, :3] = rotation_exp(np.array([0.3, 2 * np.pi * n / turns, 0.2]))
        pose[:3, 3] = [0.01, -0.02, 0.8]
        p, across = points_m @ pose[:3, :3].T + pose[:3, 3], normals @ pose[:3, :3].T
        facing = -np.sum(p * across, 1) / np.linalg.norm(p, axis=1) > 0.2
        rows = np.zeros((int(facing.sum()), k.SAMPLE))
        rows[:, :3], rows[:, 3:6] = p[facing], across[facing]
        row = np.zeros(7, dtype=np.int64)
        row[k.FIRST], row[k.COUNT] = sum(len(s) for s in samples), len(rows)
        poses.append(pose)
        samples.append(rows)
        table.append(row)
    store = ViewStore(Optics.of(CAMERA), [None] * turns, ViewConfig())
    store.samples, store.table = np.concatenate(samples).astype(np.float32), np.array(table)
    return Scene(store, np.arange(turns) / 30, np.zeros(3), np.zeros(3), Sift()), np.array(poses)


def cylinder(rng: np.random.Generator, middle_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Along y, with a block beside it for a handle."""
    around, height = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(-0.05, 0.05, 3000)
    normals = np.stack([np.cos(around), np.zeros(3000), np.sin(around)], -1)
    points = 0.04 * normals + height[:, None] * [0, 1, 0]
    block = rng.uniform(-1, 1, (250, 3)) * [0.006, 0.02, 0.0] + [0.06, 0, 0.006]
    faces = np.tile([0.0, 0.0, 1.0], (250, 1))
    noise = rng.normal(0, 0.05, (3250, 3))
    all_normals = np.concatenate([normals, faces]) + noise
    all_normals /= np.linalg.norm(all_normals, axis=1, keepdims=True)
    return np.concatenate([points, block]) + middle_m, all_normals


def test_a_cylinders_axis_is_found_though_it_has_a_handle() -> None:
    middle = np.array([0.02, 0.0, -0.03])
    scene, poses = seen(*cylinder(np.random.default_rng(1), middle))
    axis = open_axis(scene, poses, np.ones(len(poses), dtype=bool), AxisConfig())
    assert axis is not None
    assert abs(axis.direction[1]) == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(axis.point_m[[0, 2]], middle[[0, 2]], atol=1e-3)
    there = axis.turn(0.7)
    np.testing.assert_allclose(there[:3, :3] @ axis.point_m + there[:3, 3], axis.point_m, atol=1e-12)


def test_a_box_has_no_open_turn() -> None:
    rng = np.random.default_rng(2)
    points, normals = [], []
    for a in range(3):
        for sign in (-1.0, 1.0):
            face = rng.uniform(-1, 1, (600, 3)) * [0.05, 0.05, 0.05]
            face[:, a] = sign * 0.05
            points.append(face)
            normals.append(np.tile(sign * np.eye(3)[a], (600, 1)))
    scene, poses = seen(np.concatenate(points), np.concatenate(normals))
    assert open_axis(scene, poses, np.ones(len(poses), dtype=bool), AxisConfig()) is None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_turns_that_pairs_of_views_agree_on_are_found_from_nothing(seed: int) -> None:
    config, count, views = TurnConfig(), 72, 20
    rng = np.random.default_rng(seed)
    steady = 2 * np.arange(views) + rng.integers(-1, 2, views)
    steady[0] = 0
    pairs = np.array([(a, b) for a in range(views) for b in range(a) if a - b in (1, 2, 4, 7, 11)])
    gap = np.arange(count)[None] - (steady[pairs[:, 0]] - steady[pairs[:, 1]])[:, None]
    gap = np.abs((gap + count // 2) % count - count // 2)
    costs = 0.03 * np.minimum(gap / 3.0, 1.0) + rng.normal(0, 0.002, gap.shape)
    wild = rng.random(len(pairs)) < 0.15  # some pairs say something else altogether
    costs[wild] = np.roll(costs[wild], 20, axis=1)
    field = _Field(costs, pairs, np.zeros(views - 1), np.full(views - 1, 1 / 30), np.radians(5.0), True, config)
    state = min((field.settled(s) for s in (np.zeros(views, dtype=np.int64), field.greedy(views))), key=field.energy)
    state = state - state[0]
    assert np.abs((state - steady + count // 2) % count - count // 2).max() <= 1
    blind = _Field(np.zeros_like(costs), pairs, np.zeros(views - 1), np.full(views - 1, 1 / 30), 0.087, True, config)
    assert field.sigma(state).max() < blind.sigma(state).max()


def test_what_contradicts_the_poses_widens_the_doubt() -> None:
    found = Turned(np.tile(np.eye(4), (3, 1, 1)), np.radians([0.0, 10.0, 10.0]), Axis(np.eye(3)[2], np.zeros(3)))
    config = TurnConfig()
    sure, unsure = (doubted(found, config.usual * times, 0, config).sigma_rad for times in (0.5, 4.0))
    np.testing.assert_allclose(np.degrees(sure), [0, 10, 10])
    np.testing.assert_allclose(np.degrees(unsure), [0, 40, 40])
