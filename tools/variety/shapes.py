"""Shapes drawn at random, each a closed mesh in metres with charts to paint; origin at the bounding box's centre."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from acquisition.synthetic.objects.solids import Chart, Solid, extrude, flat_chart, sweep

LONGEST_M = (0.04, 0.20)
CELLS = 80
"""Of marching cubes, along the longest side."""
SLICES = 72
SUPPORT_DIRECTIONS = 300

Field = Callable[[Float[Array, "*n 3"]], Float[Array, "*n"]]
"""Signed distance (or a bound of it), negative inside, in units of half the longest side."""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def make(family: str, rng: np.random.Generator) -> Solid:
    """A shape of a family, its longest extent log-uniform in LONGEST_M."""
    unit = MAKERS[family](rng)
    return scaled(unit, log_uniform(rng, *LONGEST_M) / float(np.ptp(unit.vertices_m, axis=0).max()))


def scaled(solid: Solid, factor: float) -> Solid:
    """Centred and scaled, charts too."""
    low, high = solid.vertices_m.min(axis=0), solid.vertices_m.max(axis=0)
    vertices = (solid.vertices_m - 0.5 * (low + high)) * factor
    charts = tuple(Chart(c.name, c.width_m * factor, c.height_m * factor) for c in solid.charts)
    return Solid(vertices, solid.faces, charts, solid.face_chart, solid.corner_uv_m * factor, (supports(vertices),))


def merged(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> tuple[Float[Array, "w 3"], Int[Array, "f 3"]]:
    """Vertices at one place (to seven digits) become one, so that a surface of strips is closed."""
    _, first, of = np.unique(np.round(vertices_m, 7), axis=0, return_index=True, return_inverse=True)
    return vertices_m[first], of.reshape(-1)[faces]


def supports(vertices_m: Float[Array, "v 3"]) -> Float[Array, "n 3"]:
    """Corners of the convex hull, as far as directions spread evenly over the sphere tell them apart."""
    k = np.arange(SUPPORT_DIRECTIONS) + 0.5
    z = 1 - 2 * k / SUPPORT_DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5.0)) * k
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    return vertices_m[np.unique((directions @ vertices_m.T).argmax(axis=1))]


def box(rng: np.random.Generator) -> Solid:
    x, y, z = rng.uniform(0.25, 1.0, 3)
    return extrude(np.array([[0.0, 0.0], [x, 0.0], [x, y], [0.0, y]]), z)


def prism(rng: np.random.Generator) -> Solid:
    """Three, five, six or eight corners on an ellipse."""
    corners = int(rng.choice([3, 5, 6, 8]))
    angle = 2 * np.pi * (np.arange(corners) + rng.uniform(-0.15, 0.15, corners)) / corners
    flat = np.stack([np.cos(angle), rng.uniform(0.6, 1.0) * np.sin(angle)], 1)
    return extrude(flat, float(rng.uniform(0.6, 5.0)))


def turned(profile: Float[Array, "n 2"]) -> Solid:
    """A body of revolution about z. `profile`: radius and height from the lower pole to the upper, outside first."""
    angle = np.linspace(0, 2 * np.pi, SLICES, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], -1)
    height = np.broadcast_to(profile[:, None, 1:], (len(profile), SLICES, 1))
    rings = np.concatenate([profile[:, None, :1] * around[None], height], -1)
    vertices, faces, of, uv, charts = sweep(rings, [f"band{k}" for k in range(len(profile) - 1)])
    vertices, indices = merged(vertices, np.array(faces))
    return Solid(vertices, indices, tuple(charts), np.array(of), np.array(uv), ())


def can(rng: np.random.Generator) -> Solid:
    """A cylinder with bevelled rims."""
    height, bevel = rng.uniform(0.5, 5.0), rng.uniform(0.03, 0.12)
    return turned(np.array([[0, 0], [1 - bevel, 0], [1, bevel], [1, height - bevel], [1 - bevel, height], [0, height]]))


def bottle(rng: np.random.Generator) -> Solid:
    """Body, shoulder, neck, cap; closed, so that it may be full or empty."""
    height, shoulder = rng.uniform(3.0, 5.0), rng.uniform(0.55, 0.8)
    neck, waist = rng.uniform(0.3, 0.6), rng.uniform(0.8, 1.0)
    top = min(0.97, shoulder + rng.uniform(0.1, 0.25))
    share = np.linspace(0, 1, 7)
    curve = 0.5 - 0.5 * np.cos(np.pi * share)
    rising = np.stack([1 - (1 - neck) * curve, height * (shoulder + (top - shoulder) * share)], 1)
    body = np.array([[0, 0], [0.9, 0], [1, 0.1], [waist, 0.5 * height * shoulder]])
    return turned(np.vstack([body, rising, [[1.15 * neck, height * top], [1.15 * neck, height], [0, height]]]))


def bowl(rng: np.random.Generator) -> Solid:
    """An open shell with a wall of even thickness."""
    depth, wall, foot = rng.uniform(0.4, 1.1), rng.uniform(0.05, 0.12), rng.uniform(0.3, 0.6)
    share = np.linspace(0, 1, 12)
    outside = np.stack([foot + (1 - foot) * np.sin(0.5 * np.pi * share), depth * share], 1)
    inside = outside[::-1] - [wall, 0.0]
    inside[:, 1] = np.maximum(inside[:, 1], wall)
    return turned(np.vstack([[[0, 0]], outside, inside, [[0, wall]]]))


def rounded_box(half: Float[Array, "3"], radius: float, at: Float[Array, "3"]) -> Field:
    def field(p: Array) -> Array:
        q = np.abs(p - at) - half + radius
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0) - radius

    return field


def cylinder(radius: float, half: float, at: Float[Array, "3"], top: float = 1.0) -> Field:
    """Along z; `top`: the upper radius as a share of the lower one."""

    def field(p: Array) -> Array:
        z = p[..., 2] - at[2]
        wanted = radius * (1 + (top - 1) * np.clip(0.5 + 0.5 * z / half, 0, 1))
        q = np.stack([np.hypot(p[..., 0] - at[0], p[..., 1] - at[1]) - wanted, np.abs(z) - half], -1)
        return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)

    return field


def ellipsoid(half: Float[Array, "3"], at: Float[Array, "3"]) -> Field:
    return lambda p: (np.linalg.norm((p - at) / half, axis=-1) - 1) * float(half.min())


def joined(fields: list[Field], blend: float) -> Field:
    """Union with a fillet of about `blend`."""

    def field(p: Array) -> Array:
        out = fields[0](p)
        for other in fields[1:]:
            d = other(p)
            mix = np.clip(0.5 + 0.5 * (d - out) / blend, 0, 1)
            out = d * (1 - mix) + out * mix - blend * mix * (1 - mix)
        return out

    return field


def meshed(field: Field, half: Float[Array, "3"]) -> Solid:
    """The zero surface of a field inside a box of these half sizes, by marching cubes; six charts, one a side."""
    from skimage.measure import marching_cubes

    cell = 2 * float(half.max()) / CELLS
    counts = np.ceil(2 * half / cell).astype(int) + 5
    axes = [cell * (np.arange(n) - (n - 1) / 2) for n in counts]
    values = field(np.stack(np.meshgrid(*axes, indexing="ij"), -1))
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(cell,) * 3)
    vertices = vertices.astype(np.float64) + [a[0] for a in axes]
    outwards = faces[:, ::-1] if _inside_out(vertices, faces) else faces
    return charted(vertices, outwards.astype(np.int64))


def _inside_out(vertices: Array, faces: Array) -> bool:
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) < 0


def charted(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> Solid:
    """Six charts by the side that each face looks to."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    axis = np.abs(normals).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(normals, axis[:, None], 1)[:, 0] > 0)
    charts, of, uv = [], np.zeros(len(faces), dtype=np.int64), np.zeros((len(faces), 3, 2))
    for number, which in enumerate(np.unique(side)):
        outward, right = np.zeros(3), np.zeros(3)
        outward[which // 2], right[(which // 2 + 1) % 3] = (1.0 if which % 2 else -1.0), 1.0
        rows = np.flatnonzero(side == which)
        chart, flat = flat_chart(str(number), vertices_m[faces[rows]].reshape(-1, 3), outward, right)
        charts.append(Chart(chart.name, chart.width_m, chart.height_m))
        of[rows], uv[rows] = number, flat.reshape(-1, 3, 2)
    return Solid(vertices_m, faces, tuple(charts), of, uv, ())


def beam(rng: np.random.Generator) -> Solid:
    """An L, T or U of even thickness."""
    thick, deep, other = rng.uniform(0.15, 0.3), rng.uniform(0.15, 0.5), rng.uniform(0.5, 1.0)
    foot = (np.array([1.0, thick, deep]), np.array([0.0, -other + thick, 0.0]))
    leg = np.array([thick, other, deep])
    places = {"L": [-1 + thick], "T": [0.0], "U": [-1 + thick, 1 - thick]}[str(rng.choice(["L", "T", "U"]))]
    parts = [foot, *((leg, np.array([x, 0.0, 0.0])) for x in places)]
    return meshed(
        joined([rounded_box(h, 0.03, at) for h, at in parts], 0.01), np.array([1.05, other + 0.05, deep + 0.05])
    )


def mug(rng: np.random.Generator) -> Solid:
    """A cup with a round or square handle of random size and place."""
    radius, half, wall = rng.uniform(0.5, 0.75), rng.uniform(0.6, 0.95), rng.uniform(0.05, 0.09)
    top = rng.uniform(0.85, 1.15)
    shell, hollow = (
        cylinder(radius, half, np.zeros(3), top),
        cylinder(radius - wall, half, np.array([0.0, 0.0, wall]), top),
    )
    reach, tall, tube = rng.uniform(0.25, 0.45), rng.uniform(0.35, 0.6) * half, rng.uniform(0.05, 0.09)
    power = float(rng.choice([2.0, 6.0]))

    def handle(p: Array) -> Array:
        x, z = (p[..., 0] - radius) / reach, p[..., 2] / tall
        around = (np.abs(x) ** power + np.abs(z) ** power) ** (1 / power) - 1
        ring = np.hypot(around * min(reach, tall), p[..., 1]) - tube
        return np.maximum(ring, radius - wall / 2 - np.hypot(p[..., 0], p[..., 1]))

    whole = joined([shell, handle], 0.04)
    return meshed(lambda p: np.maximum(whole(p), -hollow(p)), np.array([1.3, 1.0, 1.0]))


def blob(rng: np.random.Generator) -> Solid:
    """A smooth random surface that is seen whole from its middle."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=5)
    directions = np.array(ball.vertices)
    radius = np.ones(len(directions))
    for _ in range(12):
        towards = rng.standard_normal(3)
        bump = np.exp(rng.uniform(1.0, 6.0) * (directions @ (towards / np.linalg.norm(towards)) - 1))
        radius += rng.uniform(-0.25, 0.35) * bump
    vertices = directions * np.maximum(radius, 0.35)[:, None] * rng.uniform(0.6, 1.0, 3)
    return charted(vertices, np.array(ball.faces))


def primitive(rng: np.random.Generator, at: Float[Array, "3"]) -> Field:
    half = rng.uniform(0.2, 0.6, 3)
    kind = rng.integers(0, 3)
    if kind == 0:
        return rounded_box(half, 0.05, at)
    return cylinder(float(half[0]), float(half[2]), at) if kind == 1 else ellipsoid(half, at)


def union(rng: np.random.Generator) -> Solid:
    """Two primitives that overlap."""
    away = rng.standard_normal(3)
    away *= 0.22 / np.linalg.norm(away)
    return meshed(joined([primitive(rng, away), primitive(rng, -away)], 0.03), np.full(3, 1.0))


MAKERS: dict[str, Callable[[np.random.Generator], Solid]] = {
    "box": box, "can": can, "prism": prism, "beam": beam, "bottle": bottle, "bowl": bowl, "mug": mug, "blob": blob,
    "union": union,
}  # fmt: skip
FAMILIES = tuple(MAKERS)
