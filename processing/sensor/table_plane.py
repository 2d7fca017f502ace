"""`--table-from-depth`: where the table is, from the depth of the empty scene, for sessions whose calibration does not
say. Gravity is taken to be the plane's normal, which is said in the result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array

from recordings.constants import MAD_TO_SIGMA
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.tracks import RigCalibration

NEAR_M = 0.006
"""A point this near to the plane lies on it."""
TRIALS = 400
LEAST_SHARE = 0.15
"""A table fills at least this share of the pixels with depth."""


def fitted_plane(points_m: Float[Array, "n 3"], seed: int = 0) -> tuple[Float[Array, "3"], float, float]:
    """Unit normal, offset (n . x = offset) and the share of points on the largest plane: RANSAC (Fischler and Bolles
    1981), then least squares of what lies on it."""
    rng = np.random.default_rng(seed)
    best: tuple[int, Float[Array, "3"], float] = (0, np.array([0.0, 0.0, 1.0]), 0.0)
    for _ in range(TRIALS):
        a, b, c = points_m[rng.choice(len(points_m), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-9:
            continue
        normal /= length
        on = int((np.abs(points_m @ normal - a @ normal) < NEAR_M).sum())
        if on > best[0]:
            best = (on, normal, float(a @ normal))
    normal, offset = best[1], best[2]
    for reach in (NEAR_M, NEAR_M, NEAR_M / 2):
        on_it = points_m[np.abs(points_m @ normal - offset) < reach]
        middle = on_it.mean(0)
        normal = np.linalg.svd(on_it - middle, full_matrices=False)[2][2] * 1.0
        offset = float(middle @ normal)
    return normal, offset, float((np.abs(points_m @ normal - offset) < NEAR_M).mean())


def with_table_from_depth(
    calibration: RigCalibration, camera_name: str, depth_m: Float32[Array, "h w"]
) -> tuple[RigCalibration, Mapping[str, Any]]:
    """The calibration with `world` on the plane that the depth of the empty scene shows: z up along its normal towards
    the camera, origin under the middle of the picture. A `world` that is known keeps its axes; the plane is measured
    in it. Also returned: what was found. Raises BadInput where no plane fills enough of the picture.
    """
    camera = calibration.camera(camera_name)
    v, u = np.nonzero(depth_m > 0)
    chosen = np.random.default_rng(0).permutation(len(v))[:20_000]
    points = camera.pixel_rays()[v[chosen], u[chosen]] * depth_m[v[chosen], u[chosen], None].astype(np.float64)
    if len(points) < 500:
        raise BadInput(f"--table-from-depth: only {len(points)} pixels of the empty scene have depth; wanted 500")
    normal, offset, share = fitted_plane(points)
    if share < LEAST_SHARE:
        raise BadInput(
            f"--table-from-depth: the largest plane holds {100 * share:.0f} % of the depth; wanted at least "
            f"{100 * LEAST_SHARE:.0f} %: give the table by `toss-calibrate table SESSION`"
        )
    if offset > 0:  # the normal points to the camera, which lies at the origin
        normal, offset = -normal, -offset
    gap_m = np.abs(points @ normal - offset)
    spread_m = float(MAD_TO_SIGMA * np.median(gap_m[gap_m < NEAR_M]))
    found = {"share": round(share, 3), "spread_m": round(spread_m, 5), "source": "depth of the empty scene"}
    known = calibration.find("world", camera_name)
    if known is None:
        world = _world_on(normal, offset, camera)
        plane = {"normal_world": [0.0, 0.0, 1.0], "offset_m": 0.0}
        calibration = replace(calibration, transforms=(*calibration.transforms, world))
    else:
        up = known.rotation @ normal
        plane = {"normal_world": up.tolist(), "offset_m": offset + float(up @ known.translation_m)}
    residuals = {**calibration.residuals, "table": {**plane, **found, "std_m": spread_m}}
    return replace(calibration, residuals=residuals), found


def _world_on(normal: Float[Array, "3"], offset: float, camera: CameraModel) -> Transform:
    """world_from_camera: z along the plane's normal, x along the picture's, origin where the middle ray lands."""
    ray = np.array([0.0, 0.0, 1.0])
    origin = ray * offset / float(ray @ normal) if abs(float(ray @ normal)) > 1e-3 else normal * offset
    x = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = np.stack([x, np.cross(normal, x), normal], 1)
    camera_from_world[:3, 3] = origin
    return Transform.from_matrix(camera.frame, "world", camera_from_world).inverse()
