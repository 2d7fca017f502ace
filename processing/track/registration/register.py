"""Brings several tosses of one object into one object frame: appearance and a search all around propose, a proposal is
judged by its consistency in any two views, and all keyframes of all tosses are refined together.

Tosses join one by one, the certain ones first. Feature matches between keyframes propose (proposals.py); where they are
not sure, placements are sought over all turns, too (consistency.py): two tosses need not show a common side. Every
proposal is judged by its inconsistency over all pairs of views, and the most consistent one is taken. A toss that is
inconsistent everywhere is left out and reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.features.sift import FeatureMatcher, Features, Sift
from processing.motion.interpolate import blended
from processing.track.joint_refinement import GraphConfig, Motion, refine
from processing.track.known_shape import ShapeConfig
from processing.track.registration.consistency import ConsistencyConfig, ConsistencyTerms, Inconsistency, Rims
from processing.track.registration.keyframe_database import KeyframeDatabase, keyframes_of, sides
from processing.track.registration.proposals import Fit, ProposeConfig, by_features
from processing.track.registration.support_plane import SupportPlaneConfig
from processing.track.track_toss import TossTrack
from recordings.errors import BadInput
from recordings.progress import Progress, Silent
from recordings.tracks import ObjectShape, ObjectTrack


@dataclass(frozen=True)
class RegisterConfig:
    """How placements of tosses are made and judged."""

    keyframes: int = 10
    """Least views of a toss that take part, spread over directions; ..."""
    most_keyframes: int = 20
    """... of few tosses up to so many, ..."""
    many: int = 40
    """... so that there are about so many; of a toss that they leave ambiguous so many alone."""
    worst: float = 0.05
    """A toss whose best placement costs more (inconsistency) is left out."""
    good: float = 0.01
    """A sure proposal that costs more is no longer sure."""
    ambiguous: float = 0.003
    """Another placement that costs more by less than this may be the right one."""
    rivals: float = 0.06
    """Of sure proposals, those that fit worse than the first by less than this are judged beside it."""
    propose: ProposeConfig = field(default_factory=ProposeConfig)
    consistency: ConsistencyConfig = field(default_factory=ConsistencyConfig)
    joint: GraphConfig = field(default_factory=lambda: GraphConfig(loops=10, neighbours=1))
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    ground: SupportPlaneConfig = field(default_factory=SupportPlaneConfig)


@dataclass(frozen=True, eq=False)
class Registered:
    """All tracks in the object frame of the first; `fit` per toss (near 0 or below good, see consistency.py; 0 for
    the first), `joined` says which could be registered: the others keep their own frame. `first_from_own` 4x4 per toss.

    `gap` per toss: how much more the best different placement costs (infinite: there is none); where that is
    less than the settings' `ambiguous`, the toss is `ambiguous`: the object looks the same from several sides, and
    nothing in the images decides which one is right.
    """

    tracks: tuple[ObjectTrack, ...]
    joined: tuple[bool, ...]
    fit: Float[Array, " t"]
    first_from_own: Float[Array, "t 4 4"]
    gap: Float[Array, " t"]
    ambiguous: tuple[bool, ...]


@dataclass
class _Placing:
    """Where each toss lies so far (NaN fit: nowhere yet), and what others are compared with."""

    keyframes: KeyframeDatabase
    rims: Rims
    matcher: FeatureMatcher
    config: RegisterConfig
    first_from_own: Float[Array, "t 4 4"]
    fit: Float[Array, " t"]
    features: dict[int, Features] = field(default_factory=dict)
    known: dict[tuple[int, ...], list[Fit]] = field(default_factory=dict)
    """What was found of a toss (first number) against others."""

    def inconsistency(self, toss: int, many: KeyframeDatabase | None = None) -> Inconsistency | None:
        """A toss against all others that are placed, by all views of another keyframe database where one is given; None
        where either has no view."""
        joined = np.flatnonzero(np.isfinite(self.fit) & (np.arange(len(self.fit)) != toss))
        keyframes, rims, config = self.keyframes, self.rims, self.config.consistency
        if many is not None:
            keyframes, rims, config = many, Rims.of(many.store), replace(config, views=self.config.many)
        both = sides(keyframes, toss, joined, self.first_from_own)
        if len(both.mine) == 0 or len(both.theirs) == 0:
            return None
        return Inconsistency.of(both, rims, config)

    def found(self, toss: int) -> list[Fit]:
        """Different placements of a toss, the most consistent first."""
        joined = np.flatnonzero(np.isfinite(self.fit))
        key = (toss, *map(int, joined))
        if key not in self.known:
            self.known[key] = self._found(toss, joined)
        return self.known[key]

    def _found(self, toss: int, joined: Int[Array, " j"]) -> list[Fit]:
        against = self.inconsistency(toss)
        if against is None:
            return []
        both = sides(self.keyframes, toss, joined, self.first_from_own)
        proposed, sure = by_features(both, self.features, self.matcher, self.config.propose)
        if sure and against.cost(proposed[0].first_from_own) < self.config.good:
            rivals = [f for f in proposed if f.cost < proposed[0].cost + self.config.rivals]
            if len(rivals) == 1:
                return [Fit(rivals[0].first_from_own, against.cost(rivals[0].first_from_own))]
            return against.fitted(rivals)
        return against.fitted([*proposed, *against.all_around()])

    def place(self, toss: int, found: list[Fit], most: float) -> bool:
        """Take the best placement, if its inconsistency costs no more than `most`."""
        if not found or found[0].cost > most:
            return False
        self.first_from_own[toss], self.fit[toss] = found[0].first_from_own, found[0].cost
        return True


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
    views = int(np.clip(config.many // len(tosses), config.keyframes, config.most_keyframes))
    keyframes = keyframes_of(tosses, model, [views] * len(tosses), config.shape, config.ground)
    root, count = (0, len(tosses)) if model is None else (len(tosses), len(tosses) + 1)
    fit = np.zeros(count) if together else np.where(np.arange(count) == root, 0.0, np.nan)
    placing = _Placing(keyframes, Rims.of(keyframes.store), matcher, config, np.tile(np.eye(4), (count, 1, 1)), fit)
    gap = np.full(count, np.inf)
    if not together:
        others = [t for t in range(len(tosses)) if t != root]
        gap = _placed(placing, others, lambda t: _many_views(tosses, model, t, config), progress)
    fixed = keyframes.toss == root
    if model is None:
        fixed[1:] = False
    poses = _refined(
        keyframes, placing.rims, np.isfinite(fit), placing.first_from_own, fixed, _tied(tosses, keyframes), config
    )
    fit, gap, first_from_own = fit[: len(tosses)], gap[: len(tosses)], placing.first_from_own[: len(tosses)]
    tracks = [_moved_track(toss, keyframes, t, poses, bool(np.isfinite(fit[t]))) for t, toss in enumerate(tosses)]
    joined = np.isfinite(fit)
    unsure = joined & (gap < config.ambiguous)
    return Registered(tuple(tracks), tuple(map(bool, joined)), fit, first_from_own, gap, tuple(map(bool, unsure)))


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a toss lies among others: `shared_from_own` 4x4, its `fit` and the `gap` to the next different placement,
    as in Registered; `joined` and `ambiguous` likewise."""

    shared_from_own: Float[Array, "4 4"]
    fit: float
    gap: float
    joined: bool
    ambiguous: bool


