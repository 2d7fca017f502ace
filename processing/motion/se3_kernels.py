"""Rigid motions in compiled code: 4x4 poses, and twists in the order (translation, rotation)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@no_type_check
@njit(cache=True, nogil=True)
def inverse(pose):
    out = np.eye(4)
    back = np.ascontiguousarray(pose[:3, :3].T)
    out[:3, :3] = back
    out[:3, 3] = -(back @ np.ascontiguousarray(pose[:3, 3]))
    return out


@no_type_check
@njit(cache=True, nogil=True)
def between(a, b):
    """a @ inverse(b)."""
    out = np.zeros((4, 4))
    for i in range(3):
        out[i, 3] = a[i, 3]
        for j in range(3):
            out[i, j] = a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2]
            out[i, 3] -= out[i, j] * b[j, 3]
    out[3, 3] = 1.0
    return out


@no_type_check
@njit(cache=True, nogil=True)
def exponential(twist):
    """4x4 of a twist (translation, rotation): the translation is taken as it is."""
    out = np.eye(4)
    angle = np.sqrt(twist[3] ** 2 + twist[4] ** 2 + twist[5] ** 2)
    s = 1.0 - angle * angle / 6.0 if angle < 1e-4 else np.sin(angle) / angle
    c = 0.5 - angle * angle / 24.0 if angle < 1e-4 else (1.0 - np.cos(angle)) / (angle * angle)
    K = np.zeros((3, 3))
    K[0, 1], K[0, 2], K[1, 2] = -twist[5], twist[4], -twist[3]
    K[1, 0], K[2, 0], K[2, 1] = twist[5], -twist[4], twist[3]
    out[:3, :3] += s * K + c * (K @ K)
    out[:3, 3] = twist[:3]
    return out


@no_type_check
@njit(cache=True, nogil=True)
def adjoint(pose):
    """The matrix (6, 6) that turns twists of the frame that a pose comes from into those of the frame it leads to."""
    A = np.zeros((6, 6))
    for i in range(3):
        for j in range(3):
            A[i, j] = pose[i, j]
            A[i + 3, j + 3] = pose[i, j]
    t = pose[:3, 3]
    for j in range(3):
        A[0, j + 3] = t[1] * pose[2, j] - t[2] * pose[1, j]
        A[1, j + 3] = t[2] * pose[0, j] - t[0] * pose[2, j]
        A[2, j + 3] = t[0] * pose[1, j] - t[1] * pose[0, j]
    return A
