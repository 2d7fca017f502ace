"""A round body's turn about its axis: sought over all turns and all frames at once, because no single frame tells it.

Where the depth of all frames leaves one turn open (a mug's, a can's), every pair of views is compared over that whole
turn; the turns of all frames together are then those that contradict the pairs least and spin steadily. What even that
leaves open is told as a standard deviation per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.track import kernels as k
from processing.track import turn_kernels as tk
from processing.track.beam import Scene
from processing.track.keyframes import view_directions
from processing.track.round_axis import Axis, AxisConfig
from recordings.geometry import rotation_log


@dataclass(frozen=True)
class TurnConfig:
    """How a round body's turns are sought."""

    axis: AxisConfig = field(default_factory=AxisConfig)
    grid_deg: float = 5.0
    fine_deg: float = 1.5
    """Steps of the two searches ..."""
    fine_reach_deg: float = 12.0
    """... and how far the second one goes."""
    polar_deg: float = 40.0
    """Views are compared whose directions differ by at most this in their angle to the axis."""
    near: tuple[int, ...] = (1, 2, 4)
    """Steps in time over which views are always compared ..."""
    pairs: int = 8
    """... and how many others a view is compared with."""
    every: int = 2
    """Of a view's points, one in so many is used."""
    depth_m: float = 0.004
    outline_m: float = 0.004
    bright: float = 0.3
    color: float = 0.15
    """Scales: depth and outline (at 0.8 m), differences of looks."""
    looks_gain: float = 0.5
    """Of looks beside outright contradictions ..."""
    far_gain: float = 0.15
    """... and between views farther apart in time, because shading makes them err more."""
    most: float = 0.06
    """A pair's word counts no more than this."""
    spin_change_rad_s: float = 3.0
    spin_price: float = 0.02
    """Change of spin about the axis that costs half the price: a round body's is constant in flight."""
    fast_rad_s: float = 25.0
    fast_price: float = 0.5
    """Spins above this cost their excess times this."""
    profile_m: float = 0.01
    profile_share: float = 0.85
    off_m: float = 0.006
    """Points farther from the axis by this than that share of those at the same height (cells of `profile_m`) are odd:
    a handle's."""
    temperature: float = 0.03
    """Sum of contradictions that is chance."""
    sweeps: int = 12
    least_odd: int = 4
    """Points off the round body that show a handle."""
    least_sigma_deg: float = 3.0
    """What shading and the depth sensor's fixed pattern make a found turn err by, however sure the pairs are."""
    usual: float = 0.005
    """Contradiction that right poses leave; where more is left, something is wrong and doubt grows with it."""


@dataclass(frozen=True, eq=False)
class Turned:
    """Poses after the search, the standard deviation of each one's turn about the axis, and the axis."""

    poses: Float[Array, "n 4 4"]
    sigma_rad: Float[Array, " n"]
    axis: Axis
    shown: float = 0.0
    """Share of the views that show something off the round body (a handle): they tell the turn by themselves."""


def doubted(found: Turned, said: float, first: int, config: TurnConfig) -> Turned:
    """With the doubt that what still speaks against the poses (`said`) and the usual errors leave; the first frame
    has none."""
    sigma = np.maximum(found.sigma_rad, np.radians(config.least_sigma_deg)) * max(1.0, said / config.usual)
    sigma[first] = 0.0
    return replace(found, sigma_rad=np.asarray(sigma))


