"""A shape whose surface is unknown along its normals: an offset for each small patch of it, smooth over the patches.

The surface moves: once its offsets are told they bend it, and it is drawn as it now is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array
from scipy.sparse import coo_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from processing.sensor.render import RaycastRenderer
from recordings.geometry import CameraModel
from recordings.tracks import ObjectShape

PATCH_M, PATCHES_ACROSS = 0.006, 25
"""Width of a patch, and so many across a larger body: finer ones cost time and change nothing (choose-003)."""
OFFSET_SIGMA_M = 0.005
"""How far a fused surface may be off (standard deviation). Not swept; by their volumes three sessions (choose-008, the
former judge-013 and 021) were 2 to 4 mm too small before outlines moved them out."""
SMOOTH_SIGMA_M = 0.0007
"""... and by how much neighbouring patches of one face differ in it; .0003 gives the same poses."""
MOST_POINTS = 200
"""Of an outline, evenly along it."""
EVEN = 2
"""Times that offsets and normals of vertices are averaged with their neighbours': patches leave no steps."""


class OffsetsInformation:
    """An inverse covariance (1/m^2) of a surface's offsets: a sparse matrix less `mean` everywhere."""

    def __init__(self, sparse: Any, mean: float) -> None:
        self._sparse, self._mean = sparse, mean

    def times(self, offsets_m: Float[Array, " k"]) -> Float[Array, " k"]:
        """Its product with offsets."""
        return np.asarray(self._sparse @ offsets_m - self._mean * offsets_m.sum())

    def with_more(self, information: Float[Array, " k"]) -> OffsetsInformation:
        """The same with more known of each offset alone."""
        return OffsetsInformation(self._sparse + diags_array(information), self._mean)

    def solver(self) -> Callable[[Float[Array, "k ..."]], Float[Array, "k ..."]]:
        """The product of its inverse with a vector or columns (Sherman and Morrison, 1950, for the mean)."""
        factor = splu(self._sparse.tocsc(), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        ones = factor.solve(np.ones(self._sparse.shape[0]))
        gain = self._mean / (1 - self._mean * ones.sum())

        def solved(columns: Float[Array, "k ..."]) -> Float[Array, "k ..."]:
            return np.asarray(factor.solve(columns) + gain * np.multiply.outer(ones, ones @ columns))

        return solved


class FreeSurface:
    """The patches of a shape (object frame), and what is known of their `count` offsets before anything is measured
    (`prior`): they are small, their mean no more so than any one of them, and smooth. `moved_m`: how far each has been
    moved."""

    def __init__(self, shape: ObjectShape, pinhole: CameraModel) -> None:
        """`pinhole`: the camera, rectified."""
        self._first, self._pinhole, self._neighbours = shape, pinhole, _neighbours(shape)
        self._renderer = RaycastRenderer(shape, pinhole)
        self._seen = np.ones(len(shape.faces), bool) if shape.observed is None else shape.observed[shape.faces].all(1)
        self._put(shape)
        size_m = float(np.linalg.norm(np.ptp(shape.vertices_m, axis=0)))
        self.patch = _patches(shape.vertices_m, self.normals, max(PATCH_M, size_m / PATCHES_ACROSS))
        """Of each vertex."""
        self.count = int(self.patch.max()) + 1
        mean = np.stack([np.bincount(self.patch, axis, self.count) for axis in self.normals.T], -1)
        self.patch_normals = mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
        own = diags_array(np.full(self.count, OFFSET_SIGMA_M**-2.0))
        self.prior = OffsetsInformation(
            _smooth(shape.faces, self.patch, self.patch_normals) + own,
            (1 - 1 / self.count) / self.count / OFFSET_SIGMA_M**2,
        )
        self.moved_m = np.zeros(self.count)
        ways = self._even(self.normals)
        self._ways = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)

    @property
    def pull(self) -> Float[Array, " k"]:
        """The prior's gradient by further offsets: back to the surface as it was."""
        return self.prior.times(self.moved_m)

    def move(self, offsets_m: Float[Array, " k"]) -> None:
        """Moves every patch on by its offset."""
        self.moved_m = self.moved_m + offsets_m
        moved = self._first.vertices_m + self._even(self.moved_m[self.patch, None]) * self._ways
        self._put(replace(self._first, vertices_m=moved))

    def depth(self, camera_from_object: Float[Array, "4 4"]) -> Float32[Array, "h w"]:
        """Depth (m) of the surface at a pose; 0 beside it, and where no view saw it."""
        hits = self._renderer.hits(camera_from_object)
        out = np.zeros((self._pinhole.height, self._pinhole.width), dtype=np.float32)
        out[hits.box] = np.where(self._seen[hits.face], hits.depth_m, np.float32(0))
        return out

    def _put(self, shape: ObjectShape) -> None:
        self._renderer.show(shape)
        self.vertices_m, self.normals = shape.vertices_m, _vertex_normals(shape)
        self._tree = cKDTree(shape.vertices_m)

    def _even(self, values: Float[Array, "v d"]) -> Float[Array, "v d"]:
        for _ in range(EVEN):
            values = self._neighbours @ values
        return values

    def nearest(self, points_m: Float[Array, "n 3"]) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
        """Distance (m) to the nearest vertex, and which it is."""
        distance_m, vertex = self._tree.query(points_m)
        return np.asarray(distance_m), np.asarray(vertex)

    def outline(self, camera_from_object: Float[Array, "4 4"]) -> tuple[Float[Array, "n 3"], Int[Array, " n"], float]:
        """What the outline of the shape at a pose is made of: points of the surface (object frame, m), each one's
        nearest vertex, and how many pixels of the outline a point stands for. Parts that no view saw are left out."""
        hits = self._renderer.hits(camera_from_object)
        v, u = np.nonzero(_border(hits.depth_m > 0))
        seen = self._seen[hits.face[v, u]]
        v, u = v[seen], u[seen]
        some = np.unique(np.linspace(0, len(v) - 1, MOST_POINTS).astype(int)) if len(v) else np.zeros(0, dtype=int)
        share, v, u = len(v) / max(len(some), 1), v[some], u[some]
        corners = self._first.faces[hits.face[v, u]]
        points = np.einsum("nc,ncj->nj", hits.weight[v, u].astype(np.float64), self.vertices_m[corners])
        return points, corners[:, 0], share


