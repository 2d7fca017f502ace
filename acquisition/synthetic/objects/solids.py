"""Meshes that can be painted: a solid is cut into charts (patches of surface), each with coordinates in metres.

A flat chart's frame is an AprilTag's as pupil-apriltags reports it: x right, y down as seen from outside, z into the
surface, origin at the chart's top left corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from recordings.geometry import Transform

CREASE_COS = float(np.cos(np.deg2rad(35.0)))


@dataclass(frozen=True, eq=False)
class Chart:
    """A patch of surface painted as one picture of width_m x height_m. `object_from_chart` only where it is flat."""

    name: str
    width_m: float
    height_m: float
    object_from_chart: Transform | None = None


@dataclass(frozen=True, eq=False)
class Solid:
    """A closed triangle mesh in its own frame, with charts to paint and convex pieces to collide with."""

    vertices_m: Float[Array, "v 3"]
    faces: Int[Array, "f 3"]
    charts: tuple[Chart, ...]
    face_chart: Int[Array, " f"]
    corner_uv_m: Float[Array, "f 3 2"]
    """Position of each face's corner in its chart, from the chart's top left."""
    pieces_m: tuple[Float[Array, "_ 3"], ...]


def corner_normals(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> Float[Array, "f 3 3"]:
    """Unit normal at each face's corner, smoothed over neighbours that meet at less than 35 degrees."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    area_normals = np.cross(b - a, c - a)
    units = area_normals / np.maximum(np.linalg.norm(area_normals, axis=1, keepdims=True), 1e-15)
    _, vertex_of = np.unique(np.round(vertices_m, 7), axis=0, return_inverse=True)
    corner_vertex = vertex_of.reshape(-1)[faces].reshape(-1)
    order = np.argsort(corner_vertex, kind="stable")
    starts = np.searchsorted(corner_vertex[order], np.arange(corner_vertex.max() + 2))
    counts = np.diff(starts)[corner_vertex]
    first = np.repeat(np.arange(len(corner_vertex)), counts)
    within = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
    second = order[np.repeat(starts[corner_vertex], counts) + within]
    near = np.einsum("ij,ij->i", units[first // 3], units[second // 3]) > CREASE_COS
    summed = np.zeros((len(corner_vertex), 3))
    np.add.at(summed, first[near], area_normals[second[near] // 3])
    summed /= np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-15)
    return summed.reshape(-1, 3, 3)


def flat_chart(
    name: str, polygon_m: Float[Array, "n 3"], outward: Float[Array, "3"], right: Float[Array, "3"]
) -> tuple[Chart, Float[Array, "n 2"]]:
    """Chart of a flat polygon, `right` (in its plane) pointing right as seen from outside, and the polygon in it."""
    down = np.cross(-outward, right)
    axes = np.stack([right, down, -outward], axis=1)
    flat = polygon_m @ axes
    low, high = flat[:, :2].min(axis=0), flat[:, :2].max(axis=0)
    corner = axes @ np.array([low[0], low[1], flat[0, 2]])
    frame = Transform("object", f"chart_{name}", axes, corner)
    return Chart(name, float(high[0] - low[0]), float(high[1] - low[1]), frame), flat[:, :2] - low


def extrude(polygon_m: Float[Array, "n 2"], length_m: float) -> Solid:
    """A prism along z over a counter-clockwise polygon that is star-shaped about its first corner, centred."""
    n = len(polygon_m)
    centre = 0.5 * (polygon_m.min(axis=0) + polygon_m.max(axis=0))
    ring = polygon_m - centre
    bottom = np.column_stack([ring, np.full(n, -length_m / 2)])
    top = np.column_stack([ring, np.full(n, length_m / 2)])
    x, z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    sides = []
    for k in range(n):
        j = (k + 1) % n
        along = (bottom[j] - bottom[k]) / np.linalg.norm(bottom[j] - bottom[k])
        quad = np.array([bottom[k], bottom[j], top[j], top[k]])
        sides.append((quad, [k, j, n + j, n + k], np.cross(along, z), along))
    caps = [(top, list(range(n, 2 * n)), z, x), (bottom[::-1], list(range(n))[::-1], -z, x)]
    # the bottom's fan must start at the polygon's first corner as well
    caps[1] = (np.roll(caps[1][0], 1, axis=0), list(np.roll(caps[1][1], 1)), -z, x)
    faces, face_chart, uv, charts = [], [], [], []
    for number, (points, indices, outward, right) in enumerate([*sides, *caps]):
        chart, flat = flat_chart(str(number), points, outward, right)
        charts.append(chart)
        for i in range(1, len(indices) - 1):
            faces.append([indices[0], indices[i], indices[i + 1]])
            face_chart.append(number)
            uv.append(flat[[0, i, i + 1]])
    vertices = np.vstack([bottom, top])
    return Solid(vertices, np.array(faces), tuple(charts), np.array(face_chart), np.array(uv), (vertices,))


def sweep(rings_m: Float[Array, "r s 3"], names: list[str]) -> tuple[Float[Array, "v 3"], list, list, list, list]:
    """Bands between consecutive closed rings, one chart each: vertices, faces, chart of each face, uv, charts.

    A ring of coincident points is a pole. Faces look to the right of the direction (ring order x ring direction).
    """
    count, slices, _ = rings_m.shape
    faces, face_chart, uv, charts = [], [], [], []
    for band in range(count - 1):
        lower, upper = rings_m[band], rings_m[band + 1]
        steps = [np.linalg.norm(np.roll(r, -1, axis=0) - r, axis=1) for r in (lower, upper)]
        width = float(max(steps[0].sum(), steps[1].sum()))
        height = float(np.linalg.norm(upper - lower, axis=1).mean())
        charts.append(Chart(names[band], width, height))
        for k in range(slices):
            j = (k + 1) % slices
            a, b, c, d = band * slices + k, band * slices + j, (band + 1) * slices + j, (band + 1) * slices + k
            u0, u1 = width * k / slices, width * (k + 1) / slices
            if np.linalg.norm(lower[k] - lower[j]) > 1e-9:
                faces.append([a, b, c])
                uv.append([[u0, height], [u1, height], [u1, 0.0]])
                face_chart.append(band)
            if np.linalg.norm(upper[k] - upper[j]) > 1e-9:
                faces.append([a, c, d])
                uv.append([[u0, height], [u1, 0.0], [u0, 0.0]])
                face_chart.append(band)
    return rings_m.reshape(-1, 3), faces, face_chart, uv, charts
