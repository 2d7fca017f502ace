"""The inner problem of solver.py, one row after another in compiled code: on a CPU several times faster than batches.

The same Newton iteration with the same line search and the same ends, so that both give the same numbers
(tests/processing/contact/test_solver.py); the batched form stays for CUDA and as the reference.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def _project(y, out):
    """Nearest points of the Lorentz cones {y_2 >= |y_01|}."""
    for c in range(len(y) // 3):
        tx, ty, n = y[3 * c], y[3 * c + 1], y[3 * c + 2]
        length = (tx * tx + ty * ty) ** 0.5
        if length <= n:
            out[3 * c], out[3 * c + 1], out[3 * c + 2] = tx, ty, n
        elif length <= -n:
            out[3 * c] = out[3 * c + 1] = out[3 * c + 2] = 0.0
        else:
            half = 0.5 * (n + length)
            out[3 * c], out[3 * c + 1], out[3 * c + 2] = tx * half / length, ty * half / length, half


@njit(cache=True, nogil=True)
@no_type_check
def _hessian(A, y, epsilon, H):
    """1 + A' P'(y) A / epsilon, P' as in solver.project_jacobian."""
    H[:] = 0.0
    D, DA = np.zeros((3, 3)), np.zeros((3, 6))
    for c in range(len(y) // 3):
        tx, ty, n = y[3 * c], y[3 * c + 1], y[3 * c + 2]
        length = (tx * tx + ty * ty) ** 0.5
        if length <= -n and not length <= n:
            continue
        D[:] = 0.0
        if length <= n:
            D[0, 0] = D[1, 1] = D[2, 2] = 1.0
        else:
            ux, uy, r = tx / length, ty / length, n / length
            D[0, 0], D[1, 1], D[2, 2] = 0.5 * (1 + r - r * ux * ux), 0.5 * (1 + r - r * uy * uy), 0.5
            D[0, 1] = D[1, 0] = -0.5 * r * ux * uy
            D[0, 2] = D[2, 0] = 0.5 * ux
            D[1, 2] = D[2, 1] = 0.5 * uy
        for i in range(3):
            for j in range(6):
                DA[i, j] = D[i, 0] * A[3 * c, j] + D[i, 1] * A[3 * c + 1, j] + D[i, 2] * A[3 * c + 2, j]
        for i in range(6):
            for j in range(i + 1):
                H[i, j] += A[3 * c, i] * DA[0, j] + A[3 * c + 1, i] * DA[1, j] + A[3 * c + 2, i] * DA[2, j]
    for i in range(6):
        for j in range(i + 1):
            H[i, j] = H[i, j] / epsilon
        H[i, i] += 1.0


@njit(cache=True, nogil=True)
@no_type_check
def _descend(H, gradient, out):
    """-H^-1 gradient; H's lower triangle becomes its Cholesky factor."""
    for j in range(6):
        total = H[j, j]
        for k in range(j):
            total -= H[j, k] * H[j, k]
        H[j, j] = total**0.5
        for i in range(j + 1, 6):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            H[i, j] = total / H[j, j]
    for i in range(6):
        total = -gradient[i]
        for k in range(i):
            total -= H[i, k] * out[k]
        out[i] = total / H[i, i]
    for i in range(5, -1, -1):
        total = out[i]
        for k in range(i + 1, 6):
            total -= H[k, i] * out[k]
        out[i] = total / H[i, i]


@njit(cache=True, nogil=True)
@no_type_check
def _step(y, Ad, v, d, slope, epsilon, flat_enough, search_steps, near, impulse):
    """Length of the step along d to where the slope has nearly vanished (Illinois form of regula falsi)."""
    length, low, high, at_low, at_high = 1.0, 0.0, 1.0, slope, 0.0
    for turn in range(search_steps + 1):
        here = 0.0
        for i in range(len(y)):
            near[i] = y[i] - length * Ad[i] / epsilon
        _project(near, impulse)
        for i in range(6):
            here += d[i] * (v[i] + length * d[i])
        for i in range(len(y)):
            here -= Ad[i] * impulse[i]
        if turn == 0:
            if not here > flat_enough * abs(slope):
                return 1.0
            at_high = here
        else:
            if abs(here) <= flat_enough * abs(slope) or turn == search_steps:
                return length
            if here < 0:
                low, at_low, at_high = length, here, 0.5 * at_high
            else:
                high, at_high, at_low = length, here, 0.5 * at_low
        length = low + (high - low) * min(max(at_low / (at_low - at_high), 0.05), 0.95)
    return length


@njit(cache=True, nogil=True)
@no_type_check
def _outward(A, v, q, epsilon, y):
    """y = -(A v + q) / epsilon."""
    for i in range(len(q)):
        total = q[i]
        for j in range(6):
            total += A[i, j] * v[j]
        y[i] = -total / epsilon


@njit(cache=True, nogil=True)
@no_type_check
def solve_rows(A, q, epsilon, primal, tolerance, most_iterations, flat_enough, search_steps):
    """Solve every row: A (n, 3k, 6), q (n, 3k); `primal` (n, 6) holds the start and takes the result.

    Returns impulses (n, 3k), whether each row failed, and the most iterations of any.
    """
    n, k3 = q.shape
    impulses, failed = np.zeros((n, k3)), np.ones(n, dtype=np.bool_)
    y, near, Ad = np.zeros(k3), np.zeros(k3), np.zeros(k3)
    gradient, d, H = np.zeros(6), np.zeros(6), np.zeros((6, 6))
    most = 0
    for row in range(n):
        v, impulse = primal[row], impulses[row]
        iterations = 0
        while True:
            _outward(A[row], v, q[row], epsilon, y)
            _project(y, impulse)
            if iterations >= most_iterations:
                break
            iterations += 1
            size = size_of_momentum = size_of_gradient = value = 0.0
            for j in range(6):
                momentum = 0.0
                for i in range(k3):
                    momentum += A[row, i, j] * impulse[i]
                gradient[j] = v[j] - momentum
                size += v[j] * v[j]
                size_of_momentum += momentum * momentum
                size_of_gradient += gradient[j] * gradient[j]
            if size_of_gradient**0.5 <= 1e-14 + tolerance * max(size, size_of_momentum) ** 0.5:
                failed[row] = False
                break
            for i in range(k3):
                value += impulse[i] * impulse[i]
            value = 0.5 * size + 0.5 * epsilon * value
            _hessian(A[row], y, epsilon, H)
            _descend(H, gradient, d)
            slope = 0.0
            for j in range(6):
                slope += gradient[j] * d[j]
            if -slope <= 1e-13 * value + 1e-22:  # no further fall within rounding
                failed[row] = False
                break
            if not np.isfinite(slope):
                break
            for i in range(k3):
                Ad[i] = 0.0
                for j in range(6):
                    Ad[i] += A[row, i, j] * d[j]
            length = _step(y, Ad, v, d, slope, epsilon, flat_enough, search_steps, near, impulse)
            for j in range(6):
                v[j] += length * d[j]
        most = max(most, iterations)
    return impulses, failed, most
