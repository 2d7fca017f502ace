"""The table's plane in the world, from tags on it and from depth, tied together; and the direction of gravity.

A depth camera's scale is off by up to a percent (3 mm at the table), tags know the scale but are few: the plane and the
depth's scale are solved together,

    n . c = d + thickness        for tag corners c (metres, from the calibrated cameras),
    n . (x / s) = d              for depth points x reported s times too far,

with n the unit normal, d the offset and s near 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array
from scipy.optimize import least_squares

from calibration.cameras.bundle import Observations, Scene, Solved, adjust
from calibration.cameras.extrinsics import whitening
from calibration.cameras.pnp import poses_of_points
from calibration.cameras.poses import inverse_poses
from calibration.cameras.targets import TargetView
from calibration.report import Finding, Report, limit
from calibration.time_offset import Path3
from recordings.constants import GRAVITY_M_S2, MAD_TO_SIGMA
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform

GOOD_MM, WORST_MM = 0.5, 2.0
GOOD_DEG, WORST_DEG = 0.1, 0.5
TAGS_PX, WORST_TAGS_PX = 0.8, 3.0
DEPTH_SIGMA_M = 0.0015
"""Of a depth point, with the part that neighbours share."""
DEPTH_POINTS = 400
"""As many depth points count as independent, however many there are."""
SCALE_SIGMA = 0.01
NEAR_M = 0.03
RANSAC_ROUNDS = 200
GRAVITY_DEG = 1.0
LEAST_FLIGHT = 7
FLIGHT_RMS_M = 0.0012
CENTER_SIGMA_M = 0.01
"""Of the centre of mass about the centre of the tags."""


@dataclass(frozen=True, eq=False)
class Plane:
    """n . x = offset in some frame; `std_m` of its height where it was measured, `tilt_std_deg` of its normal."""

    normal: Float[Array, "3"]
    offset_m: float
    std_m: float
    tilt_std_deg: float

    def heights_m(self, points_m: Float[Array, "n 3"]) -> Float[Array, " n"]:
        return points_m @ self.normal - self.offset_m

    def in_frame(self, target_from_source: Transform) -> Plane:
        normal = target_from_source.vectors(self.normal[None])[0]
        offset = self.offset_m + float(normal @ target_from_source.translation_m)
        return Plane(normal, offset, self.std_m, self.tilt_std_deg)


def place_world(
    models: Mapping[str, CameraModel],
    camera_from_rig: Mapping[str, Float[Array, "4 4"]],
    views: Mapping[str, TargetView],
) -> Solved:
    """rig_from_world from the table's tags at their given places (points of the views are in the world), seen by
    calibrated cameras. Raises BadInput where no camera sees enough of them."""
    names = tuple(n for n in models if n in views and len(views[n]) >= 4 and n in camera_from_rig)
    starts = [
        (len(views[n]), inverse_poses(camera_from_rig[n]) @ found[0][0])
        for n in names
        if (found := poses_of_points(models[n], views[n].points_m, views[n].pixels))
    ]
    if not starts:
        raise BadInput("no camera sees a tag on the table; clear the view, or give `table_tags` in calibration.json")
    start = max(starts, key=lambda s: s[0])[1]
    counts = [len(views[n]) for n in names]
    zeros = np.zeros(sum(counts), dtype=np.int64)
    seen = Observations(
        np.repeat(np.arange(len(names)), counts),
        zeros,
        zeros,
        np.concatenate([views[n].points_m for n in names]),
        np.concatenate([views[n].pixels for n in names]),
        whitening(np.concatenate([views[n].covariance_px2 for n in names])),
    )
    no = np.zeros(len(names), dtype=bool)
    one, off = np.eye(4)[None], np.zeros(1, dtype=bool)
    cameras = np.array([camera_from_rig[n] for n in names])
    scene = Scene(
        tuple(models[n] for n in names), cameras, start[None], one, no, np.ones(1, dtype=bool), off, no, np.ones(1), off
    )
    return adjust(scene, seen)


def fit_table(
    tags: tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]] | None,
    depth_points_m: Float[Array, "m 3"] | None,
    tag_height_m: float = 0.0,
) -> tuple[Plane, float | None, dict[str, float]]:
    """Plane (normal towards the camera), depth scale, and residuals, in the D455's frame.

    `tags`: points on the tags' surface with covariances; `tag_height_m`: how far they lie above the table (paper).
    """
    if tags is None and depth_points_m is None:
        raise BadInput("neither tags on the table nor depth of it: the plane cannot be found")
    start = _start(tags, depth_points_m)
    depth = depth_points_m
    tie = tags is not None and depth is not None
    frame = _axes(start)
    middle = np.median(depth if depth is not None else np.asarray(tags[0] if tags else ()), axis=0)
    origin = middle - start.normal * (start.normal @ middle - start.offset_m)
    fit = least_squares(_residuals, np.zeros(4), x_scale="jac", args=(frame, origin, tags, depth, tag_height_m, tie))
    numbers = fit.x
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac, hermitian=True)
    normal, offset = _plane(numbers, frame, origin)
    plane = Plane(
        normal,
        offset,
        float(np.sqrt(covariance[2, 2])),
        float(np.degrees(np.sqrt(covariance[0, 0] + covariance[1, 1]))),
    )
    scale = 1.0 + float(numbers[3]) if tie else None
    return plane, scale, _left_over(plane, scale, tags, depth, tag_height_m)


def _start(tags: tuple[Array, Array] | None, depth: Array | None) -> Plane:
    points = depth if depth is not None else (tags[0] if tags is not None else np.zeros((0, 3)))
    center = np.median(points, axis=0)
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    normal = normal if normal @ center < 0 else -normal
    return Plane(normal, float(normal @ center), 0.0, 0.0)


def _axes(plane: Plane) -> Float[Array, "3 3"]:
    """Columns: two directions in the plane, and its normal."""
    first = np.cross(plane.normal, np.eye(3)[np.abs(plane.normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(plane.normal, first), plane.normal], -1)


def _plane(numbers: Array, frame: Array, origin: Array) -> tuple[Array, float]:
    """Two tilts and a height about the origin."""
    normal = frame[:, 2] + numbers[0] * frame[:, 0] + numbers[1] * frame[:, 1]
    normal = normal / np.linalg.norm(normal)
    return normal, float(normal @ origin + numbers[2])


def _residuals(
    numbers: Array,
    frame: Array,
    origin: Array,
    tags: tuple[Array, Array] | None,
    depth: Array | None,
    tag_height_m: float,
    tie: bool,
) -> Array:
    """In standard deviations: of the scale from 1, of the tags' and of depth's heights over the plane."""
    normal, offset = _plane(numbers, frame, origin)
    parts = [numbers[3:] / SCALE_SIGMA]
    if tags is not None:
        sigma = np.sqrt(np.einsum("i,nij,j->n", frame[:, 2], tags[1], frame[:, 2]) + 1e-10)
        parts.append((tags[0] @ normal - offset - tag_height_m) / sigma)
    if depth is not None:
        scale = 1.0 + numbers[3] if tie else 1.0
        weight = min(1.0, np.sqrt(DEPTH_POINTS / len(depth))) / DEPTH_SIGMA_M
        parts.append((depth @ normal / scale - offset) * weight)
    return np.concatenate(parts)


def _left_over(
    plane: Plane, scale: float | None, tags: tuple[Array, Array] | None, depth: Array | None, tag_height_m: float
) -> dict[str, float]:
    out = {}
    if tags is not None:
        out["tags_rms_mm"] = 1e3 * float(np.sqrt(((plane.heights_m(tags[0]) - tag_height_m) ** 2).mean()))
    if depth is not None:
        heights = plane.heights_m(depth / (scale or 1.0))
        out["depth_spread_mm"] = 1e3 * MAD_TO_SIGMA * float(np.median(np.abs(heights - np.median(heights))))
        if tags is not None:
            raw = plane.heights_m(depth)
            out["depth_before_scaling_mm"] = 1e3 * float(np.median(raw))
    return out


def table_points(
    depth_m: Float32[Array, "h w"], camera: CameraModel, near: Plane | None, seed: int = 0
) -> Float[Array, "m 3"]:
    """Depth points on the table: those near a first plane (given, or found by RANSAC as the largest), after three
    rounds of fitting and leaving out what sticks out of it."""
    step = max(1, int(np.sqrt(depth_m.size / 40_000)))
    v, u = np.mgrid[0 : depth_m.shape[0] : step, 0 : depth_m.shape[1] : step]
    z = depth_m[v, u].ravel().astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], -1)[z > 0].astype(np.float64)
    points = camera.back_project(pixels, z[z > 0])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 100:
        raise BadInput("the depth image shows hardly anything; wanted a view of the table")
    plane = near or _ransac(points, np.random.default_rng(seed))
    width = NEAR_M
    for _ in range(4):
        heights = plane.heights_m(points)
        close = points[np.abs(heights - np.median(heights[np.abs(heights) < width])) < width]
        if len(close) < 100:
            raise BadInput("no table in the depth image where the calibration says it is; run `toss-calibrate cameras`")
        plane = _start(None, close)
        width = max(3.0 * MAD_TO_SIGMA * float(np.median(np.abs(plane.heights_m(close)))), 0.003)
    return close


def _ransac(points: Float[Array, "n 3"], rng: np.random.Generator) -> Plane:
    best, most = None, -1
    for _ in range(RANSAC_ROUNDS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-6:
            continue
        normal = normal / length * (-1 if normal @ a > 0 else 1)
        count = int((np.abs(points @ normal - normal @ a) < 0.006).sum())
        if count > most:
            best, most = Plane(normal, float(normal @ a), 0.0, 0.0), count
    if best is None:
        raise BadInput("the depth image has no plane in it; wanted a view of the table")
    return best


@dataclass(frozen=True)
class Gravity:
    """Downward direction in the trajectory's frame, its deviation, and the size of the acceleration."""

    down: Float[Array, "3"]
    std_deg: float
    size_m_s2: float
    frames: int


