"""The support surface of a measured mesh: its convex hull without the spikes that measuring leaves.

The hull of a noisy mesh lies outside of the object: every spike pushes it. So a direction's support is not where the
mesh ends. It is carried on from the heights beyond which little of the surface lies, by how surface ends: at a corner
the area beyond a height grows with the square of the depth, at an edge or a round face with the depth itself. The
trimmed hull is what these half spaces leave, of contact's points as few half spaces as noise allows: more of them leave
a roof on every flat face and blunt every edge, and a body rolls where it should slide.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial import ConvexHull, HalfspaceIntersection

from processing.contact.physics.geometry import sphere_directions, support_points
from recordings.errors import BadInput
from recordings.tracks import ObjectShape

CAPS = (1 / 1500, 4 / 1500, 16 / 1500)
"""Of the surface: what lies beyond the heights that tell a direction's support. Spikes must have less than the first
or far less than the last."""
SAMPLES = 40_000
R2 = 1 / 1.32471795724474602596 ** np.array([1, 2])
DIRECTIONS, FACETS = 300, 60
FLAT = (0.02, 0.01, 0.005)
"""How near to the support a face's samples lie, as a share of the mean extent: nearer each time."""
LEAST_SAMPLES = 10
ROUGH = 0.012
"""Support that may be missing between the points of a measured mesh, or stand over between its planes, as a share of
its mean extent: less is noise."""


def surface_samples(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], count: int = SAMPLES
) -> Float[Array, "n 3"]:
    """Points that each stand for as much of the surface, by the triangles' order, which goes round it: evenly within
    neighbouring ones, too, where random ones would crowd. Within a triangle: the plane's R2 sequence (Roberts 2018)."""
    corners = vertices_m[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    if not area.sum() > 0:
        raise BadInput(f"a shape of {len(faces)} triangles has no surface; wanted a mesh with an area")
    ends = np.cumsum(area) / area.sum()
    chosen = np.minimum(np.searchsorted(ends, (np.arange(count) + 0.5) / count), len(faces) - 1)
    a, b = (0.5 + np.outer(R2, np.arange(count))[..., None]) % 1
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    corner = corners[chosen]
    return np.asarray(corner[:, 0] + a * (corner[:, 1] - corner[:, 0]) + b * (corner[:, 2] - corner[:, 0]))


def trimmed_hull(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], points: int = 64) -> Float[Array, "n 3"]:
    """At most `points` vertices of the mesh's convex hull without spikes: between as few planes as noise allows."""
    spaces = _HalfSpaces.of(vertices_m, faces)
    rough = ROUGH * float(np.ptp(spaces.corners(), axis=0).mean())
    return support_points(spaces.fewest(rough).corners(), points, rough)


def trimmed_vertices(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> Float[Array, "n 3"]:
    """All vertices of the trimmed hull, between all planes."""
    return _HalfSpaces.of(vertices_m, faces).corners()


@dataclass(frozen=True, eq=False)
class _HalfSpaces:
    """Points p with normals @ (p - center_m) <= reach_m, and the share of the surface that lies near each plane."""

    center_m: Float[Array, "3"]
    normals: Float[Array, "d 3"]
    reach_m: Float[Array, " d"]
    near: Float[Array, " d"]

    @classmethod
    def of(cls, vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> _HalfSpaces:
        samples = surface_samples(vertices_m, faces)
        center = samples.mean(0)
        samples = samples - center
        directions = np.concatenate([sphere_directions(DIRECTIONS), _facets(vertices_m)])
        normals = np.concatenate([face_normals(samples[::10], directions), directions])
        heights = normals.astype(np.float32) @ samples.astype(np.float32).T
        rough = ROUGH * float(np.ptp(samples, axis=0).mean())
        last = [len(samples) - 1 - round(share * len(samples)) for share in CAPS]
        heights.partition(last, axis=1)
        small, middling, large = heights[:, last].T
        corner, edge_too = 2 * middling - large, (8 * small - 6 * middling + large) / 3
        near = (heights > (middling - rough)[:, None]).mean(1)
        return cls(center, normals, np.minimum(corner, edge_too), near)

    def fewest(self, missing_m: float) -> _HalfSpaces:
        """So few that the others cut off less than `missing_m`: of those that do, always the one that most surface lies
        near, so that flat faces come first."""
        around = np.concatenate([np.eye(3), -np.eye(3)])
        box = np.column_stack([around, np.full(6, -2 * self.reach_m.max())])
        body, chosen = HalfspaceIntersection(box, np.zeros(3), incremental=True), np.zeros(len(self.normals), bool)
        while True:
            over = (self.normals @ body.intersections.T).max(1) - self.reach_m
            left = np.flatnonzero((over > missing_m) & ~chosen)
            if not len(left):
                return _HalfSpaces(self.center_m, self.normals[chosen], self.reach_m[chosen], self.near[chosen])
            at = left[self.near[left].argmax()]
            chosen[at] = True
            body.add_halfspaces(np.array([[*self.normals[at], -self.reach_m[at]]]))

    def corners(self) -> Float[Array, "n 3"]:
        """Vertices of what the half spaces leave."""
        planes = np.column_stack([self.normals, -self.reach_m])
        inside = HalfspaceIntersection(planes, np.zeros(3)).intersections + self.center_m
        return np.asarray(inside[np.isfinite(inside).all(1)])


def face_normals(samples_m: Float[Array, "n 3"], directions: Float[Array, "d 3"]) -> Float[Array, "e 3"]:
    """Where a direction is a few degrees off a flat face's normal, that normal: of the plane through the samples that
    lie near the support. Where no face is flat, any direction is as good."""
    extent, normals = float(np.ptp(samples_m, axis=0).mean()), directions
    for share in FLAT:
        heights = normals @ samples_m.T
        least = np.partition(heights, -LEAST_SAMPLES, axis=1)[:, -LEAST_SAMPLES] - share * extent
        thinnest = [np.linalg.eigh(np.cov(samples_m[h > floor].T))[1][:, 0] for h, floor in zip(heights, least)]
        normals = np.stack([thin * np.sign(thin @ normal) for thin, normal in zip(thinnest, normals)])
    return np.unique(np.round(normals, 3), axis=0)


def _facets(vertices_m: Float[Array, "v 3"], most: int = FACETS) -> Float[Array, "n 3"]:
    """Normals of the hull's largest facets: with them a flat face stays flat and an edge sharp."""
    hull = ConvexHull(vertices_m)
    corners = vertices_m[hull.simplices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.unique(np.round(hull.equations[np.argsort(-area)[:most], :3], 6), axis=0)


def volume_m3(shape: ObjectShape) -> float | None:
    """Volume inside a closed mesh; None where it is not closed."""
    import trimesh

    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces, process=True)
    return float(abs(mesh.volume)) if mesh.is_watertight else None
