"""A round body's axis and its azimuths: known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from processing.features.sift import Sift
from processing.sensor import view_layout as lay
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig
from processing.sensor.view_store import ViewStore
from processing.track.beam import Scene
from processing.track.revolution import azimuth_kernels as tk
from processing.track.revolution.axis import Axis, AxisConfig, open_axes
from processing.track.revolution.azimuth import (
    AzimuthConfig,
    Azimuths,
    _Frames,
    _stood,
    _trust,
    standing_terms,
    with_uncertainty,
)
from processing.track.revolution.azimuth_smoothing import Pace, SteadyConfig, steadied
from processing.track.revolution.print_match import PrintMatch, print_match
from processing.track.revolution.rolling import ExpectedSteps
from processing.track.revolution.unwrapping import (
    Unwrapped,
    UnwrappingConfig,
    _heights,
    _off,
    _Pixels,
    _shines,
)
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
        rows = np.zeros((int(facing.sum()), lay.SAMPLE))
        rows[:, :3], rows[:, 3:6] = p[facing], across[facing]
        row = np.zeros(7, dtype=np.int64)
        row[lay.FIRST], row[lay.COUNT] = sum(len(s) for s in samples), len(rows)
        poses.append(pose)
        samples.append(rows)
        table.append(row)
    store = ViewStore(Rectification.of(CAMERA), [None] * turns, ViewConfig())
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
    axis = open_axes(scene, poses, np.ones(len(poses), dtype=bool), AxisConfig())[0]
    assert abs(axis.direction[1]) == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(axis.point_m[[0, 2]], middle[[0, 2]], atol=1e-3)
    there = axis.rotation(0.7)
    np.testing.assert_allclose(there[:3, :3] @ axis.point_m + there[:3, 3], axis.point_m, atol=1e-12)


def test_a_box_has_no_open_axis() -> None:
    rng = np.random.default_rng(2)
    points, normals = [], []
    for a in range(3):
        for sign in (-1.0, 1.0):
            face = rng.uniform(-1, 1, (600, 3)) * [0.05, 0.05, 0.05]
            face[:, a] = sign * 0.05
            points.append(face)
            normals.append(np.tile(sign * np.eye(3)[a], (600, 1)))
    scene, poses = seen(np.concatenate(points), np.concatenate(normals))
    assert open_axes(scene, poses, np.ones(len(poses), dtype=bool), AxisConfig()) == []


def pace(views: int, flies: bool = False) -> Pace:
    nothing = np.zeros(views - 1)
    no = np.zeros(views, dtype=bool)
    expected = ExpectedSteps(nothing, nothing + np.inf)
    return Pace(nothing, np.full(views - 1, 1 / 30), no, no | flies, no, np.ones(views), expected)


def given(costs: np.ndarray, pairs: np.ndarray, views: int) -> tuple[object, ...]:
    p = pace(views)
    expected = p.expected.step_rad, p.expected.sigma_rad
    step, motion = 2 * np.pi / costs.shape[1], np.array([25.0, 20.0])
    return costs, pairs, p.base_rad, p.steps_s, p.still, p.spin_weight, np.full(views, 1.5), *expected, step, motion


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_azimuths_that_pairs_of_views_agree_on_are_found_from_nothing(seed: int) -> None:
    count, views = 72, 20
    rng = np.random.default_rng(seed)
    steady = 2 * np.arange(views) + rng.integers(-1, 2, views)
    steady[0] = 0
    pairs = np.array([(a, b) for a in range(views) for b in range(a) if a - b in (1, 2, 4, 7, 11)])
    gap = np.arange(count)[None] - (steady[pairs[:, 0]] - steady[pairs[:, 1]])[:, None]
    gap = np.abs((gap + count // 2) % count - count // 2)
    costs = 6 * np.minimum(gap / 3.0, 1.0) + rng.normal(0, 0.3, gap.shape)
    wild = rng.random(len(pairs)) < 0.15  # some pairs vote for something else altogether
    costs[wild] = np.roll(costs[wild], 20, axis=1)
    problem = given(costs, pairs, views)
    starts = np.zeros(views, dtype=np.int64), tk.greedy(views, *problem)
    state = min((tk.descend(s, *problem, 8, 12) for s in starts), key=lambda s: float(tk.energy(s, *problem)))
    state = state - state[0]
    assert np.abs((state - steady + count // 2) % count - count // 2).max() <= 1
    blind = given(np.zeros_like(costs), pairs, views)
    assert tk.variances(state, *problem).max() < 0.1 * tk.variances(state, *blind).max()


def test_a_stretch_that_shows_nothing_turns_as_steadily_as_what_is_seen_around_it() -> None:
    views, reach, cell = 30, 40, np.radians(1.5)
    truth = 0.04 * np.arange(views)  # 1.2 rad/s; the angles start elsewhere
    seen = (np.arange(views) < 8) | (np.arange(views) >= 22)
    pairs = np.array([(a, b) for a in range(views) for b in range(a) if seen[a] and seen[b]])
    offsets = np.arange(-reach, reach + 1)[None] * cell - (truth[pairs[:, 0]] - truth[pairs[:, 1]])[:, None]
    costs = np.minimum(np.abs(offsets) / cell, 6.0)
    start = np.where(seen, 0.0, 0.3)
    p = pace(views, flies=True)
    moved = replace(p, base_rad=-np.diff(start))
    shift = start[pairs[:, 0]] - start[pairs[:, 1]]
    assert (shift == 0).all()
    nothing = np.zeros((views, views)), np.zeros(views)
    angle, sigma = steadied(costs, pairs, nothing, moved, cell, 0, SteadyConfig())
    np.testing.assert_allclose(start + angle, truth, atol=np.radians(1.5))
    assert sigma[0] == 0
    assert sigma[15] > 2 * sigma[5]
    once = steadied(costs, pairs, nothing, moved, cell, 0, SteadyConfig(tails=1.0))[1]
    np.testing.assert_allclose(sigma, SteadyConfig().tails * once)


def test_a_stretch_that_shows_nothing_turns_as_the_body_rolls() -> None:
    views, reach, cell = 20, 40, np.radians(1.5)
    truth = np.cumsum(np.r_[0.0, 0.02 * np.arange(views - 1) * (np.arange(views - 1) < 12)])  # faster, then it stops
    pairs = np.array([(a, b) for a in range(6) for b in range(a)])
    offsets = np.arange(-reach, reach + 1)[None] * cell - (truth[pairs[:, 0]] - truth[pairs[:, 1]])[:, None]
    costs = np.minimum(np.abs(offsets) / cell, 6.0)
    rolling = replace(pace(views), expected=ExpectedSteps(-np.diff(truth), np.full(views - 1, 0.02)))
    nothing = np.zeros((views, views)), np.zeros(views)
    blind, blind_sigma = steadied(costs, pairs, nothing, pace(views), cell, 0, SteadyConfig())
    angle, sigma = steadied(costs, pairs, nothing, rolling, cell, 0, SteadyConfig())
    assert np.abs(blind - truth).max() > np.radians(10)
    np.testing.assert_allclose(angle, truth, atol=np.radians(4))
    assert sigma[-1] < 0.2 * blind_sigma[-1]


def unwrapped(appearance: np.ndarray, count: np.ndarray) -> Unwrapped:
    views, _, cells = count.shape
    empty = np.zeros((views, 1, cells))
    return Unwrapped(appearance, count, empty, np.zeros((views, 3, 1, cells)), empty, [], np.zeros((0, 2)))


def seen_half(around: np.ndarray, turns: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Maps and counts of views that see 150 degrees each of a body turned so, and err by `noise`."""
    rng = np.random.default_rng(2)
    maps = np.array([np.roll(around, -t, axis=1) for t in turns]) + rng.normal(0, noise, (len(turns), *around.shape))
    count = np.zeros(maps.shape[:3])
    count[:, :, :50] = 2.0
    return maps * (count[..., None] > 0), count


