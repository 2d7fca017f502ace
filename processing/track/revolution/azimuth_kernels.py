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
OPEN_RAD = 1e6
"""A turn whose standard deviation is beyond this is not expected at all."""


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
        if slack[t] < OPEN_RAD:
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
def _add_turned(out, costs, between, forward):
    """Adds to out (cells) what a pair costs with so many cells between its views, and from there on or back."""
    cells = len(costs)
    if forward:
        for q in range(cells - between):
            out[q] += costs[between + q]
        for q in range(between):
            out[cells - between + q] += costs[q]
    else:
        for q in range(between + 1):
            out[q] += costs[between - q]
        for q in range(between + 1, cells):
            out[q] += costs[cells + between - q]


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
        _add_turned(out, costs[m], (state[i] - state[j]) % cells, one)


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _run_costs(state, a, b, costs, pairs, rest, out, trial):
    """Into out (cells): what the pairs and the changes of spin cost when the views a..b turn together, by how far; the
    spin within them stays, so that it counts near a and near b alone."""
    base, steps_s, still, spin_weight, usual, expected, slack, step, motion = rest
    v, cells = len(state), costs.shape[1]
    _part(state, a, b, costs, pairs, out)
    lo, hi = max(a - 2, 0), min(b + 2, v - 1)
    apart, last = b - a > 4, b - 2
    first = min(a + 2 if apart or b == v - 1 else hi, hi)
    trial[lo : hi + 1] = state[lo : hi + 1]
    for q in range(cells):
        trial[a : min(b, first) + 1] = (state[a : min(b, first) + 1] + q) % cells
        out[q] += spin_cost(trial, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, lo, first)
        if apart and b < v - 1:
            trial[last : b + 1] = (state[last : b + 1] + q) % cells
            out[q] += spin_cost(
                trial, base, steps_s, still, spin_weight, usual, expected, slack, step, motion, last, hi
            )


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _ramp(length, cells):
    """Cells that a view turns by, (length + 1, cells): after so many views of a ramp, by how far it turns in all."""
    out = np.zeros((length + 1, cells), np.int64)
    for k in range(length + 1):
        for q in range(cells):
            out[k, q] = int(np.round((q if q <= cells // 2 else q - cells) * (k / length)))
    return out


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _ramped(state, a, ramp, q, trial, b):
    """`trial`: the views from a on turned along a ramp; views up to b."""
    for t in range(a, b + 1):
        trial[t] = (state[t] + ramp[min(t - a + 1, len(ramp) - 1), q]) % ramp.shape[1]


@no_type_check
@njit(cache=True, nogil=True, fastmath=True)
def _ramp_costs(state, a, ramp, costs, pairs, rest, out, trial):
    """Into out (cells): what the pairs and the changes of spin that a ramp changes cost, by how far it turns."""
    base, steps_s, still, spin_weight, usual, expected, slack, step, motion = rest
    v, cells, length = len(state), costs.shape[1], len(ramp) - 1
    out[:] = 0.0
    for m in range(pairs.shape[0]):
        i, j = pairs[m, 0], pairs[m, 1]
        one, two = min(max(i - a + 1, 0), length), min(max(j - a + 1, 0), length)
        if one == two:
            continue
        between = (state[i] - state[j]) % cells
        if abs(one - two) == length:
            _add_turned(out, costs[m], between, one > two)
            continue
        for q in range(cells):
            at = between + ramp[one, q] - ramp[two, q]
            out[q] += costs[m, at + cells if at < 0 else (at - cells if at >= cells else at)]
    lo, hi = max(a - 2, 0), min(a + length + 1, v - 1)
    trial[lo : hi + 1] = state[lo : hi + 1]
    for q in range(cells):
        _ramped(state, a, ramp, q, trial, hi)
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
                _run_costs(state, a, b, costs, pairs, rest, out, trial)
                best = 0
                for q in range(1, cells):
                    if out[q] < out[best] - 1e-9:
                        best = q
                if best:
                    state[a : b + 1] = (state[a : b + 1] + best) % cells
                    changed = True
        for length in RAMPS:
            ramp = _ramp(length, cells)
            for a in range(1, v - 1):
                _ramp_costs(state, a, ramp, costs, pairs, rest, out, trial)
                best = out.argmin()
                if out[best] < out[0] - 1e-6:
                    trial[:] = state
                    _ramped(state, a, ramp, best, trial, v - 1)
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
    trial, e, var = state.copy(), np.zeros(cells), np.zeros(v)
    rest = base, steps_s, still, spin_weight, usual, expected, slack, step, motion
    for length in range(v):
        for a in range(1, v):
            b = v - 1 if length == 0 else a + length - 1
            if b >= v:
                continue
            _run_costs(state, a, b, costs, pairs, rest, e, trial)
            _widen(var, e, a, b, 1, step)
    for length in RAMPS:
        ramp = _ramp(length, cells)
        for a in range(1, v - 1):
            _ramp_costs(state, a, ramp, costs, pairs, rest, e, trial)
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
