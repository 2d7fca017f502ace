"""Poses of known points in one camera: a start for the bundle adjustment, both solutions where a plane allows two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from calibration.cameras.poses import inverse_poses
from recordings.errors import BadInput
from recordings.geometry import CameraModel

FLAT = 1e-4
"""Points this near to a plane, as a share of their spread, are flat."""
LEAST_POINTS = 4
LEAST_SHARED = 2
"""Views that two cameras must share to be connected by them."""


def poses_of_points(
    camera: CameraModel, points_m: Float[Array, "n 3"], pixels: Float[Array, "n 2"]
) -> list[tuple[Float[Array, "4 4"], float]]:
    """camera_from_body with its rms in px, best first; two for flat bodies, none where OpenCV finds none."""
    rays = camera.rays(pixels)[:, :2]
    fine = np.isfinite(rays).all(axis=1)
    if fine.sum() < LEAST_POINTS:
        return []
    points, rays = np.ascontiguousarray(points_m[fine]), np.ascontiguousarray(rays[fine])
    flat = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    planar = flat[2] < FLAT * flat[0]
    if not planar and len(points) < 6:
        return []
    try:
        method = cv2.SOLVEPNP_IPPE if planar else cv2.SOLVEPNP_SQPNP
        _, turns, places, _ = cv2.solvePnPGeneric(points, rays, np.eye(3), None, flags=method)
    except cv2.error:
        return []
    found = []
    for turn, place in zip(turns, places):
        turn, place = cv2.solvePnPRefineLM(points, rays, np.eye(3), None, turn, place)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], place.ravel()
        error = rms_px(camera, pose, points_m[fine], pixels[fine])
        if np.isfinite(error) and pose[2, 3] > 0:
            found.append((pose, error))
    return sorted(found, key=lambda f: f[1])


def rms_px(
    camera: CameraModel, pose: Float[Array, "4 4"], points_m: Float[Array, "n 3"], pixels: Float[Array, "n 2"]
) -> float:
    gap = camera.project(points_m @ pose[:3, :3].T + pose[:3, 3]) - pixels
    return float(np.sqrt((gap**2).mean()))


def most_agreed(
    candidates: Sequence[Sequence[Float[Array, "4 4"]]], turn_deg: float = 3.0, shift_m: float = 0.01
) -> tuple[Float[Array, "4 4"], int] | None:
    """The pose that most groups of candidates agree on, averaged over those that do, and how many they are.

    Each group holds the possible poses of one look, of which at most one is right.
    """
    from calibration.cameras.poses import mean_pose

    groups = [g for g, group in enumerate(candidates) for _ in group]
    if not groups:
        return None
    stack, owner = np.array([p for group in candidates for p in group]), np.array(groups)
    near = _near(stack, turn_deg, shift_m)
    support = np.array([len(np.unique(owner[row])) for row in near])
    best = int(support.argmax())
    return mean_pose(list(stack[near[best]])), int(support[best])


def _near(stack: Float[Array, "n 4 4"], turn_deg: float, shift_m: float) -> Array:
    cosine = (np.einsum("aij,bij->ab", stack[:, :3, :3], stack[:, :3, :3]) - 1) / 2
    shift = np.linalg.norm(stack[:, None, :3, 3] - stack[None, :, :3, 3], axis=2)
    return (cosine > np.cos(np.radians(turn_deg))) & (shift < shift_m)


def connected(
    names: Sequence[str], poses: Mapping[str, Sequence[Sequence[Float[Array, "4 4"]]]]
) -> Float[Array, "c 4 4"]:
    """camera_from_rig, the rig being the first camera, by chaining relative poses that many views agree on.

    Raises BadInput naming the cameras that share too few views with the others.
    """
    found = {names[0]: np.eye(4)}
    while len(found) < len(names):
        best: tuple[int, str, Array] | None = None
        for here, there in ((a, b) for a in found for b in names if b not in found):
            relative = [
                [there_pose @ inverse_poses(here_pose) for there_pose in q for here_pose in p]
                for p, q in zip(poses[here], poses[there])
            ]
            agreed = most_agreed([of_view for of_view in relative if of_view], 5.0, 0.05)
            if agreed is not None and (best is None or agreed[1] > best[0]):
                best = (agreed[1], there, agreed[0] @ found[here])
        if best is None or best[0] < LEAST_SHARED:
            cut = [n for n in names if n not in found]
            raise BadInput(
                f"degenerate geometry: {', '.join(cut)} shares no views of the board with {', '.join(found)}, so its "
                "place is undetermined; record views in which both see the board: `toss-record --calibration board`"
            )
        found[best[1]] = best[2]
    return np.array([found[n] for n in names])
