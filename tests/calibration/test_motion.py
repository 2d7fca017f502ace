"""Hand-eye, time offsets, the table and gravity, against known ones."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from calibration.cameras.intrinsics import calibrate_intrinsics
from calibration.cameras.poses import angle_deg, exp_poses, inverse_poses, log_poses
from calibration.cameras.targets import Tags
from calibration.ground_plane import (
    Plane,
    find_flight,
    fit_table,
    gravity_from_flight,
    judge_table,
    place_world,
    table_points,
)
from calibration.hand_eye import LensAccuracy, calibrate_hand_eye, missing_motion
from calibration.hand_eye_start import best_start, daniilidis, park
from calibration.time_offset import (
    Path3,
    TimeOffset,
    offset_of_corners,
    offset_of_paths,
    offset_report,
    place_by_motion,
    pooled,
)
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.sync import clock_offset_ns


def off(found, true):
    gap = inverse_poses(true) @ found
    return 1e3 * float(np.linalg.norm(gap[:3, 3])), angle_deg(gap[:3, :3])


def arm_case(geometry, seed, mounting, turn_deg=45.0, axes=(1, 1, 1), noise=1.0, arm=1.0):
    """Twenty robot poses with a board 0.5 mm and 0.1 deg off, and an arm `arm` times 0.05 deg and 0.2 mm off."""
    rng = np.random.default_rng(seed)
    model = geometry.camera("d455", 430.0, (848, 480))
    mount = geometry.pose(
        [2.2, 0.3, -0.4] + 0.2 * rng.normal(size=3), [0.1, 0.2, 1.4 if mounting == "eye-to-hand" else 0.1]
    )
    held = geometry.pose(0.5 * rng.normal(size=3), [0.05, 0.02, 0.1])
    robot, views = [], []
    for _ in range(20):
        turn = rng.normal(size=3) * axes
        turn *= np.radians(turn_deg) * rng.uniform(0.5, 1) / np.linalg.norm(turn)
        facing = Rotation.from_rotvec(turn) * Rotation.from_euler("x", np.pi)
        seen = geometry.pose(facing.as_rotvec(), [*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.6, 0.85)])
        moved = inverse_poses(mount) @ seen @ inverse_poses(held)
        slip = exp_poses(arm * noise * rng.normal(size=(1, 6)) * ([np.radians(0.05)] * 3 + [2e-4] * 3))[0]
        wobble = exp_poses(noise * rng.normal(size=(1, 6)) * ([np.radians(0.1)] * 3 + [5e-4] * 3))[0]
        robot.append(moved @ slip if mounting == "eye-to-hand" else inverse_poses(slip @ moved))
        views.append(geometry.view(model, seen @ wobble, rng))
    return model, mount, held, np.array(robot), views


@pytest.mark.parametrize("mounting", ["eye-to-hand", "eye-in-hand"])
def test_the_camera_is_found_on_either_mounting(geometry, mounting):
    model, mount, held, robot, views = arm_case(geometry, 3, mounting)
    solved = calibrate_hand_eye(model, views, robot, mounting)
    mm, deg = off(solved.camera_from_mount, mount)
    said = solved.report.uncertainty
    assert said["position_mm"] < 1.5
    assert said["direction_deg"] < 0.15
    assert mm < 2.5 * said["position_mm"]
    assert deg < 2.5 * said["direction_deg"]
    assert off(solved.held_from_board, held)[0] < 3.0
    assert solved.report.verdict == "good"


@pytest.mark.parametrize("seed", [0, 1])
def test_an_arm_much_worse_than_assumed_widens_the_deviation_until_it_holds(geometry, seed):
    """Real poses of an arm may be off by half a degree (Paper-Tracking's are): stated is what such poses tell."""
    model, mount, _, robot, views = arm_case(geometry, seed, "eye-in-hand", arm=12.0)
    solved = calibrate_hand_eye(model, views, robot, "eye-in-hand")
    said, (mm, deg) = solved.report.uncertainty, off(solved.camera_from_mount, mount)
    assert said["position_mm"] > 2.0
    assert mm < 2.5 * said["position_mm"]
    assert deg < 2.5 * said["direction_deg"]


def squared_deviations(found, true):
    """Of place and direction in standard deviations: chi-square of 3 degrees of freedom where these are right."""
    gap = log_poses((true @ inverse_poses(found.camera_from_mount))[None])[0]
    return [float(gap[k] @ np.linalg.solve(found.covariance[k, k], gap[k])) for k in (slice(3, 6), slice(0, 3))]


@pytest.mark.slow
def test_the_interval_holds_the_camera_where_its_lens_was_fitted_on_few_noisy_corners(geometry):
    held = {"lens as exact": 0, "lens as stated": 0}
    for seed in range(4):
        mounting = ("eye-to-hand", "eye-in-hand")[seed % 2]
        model, mount, _, robot, views = arm_case(geometry, seed, mounting)
        rng = np.random.default_rng(100 + seed)
        board = [geometry.view(model, geometry.tilted(rng, tilt_deg=25.0), rng, sigma_px=0.5) for _ in range(8)]
        lens = calibrate_intrinsics("d455", (848, 480), board, ("none",))
        for name, sure in zip(held, (LensAccuracy(), LensAccuracy.stated(lens.report.uncertainty))):
            found = calibrate_hand_eye(lens.model, views, robot, mounting, lens=sure)
            held[name] += max(squared_deviations(found, mount)) < chi2.ppf(0.99, 3)
    assert held["lens as stated"] == 4
    assert held["lens as exact"] <= 1


def test_park_and_daniilidis_are_exact_without_noise(geometry):
    _, mount, held, robot, _ = arm_case(geometry, 5, "eye-to-hand", noise=0.0)
    boards = mount[None] @ robot @ held[None]
    for solver in (park, daniilidis, best_start):
        found, carried = solver(boards, robot)
        assert off(found, mount)[0] < 1e-6
        assert off(carried, held)[0] < 1e-6


def test_too_little_rotation_is_refused_with_the_motion_that_is_missing(geometry):
    _, _, _, robot, _ = arm_case(geometry, 7, "eye-to-hand", turn_deg=8.0)
    assert "wanted 30" in missing_motion(robot)[0]
    spin = np.array([geometry.pose([0, 0, 0.3 * k], [0.4, 0, 0.3]) for k in range(6)])
    (said,) = missing_motion(spin)
    assert "its z" in said
    assert "about its x or y" in said
    model, _, _, robot, views = arm_case(geometry, 7, "eye-to-hand", turn_deg=8.0)
    assert calibrate_hand_eye(model, views, robot, "eye-to-hand").report.verdict == "refused"
    with pytest.raises(BadInput, match="robot poses"):
        calibrate_hand_eye(model, views[:3], robot[:3], "eye-to-hand")


def ballistic(geometry, count=40, period=1 / 30, start=0.0, seed=0):
    """Held, thrown, bounced at 0.75 s: stamps and poses."""

    def at(t):
        flown = max(0.0, min(t, 0.75) - 0.25)
        place = np.array([0.9 * flown, 0.3 * flown, 0.3 + 1.4 * flown - 4.905 * flown**2])
        if t > 0.75:
            place += [0.4 * (t - 0.75), 0.2 * (t - 0.75), 1.0 * (t - 0.75) - 4.905 * (t - 0.75) ** 2]
        turn = np.array([4.0, 2.0, -3.0]) * flown + (np.array([-2.0, 5.0, 1.0]) * (t - 0.75) if t > 0.75 else 0)
        return geometry.pose(turn, place)

    times = start + period * np.arange(count)
    return times, np.array([at(t) for t in times]), at


@pytest.mark.parametrize("offset_ms", [0.0, 7.3, -21.0])
def test_an_offset_between_two_trajectories_is_found_within_its_deviation(geometry, offset_ms):
    times, poses, at = ballistic(geometry)
    rng = np.random.default_rng(1)
    others = 0.011 + times[:-2]
    points = np.array([at(t)[:3, 3] + at(t)[:3, :3] @ [0.01, 0.02, -0.01] for t in others])
    noisy = points + 0.0005 * rng.normal(size=points.shape)
    found = offset_of_paths(Path3.of_poses(times, poses), Path3(others - 1e-3 * offset_ms, noisy))
    assert abs(1e3 * found.offset_s - offset_ms) < max(3e3 * found.std_s, 0.05)
    assert found.std_s < 1e-3


@pytest.mark.slow
def test_noisy_tosses_pooled_know_the_offset_better_than_one(geometry):
    times, poses, at = ballistic(geometry)
    rng, each = np.random.default_rng(2), []
    for _ in range(6):
        others = 0.004 + times[:-2] + rng.uniform(0, 0.02)
        points = np.array([at(t)[:3, 3] for t in others]) + 0.003 * rng.normal(size=(len(others), 3))
        each.append(offset_of_paths(Path3.of_poses(times, poses), Path3(others - 0.005, points)))
    together = pooled(each)
    assert together.std_s < 0.6 * np.median([e.std_s for e in each])
    assert abs(together.offset_s - 0.005) < 3 * together.std_s
    assert 0.3 < np.sqrt(np.mean([((e.offset_s - 0.005) / e.std_s) ** 2 for e in each])) < 2.0


def corner_frames(geometry, model, camera_from_rig, at, stamps, late_s, rng):
    board = geometry.board
    small = Tags(board.family, board.size_m, board.board_from_tag)
    seen = type(geometry)(small)
    return [(float(t), seen.view(model, camera_from_rig @ at(t + late_s), rng, 0.3)) for t in stamps]


def test_an_offset_from_tag_corners_is_found_to_a_fraction_of_a_millisecond(geometry):
    times, poses, at = ballistic(geometry)
    model = geometry.camera("d455", 500.0, (848, 640))
    camera = geometry.pose([np.pi, 0, 0], [-0.1, 0.1, 1.5])
    frames = corner_frames(geometry, model, camera, at, times[2:-4:2] + 0.009, 0.0062, np.random.default_rng(3))
    trajectory = Path3.of_poses(times, poses)
    crooked = geometry.pose([0.001, -0.001, 0.0005], [0.001, 0.001, -0.002]) @ camera
    found = offset_of_corners(trajectory, model, crooked, frames)
    assert abs(found.offset_s - 0.0062) < 0.0003
    place = place_by_motion(trajectory, model, frames)
    mm, deg = off(place, camera)
    assert mm < 3.0
    assert deg < 0.1


def test_a_body_at_rest_shows_no_offset(geometry):
    times = np.arange(20) / 30
    still = Path3.of_poses(times, np.tile(np.eye(4), (20, 1, 1)))
    with pytest.raises(BadInput, match="hardly moves"):
        offset_of_paths(still, Path3(times, np.zeros((20, 3))))


def test_offsets_that_scatter_are_called_unsynchronised():
    steady = {k: TimeOffset(0.004 + 1e-5 * k, 1e-4, 30, 0.2) for k in range(5)}
    assert offset_report("mono", "d455", steady, {}).verdict == "good"
    jumping = {k: TimeOffset(0.004 * k, 1e-4, 30, 0.2) for k in range(5)}
    said = offset_report("mono", "d455", jumping, {}).reasons()
    assert any("not synchronised" in reason for reason in said)


def test_readers_get_an_offset_and_zero_where_nobody_measured():
    assert clock_offset_ns({"time": {"offsets": {"mono": {"offset_ns": 1234}}}}, "mono") == 1234
    assert clock_offset_ns({"time": {"offsets": {"mono": {"offset_ns": 1234}}}}, "arm") == 0
    assert clock_offset_ns({}, "mono") == 0


@pytest.fixture(scope="module")
def tilted_table():
    """camera_from_world of a camera 0.9 m away, looking down at the table at 55 deg; its depth image, 0.4 % too far."""
    model = CameraModel("d455", 320, 240, np.array([[210.0, 0, 160], [0, 210, 120], [0, 0, 1]]))
    turn = Rotation.from_euler("x", 180 - 35, degrees=True).as_matrix()
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = turn, [0.0, 0.05, 0.9]
    normal = turn @ [0, 0, 1.0]
    rays = model.pixel_rays()
    depth = (normal @ camera_from_world[:3, 3]) / (rays @ normal)
    rng = np.random.default_rng(4)
    depth = 1.004 * depth + 0.001 * rng.normal(size=depth.shape)
    depth[90:130, 140:190] -= 0.08  # something stands on it
    depth[:5] = 0
    return model, camera_from_world, depth.astype(np.float32)


def test_tags_and_depth_tied_together_know_the_table_to_half_a_millimetre(geometry, tilted_table):
    model, camera_from_world, depth = tilted_table
    rng = np.random.default_rng(5)
    flat = np.diag([1.0, -1.0, -1.0, 1.0])
    places = {}
    for k, (x, y) in enumerate([(-0.2, 0.15), (0.2, 0.15), (0.2, -0.1), (-0.2, -0.1)]):
        places[k] = flat.copy()
        places[k][:2, 3] = x, y
    tags = Tags("tag36h11", dict.fromkeys(places, 0.08), places)
    look = type(geometry)(tags).view(model, camera_from_world, rng)
    solved = place_world({"d455": model}, {"d455": np.eye(4)}, {"d455": look})
    assert off(solved.scene.rig_from_body[0], camera_from_world)[0] < 2.0
    corners = np.concatenate([tags.corners_m(k) for k in places])
    points = corners @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    points = points + 0.0003 * rng.normal(size=points.shape)
    table = table_points(depth, model, None)
    spread = np.tile(0.0003**2 * np.eye(3), (len(points), 1, 1))
    plane, scale, left = fit_table((points, spread), table)
    world = plane.in_frame(Transform.from_matrix("world", "d455", inverse_poses(camera_from_world)))
    assert scale == pytest.approx(1.004, abs=1e-3)
    assert abs(world.heights_m(np.zeros((1, 3)))[0]) < 0.0005
    assert np.degrees(np.arccos(world.normal[2])) < 0.05
    assert left["depth_before_scaling_mm"] < -1.0
    report = judge_table(world, left, {}, 0.2, scale, [])
    assert report.verdict == "good"
    alone, none, _ = fit_table(None, table)
    assert none is None
    assert judge_table(alone, {}, {}, None, None, []).verdict == "doubtful"


def test_an_image_without_a_table_is_refused():
    model = CameraModel("d455", 64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]))
    with pytest.raises(BadInput, match="hardly anything"):
        table_points(np.zeros((48, 64), np.float32), model, None)