def place_among(
    toss: TossTrack, others: Sequence[TossTrack], config: RegisterConfig | None = None,
    matcher: FeatureMatcher | None = None,
) -> Placement:  # fmt: skip
    """Where one toss lies in the object frame that the tracks of `others` share already; nothing is refined."""
    config, tosses = config or RegisterConfig(), [*others, toss]
    views = int(np.clip(config.many // len(tosses), config.keyframes, config.most_keyframes))
    keyframes = keyframes_of(tosses, None, [views] * len(tosses), config.shape, config.ground)
    last = len(others)
    fit = np.where(np.arange(len(tosses)) == last, np.nan, 0.0)
    moves = np.tile(np.eye(4), (len(tosses), 1, 1))
    of_others = [
        (i, tosses[n].features, int(f)) for i, (n, f) in enumerate(zip(keyframes.toss, keyframes.frame)) if n < last
    ]
    known = {i: features[frame] for i, features, frame in of_others if frame in features}
    placing = _Placing(keyframes, Rims.of(keyframes.store), matcher or Sift(), config, moves, fit, known)
    gap = float(_placed(placing, [last], lambda t: _many_views(tosses, None, t, config), Silent())[last])
    for i, features, frame in of_others:  # for the tosses after this one
        if i in placing.features:
            features[frame] = placing.features[i]
    joined = bool(np.isfinite(fit[last]))
    return Placement(moves[last], float(fit[last]), gap, joined, joined and gap < config.ambiguous)


def _many_views(
    tosses: Sequence[TossTrack], model: ObjectShape | None, toss: int, config: RegisterConfig
) -> KeyframeDatabase:
    """Many views of one toss, and together as many of the others."""
    of_others = max(config.keyframes, config.many // max(len(tosses) - 1, 1))
    counts = [config.many if t == toss else of_others for t in range(len(tosses))]
    return keyframes_of(tosses, model, counts, config.shape, config.ground)


def _placed(
    placing: _Placing, tosses: list[int], many: Callable[[int], KeyframeDatabase], progress: Progress
) -> Float[Array, " t"]:
    """Places tosses one by one: the certain ones first, because others may then be distinguished by what these show. A
    toss that stays ambiguous is judged by `many` views. Returns how much more the best different placement of each
    costs."""
    config, waiting, found = placing.config, list(tosses), dict[int, list[Fit]]()
    for most, least_gap in ((0.5 * config.worst, config.ambiguous), (0.5 * config.worst, 0.0), (config.worst, 0.0)):
        for t in list(waiting):
            found[t] = placing.found(t)
            if _gap(found[t]) >= least_gap and placing.place(t, found[t], most):
                waiting.remove(t)
            progress.step(len(tosses) - len(waiting), len(tosses), f"toss {t}")
    gap = np.full(len(placing.fit), np.inf)
    for t in tosses:
        rivals = [f for f in found[t] if f.cost < found[t][0].cost + 3 * config.ambiguous]
        against = placing.inconsistency(t)
        if t in waiting or len(rivals) < 2 or against is None:
            gap[t] = _gap(found[t])
            continue
        again = against.fitted(rivals)  # now against all the others
        closer = placing.inconsistency(t, many(t)) if _gap(again) < config.ambiguous else None
        if closer is not None:
            again = closer.judged(again)
        placing.place(t, again, np.inf)
        gap[t] = _gap(again)
    return gap


def _tied(tosses: Sequence[TossTrack], keyframes: KeyframeDatabase) -> Int[Array, " n"]:
    """Views with the same number move as one; those with -1 alone."""
    out = np.full(len(keyframes.toss), -1)
    for n, toss in enumerate(tosses):
        mine = keyframes.toss == n
        tied = toss.tied[keyframes.frame[mine]]
        out[mine] = np.where(tied >= 0, len(tosses) * tied + n, -1)
    return out


def _gap(found: list[Fit]) -> float:
    """How much more the second of several placements costs than the first."""
    return found[1].cost - found[0].cost if len(found) > 1 else float("inf")


def _refined(
    keyframes: KeyframeDatabase, rims: Rims, joined: Bool[Array, " t"], first_from_own: Float[Array, "t 4 4"],
    fixed: Bool[Array, " n"], tied: Int[Array, " n"], config: RegisterConfig,
) -> Float[Array, "n 4 4"]:  # fmt: skip
    """All keyframes of all joined tosses at once (the first toss's first one is fixed, or a learned shape's views);
    poses in the common frame. Views with the same number in `tied` move as one."""
    poses = np.array([p @ np.linalg.inv(first_from_own[t]) for p, t in zip(keyframes.poses, keyframes.toss)])
    use = joined[keyframes.toss]
    none = np.zeros(len(poses), dtype=bool)
    # keyframes are far apart in time: the pull towards free flight has no meaning between them
    motion = Motion(keyframes.frame.astype(np.float64), np.arange(len(poses)), np.zeros(3), keyframes.center_m, none)
    graph = replace(config.joint, spread_in_time=1)
    priors = (
        replace(keyframes.support_plane, views=np.flatnonzero(use)),
        ConsistencyTerms.of(keyframes, rims, use, config.consistency),
    )
    return refine(keyframes.store, poses, use, fixed, motion, graph, tied=tied, priors=priors).poses


def _moved_track(
    toss: TossTrack, keyframes: KeyframeDatabase, t: int, poses: Float[Array, "n 4 4"], joined: bool,
) -> ObjectTrack:  # fmt: skip
    """The toss's track in the common frame: each frame moved by the mean correction of the keyframes around it."""
    track = toss.track
    if not joined:
        return track
    mine = np.flatnonzero(keyframes.toss == t)
    corrections = np.array([np.linalg.inv(poses[i]) @ keyframes.poses[i] for i in mine])  # common_from_own per keyframe
    out = track.camera_from_object.copy()
    for i in range(len(out)):
        if track.status[i] != "lost":
            out[i] = out[i] @ np.linalg.inv(blended(corrections, keyframes.frame[mine], i))
    return replace(track, camera_from_object=out)