def test_a_body_of_one_colour_leaves_the_azimuth_open_and_a_wide_label_fixes_it() -> None:
    turns = np.random.default_rng(0).integers(0, 120, 10)
    pairs = np.array([(a, b) for a in range(10) for b in range(a)])
    frames, config = _Frames([[n] for n in range(10)], np.arange(10), pairs), AzimuthConfig()
    around, told = np.zeros((8, 120, 2)), []
    for label in (0.0, 0.6):
        around[2:6, 20:90, 0] = label  # over more than a view shows: its two edges tell
        seen = print_match(unwrapped(*seen_half(around, turns, 0.1)), pairs)
        trust = _trust(seen, -turns % 120, (np.zeros((len(pairs), 120)), turns), frames, config)
        costs = seen.costs(np.array(trust.correlations))
        told.append(trust.appearance * float(costs.mean()))
    assert told[0] == 0.0  # no correlation is likelier than any
    assert told[1] > 0.3
    at = np.arange(len(pairs)), (turns[pairs[:, 1]] - turns[pairs[:, 0]]) % 120
    assert costs[at].mean() < 0.15 * costs.mean()


def test_print_all_over_tells_the_azimuth_to_a_cell() -> None:
    rng = np.random.default_rng(1)
    turns = np.array([0, 11, 47])
    pairs = np.array([[1, 0], [2, 0], [2, 1]])
    around = rng.normal(0, 1, (6, 120, 2)) + 5.0 * np.arange(6)[:, None, None]  # rows differ, which tells nothing
    appearance = np.array([np.roll(around, -t, axis=1) for t in turns]) + rng.normal(0, 0.5, (3, 6, 120, 2))
    seen = print_match(unwrapped(appearance, np.full((3, 6, 120), 2.0)), pairs)
    at = (turns[pairs[:, 1]] - turns[pairs[:, 0]]) % 120
    np.testing.assert_array_equal(seen.costs(seen.best_correlations()).argmin(1), at)
    np.testing.assert_allclose(seen.best_correlations(at), 1 / (1 + 0.5**2))


