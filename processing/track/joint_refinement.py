"""Joint refinement: every view against every view that sees the same surface, all poses at once (Gauss-Newton).

The residuals are the images themselves (depth, grey, outline) of each pair, so that a pair of far apart times closes a
loop without a feature match; a weak pull towards free flight holds what the images leave open. Solved for twists
(translation, rotation) of the object frame per view: object_from_camera <- exp(twist) object_from_camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.motion.interpolate import turns_between
from processing.motion.motion_prior import free_change_rad_s, free_jerk_rad_s
from processing.sensor import noise
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k
from processing.track.depth_error.fields import DepthErrors
from processing.track.keyframes import view_directions
from processing.track.pairs import compared
from processing.track.schedule import Schedule, rows
from recordings.estimation.robust import cauchy_weight, geman_mcclure_weight
from recordings.geometry import rotation_log, skew


@dataclass(frozen=True)
class GraphConfig:
    """Which pairs are compared, how long, and how much free flight weighs."""

    neighbours: int = 2
    """Frames before and after that a view is compared with."""
    loops: int = 6
    """Views from near directions, whatever their time, that a view is compared with."""
    co_visible_deg: float = 50.0
    least_loops: int = 2
    wide_deg: float = 70.0
    """A view with fewer loops takes some from directions so far apart: they err more, but a chain drifts."""
    spread_in_time: int = 3
    """Of frames nearer to each other in time than this, or between which the object stands still, only one is taken for
    loops."""
    schedule: Schedule = (
        (1, 2, 0.006, 0.4, 0.008, 0.3),
        (0, 3, 0.004, 0.4, 0.006, 0.5),
        (0, 3, 0.003, 0.15, 0.002, 1.0),
        (0, 5, 0.0035, 0.08, 0.002, 1.0),
    )
    """The last row weighs appearance more: it errs by a tenth of a pixel, and whole patches of depth err together. The
    outline, good to half a pixel, holds the rotation of bodies whose appearance varies little."""
    sure_cost: float = 0.08
    """A pair that fits worse counts less."""
    spin_change_rad_s: float = 0.5
    """Standard deviation of the change of spin between frames (not an impact), beyond what a free body's changes by."""
    velocity_change_m_s: float = 0.06
    """... and of the velocity beyond gravity's share."""
    jerk_rad_s: float | None = 0.25
    """Standard deviation of the change of that change: spin changes slowly in flight and while an arm swings."""
    still_rad: float = 0.003
    still_m: float = 0.0002
    """What a body that stands still may move between frames (standard deviation)."""
    carried_rad: float = 0.0003
    carried_m: float = 0.00012
    """Standard deviation of what a held body moves in the hand from frame to frame (slipping is an outlier): the arm's
    repeatability, .1 mm (Franka Emika, data sheet, ISO 9283), and what that turns at a third of a metre ..."""
    held_rad: float = 0.08
    held_m: float = 0.015
    """... and what moves more is not held."""
    round_body: bool = False
    """Surfaces that turn away from the camera and brightness count little: on a round body they stay with the view."""
    shared_noise: float = noise.PAIRS_PER_MEASUREMENT
    depth_errors: noise.DepthNoise | None = None
    """How the depth of each view errs, which is then solved for with the poses; None: depth is taken as it is."""


def steady_motion() -> GraphConfig:
    """Settings under which steady motion outweighs what the images show."""
    rough = ((1, 6, 0.006, 0.4, 0.008, 0.3), (1, 6, 0.006, 0.4, 0.008, 0.5))
    return GraphConfig(
        shared_noise=noise.STEADY_PAIRS_PER_MEASUREMENT, jerk_rad_s=0.1, schedule=(*rough, *GraphConfig().schedule[1:])
    )


def round_views() -> GraphConfig:
    """Settings for views that a round body's profile ties already: pairs of them, which drift, count little."""
    fine = ((1, 2, 0.006, 0.4, 0.008, 0.3), (0, 4, 0.003, 0.15, 0.005, 0.3), (0, 6, 0.0035, 0.08, 0.005, 0.3))
    return GraphConfig(round_body=True, shared_noise=noise.ROUND_PAIRS_PER_MEASUREMENT, schedule=fine)


