"""Many rigid motions at once: exponential and logarithm of SE(3), vectorised over leading axes.

A tangent vector is (rotation vector in rad, translation in m), acting on the right: T <- T exp(xi), in
the order of GTSAM's Pose3.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation


def skew(v: Float[Array, "*n 3"]) -> Float[Array, "*n 3 3"]:
    """Matrices of the cross product: skew(a) @ b = a x b."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def exp(xi: Float[Array, "n 6"]) -> Float[Array, "n 4 4"]:
    """Rotation by Rodrigues' formula, translation by the left Jacobian of SO(3)."""
    out = np.zeros((len(xi), 4, 4))
    out[:, :3, :3] = Rotation.from_rotvec(xi[:, :3]).as_matrix()
    out[:, :3, 3] = (left_jacobian(xi[:, :3]) @ xi[:, 3:, None])[..., 0]
    out[:, 3, 3] = 1
    return out


def log(poses: Float[Array, "n 4 4"]) -> Float[Array, "n 6"]:
    """The inverse of `exp`, rotation vectors up to pi."""
    w = Rotation.from_matrix(poses[:, :3, :3]).as_rotvec()
    v = np.linalg.solve(left_jacobian(w), poses[:, :3, 3:])[..., 0]
    return np.concatenate([w, v], axis=-1)


def rotations(turns: Float[Array, "*n 3 3"]) -> Float[Array, "*n 4 4"]:
    """Poses with these rotations and no translation."""
    out = np.zeros((*turns.shape[:-2], 4, 4))
    out[..., :3, :3], out[..., 3, 3] = turns, 1.0
    return out


def left_jacobian(w: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """J(w) = I + (1 - cos a)/a^2 [w] + (a - sin a)/a^3 [w]^2 with a = |w|; series near 0."""
    a = np.linalg.norm(w, axis=-1)[:, None, None]
    small = a < 1e-4
    safe = np.where(small, 1.0, a)
    first = np.where(small, 0.5 - a**2 / 24, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6 - a**2 / 120, (safe - np.sin(safe)) / safe**3)
    W = skew(w)
    return np.eye(3) + first * W + second * (W @ W)


def adjoint(poses: Float[Array, "n 4 4"]) -> Float[Array, "n 6 6"]:
    """Ad(T) with T exp(xi) T^-1 = exp(Ad(T) xi), for (rotation, translation) order."""
    R, t = poses[:, :3, :3], poses[:, :3, 3]
    out = np.zeros((len(poses), 6, 6))
    out[:, :3, :3] = R
    out[:, 3:, 3:] = R
    out[:, 3:, :3] = skew(t) @ R
    return out