def test_the_log_ratio_is_that_of_correlated_to_independent_samples() -> None:
    r, a, b = 0.7, np.array([0.4, -1.2, 2.0]), np.array([0.1, -0.8, -0.3])
    seen = PrintMatch(*np.array([[[[a @ b]]] * 2, [[[a @ a + b @ b]]] * 2]), np.array([[3.0]]), 1.0)
    both = multivariate_normal(cov=[[1, r], [r, 1]]).logpdf(np.column_stack([a, b])).sum()
    alone = norm.logpdf(np.concatenate([a, b])).sum()
    assert seen._log_ratio(1, r)[0, 0] == pytest.approx(both - alone)


def test_inconsistency_of_the_poses_widens_the_uncertainty() -> None:
    found = Azimuths(np.tile(np.eye(4), (3, 1, 1)), np.radians([0.0, 10.0, 10.0]), Axis(np.eye(3)[2], np.zeros(3)))
    config = AzimuthConfig()
    sure, unsure = (with_uncertainty(found, config.usual * times, 0, config).sigma_rad for times in (0.5, 4.0))
    np.testing.assert_allclose(np.degrees(sure), [0, 10, 10])
    np.testing.assert_allclose(np.degrees(unsure), [0, 40, 40])


def test_a_lamp_makes_a_colour_paler_but_not_the_opposite_one() -> None:
    usual = np.array([0.8, -0.2])
    brighter = 0.5
    lamp, label, shade = -0.7 * usual, -1.6 * usual, -0.1 * usual
    left = np.array([[*lamp, brighter], [*label, brighter], [*shade, 0.0]])
    assert _shines(left, usual, UnwrappingConfig()).tolist() == [True, False, False]


def test_places_have_the_height_above_the_table_that_pixels_around_them_have() -> None:
    up, offset = np.array([0.0, -0.6, -0.8]), 0.7
    v, u = np.mgrid[0:30, 0:40]
    depth = (0.8 + 0.002 * u + 0.003 * v).astype(np.float32)
    points = np.stack([(u + 300 - 320) / 386, (v + 200 - 240) / 386, np.ones_like(u)], -1) * depth[..., None]
    nothing = np.zeros(depth.shape, dtype=bool)
    color = np.zeros((*depth.shape, 3), np.float32)
    heights = (points @ up + offset).astype(np.float32)
    crop = Crop(0, (300, 200), nothing, depth, color, nothing, heights, 0.0)
    store = ViewStore(Rectification.of(CAMERA), [crop], ViewConfig())
    places = np.random.default_rng(0).normal([0, 0, 0.9], 0.05, (2, 5, 3))
    np.testing.assert_allclose(_heights(store, 0, places), places @ up + offset, atol=1e-4)


def test_the_table_seen_through_a_handle_stands_not_off_the_body() -> None:
    heights_m = np.array([0.001, 0.004, 0.012, 0.04, np.inf])
    n = len(heights_m)
    aside = np.tile([0.0, 1.0, 0.0], (n, 1))
    p = _Pixels(np.full(n, 0.02), np.full(n, 0.055), np.zeros(n), aside, np.ones(n), aside, np.zeros((n, 2)),
                np.zeros(n), heights_m, np.zeros((n, lay.SAMPLE), np.float32))  # fmt: skip
    *_, off = _off(p, np.full(20, 0.04), 0.0, 0.0, UnwrappingConfig())
    assert off.tolist() == [False, False, True, True, True]
    *_, off = _off(p, np.full(20, 0.04), 0.0, 0.02, UnwrappingConfig())  # a matcher's window joins body and table
    assert off.tolist() == [False, False, False, True, True]
    *_, off = _off(p, np.full(20, 0.04), 0.0, 0.036, UnwrappingConfig())  # and runs past the outline by half of it
    assert not off.any()


