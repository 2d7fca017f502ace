"""The flight of a toss solved as one: nothing touches the body there, so that a few numbers hold all its poses.

From frame to frame a fast or repetitive body leaves its turn open. Over some frames of a flight it does not: the centre
falls, the spin hardly changes, and one spin must explain every pair of views, near and far in time. All spins that the
camera's rate can tell apart are tried; what fits best is one more hypothesis, from which the beam goes on both ways.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.motion.rotation_grid import ball
from processing.sensor import view_layout as lay
from processing.track.appearance_ratio import turns_apart_deg
from processing.track.beam import BeamConfig, Hypothesis, Scene, follow
from processing.track.flight_kernels import SPIN, VELOCITY, fit_flights
from processing.track.kernels import STEPS
from processing.track.keyframes import extended
from processing.track.schedule import Schedule, rows
from recordings.geometry import rotation_exp

LEAST_SCATTER_M = 0.001
"""Centres of what depth shows scatter by more than this."""
BEHIND = 0.7
"""How far a body's centre lies behind the mean of its visible surface, in radii: 2/3 of a ball, pi/4 of a cylinder."""


@dataclass(frozen=True)
class FlightConfig:
    """How flights are found and solved."""

    least_frames: int = 6
    """Shorter ones are not told from a hand's motion."""
    longest_s: float = 1.2
    """A throw that flies for longer rises above a ceiling (1.8 m up and down)."""
    off_share: float = 0.1
    """The centre of what is seen wanders about a falling body's centre by so much of its size (root mean square)."""
    alike: float = 1.5
    """Centres scatter so many times as much about a parabola where it is not all of their way. Of the 245 frames of 26
    made tosses' longest flights 1.5 misses 92, and calls 25 others flying; 1.25: 102 and 19, 2: 86 and 40, any: 80 and
    69."""
    off_m_s2: float = 2.0
    """How far a falling centre's acceleration may be from gravity's, beyond three standard deviations."""
    most_turn_deg: float = 66.0
    """Largest turn from frame to frame that is tried: beyond, hardly anything seen in one frame is seen in the next."""
    grid_deg: float = 12.0
    """Between the turns tried."""
    rough: Schedule = ((1, 5, 0.012, 0.25, 0.010, 0.12),)
    likely: float = 0.5
    """Of all spins this share, those that cost least as they are (it held 47 of 48 solutions that all spins led to), on
    pairs of neighbouring frames ..."""
    kept: int = 24
    fine: Schedule = ((1, 6, 0.010, 0.2, 0.010, 0.2), (1, 4, 0.006, 0.15, 0.008, 0.4), (0, 4, 0.004, 0.1, 0.004, 0.5))
    """... and of the best of them, on pairs up to `lags` apart."""
    lags: int = 4
    solved_frames: int = 5
    """In the middle of a flight: over more of them the spin of a body that is no ball changes."""
    hypotheses: int = 2
    apart_deg: float = 6.0
    """Turns from frame to frame that are nearer are one."""
    same_deg: float = 4.0
    """Where all directions of time agree about the turns in a flight so well, nothing is left open."""
    other_deg: float = 20.0
    """A solution that differs by less about all turns between its frames is what the beam found."""


@dataclass(frozen=True, eq=False)
class Flight:
    """A flight solved: its frames, their poses (camera_from_object, the centre of mass at `center_m`), the spin (rad/s,
    camera axes) and what it costs."""

    frames: Int[Array, " m"]
    poses: Float[Array, "m 4 4"]
    spin_rad_s: Float[Array, "3"]
    cost: float


def flying(scene: Scene, count: int, config: FlightConfig) -> Int[Array, " m"]:
    """Of the first `count` views the longest run in which the centre of what is seen falls as a free body does; none
    where gravity is not known or nothing falls for long enough."""
    usable = np.array([i for i in range(count) if scene.store.usable(i)], dtype=np.int64)
    if len(usable) < config.least_frames or not scene.gravity_camera_m_s2.any():
        return usable[:0]
    size_m = float(np.median([_size_m(scene, int(i)) for i in usable]))
    run = fallen(scene.store.center_m[usable], scene.times_s[usable], scene.gravity_camera_m_s2, size_m, config)
    return usable[run]


