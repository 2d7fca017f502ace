"""The camera as an ideal pinhole."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array

from recordings.geometry import CameraModel


@dataclass(frozen=True, eq=False)
class Rectification:
    """A camera as an ideal pinhole, with the maps that undo its distortion (None where it has none)."""

    camera: CameraModel
    map_u: Float32[Array, "h w"] | None
    map_v: Float32[Array, "h w"] | None

    @staticmethod
    def of(camera: CameraModel) -> Rectification:
        if camera.distortion_model == "none":
            return Rectification(camera, None, None)
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
        pixels = np.nan_to_num(camera.project(rays), nan=-1e4)
        return Rectification(camera, pixels[..., 0].astype(np.float32), pixels[..., 1].astype(np.float32))

    @property
    def focal(self) -> Float[Array, "2"]:
        return np.array([self.camera.fx, self.camera.fy])

    @property
    def center(self) -> Float[Array, "2"]:
        return np.array([self.camera.cx, self.camera.cy])

    def straight(self, image: Array, smooth: bool) -> Array:
        """The image as the pinhole would see it."""
        if self.map_u is None or self.map_v is None:
            return image
        return cv2.remap(image, self.map_u, self.map_v, cv2.INTER_LINEAR if smooth else cv2.INTER_NEAREST)
