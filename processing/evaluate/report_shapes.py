"""Pictures of shapes for the report: every step's shape side by side, from two sides, and its error against truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from recordings.geometry import rotation_exp
from recordings.tracks import ObjectShape

if TYPE_CHECKING:
    import trimesh

PANEL_PX = 260
ERROR_FULL_MM = 3.0
"""Distance at which the error colours saturate."""
UNSEEN_RGB = (150, 150, 190)
BACKGROUND = 255


@dataclass(frozen=True, eq=False)
class Shown:
    """A shape in a picture: where it stands (camera_from_object of the first frame, so that all are seen alike), its
    distance to the true surface per vertex in metres (None: not known), and the title."""

    title: str
    shape: ObjectShape
    camera_from_object: Float[Array, "4 4"]
    error_m: Float[Array, " v"] | None = None


def shape_picture(shown: Sequence[Shown]) -> UInt8[Array, "h w 3"]:
    """One column a shape; rows: colours from the camera's side, form from the other side, errors where known."""
    import cv2

    size_m = max(float(np.linalg.norm(np.ptp(s.shape.vertices_m, axis=0))) for s in shown)
    columns = []
    for s in shown:
        front, back = (_drawn(s, turn, size_m) for turn in (rotation_exp(np.array([-0.35, 0.45, 0.0])),
                       rotation_exp(np.array([0.35, np.pi + 0.45, 0.0]))))  # fmt: skip
        rows = [_painted(front, colors_of(s.shape)), _painted(back, form_colors(s.shape))]
        if any(x.error_m is not None for x in shown):
            rows.append(_painted(front, error_colors(s)))
        column = np.vstack(rows)
        title = np.full((26, PANEL_PX, 3), BACKGROUND, dtype=np.uint8)
        cv2.putText(title, s.title, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (30, 30, 30), 1, cv2.LINE_AA)
        columns.append(np.vstack([title, column]))
    return np.hstack(columns)


@dataclass(frozen=True, eq=False)
class _Drawing:
    """Per pixel: whether the shape is there, its face, the weights of its corners, and how it faces the light."""

    seen: Any
    face: Any
    weight: Any
    light: Any
    faces: Any


def _drawn(s: Shown, turn: Float[Array, "3 3"], size_m: float) -> _Drawing:
    """Orthographic, about the centre of the shape."""
    import open3d as o3d

    points = s.shape.vertices_m @ s.camera_from_object[:3, :3].T
    points = (points - 0.5 * (points.min(0) + points.max(0))) @ turn.T
    scene = o3d.t.geometry.RaycastingScene()
    tensor = o3d.core.Tensor
    scene.add_triangles(tensor(points.astype(np.float32)), tensor(s.shape.faces.astype(np.uint32)))
    at = (np.arange(PANEL_PX) - (PANEL_PX - 1) / 2) / PANEL_PX * size_m * 1.1
    x, y = np.meshgrid(at, at)
    rays = np.zeros((PANEL_PX, PANEL_PX, 6), dtype=np.float32)
    rays[..., 0], rays[..., 1], rays[..., 2], rays[..., 5] = x, y, -2 * size_m, 1.0
    found = scene.cast_rays(tensor(rays))
    seen = np.isfinite(found["t_hit"].numpy())
    normal = found["primitive_normals"].numpy()
    light = np.abs(normal @ np.array([-0.35, -0.5, -0.79]))  # closed or not, and wound either way
    uv = found["primitive_uvs"].numpy()
    weight = np.concatenate([1 - uv.sum(-1, keepdims=True), uv], -1)
    return _Drawing(seen, np.where(seen, found["primitive_ids"].numpy(), 0), weight, light, s.shape.faces)


def _painted(d: _Drawing, vertex_rgb: Float[Array, "v 3"]) -> UInt8[Array, "h w 3"]:
    corner = vertex_rgb[d.faces[d.face]]
    rgb = (corner * d.weight[..., None]).sum(-2) * (0.35 + 0.65 * d.light[..., None])
    return np.where(d.seen[..., None], np.clip(rgb, 0, 255), BACKGROUND).astype(np.uint8)


def colors_of(shape: ObjectShape) -> Float[Array, "v 3"]:
    if shape.vertex_rgb is None:
        return np.full((len(shape.vertices_m), 3), 200.0)
    return shape.vertex_rgb.astype(np.float64)


def form_colors(shape: ObjectShape) -> Float[Array, "v 3"]:
    """Grey, and blue where no camera saw the surface."""
    rgb = np.full((len(shape.vertices_m), 3), 205.0)
    if shape.observed is not None:
        rgb[~shape.observed] = UNSEEN_RGB
    return rgb


def error_colors(s: Shown) -> Float[Array, "v 3"]:
    """White for none, over yellow to red for ERROR_FULL_MM and more; grey where the truth is not known."""
    if s.error_m is None:
        return np.full((len(s.shape.vertices_m), 3), 225.0)
    share = np.clip(1e3 * s.error_m / ERROR_FULL_MM, 0, 1)[:, None]
    white, yellow, red = np.array([250.0, 250, 250]), np.array([250.0, 210, 40]), np.array([205.0, 30, 30])
    low, high = np.clip(2 * share, 0, 1), np.clip(2 * share - 1, 0, 1)
    return (1 - high) * ((1 - low) * white + low * yellow) + high * red


def true_shape(mesh: trimesh.Trimesh) -> ObjectShape:
    """The true mesh as a shape to show."""
    return ObjectShape("object", "truth", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int64))
