"""How much too far the depth camera reports: its view of the table against where the calibration has the table.

A depth that is too large by a factor moves a plane to a parallel one. So a tilt between the two planes is the
calibration's own error. What it does to the distance hangs on the point of the room that the calibration turned about:
none where that is the camera, whose height above the table then is right; the tilt times the table's distance where it
is a point of the table (a board that lay there). Nothing tells which: the scale is taken halfway between.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from processing.segment.background.static_scene import StaticScene, fit_plane
from recordings.geometry import CameraModel, Transform


@dataclass(frozen=True)
class DepthScaleSettings:
    """How far the table and what is known of such cameras are believed."""

    near_table_m: float = 0.03
    """Scene points this near to the calibrated table plane may be the table."""
    least_share: float = 0.05
    """With a smaller share of the image the table is hardly in view."""
    tolerance_m: float = 0.008
    place_m: float = 0.0025
    """Standard deviation of the calibrated way between camera and table, whatever the tilt. The likeliest of .25 to
    6 mm on 800 drawn calibrations that are off by up to 8 mm and 1 degree, half of them turned about the camera, half
    about the table (`tools/bench_depth_scale.py`); twice as much costs .2 nats, half as much .5."""
    sensor_sigma: float = 0.0005
    """Standard deviation of the scale that averaging does not remove (lens, fixed pattern)."""
    among_cameras: float = 0.01
    """Standard deviation of the scale before anything is seen: the D455's data sheet allows 2 %."""


@dataclass(frozen=True)
class TableScale:
    """Reported / calibrated distance of the table, its standard deviation, and the planes' tilt against each other.
    `turned_at_table`, `turned_at_camera`: the same scale were the calibration's tilt about a point of either."""

    scale: float
    sigma: float
    tilt_deg: float
    pixels: int
    turned_at_table: float
    turned_at_camera: float


def table_scale(
    scene: StaticScene, camera: CameraModel, world_from_camera: Transform, settings: DepthScaleSettings
) -> TableScale | None:
    """The depth scale that the table shows; None where the table is hardly seen."""
    s = settings
    near = (scene.table_depth_m > 0) & scene.known & (scene.depth_m > 0)
    near &= np.abs(scene.depth_m - scene.table_depth_m) < s.near_table_m * np.maximum(1.0, scene.table_depth_m)
    if near.mean() < s.least_share:
        return None
    points = (camera.pixel_rays()[near] * scene.depth_m[near][:, None]).astype(np.float64)
    points = points[:: max(1, len(points) // 20_000)]
    plane = fit_plane(points, s.tolerance_m)
    if plane is None:
        return None
    up, height_m = world_from_camera.rotation[2], float(world_from_camera.translation_m[2])
    normal = plane[0] if plane[0] @ up > 0 else -plane[0]
    on_plane = points[np.abs(points @ normal - normal @ points.mean(0)) < 3 * s.tolerance_m]
    tilt_deg = float(np.degrees(np.arccos(np.clip(normal @ up, -1, 1))))
    # things that lie on the table move a mean
    at_table, at_camera = (float(np.median(-(on_plane @ axis)) / height_m) for axis in (up, normal))
    sigma = np.linalg.norm([s.place_m / height_m, (at_table - at_camera) / 2, s.sensor_sigma])
    return TableScale((at_table + at_camera) / 2, float(sigma), tilt_deg, int(near.sum()), at_table, at_camera)


def posterior_scale(scale: float, sigma: float, settings: DepthScaleSettings) -> float:
    """The scale to correct depth by: the mean of its posterior, from an estimate and its standard deviation and from
    how cameras scatter about 1; 1 where nothing tells (NaN)."""
    if not (np.isfinite(scale) and np.isfinite(sigma)):
        return 1.0
    told = settings.among_cameras**2 / (settings.among_cameras**2 + sigma**2)
    return 1.0 + told * (scale - 1.0)


def posterior_sigma(sigma: float | None, settings: DepthScaleSettings) -> float:
    """The standard deviation of that posterior; `sigma`: of the estimate, None where nothing tells."""
    if sigma is None:
        return settings.among_cameras
    return float(settings.among_cameras * sigma / np.hypot(settings.among_cameras, sigma))