def test_frames_between_which_the_body_stands_still_turn_together() -> None:
    rng = np.random.default_rng(3)
    axis = Axis(np.array([0.0, 1.0, 0.0]), np.array([0.01, 0.0, 0.02]))
    stands = np.eye(4)
    stands[:3, :3], stands[:3, 3] = rotation_exp(np.array([0.4, -0.3, 1.0])), [0.1, 0.0, 0.8]
    poses = np.array([stands @ axis.rotation(a) for a in rng.uniform(-1, 1, 6)])
    found = _stood(poses, _Frames([[0, 1, 2], [3], [4, 5]], np.array([1, 3, 4]), np.zeros((0, 2), int)), axis, 0)
    np.testing.assert_allclose(found[0], poses[0], atol=1e-12)
    np.testing.assert_allclose(found[1:3], found[[0, 0]], atol=1e-12)
    np.testing.assert_allclose(found[4], found[5], atol=1e-12)
    # how the runs lie to each other stays
    np.testing.assert_allclose(found[1] @ np.linalg.inv(found[3]), poses[1] @ np.linalg.inv(poses[3]), atol=1e-12)


def test_what_contradicts_itself_tells_little() -> None:
    rng = np.random.default_rng(0)
    views, config = 12, AzimuthConfig()
    cells = config.cells
    pairs = np.array([(a, b) for a in range(views) for b in range(a)])
    frames = _Frames([[n] for n in range(views)], np.arange(views), pairs)
    no_print = PrintMatch(*np.zeros((2, 2, len(pairs), cells)), np.zeros((len(pairs), cells)), 1.0)
    noise = rng.uniform(0.0, 2.0, (len(pairs), cells))
    state = rng.integers(0, cells, views)
    assert _trust(no_print, state, (noise, state), frames, config).shape < 0.01
    label = np.full((len(pairs), cells), 2.0)
    at = (state[pairs[:, 0]] - state[pairs[:, 1]])[:, None] + np.arange(-2, 3)
    np.put_along_axis(label, at % cells, 0.0, axis=1)
    assert _trust(no_print, state, (label + 0.05 * noise, state), frames, config).shape == 1.0


def test_a_spin_may_change_at_a_release_and_hardly_in_flight() -> None:
    """Nothing shows the azimuth; the body is still in the hand, and flies from view 8 on."""
    views, pairs = 24, np.array([(n, n - 1) for n in range(1, 24)])
    costs = np.zeros((len(pairs), 120))
    costs[:7] = 20 * (np.arange(120) > 0)  # the hand shows
    problem = given(costs, pairs, views)
    tight = tk.variances(np.zeros(views, dtype=np.int64), *problem)
    usual = np.where(np.arange(views) == 8, 34.6, 1.5)
    free = tk.variances(np.zeros(views, dtype=np.int64), *problem[:6], usual, *problem[7:])
    assert np.degrees(np.sqrt(free[:8])).max() < 2
    assert free[12] > 2 * tight[12]
    assert np.degrees(np.sqrt(free[23])) > 60


def test_what_stands_off_the_body_fixes_an_azimuth() -> None:
    """Two views of a handle's side, a plate beside the axis; the second's pose is turned by what must be found."""
    axis, wrong = Axis(np.array([0.0, 1.0, 0.0]), np.zeros(3)), np.radians(3.0)
    turns, crops = (0.1, 0.4), []
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = 0.7
    for n, turn in enumerate(turns):
        pose = poses[n] @ axis.rotation(turn)
        v, u = np.mgrid[180:300, 280:400]
        rays = np.stack([(u - 320) / 386, (v - 240) / 386, np.ones(u.shape)], -1)
        depth = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
        x, y, _ = np.moveaxis((rays * depth[..., None] - pose[:3, 3]) @ pose[:3, :3], -1, 0)
        mask = (x > 0.03) & (x < 0.07) & (np.abs(y) < 0.03)
        nothing, depth = np.zeros(mask.shape, bool), np.where(mask, depth, 0).astype(np.float32)
        crops.append(Crop(n, (280, 180), mask, depth, np.zeros((*mask.shape, 3), np.float32), nothing, None, 0.0))
        poses[n] = poses[n] @ axis.rotation(turn + n * wrong)
    store = ViewStore(Rectification.of(CAMERA), crops, ViewConfig())
    assert all(store.fill(n) for n in range(2))
    frames = _Frames([[0], [1]], np.arange(2), np.array([(1, 0)]))
    standing = [store.samples[r[lay.FIRST] : r[lay.FIRST] + r[lay.COUNT]] for r in store.table]
    config = AzimuthConfig()
    H, g = standing_terms(store, poses, frames, standing, axis, config)
    assert -g[1] / H[1, 1] == pytest.approx(-wrong, rel=0.15)
    np.testing.assert_allclose(H @ [1, 1], 0, atol=1e-9 * H[1, 1])
    assert g[0] == pytest.approx(-g[1])
    few = standing_terms(store, poses, frames, [s[: config.least_standing - 1] for s in standing], axis, config)
    assert not few[0].any()
    assert not few[1].any()
