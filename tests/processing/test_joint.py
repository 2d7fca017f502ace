"""The joint objective: every term's derivatives are those of its residuals, and it finds poses and shape that were
disturbed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from processing.motion.tangents import about
from processing.refine.icp import ShapeSurface
from processing.refine.joint import FrameData, JointConfig, World, solve_jointly
from processing.refine.joint_terms import Block, Controls, depth_block, flight_block, plane_block, rest_block
from recordings.geometry import rotation_angle_rad, rotation_exp
from recordings.tracks import ObjectShape

CENTER = np.array([0.01, -0.005, 0.02])
LOOSE = np.diag([0.05] * 3 + [0.01] * 3) ** 2
"""A covariance that says next to nothing."""


def box_shape(scale: float = 1.0) -> ObjectShape:
    box = trimesh.creation.box((0.10, 0.08, 0.06)).subdivide().subdivide().subdivide()
    shade = (127 + 120 * np.sin(300 * box.vertices.sum(1))).clip(0, 255).astype(np.uint8)
    rgb = np.repeat(shade[:, None], 3, 1)
    return ObjectShape("object", "test", scale * np.asarray(box.vertices), np.asarray(box.faces), rgb)


def motion(turn: Any, shift: Any) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation_exp(np.array(turn, dtype=np.float64)), shift
    return out


def dense(block: Block, columns: int) -> np.ndarray:
    out = np.zeros((len(block.residual), columns))
    np.add.at(out, (block.row, block.column), block.value)
    return out


def slopes(residual: Any, columns: int, step: float = 1e-6) -> np.ndarray:
    """Central differences of residual(frame, turn, shift)."""
    out = []
    for k in range(columns):
        change = np.zeros(columns)
        change[k] = step
        out.append((residual(change) - residual(-change)) / (2 * step))
    return np.stack(out, 1)


def moved(poses: np.ndarray, change: np.ndarray) -> np.ndarray:
    steps = change.reshape(-1, 2, 3)
    return np.stack([p @ about(CENTER, s[0], s[1]) for p, s in zip(poses, steps)])


@pytest.mark.parametrize("term", ["flight", "rest"])
def test_the_derivatives_of_motion_terms_are_those_of_their_residuals(term: str) -> None:
    rng = np.random.default_rng(3)
    poses = np.stack([motion(rng.normal(0, 0.15, 3) + [0.2 * i, 0.1 * i, 0], rng.normal(0, 0.1, 3)) for i in range(3)])
    times_s = np.array([0.0, 0.033, 0.07])

    def block(change: np.ndarray) -> Block:
        at = moved(poses, change)
        if term == "rest":
            return rest_block(np.array([[0, 1], [1, 2]]), at, CENTER)
        return flight_block(np.array([[0, 1, 2]]), times_s, at, CENTER, np.eye(3))

    found = dense(block(np.zeros(18)), 18)
    expected = slopes(lambda c: block(c).residual, 18)
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


def test_the_derivatives_of_the_depth_term_are_those_of_its_residuals() -> None:
    shape = box_shape()
    controls = Controls.of(shape, 40, 0.12)
    rng = np.random.default_rng(0)
    pose = motion((0.4, 0.2, 0.1), (0.0, 0.02, 0.6))
    points = (np.c_[rng.uniform(-0.04, 0.04, 50), rng.uniform(-0.03, 0.03, 50), np.full(50, -0.0295)]) @ pose[:3, :3].T
    points += pose[:3, 3]

    def block(change: np.ndarray) -> Block:
        at = moved(pose[None], change[:6])[0]
        surface = ShapeSurface(controls.moved(shape, change[6:]))
        return depth_block(0, points, at, surface, controls, CENTER, 6, 10.0)

    found = dense(block(np.zeros(46)), 46)
    expected = slopes(lambda c: block(c).residual, 46, 1e-5)
    np.testing.assert_allclose(found[:, :6], expected[:, :6], atol=2e-3)
    np.testing.assert_allclose(found[:, 6:].sum(1), expected[:, 6:].sum(1), atol=0.05)


def test_the_plane_term_pushes_out_what_lies_below_and_leaves_what_flies() -> None:
    shape = box_shape()
    controls = Controls.of(shape, 40, 0.12)
    poses = np.stack([motion((0, 0, 0), (0, 0, 0.028)), motion((0, 0, 0), (0, 0, 0.2))])
    up = np.array([0.0, 0.0, 1.0])
    block = plane_block(np.array([0, 1]), np.zeros(0, dtype=np.int64), poses, shape, controls, CENTER, up, 0.0, 12)
    assert set((block.column[block.column < 12] // 6).tolist()) == {0}
    np.testing.assert_allclose(block.residual, -0.002, atol=1e-5)  # the hull is read from samples
    assert dense(block, 52)[:, 5] == pytest.approx(1.0)


def test_disturbed_poses_and_a_swollen_shape_come_back_together(tiny_world: Any) -> None:
    true_poses = [(tiny_world.world_from_camera.inverse() @ p).matrix for p in tiny_world.poses(8)]
    shape = box_shape(1.02)  # 1 mm too large on either side
    rng = np.random.default_rng(1)
    frames, start = [], []
    for i, pose in enumerate(true_poses):
        frame, mask = tiny_world.see(tiny_world.poses(8)[i], i)
        v, u = np.nonzero(mask)
        rays = tiny_world.camera.pixel_rays()
        points = rays[v, u] * frame.depth_m[v, u, None].astype(np.float64)
        frames.append(FrameData(0, i, i / 30, points, np.eye(4), LOOSE))
        start.append(pose @ motion(rng.normal(0, 0.01, 3), rng.normal(0, 0.002, 3)))
    config = JointConfig(rounds=6, shape_sigma_m=0.002)
    found = solve_jointly(frames, np.stack(start), shape, None, config)
    ours, true = (p @ np.linalg.inv(p[0]) for p in (found.poses, np.stack(true_poses)))  # size and place meet one-sided
    turned = [np.degrees(rotation_angle_rad(a[:3, :3].T @ b[:3, :3])) for a, b in zip(ours, true)]
    assert np.median(turned) < 0.35
    gaps = []
    for frame, pose in zip(frames, found.poses):
        inverse = np.linalg.inv(pose)
        points = frame.points_m @ inverse[:3, :3].T + inverse[:3, 3]
        gaps.append(np.linalg.norm(ShapeSurface(found.shape).nearest(points)[0] - points, axis=1).mean())
    assert np.mean(gaps) < 0.0007


def test_flight_draws_noisy_poses_towards_the_parabola() -> None:
    rng = np.random.default_rng(5)
    times_s = np.arange(12) / 30
    fall = [motion((0, 0.3 * t, 0), (0.5 * t, 0, 1.0 + 1.2 * t - 0.5 * 9.81 * t * t)) for t in times_s]
    noisy = np.stack([p @ motion(rng.normal(0, 0.01, 3), rng.normal(0, 0.001, 3)) for p in fall])
    frames = [FrameData(0, i, float(t), np.zeros((0, 3)), np.eye(4), LOOSE) for i, t in enumerate(times_s)]
    index = np.zeros(0, dtype=np.int64)
    flights = np.arange(10)[:, None] + np.arange(3)
    up = np.array([0.0, 0.0, 1.0])
    world = World(np.eye(4), up, -9.0, np.zeros(3), np.eye(3), flights, index.reshape(0, 2), index, index)
    found = solve_jointly(frames, noisy, box_shape(), world, JointConfig(rounds=4))

    def bend(poses: np.ndarray) -> float:
        place = poses[:, :3, 3]
        return float(np.abs(place[2:] - 2 * place[1:-1] + place[:-2] - np.array([0, 0, -9.81]) / 900).mean())

    assert bend(found.poses) < 0.1 * bend(noisy)
