"""Where hand-eye begins: X and T of A_i = X B_i T in closed form, from relative motions (Park and Martin
1994; Daniilidis 1999)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation

from calibration.cameras.poses import inverse_poses, log_poses
from recordings.geometry import skew


def best_start(camera_from_board: Float[Array, "n 4 4"], moved: Float[Array, "n 4 4"]) -> tuple[Array, Array]:
    """(camera_from_mount, held_from_board) by Park and by Daniilidis, whichever leaves less."""
    starts = [park(camera_from_board, moved), daniilidis(camera_from_board, moved)]
    return min(starts, key=lambda s: _misfit(camera_from_board, moved, *s))


def _misfit(A: Float[Array, "n 4 4"], B: Float[Array, "n 4 4"], X: Array, T: Array) -> float:
    gap = log_poses(inverse_poses(A) @ (X[None] @ B @ T[None]))
    return float(np.median(np.linalg.norm(gap[:, :3], axis=1) + np.linalg.norm(gap[:, 3:], axis=1)))


def _pairs(A: Float[Array, "n 4 4"], B: Float[Array, "n 4 4"]) -> tuple[Array, Array]:
    """Relative motions a X = X b with X = camera_from_mount: a = A_j A_i^-1, b = B_j B_i^-1, larger turns only."""
    i, j = np.triu_indices(len(A), 1)
    a, b = A[j] @ inverse_poses(A[i]), B[j] @ inverse_poses(B[i])
    turn = np.linalg.norm(Rotation.from_matrix(b[:, :3, :3]).as_rotvec(), axis=1)
    keep = (turn >= 0.5 * np.median(turn)) & (turn < np.radians(170))
    return (a[keep], b[keep]) if keep.sum() >= 3 else (a, b)


def park(A: Float[Array, "n 4 4"], B: Float[Array, "n 4 4"]) -> tuple[Array, Array]:
    """Park and Martin 1994: R = (M^T M)^(-1/2) M^T from rotation vectors, then the translation by least squares."""
    a, b = _pairs(A, B)
    alpha, beta = (Rotation.from_matrix(m[:, :3, :3]).as_rotvec() for m in (a, b))
    M = beta.T @ alpha
    R = _nearest(np.real(np.linalg.pinv(np.asarray(sqrtm(M.T @ M))) @ M.T))
    return _completed(A, B, a, b, R)


def daniilidis(A: Float[Array, "n 4 4"], B: Float[Array, "n 4 4"]) -> tuple[Array, Array]:
    """Daniilidis 1999: rotation and translation together from the null space of screw axes' dual quaternions."""
    a, b = _pairs(A, B)
    qa, da = _dual(a)
    qb, db = _dual(b)
    rows = []
    for p, dp, q, dq in zip(qa, da, qb, db):
        top = np.hstack([(p - q)[1:, None], skew(p[1:] + q[1:]), np.zeros((3, 4))])
        low = np.hstack([(dp - dq)[1:, None], skew(dp[1:] + dq[1:]), (p - q)[1:, None], skew(p[1:] + q[1:])])
        rows += [top, low]
    _, _, vt = np.linalg.svd(np.vstack(rows))
    u1, v1, u2, v2 = vt[6, :4], vt[6, 4:], vt[7, :4], vt[7, 4:]
    real = _real_mix(u1, v1, u2, v2)
    R = Rotation.from_quat(np.roll(real, -1)).as_matrix()
    return _completed(A, B, a, b, R)


def _real_mix(u1: Array, v1: Array, u2: Array, v2: Array) -> Float[Array, "4"]:
    """The unit combination s1 (u1, v1) + s2 (u2, v2) that is a dual quaternion: u . v = 0, |u| = 1."""
    coefficients = [u1 @ v1, u1 @ v2 + u2 @ v1, u2 @ v2]
    best, found = -1.0, u2
    for s in np.real(np.roots(coefficients)) if abs(coefficients[0]) > 1e-15 else np.array([0.0]):
        mixed = s * u1 + u2
        if mixed @ mixed > best:
            best, found = float(mixed @ mixed), mixed
    return found / np.linalg.norm(found)


def _dual(motions: Float[Array, "n 4 4"]) -> tuple[Array, Array]:
    """Unit quaternions wxyz with w >= 0 and their dual parts 0.5 (0, t) q."""
    q = np.roll(Rotation.from_matrix(motions[:, :3, :3]).as_quat(canonical=True), 1, axis=1)
    t = motions[:, :3, 3]
    dual = 0.5 * np.column_stack([-np.einsum("ij,ij->i", t, q[:, 1:]), q[:, :1] * t + np.cross(t, q[:, 1:])])
    return q, dual


def _completed(A: Array, B: Array, a: Array, b: Array, R: Array) -> tuple[Array, Array]:
    """The translation of X from (R_a - 1) t = R t_b - t_a, and T as the mean of (X B_i)^-1 A_i."""
    left = (a[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (b[:, :3, 3] @ R.T - a[:, :3, 3]).reshape(-1)
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R, np.linalg.lstsq(left, right, rcond=None)[0]
    held = inverse_poses(X[None] @ B) @ A
    T = np.eye(4)
    T[:3, :3] = Rotation.from_matrix(held[:, :3, :3]).mean().as_matrix()
    T[:3, 3] = np.median(held[:, :3, 3], axis=0)
    return X, T


def _nearest(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