def contradiction(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: TurnConfig
) -> float:
    """What the pairs of views that the search compares say against these poses, mean over pairs."""
    views = np.array([run[len(run) // 2] for run in _runs(scene, use)])
    pairs = _pairs(poses, views, axis, config)
    odd = _odd(scene, poses, use, axis, config)
    return float(_raw(scene, poses, views, pairs, np.zeros(1), np.zeros(len(pairs)), odd, axis, config).mean())


def turned(
    scene: Scene, poses: Float[Array, "n 4 4"], rivals: list[Float[Array, "n 4 4"]], use: Bool[Array, " n"], first: int,
    axis: Axis, config: TurnConfig,
) -> Turned:  # fmt: skip
    """The poses with the turns about `axis` that all frames together say; `rivals` are other stories to start from.
    The first frame's pose stays."""
    runs = _runs(scene, use)
    views = np.array([run[len(run) // 2] for run in runs])
    pairs = _pairs(poses, views, axis, config)
    if len(pairs) == 0:
        return Turned(poses, np.zeros(len(poses)), axis)
    # what stands still turns between its last frame and the next one's first
    steps_s = np.array([scene.times_s[b[0]] - scene.times_s[a[-1]] for a, b in zip(runs, runs[1:])])
    base = _rates(poses, views, steps_s, axis)
    odd = _odd(scene, poses, use, axis, config)
    step = np.radians(config.grid_deg)
    count = round(2 * np.pi / step)
    wide = _costs(scene, poses, views, pairs, np.arange(count) * step, np.zeros(len(pairs)), odd, axis, config)
    wide = 0.25 * np.roll(wide, 1, 1) + 0.5 * wide + 0.25 * np.roll(wide, -1, 1)
    field = _Field(wide, pairs, base, steps_s, step, True, config)
    starts = [np.zeros(len(views), dtype=np.int64), field.greedy(len(views))]
    starts += [np.round(_angles(poses[views], r[views], axis) / step).astype(np.int64) for r in rivals]
    state = min((field.settled(s) for s in starts), key=field.energy)
    sigma = field.sigma(state)
    angle = state * step
    fine = np.radians(config.fine_deg)
    reach = round(config.fine_reach_deg / config.fine_deg)
    offsets = np.arange(-reach, reach + 1) * fine
    between = angle[pairs[:, 0]] - angle[pairs[:, 1]]
    close = _costs(scene, poses, views, pairs, offsets, between, odd, axis, config)
    base = base - np.diff(np.unwrap(angle)) / steps_s
    last = _Field(close, pairs, base, steps_s, fine, False, config)
    angle = angle + last.settled(np.zeros(len(views), dtype=np.int64)) * fine
    angle = angle - angle[_run_of(runs, first)]
    out, spread = poses.copy(), np.zeros(len(poses))
    for run, a, s in zip(runs, angle, sigma):
        turn = axis.turn(float(a))
        for i in run:
            out[i], spread[i] = poses[i] @ turn, s
    shown = np.mean(
        [odd[f : f + c].sum() >= config.least_odd for f, c in scene.store.table[views][:, [k.FIRST, k.COUNT]]]
    )
    return Turned(out, spread, axis, float(shown))


def _odd(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: TurnConfig
) -> Float[Array, " s"]:
    """Which of the store's samples lie outside the round body (1), as a handle does."""
    store = scene.store
    out = np.zeros(len(store.samples))
    where, height, radius = [], [], []
    for i in np.flatnonzero(use):
        first, count = int(store.table[i, k.FIRST]), int(store.table[i, k.COUNT])
        p = (store.samples[first : first + count, :3] - poses[i][:3, 3]) @ poses[i][:3, :3] - axis.point_m
        along = p @ axis.direction
        where.append(np.arange(first, first + count))
        height.append(along)
        radius.append(np.linalg.norm(p - along[:, None] * axis.direction, axis=1))
    index, h, r = np.concatenate(where), np.concatenate(height), np.concatenate(radius)
    cell = np.floor((h - h.min()) / config.profile_m).astype(int)
    for c in np.unique(cell):
        here = cell == c
        most = np.quantile(r[here], config.profile_share)
        out[index[here & (r > most + config.off_m)]] = 1.0
    return out


def _runs(scene: Scene, use: Bool[Array, " n"]) -> list[list[int]]:
    """Used frames, those between which the object stands still together."""
    runs: list[list[int]] = []
    for i in np.flatnonzero(use):
        if runs and runs[-1][-1] == i - 1 and scene.store.stands_still(int(i) - 1, int(i)):
            runs[-1].append(int(i))
        else:
            runs.append([int(i)])
    return runs


def _run_of(runs: list[list[int]], frame: int) -> int:
    return next((n for n, run in enumerate(runs) if frame in run), 0)


def _pairs(
    poses: Float[Array, "n 4 4"], views: Int[Array, " v"], axis: Axis, config: TurnConfig
) -> Int[Array, "m 2"]:  # fmt: skip
    """Positions in `views`, later one first: neighbours in time, and views from about the same angle to the axis."""
    toward = view_directions(poses[views], axis.point_m)
    polar = np.degrees(np.arccos(np.clip(toward @ axis.direction, -1, 1)))
    chosen = set()
    for a in range(len(views)):
        apart = np.abs(polar - polar[a])
        chosen |= {(a, a - s) for s in config.near if s <= a and apart[a - s] < config.polar_deg}
        earlier = [b for b in range(a) if apart[b] < config.polar_deg and (a, b) not in chosen]
        # spread over time, so that the first frames are linked with the last
        picked: Array | list[int] = (
            np.unique(np.linspace(0, len(earlier) - 1, config.pairs).round().astype(int)) if earlier else []
        )
        chosen |= {(a, earlier[p]) for p in picked}
    return np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2)


def _costs(
    scene: Scene, poses: Float[Array, "n 4 4"], views: Int[Array, " v"], pairs: Int[Array, "m 2"],
    offsets_rad: Float[Array, " d"], between_rad: Float[Array, " m"], odd: Float[Array, " s"], axis: Axis,
    config: TurnConfig,
) -> Float[Array, "m d"]:  # fmt: skip
    """As `_raw`, above each pair's least, and no more than a pair may say."""
    costs = _raw(scene, poses, views, pairs, offsets_rad, between_rad, odd, axis, config)
    return np.minimum(costs - costs.min(1, keepdims=True), config.most)


def _raw(
    scene: Scene, poses: Float[Array, "n 4 4"], views: Int[Array, " v"], pairs: Int[Array, "m 2"],
    offsets_rad: Float[Array, " d"], between_rad: Float[Array, " m"], odd: Float[Array, " s"], axis: Axis,
    config: TurnConfig,
) -> Float[Array, "m d"]:  # fmt: skip
    """What speaks against each turn of a pair's first view against its second."""
    turns = np.array([[axis.turn(float(b + o)) for o in offsets_rad] for b in np.unique(between_rad)])
    turns = turns[np.searchsorted(np.unique(between_rad), between_rad)]
    store = scene.store
    far = float(np.median(np.linalg.norm(store.center_m[views], axis=1))) / 0.8
    return np.asarray(tk.turn_costs(
        np.ascontiguousarray(poses), views[pairs], turns, store.maps, store.samples, odd, store.table,
        store.optics.focal, store.optics.center, config.every, config.depth_m * float(np.clip(far**2, 0.5, 4.0)),
        config.outline_m * float(np.clip(far, 0.5, 2.0)), np.array([config.bright, config.color]),
        np.where(pairs[:, 0] - pairs[:, 1] <= 2, config.looks_gain, config.far_gain),
    ))  # fmt: skip


def _rates(
    poses: Float[Array, "n 4 4"], views: Int[Array, " v"], steps_s: Float[Array, " r"], axis: Axis
) -> Float[Array, " r"]:
    """Spin about the axis from view to view, rad/s, object frame."""
    turns = [rotation_log(poses[b][:3, :3].T @ poses[a][:3, :3]) for a, b in zip(views, views[1:])]
    return np.array([float(t @ axis.direction) for t in turns]) / steps_s


def _angles(poses: Float[Array, "v 4 4"], others: Float[Array, "v 4 4"], axis: Axis) -> Float[Array, " v"]:
    """The turn about the axis that leads from each pose to the other story's."""
    out = np.zeros(len(poses))
    for n, (p, o) in enumerate(zip(poses, others)):
        if np.isfinite(o).all():
            turn = p[:3, :3].T @ o[:3, :3]
            d = axis.direction
            sine = 0.5 * float(d @ [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            out[n] = np.arctan2(sine, 0.5 * (float(np.trace(turn)) - float(d @ turn @ d)))
    return out


class _Field:
    """Energy of all views' turns (whole steps): contradictions of the pairs and changes of spin; what lowers it."""

    def __init__(
        self, costs: Float[Array, "m d"], pairs: Int[Array, "m 2"], rates: Float[Array, " r"],
        steps_s: Float[Array, " r"], step_rad: float, round_: bool, config: TurnConfig,
    ) -> None:  # fmt: skip
        self.costs, self.pairs, self.rates, self.steps_s = costs, pairs, rates, steps_s
        self.step_rad, self.round, self.config = step_rad, round_, config
        self.count = costs.shape[1]
        reach = self.count // 2
        self.moves = np.arange(self.count) if round_ else np.arange(-reach, reach + 1)

    def _at(self, m: Int[Array, " a"], between: Int[Array, " a *b"]) -> Float[Array, " a *b"]:
        rows_m = m.reshape(-1, *([1] * (between.ndim - 1)))
        if self.round:
            return np.asarray(self.costs[rows_m, between % self.count])
        place = between + self.count // 2
        ends = np.clip(place, 0, self.count - 1)
        return np.asarray(self.costs[rows_m, ends] + 0.05 * np.abs(place - ends))

    def _spin(self, states: Int[Array, "s v"]) -> Float[Array, " s"]:
        """Price of the changes of spin."""
        turn = np.diff(states, axis=1)
        if self.round:
            turn = (turn + self.count // 2) % self.count - self.count // 2
        rate = self.rates + -turn * self.step_rad / self.steps_s
        change = (np.diff(rate, axis=1) / self.config.spin_change_rad_s) ** 2
        fast = np.maximum(np.abs(rate) / self.config.fast_rad_s - 1.0, 0.0)
        return np.asarray(
            self.config.spin_price * (change / (1.0 + change)).sum(1) + self.config.fast_price * fast.sum(1)
        )

    def energy(self, state: Int[Array, " v"]) -> float:
        between = state[self.pairs[:, 0]] - state[self.pairs[:, 1]]
        return float(self._at(np.arange(len(self.pairs)), between).sum() + self._spin(state[None])[0])

    def moved(self, state: Int[Array, " v"], which: Bool[Array, " v"]) -> Float[Array, " d"]:
        """Energy (but for a constant) when the views in `which` turn together by each move."""
        one, two = which[self.pairs[:, 0]], which[self.pairs[:, 1]]
        m = np.flatnonzero(one != two)
        between = (state[self.pairs[:, 0]] - state[self.pairs[:, 1]])[m]
        sign = np.where(one[m], 1, -1)
        pair = self._at(m, between[:, None] + sign[:, None] * self.moves[None, :]).sum(0)
        return np.asarray(pair + self._spin(state[None] + which[None] * self.moves[:, None]))

    def settled(self, start: Int[Array, " v"]) -> Int[Array, " v"]:
        """No view, and no end of the toss from any view on, wants to turn."""
        state, v = start.copy(), len(start)
        sets = [np.arange(v) >= t for t in range(1, v)] + [np.arange(v) == t for t in range(1, v)]
        for _ in range(self.config.sweeps):
            before = state.copy()
            for which in sets:
                state[which] += self.moves[int(self.moved(state, which).argmin())]
            if (state == before).all():
                break
        return state

    def greedy(self, v: int) -> Int[Array, " v"]:
        """Each view where those before want it."""
        state = np.zeros(v, dtype=np.int64)
        for t in range(1, v):
            m = np.flatnonzero((self.pairs[:, 0] == t) & (self.pairs[:, 1] < t))
            told = self._at(m, self.moves[None, :] - state[self.pairs[m, 1]][:, None]).sum(0)
            trial = np.repeat(state[None, : t + 1], self.count, 0)
            trial[:, t] = self.moves
            rates, steps = self.rates[:t], self.steps_s[:t]
            part = _Field(self.costs, self.pairs, rates, steps, self.step_rad, self.round, self.config)
            state[t] = self.moves[int((told + part._spin(trial)).argmin())]
        return state

    def sigma(self, state: Int[Array, " v"]) -> Float[Array, " v"]:
        """Standard deviation of each view's turn against the first: the widest of those that lead to it."""
        v = len(state)
        turn = (self.moves + self.count // 2) % self.count - self.count // 2
        out = np.zeros(v)
        for t in range(1, v):
            energy = self.moved(state, np.arange(v) >= t)
            share = np.exp(-(energy - energy.min()) / self.config.temperature)
            out[t] = np.sqrt(float(share @ (turn * self.step_rad) ** 2) / share.sum())
        return np.asarray(np.maximum.accumulate(out))
