"""Aligning the reprojected shape to the raw depth, frame by frame (the paper's step 5).

The shape moves, the measurement stays: every raw depth pixel on the object is matched to the nearest point of the
shape, and the pose correction minimises the point-to-plane distances with Tukey's weights (Chen and Medioni 1991).
Directions that the visible faces do not constrain stay where they were (Zhang, Kaess and Singh 2016). All in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.motion.tangents import about
from processing.sensor import noise
from recordings.constants import MAD_TO_SIGMA
from recordings.estimation.robust import tukey_weight
from recordings.geometry import CameraModel, skew
from recordings.tracks import ObjectShape

LEAST_SIGMA = (0.002, 0.0003)
"""Radians and metres that a pose is uncertain by at least."""
Verdict = Literal["aligned", "too few points", "poor fit", "moved too far", "lost"]


@dataclass(frozen=True)
class IcpConfig:
    iterations: int = 12
    """Gauss-Newton steps, each with new matches."""
    most_points: int = 1200
    """Raw depth points used of a frame, drawn evenly."""
    border_px: int = 2
    """Depth this near to the mask's outline is fattened or flies: left out."""
    fewest_points: int = 150
    """Below this a frame is rejected: too few points."""
    reach_m: float = 0.015
    """Matches further apart than this are outliers; shrinks to a third over the iterations."""
    least_fitness: float = 0.6
    """Share of the points that must end within a third of `reach_m`, else: poor fit."""
    most_rotation_rad: float = 0.2
    """A larger correction is rejected: moved too far."""
    most_translation_m: float = 0.02
    observable: float = 0.02
    """A direction whose eigenvalue is below this share of the best-constrained one's is not observable."""
    least_noise_m: float = noise.ICP_LEAST_SIGMA_M
    """Depth is never trusted more than this, however well the shape fits."""
    points_per_measurement: float = noise.ICP_POINTS_PER_MEASUREMENT


@dataclass(frozen=True, eq=False)
class Alignment:
    """One frame's result. `camera_from_object` equals the start unless the verdict is `aligned`.

    `fitness`: share of points matched; `rmse_m` of those; `held` counts the directions (of six) not observable.
    """

    camera_from_object: Float[Array, "4 4"]
    verdict: Verdict
    fitness: float
    rmse_m: float
    held: int


class ShapeSurface:
    """Nearest points of a shape and the outward normals there."""

    def __init__(self, shape: ObjectShape) -> None:
        import open3d as o3d

        self._core: Any = o3d.core
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(shape.vertices_m.astype(np.float32)), o3d.core.Tensor(shape.faces.astype(np.uint32))
        )
        self.radius_m = float(np.linalg.norm(shape.vertices_m - shape.vertices_m.mean(0), axis=1).mean())
        self.centre_m = shape.vertices_m.mean(0)

    def nearest(self, points_m: Float[Array, "n 3"]) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        found = self._scene.compute_closest_points(self._core.Tensor(points_m.astype(np.float32)))
        return found["points"].numpy().astype(np.float64), found["primitive_normals"].numpy().astype(np.float64)


def align_frame(
    surface: ShapeSurface,
    points_camera_m: Float[Array, "n 3"],
    camera_from_object: Float[Array, "4 4"],
    config: IcpConfig,
    covariance: Float[Array, "6 6"] | None = None,
) -> Alignment:
    """Move the pose so that the shape lies on the raw points of one frame (n, 3) in the camera frame.

    With the start's `covariance` (rotation vector, translation of the origin, camera axes; rad, m) the result is the
    most probable pose given both: what depth says little about stays with the tracker.
    """
    if not np.isfinite(camera_from_object).all():
        return Alignment(camera_from_object, "lost", 0.0, float("nan"), 6)
    if len(points_camera_m) < config.fewest_points:
        return Alignment(camera_from_object, "too few points", 0.0, float("nan"), 6)
    pose, held = camera_from_object.copy(), 6
    known = _known(surface, camera_from_object, covariance)
    gone = np.zeros(6)  # the correction so far, rotation scaled by the radius
    for step in range(config.iterations):
        reach_m = config.reach_m * max(1 / 3, 1 - step / max(config.iterations - 1, 1))
        in_object, gap, normal, facing = _matches(surface, points_camera_m, pose)
        use = facing & (np.abs(gap) < reach_m)
        arm = in_object - surface.centre_m
        move, held = _solve(arm, gap, normal, use, surface.radius_m, reach_m, config, known, gone)
        gone += np.concatenate([move[:3] * surface.radius_m, move[3:]])
        pose = pose @ about(surface.centre_m, move[:3], move[3:])
        if np.linalg.norm(move[:3]) < 1e-5 and np.linalg.norm(move[3:]) < 1e-6:
            break
    _, gap, _, facing = _matches(surface, points_camera_m, pose)
    near = facing & (np.abs(gap) < config.reach_m / 3)
    fitness = float(near.mean())
    rmse_m = float(np.sqrt((gap[near] ** 2).mean())) if near.any() else float("nan")
    verdict = _judge(camera_from_object, pose, surface.centre_m, fitness, config)
    return Alignment(pose if verdict == "aligned" else camera_from_object, verdict, fitness, rmse_m, held)


