"""The baseline tracker on motions that are known exactly."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from processing.baselines.frame_to_model import FrameToModel, Tracked
from processing.evaluate.metrics import align_first, frame_errors
from recordings.errors import BadInput
from recordings.geometry import CameraModel, rotation_angle_rad
from recordings.progress import Silent
from recordings.records import RgbdFrame

COUNT = 10


def track(world: Any, frames: list[RgbdFrame], masks: list[np.ndarray], camera: CameraModel | None = None) -> Tracked:
    return FrameToModel().track(4, frames, masks, camera or world.camera, "object", Silent())


@pytest.fixture(scope="module")
def toss(tiny_world: Any) -> tuple[list[RgbdFrame], list[np.ndarray], np.ndarray]:
    poses = tiny_world.poses(COUNT)
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(poses)]
    truth = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in poses])
    return [f for f, _ in seen], [m for _, m in seen], truth


@pytest.fixture(scope="module")
def tracked(tiny_world: Any, toss: Any) -> Tracked:
    return track(tiny_world, toss[0], toss[1])


def test_a_known_motion_comes_back(toss: Any, tracked: Tracked) -> None:
    estimate, truth = tracked.track.camera_from_object, toss[2]
    errors = frame_errors(estimate @ align_first(estimate, truth), truth, np.eye(3) * 0.05)
    assert errors.rotation_deg.max() < 3.0
    assert errors.translation_m.max() < 0.004
    assert tracked.track.status == ("tracked",) * COUNT
    assert tracked.track.time_ns.tolist() == [f.time_ns for f in toss[0]]


def test_the_object_frame_starts_parallel_to_the_camera_in_the_cloud(toss: Any, tracked: Tracked) -> None:
    first = tracked.track.camera_from_object[0]
    np.testing.assert_array_equal(first[:3, :3], np.eye(3))
    assert np.linalg.norm(first[:3, 3] - toss[2][0, :3, 3]) < 0.05


def test_the_mesh_lies_on_the_true_surface(toss: Any, tracked: Tracked) -> None:
    import trimesh

    from processing.evaluate.metrics import distance_to_surface_m

    shift = np.linalg.inv(tracked.track.camera_from_object[0]) @ toss[2][0]
    inverse = np.linalg.inv(shift)
    there = tracked.shape.vertices_m @ inverse[:3, :3].T + inverse[:3, 3]
    box = trimesh.creation.box((0.10, 0.08, 0.06))
    assert np.median(distance_to_surface_m(box, there)) < 0.0015
    assert tracked.shape.vertex_rgb is not None
    assert len(tracked.shape.faces) > 500


def test_covariances_are_positive_and_of_a_likely_size(tracked: Tracked) -> None:
    for covariance in tracked.track.covariance[1:]:
        assert np.linalg.eigvalsh(covariance).min() > 0
        assert 1e-6 < np.sqrt(np.trace(covariance[3:, 3:])) < 0.02


def test_the_direction_along_a_plane_is_the_uncertain_one(tiny_world: Any) -> None:
    """Seen from above, a flat plate slides freely in its plane: only its distance is known."""
    from processing.baselines.frame_to_model import covariance_of

    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-0.05, 0.05, (400, 2)), np.full(400, 0.8)]
    pose = np.eye(4)
    pose[2, 3] = 0.8
    covariance = covariance_of(points, np.tile([0.0, 0.0, -1.0], (400, 1)), pose, 0.001)
    assert covariance[5, 5] < 1e-6
    assert covariance[3, 3] == pytest.approx(1.0)
    assert covariance[2, 2] == pytest.approx(1.0)
    assert covariance[0, 0] < 1e-3


def test_a_hidden_frame_is_lost_and_the_track_goes_on(tiny_world: Any, toss: Any) -> None:
    frames, masks, truth = toss
    hidden = [np.zeros_like(m) if i == 4 else m for i, m in enumerate(masks)]
    found = track(tiny_world, frames, hidden).track
    assert found.status[4] == "lost"
    assert np.isnan(found.camera_from_object[4]).all()
    assert found.status.count("lost") == 1
    errors = frame_errors(
        found.camera_from_object @ align_first(found.camera_from_object, truth), truth, np.eye(3) * 0.05
    )
    assert errors.rotation_deg[-1] < 4


def test_depth_of_zero_in_the_mask_is_lost(tiny_world: Any, toss: Any) -> None:
    frames, masks, _ = toss
    blind = [replace(f, depth_m=f.depth_m * 0) if i == 3 else f for i, f in enumerate(frames)]
    assert track(tiny_world, blind, masks).track.status[3] == "lost"


def test_identical_frames_hardly_drift(tiny_world: Any, toss: Any) -> None:
    """Not zero: each fusion moves the surface by a fraction of its 2 mm voxels, on an object of 40 pixels."""
    frames, masks, _ = toss
    found = track(tiny_world, frames[:1] * 6, masks[:1] * 6).track
    last, first = found.camera_from_object[-1], found.camera_from_object[0]
    assert np.degrees(rotation_angle_rad(last[:3, :3] @ first[:3, :3].T)) < 1.0
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) < 0.001


def test_one_frame_gives_one_pose_and_a_surface(tiny_world: Any, toss: Any) -> None:
    found = track(tiny_world, toss[0][:1], toss[1][:1])
    assert found.track.status == ("tracked",)
    assert len(found.shape.faces) > 100


def test_a_toss_without_the_object_says_what_is_wanted(tiny_world: Any, toss: Any) -> None:
    with pytest.raises(BadInput, match="toss 4: no frame holds .* wanted a mask that covers it"):
        track(tiny_world, toss[0], [np.zeros_like(m) for m in toss[1]])


def test_the_same_input_gives_the_same_bytes(tiny_world: Any, toss: Any, tracked: Tracked) -> None:
    again = track(tiny_world, toss[0], toss[1])
    np.testing.assert_array_equal(again.track.camera_from_object, tracked.track.camera_from_object)
    np.testing.assert_array_equal(again.shape.vertices_m, tracked.shape.vertices_m)