def gravity_from_flight(trajectory: Path3, flight: slice) -> Gravity:
    """From positions in free flight, p + R c = a + v t + g t^2 / 2: with rotations the centre of mass c of the body is
    found too, within a centimetre or so of the tracked point. Raises BadInput for too short a flight."""
    found, left = _ballistic(trajectory, flight)
    acceleration, size = found[6:9], float(np.linalg.norm(found[6:9]))
    spare = max(1, left.size - 9)
    A = _ballistic_matrix(trajectory, flight)
    covariance = float((left**2).sum()) / spare * np.linalg.pinv(A.T @ A)[6:9, 6:9]
    across = np.eye(3) - np.outer(acceleration, acceleration) / size**2
    std = float(np.sqrt(np.trace(across @ covariance @ across))) / size
    return Gravity(acceleration / size, float(np.degrees(std)), size, len(left))


def find_flight(trajectory: Path3, release_s: float | None = None) -> slice | None:
    """The longest stretch (after the release, where that is known) that a parabola explains to a millimetre with about
    the right acceleration; None without one."""
    count, best = len(trajectory.time_s), None
    first = 0 if release_s is None else int(np.searchsorted(trajectory.time_s, release_s))
    for start in range(first, count - LEAST_FLIGHT):
        for stop in range(count, start + LEAST_FLIGHT, -1):
            if best is not None and stop - start <= best.stop - best.start:
                break
            found, left = _ballistic(trajectory, slice(start, stop))
            right_size = 0.8 < np.linalg.norm(found[6:9]) / GRAVITY_M_S2 < 1.2
            if right_size and np.sqrt((left**2).mean()) < FLIGHT_RMS_M:
                best = slice(start, stop)
                break
    return best


