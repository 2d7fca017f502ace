"""How depth errs, measured on the table: known noise comes back, and neither a tilted table nor an object counts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import gaussian_filter

from processing.field.network import ObjectField
from processing.field.poses import PoseConfig, refine_poses
from processing.field.rays import RayDataset
from processing.sensor.noise import DepthNoise, measured_noise
from processing.sensor.surface_kernel import fit_surface
from recordings.geometry import CameraModel

CAMERA = CameraModel("d455", 320, 240, np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]))
UP, HEIGHT_M = np.array([0.0, -0.6, -0.8]), 0.8


def table(up: np.ndarray = UP) -> np.ndarray:
    rays = CAMERA.pixel_rays()
    return np.asarray(-HEIGHT_M / (rays @ (up / np.linalg.norm(up))), dtype=np.float32)


def errors(sigma_at_1m: float, blur_px: float) -> np.ndarray:
    white = np.random.default_rng(3).normal(size=(240, 320))
    smooth = gaussian_filter(white, blur_px) if blur_px else white
    return sigma_at_1m * smooth / smooth.std()


@pytest.mark.parametrize("sigma", [0.0025, 0.007])
@pytest.mark.parametrize("blur_px", [0.0, 1.5, 3.0])
def test_size_and_reach_of_the_noise_come_back(sigma: float, blur_px: float) -> None:
    true = table()
    found = measured_noise((true + true**2 * errors(sigma, blur_px)).astype(np.float32), true, CAMERA.pixel_rays())
    assert found is not None
    assert found.sigma_at_1m == pytest.approx(sigma, rel=0.1)
    assert found.patch_px == pytest.approx(max(4 * np.pi * blur_px**2, 1.0), rel=0.35)


def test_a_table_that_is_calibrated_wrongly_and_an_object_on_it_are_no_noise() -> None:
    true = table(UP + [0.01, 0.0, 0.0])
    depth = 1.005 * (true + true**2 * errors(0.003, 1.0))
    depth[100:150, 100:150] -= 0.02
    found = measured_noise(depth.astype(np.float32), table(), CAMERA.pixel_rays())
    assert found is not None
    assert found.sigma_at_1m == pytest.approx(0.003, rel=0.15)


def test_a_session_without_a_table_tells_no_noise() -> None:
    assert measured_noise(table(), np.zeros((240, 320), np.float32), CAMERA.pixel_rays()) is None


def test_poses_are_as_sure_as_the_number_of_independent_pixels_says() -> None:
    """Information of a view falls with the patch, and with the square of the noise where depth alone tells."""

    class Sphere(ObjectField):
        def __init__(self) -> None:
            torch.nn.Module.__init__(self)

        def sdf(self, x: torch.Tensor) -> torch.Tensor:
            return x.norm(dim=-1) - 0.05

        def color(self, x: torch.Tensor) -> torch.Tensor:
            return 0.5 + 0.0 * x

    torch.manual_seed(0)
    ray = torch.cat([0.03 * torch.randn(900, 2), torch.ones(900, 1)], 1)
    b, c = ray[:, 2] * 0.8, 0.64 - 0.05**2
    depth = (b - (b**2 - (ray**2).sum(1) * c).clamp(min=1e-6).sqrt()) / (ray**2).sum(1)
    pool = RayDataset(ray, depth, ray, torch.full((900, 3), 0.5), torch.zeros(900, dtype=torch.int64), torch.ones(900),
                   ray[:1], torch.zeros(1, dtype=torch.int64))  # fmt: skip
    rotation, translation = torch.eye(3)[None], torch.tensor([[0.0, 0.0, 0.8]])

    def told(noise: DepthNoise) -> float:
        found = refine_poses(Sphere(), rotation, translation, pool, PoseConfig(noise=noise))[2]
        return float(found[0, 5, 5])

    usual = told(DepthNoise(0.003, 10.0))
    assert told(DepthNoise(0.003, 40.0)) == pytest.approx(usual / 4, rel=0.02)
    assert told(DepthNoise(0.006, 10.0)) == pytest.approx(usual / 4, rel=0.1)


@pytest.mark.parametrize(("distance_m", "cosine", "kept"), [(0.5, 0.15, False), (0.5, 0.22, True), (1.0, 0.11, True)])
def test_a_surface_is_one_as_far_as_a_stereo_camera_can_follow_its_slant(
    distance_m: float, cosine: float, kept: bool
) -> None:
    """Disparity grows by baseline / z * tan(slant) a pixel: at 0.5 m a steeper slant is lost than at 1 m."""
    focal, side = 2000.0, np.sqrt(1 - cosine**2)
    x = (np.arange(41) - 20) / focal
    row = cosine * distance_m / (cosine - side * x)
    depth = np.tile(row, (41, 1)).astype(np.float32)
    out, normals = np.zeros((41, 41), np.float32), np.zeros((41, 41, 3), np.float32)
    rays = np.array([1 / focal, 1 / focal, x[0], x[0]])
    fit_surface(depth, np.ones((41, 41), bool), rays, 3, 0.012, out, normals)
    assert (out[20, 20] > 0) == kept


@pytest.mark.parametrize(("noise", "share"), [
    (DepthNoise(0.0026, 50.0), 1.0),  # as fine as the schedules' ...
    (DepthNoise(0.001, 20.0), 1.0),  # ... finer, which says no more
    (DepthNoise(0.0039, 50.0), 1 / 2.25),
    (DepthNoise(0.0026, 100.0), 0.5),
    (DepthNoise(0.02, 300.0), 0.3),
])  # fmt: skip
def test_depth_says_less_of_turns_by_the_variance_of_a_patch(noise: DepthNoise, share: float) -> None:
    assert noise.turn_share == pytest.approx(share, rel=1e-6)
