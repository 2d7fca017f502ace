"""A round body's azimuth about its axis: sought over all frames at once, because no single frame fixes it.

Where the depth of all frames leaves one rotation open (a mug's, a can's), the views are unwrapped about the axis and
every pair is compared over the whole circle: does what stands off the body fall into a place that was seen empty, does
what is printed correlate (print_match.py). Both are log likelihood ratios against a random azimuth, so that a body of
one colour leaves it open and a small label fixes it, and count as far as they do not contradict themselves. The
azimuths of all frames are those that cost least together with the changes of spin: first on a grid
(azimuth_kernels.py), then off it (azimuth_smoothing.py).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array
from scipy.ndimage import minimum_filter1d

from processing.motion import se3_kernels as se3
from processing.motion.twist_terms import to_object
from processing.sensor import noise
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k
from processing.track.beam import Scene
from processing.track.revolution import azimuth_kernels as tk
from processing.track.revolution.axis import Axis, AxisConfig, angles_between
from processing.track.revolution.azimuth_smoothing import Normal, SteadyConfig, pace_of, steadied
from processing.track.revolution.print_match import PrintMatch, print_match
from processing.track.revolution.rolling import Grounded, grounded, sunk
from processing.track.revolution.unwrapping import Unwrapped, UnwrappingConfig, unwrap

NOT_COMPARED = 1e6
"""Standard deviation of what does not count."""


@dataclass(frozen=True)
class AzimuthConfig:
    """How a round body's azimuths are sought."""

    axis: AxisConfig = field(default_factory=AxisConfig)
    unwrapping: UnwrappingConfig = field(default_factory=UnwrappingConfig)
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
    shape_gain: float = noise.AZIMUTH_SHAPE_GAIN
    match: float = 2.0
    clash: float = 2.0
    """Log ratio of a cell where something stands off the body in both views, or in one where the other saw nothing."""
    standing_m: float = 0.002
    """Depth of what stands off the body errs by this ..."""
    standing_gain: float = 1.0
    """... and neighbouring pixels together, so that a view counts for so much of their sum."""
    least_standing: int = 5
    """Pixels: fewer may be anything."""
    most_shape: float = 10.0
    """A pair costs no more than this by shape (nats)."""
    usual_left: float = 0.1
    """What stands off the body contradicts itself in so large a share of what random azimuths cost even at the right
    ones: mugs of four kinds leave .02 to .09; a bottle on whose table the depth ran on left .55 and .79 ..."""
    usual_print: float = 0.07
    """... and print in so large a one: cans .003 to .05, glossy bottles whose azimuths are off by 10 to 60 degrees .1
    to .2."""
    misfit: float = 3.0
    """Where more is left than that, views err together (lamps mirrored, a shape that is none), and what they tell
    counts by this power of how often that is (docs/decisions)."""
    standing_share: float = 0.7
    """What stands off the body shows in most pairs: where random azimuths cost less than this share of `most_shape`, it
    is seen in few views (a finger, depth that runs on to the table) and counts the less, by the third power."""
    spin_change_rad_s: float = 1.5
    """Usual change of spin from view to view, on the grid."""
    fast_cost: float = 100.0
    """Spins faster than `SteadyConfig.fast_rad_s` cost their excess times this."""
    sweeps: int = 8
    longest: int = 12
    """Views of a run that are turned together."""
    rounds: int = 2
    least_sigma_deg: float = 2.0
    """What shading and the depth sensor's fixed pattern make a found azimuth err by, however sure the pairs are: those
    of cans, a bottle and mugs that claim less than 6 degrees err by 2.6 at most in the root mean square of a toss; the
    mean square of error over standard deviation is 0 to .6 with 2 degrees, 1.2 at most with 1 (docs/decisions)."""
    usual: float = 0.5
    """Inconsistency (nats a pair) that right poses leave; where more is left, the uncertainty grows with it."""


