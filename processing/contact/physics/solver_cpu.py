"""The inner problem of solver.py, one row after another in compiled code: on a CPU several times faster than batches.

The same Newton iteration with the same line search and the same ends, so that both give the same numbers
(tests/processing/contact/test_solver.py); the batched form stays for CUDA and as the reference. It also knows how
A = J M^-1/2 looks (loss.jacobian): of the last three columns row 3c + a has column 3 + a only.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
@no_type_check
def _project(y, size, out):
    """Nearest points of the Lorentz cones {y_2 >= |y_01|}."""
    for c in range(size // 3):
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
def _hessian(A, y, size, epsilon, H, D, DA):
    """1 + A' P'(y) A / epsilon, P' as in solver.project_jacobian; `D` (3, 3) and `DA` (3, 6) are room to work in."""
    H[:] = 0.0
    for c in range(size // 3):
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
            for j in range(3):
                DA[i, j] = D[i, 0] * A[3 * c, j] + D[i, 1] * A[3 * c + 1, j] + D[i, 2] * A[3 * c + 2, j]
                DA[i, 3 + j] = D[i, j] * A[3 * c + j, 3 + j]
        for i in range(3):
            for j in range(i + 1):
                H[i, j] += A[3 * c, i] * DA[0, j] + A[3 * c + 1, i] * DA[1, j] + A[3 * c + 2, i] * DA[2, j]
            for j in range(4 + i):
                H[3 + i, j] += A[3 * c + i, 3 + i] * DA[i, j]
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
def _step(y, Ad, size, v, d, slope, epsilon, flat_enough, search_steps, near, impulse):
    """Length of the step along d to where the slope has nearly vanished (Illinois form of regula falsi)."""
    length, low, high, at_low, at_high = 1.0, 0.0, 1.0, slope, 0.0
    for turn in range(search_steps + 1):
        here = 0.0
        for i in range(size):
            near[i] = y[i] - length * Ad[i] / epsilon
        _project(near, size, impulse)
        for i in range(6):
            here += d[i] * (v[i] + length * d[i])
        for i in range(size):
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
def _outward(A, v, q, size, epsilon, y):
    """y = -(A v + q) / epsilon."""
    for c in range(size // 3):
        for a in range(3):
            i = 3 * c + a
            y[i] = -(q[i] + A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2] + A[i, 3 + a] * v[3 + a]) / epsilon


@njit(cache=True, nogil=True)
@no_type_check
def _times(A, d, size, Ad):
    """Ad = A d."""
    for c in range(size // 3):
        for a in range(3):
            i = 3 * c + a
            Ad[i] = A[i, 0] * d[0] + A[i, 1] * d[1] + A[i, 2] * d[2] + A[i, 3 + a] * d[3 + a]


@njit(cache=True, nogil=True)
@no_type_check
def room(most):
    """What `solve_row` works in, for up to `most` entries of q."""
    return np.zeros((3, most)), np.zeros((3, 6)), np.zeros((6, 6)), np.zeros((3, 3)), np.zeros((3, 6))


@njit(cache=True, nogil=True)
@no_type_check
def solve_row(A, q, size, epsilon, v, tolerance, most_iterations, flat_enough, search_steps, impulse, work):
    """One row: the first `size` entries of A (3k, 6) and q (3k,); `v` (6,) holds the start and takes the result,
    `impulse` (3k,) the impulses, `work` is a `room`.

    Returns whether it was solved, and the iterations.
    """
    (y, near, Ad), (gradient, d, momentum), H, D, DA = work
    iterations = 0
    while True:
        _outward(A, v, q, size, epsilon, y)
        _project(y, size, impulse)
        if iterations >= most_iterations:
            return False, iterations
        iterations += 1
        size_of_v = size_of_momentum = size_of_gradient = value = 0.0
        momentum[:] = 0.0
        for c in range(size // 3):
            for a in range(3):
                i = 3 * c + a
                for j in (0, 1, 2, 3 + a):
                    momentum[j] += A[i, j] * impulse[i]
        for j in range(6):
            gradient[j] = v[j] - momentum[j]
            size_of_v += v[j] * v[j]
            size_of_momentum += momentum[j] * momentum[j]
            size_of_gradient += gradient[j] * gradient[j]
        if size_of_gradient**0.5 <= 1e-14 + tolerance * max(size_of_v, size_of_momentum) ** 0.5:
            return True, iterations
        for i in range(size):
            value += impulse[i] * impulse[i]
        value = 0.5 * size_of_v + 0.5 * epsilon * value
        _hessian(A, y, size, epsilon, H, D, DA)
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


@njit(cache=True, nogil=True)
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
