"""ICP of the shape to raw depth: known offsets come back, what is not observable stays, bad frames are named."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from processing.refine.icp import IcpConfig, ShapeSurface, align_frame, align_frames, count_verdicts
from processing.sensor.render import RaycastRenderer
from recordings.geometry import CameraModel
from recordings.tracks import ObjectShape

CAMERA = CameraModel("d455", 320, 240, np.array([[190.0, 0, 160.2], [0, 191.0, 119.4], [0, 0, 1]]))
CORNER_VIEW = Rotation.from_rotvec([0.5, -0.7, 0.3])


@pytest.fixture(scope="module")
def box() -> ObjectShape:
    mesh = trimesh.creation.box((0.10, 0.08, 0.06))
    return ObjectShape("object", "test", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def at(turn: Rotation) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), [0.02, -0.01, 0.5]
    return pose


def moved(pose: np.ndarray, turn_deg: list[float], shift_m: list[float]) -> np.ndarray:
    off = np.eye(4)
    off[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    off[:3, 3] = shift_m
    return pose @ off


def seen(box: ObjectShape, pose: np.ndarray, noise_m: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    depth_m = RaycastRenderer(box, CAMERA).depth(pose)
    mask = depth_m > 0
    noise = noise_m * np.random.default_rng(0).normal(size=depth_m.shape)
    return np.where(mask, depth_m + noise, 0).astype(np.float32), mask


def gap(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    off = np.linalg.inv(a) @ b
    return float(np.degrees(Rotation.from_matrix(off[:3, :3]).magnitude())), float(np.linalg.norm(off[:3, 3]))


@pytest.mark.parametrize("noise_m", [0.0, 0.0015])
def test_a_known_offset_comes_back_when_three_faces_are_seen(box, noise_m):
    true = at(CORNER_VIEW)
    depth_m, mask = seen(box, true, noise_m)
    (result,) = align_frames(
        box, [depth_m], [mask], CAMERA, moved(true, [3, -2, 2], [0.004, 0.003, -0.004])[None], IcpConfig()
    )
    degrees, metres = gap(result.camera_from_object, true)
    assert result.verdict == "aligned"
    assert result.held == 0
    assert degrees < 0.05 + 200 * noise_m
    assert metres < 0.0001 + 0.3 * noise_m


def test_with_one_face_visible_sliding_along_it_is_left_alone(box):
    true = at(Rotation.identity())
    true[:2, 3] = 0
    depth_m, mask = seen(box, true)
    start = moved(true, [0, 0, 0], [0.003, 0.0, 0.004])
    (result,) = align_frames(box, [depth_m], [mask], CAMERA, start[None], IcpConfig())
    assert result.held == 3
    assert result.camera_from_object[2, 3] == pytest.approx(true[2, 3], abs=2e-4)  # depth is corrected
    assert result.camera_from_object[0, 3] == pytest.approx(start[0, 3], abs=3e-4)  # sliding is not


def test_a_frame_at_rest_on_its_true_pose_does_not_move(box):
    true = at(CORNER_VIEW)
    depth_m, mask = seen(box, true)
    (result,) = align_frames(box, [depth_m], [mask], CAMERA, true[None], IcpConfig())
    degrees, metres = gap(result.camera_from_object, true)
    assert degrees < 0.01
    assert metres < 2e-5


def test_a_frame_far_off_is_rejected_and_keeps_its_pose(box):
    true = at(CORNER_VIEW)
    depth_m, mask = seen(box, true)
    start = moved(true, [0, 0, 40], [0.03, 0, 0])
    (result,) = align_frames(box, [depth_m], [mask], CAMERA, start[None], IcpConfig())
    assert result.verdict in ("poor fit", "moved too far")
    np.testing.assert_array_equal(result.camera_from_object, start)


def test_rejections_are_counted_by_name(box):
    true = at(CORNER_VIEW)
    depth_m, mask = seen(box, true)
    lost = np.full((4, 4), np.nan)
    none = np.zeros_like(mask)
    results = align_frames(box, [depth_m] * 3, [mask, none, mask], CAMERA, np.stack([true, true, lost]), IcpConfig())
    assert count_verdicts(results) == {"aligned": 1, "too few points": 1, "lost": 1}
    assert np.isnan(results[2].camera_from_object).all()


def test_points_of_a_neighbour_do_not_drag_the_shape(box):
    true = at(CORNER_VIEW)
    depth_m, mask = seen(box, true)
    v, u = np.nonzero(mask)
    points = CAMERA.back_project(np.stack([u, v], -1).astype(float), depth_m[v, u].astype(float))
    table = np.random.default_rng(0).uniform([-0.1, -0.1, 0.56], [0.1, 0.1, 0.57], (len(points) // 5, 3))
    result = align_frame(
        ShapeSurface(box), np.concatenate([points, table]), moved(true, [1, 1, 0], [0.002, 0, 0]), IcpConfig()
    )
    degrees, metres = gap(result.camera_from_object, true)
    assert result.verdict == "aligned"
    assert degrees < 0.15
    assert metres < 0.0005
