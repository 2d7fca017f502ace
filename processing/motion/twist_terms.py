"""What a residual of a moved point adds to the normal equations of the twist that moves it.

H (6, 6; its lower triangle) and g (6) are of a twist (translation, rotation) of the points in a camera's frame: the
derivative of a point X by it is [1, -[X]x]. Written out entry by entry: the compiler leaves triangular loops as they
are, and these lines run for every point of every pair of views (a track takes a fifth less time than with loops). What
is done once a pair stands in loops all the same: a matrix product this small is mostly its call.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.motion.se3_kernels import adjoint


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def add_residual(J, x, y, z, r, weight, H, g):
    """One residual whose derivative by the point is J[:3]."""
    a0, a1, a2 = J[0], J[1], J[2]
    a3, a4, a5 = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
    w0, w1, w2, w3, w4, w5 = weight * a0, weight * a1, weight * a2, weight * a3, weight * a4, weight * a5
    g[0], g[1], g[2] = g[0] + w0 * r, g[1] + w1 * r, g[2] + w2 * r
    g[3], g[4], g[5] = g[3] + w3 * r, g[4] + w4 * r, g[5] + w5 * r
    H[0, 0] += w0 * a0
    H[1, 0], H[1, 1] = H[1, 0] + w1 * a0, H[1, 1] + w1 * a1
    H[2, 0], H[2, 1], H[2, 2] = H[2, 0] + w2 * a0, H[2, 1] + w2 * a1, H[2, 2] + w2 * a2
    H[3, 0], H[3, 1], H[3, 2], H[3, 3] = H[3, 0] + w3 * a0, H[3, 1] + w3 * a1, H[3, 2] + w3 * a2, H[3, 3] + w3 * a3
    H[4, 0], H[4, 1], H[4, 2] = H[4, 0] + w4 * a0, H[4, 1] + w4 * a1, H[4, 2] + w4 * a2
    H[4, 3], H[4, 4] = H[4, 3] + w4 * a3, H[4, 4] + w4 * a4
    H[5, 0], H[5, 1], H[5, 2] = H[5, 0] + w5 * a0, H[5, 1] + w5 * a1, H[5, 2] + w5 * a2
    H[5, 3], H[5, 4], H[5, 5] = H[5, 3] + w5 * a3, H[5, 4] + w5 * a4, H[5, 5] + w5 * a5


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def add_image_residuals(x, y, z, iz, suu, suv, svv, tu, tv, H, g):
    """All residuals of one point that only ask where it lies in the image. Of their weights w, values r and derivatives
    a, b by the point's x and y come the sums w a a, w a b, w b b, w a r, w b r; that by z is -(a x + b y) / z."""
    u2, u3, u4, u5 = -x * iz, -x * y * iz, z + x * x * iz, -y
    v2, v3, v4, v5 = -y * iz, -y * y * iz - z, x * y * iz, x
    p2, q2 = suu * u2 + suv * v2, suv * u2 + svv * v2
    p3, q3 = suu * u3 + suv * v3, suv * u3 + svv * v3
    p4, q4 = suu * u4 + suv * v4, suv * u4 + svv * v4
    p5, q5 = suu * u5 + suv * v5, suv * u5 + svv * v5
    g[0], g[1], g[2] = g[0] + tu, g[1] + tv, g[2] + tu * u2 + tv * v2
    g[3], g[4], g[5] = g[3] + tu * u3 + tv * v3, g[4] + tu * u4 + tv * v4, g[5] + tu * u5 + tv * v5
    H[0, 0] += suu
    H[1, 0], H[1, 1] = H[1, 0] + suv, H[1, 1] + svv
    H[2, 0], H[2, 1], H[2, 2] = H[2, 0] + p2, H[2, 1] + q2, H[2, 2] + p2 * u2 + q2 * v2
    H[3, 0], H[3, 1] = H[3, 0] + p3, H[3, 1] + q3
    H[3, 2], H[3, 3] = H[3, 2] + p3 * u2 + q3 * v2, H[3, 3] + p3 * u3 + q3 * v3
    H[4, 0], H[4, 1], H[4, 2] = H[4, 0] + p4, H[4, 1] + q4, H[4, 2] + p4 * u2 + q4 * v2
    H[4, 3], H[4, 4] = H[4, 3] + p4 * u3 + q4 * v3, H[4, 4] + p4 * u4 + q4 * v4
    H[5, 0], H[5, 1], H[5, 2] = H[5, 0] + p5, H[5, 1] + q5, H[5, 2] + p5 * u2 + q5 * v2
    H[5, 3], H[5, 4], H[5, 5] = H[5, 3] + p5 * u3 + q5 * v3, H[5, 4] + p5 * u4 + q5 * v4, H[5, 5] + p5 * u5 + q5 * v5


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True, fastmath=True, inline="always")
def add_shading(J, r, weight, K, first, B, N):
    """One residual whose derivative by three more unknowns, from `first` on, is K: J' w K goes into B, K' w K into N
    and r w K into its last row."""
    for a in range(3):
        ka = weight * K[a]
        N[-1, first + a] += ka * r
        for b in range(3):
            N[first + a, first + b] += ka * K[b]
        for b in range(6):
            B[b, first + a] += ka * J[b]


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def add_by_others(H, g, A, weight, weight_g, H_out, g_out):
    """Adds normal equations of a twist to those of the unknowns that it depends on: twist = A (6, n) unknowns.

    H (6, 6) has its lower triangle only, H_out (n, n) both; `weight` of H, `weight_g` of g.
    """
    n = A.shape[1]
    half = np.empty((6, n))
    for a in range(6):
        for b in range(n):
            total = 0.0
            for c in range(6):
                total += (H[a, c] if a >= c else H[c, a]) * A[c, b]
            half[a, b] = weight * total
    for a in range(n):
        for b in range(n):
            total = 0.0
            for c in range(6):
                total += A[c, a] * half[c, b]
            H_out[a, b] += total
        total = 0.0
        for c in range(6):
            total += A[c, a] * g[c]
        g_out[a] += weight_g * total


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def to_object(H, g, pose, sign, H_out, g_out):
    """Adds normal equations of a camera frame to those of the object frame: twist_camera = sign * A twist_object.

    pose: 4x4 camera_from_object. H has its lower triangle only.
    """
    add_by_others(H, g, adjoint(pose), 1.0, sign, H_out, g_out)