@dataclass(frozen=True)
class Trust:
    """Weights, 0..1, of appearance and of what stands off the body; how views' appearance correlates where it meets."""

    appearance: float = 1.0
    shape: float = 1.0
    correlations: tuple[float, ...] = (0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Azimuths:
    """Poses after the search, the standard deviation of each one's azimuth about the axis, and the axis."""

    poses: Float[Array, "n 4 4"]
    sigma_rad: Float[Array, " n"]
    axis: Axis
    trust: Trust = Trust()

    @property
    def covariance(self) -> Float[Array, "n 6 6"]:
        """Of the poses, by their azimuths alone (twist of the object frame)."""
        return np.asarray(self.sigma_rad[:, None, None] ** 2 * np.outer(self.axis.twist, self.axis.twist))


@dataclass(frozen=True, eq=False)
class _Frames:
    """Runs of used frames (those between which the object stands still together), a view for each, compared pairs."""

    runs: list[list[int]]
    views: Int[Array, " v"]
    pairs: Int[Array, "m 2"]


def with_uncertainty(found: Azimuths, cost: float, first: int, config: AzimuthConfig) -> Azimuths:
    """With the uncertainty that the inconsistency (`cost`, nats a pair) and usual errors leave; the first has none."""
    sigma = np.maximum(found.sigma_rad, np.radians(config.least_sigma_deg)) * max(1.0, cost / config.usual)
    sigma[first] = 0.0
    return replace(found, sigma_rad=np.asarray(sigma))


def inconsistency(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], found: Azimuths, config: AzimuthConfig
) -> float:
    """Mean cost (nats) of the compared pairs of views at these poses, appearance weighing as in `found`."""
    frames = _frames(scene, use, config)
    if len(frames.pairs) == 0:
        return 0.0
    unwrapped = unwrap(scene, poses, frames.views, found.axis, config.fine_cells, config.unwrapping)
    body = grounded(scene.store, frames.views, poses[frames.views], found.axis, unwrapped.rings)
    costs, _ = _fine_costs(unwrapped, body, frames, found.trust, config)
    return float(costs[:, config.fine_reach].mean())


def estimate_azimuths(
    scene: Scene, poses: Float[Array, "n 4 4"], rivals: list[Float[Array, "n 4 4"]], use: Bool[Array, " n"], first: int,
    axis: Axis, config: AzimuthConfig,
) -> Azimuths:  # fmt: skip
    """The poses with azimuths that fit all frames together, sought from them and from `rivals`; the first stays. As
    they are where others fit no better than by chance: half a nat for each azimuth."""
    frames = _frames(scene, use, config)
    if len(frames.pairs) == 0:
        return Azimuths(poses, np.zeros(len(poses)), axis)
    poses = _stood(poses, frames, axis, first)
    step = 2 * np.pi / config.cells
    seen, shape, standing, rest = _weighed(scene, poses, frames, axis, config)
    starts = [np.zeros(len(frames.views), dtype=np.int64)]
    apart = [angles_between(poses[frames.views], r[frames.views], axis) for r in rivals]
    starts += [np.round(a / step).astype(np.int64) % config.cells for a in apart]
    nothing, correlations = np.zeros_like(shape), seen.best_correlations()
    by_shape, by_print = _sought(_near(nothing, shape), rest, starts, config), starts[0]
    for _ in range(2):  # how much print there is, the azimuths tell that it meets best at
        appearance = seen.costs(correlations)
        by_print = _sought(_near(appearance, nothing), rest, [*starts, by_print], config)
        correlations = seen.best_correlations(_between(by_print, frames, config))
    trust = _trust(seen, by_print, (shape, by_shape), frames, config)
    costs = _pair_costs(seen, shape, trust)
    state = _sought(costs, rest, [*starts, by_print, by_shape], config)
    better = tk.energy(starts[0], costs, *rest) - tk.energy(state, costs, *rest) > 0.5 * len(state)
    state = state if better else starts[0]
    out = _moved(poses, frames, state * step, axis, first)
    spread = _azimuth_sigma_rad(frames, costs, rest, state, len(poses))
    found = Azimuths(out, spread, axis, replace(trust, shape=standing * trust.shape))
    return steady(scene, found, use, first, config) if better else found


def given_azimuths(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: AzimuthConfig
) -> Azimuths:
    """The poses as they are, with the uncertainty that all frames together leave about their azimuths."""
    frames = _frames(scene, use, config)
    if len(frames.pairs) == 0:
        return Azimuths(poses, np.zeros(len(poses)), axis)
    seen, shape, standing, rest = _weighed(scene, poses, frames, axis, config)
    state = np.zeros(len(frames.views), dtype=np.int64)
    trust = _trust(seen, state, (shape, state), frames, config)
    spread = _azimuth_sigma_rad(frames, _pair_costs(seen, shape, trust), rest, state, len(poses))
    return Azimuths(poses, spread, axis, replace(trust, shape=standing * trust.shape))


