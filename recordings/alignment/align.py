"""Depth of one camera seen from another, with occlusion handled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array

from recordings.errors import BadInput, FrameMismatch
from recordings.geometry import CameraModel, Transform

STEP_RELATIVE = 0.008
STEP_PER_M = 0.010
"""Neighbouring depths that differ by less than 0.8 % + z * 1 % per metre are one surface: the second part is the noise
of a stereo camera, which grows with the square of the distance."""
STEP_MOST = 0.10
"""Up to this share a step is still one surface if it continues its neighbours' (a plane seen at a grazing angle)."""


def align_depth(
    depth_m: Float32[Array, "h w"], depth_camera: CameraModel, color_camera: CameraModel, color_from_depth: Transform
) -> Float32[Array, "hc wc"]:
    """Depth along the colour camera's axis at the colour camera's pixels; 0 where no ray of the depth camera tells.

    The depth image is drawn as a surface (triangles between neighbours that lie on one surface, none across jumps)
    into a z-buffer of the colour camera, so that a background that the colour camera cannot see never shows through.
    The two exposure times are not touched: a moving object is where it was when depth was exposed.
    """
    from recordings.alignment import kernels as align_kernels

    if depth_m.shape != (depth_camera.height, depth_camera.width):
        found = f"{depth_m.shape[1]}x{depth_m.shape[0]}"
        raise BadInput(f"a depth image of {found}, its camera says {depth_camera.width}x{depth_camera.height}")
    plan = _plan(depth_camera, color_camera, color_from_depth)
    depth = np.where(np.isfinite(depth_m), depth_m, np.float32(0))
    pixels = np.empty((*depth.shape, 2))
    z_m = np.zeros(depth.shape)
    align_kernels.project(depth, plan.rays, color_from_depth.translation_m, plan.lens, pixels, z_m)
    if color_camera.distortion_model == "fisheye":
        points_m = plan.rays * depth[..., None] + color_from_depth.translation_m
        pixels = np.where((z_m > 0)[..., None], color_camera.project(points_m), 0.0)
    out = np.zeros((color_camera.height, color_camera.width), dtype=np.float32)
    align_kernels.draw(depth, pixels, z_m, out, plan.limits)
    return out


@dataclass(frozen=True, eq=False)
class _Plan:
    """What does not change from frame to frame: the depth camera's rays in colour axes, the colour lens as numbers."""

    rays: Float[Array, "h w 3"]
    lens: Float[Array, "14"]
    limits: Float[Array, "4"]


@lru_cache(maxsize=8)
def _plan(depth_camera: CameraModel, color_camera: CameraModel, color_from_depth: Transform) -> _Plan:
    if (color_from_depth.target, color_from_depth.source) != (color_camera.frame, depth_camera.frame):
        raise FrameMismatch(f"{color_from_depth} does not lead from {depth_camera.frame} to {color_camera.frame}")
    radial = color_camera.distortion_model in ("brown-conrady", "rational")
    coefficients = np.zeros(8)
    coefficients[: len(color_camera.distortion) if radial else 0] = color_camera.distortion if radial else ()
    K = color_camera.K
    lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], *coefficients, _widest_r2(color_camera)])
    splat_px = 0.5 * max(0.0, color_camera.fx / depth_camera.fx - 1.0)
    return _Plan(
        np.ascontiguousarray(depth_camera.pixel_rays() @ color_from_depth.rotation.T),
        lens,
        np.array([STEP_RELATIVE, STEP_PER_M, STEP_MOST, splat_px]),
    )


def _widest_r2(camera: CameraModel) -> float:
    """Squared length of the longest (x, y) that the image shows, and a little more: what lies beyond is not on it."""
    u, v = np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64)
    border = [np.stack([u, np.full_like(u, y)], -1) for y in (0.0, camera.height - 1.0)]
    border += [np.stack([np.full_like(v, x), v], -1) for x in (0.0, camera.width - 1.0)]
    xy = camera.rays(np.concatenate(border))[:, :2]
    return 1.1 * float(np.nanmax((xy**2).sum(axis=-1)))
