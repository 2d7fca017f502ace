"""Depth as a stereo camera finds it: from two infrared pictures to disparity, to depth, to the colour camera.

D455: imagers 95 mm apart, 848x480, f 424 px (90 degrees); colour 59 mm from the left imager (factory extrinsics as
users post them, librealsense issue 15609). The matcher is OpenCV's semi-global one, in steps of 1/16 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, Int16, UInt8, UInt16
from numba import njit
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform

WIDTH, HEIGHT, FOCAL_PX, BASELINE_M = 848, 480, 424.0, 0.095
COLOR_FROM_LEFT_M = 0.059
DISPARITIES = 160
NOTHING = -1.0
NEAREST_M, FARTHEST_M = 0.25, 6.0


@dataclass(frozen=True)
class Preset:
    """What a visual preset of the device does, in the matcher's words."""

    block: int
    uniqueness_percent: int
    left_right_px: float
    speckle_px: int
    texture: float
    """Smallest local deviation (grey levels) of the left picture that is believed."""
    fill_holes: bool


PRESETS = {
    "default": Preset(9, 8, 1.0, 60, 0.7, False),
    "high-accuracy": Preset(9, 18, 0.6, 150, 1.4, False),
    "high-density": Preset(11, 2, 2.0, 20, 0.3, True),
}


