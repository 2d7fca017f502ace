"""A mesh as a union of convex pieces, and carrying a mesh along when the pieces' points move."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.interpolate import RBFInterpolator
from scipy.spatial import ConvexHull

from processing.contact.physics.geometry import FreePoints, support_points
from processing.contact.physics.support import trimmed_hull

MOST_PIECES = 8
GOOD_ENOUGH = 0.97
"""Share of the pieces' hulls that the mesh must fill; below it the worst piece is cut."""
CUTS = 9
"""Planes tried per axis."""
LEAST_GAIN = 0.01
"""Share of the mesh's volume that a cut must save."""
MOST_FACES = 2500
"""A finer mesh is made coarser before it is cut."""


def convex_pieces(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], points: int = 64, trimmed: bool = False
) -> FreePoints:
    """Cut a mesh by planes along its principal axes until the pieces' hulls are nearly the mesh.

    Greedy: the cut of any piece that leaves the least total hull volume. `points` is the most support points of all
    pieces together; `trimmed` takes a measured mesh's spikes off. Only the hulls are wanted, so cuts are left open.
    """
    import trimesh

    if len(faces) > MOST_FACES:
        vertices_m, faces = _coarser(vertices_m, faces)
    mesh = trimesh.Trimesh(vertices_m, faces, process=True)
    box_from_mesh, _ = trimesh.bounds.oriented_bounds(mesh)
    axes, filled = np.asarray(box_from_mesh)[:3, :3], abs(float(mesh.volume))
    parts = [np.asarray(mesh.triangles, dtype=np.float64)]
    while len(parts) < MOST_PIECES and filled < GOOD_ENOUGH * sum(map(_hull_volume, parts)):
        gain, at, halves = max((_best_cut(p, i, axes) for i, p in enumerate(parts)), key=lambda c: c[0])
        if gain <= LEAST_GAIN * filled:
            break
        parts[at : at + 1] = halves
    each = max(8, points // len(parts))
    found = [_trimmed(p, each) if trimmed else support_points(p.reshape(-1, 3), each) for p in parts]
    ends = np.cumsum([len(p) for p in found])
    groups = tuple(tuple(range(int(e) - len(p), int(e))) for p, e in zip(found, ends))
    return FreePoints(np.concatenate(found), groups)


def _coarser(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]
) -> tuple[Float[Array, "w 3"], Int[Array, "g 3"]]:
    import open3d as o3d

    mesh = o3d.geometry.TriangleMesh(o3d.utility.Vector3dVector(vertices_m), o3d.utility.Vector3iVector(faces))
    mesh = mesh.simplify_quadric_decimation(MOST_FACES)
    return np.asarray(mesh.vertices), np.asarray(mesh.triangles, dtype=np.int64)


def _trimmed(triangles: Float[Array, "t 3 3"], points: int) -> Float[Array, "p 3"]:
    vertices = triangles.reshape(-1, 3)
    return trimmed_hull(vertices, np.arange(len(vertices)).reshape(-1, 3), points)


def _hull_volume(triangles: Float[Array, "t 3 3"]) -> float:
    points = triangles.reshape(-1, 3)
    if len(points) < 4 or np.linalg.matrix_rank(points - points.mean(0), tol=1e-7) < 3:
        return 0.0
    return float(ConvexHull(points).volume)


Cut = tuple[float, int, list[Array]]


def _best_cut(triangles: Float[Array, "t 3 3"], at: int, axes: Float[Array, "3 3"]) -> Cut:
    """The hull volume that the best cut of a part saves, which part it is, and its halves."""
    whole = _hull_volume(triangles)
    best: Cut = (0.0, at, [])
    for axis in axes:
        heights = triangles @ axis
        levels = np.linspace(heights.min(), heights.max(), CUTS + 2)[1:-1]
        own = np.unique(np.round(heights, 5))  # concave bodies change at their edges: planes through vertices, if few
        for level in (*levels, *(own if len(own) <= 40 else ())):
            halves = [_above(triangles, side * axis, side * level) for side in (1.0, -1.0)]
            volumes = [_hull_volume(h) for h in halves]
            if min(volumes) > 0 and whole - sum(volumes) > best[0]:
                best = (whole - sum(volumes), at, halves)
    return best


def _above(triangles: Float[Array, "t 3 3"], axis: Float[Array, "3"], level: float) -> Float[Array, "u 3 3"]:
    """The part of the triangles with axis . x >= level, triangulated."""
    heights = triangles @ axis - level
    kept = [triangles[(heights >= 0).all(1)]]
    crossing = (heights > 1e-9).any(1) & (heights < -1e-9).any(1)
    for triangle, height in zip(triangles[crossing], heights[crossing]):
        polygon = []
        for i in range(3):
            j = (i + 1) % 3
            if height[i] >= 0:
                polygon.append(triangle[i])
            if (height[i] > 0) != (height[j] > 0):
                share = height[i] / (height[i] - height[j])
                polygon.append(triangle[i] + share * (triangle[j] - triangle[i]))
        kept += [np.array([[polygon[0], polygon[k], polygon[k + 1]]]) for k in range(1, len(polygon) - 1)]
    return np.concatenate(kept)


def carried(
    vertices_m: Float[Array, "v 3"], before_m: Float[Array, "p 3"], after_m: Float[Array, "p 3"]
) -> Float[Array, "v 3"]:
    """Vertices moved by the displacement of the control points, interpolated linearly between them (a polyharmonic
    spline of order 1): where the controls stay, the mesh stays."""
    _, first = np.unique(np.round(before_m, 7), axis=0, return_index=True)
    shift = RBFInterpolator(before_m[first], (after_m - before_m)[first], kernel="linear", degree=0, neighbors=12)
    return vertices_m + shift(vertices_m)
