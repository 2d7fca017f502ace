"""The pull of each compiled kernel against finite differences of its cost, one residual at a time.

Every kernel adds J^T w J to H and J^T w r to g for the residual r of a point. Where one point has one residual, the
cost C(r) that the kernel returns tells r's derivative: dC = C'(r) dr. The tests say by which factor g may differ from
dC (the weight is another function than the cost's derivative: on purpose, said at each test), and that its direction
does not.
"""

from __future__ import annotations

import numpy as np
import pytest

from processing.motion import se3_kernels as se3
from processing.motion.twist_terms import add_depth, to_object
from processing.sensor import view_layout as lay
from processing.track import kernels as k
from processing.track.joint_refinement import Motion, motion_residual
from processing.track.registration import consistency_kernels as c
from processing.track.revolution import profile_kernels as rk

FOCAL, CENTER = np.array([600.0, 610.0]), np.array([40.0, 30.0])
WIDTH, HEIGHT = 80, 60
ROW = np.array([0, 0, 0, WIDTH, HEIGHT, 0, 1], dtype=np.int64)
STEP = 1e-6
S_GEO, S_INT, S_OUT = 0.004, 0.3, 0.006


def plane_maps(normal=(0.1, -0.2, -1.0), distance_m=0.5):
    """A view of a plane n . x = -d: exact depth, constant normal, no usable appearance."""
    n = np.array(normal) / np.linalg.norm(normal)
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([(u - CENTER[0]) / FOCAL[0], (v - CENTER[1]) / FOCAL[1], np.ones(u.shape)], -1)
    maps = np.zeros((HEIGHT, WIDTH, lay.CHANNELS))
    maps[..., lay.Z] = distance_m * n[2] / (rays @ n)
    maps[..., lay.NX : lay.NZ + 1] = n
    maps[..., lay.SHARP :] = lay.NO_APPEARANCE
    return np.ascontiguousarray(maps.reshape(-1, lay.CHANNELS)), n


def sample_at(maps, u, v, off_m, normal, distance_m=0.5):
    """One sample that lies `off_m` off the plane along its normal at pixel (u, v); without appearance."""
    z = maps[v * WIDTH + u, lay.Z]
    point = z * np.array([(u + 0.23 - CENTER[0]) / FOCAL[0], (v - 0.31 - CENTER[1]) / FOCAL[1], 1.0])
    point *= distance_m * normal[2] / (point @ normal)  # onto the plane, along its own ray
    sample = np.full((1, lay.SAMPLE), lay.NO_APPEARANCE)
    sample[0, :3], sample[0, 3:6] = point + off_m * normal, normal
    return sample


def moved(twist):
    """4x4 of a twist (translation, rotation) of points in the other camera's frame, to first order exact."""
    return se3.exponential(np.asarray(twist, dtype=np.float64))


def pair(maps, sample, pose=None, level=0, round_body=False):
    H, g = np.zeros((6, 6)), np.zeros(6)
    cost, _, _, _ = k.pair_terms(sample, 1, np.eye(4) if pose is None else pose, maps, ROW, FOCAL, CENTER, level, S_GEO,
                                 S_INT, S_OUT, round_body, False, H, g, H, g, *k.NO_SHADING)  # fmt: skip
    return cost, H, g


def slopes(cost):
    """Central differences of a cost by each of the six coordinates of a twist."""
    return np.array([(cost(moved(STEP * e)) - cost(moved(-STEP * e))) / (2 * STEP) for e in np.eye(6)])


@pytest.mark.parametrize("off_m", [-0.009, -0.002, 0.001, 0.004, 0.010])
def test_a_views_depth_pulls_as_its_truncated_square_with_tukeys_weight(off_m):
    maps, normal = plane_maps()
    sample = sample_at(maps, 44, 25, off_m, normal)
    _, H, g = pair(maps, sample)
    wanted = slopes(lambda pose: pair(maps, sample, pose)[0])
    r = off_m / S_GEO
    # cost: r^2 / 18, cut off at 3; pull: Tukey's biweight of the same residual, so that what nears the cut lets go
    factor = 9 * (1 - r * r / 9) ** 2
    np.testing.assert_allclose(g, factor * wanted, rtol=2e-3, atol=2e-3 * np.abs(g).max())
    J = np.concatenate([normal, np.cross(sample[0, :3], normal)])
    full = (1 - r * r / 9) ** 2 / S_GEO**2 * np.outer(J, J)
    np.testing.assert_allclose(np.tril(H), np.tril(full), rtol=1e-3, atol=1e-3 * np.abs(full).max())


