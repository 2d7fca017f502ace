"""The shapes that are tossed, and their masses. Each solid's frame has its origin at the bounding box's centre."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import ObjectConfig, Shape
from acquisition.synthetic.objects.solids import Chart, Solid, extrude, flat_chart, sweep
from recordings.errors import BadInput

USUAL_SIZE_M: dict[Shape, tuple[float, float, float]] = {
    "cube": (0.1048, 0.1048, 0.1048),
    "box": (0.16, 0.11, 0.07),
    "prism": (0.072, 0.0716, 0.166),
    "l": (0.13, 0.11, 0.05),
    "mug": (0.084, 0.084, 0.1),
}
MUG_WALL_M, MUG_HANDLE_RADIUS_M, MUG_SLICES = 0.005, 0.006, 64
L_THICKNESS_SHARE = 0.42


@dataclass(frozen=True, eq=False)
class MassProperties:
    """Mass, centre of mass and inertia about it, in the mesh's axes."""

    mass_kg: float
    center_m: Float[Array, "3"]
    inertia_kgm2: Float[Array, "3 3"]


def build(config: ObjectConfig) -> Solid:
    """The solid that a config names."""
    if config.shape == "mesh":
        if config.mesh_file is None:
            raise BadInput("shape 'mesh' without a file; set ObjectConfig.mesh_file to an .obj, .ply or .stl in metres")
        return from_file(config.mesh_file, config.size_m)
    size = config.size_m or USUAL_SIZE_M[config.shape]
    if min(size) <= 0:
        raise BadInput(f"object size {size}; wanted three positive lengths in metres")
    makers = {"cube": box, "box": box, "prism": prism, "l": l_shape, "mug": mug}
    return makers[config.shape](*size)


def mass_properties(solid: Solid, mass_kg: float) -> MassProperties:
    """Of a solid of even density."""
    import trimesh

    mesh = trimesh.Trimesh(solid.vertices_m, solid.faces, process=False)
    share = mass_kg / mesh.volume
    return MassProperties(mass_kg, np.array(mesh.center_mass), np.array(mesh.moment_inertia) * share)


def box(x_m: float, y_m: float, z_m: float) -> Solid:
    return extrude(np.array([[0.0, 0.0], [x_m, 0.0], [x_m, y_m], [0.0, y_m]]), z_m)


def prism(x_m: float, y_m: float, z_m: float) -> Solid:
    """Triangular: base x, height y, length z."""
    return extrude(np.array([[0.0, 0.0], [x_m, 0.0], [x_m / 2, y_m]]), z_m)


def l_shape(x_m: float, y_m: float, z_m: float) -> Solid:
    """Two legs that meet at the first corner; each is a convex piece."""
    t = L_THICKNESS_SHARE * min(x_m, y_m)
    outline = np.array([[0.0, 0.0], [x_m, 0.0], [x_m, t], [t, t], [t, y_m], [0.0, y_m]])
    solid = extrude(outline, z_m)
    pieces = []
    for corner in ((x_m, t), (t, y_m)):
        flat = np.array([[0.0, 0.0], [corner[0], 0.0], corner, [0.0, corner[1]]]) - [x_m / 2, y_m / 2]
        pieces.append(np.vstack([np.column_stack([flat, np.full(4, s * z_m / 2)]) for s in (-1, 1)]))
    return Solid(solid.vertices_m, solid.faces, solid.charts, solid.face_chart, solid.corner_uv_m, tuple(pieces))


def mug(x_m: float, y_m: float, z_m: float) -> Solid:
    """A cup of outer diameter x (y must be equal) and height z, open at +z, with a handle beside it along +x."""
    if abs(x_m - y_m) > 1e-9:
        raise BadInput(f"a mug is round: size_m {x_m, y_m, z_m} has two different diameters; make x and y equal")
    radius = x_m / 2
    profile = np.array(
        [
            [0.0, 0.0],
            [radius, 0.0],
            [radius, z_m],
            [radius - MUG_WALL_M, z_m],
            [radius - MUG_WALL_M, MUG_WALL_M],
            [0.0, MUG_WALL_M],
        ]
    )
    angle = np.linspace(0, 2 * np.pi, MUG_SLICES, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], -1)
    rings = np.concatenate(
        [profile[:, None, :1] * around[None], np.broadcast_to(profile[:, None, 1:], (6, MUG_SLICES, 1))], -1
    )
    cup = sweep(rings, ["foot", "outside", "rim", "inside", "bottom"])
    handle_rings = _handle_rings(radius, z_m)
    handle = sweep(handle_rings, [f"handle{i}" for i in range(len(handle_rings) - 1)])
    vertices, offset = np.vstack([cup[0], handle[0]]), np.array([0.0, 0.0, z_m / 2])
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    offset = 0.5 * (low + high)
    pieces = [p - offset for p in [*_cup_pieces(profile), *_handle_pieces(handle_rings)]]
    return Solid(
        vertices - offset,
        np.array(cup[1] + [[i + len(cup[0]) for i in f] for f in handle[1]]),
        tuple(cup[4] + handle[4]),
        np.array(cup[2] + [c + len(cup[4]) for c in handle[2]]),
        np.array(cup[3] + handle[3]),
        tuple(pieces),
    )


