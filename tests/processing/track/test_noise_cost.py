"""What depth's noise makes views cost, and frames of a noisy camera that are not called lost for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from processing.evaluate.metrics import align_first, frame_errors
from processing.sensor.noise import FINE, DepthNoise
from processing.track.noise_cost import at_noise, pair_cost
from processing.track.track_toss import TossTrack, TrackConfig, track_toss

COARSE = DepthNoise(0.03, 20.0)


@pytest.mark.parametrize("noise", [FINE, DepthNoise(0.008, 200.0), DepthNoise(0.02, 20.0)])
def test_the_cost_of_true_poses_is_the_kernels_mean_over_noise(noise: DepthNoise) -> None:
    """min(r^2 / 9, 1) / 2 of residuals between two smoothed surfaces, drawn."""
    smooth_m = noise.sigma_at_1m * 0.8**2 * min(1.0, noise.patch_px / 49.0) ** 0.5
    one, other = smooth_m * np.random.default_rng(0).standard_normal((2, 400_000))
    drawn = 0.5 * np.minimum(((one - other) / 0.0035) ** 2 / 9, 1.0).mean()
    assert pair_cost(noise, 0.0035, 3) == pytest.approx(drawn, rel=0.01)


def test_without_noise_nothing_costs_and_depth_finer_than_the_thresholds_leaves_them() -> None:
    assert pair_cost(DepthNoise(0.0, 49.0), 0.0035, 3) == 0.0
    usual = TrackConfig()
    for noise in (FINE, DepthNoise(0.001, 20.0)):
        assert at_noise(usual, noise) == replace(usual, hypotheses=replace(usual.hypotheses, depth_noise=noise))


def noisy(frames: Any, noise: DepthNoise, seed: int) -> list[Any]:
    """Errors that are alike over the noise's patches: a Gaussian's correlation over pi (2 s)^2 pixels."""
    rng, blur_px, found = np.random.default_rng(seed), (noise.patch_px / (4 * np.pi)) ** 0.5, []
    for frame in frames:
        error = cv2.GaussianBlur(rng.standard_normal(frame.depth_m.shape), (0, 0), blur_px)
        error *= noise.sigma_at_1m / error.std()
        depth_m = np.where(frame.depth_m > 0, frame.depth_m + error * frame.depth_m**2, 0).astype(np.float32)
        found.append(replace(frame, depth_m=depth_m))
    return found


@pytest.mark.slow
def test_frames_of_a_coarse_camera_that_lie_right_are_not_lost(tiny_world: Any) -> None:
    poses = tiny_world.poses(5, 0)
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(poses)]
    truth = np.stack([(tiny_world.world_from_camera.inverse() @ p).matrix for p in poses])
    frames = noisy([f for f, _ in seen], COARSE, seed=0)

    def followed(config: TrackConfig) -> TossTrack:
        world_from_camera = tiny_world.world_from_camera
        return track_toss(frames, [m for _, m in seen], tiny_world.camera, config, world_from_camera=world_from_camera)

    fine, coarse = followed(TrackConfig()), followed(at_noise(TrackConfig(), COARSE))
    estimate = coarse.track.camera_from_object
    errors = frame_errors(estimate @ align_first(estimate, truth), truth, np.eye(3) * 0.05)
    assert "lost" in fine.track.status
    assert "lost" not in coarse.track.status
    assert errors.rotation_deg.max() < 5.0
    assert errors.translation_m.max() < 0.006