@runtime_checkable
class Terms(Protocol):
    """What else is known of poses."""

    def add(
        self, H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], place: Int[Array, " n"]
    ) -> None:
        """Adds to normal equations for the twists of the object frame per unknown; `place`: that of each view, -1
        where it is fixed."""


@dataclass(frozen=True, eq=False)
class Motion:
    """What the pull towards free flight needs: times, gravity (camera axes), the body's center of mass (object frame),
    and which views follow each other within one toss (views of other tosses have other numbers)."""

    times_s: Float[Array, " n"]
    toss: Int[Array, " n"]
    gravity_camera_m_s2: Float[Array, "3"]
    center_m: Float[Array, "3"]
    still: Bool[Array, " n"]
    """Whether the object stands still between each view and the one before it in its toss."""
    carried: Mapping[tuple[int, int], Float[Array, "4 4"]] = field(default_factory=dict)
    """How the robot's hand moves (camera axes) from one view to the next."""


@dataclass(frozen=True, eq=False)
class Refined:
    """Poses after joint refinement, the covariance of each (twist of the object frame, translation first), the pairs
    (i, k) and their figures: mean cost, share on the surface, share of violations."""

    poses: Float[Array, "n 4 4"]
    covariance: Float[Array, "n 6 6"]
    pairs: Int[Array, "m 2"]
    figures: Float[Array, "m 3"]


def choose_pairs(
    poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], toss: Int[Array, " n"], center_m: Float[Array, "3"],
    still: Bool[Array, " n"], config: GraphConfig,
) -> Int[Array, "m 2"]:  # fmt: skip
    """Pairs (i, k), both ways: neighbours in time, and views from near directions spread over time and tosses. `still`:
    whether the object stands still between each view and the one before it."""
    index = np.flatnonzero(use)
    directions = view_directions(poses[index], center_m)
    cosine = np.clip(directions @ directions.T, -1, 1)
    chosen: set[tuple[int, int]] = set()
    # plain numbers: arrays' own are slow to compare one by one
    whose, stay, views = toss.tolist(), np.cumsum(~still).tolist(), index.tolist()
    near, wide = np.cos(np.radians(config.co_visible_deg)), np.cos(np.radians(config.wide_deg))
    for a, i in enumerate(views):
        later = [j for j in views[a + 1 : a + 1 + config.neighbours] if whose[j] == whose[i]]
        taken = [i, *later]
        chosen.update((i, j) for j in later)
        wanted = config.loops
        for b in np.argsort(-cosine[a]).tolist():
            j = views[b]
            few = config.loops - wanted < config.least_loops
            if wanted == 0 or cosine[a, b] < (wide if few else near):
                break
            if any(whose[j] == whose[t] and (abs(j - t) < config.spread_in_time or stay[j] == stay[t]) for t in taken):
                continue
            taken.append(j)
            chosen.add((min(i, j), max(i, j)))
            wanted -= 1
    one_way = np.array(sorted(chosen), dtype=np.int64).reshape(-1, 2)
    return np.concatenate([one_way, one_way[:, ::-1]])


def refine(
    store: ViewStore,
    poses: Float[Array, "n 4 4"],
    use: Bool[Array, " n"],
    fixed: Bool[Array, " n"],
    motion: Motion,
    config: GraphConfig,
    held: Float[Array, "6"] | None = None,
    tied: Int[Array, " n"] | None = None,
    priors: Sequence[Terms] = (),
) -> Refined:
    """All poses in `use` at once; those in `fixed` stay. `poses` of other views are returned as they are. No pose moves
    along the twist `held`, where there is one, but for all of them together where others are fixed. Views with the
    same number in `tied` move as one (not at all with a fixed one); those with -1 move alone. `priors`: what else is
    known of the poses."""
    poses = poses.copy()
    free = use & ~fixed
    place = np.where(free, np.cumsum(free) - 1, -1)
    if tied is not None:
        place = _tied(place, np.where(use, tied, -1))
    pairs = choose_pairs(poses, use, motion.toss, motion.center_m, motion.still, config)
    pairs = pairs[place[pairs[:, 0]] != place[pairs[:, 1]]]
    distance = float(np.median(np.linalg.norm(store.center_m[use], axis=1)))
    figures = np.zeros((len(pairs), 3))
    H = np.eye(6 * (int(place.max(initial=-1)) + 1))
    errs = config.depth_errors
    errors = None if errs is None else DepthErrors(store, use, errs, config.shared_noise, config.sure_cost)
    for row in rows(config.schedule, distance, config.round_body):
        for _ in range(int(row[k.STEPS])):
            H, g, figures = _normal_equations(store, poses, use, pairs, place, row, motion, config, priors, errors)
            if held is not None:
                _hold(H, held, together=bool((use & fixed).any()))
            step = -np.linalg.solve(H + np.diag(1e-6 * np.diag(H) + 1e-9), g).reshape(-1, 6)
            taken = step / np.maximum(np.linalg.norm(step.reshape(-1, 2, 3), axis=2) / (0.03, 0.2), 1.0).max(1)[:, None]
            for i in np.flatnonzero(place >= 0):
                poses[i] = poses[i] @ se3.inverse(se3.exponential(taken[place[i]]))
            if errors is not None:
                errors.follow(taken)
            if np.abs(step[:, :3]).max(initial=0) < 3e-5 and np.abs(step[:, 3:]).max(initial=0) < 3e-4:
                break
    return Refined(poses, _covariances(H, place), pairs, figures)


