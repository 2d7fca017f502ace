"""Depth that errs smoothly is an unknown of the joint refinement: its derivatives, and what it spares the poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from processing.motion import se3_kernels as se3
from processing.sensor import view_layout as lay
from processing.sensor.noise import DepthNoise
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k
from processing.track.depth_error import kernels as e
from processing.track.depth_error.fields import DepthErrors
from processing.track.joint_refinement import GraphConfig, Motion, refine
from recordings.geometry import CameraModel, rotation_log

CAMERA = CameraModel("d455", 120, 100, np.array([[500.0, 0, 60], [0, 500, 50], [0, 0, 1]]))
FOCAL, CENTER = np.array([500.0, 500.0]), np.array([60.0, 50.0])
AXES_M, FAR_M, TURN_RAD = np.array([0.06, 0.045, 0.035]), 0.8, np.radians(20)
NOISE = DepthNoise(0.006, 200.0)
FINEST = ((0, 15, 0.0035, 0.08, 0.004, 1.0),)


def print_of(points: np.ndarray) -> np.ndarray:
    """Colour (0..1) of an ellipsoid's points: a dense print."""
    x, y, z = np.moveaxis(points / 0.012, -1, 0)
    tones = np.sin(x + 2 * y), np.sin(1.7 * y - z), np.sin(1.3 * z + 0.6 * x)
    return np.stack([0.5 + 0.3 * t for t in tones], -1)


def crop_of(position: int, pose: np.ndarray, tilt: float) -> Crop:
    """What the camera sees of the ellipsoid, its depth longer by a share `tilt` for every pixel to the right."""
    v, u = np.indices((CAMERA.height, CAMERA.width))
    rays = np.stack([(u - CENTER[0]) / FOCAL[0], (v - CENTER[1]) / FOCAL[1], np.ones(u.shape)], -1)
    own = rays @ pose[:3, :3] / AXES_M
    start = -pose[:3, :3].T @ pose[:3, 3] / AXES_M
    a, b, c = (own**2).sum(-1), own @ start, start @ start - 1
    inside = b**2 - a * c
    on = inside > 0
    z = np.where(on, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0)
    color = np.where(on[..., None], print_of((rays * z[..., None] - pose[:3, 3]) @ pose[:3, :3]), 0.1)
    depth_m = (z * (1 + tilt * (u - CENTER[0]))).astype(np.float32)
    nothing = np.zeros(on.shape, dtype=bool)
    return Crop(position, (0, 0), on, depth_m, color.astype(np.float32), nothing, None, 0.0)


def turned_poses(count: int) -> np.ndarray:
    poses = np.stack([se3.exponential(np.array([0, 0, 0, 0.3, TURN_RAD * i, 0.1 * i])) for i in range(count)])
    poses[:, 2, 3] += FAR_M
    return poses


def store_of(poses: np.ndarray, tilt: float) -> ViewStore:
    crops = [crop_of(i, pose, tilt) for i, pose in enumerate(poses)]
    store = ViewStore(Rectification.of(CAMERA), list(crops), ViewConfig())
    assert all(store.fill(i) for i in range(len(crops)))
    return store


def refined(poses: np.ndarray, tilt: float, noise: DepthNoise | None):
    n = len(poses)
    motion = Motion(np.arange(n) / 30, np.zeros(n, dtype=np.int64), np.array([0.0, 9.81, 0.0]), np.zeros(3),
                    np.zeros(n, dtype=bool))  # fmt: skip
    config = replace(GraphConfig(), schedule=FINEST, depth_errors=noise, velocity_change_m_s=1e3, spin_change_rad_s=1e3)
    fixed = np.arange(n) == 0
    return refine(store_of(poses, tilt), poses, np.ones(n, dtype=bool), fixed, motion, replace(config, jerk_rad_s=None))


def turned_wrongly_deg(found: np.ndarray, true: np.ndarray) -> float:
    """How far the last view is turned against the first, beside the truth."""
    gap = found[-1][:3, :3].T @ found[0][:3, :3] @ true[0][:3, :3].T @ true[-1][:3, :3]
    return float(np.degrees(np.linalg.norm(rotation_log(gap))))


def test_depth_that_is_tilted_alike_in_every_picture_turns_a_body_less_where_it_is_solved_for() -> None:
    poses = turned_poses(6)
    taken = turned_wrongly_deg(refined(poses, 6e-4, None).poses, poses)
    solved = turned_wrongly_deg(refined(poses, 6e-4, NOISE).poses, poses)
    assert taken > 5.0
    assert solved < 0.6 * taken


@pytest.mark.parametrize("sigma_at_1m", [0.0, 1e-5])
def test_depth_that_hardly_errs_is_taken_as_it_is(sigma_at_1m: float) -> None:
    poses = turned_poses(4)
    exact, taken = (refined(poses, 0.0, noise).poses for noise in (DepthNoise(sigma_at_1m, 200.0), None))
    assert turned_wrongly_deg(exact, poses) == pytest.approx(turned_wrongly_deg(taken, poses), abs=0.1)


