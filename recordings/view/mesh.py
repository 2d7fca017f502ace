"""Meshes for the viewer: shaded in 3D, and their visible outline in an image."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import rerun as rr
from jaxtyping import Float, Int
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform
from recordings.tracks import ObjectShape

FEW_FACES = 5_000
FINER, SUBPIXEL_BITS = 4, 4
SUBPIXELS = 1 << SUBPIXEL_BITS
MAX_CANVAS = 100_000.0
"""A face may reach far out of the image; OpenCV's fixed-point corners may not."""


def shaded_mesh(shape: ObjectShape, rgba: tuple[int, int, int, int]) -> rr.Mesh3D:
    """A shape in one colour: with sharp edges where it has few faces, smooth where it has many."""
    if len(shape.faces) <= FEW_FACES:
        return flat_mesh(shape.vertices_m, shape.faces, albedo_factor=rgba)
    return smooth_mesh(shape, albedo_factor=rgba)


def smooth_mesh(shape: ObjectShape, **look: Any) -> rr.Mesh3D:
    """Faces that share their corners, shaded by the normals there."""
    return rr.Mesh3D(
        vertex_positions=shape.vertices_m.astype(np.float32),
        triangle_indices=shape.faces.astype(np.uint32),
        vertex_normals=vertex_normals(shape.vertices_m, shape.faces).astype(np.float32),
        **look,
    )


def flat_mesh(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], **look: Any) -> rr.Mesh3D:
    """Every face with corners and a normal of its own."""
    corners = vertices_m[faces]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3).astype(np.float32),
        triangle_indices=np.arange(3 * len(faces), dtype=np.uint32).reshape(-1, 3),
        vertex_normals=np.repeat(normals, 3, axis=0).astype(np.float32),
        **look,
    )


def vertex_normals(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> Float[Array, "v 3"]:
    """Unit normals at the vertices: the area-weighted mean of the faces around each."""
    corners = vertices_m[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    summed = np.zeros_like(vertices_m)
    for k in range(3):
        np.add.at(summed, faces[:, k], normals)
    return unit(summed)


def unit(vectors: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Vectors of length one; a zero vector stays zero."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


def outline_px(shape: ObjectShape, camera: CameraModel, camera_from_object: Transform) -> list[Float[Array, "n 2"]]:
    """The border of what the shape covers in the image, through the lens: closed strips of pixels, right to 1/4 px.

    Faces that reach behind the camera are left out; holes have a strip of their own.
    """
    triangles = camera.project(camera_from_object.points(shape.vertices_m))[shape.faces]
    triangles = triangles[np.isfinite(triangles).all(axis=(1, 2))]
    low = np.maximum(np.floor(triangles.min(axis=(0, 1), initial=np.inf)) - 1, -1)
    high = np.minimum(np.ceil(triangles.max(axis=(0, 1), initial=-np.inf)) + 2, [camera.width, camera.height])
    if len(triangles) == 0 or (high <= low).any():
        return []
    width, height = ((high - low) * FINER).astype(int)
    covered = np.zeros((height, width), dtype=np.uint8)
    corners = np.clip((triangles - low) * FINER, -MAX_CANVAS, MAX_CANVAS)
    for triangle in np.round(corners * SUBPIXELS).astype(np.int32):
        cv2.fillConvexPoly(covered, triangle, 1, shift=SUBPIXEL_BITS)
    borders, _ = cv2.findContours(covered, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    simple = [cv2.approxPolyDP(border, 1.0, True)[:, 0] for border in borders]
    return [np.vstack([border, border[:1]]) / FINER + low for border in simple if len(border) > 2]
