"""What learning starts from: a geometry in its own frame, made from a vision mesh, or from a size alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.contact.physics.geometry import (
    Box,
    FreePoints,
    Geometry,
    GeometryName,
    hull_mesh,
    hull_of,
    pieces_mesh,
    sphere,
    sphere_in_pieces,
)
from processing.contact.physics.inertia import Physics
from processing.contact.physics.support import trimmed_hull, trimmed_vertices
from processing.motion.trajectory import PoseSeries
from recordings.tracks import ObjectShape


@dataclass(frozen=True, eq=False)
class Frame:
    """The frame that learning works in: origin at the prior's centre of mass, `axes` = object_from_learning."""

    axes: Float[Array, "3 3"]
    origin_object_m: Float[Array, "3"]

    def of(self, track: PoseSeries) -> PoseSeries:
        """The track of this frame instead of the object's."""
        moved = track.about(self.origin_object_m)
        return PoseSeries(moved.toss, moved.time_s, moved.rotation @ self.axes, moved.position_m)

    def back(self, points_m: Float[Array, "v 3"]) -> Float[Array, "v 3"]:
        """Points in the object frame."""
        return points_m @ self.axes.T + self.origin_object_m

    def inside(self, points_object_m: Float[Array, "v 3"]) -> Float[Array, "v 3"]:
        """Points of the object frame in this one."""
        return (points_object_m - self.origin_object_m) @ self.axes

    def inertia(self, inertia_object_kgm2: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
        """The inertia in the axes of this frame."""
        return self.axes.T @ inertia_object_kgm2 @ self.axes


@dataclass(frozen=True, eq=False)
class Prior:
    """A geometry to start from. `measured`: its size means something (it comes from vision, not from a guess).
    `mesh` is the shape it was made from, kept for what contact never touches."""

    geometry: Geometry
    frame: Frame
    measured: bool
    object_frame: str = "object"
    mesh: ObjectShape | None = None
    sigma_m: Float[Array, " v"] | None = None
    """How far each point may be off (standard deviation), where the prior is to hold its points; None: not at all."""


def prior_from_size(geometry: GeometryName, side_m: float, center_m: Float[Array, "3"] | None = None) -> Prior:
    """Start from a cube of a side, or a sphere of 0.8 times that side as radius (in eight pieces where the body need
    not be convex), about the centre of mass."""
    center = np.zeros(3) if center_m is None else np.asarray(center_m, dtype=np.float64)
    makers: dict[GeometryName, Callable[[], Geometry]] = {
        "box": lambda: Box(np.full(3, side_m / 2)),
        "hull": lambda: sphere(0.8 * side_m),
        "nonconvex": lambda: sphere_in_pieces(0.8 * side_m),
    }
    shape = makers[geometry]()
    return Prior(shape, Frame(np.eye(3), center), measured=False)


def prior_from_shape(
    geometry: GeometryName,
    shape: ObjectShape,
    physics: Physics,
    points: int = 64,
    contacts: int = 10,
    trimmed: bool = False,
) -> Prior:
    """Start from a mesh: its oriented bounding box, its convex hull, or its convex pieces.

    `trimmed` takes the spikes of a measured mesh off first.
    """
    center = physics.center_of_mass_m
    if geometry == "box":
        around = trimmed_vertices(shape.vertices_m, shape.faces) if trimmed else shape.vertices_m
        axes, center, half = _oriented_box(around)
        return Prior(Box(half), Frame(axes, center), True, shape.object_frame, shape)
    frame = Frame(np.eye(3), center)
    local = frame.inside(shape.vertices_m)
    free: FreePoints
    if geometry == "hull":
        free = hull_of(trimmed_hull(local, shape.faces, points) if trimmed else local, points)
    else:
        from processing.contact.physics.pieces import convex_pieces

        free = convex_pieces(local, shape.faces, points, trimmed)
    free = FreePoints(free.points_m, free.groups, contacts)
    return Prior(free, frame, True, shape.object_frame, shape)


def _oriented_box(
    vertices_m: Float[Array, "v 3"],
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, "3"]]:
    """Axes (object_from_box), middle and half lengths of the smallest box around points."""
    import trimesh

    box_from_object, size = trimesh.bounds.oriented_bounds(vertices_m)
    object_from_box = np.linalg.inv(box_from_object)
    axes = object_from_box[:3, :3]
    if np.linalg.det(axes) < 0:
        axes = axes * [1.0, 1.0, -1.0]
    return axes, object_from_box[:3, 3], np.asarray(size) / 2


def learned_shape(prior: Prior, points_m: Float[Array, "v 3"], touched: Bool[Array, " v"]) -> ObjectShape:
    """The refined shape in the object frame: a hull's mesh, or the prior's mesh carried along by its pieces."""
    if prior.geometry.name == "nonconvex" and prior.mesh is not None:
        start = prior.geometry.start().reshape(-1, 3)
        from processing.contact.physics.geometry import SCALE_M
        from processing.contact.physics.pieces import carried

        moved = carried(prior.frame.inside(prior.mesh.vertices_m), start * SCALE_M, points_m)
        mesh = prior.mesh
        return ObjectShape(
            prior.object_frame, "contact", prior.frame.back(moved), mesh.faces, mesh.vertex_rgb, mesh.observed
        )
    if prior.geometry.name == "nonconvex":
        vertices, faces = pieces_mesh(points_m, prior.geometry.pieces())
    else:
        vertices, faces = hull_mesh(points_m)
    used = np.array([int(np.linalg.norm(points_m - v, axis=1).argmin()) for v in vertices])
    return ObjectShape(prior.object_frame, "contact", prior.frame.back(vertices), faces, None, touched[used])