def _ballistic(trajectory: Path3, flight: slice) -> tuple[Array, Float[Array, "n 3"]]:
    count = len(trajectory.time_s[flight])
    if count < LEAST_FLIGHT:
        raise BadInput(f"{count} frames of free flight; wanted {LEAST_FLIGHT} or more")
    A, places = _ballistic_matrix(trajectory, flight), trajectory.position_m[flight].ravel()
    places = np.concatenate([places, np.zeros(len(A) - len(places))])
    found = np.linalg.lstsq(A, places, rcond=None)[0]
    return found, (places - A @ found)[: 3 * count].reshape(-1, 3)


def _ballistic_matrix(trajectory: Path3, flight: slice) -> Float[Array, "m k"]:
    """Columns a, v, g, and c where rotations are known, with rows that hold c near the tracked point."""
    t = trajectory.time_s[flight] - trajectory.time_s[flight].mean()
    parts = [np.kron(factor[:, None], np.eye(3)) for factor in (np.ones_like(t), t, 0.5 * t * t)]
    if trajectory.rotation is not None:
        parts.append(-trajectory.rotation[flight].reshape(-1, 3))
        near = np.hstack([np.zeros((3, 9)), FLIGHT_RMS_M / CENTER_SIGMA_M * np.eye(3)])
        return np.vstack([np.hstack(parts), near])
    return np.hstack(parts)