def _handle_rings(radius_m: float, height_m: float, steps: int = 17, slices: int = 16) -> Float[Array, "r s 3"]:
    """Rings along a half ellipse in the x-z plane from the lower to the upper wall, closed by poles in the wall."""
    inside = radius_m - 0.6 * MUG_WALL_M
    phi = np.linspace(-np.pi / 2, np.pi / 2, steps)
    centre = np.stack(
        [inside + 0.7 * radius_m * np.cos(phi), np.zeros(steps), height_m * (0.5 + 0.33 * np.sin(phi))], -1
    )
    tangent = np.gradient(centre, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    across = np.cross(side, tangent)
    turn = np.linspace(0, 2 * np.pi, slices, endpoint=False)
    # seen along the tangent the ring runs counter-clockwise, so that faces look outwards
    circle = (
        np.cos(turn)[None, :, None] * across[:, None] + np.sin(turn)[None, :, None] * np.cross(tangent, across)[:, None]
    )
    rings = centre[:, None] + MUG_HANDLE_RADIUS_M * circle
    poles = np.broadcast_to(centre[[0, -1], None], (2, slices, 3))
    return np.concatenate([poles[:1], rings, poles[1:]])


def _cup_pieces(profile: Float[Array, "6 2"], staves: int = 16) -> list[Float[Array, "n 3"]]:
    """A disc for the foot and staves for the wall, all convex."""
    outer, height = profile[1, 0], profile[2, 1]
    ring = np.linspace(0, 2 * np.pi, 4 * staves, endpoint=False)
    disc = [np.stack([outer * np.cos(ring), outer * np.sin(ring), np.full(len(ring), z)], -1) for z in (0, MUG_WALL_M)]
    pieces = [np.vstack(disc)]
    for k in range(staves):
        turn = 2 * np.pi * (k + np.linspace(0, 1, 5)) / staves
        corners = [
            np.stack([r * np.cos(turn), r * np.sin(turn), np.full(5, z)], -1)
            for r in (outer, outer - MUG_WALL_M)
            for z in (MUG_WALL_M, height)
        ]
        pieces.append(np.vstack(corners))
    return pieces


def _handle_pieces(rings: Float[Array, "r s 3"]) -> list[Float[Array, "n 3"]]:
    return [np.vstack([rings[i], rings[i + 3]]) for i in range(1, len(rings) - 4, 3)]


def from_file(path: Path, size_m: tuple[float, float, float] | None) -> Solid:
    """A mesh file as a solid: six charts by the axis that each face looks along, one convex piece per component."""
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except (OSError, ValueError, NotImplementedError) as wrong:
        raise BadInput(f"{path}: cannot be read as a mesh ({wrong}); wanted .obj, .ply or .stl") from wrong
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if len(mesh.faces) == 0 or not mesh.is_watertight:
        raise BadInput(f"{path}: {len(mesh.faces)} faces, not watertight; close its holes first")
    if mesh.volume < 0:
        mesh.invert()
    low, high = mesh.bounds
    scale = np.ones(3) if size_m is None else np.array(size_m) / (high - low)
    vertices = (np.array(mesh.vertices) - 0.5 * (low + high)) * scale
    pieces = [np.array(p.convex_hull.vertices) for p in mesh.split(only_watertight=False)]
    charts, face_chart, uv = _charts_by_axis(vertices, np.array(mesh.faces))
    moved = tuple((p - 0.5 * (low + high)) * scale for p in pieces)
    return Solid(vertices, np.array(mesh.faces), charts, face_chart, uv, moved)


def _charts_by_axis(vertices_m: Float[Array, "v 3"], faces: Array) -> tuple[tuple[Chart, ...], Array, Array]:
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    charts, face_chart, uv = [], np.zeros(len(faces), dtype=np.int64), np.zeros((len(faces), 3, 2))
    for number, which in enumerate(np.unique(side)):
        outward, right = np.zeros(3), np.zeros(3)
        outward[which // 2], right[(which // 2 + 1) % 3] = (1.0 if which % 2 else -1.0), 1.0
        rows = np.flatnonzero(side == which)
        chart, flat = flat_chart(str(number), vertices_m[faces[rows]].reshape(-1, 3), outward, right)
        charts.append(Chart(chart.name, chart.width_m, chart.height_m))
        face_chart[rows], uv[rows] = number, flat.reshape(-1, 3, 2)
    return tuple(charts), face_chart, uv
