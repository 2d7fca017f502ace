"""Meshes drawn in software, where there is no graphics driver: a z-buffer, one light, colours at the vertices."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, UInt8
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform
from recordings.tracks import ObjectShape

AMBIENT = 0.45
LIGHT_CAMERA = np.array([-0.35, -0.5, -0.79])
"""Towards the light, in the camera's axes: from the upper left, behind the camera."""
NO_COLOR = 200.0
NEAREST_M = 1e-3


@dataclass(frozen=True, eq=False)
class Canvas:
    """A picture in the making, as one camera sees it: colour, and the depth of what is drawn (infinite: nothing)."""

    camera: CameraModel
    rgb: Float64[Array, "h w 3"]
    depth_m: Float64[Array, "h w"]

    @staticmethod
    def on(camera: CameraModel, background_rgb: UInt8[Array, "h w 3"]) -> Canvas:
        """A canvas over a background, which is copied."""
        return Canvas(camera, background_rgb.astype(np.float64), np.full((camera.height, camera.width), np.inf))

    def draw(self, shape: ObjectShape, camera_from_object: Transform) -> None:
        """Draw a shape at a pose, lit. Faces that reach behind the camera are left out."""
        points = camera_from_object.points(shape.vertices_m)
        self._fill(shape, points, _lit(shape, points))

    def cover(self, shape: ObjectShape, camera_from_object: Transform) -> None:
        """Draw a shape in black: only where it is matters."""
        points = camera_from_object.points(shape.vertices_m)
        self._fill(shape, points, np.zeros_like(points))

    def _fill(self, shape: ObjectShape, points_m: Float[Array, "v 3"], rgb: Float[Array, "v 3"]) -> None:
        from recordings.film import raster_kernels

        placed = np.concatenate([self.camera.project(points_m), points_m[:, 2:]], axis=1)
        good = np.isfinite(placed).all(axis=1) & (points_m[:, 2] > NEAREST_M)
        faces = shape.faces[good[shape.faces].all(axis=1)]
        raster_kernels.fill(placed[faces], rgb[faces], self.depth_m, self.rgb)

    @property
    def covered(self) -> Bool[Array, "h w"]:
        return np.isfinite(self.depth_m)

    def image(self) -> UInt8[Array, "h w 3"]:
        return np.clip(self.rgb, 0, 255).astype(np.uint8)


def _lit(shape: ObjectShape, points_camera: Float[Array, "v 3"]) -> Float64[Array, "v 3"]:
    """Colours of the vertices in this light; a surface wound either way is lit alike."""
    corners = points_camera[shape.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    around, count = shape.faces.ravel(), len(points_camera)
    summed = np.stack([np.bincount(around, np.repeat(normals[:, k], 3), count) for k in range(3)], axis=1)
    length = np.maximum(np.linalg.norm(summed, axis=1), 1e-30)
    light = np.abs(summed @ LIGHT_CAMERA) / length
    rgb = np.full(points_camera.shape, NO_COLOR) if shape.vertex_rgb is None else shape.vertex_rgb.astype(np.float64)
    return rgb * (AMBIENT + (1 - AMBIENT) * light[:, None])


def covered_pixels(shape: ObjectShape, camera_from_object: Transform, camera: CameraModel) -> Bool[Array, "h w"]:
    """Pixels of a camera that a shape covers at a pose, through the lens."""
    canvas = Canvas.on(camera, np.zeros((camera.height, camera.width, 3), dtype=np.uint8))
    canvas.cover(shape, camera_from_object)
    return canvas.covered


def outlined(
    image_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"], color: tuple[int, int, int], width_px: int = 1
) -> UInt8[Array, "h w 3"]:
    """A copy of an image with a mask's border drawn on it, holes included."""
    drawn = np.ascontiguousarray(image_rgb.copy())
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(drawn, contours, -1, color, width_px))
