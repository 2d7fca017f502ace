"""A pair of views says of a turn what paint tells, and nothing that light alone would explain."""

from __future__ import annotations

import numpy as np
import pytest

from processing.motion import se3_kernels as se3
from processing.sensor import view_layout as lay
from processing.track import kernels as k
from processing.track.pairs import SHADING_SIGMA, eliminated

FOCAL, CENTER, SIDE = np.array([500.0, 500.0]), np.array([40.0, 40.0]), 80
BALL_M, FAR_M = 0.05, 0.8
ROW = np.array([0, 20, 0.0035, 0.08, 0.002, 1.0, 0.0])


def ball(paint: float) -> tuple[np.ndarray, np.ndarray]:
    """Maps (pixels, channels) and samples of a ball lit from the left, with a printed pattern of this contrast."""
    v, u = np.indices((SIDE, SIDE))
    rays = np.stack([(u - CENTER[0]) / FOCAL[0], (v - CENTER[1]) / FOCAL[1], np.ones((SIDE, SIDE))], -1)
    square, along = (rays**2).sum(-1), rays[..., 2] * FAR_M
    inside = along**2 - square * (FAR_M**2 - BALL_M**2)
    on = inside > 0
    z = np.where(on, (along - np.sqrt(np.maximum(inside, 0))) / square, 0)
    points = rays * z[..., None]
    normal = np.where(on[..., None], (points - [0, 0, FAR_M]) / BALL_M, 0)
    maps = np.zeros((SIDE, SIDE, lay.CHANNELS), dtype=np.float32)
    maps[..., lay.Z], maps[..., lay.NX : lay.NZ + 1], maps[..., lay.OUTSIDE] = z, normal, np.where(on, 0, 9)
    tone = 0.4 * normal[..., 0] + paint * np.sin(3 * np.arctan2(normal[..., 1], normal[..., 2]) + 20 * normal[..., 0])
    maps[..., lay.SHARP :] = np.where(on, tone, 0)[..., None]
    seen = on & (normal[..., 2] < -0.4)
    samples = np.concatenate([points[seen], normal[seen], maps[seen][:, lay.SHARP :]], -1).astype(np.float32)
    return maps.reshape(-1, lay.CHANNELS), np.ascontiguousarray(samples)


def said_of_a_turn(paint: float, turned_rad: float, shaded: bool) -> tuple[float, float]:
    """Step (rad) and information that one pair gives for the ball's turn about its vertical axis, when its pose has it
    turned by so much and nothing that is seen has."""
    maps, samples = ball(paint)
    table = np.array([[0, 0, 0, SIDE, SIDE, 0, len(samples)]] * 2, dtype=np.int64)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = FAR_M
    poses[1] = poses[1] @ se3.exponential(np.array([0, 0, 0, 0, turned_rad, 0]))
    blocks, gradients, figures = np.zeros((1, 6, 6)), np.zeros((1, 6)), np.zeros((1, 3))
    crossed, among = k.shading_terms(1)
    k.graph_terms(poses, np.array([[0, 1]]), maps, samples, table, FOCAL, CENTER, ROW, 1.0, shaded, blocks,
                  gradients, crossed, among, figures)  # fmt: skip
    if shaded:
        blocks, gradients = eliminated(blocks, gradients, crossed, among)
    return float(-gradients[0, 4] / blocks[0, 4, 4]), float(blocks[0, 4, 4])


def test_the_light_on_a_plain_ball_does_not_say_that_it_has_not_turned() -> None:
    step, information = said_of_a_turn(paint=0.0, turned_rad=0.1, shaded=False)
    assert abs(abs(step) - 0.1) < 0.04  # followed as paint, light turns the ball back
    assert said_of_a_turn(paint=0.0, turned_rad=0.1, shaded=True)[1] < 0.25 * information


def test_print_says_of_a_turn_as_much_as_before() -> None:
    followed = said_of_a_turn(paint=0.3, turned_rad=0.01, shaded=False)
    free = said_of_a_turn(paint=0.3, turned_rad=0.01, shaded=True)
    assert free[0] == pytest.approx(followed[0], rel=0.1)
    assert abs(abs(free[0]) - 0.01) < 0.003
    assert free[1] > 0.9 * followed[1]


def test_what_shading_and_a_motion_do_together_is_told_apart() -> None:
    rng = np.random.default_rng(5)
    J, K = rng.normal(size=(400, 6)), rng.normal(size=(400, k.SHADING))
    motion, shading = rng.normal(size=6), 0.1 * SHADING_SIGMA * rng.normal(size=k.SHADING)
    r = -(J @ motion + K @ shading)
    among = np.concatenate([K.T @ K, (K.T @ r)[None]])
    H, g = eliminated((J.T @ J)[None], (J.T @ r)[None], (J.T @ K)[None], among[None])
    np.testing.assert_allclose(-np.linalg.solve(H[0], g[0]), motion, atol=2e-3)
    assert np.linalg.eigvalsh(J.T @ J - H[0]).min() > -1e-9  # never more than with the light known