def fallen(
    centers_m: Float[Array, "n 3"], t: Float[Array, " n"], gravity: Float[Array, "3"], size_m: float,
    config: FlightConfig,
) -> slice:  # fmt: skip
    """The longest run of a body's centres at times `t` that lie on a parabola of gravity's, and of that the longest
    part that lies on one about as well as its best part does: a hand's swing before the release and a bounce after the
    impact pass for noise in a long run."""
    best, off_m = slice(0, 0), config.off_share * size_m
    for a in range(len(t)):
        ends = int(np.searchsorted(t, t[a] + config.longest_s))
        for b in range(ends, a + max(config.least_frames, best.stop - best.start + 1) - 1, -1):
            if _falls(centers_m[a:b], t[a:b], gravity, off_m, config.off_m_s2):
                best = slice(a, b)
                break
    parts = [slice(a, b) for a in range(best.start, best.stop) for b in range(a + config.least_frames, best.stop + 1)]
    scatter_m = [_scatter_m(centers_m[p], t[p], gravity) for p in parts]
    most_m = config.alike * max(min(scatter_m, default=0.0), LEAST_SCATTER_M)
    alike = [(p.stop - p.start, -off, p) for p, off in zip(parts, scatter_m) if off < most_m]
    return max(alike, key=lambda x: x[:2])[2] if alike else best


def _scatter_m(centers_m: Float[Array, "n 3"], t: Float[Array, " n"], gravity: Float[Array, "3"]) -> float:
    """Standard deviation of centres about gravity's parabola through them."""
    t = t - t.mean()
    powers = np.stack([np.ones_like(t), t], -1)
    straight = centers_m - 0.5 * (t * t)[:, None] * gravity
    fit, *_ = np.linalg.lstsq(powers, straight, rcond=None)
    return float(np.sqrt(((straight - powers @ fit) ** 2).sum() / (3 * len(t) - 6)))


def _size_m(scene: Scene, view: int) -> float:
    return float(np.linalg.norm(np.ptp(_points(scene, view), axis=0)))


def _falls(
    centers_m: Float[Array, "n 3"], t: Float[Array, " n"], gravity: Float[Array, "3"], off_m: float, off_m_s2: float
) -> bool:
    """Whether centres lie on a parabola of gravity's, and not just because they are few."""
    if (np.diff(t) <= 0).any():
        return False
    t = t - t.mean()
    powers = np.stack([np.ones_like(t), t, 0.5 * t * t], -1)
    free, *_ = np.linalg.lstsq(powers, centers_m, rcond=None)
    fixed, *_ = np.linalg.lstsq(powers[:, :2], centers_m - powers[:, 2:] * gravity, rcond=None)
    left = centers_m - powers[:, 2:] * gravity - powers[:, :2] @ fixed
    if np.sqrt((left**2).sum(1).mean()) > off_m:
        return False
    sigma = off_m / np.sqrt(3) * np.sqrt(np.linalg.inv(powers.T @ powers)[2, 2])
    return bool(np.linalg.norm(free[2] - gravity) < min(3 * sigma, 0.5 * np.linalg.norm(gravity)) + off_m_s2)


