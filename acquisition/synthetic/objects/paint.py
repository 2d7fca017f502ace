"""A solid with its charts painted: one atlas picture, texture coordinates, tags, gloss."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from acquisition.synthetic.config import Surface
from acquisition.synthetic.objects import textures
from acquisition.synthetic.objects.solids import Chart, Solid, corner_normals
from recordings.geometry import Transform

TEXELS_PER_M = 2600.0
LARGEST_ATLAS_PX = 2048
PAD_PX = 8
FIRST_OBJECT_TAG = 0
TAG_SHARE = 0.94
"""Of the largest free square of a face, the part that the tag's white border takes."""
SMALLEST_TAG_M = 0.012


@dataclass(frozen=True)
class Gloss:
    """Specular reflection: Fresnel's reflectance at normal incidence and the highlight's sharpness."""

    reflectance: float = 0.02
    exponent: float = 12.0
    mirror: float = 0.0
    """How much of the surroundings is mirrored (1: a polished coat)."""


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """What a renderer needs. `corner_uv_px`: texel positions, texel centres at integers."""

    vertices_m: Float[Array, "v 3"]
    faces: Int[Array, "f 3"]
    corner_uv_px: Float32[Array, "f 3 2"]
    corner_normals: Float32[Array, "f 3 3"]
    atlas: Float32[Array, "h w 3"]
    texels_per_m: float
    gloss: Gloss


@dataclass(frozen=True)
class ObjectTag:
    """An AprilTag on the object: `object_from_tag` has x right, y down, z into the face, origin at the centre."""

    tag_id: int
    size_m: float
    face: str
    object_from_tag: Transform


def paint_object(solid: Solid, surface: Surface, rng: np.random.Generator) -> tuple[PaintedMesh, tuple[ObjectTag, ...]]:
    """Paint every chart of an object in one manner; `tagged` puts a tag on each flat chart with room for one."""
    scale = _texels_per_m(solid)
    base = _base_color(surface, rng)
    pictures: list[Array] = []
    tags: list[ObjectTag] = []
    for number, chart in enumerate(solid.charts):
        width, height = _pixels(chart, scale)
        picture = _picture(surface, rng, height, width, base)
        if surface == "tagged" and chart.object_from_chart is not None:
            tag = _put_tag(solid, number, picture, scale, FIRST_OBJECT_TAG + len(tags), rng)
            tags += [tag] if tag else []
        pictures.append(picture)
    gloss = {"glossy": Gloss(0.05, 250.0, 1.0), "dark": Gloss(0.02, 20.0)}.get(surface, Gloss())
    return assemble(solid, pictures, scale, gloss), tuple(tags)


def assemble(solid: Solid, pictures: list[Array], texels_per_m: float, gloss: Gloss) -> PaintedMesh:
    """Pack one picture per chart into an atlas, each with a margin so that coarse mip levels do not mix them."""
    atlas, corners = pack(pictures)
    uv = solid.corner_uv_m * texels_per_m + corners[solid.face_chart][:, None] - 0.5
    return PaintedMesh(
        solid.vertices_m,
        solid.faces,
        uv.astype(np.float32),
        corner_normals(solid.vertices_m, solid.faces).astype(np.float32),
        atlas,
        texels_per_m,
        gloss,
    )


def pack(pictures: list[Array]) -> tuple[Float32[Array, "h w 3"], Float[Array, "n 2"]]:
    """Shelf packing: the atlas and each picture's top left corner (x, y) in it."""
    padded = [cv2.copyMakeBorder(p, PAD_PX, PAD_PX, PAD_PX, PAD_PX, cv2.BORDER_REPLICATE) for p in pictures]
    width = max(max(p.shape[1] for p in padded), int(1.1 * np.sqrt(sum(p.shape[0] * p.shape[1] for p in padded))))
    corners, x, y, shelf = np.zeros((len(padded), 2)), 0, 0, 0
    for k in sorted(range(len(padded)), key=lambda k: -padded[k].shape[0]):
        high, wide = padded[k].shape[:2]
        if x + wide > width:
            x, y, shelf = 0, y + shelf, 0
        corners[k], x, shelf = (x + PAD_PX, y + PAD_PX), x + wide, max(shelf, high)
    atlas = np.zeros((y + shelf, width, 3), np.float32)
    for p, (left, top) in zip(padded, corners.astype(int) - PAD_PX):
        atlas[top : top + p.shape[0], left : left + p.shape[1]] = p
    return atlas, corners


def _texels_per_m(solid: Solid) -> float:
    area = sum((c.width_m + 0.004) * (c.height_m + 0.004) for c in solid.charts)
    return min(TEXELS_PER_M, 0.85 * LARGEST_ATLAS_PX / float(np.sqrt(area)))


def _pixels(chart: Chart, scale: float) -> tuple[int, int]:
    return max(2, int(np.ceil(chart.width_m * scale))), max(2, int(np.ceil(chart.height_m * scale)))


def _base_color(surface: Surface, rng: np.random.Generator) -> Float32[Array, "3"]:
    if surface == "dark":
        return (0.02 + 0.02 * rng.random(3)).astype(np.float32)
    return textures.color(rng, 0.25, 0.75)


def _picture(
    surface: Surface, rng: np.random.Generator, height: int, width: int, base: Float32[Array, "3"]
) -> Float32[Array, "h w 3"]:
    if surface == "dark":
        return 0.02 + 0.05 * textures.rich(rng, height, width) + textures.plain(rng, height, width, base)
    if surface in ("plain", "glossy"):
        return textures.plain(rng, height, width, base)
    if surface == "few":
        return textures.few(rng, height, width, base)
    return textures.rich(rng, height, width)


def _put_tag(
    solid: Solid, number: int, picture: Array, scale: float, tag_id: int, rng: np.random.Generator
) -> ObjectTag | None:
    chart = solid.charts[number]
    assert chart.object_from_chart is not None
    center_px, free_px = textures.free_square(_covered(solid, number, picture.shape[:2], scale))
    border = (textures.MARKER_MODULES + 2) / textures.MARKER_MODULES
    size_m = TAG_SHARE * free_px / scale / border
    if size_m < SMALLEST_TAG_M:
        return None
    slack_px = (free_px - size_m * border * scale) / 2
    center_px = center_px + rng.uniform(-slack_px, slack_px, 2)
    textures.paint_tag(picture, tag_id, center_px, size_m * scale)
    from_tag = Transform(chart.object_from_chart.source, "tag", np.eye(3), np.append(center_px / scale, 0.0))
    return ObjectTag(tag_id, size_m, chart.name, chart.object_from_chart @ from_tag)


def _covered(solid: Solid, number: int, shape: tuple[int, int], scale: float) -> Bool[Array, "h w"]:
    inside = np.zeros(shape, np.uint8)
    for uv in solid.corner_uv_m[solid.face_chart == number] * scale:
        cv2.fillPoly(inside, [np.round(uv - 0.5).astype(np.int32)], 1)
    return inside > 0
