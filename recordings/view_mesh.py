"""Meshes for the viewer: shaded in 3D, and their visible outline in an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform
from recordings.tracks import ObjectShape

FEW_FACES = 5_000


def shaded_mesh(shape: ObjectShape, rgba: tuple[int, int, int, int]) -> rr.Mesh3D:
    """A shape in one colour: with sharp edges where it has few faces, smooth where it has many."""
    if len(shape.faces) <= FEW_FACES:
        return flat_mesh(shape.vertices_m, shape.faces, albedo_factor=rgba)
    return rr.Mesh3D(
        vertex_positions=shape.vertices_m.astype(np.float32),
        triangle_indices=shape.faces.astype(np.uint32),
        vertex_normals=vertex_normals(shape.vertices_m, shape.faces).astype(np.float32),
        albedo_factor=rgba,
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


@dataclass(frozen=True, eq=False)
class Outline:
    """A mesh prepared for its outline: the edges between a face that looks at the camera and one that looks away.

    `faces[e]` are the two faces at edge e; the second is -1 on an open border.
    """

    vertices_m: Float[Array, "v 3"]
    edges: Int[Array, "e 2"]
    faces: Int[Array, "e 2"]
    normals: Float[Array, "f 3"]
    centres_m: Float[Array, "f 3"]

    @staticmethod
    def of(shape: ObjectShape) -> Outline:
        """Equal vertices are joined first: texture seams are no borders."""
        vertices_m, joined = np.unique(np.round(shape.vertices_m, 9), axis=0, return_inverse=True)
        faces = joined.reshape(-1)[shape.faces]
        corners = vertices_m[faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        edges, pairs = _edges_with_faces(faces)
        return Outline(vertices_m, edges, pairs, normals, corners.mean(axis=1))

    def segments(self, camera: CameraModel, camera_from_object: Transform) -> Float[Array, "s 2 2"]:
        """Outline segments in pixels through the lens; those behind the camera or off the image are left out."""
        eye_m = camera_from_object.inverse().translation_m
        towards: Bool[Array, " f"] = ((eye_m - self.centres_m) * self.normals).sum(axis=1) > 0
        second = np.where(self.faces[:, 1] < 0, ~towards[self.faces[:, 0]], towards[self.faces[:, 1]])
        edges = self.edges[towards[self.faces[:, 0]] != second]
        pixels = camera.project(camera_from_object.points(self.vertices_m))[edges]
        return pixels[camera.sees(pixels).all(axis=1)]


def _edges_with_faces(faces: Int[Array, "f 3"]) -> tuple[Int[Array, "e 2"], Int[Array, "e 2"]]:
    """Each edge once, with the (first two) faces that share it."""
    sides = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((sides[:, 1], sides[:, 0]))
    sides, owner = sides[order], owner[order]
    first = np.flatnonzero(np.r_[True, (sides[1:] != sides[:-1]).any(axis=1)])
    shared = np.r_[np.diff(first), len(sides) - first[-1]] > 1
    second = np.where(shared, owner[np.minimum(first + 1, len(owner) - 1)], -1)
    return sides[first], np.stack([owner[first], second], axis=1)