def depth_terms(turn_share, points, normals, off_m):
    """H, g of depth residuals `off_m` (n) along normals (n, 3) at points (n, 3), as graph_terms adds them."""
    J = np.concatenate([normals, np.cross(points, normals)], axis=1)
    H, g = np.zeros((6, 6)), np.zeros(6)
    add_depth(np.tril(J.T @ J), J.T @ off_m, turn_share, H, g)
    return H + np.tril(H, -1).T, g, J


def test_what_is_between_two_poses_leads_from_one_to_the_other():
    one, other = (se3.exponential(np.random.default_rng(seed).normal(size=6)) for seed in (4, 5))
    np.testing.assert_allclose(se3.between(other, one) @ one, other, atol=1e-12)


def test_normal_equations_of_the_camera_become_those_of_the_object():
    """Of residuals J t for the points' twist t in the camera, by the object frame's twist that moves them alike."""
    rng = np.random.default_rng(3)
    J, r, pose = rng.normal(size=(20, 6)), rng.normal(size=20), se3.exponential(rng.normal(size=6))
    H, g = np.zeros((6, 6)), np.zeros(6)
    to_object(np.tril(J.T @ J), J.T @ r, pose, -1.0, H, g)
    K = -J @ se3.adjoint(pose)
    np.testing.assert_allclose(H, K.T @ K, atol=1e-12 * np.abs(H).max())
    np.testing.assert_allclose(g, K.T @ r, atol=1e-12 * np.abs(g).max())


