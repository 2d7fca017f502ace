"""The accurate tracker: its kernels against known answers, its parts, whole tosses of known motion, bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from processing.evaluate.metrics import align_first, frame_errors
from processing.motion import se3_kernels as se3
from processing.motion.interpolate import moved, turn_between
from processing.motion.motion_prior import (
    MotionConfig,
    change_cost,
    free_change_rad_s,
    free_jerk_rad_s,
    steady_spin,
)
from processing.motion.rotation_grid import all_turns
from processing.sensor import view_layout as lay
from processing.sensor.rectification import Rectification
from processing.sensor.surface_kernel import fit_surface
from processing.sensor.view import ViewConfig, cut, make_view
from processing.sensor.view_store import ViewStore
from processing.track import hypotheses as trajectory
from processing.track.center_of_mass import flight_center
from processing.track.flags import camera_covariance
from processing.track.joint_refinement import GraphConfig, Motion, _add_motion, refine
from processing.track.keyframes import KeyframeConfig, Sides
from processing.track.registration.keyframe_database import keyframes_of
from processing.track.registration.register import RegisterConfig, register_tosses
from processing.track.revolution.axis import Axis
from processing.track.track_file import read_toss_track, write_toss_track
from processing.track.track_toss import TossTrack, TrackConfig, track_toss
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform, rigid_fit, rotation_exp
from recordings.records import RgbdFrame

COUNT = 10
SMALL = st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6).map(np.array)


def pose_of(twist: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_exp(twist[3:]), twist[:3]
    return out


def flight(count: int, center: np.ndarray, spin: np.ndarray, step_s: float = 1 / 30) -> tuple[np.ndarray, np.ndarray]:
    """Poses of a body in free flight with constant spin, and their times; gravity along -z of the camera."""
    times = np.arange(count) * step_s
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, t in enumerate(times):
        poses[i, :3, :3] = rotation_exp(spin * t) @ rotation_exp(np.array([0.3, -0.2, 0.5]))
        middle = np.array([0.1, 0.0, 1.0]) + np.array([0.4, 0.2, 1.5]) * t + 0.5 * np.array([0, 0, -9.81]) * t * t
        poses[i, :3, 3] = middle - poses[i, :3, :3] @ center
    return poses, times


def pull_on_turns(poses: np.ndarray, times: np.ndarray) -> float:
    """Largest pull (per rad) of steady motion on the turn of any pose."""
    n = len(poses)
    motion = Motion(times, np.zeros(n, dtype=np.int64), np.array([0, 0, -9.81]), np.zeros(3), np.zeros(n, dtype=bool))
    H, g = np.zeros((n, n, 6, 6)), np.zeros((n, 6))
    _add_motion(H, g, poses, np.ones(n, dtype=bool), np.arange(n), motion, GraphConfig())
    return float(np.linalg.norm(g[:, 3:], axis=1).max())


@pytest.mark.parametrize("impact_rad_s", [20.0, 35.0])
def test_an_impact_does_not_pull_at_the_turns_around_it_but_a_small_error_does(impact_rad_s: float) -> None:
    poses, times = flight(8, np.zeros(3), np.array([1.0, 2.0, -1.0]))
    assert pull_on_turns(poses, times) < 1e-6
    for i in range(4, 8):  # another spin from frame 4 on
        poses[i, :3, :3] = rotation_exp(np.array([impact_rad_s, 0, 0]) * (times[i] - times[3])) @ poses[3, :3, :3]
    struck = pull_on_turns(poses, times)
    steady, _ = flight(8, np.zeros(3), np.array([1.0, 2.0, -1.0]))
    steady[4, :3, :3] = rotation_exp(np.array([np.radians(0.5), 0, 0])) @ steady[4, :3, :3]
    assert struck < 0.002 * pull_on_turns(steady, times)


@given(SMALL)
def test_exponential_and_inverse_meet(twist: np.ndarray) -> None:
    pose = se3.exponential(twist)
    np.testing.assert_allclose(pose @ se3.inverse(pose), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(pose, pose_of(twist), atol=1e-9)


def test_depth_of_a_tilted_plane_comes_back_with_its_normal() -> None:
    camera = CameraModel("d455", 60, 50, np.array([[100.0, 0, 30], [0, 100, 25], [0, 0, 1]]))
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    depth = (normal @ [0, 0, 0.8]) / (camera.pixel_rays() @ normal)
    depth[20, 30] = 0.0
    out, normals = np.zeros((50, 60), dtype=np.float32), np.zeros((50, 60, 3), dtype=np.float32)
    inside = np.zeros((50, 60), dtype=bool)
    inside[5:45, 5:55] = True
    fit_surface(depth.astype(np.float32), inside, np.array([0.01, 0.01, -0.3, -0.25]), 3, 0.012, out, normals)
    exact = (normal @ [0, 0, 0.8]) / (camera.pixel_rays() @ normal)
    np.testing.assert_allclose(out[inside], exact[inside], atol=1e-5)  # the hole too
    np.testing.assert_allclose(normals[inside], np.broadcast_to(normal, (inside.sum(), 3)), atol=1e-3)
    assert (out[~inside] == 0).all()


def test_free_flight_is_predicted_and_costs_nothing() -> None:
    center, spin, gravity = np.array([0.02, -0.01, 0.03]), np.array([3.0, -5.0, 2.0]), np.array([0, 0, -9.81])
    poses, times = flight(6, center, spin)
    predicted = moved(poses[2], poses[3], times[3] - times[2], times[4] - times[3], center, gravity)
    np.testing.assert_allclose(predicted, poses[4], atol=1e-9)
    np.testing.assert_allclose(steady_spin(poses[:5], times[:5]), spin, atol=1e-9)
    assert change_cost((poses[2], poses[3], poses[4]), (1 / 30, 1 / 30), center, gravity, MotionConfig()) < 1e-6


@pytest.mark.parametrize("askew_deg", [10, 45, 80])
@pytest.mark.parametrize("along", [0.01, 0.6, 1.4, 2.0])
def test_a_free_bodys_spin_changes_within_twice_its_standard_deviation(askew_deg: float, along: float) -> None:
    inertia = np.array([1.0, 1.0, along])  # of a rod (0) to a disc (2) about its axis, one across
    spin = 12.0 * np.array([np.sin(np.radians(askew_deg)), 0, np.cos(np.radians(askew_deg))])
    change = -np.cross(spin, inertia * spin) / inertia  # Euler's equations without a torque, in the body's axes
    step_s = 1 / 30
    assert np.linalg.norm(change) * step_s <= 2 * free_change_rad_s(12.0, step_s) + 1e-12
    if askew_deg == 45 and along in (0.01, 2.0):  # the bound is reached
        assert np.linalg.norm(change) * step_s > 1.9 * free_change_rad_s(12.0, step_s)


def test_of_a_body_that_hardly_spins_the_spin_hardly_changes() -> None:
    assert free_change_rad_s(1.0, 1 / 30) < 0.01
    assert free_jerk_rad_s(1.0, 1 / 30) < 0.001


def test_an_impact_costs_no_more_than_the_cost_of_an_impact() -> None:
    poses, _ = flight(3, np.zeros(3), np.array([3.0, -5.0, 2.0]))
    hit = poses[2].copy()
    hit[:3, :3] = rotation_exp(np.array([0.0, 0.4, 0.0])) @ hit[:3, :3]
    config = MotionConfig()
    cost = change_cost((poses[0], poses[1], hit), (1 / 30, 1 / 30), np.zeros(3), np.array([0, 0, -9.81]), config)
    assert 0.5 * config.impact_cost < cost < config.impact_cost + config.shift_cost


def test_the_center_of_mass_follows_from_free_flight_but_for_its_place_along_the_spin() -> None:
    center, spin = np.array([0.02, -0.01, 0.03]), np.array([3.0, -5.0, 2.0])
    poses, times = flight(9, center, spin)
    found = flight_center(poses, times, np.array([0, 0, -9.81]), np.arange(9), np.zeros(3), sigma_m=1.0)
    axis = poses[0, :3, :3].T @ spin / np.linalg.norm(spin)
    gap = found - center
    np.testing.assert_allclose(gap - axis * (axis @ gap), 0, atol=2e-4)
    np.testing.assert_array_equal(flight_center(poses, times, np.zeros(3), np.arange(3), center), center)


@given(SMALL)
def test_a_rigid_motion_of_points_is_found(twist: np.ndarray) -> None:
    points = np.random.default_rng(0).normal(size=(8, 3))
    pose = pose_of(twist)
    np.testing.assert_allclose(rigid_fit(points, points @ pose[:3, :3].T + pose[:3, 3]), pose, atol=1e-9)


def test_references_look_from_near_directions() -> None:
    poses = np.array([pose_of(np.array([0, 0, 1.0, 0, a, 0])) for a in np.radians([0, 20, 40, 90, 170])])
    refs = Sides(poses, (0, 1, 3, 4), 2, np.zeros(3)).references(poses[1], KeyframeConfig(used=3))
    assert set(refs) == {0, 1, 2}


def test_turns_reach_every_orientation() -> None:
    turns = all_turns(216)
    rng = np.random.default_rng(1)
    for _ in range(20):
        target = rotation_exp(rng.normal(size=3) * 2)
        cosine = (np.einsum("nij,ij->n", turns, target) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine.max(), -1, 1))) < 50


def test_covariance_turns_with_the_pose() -> None:
    twist = np.diag([1e-6, 4e-6, 9e-6, 1e-4, 4e-4, 9e-4])
    pose = pose_of(np.array([0.1, 0, 1, 0, 0, np.pi / 2]))
    found = camera_covariance(pose, twist)
    np.testing.assert_allclose(np.diag(found), [4e-4, 1e-4, 9e-4, 4e-6, 1e-6, 9e-6], atol=1e-12)


@pytest.fixture(scope="module")
def toss(tiny_world: Any) -> tuple[list[RgbdFrame], list[np.ndarray], np.ndarray]:
    return thrown(tiny_world, 0)


def thrown(world: Any, number: int) -> tuple[list[RgbdFrame], list[np.ndarray], np.ndarray]:
    poses = world.poses(COUNT, number)
    seen = [world.see(pose, i) for i, pose in enumerate(poses)]
    truth = np.stack([(world.world_from_camera.inverse() @ p).matrix for p in poses])
    return [f for f, _ in seen], [m for _, m in seen], truth


def followed(world: Any, seen: Any, **more: Any) -> TossTrack:
    return track_toss(seen[0], seen[1], world.camera, world_from_camera=world.world_from_camera, **more)


@pytest.fixture(scope="module")
def tracked(tiny_world: Any, toss: Any) -> TossTrack:
    return followed(tiny_world, toss)


@pytest.fixture(scope="module")
def other(tiny_world: Any) -> tuple[list[RgbdFrame], list[np.ndarray], np.ndarray]:
    return thrown(tiny_world, 1)


@pytest.fixture(scope="module")
def second(tiny_world: Any, other: Any) -> TossTrack:
    return followed(tiny_world, other, toss=1)


def test_a_known_motion_comes_back(toss: Any, tracked: TossTrack) -> None:
    estimate, truth = tracked.track.camera_from_object, toss[2]
    errors = frame_errors(estimate @ align_first(estimate, truth), truth, np.eye(3) * 0.05)
    assert errors.rotation_deg.max() < 2.0
    assert errors.translation_m.max() < 0.003
    assert tracked.track.status == ("tracked",) * COUNT
    assert np.isfinite(tracked.track.covariance).all()
    assert np.nanmax(tracked.cost) < 0.1


def test_the_object_frame_starts_parallel_to_the_camera_in_the_cloud(toss: Any, tracked: TossTrack) -> None:
    first = tracked.track.camera_from_object[0]
    np.testing.assert_array_equal(first[:3, :3], np.eye(3))
    assert np.linalg.norm(first[:3, 3] - toss[2][0, :3, 3]) < 0.05


@pytest.mark.parametrize(("worse", "taken"), [(1.7, True), (2.5, False)])
def test_a_body_that_looks_round_is_recognised_by_the_cost_of_its_profile(
    tiny_world: Any, toss: Any, tracked: TossTrack, monkeypatch: pytest.MonkeyPatch, worse: float, taken: bool
) -> None:
    axis = Axis(np.array([0.0, 0.0, 1.0]), tracked.center_m)

    def sought(_: Any, hypotheses: list[trajectory.TrajectoryHypothesis], *__: Any) -> trajectory.TrajectoryHypothesis:
        return replace(hypotheses[0], cost=worse * hypotheses[0].cost, axis=axis)

    monkeypatch.setattr(trajectory, "_sought", sought)
    assert followed(tiny_world, toss).round_body == taken


def test_a_given_start_is_kept(tiny_world: Any, toss: Any) -> None:
    start = Transform.from_matrix("d455", "object", toss[2][0])
    track = followed(tiny_world, (toss[0][:3], toss[1][:3]), start=start).track
    np.testing.assert_allclose(track.camera_from_object[0], toss[2][0], atol=1e-12)


def test_what_a_robots_hand_carries_moves_as_the_hand_does(tiny_world: Any, toss: Any, tracked: TossTrack) -> None:
    grasp = pose_of(np.array([0.02, -0.01, 0.05, 0.3, 1.0, -0.4]))
    held = followed(tiny_world, toss, hand=toss[2] @ grasp).track.camera_from_object
    free = tracked.track.camera_from_object
    errors = [
        frame_errors(found @ align_first(found, toss[2]), toss[2], np.eye(3) * 0.05).rotation_deg.mean()
        for found in (held, free)
    ]
    assert errors[0] < min(0.7 * errors[1], 0.5)


def test_a_hand_that_does_not_hold_the_object_changes_nothing(tiny_world: Any, toss: Any, tracked: TossTrack) -> None:
    elsewhere = np.tile(np.eye(4), (COUNT, 1, 1))
    elsewhere[:, :3, 3] = 0.3 * toss[2][:, [1, 2, 0], 3]
    elsewhere[-2:] = np.nan
    found = followed(tiny_world, toss, hand=elsewhere).track.camera_from_object
    errors = frame_errors(found, tracked.track.camera_from_object, np.eye(3) * 0.05)
    assert errors.rotation_deg.max() < 0.3
    assert errors.translation_m.max() < 0.001


def test_the_same_input_gives_the_same_track(tiny_world: Any, toss: Any, tracked: TossTrack) -> None:
    again = followed(tiny_world, toss)
    np.testing.assert_array_equal(again.track.camera_from_object, tracked.track.camera_from_object)


def test_hidden_frames_are_interpolated_or_lost_but_never_silent(tiny_world: Any, toss: Any) -> None:
    masks = [m.copy() for m in toss[1]]
    masks[4][:] = False
    masks[COUNT - 1][:] = False
    track = followed(tiny_world, (toss[0], masks)).track
    assert track.status[4] == "interpolated"
    assert track.status[COUNT - 1] == "lost"
    assert np.isnan(track.camera_from_object[COUNT - 1]).all()
    assert np.linalg.norm(track.camera_from_object[4][:3, 3] - track.camera_from_object[3][:3, 3]) < 0.1
    assert track.covariance[4, 0, 0] > track.covariance[3, 0, 0]


def test_depth_exposed_half_a_frame_late_is_moved_to_the_color(tiny_world: Any, tmp_path: Path) -> None:
    every_half = tiny_world.poses(16)
    frames, masks, truth = [], [], []
    for i in range(8):
        now, mask = tiny_world.see(every_half[2 * i], i)
        later, _ = tiny_world.see(every_half[2 * i + 1], i)
        frames.append(replace(now, depth_m=later.depth_m, depth_time_ns=now.time_ns + 16_666_667))
        masks.append(mask)
        truth.append((tiny_world.world_from_camera.inverse() @ every_half[2 * i]).matrix)
    tracked = followed(tiny_world, (frames, masks))
    estimate = tracked.track.camera_from_object
    errors = frame_errors(estimate @ align_first(estimate, np.stack(truth)), np.stack(truth), np.eye(3) * 0.05)
    assert np.median(errors.translation_m) < 0.008

    write_toss_track(tmp_path, tracked)
    kept = read_toss_track(tmp_path, 0, frames, masks, tiny_world.camera, np.ones(8), TrackConfig(),
                           tiny_world.world_from_camera)  # fmt: skip
    still = ViewStore(kept.store.rectified, kept.store.crops, kept.store.config)
    assert all(still.fill(i) for i in range(8))

    def apart_m(store: ViewStore) -> float:
        ours, theirs = store.maps[:, lay.Z], tracked.store.maps[:, lay.Z]
        return float(np.abs(ours - theirs)[(ours > 0) & (theirs > 0)].mean())

    assert apart_m(kept.store) < 0.1 * apart_m(still)


def test_one_frame_is_enough(tiny_world: Any, toss: Any) -> None:
    track = followed(tiny_world, (toss[0][:1], toss[1][:1])).track
    assert track.status == ("tracked",)


def test_frames_without_the_object_are_refused_in_words(tiny_world: Any, toss: Any) -> None:
    with pytest.raises(BadInput, match="no frame shows the object"):
        followed(tiny_world, (toss[0], [np.zeros_like(m) for m in toss[1]]))
    with pytest.raises(BadInput, match="without frames"):
        followed(tiny_world, ([], []))
    with pytest.raises(BadInput, match="10 frames, 9 masks"):
        followed(tiny_world, (toss[0], toss[1][:9]))
    with pytest.raises(BadInput, match=r"a hand of shape \(9, 4, 4\) for 10 frames"):
        followed(tiny_world, toss, hand=toss[2][:9])


def test_a_lens_makes_no_difference() -> None:
    pinhole = CameraModel("d455", 160, 120, np.array([[150.0, 0, 79], [0, 150, 59], [0, 0, 1]]))
    lens = replace(pinhole, distortion_model="brown-conrady", distortion=(-0.08, 0.05, 0.0005, -0.0005, 0.0))
    corners = []
    for camera in (pinhole, lens):
        rays = camera.pixel_rays()
        inside = (np.abs(rays[..., 0] - 0.1) < 0.12) & (np.abs(rays[..., 1]) < 0.1)
        depth = np.where(inside, 0.7, 1.5).astype(np.float32)
        frame = RgbdFrame("d455", 0, 0, 0, np.full((120, 160, 3), 90, dtype=np.uint8), depth)
        rectified = Rectification.of(camera)
        crop = cut(frame, inside, 0, rectified, 1.0, ViewConfig())
        assert crop is not None
        view = make_view(crop, rectified, ViewConfig())
        assert view is not None
        corners.append(np.quantile(view.samples[:, :2], [0.02, 0.98], axis=0))
    np.testing.assert_allclose(corners[0], corners[1], atol=0.004)


@pytest.mark.parametrize("round_body", [False, True])
def test_tosses_come_into_one_object_frame(
    tiny_world: Any, tracked: TossTrack, toss: Any, other: Any, second: TossTrack, round_body: bool
) -> None:
    tosses = [replace(t, round_body=round_body) for t in (tracked, second)]
    together = register_tosses(tosses)
    assert together.joined == (True, True)
    assert together.ambiguous == (False, False)
    shift = align_first(together.tracks[0].camera_from_object, toss[2])
    error = frame_errors(together.tracks[1].camera_from_object @ shift, other[2], np.eye(3) * 0.05)
    assert np.median(error.rotation_deg) < 3.0
    assert np.median(error.translation_m) < 0.004
    for own, common in zip(tosses, together.tracks):  # turns that were found from all frames stay
        turns = np.linalg.inv(own.track.camera_from_object) @ common.camera_from_object
        assert np.allclose(turns, turns[0], atol=1e-9) == round_body


def test_views_that_no_pair_ties_to_others_stay_and_nothing_is_known_of_them(tracked: TossTrack) -> None:
    n = len(tracked.cost)
    poses, all_of_them = tracked.track.camera_from_object, np.ones(n, dtype=bool)
    alone = Motion(np.arange(n) / 30, np.arange(n), np.zeros(3), tracked.center_m, ~all_of_them)
    config = GraphConfig(neighbours=0, loops=0)
    found = refine(tracked.store, poses, all_of_them, np.arange(n) == 0, alone, config, tied=np.arange(n) // 5)
    np.testing.assert_array_equal(found.poses, poses)
    assert not found.covariance[:5].any()
    assert (np.diagonal(found.covariance[5:], axis1=1, axis2=2) > 1e6).all()


def test_frames_that_are_not_sure_take_part_and_lost_ones_do_not(tracked: TossTrack) -> None:
    """Sure are often those in the hand alone, which show one side."""
    n = len(tracked.cost)
    poses, status = tracked.track.camera_from_object.copy(), ["tracked"] * 3 + ["interpolated"] * (n - 5) + ["lost"] * 2
    poses[-2:] = np.nan
    unsure = replace(tracked, track=replace(tracked.track, camera_from_object=poses, status=tuple(status)))
    database = keyframes_of([unsure], None, [n], RegisterConfig().shape, RegisterConfig().ground)
    assert set(database.frame) == {i for i in range(n - 2) if tracked.store.usable(i)}


def test_no_toss_cannot_be_registered() -> None:
    with pytest.raises(BadInput, match="no toss"):
        register_tosses([])


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-7, 1.0, 2.6, 2.8, np.pi - 1e-7, np.pi])
def test_turns_of_every_size_come_back(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3
    found = turn_between(pose_of(np.array([0, 0, 0, *angle * axis])), np.eye(4))
    assert min(np.linalg.norm(found - angle * axis), np.linalg.norm(found + angle * axis)) < 1e-6
    assert np.linalg.norm(found) == pytest.approx(angle, abs=1e-6)


def test_turns_between_poses_are_their_rotation() -> None:
    a, b = pose_of(np.zeros(6)), pose_of(np.array([0, 0, 0, 0.1, 0.2, -0.3]))
    np.testing.assert_allclose(turn_between(b, a), [0.1, 0.2, -0.3], atol=1e-12)
