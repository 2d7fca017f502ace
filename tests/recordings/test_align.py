"""Alignment of depth to colour against an independent ray cast of a tilted plane with a box in front."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from recordings.alignment.align import align_depth
from recordings.errors import BadInput, FrameMismatch
from recordings.geometry import CameraModel, Transform, rotation_exp


def camera(name: str, width: int, height: int, focal: float, model="none", distortion=()) -> CameraModel:
    K = np.array([[focal, 0, width / 2 - 0.7], [0, focal, height / 2 + 0.3], [0, 0, 1]])
    return CameraModel(name, width, height, K, model, distortion)


DEPTH = camera("depth", 424, 240, 212.5)
COLORS = {
    "pinhole": camera("color", 320, 240, 193.0),
    "brown-conrady": camera("color", 320, 240, 193.0, "brown-conrady", (-0.055, 0.065, 0.001, -0.0005, -0.02)),
    "rational": camera("color", 320, 240, 193.0, "rational", (0.5, 0.1, 0.001, 0.0, 0.01, 0.55, 0.12, 0.01)),
    "fisheye": camera("color", 320, 240, 193.0, "fisheye", (0.01, 0.002, 0.0, 0.0)),
    "finer": camera("color", 640, 360, 330.0, "brown-conrady", (0.1, -0.2, 0.0, 0.0, 0.05)),
}
DEPTH_FROM_COLOR = Transform(
    "depth", "color", rotation_exp(np.array([0.01, -0.02, 0.005])), np.array([0.059, 1e-3, -2e-3])
)


@dataclass(frozen=True)
class Scene:
    """A plane through (0, 0, 1) tilted about y, and a box before it, both in the depth camera's frame."""

    tilt_rad: float
    low_m: tuple[float, float, float] = (-0.10, -0.08, 0.5)
    high_m: tuple[float, float, float] = (0.08, 0.10, 0.6)

    def cast(self, lens: CameraModel, depth_from_lens: Transform) -> tuple[np.ndarray, np.ndarray]:
        """Exact depth (h w) by intersecting every pixel's ray, and where the box is seen."""
        origin = depth_from_lens.translation_m
        rays = lens.pixel_rays() @ depth_from_lens.rotation.T
        normal = np.array([np.sin(self.tilt_rad), 0, -np.cos(self.tilt_rad)])
        with np.errstate(divide="ignore", invalid="ignore"):
            plane_m = ((np.array([0, 0, 1.0]) - origin) @ normal) / (rays @ normal)
            enter = (np.array(self.low_m) - origin) / rays
            leave = (np.array(self.high_m) - origin) / rays
        plane_m = np.where(plane_m > 0, plane_m, np.inf)
        near, far = np.minimum(enter, leave).max(-1), np.maximum(enter, leave).min(-1)
        box = (near <= far) & (near > 0) & (near < plane_m)
        return np.where(box, near, plane_m), box


def rendered(tilt_rad: float) -> np.ndarray:
    depth_m = Scene(tilt_rad).cast(DEPTH, Transform.identity("depth", "depth"))[0]
    return np.where(depth_m < 3, depth_m, 0).astype(np.float32)


