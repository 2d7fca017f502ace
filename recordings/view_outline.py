"""The visible outline of a mesh in an image: edges between a face that looks at the camera and one that looks away."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform
from recordings.tracks import ObjectShape


@dataclass(frozen=True, eq=False)
class Outline:
    """A mesh prepared for outlines. `faces[e]` are the two faces at edge e; the second is -1 on an open border."""

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
