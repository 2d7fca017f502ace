"""Brings several tosses of one object into one object frame: appearance proposes, geometry and appearance judge, and
all keyframes of all tosses are refined together.

Tosses join one by one, the one that fits best first. Proposals come from feature matches between keyframes and from a
grid of turns about the body's middle; each is refined against the views already joined, and the one that fits the most
of them is taken. A toss that fits none is left out and said to be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.track import kernels as k
from processing.track.beam import Schedule, rows
from processing.track.features import FeatureMatcher, Features, RansacConfig, Sift, relative_motions
from processing.track.graph import GraphConfig, Motion, refine
from processing.track.keyframes import view_directions
from processing.track.known_shape import ShapeConfig, middle_of, shape_views
from processing.track.motion import all_turns
from processing.track.sequence import TossTrack
from processing.track.views import ViewStore
from recordings.errors import BadInput
from recordings.geometry import rotation_exp, rotation_log
from recordings.progress import Progress, Silent
from recordings.tracks import ObjectShape, ObjectTrack


@dataclass(frozen=True)
class RegisterConfig:
    """How proposals between tosses are made and judged."""

    keyframes: int = 10
    """Views of a toss that take part, spread over directions."""
    tried: int = 24
    """Proposals aligned, the most supported first."""
    grid_turns: int = 216
    """Turns tried where features say nothing."""
    doubt: float = 0.10
    """A registration by features that fits worse also tries the grid."""
    worst: float = 0.22
    """A toss that fits worse is left out."""
    sure_votes: float = 80.0
    """Feature matches that must agree on a registration, and on no other half as many, or the grid is tried too."""
    apart_deg: float = 15.0
    """Registrations nearer to each other are the same."""
    ambiguous: float = 0.02
    """Another registration that fits worse by less than this may be the right one."""
    pairs: int = 24
    co_visible_deg: float = 45.0
    coarse: Schedule = ((1, 6, 0.012, 0.5, 0.012, 0.12), (1, 4, 0.006, 0.4, 0.008, 0.2))
    fine: Schedule = ((0, 6, 0.004, 0.3, 0.006, 0.5), (0, 6, 0.003, 0.15, 0.005, 1.0))
    ransac: RansacConfig = field(default_factory=lambda: RansacConfig(trials=200, least=6))
    joint: GraphConfig = field(default_factory=lambda: GraphConfig(loops=10, neighbours=1))
    shape: ShapeConfig = field(default_factory=ShapeConfig)


@dataclass(frozen=True, eq=False)
class Registered:
    """All tracks in the object frame of the first; `fit` per toss (0 good .. 1; 0 for the first), `joined` says which
    could be registered: the others keep their own frame. `first_from_own` 4x4 per toss.

    `gap` per toss: how much worse the best different registration fits (infinite: there is none); where that is less
    than the settings' `ambiguous`, the toss is `ambiguous`: the object looks the same from several sides, and nothing
    in the images tells which one is right.
    """

    tracks: tuple[ObjectTrack, ...]
    joined: tuple[bool, ...]
    fit: Float[Array, " t"]
    first_from_own: Float[Array, "t 4 4"]
    gap: Float[Array, " t"]
    ambiguous: tuple[bool, ...]


@dataclass(frozen=True, eq=False)
class _Pool:
    """The chosen keyframes of all tosses in one store: poses in each toss's own frame, and whose they are."""

    store: ViewStore
    poses: Float[Array, "n 4 4"]
    toss: Int[Array, " n"]
    frame: Int[Array, " n"]
    center_m: Float[Array, "3"]


@dataclass(frozen=True, eq=False)
class _Fit:
    """One registration of a toss (4x4) and what it costs: mean over pairs, 0 perfect .. 1, infinite: no pair."""

    first_from_own: Float[Array, "4 4"]
    cost: float


