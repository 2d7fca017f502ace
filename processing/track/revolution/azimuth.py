"""A round body's turn about its axis: sought over all turns and all frames at once, because no single frame tells it.

Where the depth of all frames leaves one turn open (a mug's, a can's), the views are laid out about the axis (unwrapping.py)
and every pair is compared over that whole turn: does what stands off the body fall into a place that was seen empty, do
looks that are rare at their height meet. Evidence is a log likelihood ratio against a random turn, so that a body of
one colour says nothing and a small label much. The turns of all frames are those that cost least together with the
changes of spin: first on a grid (azimuth_kernels.py), then off it, where steady spin tells what the images leave open
(azimuth_smoothing.py). What even that leaves open is told as a standard deviation per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array
from scipy.ndimage import minimum_filter1d

from processing.sensor.view import ViewStore
from processing.track import kernels as k
from processing.track.beam import Scene
from processing.track.revolution import azimuth_kernels as tk
from processing.track.revolution.axis import Axis, AxisConfig
from processing.track.revolution.azimuth_smoothing import Normal, SteadyConfig, pace_of, steadied
from processing.track.revolution.rolling import Grounded, grounded, sunk
from processing.track.revolution.unwrapping import ChartConfig, Charts, charts_of

NOT_COMPARED = 1e6
"""Standard deviation of what does not count."""


@dataclass(frozen=True)
class TurnConfig:
    """How a round body's turns are sought."""

    axis: AxisConfig = field(default_factory=AxisConfig)
    chart: ChartConfig = field(default_factory=ChartConfig)
    steady: SteadyConfig = field(default_factory=SteadyConfig)
    cells: int = 120
    fine_cells: int = 240
    fine_reach: int = 20
    """Cells of the circle on the grid and off it, and how many of the latter a pair is compared over."""
    slack: int = 4
    """Fine cells that a pair's shape leaves open: a handle is thick, and no view sees both of its sides."""
    near: tuple[int, ...] = (1, 2, 3, 4, 6)
    """Steps in time over which views are always compared ..."""
    pairs: int = 12
    """... and how many others a view is compared with, spread over time."""
    least_sigma: float = 0.05
    wider: float = 1.3
    """Colours match within this, or this often the usual difference of views far apart in time ..."""
    far_steps: int = 5
    outlier: float = 0.1
    """... but for so many."""
    dead: float = 0.5
    """A cell's log ratio below this is chance ..."""
    looks_gain: float = 0.125
    shape_gain: float = 0.25
    """... and neighbouring cells err together: so much of their sum counts."""
    match: float = 2.0
    clash: float = 2.0
    """Log ratio of a cell where something stands off the body in both views, or in one where the other saw nothing."""
    standing_m: float = 0.002
    """Depth of what stands off the body errs by this ..."""
    standing_gain: float = 1.0
    """... and neighbouring pixels together, so that a view counts for so much of their sum."""
    least_standing: int = 5
    """Pixels: fewer may be anything."""
    pair_dead: float = 2.0
    fine_dead: float = 0.5
    """A pair's looks below this are the light's."""
    most_looks: float = 6.0
    most_shape: float = 10.0
    """A pair's word counts no more than this: highlights look like labels, but nothing looks like a handle."""
    left: float = 0.25
    """Mean of a pair's looks that even the best turns contradict; where more is left, looks stay with the room (a
    lamp's mirror images, shadows) and count the less ..."""
    left_share: float = 0.35
    """... or where it is more than this share of what random turns leave: then looks are noise."""
    trusted: float = 0.7
    """Looks that count less than this make the search start again."""
    spin_change_rad_s: float = 1.5
    """Usual change of spin from view to view, on the grid."""
    fast_rad_s: float = 25.0
    fast_price: float = 100.0
    """Spins above this cost their excess times this."""
    sweeps: int = 8
    longest: int = 12
    """Views of a run that is turned together."""
    rounds: int = 2
    least_sigma_deg: float = 4.0
    """What shading and the depth sensor's fixed pattern make a found turn err by, however sure the pairs are."""
    usual: float = 0.5
    """Contradiction that right poses leave; where more is left, something is wrong and doubt grows with it."""