def _border(body: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Its pixels that have a neighbour which is not; where the image ends, it goes on."""
    if body.size == 0:
        return body
    inner = cv2.erode(body.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))) > 0
    return np.asarray(body & ~inner)


def _vertex_normals(shape: ObjectShape) -> Float[Array, "v 3"]:
    """Outward, of unit length."""
    import trimesh

    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces, process=False)
    return np.array(mesh.vertex_normals, dtype=np.float64)


def _neighbours(shape: ObjectShape) -> Any:
    """Matrix (sparse, v x v) of the mean over a vertex and those that share an edge with it."""
    count = len(shape.vertices_m)
    a, b = shape.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    touch = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(count, count)).tocsr()
    touch.data[:] = 1.0  # an edge belongs to two faces
    touch = touch + eye_array(count)
    return diags_array(1.0 / touch.sum(axis=1)) @ touch


def _patches(vertices_m: Float[Array, "v 3"], normals: Float[Array, "v 3"], width_m: float) -> Int[Array, " v"]:
    """Patch of each vertex: those in one cell of a grid that face alike (by the axis that they face most)."""
    cell = np.floor(vertices_m / width_m).astype(np.int64)
    axis = np.abs(normals).argmax(1)
    side = 2 * axis + (normals[np.arange(len(normals)), axis] > 0)
    return np.unique(np.column_stack([cell, side]), axis=0, return_inverse=True)[1].reshape(-1)


def _smooth(
    faces: Int[Array, "f 3"], patch: Int[Array, " v"], normals: Float[Array, "k 3"]
) -> Any:  # fmt: skip
    """Inverse covariance (sparse, k x k) by which patches that touch, and face alike, have like offsets."""
    touch = np.unique(np.sort(patch[faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)], axis=1), axis=0)
    a, b = touch[touch[:, 0] != touch[:, 1]].T
    alike = np.maximum(np.einsum("nj,nj->n", normals[a], normals[b]), 0) ** 2 / SMOOTH_SIGMA_M**2
    values = np.r_[alike, alike, -alike, -alike]
    return coo_array((values, (np.r_[a, b, a, b], np.r_[a, b, b, a])), shape=(len(normals), len(normals))).tocsc()
