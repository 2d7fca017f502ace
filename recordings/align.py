"""Depth of one camera seen from another, with occlusion handled."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from numpy import ndarray as Array

from recordings.errors import FrameMismatch
from recordings.geometry import CameraModel, Transform

JUMP = 0.03
"""Neighbouring depths that differ by more than this share belong to different surfaces: nothing is drawn between them."""


def align_depth(
    depth_m: Float32[Array, "h w"], depth_camera: CameraModel, color_camera: CameraModel, color_from_depth: Transform
) -> Float32[Array, "hc wc"]:
    """Depth along the colour camera's axis at the colour camera's pixels; 0 where no ray of the depth camera tells.

    The depth image is drawn as a surface (samples between neighbours that lie on one surface, none across jumps) into
    a z-buffer of the colour camera, so that a background that the colour camera cannot see never shows through.
    The two exposure times are not touched: a moving object is where it was when depth was exposed.
    """
    if (color_from_depth.target, color_from_depth.source) != (color_camera.frame, depth_camera.frame):
        raise FrameMismatch(f"{color_from_depth} does not lead from {depth_camera.frame} to {color_camera.frame}")
    rays = depth_camera.pixel_rays()
    density = max(1, int(np.ceil(1.2 * color_camera.fx / depth_camera.fx)))
    out = np.zeros(color_camera.height * color_camera.width, dtype=np.float32)
    cells, depths = [], []
    for points_m in _surface_samples(rays * depth_m[..., None].astype(np.float64), depth_m, density):
        seen = color_from_depth.points(points_m)
        pixels = color_camera.project(seen)
        inside = color_camera.sees(pixels)
        u, v = np.rint(pixels[inside]).astype(np.int64).T
        cells.append(v.clip(0, color_camera.height - 1) * color_camera.width + u.clip(0, color_camera.width - 1))
        depths.append(seen[inside, 2].astype(np.float32))
    cell, depth = np.concatenate(cells), np.concatenate(depths)
    far_first = np.argsort(-depth, kind="stable")
    out[cell[far_first]] = depth[far_first]
    return out.reshape(color_camera.height, color_camera.width)


def _surface_samples(points_m: Array, depth_m: Array, density: int) -> list[Array]:
    """Points on the bilinear patches between neighbouring pixels, `density` per side; lone pixels as themselves."""
    z = depth_m.astype(np.float64)
    corners = [points_m[:-1, :-1], points_m[:-1, 1:], points_m[1:, :-1], points_m[1:, 1:]]
    stack = np.stack([z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]])
    low, high = stack.min(0), stack.max(0)
    whole = (low > 0) & (high - low < JUMP * high)
    samples = [points_m[z > 0]]
    if density == 1:
        return samples
    patch = [c[whole] for c in corners]
    steps = np.arange(density) / density
    for a in steps:
        for b in steps:
            if a == 0 and b == 0:
                continue
            top = patch[0] * (1 - b) + patch[1] * b
            bottom = patch[2] * (1 - b) + patch[3] * b
            samples.append(top * (1 - a) + bottom * a)
    return samples
