"""A body of revolution's profile, and the poses that it ties together: known answers."""

from __future__ import annotations

import numpy as np
import pytest

from processing.features.sift import Sift
from processing.motion import se3_kernels as se3
from processing.sensor import view_layout as lay
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig
from processing.sensor.view_store import ViewStore
from processing.track.beam import Hypothesis, Scene
from processing.track.hypotheses import (
    HypothesisConfig,
    TrajectoryHypothesis,
    _unsure_of_azimuths,
    with_azimuths_sought,
)
from processing.track.joint_refinement import Motion, Refined
from processing.track.revolution import profile_kernels as rk
from processing.track.revolution.axis import Axis, angles_between
from processing.track.revolution.azimuth import AzimuthConfig, given_azimuths
from processing.track.revolution.profile import BodyConfig, RoundBody, anchored, is_round, laid_on_profile
from recordings.geometry import CameraModel, rotation_exp

CAMERA = CameraModel("d455", 640, 480, np.array([[386.0, 0, 320], [0, 386, 240], [0, 0, 1]]))
RADIUS_M, HALF_M = 0.04, 0.05
AXIS = Axis(np.array([0.0, 0.0, 1.0]), np.zeros(3))


def can_poses() -> np.ndarray:
    """A can that turns over before the camera."""
    out = []
    for n in range(8):
        pose = np.eye(4)
        pose[:3, :3] = rotation_exp(np.array([0.5 + 0.3 * n, 0.0, 0.0])) @ rotation_exp(np.array([0.0, 0.0, 0.7 * n]))
        pose[:3, 3] = [0.01 * n, -0.02, 0.7 + 0.01 * n]
        out.append(pose)
    return np.array(out)


def can(poses: np.ndarray, printed: bool = False) -> ViewStore:
    """What the camera sees of it, without noise: mask and colours by the rays that hit, samples of what faces it."""
    rectified = Rectification.of(CAMERA)
    crops, views = [], []
    for n, pose in enumerate(poses):
        center = (pose[:2, 3] / pose[2, 3] * 386 + [320, 240]).astype(int)
        corner = (int(center[0]) - 60, int(center[1]) - 60)
        v, u = np.mgrid[0:120, 0:120]
        rays = np.stack([(u + corner[0] - 320) / 386, (v + corner[1] - 240) / 386, np.ones_like(u)], -1)
        z, normal = seen(rays.reshape(-1, 3), pose)
        hit = np.isfinite(z)
        depth = np.where(hit, z, 0).reshape(120, 120).astype(np.float32)
        mask = hit.reshape(120, 120)
        surface = (rays * np.where(hit, z, 0.0).reshape(120, 120, 1) - pose[:3, 3]) @ pose[:3, :3]
        color = print_at(surface) if printed else np.zeros((120, 120, 3), np.float32)
        crops.append(Crop(n, corner, mask, depth, color, np.zeros_like(mask), None, 0.0))
        inside = np.flatnonzero(hit)
        chosen = np.random.default_rng(n).permutation(inside)[:500]
        views.append((rays.reshape(-1, 3)[chosen] * z[chosen, None], normal[chosen]))
    store = ViewStore(rectified, list(crops), ViewConfig())
    for n, (points, normals) in enumerate(views):
        first = int(store.table[n, lay.FIRST])
        store.samples[first : first + len(points), :6] = np.concatenate([points, normals], 1)
        store.table[n, [lay.U0, lay.V0, lay.WIDTH, lay.HEIGHT, lay.COUNT]] = [*crops[n].corner, 120, 120, len(points)]
        offset = int(store.table[n, lay.OFFSET])
        store.maps[offset : offset + 120 * 120, lay.Z] = crops[n].depth_m.ravel()
    return store


def print_at(surface_m: np.ndarray) -> np.ndarray:
    """Patches of 20 degrees and 20 mm in colours of their own."""
    colors = np.random.default_rng(7).uniform(0.2, 0.8, (18, 5, 3)).astype(np.float32)
    around = np.floor((np.arctan2(surface_m[..., 1], surface_m[..., 0]) / (2 * np.pi) + 0.5) * 18).astype(int)
    return colors[around % 18, np.clip((surface_m[..., 2] + HALF_M) / 0.02, 0, 4).astype(int)]