@dataclass(frozen=True, eq=False)
class Turned:
    """Poses after the search, the standard deviation of each one's turn about the axis, and the axis."""

    poses: Float[Array, "n 4 4"]
    sigma_rad: Float[Array, " n"]
    axis: Axis
    trust: float = 1.0
    """How much looks were believed."""


@dataclass(frozen=True, eq=False)
class _Frames:
    """Runs of used frames (those between which the object stands still together), a view for each, compared pairs."""

    runs: list[list[int]]
    views: Int[Array, " v"]
    pairs: Int[Array, "m 2"]


def doubted(found: Turned, said: float, first: int, config: TurnConfig) -> Turned:
    """With the doubt that what still speaks against the poses (`said`) and the usual errors leave; the first frame
    has none."""
    sigma = np.maximum(found.sigma_rad, np.radians(config.least_sigma_deg)) * max(1.0, said / config.usual)
    sigma[first] = 0.0
    return replace(found, sigma_rad=np.asarray(sigma))


def contradiction(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], found: Turned, config: TurnConfig
) -> float:
    """What the pairs of views that the search compares say against these poses, mean over pairs, looks as much believed
    as in `found`."""
    frames = _frames(scene, use, config)
    if len(frames.pairs) == 0:
        return 0.0
    charts = charts_of(scene, poses, frames.views, found.axis, config.fine_cells, config.chart)
    body = grounded(scene.store, frames.views, poses[frames.views], found.axis, charts.rings)
    costs, _ = _fine_costs(charts, body, frames, found.trust, config)
    return float(costs[:, config.fine_reach].mean())


def turned(
    scene: Scene, poses: Float[Array, "n 4 4"], rivals: list[Float[Array, "n 4 4"]], use: Bool[Array, " n"], first: int,
    axis: Axis, config: TurnConfig,
) -> Turned:  # fmt: skip
    """The poses with the turns about `axis` that all frames together say; `rivals` are other stories to start from.
    The first frame's pose stays."""
    frames = _frames(scene, use, config)
    if len(frames.pairs) == 0:
        return Turned(poses, np.zeros(len(poses)), axis)
    poses = _stood(poses, frames, axis, first)
    step = 2 * np.pi / config.cells
    looks, shape, rest = _weighed(scene, poses, frames, axis, config)
    starts = [np.zeros(len(frames.views), dtype=np.int64)]
    starts += [np.round(_angles(poses[frames.views], r[frames.views], axis) / step).astype(np.int64) % config.cells
               for r in rivals]  # fmt: skip
    state, trust = _sought(_near(looks, shape), rest, starts, config), 1.0
    believed = _believed(looks, frames.pairs, state, config)
    if believed < config.trusted:
        trust = believed
        state = _sought(_near(trust * looks, shape), rest, [*starts, state], config)
    out = _moved(poses, frames, state * step, axis, first)
    spread = _spread(frames, _near(trust * looks, shape), rest, state, len(poses))
    return steady(scene, Turned(out, spread, axis, trust), use, first, config)


def given_turns(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: TurnConfig
) -> Turned:
    """The poses as they are, with the doubt that all frames together leave about their turns."""
    frames = _frames(scene, use, config)
    if len(frames.pairs) == 0:
        return Turned(poses, np.zeros(len(poses)), axis)
    looks, shape, rest = _weighed(scene, poses, frames, axis, config)
    state = np.zeros(len(frames.views), dtype=np.int64)
    believed = _believed(looks, frames.pairs, state, config)
    trust = believed if believed < config.trusted else 1.0
    return Turned(poses, _spread(frames, _near(trust * looks, shape), rest, state, len(poses)), axis, trust)