def align_frames(
    shape: ObjectShape,
    depths_m: Sequence[Float32[Array, "h w"]],
    masks: Sequence[Bool[Array, "h w"]],
    camera: CameraModel,
    camera_from_object: Float[Array, "n 4 4"],
    config: IcpConfig,
    covariance: Float[Array, "n 6 6"] | None = None,
) -> list[Alignment]:
    """`align_frame` on every frame of a toss; raw depth inside the raw mask is what the shape is laid on."""
    import cv2

    surface = ShapeSurface(shape)
    rays = camera.pixel_rays()
    kernel = np.ones((2 * config.border_px + 1,) * 2, np.uint8)
    out = []
    for i, (depth_m, mask, pose) in enumerate(zip(depths_m, masks, camera_from_object, strict=True)):
        inside = cv2.erode(mask.astype(np.uint8), kernel).astype(bool)
        v, u = np.nonzero(inside & (depth_m > 0))
        every = max(1, len(v) // config.most_points)
        v, u = v[::every], u[::every]
        points = rays[v, u] * depth_m[v, u, None].astype(np.float64)
        out.append(align_frame(surface, points, pose, config, None if covariance is None else covariance[i]))
    return out


def count_verdicts(alignments: Sequence[Alignment]) -> dict[str, int]:
    """How many frames ended with which verdict, for the stage's counts."""
    found: dict[str, int] = {}
    for a in alignments:
        found[a.verdict] = found.get(a.verdict, 0) + 1
    return found


def _matches(
    surface: ShapeSurface, points_camera_m: Float[Array, "n 3"], pose: Float[Array, "4 4"]
) -> tuple[Float[Array, "n 3"], Float[Array, " n"], Float[Array, "n 3"], Bool[Array, " n"]]:
    """Points in the object frame, their signed distance to the matched plane, its normal, and whether that plane
    faces the camera (a point of the far side's noise must not pull on it)."""
    in_object = (points_camera_m - pose[:3, 3]) @ pose[:3, :3]
    nearest, normal = surface.nearest(in_object)
    gap = ((in_object - nearest) * normal).sum(-1)
    towards_camera = -pose[:3, :3].T @ pose[:3, 3] - in_object
    return in_object, gap, normal, (normal * towards_camera).sum(-1) > 0


def _solve(
    arm: Float[Array, "n 3"],
    gap: Float[Array, " n"],
    normal: Float[Array, "n 3"],
    use: Bool[Array, " n"],
    radius_m: float,
    reach_m: float,
    config: IcpConfig,
    known: Float[Array, "6 6"],
    gone: Float[Array, "6"],
) -> tuple[Float[Array, "6"], int]:
    """Correction (rotation vector, shift) of object coordinates about the centre, and how many directions were held.

    `known`: information on the correction from elsewhere, whose part so far is `gone`.

    Rotation is scaled by the object's radius, so that eigenvalues of turning and shifting can be compared.
    """
    if use.sum() < 6:
        return np.zeros(6), 6
    weight = np.where(use, tukey_weight(gap / reach_m), 0.0)
    jacobian = np.concatenate([np.cross(arm, normal) / radius_m, normal], -1)
    noise_m = max(MAD_TO_SIGMA * float(np.median(np.abs(gap[use]))), config.least_noise_m)
    share = 1 / (noise_m**2 * config.points_per_measurement)
    depth = share * (weight[:, None] * jacobian).T @ jacobian
    information = depth + known
    right = share * (weight * gap) @ jacobian - known @ gone
    values, vectors = np.linalg.eigh(information)
    by_depth = np.einsum("ik,ij,jk->k", vectors, depth, vectors)
    seen = by_depth > config.observable * by_depth.max()
    scaled = vectors[:, seen] @ ((vectors[:, seen].T @ right) / values[seen])
    # the points move by -correction in object coordinates when the pose moves by +correction
    return np.concatenate([scaled[:3] / radius_m, scaled[3:]]), int((~seen).sum())


def _known(
    surface: ShapeSurface, camera_from_object: Float[Array, "4 4"], covariance: Float[Array, "6 6"] | None
) -> Float[Array, "6 6"]:
    """A track's covariance as information on a correction about the shape's centre in object axes.

    No pose is surer than LEAST_SIGMA, least of all one that was held fixed so that the others had a frame (covariance
    zero).
    """
    if covariance is None or not np.isfinite(covariance).all():
        return np.zeros((6, 6))
    turn = camera_from_object[:3, :3]
    to = np.zeros((6, 6))
    to[:3, :3] = surface.radius_m * turn.T
    to[3:, :3], to[3:, 3:] = -turn.T @ skew(turn @ surface.centre_m), turn.T
    least = np.diag(np.repeat(LEAST_SIGMA, 3) ** 2)
    return np.asarray(np.linalg.inv(to @ (covariance + least) @ to.T))


def _judge(
    start: Float[Array, "4 4"], end: Float[Array, "4 4"], centre_m: Float[Array, "3"], fitness: float, config: IcpConfig
) -> Verdict:
    if fitness < config.least_fitness:
        return "poor fit"
    cosine = (np.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2
    turned_rad = float(np.arccos(np.clip(cosine, -1, 1)))
    shift = (end[:3, :3] @ centre_m + end[:3, 3]) - (start[:3, :3] @ centre_m + start[:3, 3])
    if turned_rad > config.most_rotation_rad or np.linalg.norm(shift) > config.most_translation_m:
        return "moved too far"
    return "aligned"
