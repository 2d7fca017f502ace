"""What a robot hides of an object is not taken to be empty."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from processing.field.fuse import FuseConfig, fuse
from processing.field.learn import LearnConfig, TossViews, chosen_views
from processing.field.mesh import grid_mesh
from recordings.results.folder import RobotMasks
from recordings.tracks import ObjectTrack, Status


def volume_m3(views: TossViews, world: Any) -> float:
    import trimesh

    grid = fuse(chosen_views([views], world.camera, LearnConfig()), FuseConfig(voxel_m=0.003))
    mesh = grid_mesh(grid)
    return abs(float(trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False).volume))


@pytest.fixture
def held(tiny_world: Any, toss: Any, tmp_path: Path) -> TossViews:
    """The box at its true poses; in every other frame something stands before its right half."""
    frames, masks = toss
    poses = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in tiny_world.poses(len(frames))])
    folder = tmp_path / "toss_00.robot"
    folder.mkdir()
    seen, left = [], []
    for i, (frame, mask) in enumerate(zip(frames, masks)):
        robot = np.zeros_like(mask)
        if i % 2 == 0:
            robot[:, int(np.median(np.nonzero(mask)[1])) :] = True
        cv2.imwrite(str(folder / f"{i:06d}.png"), robot.astype(np.uint8) * 255)
        seen.append(replace(frame, depth_m=np.where(robot, np.float32(0.2), frame.depth_m)))
        left.append(mask & ~robot)
    status: tuple[Status, ...] = tuple("tracked" for _ in frames)
    times = np.array([f.time_ns for f in frames])
    covariance = np.tile(1e-6 * np.eye(6), (len(frames), 1, 1))
    track = ObjectTrack(0, "d455", "object", times, poses, status, covariance)
    return TossViews(seen, times, left, track, robot=RobotMasks.of(tmp_path, 0))


def test_what_the_robot_hides_stays_part_of_the_shape(tiny_world: Any, toss: Any, held: TossViews) -> None:
    whole = volume_m3(replace(held, frames=toss[0], masks=toss[1], robot=None), tiny_world)
    assert volume_m3(held, tiny_world) > 0.9 * whole
    assert volume_m3(replace(held, robot=None), tiny_world) < 0.75 * whole


def test_where_no_robot_was_drawn_it_may_be_anywhere(tmp_path: Path) -> None:
    assert RobotMasks.of(tmp_path, 3) is None
    (tmp_path / "toss_03.robot").mkdir()
    assert RobotMasks.of(tmp_path, 3) is None
    cv2.imwrite(str(tmp_path / "toss_03.robot" / "000001.png"), np.eye(4, 5, dtype=np.uint8) * 255)
    robot = RobotMasks.of(tmp_path, 3)
    assert robot is not None
    np.testing.assert_array_equal(robot.at(1, (4, 5)), np.eye(4, 5, dtype=bool))
    assert robot.at(0, (4, 5)).shape == (4, 5)
    assert robot.at(0, (4, 5)).all()
