"""Registrations of one toss to others that appearance proposes: feature matches between keyframes, aligned where views
see the same side."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.engine.parts import in_parts, side_by_side
from processing.features.sift import FeatureMatcher, Features, RansacConfig, relative_motions
from processing.motion import se3_kernels as se3
from processing.track import kernels as k
from processing.track.keyframes import view_directions
from processing.track.pairs import compared
from processing.track.registration.keyframe_database import Sides
from processing.track.schedule import Schedule, rows


@dataclass(frozen=True)
class ProposeConfig:
    """How proposals are made and aligned."""

    tried: int = 24
    """Proposals aligned, the most supported first."""
    kept: int = 5
    """The best of them that are aligned finely."""
    uncertain_cost: float = 0.10
    """A registration by features that fits worse is not sure."""
    sure_votes: float = 80.0
    """Feature matches that must agree on a registration, and on no other half as many, or it is not sure."""
    pairs: int = 24
    co_visible_deg: float = 45.0
    coarse: Schedule = ((1, 6, 0.012, 0.5, 0.012, 0.12), (1, 4, 0.006, 0.4, 0.008, 0.2))
    fine: Schedule = ((0, 6, 0.004, 0.3, 0.006, 0.5), (0, 6, 0.003, 0.15, 0.005, 1.0))
    ransac: RansacConfig = field(default_factory=lambda: RansacConfig(trials=200, least=6))


@dataclass(frozen=True, eq=False)
class Fit:
    """One registration of a toss (4x4) and what it costs: least is best, infinite: nothing to compare."""

    first_from_own: Float[Array, "4 4"]
    cost: float


APART_DEG = 15.0
"""Registrations nearer to each other are the same."""


def distinct(found: list[Fit]) -> list[Fit]:
    """Sorted by cost, without those that agree with a better one."""
    kept: list[Fit] = []
    least = 1 + 2 * np.cos(np.radians(APART_DEG))
    for f in sorted(found, key=lambda f: f.cost):
        turns = [float(np.trace(o.first_from_own[:3, :3].T @ f.first_from_own[:3, :3])) for o in kept]
        if np.isfinite(f.cost) and all(turn < least for turn in turns):
            kept.append(f)
    return kept


def by_features(
    both: Sides, features: dict[int, Features], matcher: FeatureMatcher, config: ProposeConfig
) -> tuple[list[Fit], bool]:
    """Different registrations that feature matches support, aligned, best first (cost: mean over pairs of views that
    see the same side, 0 perfect .. 1), and whether the matches make the first certain."""
    proposals, votes = _proposed(both, features, matcher, config)
    rough = list(side_by_side(lambda p: _aligned(both, p, config.coarse, config.pairs // 2, config), proposals))
    good = [f.first_from_own for f in distinct(rough)[: config.kept]]
    found = distinct(list(side_by_side(lambda p: _aligned(both, p, config.fine, config.pairs, config), good)))
    second = max(votes[1:], default=0.0)
    sure = bool(votes) and votes[0] >= config.sure_votes and second < 0.5 * votes[0]
    return found, sure and bool(found) and found[0].cost <= config.uncertain_cost


def _proposed(
    both: Sides, features: dict[int, Features], matcher: FeatureMatcher, config: ProposeConfig
) -> tuple[list[Float[Array, "4 4"]], list[float]]:
    """Transforms that feature matches between keyframes support, the most supported first, near copies merged, and how
    many matches support each."""
    new = [i for i in map(int, (*both.mine, *both.theirs)) if i not in features]
    describe = partial(matcher.describe, both.keyframes.store)
    features |= zip(new, side_by_side(describe, new) if matcher.side_by_side else map(describe, new), strict=True)

    def moved(some: slice) -> list[tuple[float, Float[Array, "4 4"]]]:
        """By the matches of some views of the toss with all views of the others."""
        return [
            (float(m.inliers), np.linalg.inv(both.common[j]) @ m.other_from_one @ both.keyframes.poses[i])
            for i in both.mine[some]
            for j in both.theirs
            for m in relative_motions(matcher, features[int(i)], features[int(j)], config.ransac, seed=int(i), most=1)
        ]

    found = in_parts(moved, len(both.mine), 1) if matcher.side_by_side else [moved(slice(None))]
    return _voted([f for part in found for f in part], config.tried)


def _voted(found: list[tuple[float, Float[Array, "4 4"]]], most: int) -> tuple[list[Float[Array, "4 4"]], list[float]]:
    """Merges transforms within 15 degrees; the sum of their inliers is the vote."""
    groups: list[tuple[float, Float[Array, "4 4"]]] = []
    for votes, transform in sorted(found, key=lambda f: -f[0]):
        for n, (total, kept) in enumerate(groups):
            if np.trace(kept[:3, :3].T @ transform[:3, :3]) > 1 + 2 * np.cos(np.radians(APART_DEG)):
                groups[n] = (total + votes, kept)
                break
        else:
            groups.append((votes, transform))
    ordered = sorted(groups, key=lambda g: -g[0])[:most]
    return [g[1] for g in ordered], [g[0] for g in ordered]


def _aligned(both: Sides, transform: Float[Array, "4 4"], schedule: Schedule, pairs: int, config: ProposeConfig) -> Fit:
    """Gauss-Newton of one transform (common_from_own) over the pairs of views that see the same side; its mean cost."""
    store, cost = both.keyframes.store, np.inf
    for row in rows(schedule, float(np.median(np.linalg.norm(store.center_m[both.mine], axis=1)))):
        for _ in range(int(row[k.STEPS])):
            poses = both.poses(transform)
            chosen = _facing_pairs(both, poses, pairs, config)
            if len(chosen) == 0:
                return Fit(transform, np.inf)
            blocks, gradients, figures = compared(store, poses, chosen, row, shaded=False)
            cost = float(figures[:, 0].mean())
            sign = np.where(np.isin(chosen[:, 0], both.mine), 1.0, -1.0)
            transform = stepped(transform, blocks.sum(0), (sign[:, None] * gradients).sum(0))
    return Fit(transform, cost)


def stepped(transform: Float[Array, "4 4"], H: Float[Array, "6 6"], g: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """One damped Gauss-Newton step of common_from_own, at most 3 cm and a quarter radian."""
    step = -np.linalg.solve(H + np.diag(1e-5 * np.diag(H) + 1e-9 * np.trace(H) + 1e-9), g)
    size = max(np.linalg.norm(step[:3]) / 0.03, np.linalg.norm(step[3:]) / 0.25, 1.0)
    return np.asarray(se3.exponential(step / size) @ transform)


def _facing_pairs(both: Sides, poses: Float[Array, "n 4 4"], count: int, config: ProposeConfig) -> Int[Array, "m 2"]:
    """Pairs of views of the two sides, both ways, nearest directions first."""
    center_m = both.keyframes.center_m
    cosine = view_directions(poses[both.mine], center_m) @ view_directions(poses[both.theirs], center_m).T
    order = np.argsort(-cosine, axis=None)[:count]
    order = order[cosine.ravel()[order] > np.cos(np.radians(config.co_visible_deg))]
    a, b = np.unravel_index(order, cosine.shape)
    one_way = np.stack([both.mine[a], both.theirs[b]], -1).astype(np.int64)
    return np.concatenate([one_way, one_way[:, ::-1]])