def register_tosses(
    tosses: Sequence[TossTrack],
    config: RegisterConfig | None = None,
    progress: Progress | None = None,
    matcher: FeatureMatcher | None = None,
    *,
    model: ObjectShape | None = None,
    together: bool = False,
) -> Registered:
    """Tracks of several tosses (or one) of one object in one object frame, jointly refined: that of the first toss, or
    that of a learned shape, into which every toss is then placed by its form and colours (`first` means the shape).
    `together`: the tracks are in one object frame already, nothing is sought.

    Raises BadInput where there is no toss, or the tosses are of different cameras.
    """
    config, progress, matcher = config or RegisterConfig(), progress or Silent(), matcher or Sift()
    if not tosses:
        raise BadInput("no toss to register; wanted at least one track")
    if len({t.track.camera for t in tosses}) > 1:
        raise BadInput(f"tracks of several cameras ({sorted({t.track.camera for t in tosses})}); wanted one camera")
    pool = _pooled(tosses, model, config)
    root = 0 if model is None else len(tosses)
    first_from_own = np.tile(np.eye(4), (max(len(tosses), root + 1), 1, 1))
    fit = np.full(len(first_from_own), np.nan)
    fit[root] = 0.0
    if together:
        fit[:] = 0.0
    features: dict[int, Features] = {}
    waiting = [] if together else [t for t in range(len(tosses)) if t != root]
    found: dict[int, list[_Fit]] = {}
    rounds = 0
    while waiting and rounds < 2:  # a toss that does not fit now may fit when more of the object is known
        for t in list(waiting):
            joined = np.flatnonzero(np.isfinite(fit))
            found[t] = _registered(pool, t, joined, first_from_own, features, matcher, config)
            if found[t] and found[t][0].cost < config.worst * (0.75 if rounds == 0 else 1.0):
                first_from_own[t], fit[t] = found[t][0].first_from_own, found[t][0].cost
                waiting.remove(t)
            progress.step(len(tosses) - len(waiting), len(tosses), f"toss {tosses[t].track.toss}")
        rounds += 1
    gap = _settled(pool, found, fit, first_from_own, config)[: len(tosses)]
    fixed = pool.toss == root
    if model is None:
        fixed[1:] = False
    poses = _refined(pool, np.isfinite(fit), first_from_own, fixed, config)
    fit, first_from_own = fit[: len(tosses)], first_from_own[: len(tosses)]
    tracks = [_moved_track(toss, pool, t, poses, bool(np.isfinite(fit[t]))) for t, toss in enumerate(tosses)]
    joined_all = np.isfinite(fit)
    unsure = joined_all & (gap < config.ambiguous)
    return Registered(tuple(tracks), tuple(map(bool, joined_all)), fit, first_from_own, gap, tuple(map(bool, unsure)))


def _settled(
    pool: _Pool, found: dict[int, list[_Fit]], fit: Float[Array, " t"], first_from_own: Float[Array, "t 4 4"],
    config: RegisterConfig,
) -> Float[Array, " t"]:  # fmt: skip
    """Tosses that several registrations fitted are judged once more, now against all others; the best is taken (fit
    and first_from_own are changed). Returns how far behind the best different one is."""
    gap = np.full(len(fit), np.inf)
    for t, several in found.items():
        rivals = [f for f in several if f.cost < several[0].cost + 3 * config.ambiguous]
        if not np.isfinite(fit[t]) or len(rivals) < 2:
            continue
        others = np.flatnonzero(np.isfinite(fit) & (np.arange(len(fit)) != t))
        mine, theirs, model = _sides(pool, t, others, first_from_own)
        again = [_aligned(pool, mine, theirs, model, f.first_from_own, config.fine, 2 * config.pairs, config)
                 for f in rivals]  # fmt: skip
        ordered = _distinct(again, config)
        first_from_own[t], fit[t] = ordered[0].first_from_own, ordered[0].cost
        gap[t] = ordered[1].cost - ordered[0].cost if len(ordered) > 1 else np.inf
    return gap


