"""Rolling many states on through contact in fine steps, in compiled code: what forecasts are made of.

The step is that of rollout.py (Anitescu 2006; implicit Euler; the same inner problem) but for three things. A point
that reaches the plane faster than SLOWEST_REBOUND_M_S leaves it with `restitution` times that speed (Newton's rule). A
point below the plane is not pushed out: in steps as fine as these a pose that is 3 mm off would leave at 1.8 m/s. And
the law is Coulomb's own: Anitescu's problem is convex because what slides at u is lifted at friction * |u|, which at an
impact is a rebound that nobody asked for, and rebounds are what friction is told from. So the lift is taken off and the
problem solved again with the sliding that was found, until that stays (de Saxce and Feng 1998; as a fixed point: Acary,
Cadoux, Lemarechal and Malick 2011).
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from processing.contact.physics.solver import FLAT_ENOUGH, MOST_ITERATIONS, SEARCH_STEPS
from processing.contact.physics.solver_cpu import room, solve_row
from recordings.constants import GRAVITY_M_S2

SLOWEST_REBOUND_M_S = 0.03
CLOSING_M_S = 3.0
"""A point that would have to close in faster than this to touch within the step is no candidate."""
FASTEST_RAD_S, FASTEST_M_S = 150.0, 30.0
"""Beyond any toss: keeps the numbers of a hopeless state finite."""
EPSILON, TOLERANCE = 1e-4, 1e-6
"""As rollout.py has them."""
CONVERGED_M_S, MOST_ROUNDS = 0.002, 5
"""The lift is right when it stays within this; sliding that turns within the step may swing on."""


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _cross(a, b, out):
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _fly(spin, velocity, inertia, inverse, step_s, work, out):
    """Velocities after a step of free flight: w -= h I^-1 (w x I w), v_z -= h g."""
    for i in range(3):
        work[i] = inertia[i, 0] * spin[0] + inertia[i, 1] * spin[1] + inertia[i, 2] * spin[2]
    _cross(spin, work, out)
    for i in range(3):
        spin[i] -= step_s * (inverse[i, 0] * out[0] + inverse[i, 1] * out[1] + inverse[i, 2] * out[2])
    velocity[2] -= GRAVITY_M_S2 * step_s
    for values, most in ((spin, FASTEST_RAD_S), (velocity, FASTEST_M_S)):
        size = (values[0] ** 2 + values[1] ** 2 + values[2] ** 2) ** 0.5
        if size > most:
            for i in range(3):
                values[i] *= most / size


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _lowest(rotation, height_m, points, contacts, heights, index):
    """The `contacts` lowest points, lowest first: their numbers in `index`; the heights of all in `heights`."""
    for i in range(len(points)):
        p = points[i]
        heights[i] = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + height_m
    count = 0
    for i in range(len(points)):
        if count == contacts and not heights[i] < heights[index[contacts - 1]]:
            continue
        at = min(count, contacts - 1)
        while at > 0 and heights[i] < heights[index[at - 1]]:
            index[at] = index[at - 1]
            at -= 1
        index[at] = i
        count = min(count + 1, contacts)


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _problem(
    rotation, spin, velocity, points, heights, index, friction, restitution, root, root_mass, step_s, A, q, swept, speed
):
    """Rows A = J M^-1/2 and offsets q of the points that may touch; how many, and whether any impulse is needed.
    `swept` and `speed` (3,) are room to work in."""
    count, needed = 0, False
    for i in index:
        arm = points[i]
        _cross(spin, arm, swept)
        for a in range(3):
            speed[a] = velocity[a] + (rotation[a, 0] * swept[0] + rotation[a, 1] * swept[1] + rotation[a, 2] * swept[2])
        gap = max(heights[i], 0.0) / step_s
        normal = speed[2] + gap
        if normal > CLOSING_M_S:
            continue
        if normal < 0 and speed[2] < -SLOWEST_REBOUND_M_S:
            normal = speed[2] + min(gap, restitution * speed[2])
        row = 3 * count
        q[row], q[row + 1], q[row + 2] = friction * speed[0], friction * speed[1], normal
        needed = needed or normal < 0
        for a in range(3):
            share = 1.0 if a == 2 else friction
            _cross(arm, rotation[a], swept)
            for b in range(3):
                A[row + a, b] = share * (swept[0] * root[0, b] + swept[1] * root[1, b] + swept[2] * root[2, b])
                A[row + a, 3 + b] = 0.0
            A[row + a, 3 + a] = share / root_mass
        count += 1
    return count, needed


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _solve(A, q, count, primal, impulse, inner, lift):
    """Impulses by Coulomb's law; whether every problem on the way was solved. `lift` (k,) is room to work in."""
    solved = True
    for c in range(count):
        lift[c] = (q[3 * c] ** 2 + q[3 * c + 1] ** 2) ** 0.5
        q[3 * c + 2] += lift[c]
    for _ in range(MOST_ROUNDS):
        here, _ = solve_row(
            A, q, 3 * count, EPSILON, primal, TOLERANCE, MOST_ITERATIONS, FLAT_ENOUGH, SEARCH_STEPS, impulse, inner
        )
        solved = solved and here
        change = 0.0
        for c in range(count):
            along, across = q[3 * c], q[3 * c + 1]
            for j in range(3):
                along += A[3 * c, j] * primal[j]
                across += A[3 * c + 1, j] * primal[j]
            along, across = along + A[3 * c, 3] * primal[3], across + A[3 * c + 1, 4] * primal[4]
            wanted = (along * along + across * across) ** 0.5
            change = max(change, abs(wanted - lift[c]))
            q[3 * c + 2] += wanted - lift[c]
            lift[c] = wanted
        if change <= CONVERGED_M_S:
            break
    return solved


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _push(A, impulse, count, root, root_mass, spin, velocity, momentum):
    """Adds the impulses to the velocities; returns the change of |v| that they stand for."""
    momentum[:] = 0.0
    for c in range(3 * count):
        for j in range(6):
            momentum[j] += A[c, j] * impulse[c]
    for j in range(3):
        spin[j] += root[j, 0] * momentum[0] + root[j, 1] * momentum[1] + root[j, 2] * momentum[2]
        velocity[j] += momentum[3 + j] / root_mass
    return (momentum[3] ** 2 + momentum[4] ** 2 + momentum[5] ** 2) ** 0.5 / root_mass


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _turn(rotation, spin, step_s, E):
    """R exp(h w), in place."""
    x, y, z = step_s * spin[0], step_s * spin[1], step_s * spin[2]
    angle = (x * x + y * y + z * z) ** 0.5
    a, b = (1.0, 0.5) if angle < 1e-9 else (np.sin(angle) / angle, (1 - np.cos(angle)) / (angle * angle))
    E[0, 0], E[1, 1], E[2, 2] = 1 - b * (y * y + z * z), 1 - b * (x * x + z * z), 1 - b * (x * x + y * y)
    E[0, 1], E[1, 0] = b * x * y - a * z, b * x * y + a * z
    E[0, 2], E[2, 0] = b * x * z + a * y, b * x * z - a * y
    E[1, 2], E[2, 1] = b * y * z - a * x, b * y * z + a * x
    for i in range(3):
        r0, r1, r2 = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        for j in range(3):
            rotation[i, j] = r0 * E[0, j] + r1 * E[1, j] + r2 * E[2, j]


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def roll_rows(rotation, position, spin, velocity, owner, laws, points, inertia, mass, contacts, steps, step_s):
    """Moves n states on by `steps` of `step_s`, in place: rotation (n, 3, 3), position, spin (object axes) and velocity
    (n, 3). `owner` (n,) says which of m laws (friction, restitution) each obeys; `points` (v, 3) are the body's, about
    its centre of mass.

    Returns the change of speed that contact made in each (n,), and how many inner problems did not solve.
    """
    n, failures = len(position), 0
    inverse = np.linalg.inv(inertia)
    root, root_mass = np.linalg.cholesky(inverse), mass**0.5
    reach = np.sqrt((points**2).sum(1).max())
    heights, index = np.zeros(len(points)), np.zeros(contacts, dtype=np.int64)
    A, q, primal = np.zeros((3 * contacts, 6)), np.zeros(3 * contacts), np.zeros(6)
    impulse, lift, inner = np.zeros(3 * contacts), np.zeros(contacts), room(3 * contacts)
    work, out, E, momentum, pushed = np.zeros(3), np.zeros(3), np.zeros((3, 3)), np.zeros(6), np.zeros(n)
    for r in range(n):
        R, w, v = rotation[r], spin[r], velocity[r]
        friction, restitution = laws[owner[r], 0], laws[owner[r], 1]
        primal[:] = 0.0
        for _ in range(steps):
            _fly(w, v, inertia, inverse, step_s, work, out)
            if position[r, 2] < reach * (1 + step_s * (w[0] ** 2 + w[1] ** 2 + w[2] ** 2) ** 0.5) - step_s * v[2]:
                _lowest(R, position[r, 2], points, contacts, heights, index)
                count, needed = _problem(
                    R, w, v, points, heights, index, friction, restitution, root, root_mass, step_s, A, q, work, out
                )
                if needed:
                    solved = _solve(A, q, count, primal, impulse, inner, lift)
                    failures += not solved
                    pushed[r] += _push(A, impulse, count, root, root_mass, w, v, momentum)
                else:
                    primal[:] = 0.0
            _turn(R, w, step_s, E)
            for j in range(3):
                position[r, j] += step_s * v[j]
    return pushed, failures