def infrared_camera(frame: str = "left") -> CameraModel:
    K = np.array([[FOCAL_PX, 0, (WIDTH - 1) / 2], [0, FOCAL_PX, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    return CameraModel(frame, WIDTH, HEIGHT, K)


def match(left: UInt8[Array, "h w"], right: UInt8[Array, "h w"], preset: Preset) -> Float32[Array, "h w"]:
    """Disparity of the left picture in pixels, NOTHING where none is believed."""
    found = _semi_global(left, right, preset)
    other = _semi_global(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]), preset)[:, ::-1]
    found = left_right_checked(found, other, preset.left_right_px)
    grey = left.astype(np.float32)
    size = (preset.block, preset.block)
    deviation = cv2.blur(grey * grey, size) - cv2.blur(grey, size) ** 2
    found = np.where(deviation < preset.texture**2, np.float32(NOTHING), found)
    found = without_speckles(found, preset.speckle_px)
    return _filled(found) if preset.fill_holes else found


def _semi_global(left: UInt8[Array, "h w"], right: UInt8[Array, "h w"], preset: Preset) -> Float32[Array, "h w"]:
    area = preset.block**2
    matcher = cv2.StereoSGBM_create(
        minDisparity=0, numDisparities=DISPARITIES, blockSize=preset.block, P1=2 * area, P2=16 * area,
        disp12MaxDiff=-1, preFilterCap=31, uniquenessRatio=preset.uniqueness_percent,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    # the matcher leaves a band of its search range at the left: a wider picture gives it back
    wide = [cv2.copyMakeBorder(image, 0, 0, DISPARITIES, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    raw: Int16[Array, "h w"] = matcher.compute(*wide)[:, DISPARITIES:]
    return np.where(raw <= 0, np.float32(NOTHING), raw.astype(np.float32) / 16)


def left_right_checked(
    left: Float32[Array, "h w"], right: Float32[Array, "h w"], most_px: float
) -> Float32[Array, "h w"]:
    """The left disparities whose partner in the right picture, at x - d, points back to within `most_px`."""
    height, width = left.shape
    x = np.arange(width)[None] - np.round(left).astype(np.int64)
    inside = (left >= 0) & (x >= 0)
    back = right[np.arange(height)[:, None], np.clip(x, 0, width - 1)]
    good = inside & (back >= 0) & (np.abs(back - left) <= most_px)
    return np.where(good, left, np.float32(NOTHING))


def without_speckles(disparity: Float32[Array, "h w"], fewest_px: int) -> Float32[Array, "h w"]:
    """Islands of less than `fewest_px` pixels whose neighbours differ by more than a pixel are dropped."""
    steps = np.where(disparity < 0, -16, np.round(disparity * 16)).astype(np.int16)
    cv2.filterSpeckles(steps, -16, fewest_px, 16)
    return np.where(steps < 0, np.float32(NOTHING), disparity)


def _filled(disparity: Float32[Array, "h w"]) -> Float32[Array, "h w"]:
    """The SDK's simplest hole filling: a hole takes the value at its left."""
    index = np.where(disparity >= 0, np.arange(disparity.shape[1])[None], 0)
    return np.take_along_axis(disparity, np.maximum.accumulate(index, axis=1), axis=1)


@njit(cache=True)
def spatial_filtered(disparity, alpha, step):
    """Edge-preserving recursive filter along rows and columns, both ways, as the SDK's spatial filter: neighbours that
    differ by less than `step` px are mixed with weight 1 - `alpha`."""
    out = disparity.copy()
    height, width = out.shape
    for _ in range(2):
        for y in range(height):
            for x in range(1, width):
                _mix(out, y, x, y, x - 1, alpha, step)
            for x in range(width - 2, -1, -1):
                _mix(out, y, x, y, x + 1, alpha, step)
        for x in range(width):
            for y in range(1, height):
                _mix(out, y, x, y - 1, x, alpha, step)
            for y in range(height - 2, -1, -1):
                _mix(out, y, x, y + 1, x, alpha, step)
    return out


@njit(cache=True)
def _mix(out, y, x, v, u, alpha, step):
    a, b = out[y, x], out[v, u]
    if a >= 0 and b >= 0 and abs(a - b) < step:
        out[y, x] = alpha * a + (1 - alpha) * b


def depth_of(disparity: Float32[Array, "h w"]) -> Float32[Array, "h w"]:
    """z = f b / d in metres; 0 where there is no disparity, or outside the device's range."""
    z = FOCAL_PX * BASELINE_M / np.maximum(disparity, 1e-3)
    return np.where((disparity > 0) & (z > NEAREST_M) & (z < FARTHEST_M), z, 0).astype(np.float32)


def aligned(
    depth_m: Float32[Array, "h w"], depth_camera: CameraModel, color: CameraModel, color_from_depth: Transform
) -> Float32[Array, "v u"]:
    """Depth in the colour camera, as the SDK aligns: every depth pixel's square is carried over as a whole and fills
    the colour pixels it meets; the nearest wins. 0 where nothing falls."""
    rows, columns = np.nonzero(depth_m > 0)
    z = depth_m[rows, columns].astype(np.float64)
    corners = []
    for off in (-0.5, 0.5):
        rays = depth_camera.rays(np.stack([columns + off, rows + off], 1).astype(np.float64))
        points = color_from_depth.points(rays / rays[:, 2:] * z[:, None])
        corners.append(color.project(points))
    middle = color_from_depth.points(depth_camera.rays(np.stack([columns, rows], 1).astype(np.float64)) * z[:, None])
    low, high = np.floor(corners[0] + 0.5).astype(np.int64), np.floor(corners[1] + 0.5).astype(np.int64)
    return _splatted(low, high, middle[:, 2].astype(np.float32), color.height, color.width)


@njit(cache=True)
def _splatted(low, high, z, height, width):
    out = np.zeros((height, width), np.float32)
    for k in range(len(z)):
        for y in range(max(low[k, 1], 0), min(high[k, 1], height - 1) + 1):
            for x in range(max(low[k, 0], 0), min(high[k, 0], width - 1) + 1):
                if out[y, x] == 0 or z[k] < out[y, x]:
                    out[y, x] = z[k]
    return out


def in_units(depth_m: Float32[Array, "h w"], unit_m: float) -> UInt16[Array, "h w"]:
    """As the file has it; 0 where there is none."""
    return np.clip(np.round(depth_m / unit_m), 0, 65535).astype(np.uint16)