@pytest.fixture
def curved():
    """Points of a bowl half a metre away, and their normals."""
    normals = np.random.default_rng(0).normal(size=(200, 3)) * [0.4, 0.4, 0.1] - [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return 0.05 * normals + [0.02, -0.01, 0.5] + 0.01 * np.random.default_rng(1).normal(size=(200, 3)), normals


def test_depth_that_counts_in_full_adds_its_own_normal_equations(curved):
    off_m = np.random.default_rng(2).normal(size=200)
    H, g, J = depth_terms(1.0, *curved, off_m)
    np.testing.assert_allclose(H, J.T @ J, atol=1e-9 * np.abs(H).max())
    np.testing.assert_allclose(g, J.T @ off_m, atol=1e-9 * np.abs(g).max())


@pytest.mark.parametrize("turn_share", [0.1, 0.5])
def test_less_of_depths_say_on_turns_leaves_shifts_as_they_are(turn_share, curved):
    """A residual that a shift answers in full pulls in full, along all six; one that only a turn answers pulls by its
    share; and information on shifts is the same."""
    points, normals = curved
    as_shift = normals @ np.array([0.001, -0.002, 0.003])
    full, pull, J = depth_terms(1.0, points, normals, as_shift)
    H, g, _ = depth_terms(turn_share, points, normals, as_shift)
    np.testing.assert_allclose(g, pull, atol=1e-4 * np.abs(pull).max())
    np.testing.assert_allclose(H[:3, :3], full[:3, :3], rtol=1e-4, atol=1e-4 * full[0, 0])
    no_shift = J[:, 3:] @ np.array([0.1, 0.2, -0.1])
    no_shift -= normals @ np.linalg.lstsq(normals, no_shift, rcond=None)[0]
    _, g, _ = depth_terms(turn_share, points, normals, no_shift)
    np.testing.assert_allclose(g[3:], turn_share * (J.T @ no_shift)[3:], rtol=1e-3)


@pytest.mark.parametrize("channel", range(lay.APPEARANCE))
@pytest.mark.parametrize("error", [-0.5, 0.2, 0.7])
def test_a_views_appearance_pulls_along_its_gradient_less_where_it_is_shading(channel, error):
    maps, normal = plane_maps()
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    slope_u, slope_v = 0.07, -0.04  # per pixel
    maps[:, lay.SHARP : lay.SHARP + lay.APPEARANCE] = 0.0
    maps[:, lay.SHARP + channel] = (slope_u * u + slope_v * v).reshape(-1)
    sample = sample_at(maps, 44, 25, 0.0, normal)
    p = sample[0, :3]
    at = slope_u * (FOCAL[0] * p[0] / p[2] + CENTER[0]) + slope_v * (FOCAL[1] * p[1] / p[2] + CENTER[1])
    sample[0, lay.SSHARP : lay.SSHARP + lay.APPEARANCE] = 0.0
    sample[0, lay.SSHARP + channel] = at - error
    _, _, g = pair(maps, sample)
    wanted = slopes(lambda pose: pair(maps, sample, pose)[0])
    r, square = error / S_INT, slope_u**2 + slope_v**2
    least = k.LEAST_BRIGHT_SLOPE if channel == 0 else k.LEAST_SLOPE
    # on purpose: gradients below `least` a pixel are shading, which stays with the room; their cost counts, their pull
    # hardly. And the APPEARANCE channels share one half of a point's cost, but pull each as a whole.
    trusted = (1 - r * r / 9) * square / (square + least**2)
    np.testing.assert_allclose(g, lay.APPEARANCE * 9 * trusted**2 * wanted, rtol=2e-3, atol=2e-3 * np.abs(g).max())


def test_an_appearances_derivative_by_its_shading_is_the_change_of_the_normal():
    maps, normal = plane_maps()
    maps[:, lay.SHARP : lay.SHARP + lay.APPEARANCE] = 0.0
    maps[:, lay.SHARP + 1] = 0.07 * np.tile(np.arange(WIDTH), HEIGHT)
    turn = moved([0, 0, 0, 0.2, -0.1, 0.3])
    own = sample_at(maps, 44, 25, 0.0, normal)
    sample = own.copy()
    sample[0, :3], sample[0, 3:6] = turn[:3, :3].T @ own[0, :3], turn[:3, :3].T @ normal
    sample[0, lay.SSHARP : lay.SSHARP + lay.APPEARANCE] = [0.0, 0.07 * 44.0, 0.0]
    H, g, B, N = np.zeros((6, 6)), np.zeros(6), np.zeros((6, k.SHADING)), np.zeros((k.SHADING + 1, k.SHADING))
    k.pair_terms(sample, 1, turn, maps, ROW, FOCAL, CENTER, 0, S_GEO, S_INT, S_OUT, False, True, H, g, H, g, B, N)
    change = sample[0, 3:6] - normal
    np.testing.assert_allclose(N[-1, 3:6] * change[0], N[-1, 3] * change, rtol=1e-5)  # r^T W K is along K ...
    np.testing.assert_allclose(N[3:6, 3:6] / np.trace(N), np.outer(change, change) / (change @ change), rtol=1e-5)
    appearance = g * N[3, 3] / N[-1, 3]  # ... and J^T W K along J, but for the share of depth, some micrometres off
    np.testing.assert_allclose(B[:, 3], appearance, rtol=1e-3, atol=2e-3 * np.abs(appearance).max())
    assert np.abs(np.delete(N, [3, 4, 5, 9], 0)).max() == np.abs(N[:, [0, 1, 2, 6, 7, 8]]).max() == 0


def outside_maps(slope_u, slope_v):
    """A view whose silhouette is far off: the distance to it is linear in the pixels."""
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    maps = np.zeros((HEIGHT, WIDTH, lay.CHANNELS))
    maps[..., lay.OUTSIDE] = 3.0 + slope_u * (u - 44) + slope_v * (v - 25)
    return maps.reshape(-1, lay.CHANNELS)


def test_a_point_outside_the_silhouette_is_pulled_by_the_slope_of_its_distance_a_pixel_at_a_time():
    # On purpose: the distance is that of the nearest pixel, so the cost is flat within a pixel. Steps of one pixel see
    # its slope. What the gap in metres (distance in pixels times z / f) changes by z alone is left out of the pull.
    slope_u, slope_v, z = 0.02, 0.03, 0.5
    maps = outside_maps(slope_u, slope_v)
    sample = np.full((1, lay.SAMPLE), lay.NO_APPEARANCE)
    sample[0, :3] = z * np.array([(44 - CENTER[0]) / FOCAL[0], (25 - CENTER[1]) / FOCAL[1], 1.0])
    sample[0, 3:6] = 0.0, 0.0, -1.0
    cost, _, g = pair(maps, sample)
    gap = 3.0 * z / FOCAL[0]
    assert cost == pytest.approx((gap / S_OUT) ** 2 / 9)
    pixel = z / FOCAL
    for axis in (0, 1):
        step = np.eye(6)[axis] * pixel[axis]
        up, down = (pair(maps, sample, moved(s * step))[0] for s in (1, -1))
        by_axis = (up - down) / (2 * pixel[axis])
        r = gap / S_OUT
        assert g[axis] == pytest.approx(9 / 2 * by_axis / (1 + r * r / 4), rel=2e-3)  # Cauchy's weight


def pairwise(maps, point, pose, rim=False, level=0):
    """Figures, block and gradient of one point of view 0 in view 1, `pose` other_from_sample_camera."""
    poses = np.stack([np.eye(4), pose])
    row = np.zeros(7)
    row[k.LEVEL], row[k.GEOMETRY_M], row[k.INTENSITY], row[k.OUTLINE_M], row[k.SHARE] = level, S_GEO, S_INT, S_OUT, 1.0
    table = np.stack([ROW, ROW])
    blocks, gradients, figures = np.zeros((1, 6, 6)), np.zeros((1, 6)), np.zeros((1, c.FIGURES))
    c.consistency_terms(poses, np.array([[0, 1]]), maps, point, np.array([0, 0]), np.array([1, 0]), table, FOCAL,
                        CENTER, row, rim, blocks, gradients, figures)  # fmt: skip
    return figures[0], blocks[0], gradients[0]


@pytest.mark.parametrize("off_m", [-0.008, 0.003, 0.009])
def test_two_views_of_one_surface_pull_together_as_their_depths_cost(off_m):
    maps, normal = plane_maps()
    point = sample_at(maps, 44, 25, off_m, normal)
    figures, _, g = pairwise(maps, point, np.eye(4))
    wanted = slopes(lambda pose: pairwise(maps, point, pose)[0][c.DEPTH] / figures[c.SHARED])
    r = off_m / S_GEO
    # cost: trust r^2 / 9 (trust is a weight, not a residual: its own change is left out); pull: Tukey's biweight
    wanted *= figures[c.SHARED]
    np.testing.assert_allclose(g, 9 / 2 * (1 - r * r / 9) ** 2 * wanted, rtol=0.02, atol=0.01 * np.abs(g).max())


def test_a_point_before_another_views_surface_is_pushed_behind_it():
    maps, normal = plane_maps()
    off_m = 0.02  # towards the camera: normals face it
    point = sample_at(maps, 44, 25, off_m, normal)
    figures, _, g = pairwise(maps, point, np.eye(4))
    r = off_m / S_OUT
    assert figures[c.BEFORE] == pytest.approx(min(r * r / 9, 1.0), rel=1e-3)
    J = np.concatenate([normal, np.cross(point[0, :3], normal)])
    # the cost is cut off at 3 scales, the pull (Cauchy) goes on to PULLED: what is wrong by much must still be led back
    np.testing.assert_allclose(g, off_m / S_OUT**2 / (1 + r * r / 4) * J, rtol=1e-3, atol=1e-3 * np.abs(g).max())


def test_the_pull_on_the_second_view_is_the_opposite_of_that_on_the_first():
    maps, normal = plane_maps()
    point = sample_at(maps, 44, 25, 0.003, normal)
    pose = moved([0.001, -0.002, 0.001, 0.01, 0.02, -0.01])

    def cost(first, second):
        return pairwise(maps, point, second @ se3.inverse(first))[0][c.DEPTH]

    _, _, g = pairwise(maps, point, pose)
    base = pose
    for axis, e in enumerate(np.eye(6)):
        # object_from_camera <- exp(twist) object_from_camera: camera_from_object <- camera_from_object exp(-twist)
        step = moved(1e-5 * e)
        by_first = cost(se3.inverse(step), base) - cost(step, base)
        by_second = cost(np.eye(4), base @ se3.inverse(step)) - cost(np.eye(4), base @ step)
        assert by_first == pytest.approx(-by_second, rel=0.02, abs=1e-9)
        assert np.sign(by_first) == np.sign(g[axis]) or abs(by_first) < 1e-7


PROFILE = {"sizes": np.array([12, 2, 8, 8]), "row_m": 0.01, "first_m": -0.05}


def profile(radius_m=0.04, slope=0.2):
    """A cone: radius by height at the nodes, flat ends; the unknowns behind the nodes are zero."""
    nodes = int(PROFILE["sizes"].sum())
    y = np.zeros(nodes + 4)
    y[:12] = radius_m + slope * PROFILE["row_m"] * np.arange(12)
    y[14:22], y[22:30] = 0.05, -0.05
    y[rk.LOW], y[rk.HIGH] = -0.05, 0.05
    config = np.zeros(9)
    config[[rk.ROW, rk.FIRST_HEIGHT, rk.OFF_M, rk.SIGMA_M]] = PROFILE["row_m"], PROFILE["first_m"], 0.012, 0.0015
    config[[rk.SIGMA_PX, rk.INTO_PX, rk.BEYOND_PX, rk.NEAR_PX, rk.OUTLINE_STEP_PX]] = 0.7, 6.0, 6.0, 3.0, 0.01
    return y, config


def surface(sample, pose, y, config):
    H, g = np.zeros((6, 6)), np.zeros(6)
    Hy, Hyy, gy = np.zeros((6, len(y))), np.zeros((len(y), len(y))), np.zeros(len(y))
    rk.surface_terms(sample, pose, np.eye(3), np.zeros(3), y, np.ones(len(y), bool), PROFILE["sizes"], config, 1.0, 1.0,
                     H, g, Hy, Hyy, gy)  # fmt: skip
    return H, g, gy


def cone_residual(point_camera, pose, y, config, slope=None):
    """(radius - profile(height)) over the length of the profile's normal, in plain numpy; `slope`: held at this."""
    q = pose[:3, :3].T @ (point_camera - pose[:3, 3])
    at = (q[2] - config[rk.FIRST_HEIGHT]) / config[rk.ROW]
    j = int(np.floor(at))
    slope = (y[j + 1] - y[j]) / config[rk.ROW] if slope is None else slope
    value = y[j] * (1 - (at - j)) + y[j + 1] * (at - j)
    return (np.hypot(q[0], q[1]) - value) / np.sqrt(1 + slope * slope)


@pytest.mark.parametrize("off_m", [-0.003, 0.001, 0.004])
def test_a_round_bodys_surface_pulls_along_the_derivative_of_its_distance_to_the_profile(off_m):
    y, config = profile()
    pose = np.eye(4)
    pose[:3, :3] = se3.exponential(np.array([0, 0, 0, 1.9, 0.1, 0.2]))[:3, :3]
    pose[:3, 3] = 0.01, -0.02, 0.6
    towards = pose[:3, :3].T @ -pose[:3, 3]
    away = np.array([towards[0], towards[1], 0.0]) / np.hypot(towards[0], towards[1])
    q = np.array([0, 0, 0.003]) + (0.04 + 0.2 * 0.053 + off_m) * away
    normal = (away - np.array([0, 0, 0.2])) / np.sqrt(1.04)
    sample = np.zeros((1, lay.SAMPLE))
    sample[0, :3], sample[0, 3:6] = pose[:3, :3] @ q + pose[:3, 3], pose[:3, :3] @ normal
    _, g, gy = surface(sample, pose, y, config)
    e = cone_residual(sample[0, :3], pose, y, config)
    facing = -(sample[0, :3] @ sample[0, 3:6]) / np.linalg.norm(sample[0, :3])
    weight = (1 - (e / 0.012) ** 2) ** 2 * np.clip((facing - 0.3) / 0.4, 0.05, 1) / 0.0015**2
    by_pose = np.zeros(6)
    for axis, step in enumerate(np.eye(6)):
        # the twist moves points in the object frame: object_from_camera <- exp(twist) object_from_camera
        up, down = (
            cone_residual(sample[0, :3], pose @ se3.inverse(moved(s * STEP * step)), y, config) for s in (1, -1)
        )
        by_pose[axis] = (up - down) / (2 * STEP)
    np.testing.assert_allclose(g, weight * e * by_pose, rtol=1e-3, atol=1e-3 * np.abs(g).max())
    by_y = np.zeros(len(y))
    for j in range(12):
        changed = [y + s * 1e-7 * np.eye(len(y))[j] for s in (1, -1)]
        up, down = (cone_residual(sample[0, :3], pose, z, config, slope=0.2) for z in changed)
        by_y[j] = (up - down) / 2e-7
    # on purpose: a node also tilts the profile's normal, which is second order in the residual and left out
    np.testing.assert_allclose(gy, weight * e * by_y, rtol=1e-3, atol=1e-3 * np.abs(gy).max())


def test_a_round_bodys_outline_pulls_along_the_derivative_of_its_squared_distance_to_the_rim():
    y, config = profile(slope=0.0)
    y[rk.BIAS], config[rk.SIGMA_PX] = -0.3, 50.0  # a wide scale: Cauchy's weight is 1
    pose = np.eye(4)
    pose[:3, :3] = se3.exponential(np.array([0, 0, 0, 1.7, 0.1, 0.2]))[:3, :3]
    pose[:3, 3] = 0.0, 0.0, 1.2
    table = np.array([0, 0, 0, WIDTH, HEIGHT, 0, 0])
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    beside_px = (0.012 * (u - 38) - 0.009 * (v - 31)).reshape(-1).astype(np.float64)

    def outline(at):
        H, g = np.zeros((6, 6)), np.zeros(6)
        Hy, Hyy, gy = np.zeros((6, len(y))), np.zeros((len(y), len(y))), np.zeros(len(y))
        found = rk.outline_terms(beside_px, table, FOCAL, CENTER, at, np.eye(3), np.zeros(3), y, np.ones(len(y), bool),
                                 PROFILE["sizes"], config, 1.0, H, g, Hy, Hyy, gy)  # fmt: skip
        return found, g

    (count, usable, _), g = outline(pose)
    assert count == usable > 20
    by_pose = np.zeros(6)
    for axis, step in enumerate(np.eye(6)):
        (up, down) = (outline(pose @ se3.inverse(moved(s * 1e-5 * step)))[0][2] for s in (1, -1))
        by_pose[axis] = (up - down) / 2e-5
    # on purpose: the point of the body that the camera sees as its rim moves along the body; that is second order for
    # the wall and left out, and the circles of the ends are fixed points of the body
    np.testing.assert_allclose(2 * config[rk.SIGMA_PX] ** 2 * g, by_pose, rtol=0.02, atol=0.02 * np.abs(by_pose).max())


@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.3, 8.0, 5.5)])
def test_a_change_of_motion_has_the_derivatives_that_are_stated(gravity):
    rng = np.random.default_rng(3)
    times = np.array([0.0, 0.033, 0.07])
    poses = [se3.exponential(np.array([0.1 * n, 0.02, 0.6, 0.1 * n, 0.03 * n, 0.2])) for n in range(3)]
    poses = [p @ moved(1e-3 * rng.normal(size=6)) for p in poses]
    motion = Motion(times, np.zeros(3, int), np.array(gravity), np.array([0.01, -0.02, 0.015]), np.zeros(3, bool))

    def residual_of(three):
        return motion_residual(np.stack(three)[None], times[None], motion)[0][0]

    residual, jacobians = residual_of(poses), motion_residual(np.stack(poses)[None], times[None], motion)[1][0]
    for which in range(3):
        for axis, e in enumerate(np.eye(6)):
            ends = []
            for s in (1, -1):
                other = list(poses)
                other[which] = poses[which] @ se3.inverse(moved(s * 1e-5 * e))
                ends.append(residual_of(other))
            slope = (ends[0] - ends[1]) / 2e-5
            # to first order: the spin's rotation vector is taken to change as the rotation does, right for small turns
            size = np.abs(jacobians[which]).max()
            np.testing.assert_allclose(jacobians[which][:, axis], slope, rtol=0.06, atol=0.06 * size)
    assert np.isfinite(residual).all()