def solved(scene: Scene, frames: Int[Array, " m"], config: FlightConfig) -> list[Flight]:
    """The spins that explain a flight's views best, best first."""
    middle = frames[len(frames) // 2]
    tau = scene.times_s - scene.times_s[middle]
    start = _parabola(scene, frames, tau)
    step_s = float(np.median(np.diff(scene.times_s[frames])))
    spins = ball(np.radians(config.most_turn_deg), np.radians(config.grid_deg)) / step_s
    distance = float(np.linalg.norm(scene.store.center_m[middle]))
    near = _pairs(frames, 1)
    starts = np.concatenate([np.tile(start, (len(spins), 1)), spins], 1)
    rough = rows(config.rough, distance)
    as_they_are = rough.copy()
    as_they_are[:, STEPS] = 0
    cheap = np.argsort(_fitted(scene, starts, near, tau, as_they_are)[1])[: round(config.likely * len(starts))]
    found, costs = _fitted(scene, starts[cheap], near, tau, rough)
    kept = _distinct(found, costs, step_s, config, config.kept)
    found, costs = _fitted(scene, found[kept], _pairs(frames, config.lags), tau, rows(config.fine, distance))
    out = []
    for k in _distinct(found, costs, step_s, config, config.hypotheses):
        out.append(Flight(frames, _poses(scene, found[k], frames, tau), found[k, SPIN:], float(costs[k])))
    return out


def _parabola(scene: Scene, frames: Int[Array, " m"], tau: Float[Array, " n"]) -> Float[Array, "6"]:
    """Place and velocity of the centre of mass in the middle of the flight: those of what is seen, moved behind it."""
    t = tau[frames]
    fall = 0.5 * t[:, None] ** 2 * scene.gravity_camera_m_s2
    powers = np.stack([np.ones_like(t), t], -1)
    fit, *_ = np.linalg.lstsq(powers, scene.store.center_m[frames] - fall, rcond=None)
    radius = float(np.median([_radius_m(_points(scene, int(i))) for i in frames]))
    place = fit[0] * (1 + BEHIND * radius / np.linalg.norm(fit[0]))
    return np.concatenate([place, fit[1]])


def _radius_m(points_m: Float[Array, "s 3"]) -> float:
    """Half the lesser width of what is seen, across the line of sight: of an even disc twice the standard deviation."""
    return float(2 * np.sqrt(np.linalg.eigvalsh(np.cov(points_m[:, :2].T))[0]))


def _points(scene: Scene, view: int) -> Float[Array, "s 3"]:
    row = scene.store.table[view]
    return scene.store.samples[row[lay.FIRST] : row[lay.FIRST] + row[lay.COUNT], :3].astype(np.float64)


def _pairs(frames: Int[Array, " m"], lags: int) -> Int[Array, "p 2"]:
    """Both ways."""
    one_way = [(a, b) for i, a in enumerate(frames) for b in frames[i + 1 : i + 1 + lags]]
    pairs = np.array(one_way, dtype=np.int64).reshape(-1, 2)
    return np.concatenate([pairs, pairs[:, ::-1]])


def _fitted(
    scene: Scene, starts: Float[Array, "c 9"], pairs: Int[Array, "p 2"], tau: Float[Array, " n"],
    schedule: Float[Array, "r 7"],
) -> tuple[Float[Array, "c 9"], Float[Array, " c"]]:  # fmt: skip
    store = scene.store
    return fit_flights(
        np.ascontiguousarray(starts), pairs, tau, scene.gravity_camera_m_s2, store.maps, store.samples, store.table,
        store.rectified.focal, store.rectified.center, schedule, store.config.turn_share,
    )  # fmt: skip


def _distinct(
    found: Float[Array, "c 9"], costs: Float[Array, " c"], step_s: float, config: FlightConfig, most: int
) -> list[int]:
    """The cheapest, without those that agree with a cheaper one."""
    kept: list[int] = []
    for k in np.argsort(costs):
        turns = [np.linalg.norm(found[k, SPIN:] - found[j, SPIN:]) * step_s for j in kept]
        if np.isfinite(costs[k]) and all(t > np.radians(config.apart_deg) for t in turns):
            kept.append(int(k))
        if len(kept) == most:
            break
    return kept


def _poses(
    scene: Scene, solution: Float[Array, "9"], frames: Int[Array, " m"], tau: Float[Array, " n"]
) -> Float[Array, "m 4 4"]:
    """camera_from_object, the centre of mass at the scene's `center_m`."""
    out = np.tile(np.eye(4), (len(frames), 1, 1))
    for pose, t in zip(out, tau[frames]):
        pose[:3, :3] = rotation_exp(solution[SPIN:] * t)
        center = solution[:VELOCITY] + solution[VELOCITY:SPIN] * t + 0.5 * scene.gravity_camera_m_s2 * t * t
        pose[:3, 3] = center - pose[:3, :3] @ scene.center_m
    return out


def flights_followed(
    scene: Scene, first: int, known: Hypothesis, others: list[Hypothesis], beam: BeamConfig, config: FlightConfig
) -> list[Hypothesis]:
    """What the beam makes of the solved flights, both ways from each; those that the `known` hypothesis has already are
    left out. None where the `others` all agree with it about the flight: then nothing is left open."""
    flown = np.flatnonzero(scene.flying) if scene.flying is not None else ()
    # the beam makes views again once it knows the motion between the exposures: one may have nothing left to see
    frames = np.array([i for i in flown if scene.store.usable(int(i))], dtype=np.int64)
    if len(frames) < config.least_frames:
        return []
    begin = (len(frames) - config.solved_frames) // 2
    frames = frames[begin : begin + config.solved_frames]
    if others and all(turns_apart_deg(known.poses[frames], h.poses[frames]).max() < config.same_deg for h in others):
        return []
    out = []
    for flight in solved(scene, frames, config):
        apart = turns_apart_deg(known.poses[frames], flight.poses).max()  # NaN where the other one lacks a pose
        if not apart <= config.other_deg:
            out.append(_followed(scene, flight, first, beam))
    return out


def _followed(scene: Scene, flight: Flight, first: int, beam: BeamConfig) -> Hypothesis:
    """The beam from the flight's first frame back to `first`, and from its last on to the end."""
    n, frames = len(scene.times_s), tuple(int(i) for i in flight.frames)
    poses, costs, on = np.full((n, 4, 4), np.nan), np.full(n, np.nan), np.full(n, np.nan)
    poses[flight.frames], costs[flight.frames], on[flight.frames] = flight.poses, flight.cost, 1.0
    keys = extended(frames[:1], poses, frames, beam.keyframes)
    h = Hypothesis(poses, costs, on, frames[::-1], keys, 0.0)
    h, _ = follow(scene, np.arange(frames[0] - 1, first - 1, -1), [h], beam)
    ahead = replace(h, done=tuple(range(first, frames[-1] + 1)))
    return follow(scene, np.arange(frames[-1] + 1, n), [ahead], beam)[0]