def _weighed(
    scene: Scene, poses: Float[Array, "n 4 4"], frames: _Frames, axis: Axis, config: AzimuthConfig
) -> tuple[PrintMatch, Float[Array, "m c"], float, tuple[object, ...]]:
    """How each pair's print meets at all azimuths between its views, what these cost by shape, the weight of the latter
    (which is in it), and what the search needs."""
    unwrapped = unwrap(scene, poses, frames.views, axis, config.cells, config.unwrapping)
    body = grounded(scene.store, frames.views, poses[frames.views], axis, unwrapped.rings)
    pace = pace_of(scene, poses, frames.runs, frames.views, body, config.steady)
    seen = print_match(unwrapped, frames.pairs)
    # from azimuths of -cells/2..cells/2 to azimuths of 0..cells-1
    shape = -np.roll(
        _shape_ratios(unwrapped, frames.pairs, config.cells // 2, config)[:, :-1], -(config.cells // 2), axis=1
    )
    step = 2 * np.pi / config.cells
    shape = np.minimum(_above_least(shape), config.most_shape)
    standing = min(float(shape.mean()) / (config.standing_share * config.most_shape), 1.0) ** 3
    shape = standing * (shape + _sunk(body, unwrapped, frames, step * np.arange(config.cells), config))
    usual = np.where(pace.meets, config.steady.fast_rad_s, config.spin_change_rad_s)
    motion = np.array([config.steady.fast_rad_s, config.fast_cost])
    expected = pace.expected.step_rad, pace.expected.sigma_rad
    rest = (frames.pairs, pace.base_rad, pace.steps_s, pace.still, pace.spin_weight, usual, *expected, step, motion)
    return seen, shape, standing, rest


def _sunk(
    body: Grounded, unwrapped: Unwrapped, frames: _Frames, azimuths_rad: Float[Array, " d"], config: AzimuthConfig
) -> Float[Array, "m d"]:
    return np.minimum(sunk(body, unwrapped.standing, frames.pairs, azimuths_rad, config.steady.roll), config.most_shape)


def _azimuth_sigma_rad(
    frames: _Frames, costs: Float[Array, "m c"], rest: tuple[object, ...], state: Int[Array, " v"], count: int
) -> Float[Array, " n"]:
    """Standard deviation (rad) of each frame's azimuth around those found."""
    out = np.zeros(count)
    for run, s in zip(frames.runs, np.sqrt(tk.variances(state, costs, *rest))):
        out[run] = s
    return out


def _trust(
    seen: PrintMatch, by_print: Int[Array, " v"], by_shape: tuple[Float[Array, "m c"], Int[Array, " v"]],
    frames: _Frames, config: AzimuthConfig,
) -> Trust:  # fmt: skip
    """What appearance and shape weigh, by the azimuths that fit each best."""
    correlations = seen.best_correlations(_between(by_print, frames, config))
    told = (seen.costs(correlations), by_print, config.usual_print), (*by_shape, config.usual_left)
    left = [max(_left(costs, frames.pairs, state), 1e-9) for costs, state, _ in told]
    usual = [min(u * float(costs.mean()) / x, 1.0) ** config.misfit for (costs, _, u), x in zip(told, left)]
    return Trust(min(_expected(frames) / left[0], 1.0) * usual[0], usual[1], tuple(correlations.tolist()))


def _pair_costs(seen: PrintMatch, shape: Float[Array, "m c"], trust: Trust) -> Float[Array, "m c"]:
    """What pairs cost as far as either is trusted."""
    return _near(trust.appearance * seen.costs(np.array(trust.correlations)), trust.shape * shape)


def _between(state: Int[Array, " v"], frames: _Frames, config: AzimuthConfig) -> Int[Array, " m"]:
    """Cells between the views of each pair."""
    return np.asarray((state[frames.pairs[:, 0]] - state[frames.pairs[:, 1]]) % config.cells)


def _left(costs: Float[Array, "m c"], pairs: Int[Array, "m 2"], state: Int[Array, " v"]) -> float:
    """What a pair costs in the mean."""
    near = _near(costs, np.zeros_like(costs))
    return float(near[np.arange(len(near)), (state[pairs[:, 0]] - state[pairs[:, 1]]) % near.shape[1]].mean())


def _expected(frames: _Frames) -> float:
    """Mean cost (nats) of a pair at the right azimuths, as `PrintMatch` counts it: half of its degrees of freedom."""
    m, v = len(frames.pairs), len(frames.views)
    return 0.5 * max(m - v + 1, 1) / m * v / m


def _near(appearance: Float[Array, "m c"], shape: Float[Array, "m c"]) -> Float[Array, "m c"]:
    """Costs of a cell more or less: azimuths are rounded to the grid."""
    costs = appearance + shape
    return _above_least(np.minimum(np.minimum(np.roll(costs, 1, 1), costs), np.roll(costs, -1, 1)))


def _sought(
    costs: Float[Array, "m c"], rest: tuple[object, ...], starts: list[Int[Array, " v"]], config: AzimuthConfig
) -> Int[Array, " v"]:
    """The azimuths (cells) that cost least, from several starts."""
    starts = [*starts, tk.greedy(len(starts[0]), costs, *rest)]
    found = [tk.descend(s.copy(), costs, *rest, config.sweeps, config.longest) for s in starts]
    best: Int[Array, " v"] = min(found, key=lambda s: float(tk.energy(s, costs, *rest)))
    return best


def steady(scene: Scene, found: Azimuths, use: Bool[Array, " n"], first: int, config: AzimuthConfig) -> Azimuths:
    """The azimuths off the grid, near those that were found; the uncertainty grows by what the motion leaves open."""
    frames = _frames(scene, use, config)
    poses, spread = found.poses, np.zeros(len(found.poses))
    if len(frames.pairs) == 0:
        return found
    for _ in range(config.rounds):
        unwrapped = unwrap(scene, poses, frames.views, found.axis, config.fine_cells, config.unwrapping)
        body = grounded(scene.store, frames.views, poses[frames.views], found.axis, unwrapped.rings)
        costs, cell_rad = _fine_costs(unwrapped, body, frames, found.trust, config)
        H, g = standing_terms(scene.store, poses[frames.views], frames, unwrapped.standing, found.axis, config)
        standing = found.trust.shape * H, found.trust.shape * g
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
        angle[run] = angles_between(poses[run], np.broadcast_to(poses[view], (len(run), 4, 4)), axis)
    return np.array([p @ axis.rotation(float(a - angle[first])) for p, a in zip(poses, angle)])


def _moved(
    poses: Float[Array, "n 4 4"], frames: _Frames, angle: Float[Array, " v"], axis: Axis, first: int
) -> Float[Array, "n 4 4"]:
    """The poses turned by their views' angles, less that of the first frame."""
    out = poses.copy()
    for run, a in zip(frames.runs, angle - angle[_run_of(frames.runs, first)]):
        turn = axis.rotation(float(a))
        for i in run:
            out[i] = poses[i] @ turn
    return out


def standing_terms(
    store: ViewStore, poses: Float[Array, "v 4 4"], frames: _Frames, standing: list[Float32[Array, "_ s"]], axis: Axis,
    config: AzimuthConfig,
) -> Normal:  # fmt: skip
    """How the azimuths of the frames' views (at `poses`) should change so that what stands off the body in one lies on
    its surface in the others: normal equations (v, v), (v) in rad. A thin part's outline is too blurred to count."""
    H, g = np.zeros((len(poses), len(poses))), np.zeros(len(poses))
    share = config.standing_gain * len(poses) / (2 * len(frames.pairs))
    for one, two in frames.pairs:
        for i, j in ((one, two), (two, one)):
            if len(standing[i]) < config.least_standing:
                continue
            h6, g6, full, slope = np.zeros((6, 6)), np.zeros(6), np.zeros((6, 6)), np.zeros(6)
            k.pair_terms(
                standing[i], 1, poses[j] @ se3.inverse(poses[i]), store.maps, store.table[frames.views[j]],
                store.rectified.focal, store.rectified.center, 0, config.standing_m, NOT_COMPARED, NOT_COMPARED, False,
                False, h6, g6, h6, g6, *k.NO_SHADING,
            )  # fmt: skip
            to_object(h6, g6, poses[j], 1.0, full, slope)
            stiff, pull = share * float(axis.twist @ full @ axis.twist), -share * float(axis.twist @ slope)
            H[[i, j], [i, j]] += stiff
            H[[i, j], [j, i]] -= stiff
            g[[i, j]] += pull, -pull
    return H, g


def _fine_costs(
    unwrapped: Unwrapped, body: Grounded, frames: _Frames, trust: Trust, config: AzimuthConfig
) -> tuple[Float[Array, "m d"], float]:
    """Cost of each pair for azimuths near those of the poses, in fine cells, and a cell's angle."""
    share = config.cells / config.fine_cells  # more cells, as many pixels
    reach = np.arange(-config.fine_reach, config.fine_reach + 1)
    seen = print_match(unwrapped, frames.pairs)
    appearance = share * _above_least(seen.costs(np.array(trust.correlations))[:, reach])
    shape = _above_least(-share * _shape_ratios(unwrapped, frames.pairs, config.fine_reach, config))
    shape = minimum_filter1d(np.minimum(shape, config.most_shape), 2 * config.slack + 1, axis=1, mode="nearest")
    cell_rad = 2 * np.pi / config.fine_cells
    shape += _sunk(body, unwrapped, frames, cell_rad * reach, config)
    return trust.appearance * appearance + trust.shape * shape, cell_rad


def _shape_ratios(
    unwrapped: Unwrapped, pairs: Int[Array, "m 2"], reach: int, config: AzimuthConfig
) -> Float[Array, "m d"]:
    """Log ratios by shape of each pair's azimuths of -reach..reach cells."""
    out = np.zeros((len(pairs), 2 * reach + 1))
    tk.add_shape_ratio(unwrapped.odd, unwrapped.sides, unwrapped.free, pairs, config.match, config.clash, reach, out)
    return config.shape_gain * out


def _above_least(costs: Float[Array, "m d"]) -> Float[Array, "m d"]:
    return costs - costs.min(1, keepdims=True)


def _frames(scene: Scene, use: Bool[Array, " n"], config: AzimuthConfig) -> _Frames:
    runs = scene.store.still_runs(use)
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