def test_what_all_depth_of_a_view_errs_by_alike_is_left_to_its_pose() -> None:
    store, every = store_of(turned_poses(3), 0.0), np.ones(3, dtype=bool)
    errors = DepthErrors(store, every, NOISE, 8.0, 0.1)
    poses = turned_poses(3)
    poses[1, 2, 3] += 0.004
    pairs = np.array([[i, j] for i in range(3) for j in range(3) if i != j])
    row = np.array([0, 1, 0.0035, 0.08, 0.004, 1.0, 0.0])
    errors.add(np.zeros((1, 1, 6, 6)), np.zeros((1, 6)), poses, pairs, np.array([-1, 0, -1]), row)
    errors.follow(np.zeros((1, 6)))
    assert np.abs(errors.relative[1]).max() > 1e-3  # the views disagree, and the pose does not move here ...
    assert abs(errors.relative[1].mean()) < 0.2 * np.abs(errors.relative[1]).max()  # ... but the mean does not follow


def test_poses_are_known_less_well_where_depth_may_err() -> None:
    poses = turned_poses(3)
    exact, erring = (refined(poses, 0.0, noise).covariance for noise in (DepthNoise(1e-6, 200.0), NOISE))
    assert all(np.trace(b[:3, :3]) > np.trace(a[:3, :3]) for a, b in zip(exact[1:], erring[1:], strict=True))


def test_the_covariance_says_itself_how_coarse_depth_is() -> None:
    """Nothing within a run may count the session's noise once more."""
    poses = turned_poses(3)
    fine, coarse = (
        np.trace(refined(poses, 0.0, noise).covariance[-1, 3:, 3:]) for noise in (DepthNoise(0.002, 50.0), NOISE)
    )
    assert coarse > 1.5 * fine


def one_pair(errors: np.ndarray, side: int = 3):
    """Normal equations of the pair (0, 1) of two views at these errors (2, nodes): depth, print and outline."""
    poses = turned_poses(2)
    store = store_of(poses, 0.0)
    row = np.array([0, 1, 0.0035, 0.08, 0.004, 1.0, 0.0])
    boxes = np.tile([20.0, 15.0, 40.0, 35.0], (2, 1))
    size = e.POSE + 2 * side**2
    H, g = np.zeros((size, size)), np.zeros(size)
    mine = store.samples[: store.table[0, lay.COUNT]]
    pose = poses[1] @ se3.inverse(poses[0])
    e.pair_terms(mine, 1, pose, store.maps, store.table[1], FOCAL, CENTER, 0, *row[2:5], side, boxes, errors, H, g)
    H = np.tril(H) + np.tril(H, -1).T
    plain = np.zeros((6, 6)), np.zeros(6), np.zeros((6, k.SHADING)), np.zeros((k.SHADING + 1, k.SHADING))
    k.pair_terms(mine, 1, pose, store.maps, store.table[1], FOCAL, CENTER, 0, *row[2:5], False, True, plain[0],
                 plain[1], plain[0], plain[1], plain[2], plain[3])  # fmt: skip
    return H, g, plain


def test_without_errors_a_pair_says_of_poses_and_shading_what_it_said() -> None:
    H, g, (H0, g0, B, N) = one_pair(np.zeros((2, 9)))
    twist, shading = slice(0, 6), slice(6, e.POSE)
    full = np.tril(H0) + np.tril(H0, -1).T
    np.testing.assert_allclose(H[twist, twist], full, rtol=1e-5, atol=1e-6 * np.abs(full).max())
    np.testing.assert_allclose(g[twist], g0, rtol=1e-4, atol=1e-5 * np.abs(g0).max())
    np.testing.assert_allclose(H[twist, shading], B, rtol=1e-5, atol=1e-6 * np.abs(B).max())
    np.testing.assert_allclose(H[shading, shading], N[:-1], rtol=1e-5, atol=1e-6 * np.abs(N).max())
    np.testing.assert_allclose(g[shading], N[-1], rtol=1e-5, atol=1e-6 * np.abs(N).max())


@pytest.mark.parametrize("view", [0, 1])
def test_what_a_pair_pulls_at_changes_with_an_error_as_its_normal_equations_say(view: int) -> None:
    """g(errors + step) = g + H step, in the mean over a view's nodes (weights change a little, too)."""
    step = np.zeros((2, 9))
    step[view] = 5e-5
    H, _, _ = one_pair(np.zeros((2, 9)))
    more, less = one_pair(step)[1], one_pair(-step)[1]
    found = (more - less) / 2
    wanted = H @ np.concatenate([np.zeros(e.POSE), step.ravel()])
    nodes = slice(e.POSE, None)
    assert found[nodes] @ wanted[nodes] > 0.95 * np.linalg.norm(found[nodes]) * np.linalg.norm(wanted[nodes])
    assert np.linalg.norm(found[nodes]) == pytest.approx(np.linalg.norm(wanted[nodes]), rel=0.25)


def test_grids_are_as_fine_as_depth_errs_alike_and_no_finer_than_can_be_solved_for() -> None:
    store = store_of(turned_poses(3), 0.0)
    sides = [round(DepthErrors(store, np.ones(3, dtype=bool), DepthNoise(0.005, px), 8.0, 0.1).relative.shape[1] ** 0.5)
             for px in (4.0, 400.0, 1e6)]  # fmt: skip
    assert sides == [6, 4, 3]
