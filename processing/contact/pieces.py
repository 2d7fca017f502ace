"""A mesh as a union of convex pieces, and carrying a mesh along when the pieces' points move."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.interpolate import RBFInterpolator
from scipy.spatial import ConvexHull

from processing.contact.geometry import FreePoints, support_points

MOST_PIECES = 8
GOOD_ENOUGH = 0.97
"""Share of the pieces' hulls that the mesh must fill; below it the worst piece is cut."""
CUTS = 9
"""Planes tried per axis."""


def convex_pieces(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], points: int = 64) -> FreePoints:
    """Cut a mesh by axis-aligned planes (of its principal axes) until the pieces' hulls are nearly the mesh.

    Greedy: of all cuts of the piece with most empty hull, the one that leaves the least total hull volume. `points` is the
    most support points of all pieces together.
    """
    import trimesh

    mesh = trimesh.Trimesh(vertices_m, faces, process=True)
    axes = _axes(mesh)
    parts = [mesh]
    filled = abs(float(mesh.volume))
    while len(parts) < MOST_PIECES and filled < GOOD_ENOUGH * sum(_hull_volume(p.vertices) for p in parts):
        cuts = [(_gain(p, axes), i) for i, p in enumerate(parts)]
        (gain, halves), at = max(cuts, key=lambda c: c[0][0])
        if gain <= 0.01 * filled or not halves:
            break
        parts[at : at + 1] = halves
    each = max(8, points // len(parts))
    found = [support_points(np.asarray(p.vertices), each) for p in parts]
    ends = np.cumsum([len(p) for p in found])
    groups = tuple(tuple(range(int(e) - len(p), int(e))) for p, e in zip(found, ends))
    return FreePoints(np.concatenate(found), groups)


def _axes(mesh: object) -> Float[Array, "3 3"]:
    """Principal axes of the oriented bounding box, as rows."""
    import trimesh

    box_from_mesh, _ = trimesh.bounds.oriented_bounds(mesh)
    return np.asarray(box_from_mesh)[:3, :3]


def _hull_volume(points: Float[Array, "v 3"]) -> float:
    points = np.asarray(points)
    if len(points) < 4 or np.linalg.matrix_rank(points - points.mean(0), tol=1e-7) < 3:
        return 0.0
    return float(ConvexHull(points).volume)


def _gain(part: object, axes: Float[Array, "3 3"]) -> tuple[float, list]:
    """The hull volume that the best cut of a part saves, and the two halves."""
    import trimesh

    whole = _hull_volume(part.vertices)  # type: ignore[attr-defined]
    best: tuple[float, list] = (0.0, [])
    for axis in axes:
        along = part.vertices @ axis  # type: ignore[attr-defined]
        for share in np.linspace(0, 1, CUTS + 2)[1:-1]:
            origin = axis * (along.min() + share * np.ptp(along))
            best = max(best, _cut(part, axis, origin, whole), key=lambda c: c[0])
        # edges of the mesh are where concave bodies change: try the planes through its vertices too, where they are few
        for level in np.unique(np.round(along, 6))[:40]:
            best = max(best, _cut(part, axis, axis * level, whole), key=lambda c: c[0])
    return best


def _cut(part: object, axis: Float[Array, "3"], origin: Float[Array, "3"], whole: float) -> tuple[float, list]:
    import trimesh

    halves = [trimesh.intersections.slice_mesh_plane(part, side * axis, origin) for side in (1.0, -1.0)]
    volumes = [_hull_volume(h.vertices) for h in halves]
    if min(volumes) <= 0:
        return 0.0, []
    return whole - sum(volumes), halves


def carried(
    vertices_m: Float[Array, "v 3"], before_m: Float[Array, "p 3"], after_m: Float[Array, "p 3"]
) -> Float[Array, "v 3"]:
    """Vertices moved by the displacement of the control points, interpolated linearly between them (a polyharmonic
    spline of order 1): where the controls stay, the mesh stays."""
    _, first = np.unique(np.round(before_m, 7), axis=0, return_index=True)
    shift = RBFInterpolator(before_m[first], (after_m - before_m)[first], kernel="linear", degree=0, neighbors=12)
    return vertices_m + shift(vertices_m)