def _tied(place: Int[Array, " n"], tied: Int[Array, " n"]) -> Int[Array, " n"]:
    """Unknowns (-1: none) of views, where those that are tied share theirs."""
    out = place.copy()
    for t in np.unique(tied[tied >= 0]):
        out[tied == t] = out[tied == t].min()
    left = np.unique(out[out >= 0])
    return np.where(out >= 0, np.searchsorted(left, out), -1)


def _hold(H: Float[Array, "f f"], held: Float[Array, "6"], together: bool) -> None:
    """Takes one twist of the object frame out of every view's freedom, or but for one by which all move `together`."""
    views = len(H) // 6
    each = np.eye(views) - (1.0 / max(views, 1) if together else 0.0)
    stiff = 1e3 * np.trace(H) / max(len(H), 1) * np.outer(held, held) / float(held @ held)
    H += np.kron(each, stiff)


def _normal_equations(
    store: ViewStore, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], pairs: Int[Array, "m 2"],
    place: Int[Array, " n"], row: Float[Array, "7"], motion: Motion, config: GraphConfig,
    priors: Sequence[Terms], errors: DepthErrors | None,
) -> tuple[Float[Array, "f f"], Float[Array, " f"], Float[Array, "m 3"]]:  # fmt: skip
    count = int(place.max()) + 1
    H, g = np.zeros((count, count, 6, 6)), np.zeros((count, 6))
    if errors is None:
        blocks, gradients, figures = compared(store, poses, pairs, row, shaded=not config.round_body)
        weight = cauchy_weight((figures[:, 0] / config.sure_cost) ** 2) / config.shared_noise
        add_pairs(H, g, blocks * weight[:, None, None], gradients * weight[:, None], place[pairs])
    else:
        figures = errors.add(H, g, poses, pairs, place, row)
    _add_motion(H, g, poses, use, place, motion, config)
    for terms in priors:
        terms.add(H, g, poses, place)
    return H.transpose(0, 2, 1, 3).reshape(6 * count, 6 * count), g.reshape(-1), figures


def add_pairs(
    H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], blocks: Float[Array, "m 6 6"], gradients: Float[Array, "m 6"],
    places: Int[Array, "m 2"],
) -> None:  # fmt: skip
    """Adds terms of pairs of views, given for the twist of each one's first, to normal equations; `places`: each
    view's unknown, -1 where it is fixed."""
    i, j = places[:, 0], places[:, 1]
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        ok = (a >= 0) & (b >= 0)
        np.add.at(H, (a[ok], b[ok]), sign * blocks[ok])
    np.add.at(g, i[i >= 0], gradients[i >= 0])
    np.add.at(g, j[j >= 0], -gradients[j >= 0])


