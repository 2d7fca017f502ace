"""The fused surface moved out to where the masks' outlines touch it.

Depth of all sides of a body, averaged at poses that err, closes in on its middle, and nothing that depth says holds
against it. A ray along a mask's outline touches the body: the least signed distance along it is 0. What it is instead
is measured for every outline, and its mean over the rays that touch near a place is how far the surface there lies
inside. Outwards alone: what a hand or an occluder hides is missing in a mask, while the body fills what it shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import numba
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array
from scipy import ndimage

from processing.field.views import FieldView

RAYS = 150
"""Of a view's outline, evenly along it."""
PRIOR_RAYS = 10.0
"""The surface as it is counts like so many rays that touch it."""
WIDTH = 0.6
"""Standard deviation of the distance over which gaps are averaged, as a share of their reach. Over five generated
sessions (choose-003, 008 and 017, the former judge-013 and 021) .4, .6 and 1 take the mean Chamfer
distance of fused tracks from .311 cm to .288, .256 and .234; but a clean box, whose edges the grid rounds, grows: that
of the shipped sample is .018 cm without, .026 at .6 and .046 at 1."""


def moved_out(
    sdf_m: Float32[Array, "a b c"], origin_m: Float[Array, "3"], voxel_m: float, reach_m: float,
    views: Sequence[FieldView],
) -> Float32[Array, "a b c"]:  # fmt: skip
    """Signed distances (negative inside) on a grid in the object frame, less what the outlines of the views find its
    surface too small by. Gaps larger than `reach_m` are of something else."""
    gap_sum, count = np.zeros(sdf_m.shape, np.float32), np.zeros(sdf_m.shape, np.float32)
    for view in views:
        directions = _outline_rays(view)
        pose = view.camera_from_object_at_depth
        eye = (-pose[:3, :3].T @ pose[:3, 3] - origin_m) / voxel_m
        _add_gaps(sdf_m, eye, directions @ pose[:3, :3], np.float32(reach_m), np.float32(view.weight), gap_sum, count)
    width = WIDTH * reach_m / voxel_m
    peak = (2 * np.pi) ** -1.5 * width**-3
    gap_sum, count = (ndimage.gaussian_filter(a, width, mode="constant") for a in (gap_sum, count))
    return np.asarray(sdf_m - np.maximum(gap_sum / (count + np.float32(PRIOR_RAYS * peak)), 0))


def _outline_rays(view: FieldView) -> Float[Array, "n 3"]:
    """Directions (camera axes) between a pixel of the mask and one beside it that surely is none of it."""
    body = ndimage.binary_dilation(view.inside, np.ones((3, 3))) & ~view.unmasked
    v, u = np.nonzero((body[1:] & view.unmasked[:-1]) | (view.unmasked[1:] & body[:-1]))
    below = np.stack([u, v + 0.5], -1)
    v, u = np.nonzero((body[:, 1:] & view.unmasked[:, :-1]) | (view.unmasked[:, 1:] & body[:, :-1]))
    pixels = np.concatenate([below, np.stack([u + 0.5, v], -1)])
    pixels = pixels[np.unique(np.linspace(0, len(pixels) - 1, RAYS).astype(int))] if len(pixels) else pixels
    x, y = ((pixels[:, a] - view.K[a, 2]) / view.K[a, a] for a in (0, 1))
    return np.stack([x, y, np.ones(len(pixels))], -1)


@numba.njit(cache=True, nogil=True)
@no_type_check  # numba cannot cache what the tests' type checker wraps
def _add_gaps(sdf, eye, directions, reach, share, gap_sum, count):
    """Adds the least distance along each ray, where it is less than `reach`, to the cell where it is. eye, directions:
    in cells."""
    last = np.array([sdf.shape[0] - 1.001, sdf.shape[1] - 1.001, sdf.shape[2] - 1.001])
    for r in range(directions.shape[0]):
        d = directions[r] / np.sqrt((directions[r] ** 2).sum())
        near, far = 0.0, 1e9
        for a in range(3):
            if abs(d[a]) < 1e-12:
                if eye[a] < 0.0 or eye[a] > last[a]:
                    far = -1.0
                continue
            one, two = -eye[a] / d[a], (last[a] - eye[a]) / d[a]
            near, far = max(near, min(one, two)), min(far, max(one, two))
        least, at = 1e9, 0.0
        along = near
        while along <= far:
            value = _between(sdf, eye, d, along, last)
            if value < least:
                least, at = value, along
            along += 1.0
        if abs(least) < reach:
            i = int(min(max(eye[0] + at * d[0], 0.0), last[0]) + 0.5)
            j = int(min(max(eye[1] + at * d[1], 0.0), last[1]) + 0.5)
            k = int(min(max(eye[2] + at * d[2], 0.0), last[2]) + 0.5)
            gap_sum[i, j, k] += share * least
            count[i, j, k] += share


@numba.njit(cache=True, nogil=True, inline="always")
@no_type_check
def _between(sdf, eye, d, along, last):
    """The grid's value (trilinear) so many cells along a ray."""
    x = min(max(eye[0] + along * d[0], 0.0), last[0])
    y = min(max(eye[1] + along * d[1], 0.0), last[1])
    z = min(max(eye[2] + along * d[2], 0.0), last[2])
    i, j, k = int(x), int(y), int(z)
    x, y, z = x - i, y - j, z - k
    value = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                share = (x if a else 1 - x) * (y if b else 1 - y) * (z if c else 1 - z)
                value += share * sdf[i + a, j + b, k + c]
    return value
