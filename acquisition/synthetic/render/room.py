"""The room that does not move: table, floor, walls with posters, things standing about, tags on the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import SceneConfig
from acquisition.synthetic.objects import textures
from acquisition.synthetic.objects.paint import Gloss, PaintedMesh, assemble
from acquisition.synthetic.objects.shapes import box
from acquisition.synthetic.objects.solids import Chart, Solid
from recordings.geometry import Transform
from recordings.tracks import TagPlacement

TABLE_HALF_M = (0.85, 0.75)
TABLE_THICKNESS_M = 0.03
FLOOR_M = -0.74
WALL_DISTANCE_M = 1.9
PAPER_M = 0.0004
TABLE_TAG_M = 0.08
FIRST_TABLE_TAG = 30
TABLE_TAG_PLACES_M = ((-0.4, 0.36), (0.4, 0.36), (0.35, -0.22), (-0.36, -0.22))


@dataclass(frozen=True, eq=False)
class Room:
    meshes: tuple[PaintedMesh, ...]
    table_tags: tuple[TagPlacement, ...]


def build_room(config: SceneConfig, facing: Float[Array, "2"], rng: np.random.Generator) -> Room:
    """The room of a session; `facing` is the direction (x, y) in which the colour camera looks: posters hang there."""
    facing = facing / np.linalg.norm(facing)
    meshes = [_table(config, rng), _flat(rng, "floor", (6.0, 6.0), _lying((0.0, 0.0, FLOOR_M)), 150.0)]
    meshes += _walls(facing, rng)
    meshes += _clutter(facing, rng)
    tags: list[TagPlacement] = []
    if config.table_tags:
        for number, (x, y) in enumerate(TABLE_TAG_PLACES_M):
            place = _lying((x, y, PAPER_M))
            tags.append(TagPlacement(FIRST_TABLE_TAG + number, TABLE_TAG_M, place))
            meshes.append(tag_card(FIRST_TABLE_TAG + number, TABLE_TAG_M, place))
    return Room(tuple(meshes), tuple(tags))


def tag_card(tag_id: int, size_m: float, world_from_tag: Transform) -> PaintedMesh:
    """A tag printed on a square of paper with a white border of one module."""
    side_m = size_m * (textures.MARKER_MODULES + 2) / textures.MARKER_MODULES
    pixels = 400
    picture = np.full((pixels, pixels, 3), textures.WHITE, np.float32)
    textures.paint_tag(picture, tag_id, np.full(2, pixels / 2.0), size_m * pixels / side_m)
    return _quad((side_m, side_m), picture, pixels / side_m, world_from_tag)


def _lying(position_m: tuple[float, float, float]) -> Transform:
    """A sheet on the table, read from the side of -y: x to the left, y to the reader, z into the table."""
    return Transform("world", "tag", np.diag([-1.0, 1.0, -1.0]), np.array(position_m))


def _quad(size_m: tuple[float, float], picture: Array, texels_per_m: float, world_from_sheet: Transform) -> PaintedMesh:
    w, h = size_m
    corners = np.array([[-w / 2, -h / 2, 0], [w / 2, -h / 2, 0], [w / 2, h / 2, 0], [-w / 2, h / 2, 0]])
    uv = corners[:, :2] + [w / 2, h / 2]
    faces = np.array([[0, 2, 1], [0, 3, 2]])
    solid = Solid(world_from_sheet.points(corners), faces, (Chart("sheet", w, h),), np.zeros(2, int), uv[faces], ())
    return assemble(solid, [picture], texels_per_m, Gloss(0.02, 8.0))


def _flat(
    rng: np.random.Generator, kind: str, size_m: tuple[float, float], place: Transform, texels_per_m: float
) -> PaintedMesh:
    h, w = int(size_m[1] * texels_per_m), int(size_m[0] * texels_per_m)
    if kind == "poster":
        picture = textures.rich(rng, h, w)
    elif kind == "floor":
        picture = 0.6 * textures.speckled(rng, h, w)
    else:
        picture = textures.faint(rng, h, w) * textures.color(rng, 0.7, 1.0) * 0.8
    return _quad(size_m, picture, texels_per_m, place)


def _table(config: SceneConfig, rng: np.random.Generator) -> PaintedMesh:
    size = (2 * TABLE_HALF_M[0], 2 * TABLE_HALF_M[1], TABLE_THICKNESS_M)
    solid, scale = box(*size), 1100.0
    draw = {"wood": textures.wood, "speckled": textures.speckled, "plain": textures.faint}[config.table]
    pictures = []
    for chart in solid.charts:
        h, w = max(2, int(np.ceil(chart.height_m * scale))), max(2, int(np.ceil(chart.width_m * scale)))
        top = chart.object_from_chart is not None and chart.object_from_chart.rotation[2, 2] < -0.9
        pictures.append(draw(rng, h, w) if top else np.full((h, w, 3), 0.1, np.float32))
    lowered = solid.vertices_m - [0.0, 0.0, TABLE_THICKNESS_M / 2]
    moved = Solid(lowered, solid.faces, solid.charts, solid.face_chart, solid.corner_uv_m, ())
    return assemble(moved, pictures, scale, Gloss(0.025, 25.0))


def _walls(facing: Float[Array, "2"], rng: np.random.Generator) -> list[PaintedMesh]:
    found = []
    for turn in (0.0, 90.0, 180.0, 270.0):
        place = _standing(facing, turn, WALL_DISTANCE_M, 0.0, 0.6)
        found.append(_flat(rng, "wall", (2 * WALL_DISTANCE_M + 1.0, 2.8), place, 120.0))
        for _ in range(4):
            across, up = rng.uniform(-1.2, 1.2), rng.uniform(0.1, 1.3)
            poster = _standing(facing, turn, WALL_DISTANCE_M - rng.uniform(0.01, 0.03), across, up)
            found.append(_flat(rng, "poster", (rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.6)), poster, 400.0))
    return found


def _standing(facing: Float[Array, "2"], turn_deg: float, distance: float, across: float, up: float) -> Transform:
    angle = np.arctan2(facing[1], facing[0]) + np.deg2rad(turn_deg)
    into = np.array([np.cos(angle), np.sin(angle), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    right = np.cross(down, into)
    return Transform("world", "sheet", np.stack([right, down, into], 1), distance * into + across * right - up * down)


def _clutter(facing: Float[Array, "2"], rng: np.random.Generator) -> list[PaintedMesh]:
    """Boxes at the far corners of the table and behind it."""
    found = []
    angle = np.arctan2(facing[1], facing[0])
    for _ in range(4):
        turn = angle + rng.choice([-1, 1]) * rng.uniform(0.45, 0.75)
        reach = rng.uniform(0.62, 0.72)
        size = rng.uniform(0.05, 0.14, 3)
        found.append(_standing_box(rng, size, (reach * np.cos(turn), reach * np.sin(turn), 0.0)))
    for _ in range(2):
        turn, size = angle + rng.uniform(-0.6, 0.6), np.array([0.2, 0.2, rng.uniform(0.8, 1.3)])
        found.append(_standing_box(rng, size, (1.35 * np.cos(turn), 1.35 * np.sin(turn), FLOOR_M)))
    return found


def _standing_box(rng: np.random.Generator, size_m: Array, foot_m: tuple[float, float, float]) -> PaintedMesh:
    solid, scale, turn = box(*size_m), 400.0, rng.uniform(0, np.pi)
    pictures = [
        textures.rich(rng, max(4, int(np.ceil(c.height_m * scale))), max(4, int(np.ceil(c.width_m * scale))))
        for c in solid.charts
    ]
    spin = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    vertices = solid.vertices_m @ spin.T + foot_m + np.array([0, 0, size_m[2] / 2])
    moved = Solid(vertices, solid.faces, solid.charts, solid.face_chart, solid.corner_uv_m, ())
    return assemble(moved, pictures, scale, Gloss())
