"""Ray casting of rigid bodies: hits with their surface attributes, and shadows (Open3D, no display needed)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray as Array

from acquisition.synthetic.objects.paint import PaintedMesh
from recordings.geometry import Transform

NEAREST_M = 1e-3
THREADS = 1
"""One, so that CPU seconds are wall seconds and runs on a shared machine do not fight."""


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid mesh that can be hit by rays. `name` says what a mask calls it."""

    name: str
    mesh: PaintedMesh

    @cached_property
    def scene(self) -> object:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene(nthreads=THREADS)
        scene.add_triangles(
            o3d.core.Tensor(self.mesh.vertices_m.astype(np.float32)), o3d.core.Tensor(self.mesh.faces.astype(np.uint32))
        )
        return scene

    @cached_property
    def center_m(self) -> Float[Array, "3"]:
        return 0.5 * (self.mesh.vertices_m.min(axis=0) + self.mesh.vertices_m.max(axis=0))

    @cached_property
    def radius_m(self) -> float:
        return float(np.linalg.norm(self.mesh.vertices_m - self.center_m, axis=1).max())

    @cached_property
    def corners_m(self) -> Float[Array, "8 3"]:
        """Corners of the bounding box."""
        low, high = self.mesh.vertices_m.min(axis=0), self.mesh.vertices_m.max(axis=0)
        return np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)])

    @cached_property
    def mips(self) -> list[Float32[Array, "h w 3"]]:
        levels = [self.mesh.atlas]
        while min(levels[-1].shape[:2]) >= 8 and len(levels) < 5:
            levels.append(cv2.resize(levels[-1], None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        return levels


@dataclass(frozen=True, eq=False)
class Placed:
    """A body at an instant."""

    body: Body
    world_from_body: Transform


class Standing:
    """Bodies that never move, all in one ray casting scene, in world coordinates."""

    def __init__(self, bodies: Sequence[Body]) -> None:
        import open3d as o3d

        self.placed = [Placed(body, Transform.identity("world", "body")) for body in bodies]
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=THREADS)
        for body in bodies:
            vertices, faces = body.mesh.vertices_m.astype(np.float32), body.mesh.faces.astype(np.uint32)
            self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))

    def cast(
        self, origin_m: Float32[Array, "3"], directions: Float32[Array, "n 3"]
    ) -> tuple[Int64[Array, " n"], dict[str, Array]]:
        """Whose surface each ray hits first (-1: none), and Open3D's answer."""
        import open3d as o3d

        rays = np.concatenate([np.broadcast_to(origin_m, directions.shape), directions], axis=1)
        answer = self._scene.cast_rays(o3d.core.Tensor(rays), nthreads=THREADS)
        found = {name: answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs", "geometry_ids")}
        return np.where(np.isfinite(found["t_hit"]), found["geometry_ids"].astype(np.int64), -1), found

    def occluded(
        self, points_m: Float32[Array, "n 3"], light_m: Float[Array, "3"], normals: Float32[Array, "n 3"]
    ) -> Bool[Array, " n"]:
        """Whether something that stands is between each point and the light."""
        import open3d as o3d

        starts = points_m + normals * np.float32(NEAREST_M)
        rays = np.concatenate([starts, light_m.astype(np.float32) - starts], axis=1)
        return self._scene.test_occlusions(o3d.core.Tensor(rays), NEAREST_M, 1.0, nthreads=THREADS).numpy()


@dataclass(frozen=True, eq=False)
class Surface:
    """What n rays hit: world points and unit normals (turned to the viewer), linear colour, mirror properties."""

    points_m: Float32[Array, "n 3"]
    normals: Float32[Array, "n 3"]
    albedo: Float32[Array, "n 3"]
    reflectance: Float32[Array, " n"]
    exponent: Float32[Array, " n"]
    mirror: Float32[Array, " n"]


def joined(surfaces: Sequence[Surface]) -> Surface:
    """Hits of several bodies, one after the other."""
    return Surface(*(np.concatenate([getattr(s, f.name) for s in surfaces]) for f in fields(Surface)))


def cast(placed: Placed, origins_m: Float32[Array, "n 3"], directions: Float32[Array, "n 3"]) -> dict[str, Array]:
    """Open3D's answer for world rays: `t_hit` in lengths of `directions` (inf: missed), `primitive_ids` and `_uvs`."""
    import open3d as o3d

    body_from_world = placed.world_from_body.inverse()
    rays = np.empty((len(origins_m), 6), np.float32)
    rays[:, :3] = body_from_world.points(origins_m)
    rays[:, 3:] = body_from_world.vectors(directions)
    answer = placed.body.scene.cast_rays(o3d.core.Tensor(rays), nthreads=THREADS)  # type: ignore[attr-defined]
    return {name: answer[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs")}


def surface(
    placed: Placed,
    hits: dict[str, Array],
    rows: Int64[Array, " n"],
    origins_m: Float32[Array, "n 3"],
    directions: Float32[Array, "n 3"],
    texels_per_pixel: float,
) -> Surface:
    """Attributes of the hits at `rows` of a cast; `origins_m` and `directions` are of these rows."""
    mesh = placed.body.mesh
    face = hits["primitive_ids"][rows].astype(np.int64)
    b, c = hits["primitive_uvs"][rows].T
    weights = np.stack([1 - b - c, b, c], -1)[..., None]
    uv = (mesh.corner_uv_px[face] * weights).sum(axis=1)
    normals = (mesh.corner_normals[face] * weights).sum(axis=1) @ placed.world_from_body.rotation.T.astype(np.float32)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    away = np.einsum("ij,ij->i", normals, directions) > 0
    normals[away] *= -1
    count, gloss = len(rows), mesh.gloss
    return Surface(
        (origins_m + directions * hits["t_hit"][rows, None]).astype(np.float32),
        normals.astype(np.float32),
        _look_up(placed.body, uv, texels_per_pixel),
        np.full(count, gloss.reflectance, np.float32),
        np.full(count, gloss.exponent, np.float32),
        np.full(count, gloss.mirror, np.float32),
    )


def _look_up(body: Body, uv_px: Float32[Array, "n 2"], texels_per_pixel: float) -> Float32[Array, "n 3"]:
    """Bilinear texture look-up in the mip level whose texels are just finer than a pixel."""
    level = int(np.clip(np.floor(np.log2(max(texels_per_pixel, 1e-3))), 0, len(body.mips) - 1))
    image, shrink = body.mips[level], 0.5**level
    at = ((uv_px + 0.5) * shrink - 0.5).astype(np.float32)
    rows = 16384  # remap's maps must stay below 32768 in either direction
    parts = [
        cv2.remap(
            image,
            at[i : i + rows, None, 0],
            at[i : i + rows, None, 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        for i in range(0, len(at), rows)
    ]
    return np.concatenate(parts)[:, 0] if parts else np.zeros((0, 3), np.float32)


def occluded(
    placed: list[Placed],
    points_m: Float32[Array, "n 3"],
    light_m: Float[Array, "3"],
    normals: Float32[Array, "n 3"] | None,
) -> Bool[Array, " n"]:
    """Whether something stands between each point and the light. Bodies out of the way are not asked."""
    import open3d as o3d

    towards = light_m.astype(np.float32) - points_m
    starts = points_m if normals is None else points_m + normals * np.float32(NEAREST_M)
    dark = np.zeros(len(points_m), dtype=bool)
    segments = _Segments(starts, towards)
    for one in placed:
        center = one.world_from_body.points(one.body.center_m).astype(np.float32)
        rows = np.flatnonzero(~dark & segments.pass_near(center, one.body.radius_m))
        if len(rows) == 0:
            continue
        body_from_world = one.world_from_body.inverse()
        rays = np.empty((len(rows), 6), np.float32)
        rays[:, :3] = body_from_world.points(starts[rows])
        rays[:, 3:] = body_from_world.vectors(towards[rows])
        scene = one.body.scene
        found = scene.test_occlusions(o3d.core.Tensor(rays), NEAREST_M, 1.0, nthreads=THREADS)  # type: ignore[attr-defined]
        dark[rows] = found.numpy()
    return dark


class _Segments:
    """Segments start .. start + towards, asked again and again whether they come near a sphere."""

    def __init__(self, starts: Float32[Array, "n 3"], towards: Float32[Array, "n 3"]) -> None:
        self._starts, self._towards = starts, towards
        self._tt = np.einsum("ij,ij->i", towards, towards)
        self._ts = np.einsum("ij,ij->i", towards, starts)
        self._ss = np.einsum("ij,ij->i", starts, starts)

    def pass_near(self, center: Float32[Array, "3"], radius_m: float) -> Bool[Array, " n"]:
        """|c - s - x t|^2 < r^2 at the nearest point, x = clip(t.(c - s) / t.t, 0, 1)."""
        along = self._towards @ center - self._ts
        x = np.clip(along / self._tt, 0, 1)
        from_start = center @ center - 2 * (self._starts @ center) + self._ss
        return from_start - 2 * x * along + x * x * self._tt < radius_m * radius_m