def _add_motion(
    H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], use: Bool[Array, " n"],
    place: Int[Array, " n"], motion: Motion, config: GraphConfig,
) -> None:  # fmt: skip
    """Adds the pull towards constant spin and ballistic centre over each three views in a row; impacts are outliers
    (`_accepted`). The residuals are changes of spin (rad/s) and of velocity (m/s), camera axes."""
    index = np.flatnonzero(use)
    _add_ties(H, g, poses, index, place, motion, config)
    if config.jerk_rad_s is not None:
        _add_smooth(H, g, poses, index, place, motion, config.jerk_rad_s)
    three = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    a, b, c = three.T
    three = three[(motion.toss[a] == motion.toss[c]) & ~motion.still[b] & ~motion.still[c]]
    times_s = motion.times_s[three]
    residual, jacobians = motion_residual(poses[three], times_s, motion)
    span_s = times_s[:, 2] - times_s[:, 0]
    fast = np.linalg.norm(turns_between(poses[three[:, 2]], poses[three[:, 0]]), axis=1) / span_s
    spin_sigma = np.hypot(config.spin_change_rad_s, free_change_rad_s(fast, 0.5 * span_s))
    sigma = np.column_stack([spin_sigma, np.full(len(three), config.velocity_change_m_s)])
    weight = _accepted(residual.reshape(-1, 2, 3) / sigma[:, :, None]) / sigma**2
    _add_terms(H, g, place[three], jacobians, residual, np.repeat(weight, 3, axis=1))


def _add_smooth(
    H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], index: Int[Array, " m"],
    place: Int[Array, " n"], motion: Motion, sigma_rad_s: float,
) -> None:  # fmt: skip
    """Adds the pull towards a steady change of spin over each four views in a row (rad/s, camera axes; `_accepted`)."""
    four = np.stack([index[:-3], index[1:-2], index[2:-1], index[3:]], axis=1)
    four = four[(motion.toss[four] == motion.toss[four[:, :1]]).all(axis=1) & ~motion.still[four[:, 1:]].any(axis=1)]
    steps = np.diff(motion.times_s[four], axis=1)
    spins = np.stack([turns_between(poses[four[:, n + 1]], poses[four[:, n]]) for n in range(3)], axis=1)
    spins /= steps[:, :, None]
    residual = spins[:, 2] - 2 * spins[:, 1] + spins[:, 0]
    fast = np.median(np.linalg.norm(spins, axis=2), axis=1)
    sigma = np.hypot(sigma_rad_s, free_jerk_rad_s(fast, steps.mean(axis=1)))
    weight = _accepted(residual / sigma[:, None]) / sigma**2
    one, two, three = 1 / steps.T
    shares = np.stack([-one, one + 2 * two, -2 * two - three, three], axis=1)
    jacobians = np.zeros((*four.shape, 3, 6))
    jacobians[..., 3:] = -shares[:, :, None, None] * poses[four][..., :3, :3]
    _add_terms(H, g, place[four], jacobians, residual, np.repeat(weight[:, None], 3, axis=1))


def _add_terms(
    H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], places: Int[Array, "m v"], jacobians: Float[Array, "m v r 6"],
    residual: Float[Array, "m r"], weight: Float[Array, "m r"],
) -> None:  # fmt: skip
    """Adds residuals of several views each; `places`: each view's unknown, -1 where it is fixed."""
    weighed, free = weight[:, None, :, None] * jacobians, places >= 0
    np.add.at(g, places[free], np.einsum("mvrd,mr->mvd", weighed, residual)[free])
    for x in range(places.shape[1]):
        for y in range(places.shape[1]):
            both = free[:, x] & free[:, y]
            blocks = weighed[both, x].transpose(0, 2, 1) @ jacobians[both, y]
            np.add.at(H, (places[both, x], places[both, y]), blocks)


def _accepted(normalised: Float[Array, "*m d"]) -> Float[Array, "*m"]:
    """Weight of changes of motion in standard deviations (Geman-McClure): an impact must not pull at all. A kernel
    whose pull fades slowly (Cauchy) turns small or blurred objects by tens of degrees where they hit the table."""
    return np.asarray(geman_mcclure_weight((normalised**2).sum(axis=-1) / 4.0))