def _pooled(tosses: Sequence[TossTrack], model: ObjectShape | None, config: RegisterConfig) -> _Pool:
    """The tosses' keyframes; after them the drawn views of a learned shape, as if they were one more toss."""
    chosen = [_spread(t, config.keyframes) for t in tosses]
    stores = [t.store.only(c) for t, c in zip(tosses, chosen)]
    poses = [t.track.camera_from_object[c] for t, c in zip(tosses, chosen)]
    center_m = tosses[0].center_m
    if model is not None:
        drawn = shape_views(model, [c for s in stores for c in s.crops], stores[0].optics, config.shape)
        stores.append(ViewStore(stores[0].optics, list(drawn.crops), stores[0].config))
        for i in range(len(drawn.crops)):
            stores[-1].fill(i)
        poses.append(drawn.poses)
        chosen.append(np.arange(len(drawn.crops)))
        center_m = middle_of(model)
    whose = np.concatenate([np.full(len(c), i) for i, c in enumerate(chosen)])
    return _Pool(ViewStore.joined(stores), np.concatenate(poses), whose, np.concatenate(chosen), center_m)


def _spread(toss: TossTrack, count: int) -> Int[Array, " m"]:
    """Well fitting keyframes, each as far as possible in direction from those before (the first and last included)."""
    poses = toss.track.camera_from_object
    usable = np.array([i for i in range(len(poses)) if toss.track.status[i] == "tracked" and toss.store.usable(i)])
    if len(usable) == 0:
        return np.zeros(0, dtype=np.int64)
    directions = view_directions(poses[usable], toss.center_m)
    cost = np.nan_to_num(toss.cost[usable], nan=0.3)
    chosen = [0]
    while len(chosen) < min(count, len(usable)):
        angle = np.degrees(np.arccos(np.clip(directions @ directions[chosen].T, -1, 1))).min(1)
        gain = np.minimum(angle, 40.0) + 0.02 * np.arange(len(usable)) - 200.0 * cost
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
    return np.sort(usable[chosen])


def _sides(
    pool: _Pool, t: int, joined: Int[Array, " j"], first_from_own: Float[Array, "t 4 4"]
) -> tuple[Int[Array, " a"], Int[Array, " b"], Float[Array, "n 4 4"]]:
    """Views of toss t, views of the joined tosses, and the poses of the latter in the common frame."""
    model = pool.poses.copy()
    for j in joined:
        rows_j = pool.toss == j
        model[rows_j] = pool.poses[rows_j] @ np.linalg.inv(first_from_own[j])
    return np.flatnonzero(pool.toss == t), np.flatnonzero(np.isin(pool.toss, joined)), model


def _registered(
    pool: _Pool, t: int, joined: Int[Array, " j"], first_from_own: Float[Array, "t 4 4"],
    features: dict[int, Features], matcher: FeatureMatcher, config: RegisterConfig,
) -> list[_Fit]:  # fmt: skip
    """Different registrations of toss t against the joined tosses, best first."""
    mine, theirs, model = _sides(pool, t, joined, first_from_own)
    if len(mine) == 0 or len(theirs) == 0:
        return []
    proposals, votes = _by_features(pool, mine, theirs, model, features, matcher, config)
    found = _best(pool, mine, theirs, model, proposals, config)
    second = max(votes[1:], default=0.0)
    sure = bool(votes) and votes[0] >= config.sure_votes and second < 0.5 * votes[0]
    if not found or found[0].cost > config.doubt or not sure:
        found += _best(pool, mine, theirs, model, _by_grid(pool, mine, theirs, model, config), config)
    return _distinct(found, config)


def _distinct(found: list[_Fit], config: RegisterConfig) -> list[_Fit]:
    """Sorted by cost, without those that say the same as a better one."""
    kept: list[_Fit] = []
    least = 1 + 2 * np.cos(np.radians(config.apart_deg))
    for f in sorted(found, key=lambda f: f.cost):
        turns = [float(np.trace(o.first_from_own[:3, :3].T @ f.first_from_own[:3, :3])) for o in kept]
        if np.isfinite(f.cost) and all(turn < least for turn in turns):
            kept.append(f)
    return kept


def _by_features(
    pool: _Pool, mine: Int[Array, " a"], theirs: Int[Array, " b"], model: Float[Array, "n 4 4"],
    features: dict[int, Features], matcher: FeatureMatcher, config: RegisterConfig,
) -> tuple[list[Float[Array, "4 4"]], list[float]]:  # fmt: skip
    """Transforms that feature matches between keyframes say, the most supported first, near copies merged, and how
    many matches support each."""
    for i in (*mine, *theirs):
        if int(i) not in features:
            features[int(i)] = matcher.describe(pool.store, int(i))
    found: list[tuple[float, Float[Array, "4 4"]]] = []
    for i in mine:
        for j in theirs:
            for m in relative_motions(matcher, features[int(i)], features[int(j)], config.ransac, seed=int(i), most=1):
                transform = np.linalg.inv(model[j]) @ m.other_from_one @ pool.poses[i]
                found.append((float(m.inliers), transform))
    return _voted(found, config.tried)


