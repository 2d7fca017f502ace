"""The inner problem of solver.py, one row after another in compiled code: on a CPU several times faster than batches.

The same Newton iteration with the same line search and the same ends, so that both give the same numbers
(tests/processing/contact/test_solver.py); the batched form stays for CUDA and as the reference. It also knows how
A = J M^-1/2 looks (loss.jacobian): of the last three columns row 3c + a has column 3 + a only.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _projected(tx, ty, n):
    """The nearest point of the Lorentz cone {n >= |t|}."""
    length = (tx * tx + ty * ty) ** 0.5
    if length <= n:
        return tx, ty, n
    if length <= -n:
        return 0.0, 0.0, 0.0
    half = 0.5 * (n + length)
    share = half / length
    return share * tx, share * ty, half


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _hessian(A, y, size, epsilon, H):
    """1 + A' P'(y) A / epsilon, its lower triangle; P' as in solver.project_jacobian. Turns (r), shifts (t) and what is
    between them (s) apart, each entry in a variable of its own: in an array all would be stored for every contact."""
    r11 = r21 = r22 = r31 = r32 = r33 = 0.0
    s11 = s12 = s13 = s21 = s22 = s23 = s31 = s32 = s33 = 0.0
    t11 = t21 = t22 = t31 = t32 = t33 = 0.0
    for c in range(0, size, 3):
        tx, ty, n = y[c], y[c + 1], y[c + 2]
        length = (tx * tx + ty * ty) ** 0.5
        if length <= n:
            d11 = d22 = d33 = 1.0
            d21 = d31 = d32 = 0.0
        elif length <= -n:
            continue
        else:
            over = 1.0 / length
            ux, uy, r = tx * over, ty * over, n * over
            d11, d22, d33 = 0.5 * (1 + r - r * ux * ux), 0.5 * (1 + r - r * uy * uy), 0.5
            d21, d31, d32 = -0.5 * r * ux * uy, 0.5 * ux, 0.5 * uy
        x1, x2, x3 = A[c, 0], A[c, 1], A[c, 2]
        y1, y2, y3 = A[c + 1, 0], A[c + 1, 1], A[c + 1, 2]
        z1, z2, z3 = A[c + 2, 0], A[c + 2, 1], A[c + 2, 2]
        p, q, s = A[c, 3], A[c + 1, 4], A[c + 2, 5]
        u1, u2, u3 = d11 * x1 + d21 * y1 + d31 * z1, d11 * x2 + d21 * y2 + d31 * z2, d11 * x3 + d21 * y3 + d31 * z3
        v1, v2, v3 = d21 * x1 + d22 * y1 + d32 * z1, d21 * x2 + d22 * y2 + d32 * z2, d21 * x3 + d22 * y3 + d32 * z3
        w1, w2, w3 = d31 * x1 + d32 * y1 + d33 * z1, d31 * x2 + d32 * y2 + d33 * z2, d31 * x3 + d32 * y3 + d33 * z3
        r11 += x1 * u1 + y1 * v1 + z1 * w1
        r21 += x2 * u1 + y2 * v1 + z2 * w1
        r22 += x2 * u2 + y2 * v2 + z2 * w2
        r31 += x3 * u1 + y3 * v1 + z3 * w1
        r32 += x3 * u2 + y3 * v2 + z3 * w2
        r33 += x3 * u3 + y3 * v3 + z3 * w3
        s11, s12, s13 = s11 + p * u1, s12 + p * u2, s13 + p * u3
        s21, s22, s23 = s21 + q * v1, s22 + q * v2, s23 + q * v3
        s31, s32, s33 = s31 + s * w1, s32 + s * w2, s33 + s * w3
        t11, t21, t22 = t11 + p * p * d11, t21 + q * p * d21, t22 + q * q * d22
        t31, t32, t33 = t31 + s * p * d31, t32 + s * q * d32, t33 + s * s * d33
    k = 1.0 / epsilon
    H[0, 0], H[1, 0], H[1, 1] = 1 + k * r11, k * r21, 1 + k * r22
    H[2, 0], H[2, 1], H[2, 2] = k * r31, k * r32, 1 + k * r33
    H[3, 0], H[3, 1], H[3, 2], H[3, 3] = k * s11, k * s12, k * s13, 1 + k * t11
    H[4, 0], H[4, 1], H[4, 2], H[4, 3], H[4, 4] = k * s21, k * s22, k * s23, k * t21, 1 + k * t22
    H[5, 0], H[5, 1], H[5, 2] = k * s31, k * s32, k * s33
    H[5, 3], H[5, 4], H[5, 5] = k * t31, k * t32, 1 + k * t33


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _descend(H, gradient, out):
    """-H^-1 gradient, by H = L D L': L's columns times D stay in H's lower triangle, 1 / D on its diagonal."""
    for j in range(6):
        H[j, j] = 1.0 / H[j, j]
        for i in range(j + 1, 6):
            share = H[i, j] * H[j, j]
            for k in range(j + 1, i + 1):
                H[i, k] -= share * H[k, j]
    for i in range(6):
        out[i] = -gradient[i]
    for j in range(6):
        share = out[j] * H[j, j]
        for i in range(j + 1, 6):
            out[i] -= H[i, j] * share
    for i in range(5, -1, -1):
        total = out[i]
        for k in range(i + 1, 6):
            total -= H[k, i] * out[k]
        out[i] = total * H[i, i]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _slope_at(y, Ad, size, length, v, d, epsilon, near, impulse):
    """The slope along d at this length; `near` and `impulse` are y and the impulses there."""
    here, step = 0.0, length / epsilon
    for i in range(6):
        here += d[i] * (v[i] + length * d[i])
    for c in range(0, size, 3):
        tx, ty, n = y[c] - step * Ad[c], y[c + 1] - step * Ad[c + 1], y[c + 2] - step * Ad[c + 2]
        near[c], near[c + 1], near[c + 2] = tx, ty, n
        tx, ty, n = _projected(tx, ty, n)
        impulse[c], impulse[c + 1], impulse[c + 2] = tx, ty, n
        here -= Ad[c] * tx + Ad[c + 1] * ty + Ad[c + 2] * n
    return here


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _step(y, Ad, size, v, d, slope, epsilon, flat_enough, search_steps, near, impulse):
    """Length of the step along d to where the slope has nearly vanished (Illinois form of regula falsi), and y and the
    impulses there in `near` and `impulse`."""
    flat = flat_enough * abs(slope)
    length, low, high, at_low = 1.0, 0.0, 1.0, slope
    at_high = _slope_at(y, Ad, size, length, v, d, epsilon, near, impulse)
    if not at_high > flat:
        return length
    for _ in range(search_steps):
        length = low + (high - low) * min(max(at_low / (at_low - at_high), 0.05), 0.95)
        here = _slope_at(y, Ad, size, length, v, d, epsilon, near, impulse)
        if abs(here) <= flat:
            break
        if here < 0:
            low, at_low, at_high = length, here, 0.5 * at_high
        else:
            high, at_high, at_low = length, here, 0.5 * at_low
    return length


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _outward(A, v, q, size, epsilon, y):
    """y = -(A v + q) / epsilon."""
    for c in range(size // 3):
        for a in range(3):
            i = 3 * c + a
            y[i] = -(q[i] + A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2] + A[i, 3 + a] * v[3 + a]) / epsilon


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _times(A, d, size, Ad):
    """Ad = A d."""
    for c in range(size // 3):
        for a in range(3):
            i = 3 * c + a
            Ad[i] = A[i, 0] * d[0] + A[i, 1] * d[1] + A[i, 2] * d[2] + A[i, 3 + a] * d[3 + a]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def room(most):
    """What `solve_row` works in, for up to `most` entries of q."""
    return np.zeros((3, most)), np.zeros((3, 6)), np.zeros((6, 6))


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_row(A, q, size, epsilon, v, tolerance, most_iterations, flat_enough, search_steps, impulse, work):
    """One row: the first `size` entries of A (3k, 6) and q (3k,); `v` (6,) holds the start and takes the result,
    `impulse` (3k,) the impulses, `work` is a `room`.

    Returns whether it was solved, and the iterations.
    """
    (y, near, Ad), (gradient, d, momentum), H = work
    iterations = 0
    _outward(A, v, q, size, epsilon, y)
    for c in range(0, size, 3):
        impulse[c], impulse[c + 1], impulse[c + 2] = _projected(y[c], y[c + 1], y[c + 2])
    while iterations < most_iterations:
        iterations += 1
        size_of_v = size_of_momentum = size_of_gradient = value = 0.0
        momentum[:] = 0.0
        for c in range(0, size, 3):
            tx, ty, n = impulse[c], impulse[c + 1], impulse[c + 2]
            for j in range(3):
                momentum[j] += A[c, j] * tx + A[c + 1, j] * ty + A[c + 2, j] * n
            momentum[3] += A[c, 3] * tx
            momentum[4] += A[c + 1, 4] * ty
            momentum[5] += A[c + 2, 5] * n
            value += tx * tx + ty * ty + n * n
        for j in range(6):
            gradient[j] = v[j] - momentum[j]
            size_of_v += v[j] * v[j]
            size_of_momentum += momentum[j] * momentum[j]
            size_of_gradient += gradient[j] * gradient[j]
        if size_of_gradient**0.5 <= 1e-14 + tolerance * max(size_of_v, size_of_momentum) ** 0.5:
            return True, iterations
        value = 0.5 * size_of_v + 0.5 * epsilon * value
        _hessian(A, y, size, epsilon, H)
        _descend(H, gradient, d)
        slope = 0.0
        for j in range(6):
            slope += gradient[j] * d[j]
        if -slope <= 1e-13 * value + 1e-22:  # no further fall within rounding
            return True, iterations
        if not np.isfinite(slope):
            return False, iterations
        _times(A, d, size, Ad)
        length = _step(y, Ad, size, v, d, slope, epsilon, flat_enough, search_steps, near, impulse)
        for j in range(6):
            v[j] += length * d[j]
        y, near = near, y
    return False, iterations


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def solve_rows(A, q, epsilon, primal, tolerance, most_iterations, flat_enough, search_steps):
    """Solve every row: A (n, 3k, 6), q (n, 3k); `primal` (n, 6) holds the start and takes the result.

    Returns impulses (n, 3k), whether each row failed, and the most iterations of any.
    """
    n, size = q.shape
    impulses, failed, work = np.zeros((n, size)), np.ones(n, dtype=np.bool_), room(size)
    most = 0
    for r in range(n):
        v, impulse = primal[r], impulses[r]
        solved, iterations = solve_row(
            A[r], q[r], size, epsilon, v, tolerance, most_iterations, flat_enough, search_steps, impulse, work
        )
        failed[r] = not solved
        most = max(most, iterations)
    return impulses, failed, most
