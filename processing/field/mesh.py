"""The field's surface as a watertight mesh with colours and a mark on what no view saw."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array
from scipy import ndimage
from skimage.measure import marching_cubes

from processing.field.fuse import Grid
from processing.field.network import ObjectField
from recordings.errors import BadInput
from recordings.tracks import ObjectShape


def extract_mesh(field: ObjectField, grid: Grid, object_frame: str = "object", source: str = "field") -> ObjectShape:
    """Marching cubes at zero on the warm start's grid, without small pieces beside it, colours from the field.

    Raises BadInput when the field has no surface.
    """
    sdf_m = _evaluate(field, grid)
    vertices_m, faces = surface_of(sdf_m, grid)
    return ObjectShape(object_frame, source, vertices_m, faces, _colors(field, vertices_m), _observed(grid, vertices_m))


def grid_mesh(grid: Grid, object_frame: str = "object", source: str = "fused") -> ObjectShape:
    """The fused grid's surface and colours, without the network."""
    vertices_m, faces = surface_of(grid.sdf_m, grid)
    rgb = (grid.rgb[_cells_of(grid, vertices_m)].clip(0, 1) * 255).round().astype(np.uint8)
    return ObjectShape(object_frame, source, vertices_m, faces, rgb, _observed(grid, vertices_m))


def surface_of(sdf_m: Float32[Array, "a b c"], grid: Grid) -> tuple[Float[Array, "v 3"], Array]:
    """Vertices in metres and outward-facing triangles of the solid that was seen most, and of others seen as well: a
    hand may hide what joins them, or a thin part is lost. A border of empty cells closes them."""
    solid, count = ndimage.label(sdf_m < 0)
    if count == 0:
        raise BadInput("the field has no inside, so no surface: the views see too little of the object")
    kept = _pieces(solid, count, grid)[solid]
    cleaned = np.where((sdf_m < 0) & ~kept, grid.voxel_m, sdf_m)
    cleaned = np.where(ndimage.binary_dilation(kept), cleaned, np.maximum(cleaned, 0.1 * grid.voxel_m))
    cleaned = _fill_cavities(cleaned, grid.voxel_m)
    least = np.float32(LEAST_SHARE * grid.voxel_m)
    cleaned = np.where(np.abs(cleaned) < least, np.where(cleaned < 0, -least, least), cleaned)
    padded = np.pad(cleaned, 1, constant_values=grid.truncation_m)
    vertices, faces, _, _ = marching_cubes(padded, 0.0)
    return grid.points(vertices.astype(np.float64) - 1), faces.astype(np.int64)


PIECE_SHARE = 0.05
"""Of the main solid's volume: a smaller one beside it is a crumb."""
PIECE_SEEN = 0.25
"""Of the views that the main solid's surface was seen in: where fewer saw another one, it is no part of the object but
what masks let through, or nothing that was seen at all."""
LEAST_SHARE = 1e-3
"""Of a cell's edge: a surface nearer to a cell's corner is moved away that far, because triangles that meet in the
corner would have no area."""


def _pieces(solid: Int[Array, "a b c"], count: int, grid: Grid) -> Bool[Array, " pieces"]:
    """Which of the labelled solids (0: empty) belong to the object."""
    size = np.bincount(solid.ravel(), minlength=count + 1)
    size[0] = 0
    beside = ndimage.maximum_filter(solid, size=3)[grid.weight > 0]
    weight = np.bincount(beside, weights=grid.weight[grid.weight > 0], minlength=count + 1)
    weight[0] = 0
    usual = weight / np.maximum(np.bincount(beside, minlength=count + 1), 1)
    main = int(np.argmax(weight)) if weight.any() else int(np.argmax(size))
    return np.asarray((size >= PIECE_SHARE * size[main]) & (size > 0) & (usual >= PIECE_SEEN * usual[main]))


def _fill_cavities(sdf_m: Float32[Array, "a b c"], voxel_m: float) -> Float32[Array, "a b c"]:
    """Empty space that is shut in by the solid was never seen by a ray: it is filled."""
    empty, count = ndimage.label(np.pad(sdf_m >= 0, 1, constant_values=True))
    if count <= 1:
        return sdf_m
    shut = (empty != empty[0, 0, 0])[1:-1, 1:-1, 1:-1] & (sdf_m >= 0)
    return np.where(shut, np.float32(-voxel_m), sdf_m)


def _evaluate(field: ObjectField, grid: Grid) -> Float32[Array, "a b c"]:
    """The network's signed distance at every cell near the warm start's surface; elsewhere the warm start."""
    near = np.abs(grid.sdf_m) < 3 * grid.truncation_m
    cells = np.argwhere(near)
    out = grid.sdf_m.copy()
    device = field.low.device
    with torch.no_grad():
        points = torch.tensor(grid.points(cells.astype(np.float64)), dtype=torch.float32, device=device)
        out[near] = torch.cat([field.sdf(part) for part in points.split(200_000)]).cpu().numpy()
    return out


def _colors(field: ObjectField, vertices_m: Float[Array, "v 3"]) -> Array:
    with torch.no_grad():
        points = torch.tensor(vertices_m, dtype=torch.float32, device=field.low.device)
        rgb = torch.cat([field.color(part) for part in points.split(200_000)]).cpu().numpy()
    return (rgb.clip(0, 1) * 255).round().astype(np.uint8)


def _observed(grid: Grid, vertices_m: Float[Array, "v 3"]) -> Bool[Array, " v"]:
    """Whether a vertex lies where views measured a surface."""
    seen = ndimage.maximum_filter((grid.weight > 0).astype(np.uint8), size=3)
    return seen[_cells_of(grid, vertices_m)] > 0


def _cells_of(grid: Grid, vertices_m: Float[Array, "v 3"]) -> tuple[Array, Array, Array]:
    """The grid's cell nearest to each vertex, as an index."""
    cells = np.rint((vertices_m - grid.origin_m) / grid.voxel_m).astype(int).T
    i, j, k = np.clip(cells, 0, np.array(grid.sdf_m.shape)[:, None] - 1)
    return i, j, k