def _add_ties(
    H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], index: Int[Array, " m"],
    place: Int[Array, " n"], motion: Motion, config: GraphConfig,
) -> None:  # fmt: skip
    """Ties each pose to the one before it where the object stands still (robustly: Cauchy, because a slow start looks
    still), or moves as the robot's hand does (Huber: it may slip, but stays in the hand)."""
    still = np.array([config.still_m**-2] * 3 + [config.still_rad**-2] * 3)
    carried = np.array([config.carried_m**-2] * 3 + [config.carried_rad**-2] * 3)
    for a, b in zip(map(int, index), map(int, index[1:])):
        if motion.toss[a] == motion.toss[b] and motion.still[b]:
            residual = _gap(poses[a], poses[b])
            weight = still / (1.0 + residual @ (still * residual) / 9.0)
        elif is_held(poses, a, b, motion, config):
            residual = _gap(motion.carried[a, b] @ poses[a], poses[b])
            weight = carried / max(np.sqrt(residual @ (carried * residual)) / 3.0, 1.0)
        else:
            continue
        _tie(H, g, (int(place[a]), int(place[b])), residual, weight)


def is_held(poses: Float[Array, "n 4 4"], a: int, b: int, motion: Motion, config: GraphConfig) -> bool:
    """Whether the body moves from one view to the next as the robot's hand does."""
    if (a, b) not in motion.carried:
        return False
    off = motion.carried[a, b] @ poses[a] @ se3.inverse(poses[b])
    center = poses[b][:3, :3] @ motion.center_m + poses[b][:3, 3]
    turn = np.linalg.norm(rotation_log(off[:3, :3]))
    return bool(turn < config.held_rad and np.linalg.norm(off[:3, :3] @ center + off[:3, 3] - center) < config.held_m)


def _gap(one: Float[Array, "4 4"], two: Float[Array, "4 4"]) -> Float[Array, "6"]:
    """Twist between two poses: that of the first one's view less that of the second's, near the solution."""
    gap = se3.inverse(one) @ two
    return np.concatenate([gap[:3, 3], rotation_log(gap[:3, :3])])


def _tie(
    H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], places: tuple[int, int], residual: Float[Array, "6"],
    weight: Float[Array, "6"],
) -> None:  # fmt: skip
    """Adds a `_gap` between two views with these unknowns (-1: fixed)."""
    a, b = places
    for x, sign in ((a, 1.0), (b, -1.0)):
        if x >= 0:
            g[x] += sign * weight * residual
            H[x, x] += np.diag(weight)
    if a >= 0 and b >= 0:
        H[a, b] -= np.diag(weight)
        H[b, a] -= np.diag(weight)


def motion_residual(
    poses: Float[Array, "m 3 4 4"], times_s: Float[Array, "m 3"], motion: Motion
) -> tuple[Float[Array, "m 6"], Float[Array, "m 3 6 6"]]:
    """Change of spin and of velocity over three poses each (gravity's share taken off where that is nearer to the truth
    of a flying body than of a held one), and its derivatives by the three twists, to first order."""
    steps = np.diff(times_s, axis=1)
    spins = [turns_between(poses[:, n + 1], poses[:, n]) / steps[:, n, None] for n in (0, 1)]
    centers = poses[:, :, :3, :3] @ motion.center_m + poses[:, :, :3, 3]
    speeds = np.diff(centers, axis=1) / steps[:, :, None]
    change = speeds[:, 1] - speeds[:, 0]
    flight = change - motion.gravity_camera_m_s2 * 0.5 * steps.sum(axis=1, keepdims=True)
    flies = np.linalg.norm(flight, axis=1) < np.linalg.norm(change, axis=1)
    residual = np.concatenate([spins[1] - spins[0], np.where(flies[:, None], flight, change)], axis=1)
    one, two = 1 / steps.T
    turned = np.stack([one, -one - two, two], axis=1)[:, :, None, None] * poses[:, :, :3, :3]
    jacobians = np.zeros((*poses.shape[:2], 6, 6))
    jacobians[:, :, :3, 3:], jacobians[:, :, 3:, :3] = -turned, -turned
    jacobians[:, :, 3:, 3:] = turned @ skew(motion.center_m)
    return residual, jacobians


def _covariances(H: Float[Array, "d d"], place: Int[Array, " n"]) -> Float[Array, "n 6 6"]:
    """Each free view's own block of the inverse; zero for the fixed, NaN elsewhere is left to the caller."""
    out = np.zeros((len(place), 6, 6))
    inverse = np.linalg.inv(H + 1e-9 * (1 + np.trace(H) / max(len(H), 1)) * np.eye(len(H)))
    for i in np.flatnonzero(place >= 0):
        a = 6 * place[i]
        out[i] = inverse[a : a + 6, a : a + 6]
    return out
