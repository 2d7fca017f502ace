"""Compiled search over a round body's azimuths: log ratios of two unwrapped views' shape for each azimuth between them,
and the moves that lower what all pairs and the change of spin cost together.

Azimuths are whole cells of the unwrapping. A view turned by `state` cells shows at angle a what was unwrapped at a +
state; so a pair's cost depends on the difference of the two states.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

RAMPS = (2, 3, 4, 6, 8, 12, 18, 27)
"""Over so many views a rotation may grow."""


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def add_shape_ratio(odd, sides, free, pairs, match, clash, reach, out):
    """Adds to out (m, 2 reach + 1): what stands off the body meets what was seen there from the same side, or a place
    that was seen to be empty."""
    cells = odd.shape[2]
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        for r in range(odd.shape[1]):
            for a in range(cells):
                mine, theirs = odd[i, r, a], odd[j, r, a]
                if mine > 0.0:
                    for q in range(-reach, reach + 1):
                        b = (a - q) % cells
                        if odd[j, r, b] > 0.0:
                            for s in range(3):
                                out[m, q + reach] += match * min(sides[i, s, r, a], sides[j, s, r, b])
                        elif free[j, r, b] > 0.0:
                            out[m, q + reach] -= clash * mine
                if theirs > 0.0:
                    for q in range(-reach, reach + 1):
                        if free[i, r, (a + q) % cells] > 0.0:
                            out[m, q + reach] -= clash * theirs


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def spin_cost(state, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, a, b):
    """Cost of the changes of spin within the views a..b. base (v-1): turn about the axis from view to view at state 0
    (rad); still (v): whether a view stands for frames without motion; spin_weight, usual (v): of a change there;
    expected, slack (v-1): expected turn and its standard deviation (infinite where nothing is expected); motion: fast
    spin, cost of faster."""
    fast, dear = motion[0], motion[1]
    total, last, known = 0.0, 0.0, False
    for t in range(a, b + 1):
        if still[t]:
            if known:
                total += spin_weight[t] * np.log(1.0 + (last / usual[t]) ** 2)
            last, known = 0.0, True
        if t == b:
            break
        turn = base[t] - (state[t + 1] - state[t]) * step
        turn -= 2.0 * np.pi * np.floor(turn / (2.0 * np.pi) + 0.5)
        off = turn - expected[t]
        off -= 2.0 * np.pi * np.floor(off / (2.0 * np.pi) + 0.5)
        total += np.log(1.0 + (off / slack[t]) ** 2)
        rate = turn / steps_s[t]
        if known:
            total += spin_weight[t] * np.log(1.0 + ((rate - last) / usual[t]) ** 2)
        total += dear * max(abs(rate) / fast - 1.0, 0.0)
        last, known = rate, True
    return total


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def energy(state, costs, pairs, base, steps_s, still, spin_weight, usual, expected, slack, step, motion):
    """What the pairs (costs (m, cells), cyclic) and the changes of spin cost together."""
    total = spin_cost(state, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, 0, len(state) - 1)
    for m in range(pairs.shape[0]):
        total += costs[m, (state[pairs[m, 0]] - state[pairs[m, 1]]) % costs.shape[1]]
    return total


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _part(state, a, b, costs, pairs, out):
    """Into out (cells): what the pairs with one view in a..b cost when those views turn together."""
    cells = costs.shape[1]
    out[:] = 0.0
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        one, two = a <= i <= b, a <= j <= b
        if one == two:
            continue
        between = (state[i] - state[j]) % cells
        for q in range(cells):
            out[q] += costs[m, (between + q if one else between - q) % cells]


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _ramp(state, a, length, q, cells, trial, b):
    """`trial`: the views from a on turned, over `length` of them more and more, by q; views up to b."""
    turn = q if q <= cells // 2 else q - cells
    for t in range(a, b + 1):
        trial[t] = (state[t] + int(np.round(turn * min((t - a + 1.0) / length, 1.0)))) % cells


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _ramp_costs(state, a, length, costs, pairs, rest, out, trial):
    """Into out (cells): what the pairs and the changes of spin that a ramp changes cost, by how far it turns."""
    base, steps_s, still, spin_weight, usual, expected, slack, step, motion = rest
    v, cells = len(state), costs.shape[1]
    out[:] = 0.0
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        one, two = min(max((i - a + 1.0) / length, 0.0), 1.0), min(max((j - a + 1.0) / length, 0.0), 1.0)
        if one == two:
            continue
        between = state[i] - state[j]
        for q in range(cells):
            turn = q if q <= cells // 2 else q - cells
            out[q] += costs[m, (between + int(np.round(turn * one)) - int(np.round(turn * two))) % cells]
    lo, hi = max(a - 2, 0), min(a + length + 1, v - 1)
    trial[lo : hi + 1] = state[lo : hi + 1]
    for q in range(cells):
        _ramp(state, a, length, q, cells, trial, hi)
        out[q] += spin_cost(trial, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, lo, hi)


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def descend(
    state, costs, pairs, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, sweeps, longest
):
    """Turns runs of views, ends of the toss, and ends reached by a ramp, until none wants to turn; view 0 stays."""
    v, cells = len(state), costs.shape[1]
    out, trial = np.zeros(cells), state.copy()
    rest = base, steps_s, still, spin_weight, usual, expected, slack, step, motion
    for _ in range(sweeps):
        changed = False
        for length in range(longest):
            for a in range(1, v):
                b = v - 1 if length == 0 else a + length - 1
                if b >= v or (length > 0 and b == v - 1) or (length > 4 and length % 4 > 0):
                    continue
                _part(state, a, b, costs, pairs, out)
                lo, hi = max(a - 2, 0), min(a + 2 if length == 0 else b + 2, v - 1)
                trial[lo : hi + 1] = state[lo : hi + 1]
                best, least = 0, 0.0
                for q in range(cells):
                    trial[a : min(b, hi) + 1] = (state[a : min(b, hi) + 1] + q) % cells
                    e = out[q] + spin_cost(
                        trial, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, lo, hi
                    )
                    if q == 0 or e < least - 1e-9:
                        best, least = q, e
                if best:
                    state[a : b + 1] = (state[a : b + 1] + best) % cells
                    changed = True
        for length in RAMPS:
            for a in range(1, v - 1):
                _ramp_costs(state, a, length, costs, pairs, rest, out, trial)
                best = out.argmin()
                if out[best] < out[0] - 1e-6:
                    trial[:] = state
                    _ramp(state, a, length, best, cells, trial, v - 1)
                    state[:] = trial
                    changed = True
        if not changed:
            break
    return state


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def greedy(v, costs, pairs, base, steps_s, still, spin_weight, usual, expected, slack, step, motion):
    """Each view where those before want it."""
    cells = costs.shape[1]
    state, e = np.zeros(v, np.int64), np.zeros(cells)
    for t in range(1, v):
        e[:] = 0.0
        for m in range(pairs.shape[0]):
            i, j = pairs[m, 0], pairs[m, 1]
            if i == t and j < t:
                for q in range(cells):
                    e[q] += costs[m, (q - state[j]) % cells]
        best = 0
        for q in range(cells):
            state[t] = q
            lo = max(t - 2, 0)
            e[q] += spin_cost(state, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, lo, t)
            if e[q] < e[best]:
                best = q
        state[t] = best
    return state


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def variances(state, costs, pairs, base, steps_s, still, spin_weight, usual, expected, slack, step, motion):
    """Variance (rad^2) of each view's azimuth against view 0: the widest of the moves that turn it, each with the
    probability that its energy leaves it."""
    v, cells = len(state), costs.shape[1]
    out, trial, e, var = np.zeros(cells), state.copy(), np.zeros(cells), np.zeros(v)
    rest = base, steps_s, still, spin_weight, usual, expected, slack, step, motion
    for length in range(v):
        for a in range(1, v):
            b = v - 1 if length == 0 else a + length - 1
            if b >= v:
                continue
            _part(state, a, b, costs, pairs, out)
            lo, hi = max(a - 2, 0), min(a + 2 if length == 0 else b + 2, v - 1)
            trial[lo : hi + 1] = state[lo : hi + 1]
            for q in range(cells):
                trial[a : min(b, hi) + 1] = (state[a : min(b, hi) + 1] + q) % cells
                e[q] = out[q] + spin_cost(
                    trial, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, lo, hi
                )
            _widen(var, e, a, b, 1, step)
    for length in RAMPS:
        for a in range(1, v - 1):
            _ramp_costs(state, a, length, costs, pairs, rest, e, trial)
            _widen(var, e, a, v - 1, length, step)
    return var


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _widen(var, e, a, b, length, step):
    cells = len(e)
    least, total, square = e.min(), 0.0, 0.0
    for q in range(cells):
        share = np.exp(least - e[q])
        turn = ((q + cells // 2) % cells - cells // 2) * step
        total += share
        square += share * turn * turn
    for t in range(a, b + 1):
        part = min((t - a + 1.0) / length, 1.0)
        var[t] = max(var[t], square / total * part * part)