@no_type_check
@njit(cache=True, error_model="numpy", nogil=True)
def add_depth(Hd, gd, turn_share, H, g):
    """Adds depth's normal equations (lower triangles): in full as far as a shift of the points answers them, the rest,
    which is of turns, by `turn_share`.

    Where patches of depth err alike they tilt the surface as a turn would, which every pair shows again, while their
    mean over the surface is near zero.
    """
    least = 1e-6 * (Hd[0, 0] + Hd[1, 1] + Hd[2, 2]) + 1e-12
    a, b, c, d, e, f = Hd[0, 0] + least, Hd[1, 1] + least, Hd[2, 2] + least, Hd[1, 0], Hd[2, 0], Hd[2, 1]
    inverse = np.empty((3, 3))
    inverse[0, 0], inverse[1, 1], inverse[2, 2] = b * c - f * f, a * c - e * e, a * b - d * d
    inverse[0, 1] = inverse[1, 0] = e * f - c * d
    inverse[0, 2] = inverse[2, 0] = d * f - b * e
    inverse[1, 2] = inverse[2, 1] = d * e - a * f
    inverse /= a * inverse[0, 0] + d * inverse[0, 1] + e * inverse[0, 2]
    by_shift, shift = np.empty((6, 3)), np.zeros((6, 3))  # shift: the one that looks most like a twist
    for i in range(6):
        for j in range(3):
            by_shift[i, j] = Hd[i, j] if i >= j else Hd[j, i]
        for j in range(3):
            for k in range(3):
                shift[i, j] += by_shift[i, k] * inverse[k, j]
    for i in range(6):
        for j in range(i + 1):
            answered = by_shift[i, 0] * shift[j, 0] + by_shift[i, 1] * shift[j, 1] + by_shift[i, 2] * shift[j, 2]
            H[i, j] += turn_share * Hd[i, j] + (1.0 - turn_share) * answered
        answered = shift[i, 0] * gd[0] + shift[i, 1] * gd[1] + shift[i, 2] * gd[2]
        g[i] += turn_share * gd[i] + (1.0 - turn_share) * answered