def test_gravity_comes_out_of_free_flight_of_a_point_off_the_centre(geometry):
    rng = np.random.default_rng(6)
    times, poses, _ = ballistic(geometry)
    carried = poses.copy()
    carried[:, :3, 3] += poses[:, :3, :3] @ [0.004, -0.003, 0.002]
    carried[:, :3, 3] += 0.0002 * rng.normal(size=(len(times), 3))
    trajectory = Path3.of_poses(times, carried)
    flight = find_flight(trajectory, 0.25)
    assert flight.start >= 8
    assert flight.stop <= 24 or flight.start >= 22  # before the bounce or after it, never across
    found = gravity_from_flight(trajectory, flight)
    assert np.degrees(np.arccos(-found.down[2])) < max(0.5, 3 * found.std_deg)
    assert found.size_m_s2 == pytest.approx(9.81, rel=0.02)
    level = Plane(np.array([0.0, 0, 1]), 0.0, 1e-4, 0.01)
    assert judge_table(level, {}, {}, 0.2, 1.0, [found]).verdict == "good"
    slope = Plane(Rotation.from_euler("x", 6, degrees=True).apply([0, 0, 1.0]), 0.0, 1e-4, 0.01)
    assert any("not level" in r for r in judge_table(slope, {}, {}, 0.2, 1.0, [found]).reasons())


def test_poses_exponential_and_logarithm_undo_each_other():
    rows = np.random.default_rng(8).uniform(-1.5, 1.5, (20, 6))
    np.testing.assert_allclose(log_poses(exp_poses(rows)), rows, atol=1e-9)
