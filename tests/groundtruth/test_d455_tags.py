"""What the D455's own view of the tags does to poses next to impacts: known answers, then a recorded toss."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.cli import main as calibrate_main
from calibration.tags.detect import TagDetection
from groundtruth.cli import main
from groundtruth.d455_tags import D455RefinementConfig, by_detections, color_tags
from groundtruth.toss_truth import TossTruth, TrackedLimits, statuses
from recordings.cli_session import main as session_main
from recordings.geometry import CameraModel
from recordings.session import Toss

TAG_M, NOISE_PX = 0.07, 0.2
CAMERA = CameraModel("d455", 848, 480, np.array([[430.0, 0, 424], [0, 430.0, 240], [0, 0, 1]]))
CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
LIMITS = TrackedLimits()


def moved(poses, random, shift_m, turn_rad):
    out = poses.copy()
    out[:, :3, 3] += shift_m * random.normal(size=(len(out), 3))
    turn = Rotation.from_rotvec(turn_rad * random.normal(size=(len(out), 3))).as_matrix()
    out[:, :3, :3] = turn @ out[:, :3, :3]
    return out


def flight(random, layout, camera_from_world, frames=24):
    """True poses before the camera, and the corners that it sees of tags that face it (a little short)."""
    world_from_camera = np.linalg.inv(camera_from_world)
    poses, seen = np.tile(np.eye(4), (frames, 1, 1)), []
    for k in range(frames):
        poses[k, :3, :3] = Rotation.from_rotvec([0.2 * k, 0.1 * k, -0.3]).as_matrix()
        poses[k, :3, 3] = (world_from_camera @ [0.01 * k - 0.1, 0.05 - 0.003 * k, 0.7, 1])[:3]
        tags = []
        for tag_id, place in layout.items():
            in_camera = camera_from_world @ poses[k] @ place
            points = TAG_M * CORNERS @ in_camera[:3, :3].T + in_camera[:3, 3]
            if points.mean(axis=0) @ in_camera[:3, 2] < 0.35 * np.linalg.norm(points.mean(axis=0)):
                continue
            pixels = CAMERA.project(points)
            pixels = pixels.mean(axis=0) + (pixels - pixels.mean(axis=0)) * 0.993
            pixels = pixels + NOISE_PX * random.normal(size=(4, 2))
            tags.append(TagDetection(tag_id, pixels, np.tile(NOISE_PX**2 * np.eye(2), (4, 1, 1)), 80.0, 0))
        seen.append(color_tags(0, k, tags, layout, dict.fromkeys(layout, TAG_M)))
    return poses, seen


@pytest.fixture
def scene(toss_lab):
    """Eight poses of 24 are guesses (4 mm, 2 deg); the camera stands 0.7 mm and 0.03 deg from where it is thought."""
    random, layout = np.random.default_rng(3), toss_lab(tosses=1, frames=2).layout
    known = np.eye(4)
    known[:3, :3], known[:3, 3] = Rotation.from_euler("x", 120, degrees=True).as_matrix(), [0, 0.2, 0.9]
    true_camera = np.eye(4)
    true_camera[:3, :3], true_camera[:3, 3] = Rotation.from_rotvec([5e-4, 0, 0]).as_matrix(), [5e-4, 5e-4, 0]
    poses, seen = flight(random, layout, true_camera @ known)
    open_ = np.arange(24) % 3 == 0
    guessed = poses.copy()
    guessed[open_] = moved(poses[open_], random, 0.004 / np.sqrt(3), np.radians(2) / np.sqrt(3))
    sigma = np.where(open_[:, None], [0.02] * 3 + [0.0025] * 3, [2e-4] * 3 + [5e-5] * 3)
    covariance = np.einsum("ni,ij->nij", sigma**2, np.eye(6))
    status = statuses(covariance, LIMITS)
    truth = TossTruth(np.arange(24), guessed, covariance, status, open_, np.zeros(24, bool), guessed)
    return truth, poses, seen, known


def errors(found, true):
    turn = Rotation.from_matrix(found[:, :3, :3]).inv() * Rotation.from_matrix(true[:, :3, :3])
    return np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1), turn.magnitude()


def test_guesses_are_put_right_and_sure_poses_stay(scene):
    truth, true, seen, known = scene
    answer = by_detections(CAMERA, known, seen, {0: truth}, LIMITS, D455RefinementConfig())
    found = answer.tosses[0]
    np.testing.assert_array_equal(found.world_from_tagged[~truth.open], truth.world_from_tagged[~truth.open])
    gap_m, turn_rad = errors(found.world_from_tagged[truth.open], true[truth.open])
    before_m, before_rad = errors(truth.world_from_tagged[truth.open], true[truth.open])
    assert np.sqrt((gap_m**2).mean()) < 0.4 * np.sqrt((before_m**2).mean())
    assert np.sqrt((turn_rad**2).mean()) < 0.3 * np.sqrt((before_rad**2).mean())
    assert found.refined.tolist() == truth.open.tolist()
    assert answer.off_m == pytest.approx(7e-4, abs=6e-4)


def test_what_it_says_of_its_error_is_about_its_error(scene):
    truth, true, seen, known = scene
    found = by_detections(CAMERA, known, seen, {0: truth}, LIMITS, D455RefinementConfig()).tosses[0]
    gap_m, turn_rad = errors(found.world_from_tagged[truth.open], true[truth.open])
    said = np.sqrt(np.einsum("nii->ni", found.covariance[truth.open]))
    assert 0.4 < np.sqrt((gap_m**2).mean() / (said[:, 3:] ** 2).sum(axis=1).mean()) < 1.6
    assert 0.4 < np.sqrt((turn_rad**2).mean() / (said[:, :3] ** 2).sum(axis=1).mean()) < 1.6


def test_corners_of_another_scene_change_nothing(scene):
    truth, _, seen, known = scene
    wrong = [replace(s, pixels=s.pixels + [40.0, -25.0]) if truth.open[s.frame] else s for s in seen]
    found = by_detections(CAMERA, known, wrong, {0: truth}, LIMITS, D455RefinementConfig()).tosses[0]
    np.testing.assert_array_equal(found.world_from_tagged, truth.world_from_tagged)
    assert not found.refined.any()


def test_a_camera_that_hardly_sees_the_sure_poses_says_nothing(scene):
    truth, _, seen, known = scene
    assert by_detections(CAMERA, known, seen[:3], {0: truth}, LIMITS, D455RefinementConfig()) is None


@pytest.mark.slow
def test_a_whole_recorded_toss_is_found_impacts_included(data, tmp_path, capsys):
    session = tmp_path / "cube"
    assert session_main(["import", "folder", str(data("cube_dev")), str(session)]) == 0
    assert calibrate_main(["cameras", str(session)]) == 0
    capsys.readouterr()
    assert main([str(session), "--toss", "0", "--tag-size", "0.06140625", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["d455_refinement"]["frames"] >= 10
    found = Toss(session / "truth" / "toss_00.mcap").poses("/groundtruth/pose")
    with np.load(data("cube_dev_truth") / "toss_00" / "poses_camera_object.npz") as stored:
        gap_m, turn_rad = after_one_offset(found, stored["T_world_object"])
    assert len(gap_m) == 43
    assert np.sqrt((gap_m**2).mean()) < 5e-4
    assert np.degrees(np.sqrt((turn_rad**2).mean())) < 0.25
    assert np.degrees(turn_rad).max() < 5


def after_one_offset(found, true):
    poses = np.array([p.matrix for p in found])
    offsets, offset = np.linalg.inv(poses) @ true, np.eye(4)
    offset[:3, :3] = Rotation.from_matrix(offsets[:, :3, :3]).mean().as_matrix()
    offset[:3, 3] = np.median(offsets[:, :3, 3], axis=0)
    return errors(poses @ offset, true)
