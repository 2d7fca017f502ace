"""The robot as the camera sees it: its URDF's meshes at the joint states, drawn by ray casting.

Each link keeps its own triangles and acceleration structure for the whole session; a frame costs the rays that can
meet a link. Rays are the camera's own, so lens distortion is exact.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int8
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform
from recordings.robot.arm import Robot
from recordings.robot.collada import read_collada

NO_LINK = -1
NEAREST_M = 0.02
"""A link with a corner nearer than this to the camera's plane may show anywhere."""


STILL_M = 1e-4
"""A link whose corners all moved less than this since the last picture looks the same: 0.04 px at 1 m."""


@dataclass(frozen=True, eq=False)
class RobotImage:
    """What of the robot each pixel would show if nothing were in front of it.

    `depth_m` is along the optical axis, 0 where there is no robot; `part` indexes `RobotView.parts` (NO_LINK: none);
    `normal` is in the camera frame, towards the camera.
    """

    depth_m: Float32[Array, "h w"]
    part: Int8[Array, "h w"]
    normal: Float32[Array, "h w 3"]


@dataclass(frozen=True, eq=False)
class _Part:
    link: str
    scene: Any
    corners_m: Float[Array, "8 3"]


@dataclass(frozen=True, eq=False)
class _Cast:
    corners_m: Float[Array, "8 3"]
    box: tuple[slice, slice]
    hit: Float32[Array, "a b"]
    normal: Float32[Array, "a b 3"]


class RobotView:
    """Draws a robot into one camera."""

    def __init__(self, robot: Robot, camera: CameraModel) -> None:
        import open3d as o3d

        self._core: Any = o3d.core
        self._look_along(camera.pixel_rays().astype(np.float32))
        self._parts = []
        for mesh in robot.meshes:
            colored = read_collada(mesh.path)
            vertices = mesh.link_from_mesh.points(colored.vertices_m)
            scene = o3d.t.geometry.RaycastingScene()
            scene.add_triangles(
                o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(colored.faces.astype(np.uint32))
            )
            low, high = vertices.min(0), vertices.max(0)
            corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (high - low) + low
            self._parts.append(_Part(mesh.link, scene, corners))

    def _look_along(self, rays: Float32[Array, "h w 3"]) -> None:
        self.rays = rays
        self._last: dict[int, _Cast] = {}
        x, y = rays[..., 0], rays[..., 1]
        self._columns = np.nanmin(x, axis=0), np.nanmax(x, axis=0)
        self._rows = np.nanmin(y, axis=1), np.nanmax(y, axis=1)

    def coarser(self, stride: int) -> RobotView:
        """The same links, drawn only at every stride-th pixel of rows and columns."""
        other = copy(self)
        other._look_along(self.rays[::stride, ::stride])
        return other

    @property
    def parts(self) -> tuple[str, ...]:
        """The links' names, as `RobotImage.part` numbers them."""
        return tuple(p.link for p in self._parts)

    def draw(self, camera_from_link: Mapping[str, Transform], leave_out: tuple[str, ...] = ()) -> RobotImage:
        """The robot with its links at these places; links in `leave_out` are not drawn."""
        shape = self.rays.shape[:2]
        depth = np.full(shape, np.inf, dtype=np.float32)
        part, normal = np.full(shape, NO_LINK, dtype=np.int8), np.zeros((*shape, 3), dtype=np.float32)
        for number, one in enumerate(self._parts):
            if one.link not in leave_out:
                self._draw_part(number, one, camera_from_link[one.link], depth, part, normal)
        return RobotImage(np.where(np.isfinite(depth), depth, 0), part, normal)

    def _draw_part(
        self,
        number: int,
        one: _Part,
        camera_from_link: Transform,
        depth: Float32[Array, "h w"],
        part: Int8[Array, "h w"],
        normal: Float32[Array, "h w 3"],
    ) -> None:
        """Draw one link into the three images where it is the nearest so far."""
        box = self._box(camera_from_link.points(one.corners_m))
        if box is None:
            return
        hit, facing_link = self._cast(number, one, camera_from_link, box)
        nearer = hit < depth[box]
        if not nearer.any():
            return
        facing = facing_link[nearer] @ camera_from_link.rotation.T.astype(np.float32)
        away = (facing * self.rays[box][nearer]).sum(-1) > 0
        facing[away] *= -1
        depth[box][nearer], part[box][nearer], normal[box][nearer] = hit[nearer], number, facing

    def _cast(
        self, number: int, one: _Part, camera_from_link: Transform, box: tuple[slice, slice]
    ) -> tuple[Float32[Array, "a b"], Float32[Array, "a b 3"]]:
        """Depth of a link in a part of the image (infinite: none) and normals in the link's frame. A link that stays
        where it was in the last picture is not cast again: much of the robot stands still most of the time."""
        corners_m = camera_from_link.points(one.corners_m)
        last = self._last.get(number)
        if last is not None and last.box == box and np.abs(last.corners_m - corners_m).max() < STILL_M:
            return last.hit, last.normal
        rays = self.rays[box]
        along = rays @ camera_from_link.rotation.astype(np.float32)  # link_from_camera is the transpose
        origin = -camera_from_link.rotation.T @ camera_from_link.translation_m
        cast = np.empty((*rays.shape[:2], 6), dtype=np.float32)
        cast[..., :3], cast[..., 3:] = origin, along
        found = one.scene.cast_rays(self._core.Tensor(cast), nthreads=1)
        hit, normal = found["t_hit"].numpy(), found["primitive_normals"].numpy()  # rays have z = 1: t_hit is depth
        self._last[number] = _Cast(corners_m, box, hit, normal)
        return hit, normal

    def _box(self, corners_m: Float[Array, "8 3"]) -> tuple[slice, slice] | None:
        """The part of the image whose rays can meet these corners' box."""
        z = corners_m[:, 2]
        if z.max() <= 0:
            return None
        if z.min() < NEAREST_M:
            return slice(None), slice(None)
        xy = corners_m[:, :2] / z[:, None]
        rows = np.flatnonzero((self._rows[1] >= xy[:, 1].min()) & (self._rows[0] <= xy[:, 1].max()))
        columns = np.flatnonzero((self._columns[1] >= xy[:, 0].min()) & (self._columns[0] <= xy[:, 0].max()))
        if len(rows) == 0 or len(columns) == 0:
            return None
        return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
