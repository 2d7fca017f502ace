"""What stands about: tables of five kinds, walls, clutter, a person, a hand, a gripper. World: z up, table z = 0."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from acquisition.synthetic.objects.paint import Gloss, PaintedMesh, assemble
from acquisition.synthetic.objects.solids import Chart, Solid, extrude
from acquisition.synthetic.objects.textures import noise
from recordings.geometry import Transform, rotation_exp
from variety import appearance, shapes
from variety.appearance import Finish

TABLE_HALF_M = (0.8, 0.7)
PATCH_HALF_M = (0.42, 0.38)
"""Half size of a towel or mat."""
FLOOR_M = -0.75
WAVE_NUMBER = 2 * np.pi / 0.6
TEXELS_PER_M = 900.0


@dataclass(frozen=True, eq=False)
class Item:
    """A body with its looks."""

    name: str
    mesh: PaintedMesh
    finish: Finish


def sheet(
    half_m: tuple[float, float],
    cell_m: float,
    height_m: Float[Array, "*n"] | float,
    keep: Bool[Array, "*n"] | None = None,
) -> Solid:
    """A grid in the x-y plane, seen from above; `height_m` and `keep` (of a cell's middle) on the grid's points."""
    counts = [max(2, int(2 * h / cell_m) + 1) for h in half_m]
    axes = [np.linspace(-h, h, n) for h, n in zip(half_m, counts)]
    x, y = np.meshgrid(*axes, indexing="ij")
    vertices = np.stack([x, y, np.broadcast_to(height_m, x.shape)], -1).reshape(-1, 3)
    i = np.arange(counts[0] * counts[1]).reshape(counts)
    a, b, c, d = (q.reshape(-1) for q in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    if keep is not None:
        rows = keep[:-1, :-1].reshape(-1)
        a, b, c, d = a[rows], b[rows], c[rows], d[rows]
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    uv = vertices[:, :2] * [1, -1] + list(half_m)
    chart = Chart("sheet", 2 * half_m[0], 2 * half_m[1])
    return Solid(vertices, faces, (chart,), np.zeros(len(faces), np.int64), uv[faces], ())


def grid(half_m: tuple[float, float], cell_m: float) -> tuple[Array, Array]:
    """x and y of a sheet's points."""
    counts = [max(2, int(2 * h / cell_m) + 1) for h in half_m]
    x, y = np.meshgrid(*(np.linspace(-h, h, n) for h, n in zip(half_m, counts)), indexing="ij")
    return x, y


def waved(x: Array, y: Array, wave_m: float) -> Array:
    """The table that is not quite flat, as `physics.Ground` has it."""
    return wave_m * np.sin(WAVE_NUMBER * x) * np.cos(WAVE_NUMBER * y)


def painted(solid: Solid, pictures: list[Array], texels_per_m: float) -> PaintedMesh:
    return assemble(solid, [np.clip(p, 0.01, 0.95).astype(np.float32) for p in pictures], texels_per_m, Gloss())


def flat_picture(kind: str, shape: tuple[int, int], rng: np.random.Generator) -> Array:
    """What a table top is covered with."""
    ground = appearance.draw_color(rng, float(rng.uniform(0.12, 0.85)))
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    if kind == "wood":
        bend = 30 * noise(rng, *shape, 400.0) + 5 * noise(rng, *shape, 60.0)
        rings = 0.5 + 0.5 * np.sin((0.05 * x + bend) * rng.uniform(0.6, 2.0))
        light, dark = np.array([0.55, 0.36, 0.2]), np.array([0.3, 0.17, 0.08])
        return (
            rng.uniform(0.5, 1.4)
            * (dark + (light - dark) * rings[..., None])
            * (0.9 + 0.2 * noise(rng, *shape, 3.0)[..., None])
        )
    if kind == "steel":
        brushed = np.repeat(rng.random((shape[0], 1), dtype=np.float32), shape[1], 1)
        return (0.5 + 0.12 * brushed + 0.1 * noise(rng, *shape, 90.0))[..., None] * np.ones(3)
    weave = 0.85 + 0.15 * np.sin(x * 1.9) * np.sin(y * 1.9) + 0.12 * (noise(rng, *shape, 2.0) - 0.5)
    stripes = 1.0 if rng.random() < 0.6 else 0.75 + 0.25 * (np.sin(2 * np.pi * x / rng.uniform(60, 300)) > 0)
    return (weave * stripes * (0.85 + 0.3 * noise(rng, *shape, 120.0)))[..., None] * ground


def table(kind: str, wave_m: float, rng: np.random.Generator) -> list[Item]:
    """The top; a towel or mat lies with its upper side at z = 0 on a table that is lower."""
    lies = kind in ("towel", "mat")
    under = str(rng.choice(["wood", "cloth"])) if lies else kind
    found = [_top(under, wave_m, -0.009 if lies else 0.0, rng)]
    if kind == "steel":
        found.append(Item("ground", *_plain_sheet(TABLE_HALF_M, -0.03, 0.03, rng)))
    if lies:
        found.append(_patch(kind, wave_m, rng))
    return found


def _plain_sheet(
    half_m: tuple[float, float], at_m: float, value: float, rng: np.random.Generator
) -> tuple[PaintedMesh, Finish]:
    solid = sheet(half_m, max(half_m), at_m)
    return painted(solid, [appearance.plain(rng, (32, 32), np.full(3, value))], 32 / (2 * half_m[0])), Finish(0.8)


def _top(kind: str, wave_m: float, at_m: float, rng: np.random.Generator) -> Item:
    cell = 0.003 if kind == "steel" else 0.02
    x, y = grid(TABLE_HALF_M, cell)
    keep = None
    if kind == "steel":
        pitch, radius = rng.uniform(0.025, 0.05), rng.uniform(0.003, 0.006)
        keep = np.hypot((x % pitch) - pitch / 2, (y % pitch) - pitch / 2) > radius
    solid = sheet(TABLE_HALF_M, cell, at_m + waved(x, y, wave_m), keep)
    shape = int(2 * TABLE_HALF_M[1] * TEXELS_PER_M), int(2 * TABLE_HALF_M[0] * TEXELS_PER_M)
    roughness = {"steel": rng.uniform(0.25, 0.5), "wood": rng.uniform(0.2, 0.6)}.get(kind, 0.95)
    finish = Finish(float(roughness), 0.0, 0.85 if kind == "steel" else 0.0, float(rng.uniform(0.7, 1.2)), 0.3)
    return Item("table", painted(solid, [flat_picture(kind, shape, rng)], TEXELS_PER_M), finish)


def _patch(kind: str, wave_m: float, rng: np.random.Generator) -> Item:
    x, y = grid(PATCH_HALF_M, 0.006)
    rim = np.minimum(PATCH_HALF_M[0] - np.abs(x), PATCH_HALF_M[1] - np.abs(y))
    height = waved(x, y, wave_m) - 0.0085 * np.clip(1 - rim / 0.008, 0, 1)
    if kind == "towel":
        height = height - 0.0012 * noise(rng, *x.shape, 9.0)
    solid = sheet(PATCH_HALF_M, 0.006, height)
    shape = int(2 * PATCH_HALF_M[1] * TEXELS_PER_M), int(2 * PATCH_HALF_M[0] * TEXELS_PER_M)
    return Item("table", painted(solid, [flat_picture("cloth", shape, rng)], TEXELS_PER_M), Finish(0.95))


def placed(solid: Solid, world_from_solid: Transform) -> Solid:
    return replace(solid, vertices_m=world_from_solid.points(solid.vertices_m))


def together(parts: list[Solid]) -> Solid:
    """Several solids as one, with all their charts."""
    at, charts, faces, of, uv = 0, 0, [], [], []
    for part in parts:
        faces.append(part.faces + at)
        of.append(part.face_chart + charts)
        uv.append(part.corner_uv_m)
        at, charts = at + len(part.vertices_m), charts + len(part.charts)
    everything = tuple(c for p in parts for c in p.charts)
    vertices = np.vstack([p.vertices_m for p in parts])
    return Solid(vertices, np.vstack(faces), everything, np.concatenate(of), np.vstack(uv), ())


def colored(solid: Solid, rgb: Float[Array, "3"], rng: np.random.Generator) -> PaintedMesh:
    """One colour all over, small pictures."""
    pictures = [appearance.plain(rng, (24, 24), rgb) for _ in solid.charts]
    stretched = tuple(Chart(c.name, 24.0, 24.0) for c in solid.charts)
    of = solid.face_chart
    size = np.array([[max(c.width_m, 1e-9), max(c.height_m, 1e-9)] for c in solid.charts])
    uv = solid.corner_uv_m / size[of][:, None] * 24.0
    return painted(replace(solid, charts=stretched, corner_uv_m=uv), pictures, 1.0)


def rod(start_m: Array, end_m: Array, radius_m: float) -> Solid:
    """A capsule between two points."""
    along = np.asarray(end_m, float) - start_m
    length, share = float(np.linalg.norm(along)), np.linspace(0, np.pi / 2, 6)
    cap = np.stack([radius_m * np.sin(share), -radius_m * np.cos(share)], 1)
    profile = np.vstack([cap, [0.0, length] + (cap * [1, -1])[::-1]])
    z = along / length
    x = np.cross(z, [0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return placed(
        shapes.turned(profile),
        Transform("world", "rod", np.stack([x, np.cross(z, x), z], 1), np.asarray(start_m, float)),
    )


def brick(low_m: tuple[float, float, float], high_m: tuple[float, float, float]) -> Solid:
    size = np.array(high_m) - low_m
    solid = extrude(np.array([[0.0, 0.0], [size[0], 0.0], size[:2], [0.0, size[1]]]), float(size[2]))
    return replace(solid, vertices_m=solid.vertices_m + 0.5 * (np.array(low_m) + high_m))


def hand(half_width_m: float, rng: np.random.Generator) -> Item:
    """Thumb on one side, three fingers on the other, palm and wrist behind. Frame: x closes, z towards the object."""
    w = half_width_m + 0.008
    fingers = [
        rod(np.array([-w - 0.01, 0.02 * k, -0.055]), np.array([-w, 0.018 * k, 0.012]), 0.0085) for k in (-1, 0, 1)
    ]
    thumb = rod(np.array([w + 0.012, 0.0, -0.05]), np.array([w, 0.0, 0.008]), 0.0105)
    palm = rod(np.array([-0.8 * w, 0.0, -0.06]), np.array([0.8 * w, 0.0, -0.062]), 0.03)
    wrist = rod(np.array([0.0, 0.0, -0.07]), np.array([0.0, 0.02, -0.3]), 0.03)
    skin = np.array([0.62, 0.42, 0.32]) * rng.uniform(0.4, 1.1)
    return Item("hand", colored(together([*fingers, thumb, palm, wrist]), skin, rng), Finish(0.5, infrared=1.2))


def gripper(half_width_m: float, rng: np.random.Generator) -> Item:
    """Two pads on a bar. Frame as `hand`."""
    w = half_width_m + 0.001
    pads = [
        brick((s * w - (0.012 if s < 0 else 0.0), -0.01, -0.06), (s * w + (0.012 if s > 0 else 0.0), 0.01, 0.01))
        for s in (-1, 1)
    ]
    bar = brick((-w - 0.03, -0.025, -0.1), (w + 0.03, 0.025, -0.06))
    post = rod(np.array([0.0, 0.0, -0.1]), np.array([0.0, 0.0, -0.3]), 0.03)
    grey = np.full(3, rng.uniform(0.1, 0.8))
    return Item("hand", colored(together([*pads, bar, post]), grey, rng), Finish(0.35))


def person(rng: np.random.Generator) -> Item:
    """Legs, body, arms, head; stands on the floor at the origin."""
    up = [rod(np.array([0.09 * s, 0, FLOOR_M]), np.array([0.08 * s, 0, FLOOR_M + 0.85]), 0.08) for s in (-1, 1)]
    arms = [rod(np.array([0.25 * s, 0, FLOOR_M + 0.9]), np.array([0.2 * s, 0, FLOOR_M + 1.4]), 0.05) for s in (-1, 1)]
    body = rod(np.array([0, 0, FLOOR_M + 0.95]), np.array([0, 0, FLOOR_M + 1.35]), 0.17)
    head = rod(np.array([0, 0, FLOOR_M + 1.58]), np.array([0, 0, FLOOR_M + 1.66]), 0.1)
    return Item(
        "person", colored(together([*up, *arms, body, head]), appearance.draw_color(rng, 0.5), rng), Finish(0.9)
    )


def clutter(number: int, towards_camera: Float[Array, "2"], rng: np.random.Generator) -> Item:
    """A thing of any family at the side or behind, standing on the table."""
    solid = shapes.make(str(rng.choice(shapes.FAMILIES[:3] + shapes.FAMILIES[4:6])), rng)
    solid = shapes.scaled(solid, float(rng.uniform(0.06, 0.26)) / float(np.ptp(solid.vertices_m, axis=0).max()))
    mesh = appearance.paint(solid, str(rng.choice(appearance.KINDS)), rng)
    angle = np.arctan2(towards_camera[1], towards_camera[0]) + rng.choice([-1, 1]) * rng.uniform(1.2, np.pi)
    reach = rng.uniform(0.4, 0.62)
    foot = -float(solid.vertices_m[:, 2].min())
    place = Transform(
        "world", "item", rotation_exp(np.array([0.0, 0.0, rng.uniform(0, 6.28)])),
        np.array([reach * np.cos(angle), reach * np.sin(angle), foot]),
    )  # fmt: skip
    normals = mesh.corner_normals @ place.rotation.T.astype(np.float32)
    moved = replace(mesh, vertices_m=place.points(mesh.vertices_m), corner_normals=normals)
    return Item(f"clutter{number}", moved, appearance.draw_finish(rng))


def pole(eye_m: Float[Array, "3"], rng: np.random.Generator) -> Item:
    """Something thin that stands between the camera and the flight."""
    foot = 0.45 * eye_m[:2] + 0.12 * rng.standard_normal(2)
    top = rng.uniform(0.15, 0.35)
    solid = rod(np.array([*foot, 0.0]), np.array([*foot, top]), float(rng.uniform(0.006, 0.014)))
    return Item("pole", colored(solid, appearance.draw_color(rng, 0.6), rng), appearance.draw_finish(rng))


def walls(away_from_camera: Float[Array, "2"], with_wall: bool, rng: np.random.Generator) -> list[Item]:
    """A floor, and mostly a wall behind the table."""
    found = [Item("floor", *_plain_sheet((4.0, 4.0), FLOOR_M, float(rng.uniform(0.1, 0.6)), rng))]
    if with_wall:
        distance, half = rng.uniform(1.0, 2.6), (3.0, 1.6)
        kind = str(rng.choice(["plain", "plain", "dense", "pattern", "printed"]))
        ground = appearance.draw_color(rng, float(rng.uniform(0.2, 0.85)))
        picture = appearance.PAINTERS[kind](rng, (int(2 * half[1] * 160), int(2 * half[0] * 160)), ground)
        into = np.array([*away_from_camera, 0.0]) / np.linalg.norm(away_from_camera)
        right = np.cross(into, [0.0, 0.0, 1.0])
        place = Transform("world", "wall", np.stack([right, [0.0, 0.0, 1.0], -into], 1), distance * into + [0, 0, 0.7])
        found.append(Item("wall", painted(placed(sheet(half, 3.0, 0.0), place), [picture], 160.0), Finish(0.9)))
    return found