def _weighed(
    scene: Scene, poses: Float[Array, "n 4 4"], frames: _Frames, axis: Axis, config: TurnConfig
) -> tuple[Float[Array, "m c"], Float[Array, "m c"], tuple[object, ...]]:
    """What each pair says against all turns of its two views, by looks and by shape, and what else the search needs."""
    charts = charts_of(scene, poses, frames.views, axis, config.cells, config.chart)
    body = grounded(scene.store, frames.views, poses[frames.views], axis, charts.rings)
    pace = pace_of(scene, poses, frames.runs, frames.views, body, config.steady)
    looks, shape = _said(charts, frames.pairs, config.cells // 2, None, config)
    # from turns by -cells/2..cells/2 to turns by 0..cells-1
    looks, shape = (np.roll(c[:, :-1], -(config.cells // 2), axis=1) for c in (looks, -shape))
    looks = np.minimum(np.maximum(_above_least(looks) - config.pair_dead, 0.0), config.most_looks)
    step = 2 * np.pi / config.cells
    shape = np.minimum(_above_least(shape), config.most_shape)
    shape += _sunk(body, charts, frames, step * np.arange(config.cells), config)
    motion = np.array([config.spin_change_rad_s, config.fast_rad_s, config.fast_price])
    told = pace.told.turn_rad, pace.told.sigma_rad
    return looks, shape, (frames.pairs, pace.base_rad, pace.steps_s, pace.still, pace.price, *told, step, motion)


def _sunk(
    body: Grounded, charts: Charts, frames: _Frames, turns_rad: Float[Array, " d"], config: TurnConfig
) -> Float[Array, "m d"]:
    return np.minimum(sunk(body, charts.standing, frames.pairs, turns_rad, config.steady.roll), config.most_shape)


def _spread(
    frames: _Frames, costs: Float[Array, "m c"], rest: tuple[object, ...], state: Int[Array, " v"], count: int
) -> Float[Array, " n"]:
    """Standard deviation (rad) of each frame's turn around those found."""
    out = np.zeros(count)
    for run, s in zip(frames.runs, np.sqrt(tk.spreads(state, costs, *rest))):
        out[run] = s
    return out


def _believed(
    looks: Float[Array, "m c"], pairs: Int[Array, "m 2"], state: Int[Array, " v"], config: TurnConfig
) -> float:
    """How much looks count: fully where the found turns contradict few of them, and far fewer than random turns do."""
    costs = _near(looks, np.zeros_like(looks))
    left = costs[np.arange(len(costs)), (state[pairs[:, 0]] - state[pairs[:, 1]]) % config.cells].mean()
    usual = min(config.left, max(config.left_share * costs.mean(), 1e-6))
    return float(1 / (1 + (left / usual) ** 2))


def _near(looks: Float[Array, "m c"], shape: Float[Array, "m c"]) -> Float[Array, "m c"]:
    """Costs of a cell more or less: turns are rounded to the grid."""
    costs = looks + shape
    return _above_least(np.minimum(np.minimum(np.roll(costs, 1, 1), costs), np.roll(costs, -1, 1)))


def _sought(
    costs: Float[Array, "m c"], rest: tuple[object, ...], starts: list[Int[Array, " v"]], config: TurnConfig
) -> Int[Array, " v"]:
    """The turns (cells) that cost least, from several starts."""
    starts = [*starts, tk.greedy(len(starts[0]), costs, *rest)]
    found = [tk.settle(s.copy(), costs, *rest, config.sweeps, config.longest) for s in starts]
    best: Int[Array, " v"] = min(found, key=lambda s: float(tk.energy(s, costs, *rest)))
    return best


def steady(scene: Scene, found: Turned, use: Bool[Array, " n"], first: int, config: TurnConfig) -> Turned:
    """The turns off the grid, near those that were found; what the motion leaves open is added to the doubt."""
    frames = _frames(scene, use, config)
    poses, spread = found.poses, np.zeros(len(found.poses))
    if len(frames.pairs) == 0:
        return found
    for _ in range(config.rounds):
        charts = charts_of(scene, poses, frames.views, found.axis, config.fine_cells, config.chart)
        body = grounded(scene.store, frames.views, poses[frames.views], found.axis, charts.rings)
        costs, cell_rad = _fine_costs(charts, body, frames, found.trust, config)
        standing = turns_of_standing(scene.store, poses[frames.views], frames, charts.standing, found.axis, config)
        pace = pace_of(scene, poses, frames.runs, frames.views, body, config.steady)
        start = _run_of(frames.runs, first)
        angle, sigma = steadied(costs, frames.pairs, standing, pace, cell_rad, start, config.steady)
        poses = _moved(poses, frames, angle, found.axis, first)
        for run, s in zip(frames.runs, sigma):
            spread[run] = s
    return replace(found, poses=poses, sigma_rad=np.sqrt(found.sigma_rad**2 + spread**2))


def _stood(poses: Float[Array, "n 4 4"], frames: _Frames, axis: Axis, first: int) -> Float[Array, "n 4 4"]:
    """Frames of one run turned as their view is; the first frame's pose stays, the others turn with its run."""
    angle = np.zeros(len(poses))
    for run, view in zip(frames.runs, frames.views):
        angle[run] = _angles(poses[run], np.broadcast_to(poses[view], (len(run), 4, 4)), axis)
    return np.array([p @ axis.turn(float(a - angle[first])) for p, a in zip(poses, angle)])


def _moved(
    poses: Float[Array, "n 4 4"], frames: _Frames, angle: Float[Array, " v"], axis: Axis, first: int
) -> Float[Array, "n 4 4"]:
    """The poses turned by their views' angles, less that of the first frame."""
    out = poses.copy()
    for run, a in zip(frames.runs, angle - angle[_run_of(frames.runs, first)]):
        turn = axis.turn(float(a))
        for i in run:
            out[i] = poses[i] @ turn
    return out


def turns_of_standing(
    store: ViewStore, poses: Float[Array, "v 4 4"], frames: _Frames, standing: list[Float32[Array, "_ s"]], axis: Axis,
    config: TurnConfig,
) -> Normal:  # fmt: skip
    """How the turns of the frames' views (at `poses`) should change so that what stands off the body in one lies on its
    surface in the others: normal equations (v, v), (v) in rad. A thin part's outline is too blurred to count."""
    H, g = np.zeros((len(poses), len(poses))), np.zeros(len(poses))
    share = config.standing_gain * len(poses) / (2 * len(frames.pairs))
    for one, two in frames.pairs:
        for i, j in ((one, two), (two, one)):
            if len(standing[i]) < config.least_standing:
                continue
            h6, g6, full, slope = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
            k.pair_terms(
                standing[i], 1, poses[j] @ k.inverse(poses[i]), store.maps, store.table[frames.views[j]],
                store.optics.focal, store.optics.center, 0, config.standing_m, NOT_COMPARED, NOT_COMPARED, False,
                h6, g6,
            )  # fmt: skip
            k.to_object(h6, g6, poses[j], 1.0, full, slope)
            stiff, pull = share * float(axis.twist @ full @ axis.twist), -share * float(axis.twist @ slope)
            H[[i, j], [i, j]] += stiff
            H[[i, j], [j, i]] -= stiff
            g[[i, j]] += pull, -pull
    return H, g


def _fine_costs(
    charts: Charts, body: Grounded, frames: _Frames, trust: float, config: TurnConfig
) -> tuple[Float[Array, "m d"], float]:
    """What each pair says against turns near those of the poses, in fine cells, and a cell's angle."""
    here = np.zeros(len(frames.views), dtype=np.int64)
    share = config.cells / config.fine_cells  # more cells, as many witnesses
    looks, shape = _said(charts, frames.pairs, config.fine_reach, here, config)
    looks, shape = _above_least(share * looks), _above_least(-share * shape)
    looks = np.minimum(np.maximum(looks - config.fine_dead, 0.0), config.most_looks)
    shape = minimum_filter1d(np.minimum(shape, config.most_shape), 2 * config.slack + 1, axis=1, mode="nearest")
    cell_rad = 2 * np.pi / config.fine_cells
    turns_rad = cell_rad * np.arange(-config.fine_reach, config.fine_reach + 1)
    return trust * looks + shape + _sunk(body, charts, frames, turns_rad, config), cell_rad


def _said(
    charts: Charts, pairs: Int[Array, "m 2"], reach: int, state: Int[Array, " v"] | None, config: TurnConfig
) -> tuple[Float[Array, "m d"], Float[Array, "m d"]]:
    """Costs by looks, and evidence by shape, of each pair's turns by -reach..reach cells."""
    looks, shape = np.zeros((len(pairs), 2 * reach + 1)), np.zeros((len(pairs), 2 * reach + 1))
    sigma = np.maximum(config.wider * _differences(charts, pairs, state, config), config.least_sigma)
    usual = _usual(charts, sigma)
    tk.said_by_looks(charts.looks, charts.count, usual, pairs, sigma, config.outlier, config.dead, reach, looks)
    tk.said_by_shape(charts.odd, charts.sides, charts.free, pairs, config.match, config.clash, reach, shape)
    return -config.looks_gain * looks, config.shape_gain * shape


def _above_least(costs: Float[Array, "m d"]) -> Float[Array, "m d"]:
    return costs - costs.min(1, keepdims=True)


def _differences(
    charts: Charts, pairs: Int[Array, "m 2"], state: Int[Array, " v"] | None, config: TurnConfig
) -> Float[Array, "2"]:
    """Standard deviation (from the median) of a cell's looks between views far apart in time: in `state`, or (None)
    over all turns."""
    far = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) >= config.far_steps]
    far = far if len(far) >= 10 else pairs
    width, counts = 0.001, np.zeros((2, 2000))
    turns = np.zeros(len(charts.looks), dtype=np.int64) if state is None else state
    tk.differences(charts.looks, charts.count, far, turns, 10 if state is None else 0, width, counts)
    middle = [width * (np.searchsorted(np.cumsum(c), c.sum() / 2) + 0.5) for c in counts]
    return np.asarray(1.48 / np.sqrt(2) * np.array(middle))


def _usual(charts: Charts, sigma: Float[Array, "2"]) -> Float[Array, "v r c"]:
    """Log density of each cell's looks among all that its row shows: a turn only shuffles a row."""
    out = np.zeros(charts.count.shape)
    for r in range(charts.count.shape[1]):
        use = charts.count[:, r] > 0
        if use.sum() < 5:
            continue
        seen = charts.looks[:, r][use]
        at = np.clip(np.round((seen - np.median(seen, axis=0)) / sigma) + 30, 0, 60).astype(int)
        shares = np.zeros((61, 61))
        np.add.at(shares, (at[:, 0], at[:, 1]), 1.0 / len(at))
        dense = 0.97 * cv2.GaussianBlur(shares, (0, 0), float(np.sqrt(2.0))) + 0.03 / shares.size
        out[:, r][use] = np.log(dense[at[:, 0], at[:, 1]] / (sigma[0] * sigma[1]))
    return out


def _frames(scene: Scene, use: Bool[Array, " n"], config: TurnConfig) -> _Frames:
    runs: list[list[int]] = []
    for i in np.flatnonzero(use):
        if runs and runs[-1][-1] == i - 1 and scene.store.stands_still(int(i) - 1, int(i)):
            runs[-1].append(int(i))
        else:
            runs.append([int(i)])
    views = np.array([run[len(run) // 2] for run in runs], dtype=np.int64)
    chosen = set()
    for a in range(len(runs)):
        chosen |= {(a, a - s) for s in config.near if s <= a}
        earlier = [b for b in range(a) if (a, b) not in chosen]
        if earlier:
            spread = np.unique(np.linspace(0, len(earlier) - 1, config.pairs).round().astype(int))
            chosen |= {(a, earlier[p]) for p in spread}
    return _Frames(runs, views, np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2))


def _run_of(runs: list[list[int]], frame: int) -> int:
    return next((n for n, run in enumerate(runs) if frame in run), 0)


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
