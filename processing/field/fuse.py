"""Fusing views into a signed-distance grid: the field's warm start, and by itself the classical baseline.

Positive outside, negative inside, metres. Every depth pixel stands for its local plane, so that a slanted surface is
not biased along the ray (projective distance would be). Curless and Levoy 1996 with point-to-plane distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

from processing.engine.parts import in_parts, side_by_side
from processing.field.outline import moved_out
from processing.field.views import FieldView, object_box
from recordings.tracks import ObjectShape

PART = 8
"""Layers of the grid that are fused in one part of the work."""
BEHIND_FULL = np.float32(0.3)
"""Cells further behind a surface than this share of the truncation count less and less: near an edge they belong to
another face (weighed fully they bulge it out; weighed down from the surface on, noisy poses shrink the object)."""

SEEN_BEHIND = 0.04
"""A cell that depth calls inside is unseen all the same where fewer than this share of the views say so: near an edge
it only lies behind another face, and its own was in view of none."""
LEAST_SEEN = 0.5
"""A cell that fewer sure views have looked at is unseen: what guesses alone show is a guess."""
OFF_MASK = 0.2
"""An unseen cell is empty where more than this share of the views sees it beside the mask."""


@dataclass(frozen=True)
class FuseConfig:
    voxel_m: float = 0.0015
    """Edge of a cell; raised where the object is so large that the grid would exceed `most_cells`."""
    truncation_m: float = 0.008
    """Half width of the band around a measured surface in which it counts."""
    most_cells: int = 6_000_000
    """Largest number of cells of the grid."""
    border_m: float = 0.012
    """Empty space kept around the measured points."""


@dataclass(frozen=True, eq=False)
class Grid:
    """A signed-distance grid in the object frame: `sdf_m[i, j, k]` at `origin_m + voxel_m * (i, j, k)`.

    `weight` is 0 where too few views saw a surface or free space; `free` marks cells that rays passed through, or that
    lie beside the masks where no depth tells;
    `rgb` (0..1) is the mean colour of the surface nearest to a cell, 0 where nothing was seen near it.
    """

    origin_m: Float[Array, "3"]
    voxel_m: float
    truncation_m: float
    sdf_m: Float32[Array, "a b c"]
    weight: Float32[Array, "a b c"]
    free: Bool[Array, "a b c"]
    rgb: Float32[Array, "a b c 3"]

    def points(self, cells: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        return self.origin_m + self.voxel_m * cells


def fuse(views: Sequence[FieldView], config: FuseConfig, prior_shape: ObjectShape | None = None) -> Grid:
    """Average the views' signed distances on a grid round the object and complete what no view saw: by the shape that
    is known so far (in the views' object frame), or by the hull of what was seen.

    Raises BadInput when the views hold too few depth points.
    """
    low, high = object_box(views)
    if prior_shape is not None:
        low, high = np.minimum(low, prior_shape.vertices_m.min(0)), np.maximum(high, prior_shape.vertices_m.max(0))
    low, high = low - config.border_m, high + config.border_m
    voxel_m = max(config.voxel_m, float(np.cbrt(np.prod(high - low) / config.most_cells)))
    shape = tuple(int(n) for n in np.ceil((high - low) / voxel_m).astype(int) + 1)
    total = np.zeros(shape, dtype=np.float32)
    weight = np.zeros(shape, dtype=np.float32)
    passed = np.zeros(shape, dtype=np.float32)
    blocked = np.zeros(shape, dtype=np.float32)
    masked, unmasked = np.zeros(shape, dtype=np.float32), np.zeros(shape, dtype=np.float32)
    paint = np.zeros((*shape, 4), dtype=np.float32)

    def integrate(part: slice) -> None:
        for view in views:
            _integrate(
                *(total[part], weight[part], passed[part], blocked[part], masked[part], unmasked[part], paint[part]),
                part.start,
                low.astype(np.float32),
                np.float32(voxel_m),
                np.float32(config.truncation_m),
                view.camera_from_object_at_depth.astype(np.float32),
                view.K.astype(np.float32),
                view.depth_m,
                view.plane,
                view.outside,
                view.unmasked,
                view.color_rgb,
                view.inside if view.colorless is None else view.inside & ~view.colorless,
                np.float32(view.weight),
            )

    in_parts(integrate, shape[0], PART)
    weight[(total < 0) & (blocked < SEEN_BEHIND * sum(view.weight for view in views))] = 0
    weight[blocked + passed < LEAST_SEEN] = 0
    off_masks = unmasked > np.maximum(2.0, OFF_MASK * (masked + unmasked))
    free = (passed > np.maximum(2.0, 0.2 * blocked)) | (off_masks & (weight == 0))
    sdf_m = np.where(weight > 0, total / np.maximum(weight, 1e-9), 0).astype(np.float32)
    rgb = paint[..., :3] / np.maximum(paint[..., 3:], 1e-9)
    grid = Grid(low, voxel_m, config.truncation_m, sdf_m, weight, free, rgb)
    painted = paint[..., 3] > 0
    if prior_shape is not None:
        return _outlined(_completed_by_prior(grid, prior_shape, painted), views)
    fills = (lambda: complete(grid), lambda: replace(grid, rgb=_nearest_color(rgb, painted)))
    whole, colored = side_by_side(lambda fill: fill(), fills)
    return _outlined(replace(whole, rgb=colored.rgb), views)


def _outlined(grid: Grid, views: Sequence[FieldView]) -> Grid:
    """The grid with its surface where the masks' outlines touch it."""
    return replace(grid, sdf_m=moved_out(grid.sdf_m, grid.origin_m, grid.voxel_m, grid.truncation_m, views))


def _nearest_color(rgb: Float32[Array, "a b c 3"], known: Bool[Array, "a b c"]) -> Float32[Array, "a b c 3"]:
    """Every cell without a colour takes that of the nearest cell that has one."""
    if not known.any():
        return rgb
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return np.ascontiguousarray(rgb[tuple(nearest)])


@numba.njit(cache=True, nogil=True, fastmath=True)
@no_type_check  # numba cannot cache what the tests' type checker wraps
def _integrate(
    total, weight, passed, blocked, masked, unmasked, paint, first, low, voxel, truncation, pose, K, depth, plane,
    outside, off_mask, rgb, colored, share,
):  # fmt: skip
    """One view, by its `share`, into the sums, which begin at layer `first` of the grid. Cells are walked along the
    last axis; all lengths in metres."""
    height, width = depth.shape
    n0, n1, n2 = total.shape
    step0, step1, step2 = pose[0, 2] * voxel, pose[1, 2] * voxel, pose[2, 2] * voxel
    for i in range(n0):
        a = low[0] + voxel * (first + i)
        for j in range(n1):
            b = low[1] + voxel * j
            x = pose[0, 0] * a + pose[0, 1] * b + pose[0, 2] * low[2] + pose[0, 3]
            y = pose[1, 0] * a + pose[1, 1] * b + pose[1, 2] * low[2] + pose[1, 3]
            z = pose[2, 0] * a + pose[2, 1] * b + pose[2, 2] * low[2] + pose[2, 3]
            for k in range(n2):
                if z > 0.05:
                    u = int(np.floor(K[0, 0] * x / z + K[0, 2] + np.float32(0.5)))
                    v = int(np.floor(K[1, 1] * y / z + K[1, 2] + np.float32(0.5)))
                    if 0 <= u < width and 0 <= v < height:
                        d = depth[v, u]
                        if off_mask[v, u]:
                            unmasked[i, j, k] += share
                        else:
                            masked[i, j, k] += share
                        if d > 0:
                            p0, p1, p2 = plane[v, u, 0], plane[v, u, 1], plane[v, u, 2]
                            length = np.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
                            distance = (np.float32(1.0) - p0 * x - p1 * y - p2 * z) / length
                            gap = d - z
                            if distance > -truncation and gap > -3 * truncation:
                                ray = np.sqrt(x * x + y * y + z * z)
                                facing = d / (length * d * ray)
                                w = share * facing / (d * d * d * d)
                                if distance > truncation:
                                    passed[i, j, k] += share
                                    distance = truncation
                                    w *= np.float32(0.3)
                                else:
                                    blocked[i, j, k] += share
                                    if distance < -BEHIND_FULL * truncation:
                                        w *= (np.float32(1.0) + distance / truncation) / (np.float32(1.0) - BEHIND_FULL)
                                if colored[v, u] and abs(distance) < np.float32(0.6) * truncation:
                                    for c in range(3):
                                        paint[i, j, k, c] += w * facing * rgb[v, u, c] / np.float32(255)
                                    paint[i, j, k, 3] += w * facing
                                total[i, j, k] += w * distance
                                weight[i, j, k] += w
                        elif outside[v, u]:
                            passed[i, j, k] += share
                x += step0
                y += step1
                z += step2


def complete(grid: Grid) -> Grid:
    """Fill what no view saw: solid inside the convex hull of the seen surface, empty outside it or where a ray passed.

    What the object looks like where nobody looked is a guess, and the mesh marks it as unobserved.
    """
    surface = np.argwhere((grid.weight > 0) & (np.abs(grid.sdf_m) < grid.voxel_m) & ~grid.free)
    return _completed(grid, inside_hull(grid.sdf_m.shape, surface))


def _completed_by_prior(grid: Grid, prior_shape: ObjectShape, painted: Bool[Array, "a b c"]) -> Grid:
    """Fill what no view saw with the distances and colours of a shape, but for where a ray passed."""
    unseen = (grid.weight == 0) & ~grid.free
    cells = np.argwhere(unseen)
    distance_m = np.full(grid.sdf_m.shape, np.inf, dtype=np.float32)
    distance_m[unseen] = _signed_distance(prior_shape, grid.points(cells.astype(np.float64)), grid.truncation_m)
    filled = _completed(grid, distance_m < 0)
    close = unseen & (np.abs(distance_m) < grid.truncation_m)
    rgb = grid.rgb.copy()
    if prior_shape.vertex_rgb is not None:
        shown = close & ~painted
        _, nearest = cKDTree(prior_shape.vertices_m).query(grid.points(np.argwhere(shown).astype(np.float64)))
        rgb[shown] = prior_shape.vertex_rgb[nearest] / np.float32(255)
        painted = painted | shown
    return replace(filled, sdf_m=np.where(close, distance_m, filled.sdf_m), rgb=_nearest_color(rgb, painted))


def _signed_distance(shape: ObjectShape, points_m: Float[Array, "n 3"], within_m: float) -> Float32[Array, " n"]:
    """Of points to a closed surface, metres, negative inside; infinite for those further off than `within_m`, for which
    only the side is asked: distances are what takes time."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    corners = shape.vertices_m.astype(np.float32)
    scene.add_triangles(open3d.core.Tensor(corners), open3d.core.Tensor(shape.faces.astype(np.uint32)))
    points = points_m.astype(np.float32)
    inside = scene.compute_occupancy(open3d.core.Tensor(points), nthreads=1).numpy() > 0
    longest = np.linalg.norm(corners[shape.faces] - corners[np.roll(shape.faces, 1, axis=1)], axis=-1).max()
    to_corner, _ = cKDTree(corners).query(points, distance_upper_bound=within_m + longest)
    near = np.isfinite(to_corner)
    distance = np.full(len(points), np.inf, dtype=np.float32)
    distance[near] = scene.compute_distance(open3d.core.Tensor(points[near]), nthreads=1).numpy()
    return np.where(inside, -distance, distance)


def _completed(grid: Grid, unseen_inside: Bool[Array, "a b c"]) -> Grid:
    """The grid with distances everywhere: measured near what views saw, elsewhere to the nearest change of side."""
    seen = (grid.weight > 0) & ~(grid.free & (grid.sdf_m <= 0))
    solid = np.where(seen, grid.sdf_m < 0, unseen_inside & ~seen & ~grid.free)
    distance_m = grid.voxel_m * (ndimage.distance_transform_edt(~solid) - ndimage.distance_transform_edt(solid)).astype(
        np.float32
    )
    distance_m -= np.sign(distance_m) * np.float32(0.5 * grid.voxel_m)
    near = seen & (np.abs(grid.sdf_m) < 0.999 * grid.truncation_m)
    sdf_m = np.where(near, grid.sdf_m, distance_m).astype(np.float32)
    return replace(grid, sdf_m=sdf_m, weight=np.where(seen, grid.weight, 0))


def inside_hull(shape: tuple[int, ...], cells: Int[Array, "n 3"]) -> Bool[Array, "a b c"]:
    """Which cells lie inside the convex hull of given cells (slightly shrunk against outliers)."""
    if len(cells) < 10:
        return np.zeros(shape, dtype=bool)
    try:
        hull = ConvexHull(cells)
    except QhullError:
        return np.zeros(shape, dtype=bool)
    planes = np.unique(np.round(hull.equations, 6), axis=0)
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    lowest, highest = np.zeros(shape[:2]), np.full(shape[:2], shape[2] - 1.0)  # along the last axis
    for a, b, c, offset in planes:
        rest = a * rows + b * columns + offset
        if c > 0:
            highest = np.minimum(highest, -rest / c)
        elif c < 0:
            lowest = np.maximum(lowest, -rest / c)
        else:
            highest = np.where(rest > 0, -1, highest)
    layers = np.arange(shape[2])
    return (layers >= lowest[..., None] - ON_HULL) & (layers <= highest[..., None] + ON_HULL)


ON_HULL = 1e-6
"""Cells: rounding of a cell that lies on the hull itself."""