def _voted(found: list[tuple[float, Float[Array, "4 4"]]], most: int) -> tuple[list[Float[Array, "4 4"]], list[float]]:
    """Merges transforms within 15 degrees; the sum of their inliers is the vote."""
    groups: list[tuple[float, Float[Array, "4 4"]]] = []
    for votes, transform in sorted(found, key=lambda f: -f[0]):
        for n, (total, kept) in enumerate(groups):
            if np.trace(kept[:3, :3].T @ transform[:3, :3]) > 1 + 2 * np.cos(np.radians(15)):
                groups[n] = (total + votes, kept)
                break
        else:
            groups.append((votes, transform))
    ordered = sorted(groups, key=lambda g: -g[0])[:most]
    return [g[1] for g in ordered], [g[0] for g in ordered]


def _by_grid(
    pool: _Pool, mine: Int[Array, " a"], theirs: Int[Array, " b"], model: Float[Array, "n 4 4"], config: RegisterConfig
) -> list[Float[Array, "4 4"]]:
    """Turns over all orientations about the two tosses' middles; the best few by a coarse look at few pairs."""
    middle_own, middle_model = _middle(pool, mine, pool.poses), _middle(pool, theirs, model)
    scored = []
    for turn in all_turns(config.grid_turns):
        transform = np.eye(4)
        transform[:3, :3] = turn
        transform[:3, 3] = middle_model - turn @ middle_own
        scored.append((_aligned(pool, mine, theirs, model, transform, config.coarse[:1], 6, config), transform))
    scored.sort(key=lambda s: s[0].cost)
    return [s[0].first_from_own for s in scored[: config.tried // 2]]


def _middle(pool: _Pool, views: Int[Array, " a"], poses: Float[Array, "n 4 4"]) -> Float[Array, "3"]:
    """Middle of the surface seen by several views, object frame."""
    seen = []
    for i in views:
        back = np.linalg.inv(poses[i])
        row = pool.store.table[i]
        points = pool.store.samples[row[k.FIRST] : row[k.FIRST] + row[k.COUNT] : 5, :3]
        seen.append(points @ back[:3, :3].T + back[:3, 3])
    cloud = np.concatenate(seen)
    return np.asarray(0.5 * (np.quantile(cloud, 0.02, axis=0) + np.quantile(cloud, 0.98, axis=0)))


def _best(
    pool: _Pool, mine: Int[Array, " a"], theirs: Int[Array, " b"], model: Float[Array, "n 4 4"],
    proposals: list[Float[Array, "4 4"]], config: RegisterConfig,
) -> list[_Fit]:  # fmt: skip
    """Each proposal aligned coarsely, the best five different ones finely, best first."""
    rough = [_aligned(pool, mine, theirs, model, p, config.coarse, config.pairs // 2, config) for p in proposals]
    good = _distinct(rough, config)[:5]
    fine = [_aligned(pool, mine, theirs, model, r.first_from_own, config.fine, config.pairs, config) for r in good]
    return sorted(fine, key=lambda f: f.cost)


def _aligned(
    pool: _Pool, mine: Int[Array, " a"], theirs: Int[Array, " b"], model: Float[Array, "n 4 4"],
    transform: Float[Array, "4 4"], schedule: Schedule, pairs: int, config: RegisterConfig,
) -> _Fit:  # fmt: skip
    """Gauss-Newton of one transform (model_from_own) over the pairs of views that see the same side; its mean cost."""
    store = pool.store
    poses = model.copy()
    cost = np.inf
    for row in rows(schedule, float(np.median(np.linalg.norm(store.center_m[mine], axis=1)))):
        for _ in range(int(row[k.STEPS])):
            poses[mine] = pool.poses[mine] @ np.linalg.inv(transform)
            both = _facing_pairs(poses, mine, theirs, pool.center_m, pairs, config)
            if len(both) == 0:
                return _Fit(transform, np.inf)
            blocks, gradients = np.zeros((len(both), 6, 6)), np.zeros((len(both), 6))
            figures = np.zeros((len(both), 3))
            k.graph_terms(
                poses, both, store.maps, store.samples, store.table, store.optics.focal, store.optics.center, row,
                blocks, gradients, figures,
            )  # fmt: skip
            cost = float(figures[:, 0].mean())
            sign = np.where(np.isin(both[:, 0], mine), 1.0, -1.0)
            H, g = blocks.sum(0), (sign[:, None] * gradients).sum(0)
            step = -np.linalg.solve(H + np.diag(1e-5 * np.diag(H) + 1e-9 * np.trace(H) + 1e-9), g)
            size = max(np.linalg.norm(step[:3]) / 0.03, np.linalg.norm(step[3:]) / 0.25, 1.0)
            transform = k.exponential(step / size) @ transform
    return _Fit(transform, cost)


def _facing_pairs(
    poses: Float[Array, "n 4 4"], mine: Int[Array, " a"], theirs: Int[Array, " b"], center_m: Float[Array, "3"],
    count: int, config: RegisterConfig,
) -> Int[Array, "m 2"]:  # fmt: skip
    """Pairs of views of the two sets, both ways, nearest directions first."""
    cosine = view_directions(poses[mine], center_m) @ view_directions(poses[theirs], center_m).T
    order = np.argsort(-cosine, axis=None)[:count]
    order = order[cosine.ravel()[order] > np.cos(np.radians(config.co_visible_deg))]
    a, b = np.unravel_index(order, cosine.shape)
    one_way = np.stack([mine[a], theirs[b]], -1).astype(np.int64)
    return np.concatenate([one_way, one_way[:, ::-1]])


def _refined(
    pool: _Pool, joined: Bool[Array, " t"], first_from_own: Float[Array, "t 4 4"], fixed: Bool[Array, " n"],
    config: RegisterConfig,
) -> Float[Array, "n 4 4"]:  # fmt: skip
    """All keyframes of all joined tosses at once (the first toss's first one is fixed, or a learned shape's views);
    poses in the common frame."""
    poses = np.array([p @ np.linalg.inv(first_from_own[t]) for p, t in zip(pool.poses, pool.toss)])
    use = joined[pool.toss]
    none = np.zeros(len(poses), dtype=bool)
    # keyframes are far apart in time: the pull towards free flight says nothing between them
    motion = Motion(pool.frame.astype(np.float64), np.arange(len(poses)), np.zeros(3), pool.center_m, none)
    graph = replace(config.joint, spread_in_time=1)
    return refine(pool.store, poses, use, fixed, motion, graph).poses


def _moved_track(
    toss: TossTrack, pool: _Pool, t: int, poses: Float[Array, "n 4 4"], joined: bool,
) -> ObjectTrack:  # fmt: skip
    """The toss's track in the common frame: each frame moved by the mean correction of the keyframes around it."""
    track = toss.track
    if not joined:
        return track
    mine = np.flatnonzero(pool.toss == t)
    corrections = np.array([np.linalg.inv(poses[i]) @ pool.poses[i] for i in mine])  # common_from_own per keyframe
    out = track.camera_from_object.copy()
    for i in range(len(out)):
        if track.status[i] != "lost":
            out[i] = out[i] @ np.linalg.inv(_blended(corrections, pool.frame[mine], i))
    return replace(track, camera_from_object=out)


def _blended(corrections: Float[Array, "m 4 4"], frames: Int[Array, " m"], i: int) -> Float[Array, "4 4"]:
    """Correction at frame i: linear between the keyframes around it."""
    after = int(np.searchsorted(frames, i))
    if after == 0 or after == len(frames):
        return corrections[min(after, len(frames) - 1)]
    a, b = corrections[after - 1], corrections[after]
    share = (i - frames[after - 1]) / (frames[after] - frames[after - 1])
    out = np.eye(4)
    out[:3, :3] = a[:3, :3] @ rotation_exp(share * rotation_log(a[:3, :3].T @ b[:3, :3]))
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    return out
