"""The factor graph against known answers, and against TagSLAM's own stored answers on its own tests."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundtruth import se3
from groundtruth.factors import CORNERS, Between, Coordinate, Distance, Prior, Projection
from groundtruth.graph import Graph, SolverConfig, Undetermined, covariances, solve
from groundtruth.tagslam.config import BodyEntry, CameraEntry, NoisyPose, TagEntry, TagSlamConfig, read_config
from groundtruth.tagslam.detections import DetectedTag, Recording, read_recording
from groundtruth.tagslam.problem import planar_poses
from groundtruth.tagslam.solve import run_tag_slam
from recordings.errors import BadInput
from recordings.geometry import CameraModel

CAMERA = CameraModel("cam0", 640, 480, np.array([[600.0, 0, 320], [0, 600.0, 240], [0, 0, 1]]))
TIGHT = np.diag([1e5] * 3 + [1e4] * 3)
vectors = st.lists(st.floats(-2.5, 2.5), min_size=6, max_size=6).map(np.array)


@given(vectors)
def test_logarithm_undoes_exponential(xi):
    xi = np.where(np.linalg.norm(xi[:3]) > 3.0, xi * 0.5, xi)[None]
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


@given(vectors, vectors)
def test_the_adjoint_carries_a_motion_through_a_pose(a, b):
    pose, small = se3.exp(a[None] * 0.5), 1e-3 * b[None]
    moved = pose @ se3.exp(small)
    carried = se3.exp((se3.adjoint(pose) @ small[..., None])[..., 0]) @ pose
    np.testing.assert_allclose(moved, carried, atol=1e-9)


def view(camera_from_tag: np.ndarray, size_m: float) -> np.ndarray:
    return CAMERA.project(size_m * CORNERS @ camera_from_tag[:3, :3].T + camera_from_tag[:3, 3])


def tag_pose(turn: list[float], at: list[float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [np.pi + turn[0], turn[1], turn[2]]).as_matrix()
    pose[:3, 3] = at
    return pose


def test_one_of_the_two_planar_solutions_is_the_true_pose():
    true = tag_pose([0.5, -0.3, 0.2], [0.1, -0.05, 0.8])
    ((poses, errors),) = planar_poses(CAMERA, np.array([0.1]), view(true, 0.1)[None])
    assert len(poses) == 2
    assert errors[0] < 1e-3
    np.testing.assert_allclose(poses[0], true, atol=1e-5)


def small_graph(disturb: float) -> tuple[Graph, np.ndarray, np.ndarray]:
    """A camera at three places sees two tags; tag 0 is known, tag 1 and the places are not."""
    second = np.eye(4)
    second[:3, 3] = [0.3, 0.1, 0.05]
    places = [
        np.linalg.inv(tag_pose([0.4 * i - 0.3, 0.3 - 0.2 * i, 0.1 * i], [0.05 * i - 0.1, 0.0, 0.9])) for i in range(3)
    ]
    random = np.random.default_rng(0)
    graph = Graph([CAMERA])

    def off(pose: np.ndarray) -> np.ndarray:
        return (pose[None] @ se3.exp(disturb * random.normal(size=(1, 6))))[0]

    eye, body = graph.add_pose("camera", np.eye(4), None), graph.add_pose("world", np.eye(4), None)
    tags = [graph.add_pose("tag 0", np.eye(4), None), graph.add_pose("tag 1", off(second), None)]
    graph.priors += [Prior(i, np.eye(4), TIGHT) for i in (eye, body, tags[0])]
    for stamp, place in enumerate(places):
        rig = graph.add_pose(f"rig at {stamp}", off(place), stamp + 1)
        for number, tag in zip(tags, (np.eye(4), second), strict=True):
            corners = view(np.linalg.inv(place) @ tag, 0.1)
            graph.projections.append(Projection(0, eye, rig, body, number, 0.1, corners, 1.0))
    return graph, second, places


def test_exact_corners_give_back_the_exact_poses():
    graph, second, places = small_graph(0.03)
    solution = solve(graph, SolverConfig())
    np.testing.assert_allclose(solution.poses[3], second, atol=1e-7)
    np.testing.assert_allclose(solution.poses[4:], places, atol=1e-7)
    assert solution.reprojection_px.max() < 1e-5


@pytest.mark.slow
def test_the_covariance_is_that_of_many_noisy_solutions():
    exact, _, _ = small_graph(0.0)
    random, found = np.random.default_rng(1), []
    truth = solve(exact, SolverConfig(huber_px=None))
    for _ in range(150):
        noisy, _, _ = small_graph(0.0)
        noisy.projections = [
            replace(p, corners_px=p.corners_px + 0.3 * random.normal(size=(4, 2)), sigma_px=0.3)
            for p in noisy.projections
        ]
        solved = solve(noisy, SolverConfig(huber_px=None))
        found.append(se3.log(np.linalg.inv(truth.poses[3])[None] @ solved.poses[3][None])[0])
    predicted = np.sqrt(np.diag(covariances(solved, [3])[0]))
    np.testing.assert_allclose(np.std(found, axis=0), predicted, rtol=0.25)


def test_one_wild_corner_hardly_moves_a_robust_solution():
    graph, second, _ = small_graph(0.0)
    wild = graph.projections[1].corners_px.copy()
    wild[0] += 40.0
    graph.projections[1] = replace(graph.projections[1], corners_px=wild)

    def error_m(huber_px: float | None) -> float:
        return float(np.linalg.norm(solve(graph, SolverConfig(huber_px=huber_px)).poses[3][:3, 3] - second[:3, 3]))

    assert error_m(1.0) < 0.3 * error_m(None)


def test_a_pose_that_nothing_holds_is_named():
    graph, _, _ = small_graph(0.0)
    graph.add_pose("body cup at 7 ns", np.eye(4), 7)
    with pytest.raises(Undetermined, match="body cup"):
        solve(graph, SolverConfig())


def test_a_graph_without_any_prior_floats_and_says_so():
    graph, _, _ = small_graph(0.0)
    graph.priors.clear()
    with pytest.raises(Undetermined):
        solve(graph, SolverConfig())


def test_relative_poses_distances_and_coordinates_pull_where_they_should():
    graph = Graph([CAMERA])
    body = graph.add_pose("world", np.eye(4), None)
    a, b = (
        graph.add_pose(name, se3.exp(np.array([[0, 0, 0, x, 0.1, 0.2]]))[0], None)
        for name, x in (("a", 0.0), ("b", 1.0))
    )
    graph.priors += [
        Prior(body, np.eye(4), TIGHT),
        Prior(a, graph.start[a], np.diag([10.0] * 6)),
        Prior(b, graph.start[b], np.eye(6)),
    ]
    graph.distances.append(Distance((body, body), (a, b), (np.zeros(3), np.zeros(3)), 1.5, 1e-4))
    graph.coordinates.append(Coordinate(body, a, np.zeros(3), np.array([0.0, 0, 1]), 0.0, 1e-4))
    poses = solve(graph, SolverConfig()).poses
    assert np.linalg.norm(poses[b][:3, 3] - poses[a][:3, 3]) == pytest.approx(1.5, abs=1e-3)
    assert poses[a][2, 3] == pytest.approx(0.0, abs=1e-3)
    graph.betweens.append(Between(a, b, se3.exp(np.array([[0.1, 0, 0, 1.5, 0, 0]]))[0], 1e3 * np.eye(6)))
    poses = solve(graph, SolverConfig()).poses
    np.testing.assert_allclose(np.linalg.inv(poses[a]) @ poses[b], graph.betweens[0].delta, atol=1e-3)


def wall_with_two_tags(minimum_area: float = 0.0, second_size_m: float = 0.3):
    """A rig drives along a wall, past a tag of known place and one of unknown place; its odometry turns by half a
    degree too much a stamp."""
    known = NoisyPose(FACING, np.diag([1e4] * 6))
    wall = BodyEntry(
        "wall",
        True,
        NoisyPose(np.eye(4), np.diag([1e6] * 6)),
        0.3,
        {1: TagEntry(1, 0.3, known), 2: TagEntry(2, second_size_m, None)},
        frozenset(),
    )
    rig = BodyEntry("rig", False, None, 0.0, {}, frozenset(), "/odom", odom_noise=(0.02, 0.02))
    camera = CameraEntry("cam0", CAMERA, "/tags", "rig", NoisyPose(np.eye(4), np.diag([1e6] * 6)), (1e-5, 1e-5))
    config = TagSlamConfig((camera,), (wall, rig), None, 0.5, (), (), (), (), (), 2, minimum_tag_area_px2=minimum_area)
    second, random = FACING.copy(), np.random.default_rng(0)
    second[0, 3] = 5.0
    frames, odometry, drift, before = {}, [], np.eye(4), None
    for k in range(61):
        place = np.eye(4)
        place[:3, 3] = 0.1 * k - 0.5, 0.05 * np.sin(k), -1.5
        tags = []
        for tag_id, size_m, world_from_tag in ((1, 0.3, FACING), (2, second_size_m, second)):
            pixels = view(np.linalg.inv(place) @ world_from_tag, size_m)
            if CAMERA.sees(pixels).all():
                tags.append(DetectedTag(tag_id, 0, pixels + 0.1 * random.normal(size=(4, 2))))
        frames[k * 100_000_000] = tuple(tags)
        if before is not None:
            step = np.linalg.inv(before) @ place
            step[:3, :3] = step[:3, :3] @ Rotation.from_euler("y", 0.5, degrees=True).as_matrix()
            drift = drift @ step
        odometry.append(drift)
        before = place
    stamps = np.array(sorted(frames))
    return config, Recording({"/tags": frames}, {"/odom": (stamps, np.array(odometry))}), second


FACING = np.diag([1.0, -1.0, -1.0, 1.0])


def test_a_tag_that_only_drifting_odometry_reaches_is_placed_and_then_agrees_with_all_its_detections():
    config, recording, second = wall_with_two_tags()
    result = run_tag_slam(config, recording)
    assert result.unplaced == ()
    assert len(result.bodies["rig"][0]) == 61
    assert np.median(result.reprojection_px) < 0.5
    turn = Rotation.from_matrix(result.tags[2][:3, :3].T @ second[:3, :3]).magnitude()
    assert turn < np.radians(25)  # of 20 deg that the odometry had turned by then


def test_small_tags_start_nothing():
    config, recording, _ = wall_with_two_tags(minimum_area=12_000.0, second_size_m=0.1)
    assert 2 not in run_tag_slam(config, recording).tags


# median reprojection of TagSLAM's own reference poses in px (as its data state them)
REFERENCE_PX = {"01": 0.39, "02": 0.34, "07": 0.97, "16": 0.07, "17": 0.08, "23": 0.34}
SLOW = ("02", "07", "11", "16", "17", "23")


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(n, marks=[pytest.mark.slow] if n in SLOW else [])
        for n in ("01", "02", "07", "11", "16", "17", "23")
    ],
)
def test_tagslams_own_tests_get_tagslams_own_answers(data, number):
    folder = data("tagslam_test") / f"test_{number}"
    recording = read_recording(folder)
    result = run_tag_slam(read_config(folder), recording)
    if number in REFERENCE_PX:
        assert np.median(result.reprojection_px) < 1.05 * REFERENCE_PX[number] + 0.005
    with np.load(folder / "reference.npz") as stored:
        (name,) = [n for n in stored.files if n.startswith("odom|") and n.endswith("stamp_ns")]
        stamps, rows = stored[name], stored[name.replace("stamp_ns", "xyz_qxyzw")]
    body = name.split("|")[1].split("body_")[1]
    ours, poses = result.bodies[body]
    assert list(ours) == stamps.tolist()
    gap_m = np.linalg.norm(poses[:, :3, 3] - rows[:, :3], axis=1) - 0.002 * np.linalg.norm(rows[:, :3], axis=1)
    turn_deg = np.degrees((Rotation.from_matrix(poses[:, :3, :3]).inv() * Rotation.from_quat(rows[:, 3:])).magnitude())
    share = 0.95 if number == "11" else 0.98  # in test 11 odometry alone carries the pose between rare tags
    assert np.quantile(gap_m, share) < 0.002
    assert np.quantile(turn_deg, share) < 0.1


@pytest.mark.slow
def test_the_test_that_must_fail_fails_by_name_and_runs_when_mended(data):
    folder = data("tagslam_test") / "test_20"
    config, recording = read_config(folder), read_recording(folder)
    with pytest.raises(Undetermined, match="tag"):
        run_tag_slam(config, recording, most_frames=300)
    body = config.body("pennstock")
    known = body.tags[45].pose
    mended = NoisyPose(known.pose, np.diag([10.0] * 3 + np.diag(known.root_information)[3:].tolist()))
    tags = {**body.tags, 45: replace(body.tags[45], pose=mended)}
    bodies = tuple(replace(b, tags=tags) if b is body else b for b in config.bodies)
    result = run_tag_slam(replace(config, bodies=bodies), recording, most_frames=300)
    assert np.median(result.reprojection_px) < 0.4


def test_the_bag_says_the_same_as_its_conversion(data, tmp_path):
    folder = data("tagslam_test") / "test_01"
    (tmp_path / "tag_detections.bag.bz2").write_bytes((folder / "tag_detections.bag.bz2").read_bytes())
    bag, converted = read_recording(tmp_path), read_recording(folder)
    assert {t: sorted(f) for t, f in bag.frames.items()} == {t: sorted(f) for t, f in converted.frames.items()}
    for topic, frames in bag.frames.items():
        for stamp, seen in frames.items():
            for a, b in zip(seen, converted.frames[topic][stamp], strict=True):
                assert a.tag_id == b.tag_id
                np.testing.assert_allclose(a.corners_px, b.corners_px, atol=1e-9)


def test_a_tag_on_two_bodies_is_refused(data, tmp_path):
    folder = data("tagslam_test") / "test_01"
    for name in ("cameras.yaml", "camera_poses.yaml"):
        (tmp_path / name).write_text((folder / name).read_text())
    body = {"is_static": True, "type": "simple", "default_tag_size": 0.1, "tags": [{"id": 3}]}
    config = {"tagslam_parameters": {}, "bodies": [{"table": body}, {"cup": {**body, "is_static": False}}]}
    (tmp_path / "tagslam.yaml").write_text(json.dumps(config))
    with pytest.raises(BadInput, match="tag 3 is on two bodies, 'table' and 'cup'"):
        read_config(tmp_path)


def test_a_folder_without_a_configuration_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"cameras\.yaml cannot be read"):
        read_config(tmp_path)
