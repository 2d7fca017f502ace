"""The support surface of a measured mesh: its convex hull without the spikes that measuring leaves.

The hull of a noisy mesh lies outside of the object: every spike pushes it. Here a direction's support is the height
beyond which no more than `cap_m2` of surface lies, and the trimmed hull is what those half spaces leave.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial import HalfspaceIntersection

from processing.contact.physics.geometry import sphere_directions, support_points
from recordings.errors import BadInput
from recordings.tracks import ObjectShape

CAP_M2 = 1e-5
"""Of a cube's corner this cuts 1.5 mm off along its diagonal, which contact gives back; of an edge nothing."""
SAMPLES = 20_000
DIRECTIONS, FACETS = 300, 60
ROUGH = 0.012
"""Support that may be missing between the points of a measured mesh, as a share of its mean extent: less is noise."""


def surface_samples(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], count: int = SAMPLES, seed: int = 0
) -> tuple[Float[Array, "n 3"], float]:
    """Points spread evenly over the triangles, and the area that each stands for (m^2)."""
    corners = vertices_m[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1)
    if not area.sum() > 0:
        raise BadInput(f"a shape of {len(faces)} triangles has no surface; wanted a mesh with an area")
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(faces), count, p=area / area.sum())
    a, b = rng.random((2, count, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corner = corners[chosen]
    points = corner[:, 0] + a * (corner[:, 1] - corner[:, 0]) + b * (corner[:, 2] - corner[:, 0])
    return points, float(area.sum()) / count


def trimmed_hull(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], points: int = 64, cap_m2: float = CAP_M2
) -> Float[Array, "n 3"]:
    """At most `points` vertices of the mesh's convex hull without spikes."""
    return rough_support(trimmed_vertices(vertices_m, faces, cap_m2), points)


def rough_support(vertices_m: Float[Array, "v 3"], points: int) -> Float[Array, "n 3"]:
    """So few of a measured hull's vertices that what they leave out is noise."""
    return support_points(vertices_m, points, ROUGH * float(np.ptp(vertices_m, axis=0).mean()))


def trimmed_vertices(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], cap_m2: float = CAP_M2
) -> Float[Array, "n 3"]:
    """All vertices of the trimmed hull."""
    samples, each = surface_samples(vertices_m, faces)
    beyond = max(round(cap_m2 / each), 1)
    directions = np.concatenate([sphere_directions(DIRECTIONS), _facets(vertices_m)])
    reach = np.partition(samples @ directions.T, -beyond - 1, axis=0)[-beyond - 1]
    middle = samples.mean(0)
    space = np.column_stack([directions, -(reach - directions @ middle)])
    inside = HalfspaceIntersection(space, np.zeros(3)).intersections + middle
    return np.asarray(inside[np.isfinite(inside).all(1)])


def _facets(vertices_m: Float[Array, "v 3"], most: int = FACETS) -> Float[Array, "n 3"]:
    """Normals of the hull's largest facets: with them a flat face stays flat and an edge sharp."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(vertices_m)
    corners = vertices_m[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.unique(np.round(hull.equations[np.argsort(-area)[:most], :3], 6), axis=0)


def volume_m3(shape: ObjectShape) -> float | None:
    """Volume inside a closed mesh; None where it is not closed."""
    import trimesh

    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces, process=True)
    return float(abs(mesh.volume)) if mesh.is_watertight else None
