"""Shapes that contact learning can move: their points, which of them may touch, how they are drawn as meshes.

Against a plane only points of the body can touch, so a geometry offers its points, and the loss takes the `contacts`
lowest ones at each pose. Several convex pieces offer the points of all: the body is their union.
Points are in object axes, relative to the centre of mass of the prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial import ConvexHull
from torch import Tensor

from recordings.errors import BadInput

SCALE_M = 0.05
"""Optimisers see lengths in units of this."""
GeometryName = Literal["box", "hull", "nonconvex"]
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


@runtime_checkable
class Geometry(Protocol):
    """What the fit asks of a shape: a parameter vector (without unit, of order one) and the points it stands for."""

    @property
    def name(self) -> GeometryName: ...

    @property
    def contacts(self) -> int: ...

    def start(self) -> Float[Array, " p"]: ...

    def points(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "v 3"]: ...

    def pieces(self) -> tuple[tuple[int, ...], ...]: ...


@dataclass(frozen=True, eq=False)
class Box:
    """A box about the centre of mass, along the object's axes; three half lengths are learned."""

    half_m: Float[Array, "3"]
    contacts: int = 4
    name: GeometryName = "box"

    def start(self) -> Float[Array, " p"]:
        return np.asarray(self.half_m, dtype=np.float64) / SCALE_M

    def points(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "v 3"]:
        corners = torch.as_tensor(CORNERS, dtype=parameters.dtype, device=parameters.device)
        return corners * parameters.abs() * SCALE_M

    def pieces(self) -> tuple[tuple[int, ...], ...]:
        return (tuple(range(8)),)


@dataclass(frozen=True, eq=False)
class FreePoints:
    """Free points in convex pieces: one piece is a convex hull, several are a non-convex body."""

    points_m: Float[Array, "v 3"]
    groups: tuple[tuple[int, ...], ...]
    contacts: int = 10

    @property
    def name(self) -> GeometryName:
        return "hull" if len(self.groups) == 1 else "nonconvex"

    def start(self) -> Float[Array, " p"]:
        return np.asarray(self.points_m, dtype=np.float64).ravel() / SCALE_M

    def points(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "v 3"]:
        return parameters.view(-1, 3) * SCALE_M

    def pieces(self) -> tuple[tuple[int, ...], ...]:
        return self.groups


def sphere_directions(count: int) -> Float[Array, "n 3"]:
    """Evenly spread unit vectors (a Fibonacci spiral)."""
    i = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * i / count), np.pi * (1 + 5**0.5) * i
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], 1)


def sphere(radius_m: float, count: int = 64) -> FreePoints:
    """A convex hull that starts as a sphere."""
    return FreePoints(radius_m * sphere_directions(count), (tuple(range(count)),))


def sphere_in_pieces(radius_m: float, count: int = 64) -> FreePoints:
    """A union of eight convex pieces that starts as a sphere: its octants, each with the middle."""
    points = np.concatenate([radius_m * sphere_directions(count), np.zeros((1, 3))])
    octant = (points[:count] > 0) @ [1, 2, 4]
    groups = tuple((*(int(i) for i in np.flatnonzero(octant == o)), count) for o in range(8))
    return FreePoints(points, groups)


def hull_of(vertices_m: Float[Array, "v 3"], count: int = 64) -> FreePoints:
    """A convex hull of at most `count` points that starts at the hull of given vertices."""
    points = support_points(vertices_m, count)
    return FreePoints(points, (tuple(range(len(points))),))


def support_points(vertices_m: Float[Array, "v 3"], count: int, missing_m: float = 0.0) -> Float[Array, "n 3"]:
    """At most `count` of the hull's vertices: greedily those that the hull of the others misses most, until it misses
    less than `missing_m`: several points in each corner would leave no candidates for the other corners of a face.

    Raises BadInput for vertices that span no volume.
    """
    vertices = np.unique(np.round(vertices_m, 9), axis=0)
    if len(vertices) < 4 or np.linalg.matrix_rank(vertices - vertices.mean(0), tol=1e-6) < 3:
        raise BadInput(f"a shape of {len(vertices_m)} vertices spans no volume; wanted at least 4 not in one plane")
    hull = vertices[ConvexHull(vertices).vertices]
    if len(hull) <= count and missing_m == 0:
        return hull
    directions = sphere_directions(20 * count)
    reach = directions @ hull.T
    farthest, whole = reach.argmax(1), reach.max(1)
    chosen = list(dict.fromkeys(int(i) for i in farthest[:: 20 * count // 6]))
    covered = reach[:, chosen].max(1)
    while len(chosen) < count:
        worst = (whole - covered).argmax()
        best = int(farthest[worst])
        if best in chosen or whole[worst] - covered[worst] < missing_m:
            break
        chosen.append(best)
        covered = np.maximum(covered, reach[:, best])
    return hull[chosen]


def hull_mesh(points_m: Float[Array, "v 3"]) -> tuple[Float[Array, "w 3"], Int[Array, "f 3"]]:
    """Vertices and outward faces of a convex hull."""
    hull = ConvexHull(points_m)
    used = hull.vertices
    place = np.full(len(points_m), -1)
    place[used] = np.arange(len(used))
    vertices, faces = points_m[used], place[hull.simplices].astype(np.int64)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces


def pieces_mesh(
    points_m: Float[Array, "v 3"], pieces: Sequence[Sequence[int]]
) -> tuple[Float[Array, "w 3"], Int[Array, "f 3"]]:
    """The hulls of all pieces as one mesh (they may overlap)."""
    vertices: list[Array] = []
    faces: list[Array] = []
    for piece in pieces:
        v, f = hull_mesh(points_m[list(piece)])
        faces.append(f + sum(map(len, vertices)))
        vertices.append(v)
    return np.concatenate(vertices), np.concatenate(faces)