def seen(rays: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth along each ray (infinite: it misses) and normals, camera axes."""
    start, way = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
    z, normal = np.full(len(rays), np.inf), np.zeros((len(rays), 3))
    a, b = np.sum(way[:, :2] ** 2, 1), way[:, :2] @ start[:2]
    root = b * b - a * (start[:2] @ start[:2] - RADIUS_M**2)
    with np.errstate(invalid="ignore"):
        wall = (-b - np.sqrt(root)) / a
    ok = np.abs(start[2] + wall * way[:, 2]) < HALF_M
    z[ok] = wall[ok]
    normal[ok, :2] = (start + wall[:, None] * way)[ok, :2] / RADIUS_M
    for side in (-1.0, 1.0):
        t = (side * HALF_M - start[2]) / way[:, 2]
        at = start + t[:, None] * way
        ok = (np.hypot(at[:, 0], at[:, 1]) < RADIUS_M) & (t < z)
        z[ok], normal[ok] = t[ok], [0.0, 0.0, side]
    return z, normal @ pose[:3, :3].T


def solved(body: RoundBody, poses: np.ndarray, steps: int = 8) -> np.ndarray:
    place = np.arange(len(poses))
    for _ in range(steps):
        H, g = np.zeros((len(poses), len(poses), 6, 6)), np.zeros((len(poses), 6))
        body.add(H, g, poses, place)
        full = H.transpose(0, 2, 1, 3).reshape(6 * len(poses), -1)
        free = np.kron(np.eye(len(poses)), np.diag([0, 0, 0, 0, 0, 1.0]))  # no view's turn about the axis (z)
        twists = -np.linalg.solve(full + 1e3 * np.trace(full) / len(full) * free, g.reshape(-1)).reshape(-1, 6)
        poses = np.array([p @ se3.inverse(se3.exponential(t)) for p, t in zip(poses, twists)])
    return poses


@pytest.fixture(scope="module")
def cans() -> tuple[ViewStore, np.ndarray]:
    return can(can_poses()), can_poses()


def test_views_that_drifted_along_and_off_the_axis_come_back_to_one_body(cans: tuple[ViewStore, np.ndarray]) -> None:
    store, truth = cans
    drifted = truth.copy()
    for n in range(len(truth)):
        away = np.array([0.0, 0.0002 * n, 0.0006 * n, 0.004 * n, 0.0, 0.0])
        drifted[n] = truth[n] @ se3.exponential(away)
    poses = solved(RoundBody(store, drifted, np.ones(len(truth), dtype=bool), AXIS, BodyConfig()), drifted)

    def apart(found: np.ndarray) -> tuple[float, float]:
        """Of each view's axis against the first view's: along or off it (m), and tilt (rad)."""
        gaps = np.linalg.inv(found) @ truth
        gaps = gaps @ np.linalg.inv(gaps[0])
        return float(np.linalg.norm(gaps[:, :3, 3], axis=1).max()), float(np.arccos(gaps[:, 2, 2].clip(-1, 1)).max())

    assert apart(drifted)[0] > 0.004
    shift, tilt = apart(poses)
    assert shift < 0.0007
    assert tilt < np.radians(0.5)


def test_right_poses_show_the_body_as_large_as_it_is(cans: tuple[ViewStore, np.ndarray]) -> None:
    store, truth = cans
    body = RoundBody(store, truth, np.ones(len(truth), dtype=bool), AXIS, BodyConfig())
    solved(body, truth, 6)
    assert body._y[rk.HIGH] - body._y[rk.LOW] == pytest.approx(2 * HALF_M, abs=1e-3)
    assert body.radius_m == pytest.approx(RADIUS_M, abs=5e-4)
    counted, _, squared = body._outline.sum(0)
    assert np.sqrt(squared / counted) < 0.4  # px


def test_outlines_say_whether_a_body_is_round_about_an_axis(cans: tuple[ViewStore, np.ndarray]) -> None:
    store, truth = cans
    every = np.ones(len(truth), dtype=bool)
    assert is_round(store, truth, every, AXIS, BodyConfig())
    assert not is_round(store, truth, every, Axis(np.array([1.0, 0.0, 0.0]), np.zeros(3)), BodyConfig())


@pytest.mark.parametrize("way", [[1.0, 0.0], [0.6, -0.8]])
def test_an_axis_that_normals_left_open_is_where_one_profile_fits_all_views(
    cans: tuple[ViewStore, np.ndarray], way: list[float]
) -> None:
    store, truth = cans
    off = np.eye(4)
    off[:3, :3] = rotation_exp(np.radians(15) * np.array([*way, 0.0]))
    off[:3, 3] = 0.003 * np.array([-way[1], way[0], 0.0])
    axis, share = laid_on_profile(store, truth, np.ones(len(truth), dtype=bool), AXIS.seen_from(off), BodyConfig())
    assert abs(axis.direction @ AXIS.direction) > np.cos(np.radians(0.5))
    assert np.linalg.norm(axis.point_m[:2]) < 5e-4
    assert share > 0.9


def test_given_azimuths_of_a_can_that_nothing_marks_stay_and_grow_uncertain() -> None:
    poses = can_poses()
    store = can(poses)
    assert all(store.fill(n) for n in range(len(poses)))
    scene = Scene(store, np.arange(len(poses)) / 30, np.zeros(3), np.zeros(3), Sift())
    given = given_azimuths(scene, poses, np.ones(len(poses), dtype=bool), AXIS, AzimuthConfig())
    np.testing.assert_array_equal(given.poses, poses)
    sigma_deg = np.degrees(given.sigma_rad)
    assert sigma_deg[0] == 0
    assert (np.diff(sigma_deg) > 0).all()
    assert sigma_deg[-1] > 10


def test_azimuths_that_slid_come_back_to_the_print_and_right_ones_stay() -> None:
    true = can_poses()
    store, n = can(true, printed=True), len(true)
    assert all(store.fill(i) for i in range(n))
    scene = Scene(store, np.arange(n) / 30, np.zeros(3), np.zeros(3), Sift())
    slid_deg = np.array([0.0, 0.0, 0.0, 60.0, 75.0, 75.0, -130.0, -130.0])
    slid = np.array([pose @ AXIS.rotation(float(np.radians(a))) for pose, a in zip(true, slid_deg)])
    for poses, most_deg in ((slid, 3.0), (true, 0.0)):
        found, axis = with_azimuths_sought(scene, poses, np.ones(n, dtype=bool), HypothesisConfig())
        assert axis is not None
        assert np.abs(np.degrees(angles_between(found, true, axis))).max() <= most_deg
        between = np.linalg.inv(found) @ poses  # they turn about the axis
        np.testing.assert_allclose(between[:, :3, :3] @ axis.direction, np.tile(axis.direction, (n, 1)), atol=1e-9)


def test_an_anchored_view_keeps_its_pose_and_the_axis_its_place_in_space() -> None:
    poses = can_poses()
    wanted = poses[2] @ se3.exponential(np.array([0.001, 0.002, -0.001, 0.01, 0.02, 0.03]))
    covariance = np.tile(np.diag([1e-6] * 6), (len(poses), 1, 1))
    moved, spread, axis = anchored(poses, covariance, AXIS, 2, wanted)
    np.testing.assert_allclose(moved[2], wanted, atol=1e-12)
    assert (spread[2] == 0).all()
    for before, after in zip(poses, moved):
        np.testing.assert_allclose(before[:3, :3] @ AXIS.direction, after[:3, :3] @ axis.direction, atol=1e-9)
        there = after[:3, :3] @ axis.point_m + after[:3, 3]
        np.testing.assert_allclose(np.cross(there - before[:3, 3], before[:3, 2]), 0, atol=1e-9)


def test_views_of_a_plain_can_that_agree_with_each_other_leave_its_azimuth_open() -> None:
    """As free views, which no profile ties, they would claim to hold it."""
    poses = can_poses()
    store, n = can(poses), len(poses)
    assert all(store.fill(i) for i in range(n))
    yes, no, none = np.ones(n, dtype=bool), np.zeros(n, dtype=bool), np.full(n, np.nan)
    motion = Motion(np.arange(n) / 30, np.zeros(n, dtype=np.int64), np.zeros(3), np.zeros(3), no)
    joint = Refined(poses, np.zeros((n, 6, 6)), np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3)))
    start = Hypothesis(poses, none, none, tuple(range(n)), (0,), 0.0)
    free = TrajectoryHypothesis(start, yes, no, joint, np.zeros(3), motion, 0.0, np.full(n, -1))
    scene = Scene(store, motion.times_s, np.zeros(3), np.zeros(3), Sift())
    found = _unsure_of_azimuths(scene, free, 0, HypothesisConfig())
    assert found.axis is None
    assert found.azimuths is not None
    assert abs(found.azimuths.axis.direction[2]) > 0.99
    sigma_deg = np.degrees(found.azimuths.sigma_rad)
    assert sigma_deg[0] == 0
    assert (np.diff(sigma_deg) > 0).all()
    assert sigma_deg[-1] > 10
