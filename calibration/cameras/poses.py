"""Stacks of 4x4 poses: exponential and logarithm in the order (rotation vector, translation), inverses, means."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation


def exp_poses(numbers: Float[Array, "n 6"]) -> Float[Array, "n 4 4"]:
    """Poses with rotation exp(w) and translation t of rows (w, t): a rotation vector beside a translation."""
    out = np.tile(np.eye(4), (len(numbers), 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(numbers[:, :3]).as_matrix()
    out[:, :3, 3] = numbers[:, 3:]
    return out


def log_poses(poses: Float[Array, "n 4 4"]) -> Float[Array, "n 6"]:
    """Undoes exp_poses."""
    return np.hstack([Rotation.from_matrix(poses[:, :3, :3]).as_rotvec(), poses[:, :3, 3]])


def inverse_poses(poses: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    """Of rigid motions (R, t): (R', -R' t)."""
    out = np.zeros_like(poses)
    turned = np.swapaxes(poses[..., :3, :3], -1, -2)
    out[..., :3, :3] = turned
    out[..., :3, 3] = -(turned @ poses[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def mean_pose(poses: Sequence[Float[Array, "4 4"]], keep: float = 0.7) -> Float[Array, "4 4"]:
    """Mean of poses after the ones farthest from the median pose are left out."""
    stack = np.array(poses)
    middle = stack[_most_central(stack)]
    gaps = log_poses(inverse_poses(middle)[None] @ stack)
    far = np.linalg.norm(gaps[:, :3], axis=1) + np.linalg.norm(gaps[:, 3:], axis=1) / 0.3
    chosen = stack[np.argsort(far)[: max(1, round(keep * len(stack)))]]
    out = np.eye(4)
    out[:3, :3] = Rotation.from_matrix(chosen[:, :3, :3]).mean().as_matrix()
    out[:3, 3] = chosen[:, :3, 3].mean(axis=0)
    return out


def _most_central(stack: Float[Array, "n 4 4"]) -> int:
    turns, places = stack[:, :3, :3], stack[:, :3, 3]
    distance = np.linalg.norm(turns[:, None] - turns[None], axis=(2, 3)) + 3 * np.linalg.norm(
        places[:, None] - places[None], axis=2
    )
    return int(np.median(distance, axis=1).argmin())


def angle_deg(rotation: Float[Array, "3 3"]) -> float:
    return float(np.degrees(Rotation.from_matrix(rotation).magnitude()))