@pytest.mark.parametrize("lens", list(COLORS))
@pytest.mark.parametrize("tilt_rad", [0.0, 0.8, 1.2])
def test_slanted_planes_are_right_to_a_millimetre_and_nothing_hidden_shows_through(lens, tilt_rad):
    color = COLORS[lens]
    exact_m, box = Scene(tilt_rad).cast(color, DEPTH_FROM_COLOR)
    aligned_m = align_depth(rendered(tilt_rad), DEPTH, color, DEPTH_FROM_COLOR.inverse())
    inside = cv2.erode(box.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    outside = cv2.dilate(box.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0
    seen = (aligned_m > 0) & (exact_m < 2.5) & (inside | outside)
    error_m = np.abs(aligned_m - exact_m)[seen]
    assert seen.sum() > 25_000
    assert np.percentile(error_m, 99.9) < 1e-3
    assert (aligned_m[inside] > 0).mean() > 0.99
    assert not (inside & (aligned_m > exact_m + 0.02)).any(), "the plane shows through the box"
    assert not (outside & (aligned_m > 0) & (aligned_m < exact_m - 0.02)).any(), "the box is smeared over the plane"


def test_the_strip_that_only_colour_sees_stays_empty():
    color = COLORS["pinhole"]
    exact_m, box = Scene(0.0).cast(color, DEPTH_FROM_COLOR)
    aligned_m = align_depth(rendered(0.0), DEPTH, color, DEPTH_FROM_COLOR.inverse())
    beside = np.zeros_like(box)
    row, columns = color.height // 2, np.flatnonzero(box[color.height // 2])
    beside[row - 5 : row + 5, columns.min() - 6 : columns.min() - 2] = True
    beside[row - 5 : row + 5, columns.max() + 3 : columns.max() + 7] = True
    assert 0 < (aligned_m[beside] == 0).sum() < beside.sum()  # the shadow lies on one side
    assert np.abs(aligned_m - exact_m)[beside & (aligned_m > 0)].max() < 1e-3


def test_the_same_camera_changes_nothing():
    depth_m = rendered(0.8)
    same = Transform("color", "depth", np.eye(3), np.zeros(3))
    color = CameraModel("color", DEPTH.width, DEPTH.height, DEPTH.K)
    np.testing.assert_allclose(align_depth(depth_m, DEPTH, color, same), depth_m, atol=1e-6)


def test_a_lone_pixel_is_kept_and_holes_stay_holes():
    depth_m = np.zeros((DEPTH.height, DEPTH.width), dtype=np.float32)
    depth_m[100, 200] = 1.0
    depth_m[150, 50:80] = np.nan
    aligned_m = align_depth(depth_m, DEPTH, COLORS["pinhole"], DEPTH_FROM_COLOR.inverse())
    assert (aligned_m > 0).sum() == 1
    assert np.isfinite(aligned_m).all()
    fine_m = align_depth(depth_m, DEPTH, COLORS["finer"], DEPTH_FROM_COLOR.inverse())
    assert 1 <= (fine_m > 0).sum() <= 4


def test_what_lies_outside_of_the_image_is_not_folded_into_it():
    strong = camera("color", 200, 150, 193.0, "brown-conrady", (-0.35, 0.0, 0.0, 0.0, 0.0))
    aligned_m = align_depth(np.full((240, 424), 1.0, np.float32), DEPTH, strong, DEPTH_FROM_COLOR.inverse())
    exact_m = Scene(0.0, (9, 9, 9), (9.1, 9.1, 9.1)).cast(strong, DEPTH_FROM_COLOR)[0]
    assert np.abs(aligned_m - exact_m)[aligned_m > 0].max() < 1e-3


def test_noise_of_a_stereo_camera_leaves_the_surface_closed():
    depth_m = np.full((240, 424), 1.5, np.float32)
    depth_m += np.random.default_rng(0).normal(0, 0.006, depth_m.shape).astype(np.float32)
    aligned_m = align_depth(depth_m, DEPTH, COLORS["pinhole"], DEPTH_FROM_COLOR.inverse())
    assert (aligned_m[40:200, 40:280] > 0).mean() > 0.995


def test_wrong_frames_and_sizes_are_refused():
    depth_m = np.ones((240, 424), dtype=np.float32)
    with pytest.raises(FrameMismatch, match="does not lead from depth to color"):
        align_depth(depth_m, DEPTH, COLORS["pinhole"], DEPTH_FROM_COLOR)
    with pytest.raises(BadInput, match="a depth image of 300x240, its camera says 424x240"):
        align_depth(depth_m[:, :300], DEPTH, COLORS["pinhole"], DEPTH_FROM_COLOR.inverse())