def judge_table(
    plane_world: Plane,
    residuals: Mapping[str, float],
    hold_out: Mapping[str, float],
    tags_px: float | None,
    depth_scale: float | None,
    gravity: Sequence[Gravity],
) -> Report:
    """Verdict on a plane in the world: its deviation, the tags' fit, agreement with depth and with free fall."""
    findings = limit(1e3 * plane_world.std_m, "the standard deviation of the table's height", "mm", GOOD_MM, WORST_MM)
    findings += limit(plane_world.tilt_std_deg, "the standard deviation of its tilt", "deg", GOOD_DEG, WORST_DEG)
    if tags_px is None:
        text = "no tags on the table: depth alone may be off by 3 mm (half a percent of its distance)"
        findings.append(Finding("warning", f"{text}; put two or more tags on the table"))
    else:
        findings += limit(tags_px, "the residual of the table's tags", "px", TAGS_PX, WORST_TAGS_PX)
    if depth_scale is not None and abs(depth_scale - 1) > 0.002:
        findings.append(Finding("note", f"depth reads {100 * (depth_scale - 1):+.2f} % too far, by the table's tags"))
    for name, figure in hold_out.items():
        if name.endswith("_mm"):
            findings += limit(figure, f"the table's {name[:-3].replace('_', ' ')}", "mm", GOOD_MM, 2 * WORST_MM)
    details: dict[str, float] = {}
    if gravity:
        down = np.mean([g.down for g in gravity], axis=0)
        down /= np.linalg.norm(down)
        tilt = float(np.degrees(np.arccos(np.clip(-down @ plane_world.normal, -1, 1))))
        std = float(1 / np.sqrt(sum(1 / max(g.std_deg, 1e-3) ** 2 for g in gravity)))
        size = float(np.median([g.size_m_s2 for g in gravity]))
        details = {"gravity_tilt_deg": tilt, "gravity_tilt_std_deg": std, "gravity_m_s2": size}
        if tilt > GRAVITY_DEG + 3 * std:
            findings.append(Finding("warning", f"gravity is {tilt:.2f} deg off the table's normal: it is not level"))
        if abs(size / GRAVITY_M_S2 - 1) > 0.03 + 3 * np.radians(std):
            off = 100 * (size / GRAVITY_M_S2 - 1)
            findings.append(
                Finding("warning", f"things fall with {size:.2f} m/s^2: lengths or times are off by {off:+.1f} %")
            )
    return Report(
        "table",
        dict(residuals) | ({"tags_rms_px": tags_px} if tags_px is not None else {}),
        hold_out,
        {"height_mm": 1e3 * plane_world.std_m, "tilt_deg": plane_world.tilt_std_deg},
        tuple(findings),
        ({"depth_scale": depth_scale} if depth_scale is not None else {}) | details,
    )
