"""Free-space and silhouette consistency of two sets of views of one body, one of which may be placed wrongly.

Two tosses may show different sides of a body: then no two views see the same surface, and only outlines and free space
show how they belong together. So every view is compared with every view of the other side (consistency_kernels.py).
The inconsistency among the views of one toss is taken off: masks and poses are not perfect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from processing.engine.parts import in_parts, side_by_side
from processing.motion.rotation_grid import all_turns
from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k
from processing.track.joint_refinement import add_pairs
from processing.track.keyframes import view_directions
from processing.track.registration import consistency_kernels as c
from processing.track.registration.keyframe_database import KeyframeDatabase, Sides, far_apart
from processing.track.registration.proposals import Fit, distinct, stepped
from processing.track.schedule import Schedule, rows


@dataclass(frozen=True)
class ConsistencyConfig:
    """How placements are aligned and judged, and how they are sought all around."""

    views: int = 16
    """Views of the joined tosses that take part, spread over directions."""
    seek: Schedule = ((1, 6, 0.012, 0.5, 0.02, 0.125),)
    coarse: Schedule = ((1, 4, 0.008, 0.4, 0.012, 0.125), (0, 4, 0.005, 0.3, 0.006, 0.25))
    fine: Schedule = ((0, 6, 0.003, 0.2, 0.004, 0.25), (0, 4, 0.003, 0.2, 0.003, 0.5))
    judged: Schedule = ((0, 1, 0.003, 0.3, 0.002, 1.0),)
    """The scales at which a placement is judged: a residual of three scales is a full inconsistency."""
    rim_share: float = 0.25
    """Weight of an inconsistent point of the rim, against one of the surface."""
    joint_share: float = 0.02
    """Weight of the consistency terms in a refinement of all poses, against pairs that see the same side, which err
    less."""
    turns: int = 216
    """Rotations tried all around ..."""
    seek_views: int = 5
    """... with so many views of each side; ..."""
    tried: int = 12
    """... the best of them that are aligned coarsely, ..."""
    kept: int = 5
    """... and finely."""


PART = 64
"""Pairs of views that are compared in one part of the work."""
RIM_POINTS = 200
RIM_REACH_PX = 4.0
"""A pixel of the outline takes the plane of the nearest good depth within this reach."""


@dataclass(frozen=True, eq=False)
class Rims:
    """The outline's own pixels as points on the surface (camera frames), where nothing may hide the body: `points_m`
    (RIM_POINTS rows a view) and how many each view has."""

    points_m: Float32[Array, "p 3"]
    count: Int[Array, " n"]

    @staticmethod
    def of(store: ViewStore) -> Rims:
        """Of every view of a store."""
        points_m, count = np.zeros((len(store) * RIM_POINTS, 3), np.float32), np.zeros(len(store), np.int64)
        for i in range(len(store)):
            rim = _rim(store, i)
            chosen = rim[np.linspace(0, len(rim) - 1, min(RIM_POINTS, len(rim))).astype(int)]
            points_m[i * RIM_POINTS : i * RIM_POINTS + len(chosen)], count[i] = chosen, len(chosen)
        return Rims(points_m, count)

    @property
    def first(self) -> Int[Array, " n"]:
        """Row of each view's first point."""
        return np.arange(len(self.count), dtype=np.int64) * RIM_POINTS


def _rim(store: ViewStore, i: int) -> Float[Array, "m 3"]:
    """Points on the rays of one view's outline pixels, at the depth of the nearest smooth surface's plane."""
    row, rectified = store.table[i], store.rectified
    h, w = int(row[lay.HEIGHT]), int(row[lay.WIDTH])
    if row[lay.COUNT] == 0:
        return np.zeros((0, 3))
    pixels = store.maps[row[lay.OFFSET] : row[lay.OFFSET] + w * h].reshape(h, w, lay.CHANNELS)
    seen = pixels[..., lay.Z] > 0
    reach, label = cv2.distanceTransformWithLabels((~seen).astype(np.uint8), cv2.DIST_L2, 5,
                                                   labelType=cv2.DIST_LABEL_PIXEL)  # fmt: skip
    source = np.zeros(int(label.max()) + 1, dtype=np.int64)
    source[label[seen]] = np.flatnonzero(seen)
    at = np.flatnonzero((_outline(pixels[..., lay.OUTSIDE]) & (reach < RIM_REACH_PX)).ravel())
    plane = pixels.reshape(-1, lay.CHANNELS)[source[label.ravel()[at]]]
    rays, there = (np.stack([(p % w + row[lay.U0] - rectified.center[0]) / rectified.focal[0],
                             (p // w + row[lay.V0] - rectified.center[1]) / rectified.focal[1], np.ones(len(p))], -1)
                   for p in (at, source[label.ravel()[at]]))  # fmt: skip
    normal, depth_m = plane[:, lay.NX : lay.NZ + 1], plane[:, lay.Z]
    slope = np.einsum("nj,nj->n", normal, rays)
    slope = np.where(np.abs(slope) < 0.05, np.nan, slope)
    at_rim_m = depth_m * np.einsum("nj,nj->n", normal, there) / slope
    good = np.abs(at_rim_m / depth_m - 1) < 0.02
    return np.asarray((rays * at_rim_m[:, None])[good])


def _outline(outside: Float32[Array, "h w"]) -> Bool[Array, "h w"]:
    """Pixels of the mask beside free background, and not near what may hide the body."""
    free = cv2.dilate((outside > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    hiding = cv2.dilate((outside < 0).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    return np.asarray((outside == 0) & free & ~hiding)


@dataclass(frozen=True, eq=False)
class Inconsistency:
    """Inconsistency of two sides, their views thinned out, beside the inconsistency within each of them."""

    both: Sides
    rims: Rims
    config: ConsistencyConfig

    @staticmethod
    def of(both: Sides, rims: Rims, config: ConsistencyConfig) -> Inconsistency:
        """Of the joined views only some take part, from everywhere."""
        directions = view_directions(both.common[both.theirs], both.keyframes.center_m)
        return Inconsistency(replace(both, theirs=both.theirs[far_apart(directions, config.views)]), rims, config)

    @cached_property
    def itself(self) -> Float[Array, " f"]:
        """Figures of pairs of views of the same toss, summed: the surface's (FIGURES), then the rim's."""
        both, toss = self.both, self.both.keyframes.toss
        views = np.concatenate([both.mine, both.theirs])
        pairs = [(i, j) for i in views for j in views if i != j and toss[i] == toss[j]]
        poses = both.common.copy()
        poses[both.mine] = both.keyframes.poses[both.mine]
        return self._figures(poses, np.array(pairs, dtype=np.int64).reshape(-1, 2))

    @cached_property
    def unlike(self) -> float:
        """Appearance cost of two points that have nothing to do with each other."""
        store, random = self.both.keyframes.store, np.random.default_rng(0)
        appearance = [_some_appearance(store, views, random) for views in (self.both.mine, self.both.theirs)]
        if min(len(x) for x in appearance) == 0:
            return 0.0
        gap = (appearance[0] - appearance[1]) / self.config.judged[0][k.INTENSITY]
        return float(np.minimum(gap**2 / 9, 1.0).mean())

    def aligned(
        self, common_from_own: Float[Array, "4 4"], schedule: Schedule, *, grounded: bool = False
    ) -> Float[Array, "4 4"]:
        """Gauss-Newton over all pairs of views of the two sides: nothing beside an outline, nothing before a surface,
        and the surfaces that both see together; `grounded`: what one stands on is where the table was."""
        distance_m = float(np.median(np.linalg.norm(self.both.keyframes.store.center_m[self.both.mine], axis=1)))
        pairs = self.pairs
        together = len(pairs) / (len(self.both.mine) + len(self.both.theirs))  # a view's pairs share its errors
        sign = np.where(np.isin(pairs[:, 0], self.both.mine), 1.0, -1.0)[:, None]
        for row in rows(schedule, distance_m):
            for _ in range(int(row[k.STEPS])):
                poses = self.both.poses(common_from_own)
                blocks, gradients, _ = self._terms(poses, pairs, row)
                H, g = blocks.sum(0) / together, (sign * gradients).sum(0) / together
                if grounded:
                    self._add_ground(H, g, poses)
                common_from_own = stepped(common_from_own, H, g)
        return common_from_own

    def _add_ground(self, H: Float[Array, "6 6"], g: Float[Array, "6"], poses: Float[Array, "n 4 4"]) -> None:
        both = self.both
        place = np.full(len(poses), -1)
        place[both.mine] = 0
        views = np.concatenate([both.mine, both.theirs])
        replace(both.keyframes.support_plane, views=views).add(H[None, None], g[None], poses, place)

    def cost(self, common_from_own: Float[Array, "4 4"]) -> float:
        """Cost of a placement's inconsistency, mean over the points (no unit): near 0 (or below) for the right one,
        where the two sides agree with each other as well as each agrees with itself.

        Appearance speaks for a placement where it agrees better than chance would have it, and against it where it does
        not; that of an object that is the same all over says nothing.
        """
        f, own = self._figures(self.both.poses(common_from_own), self.pairs), self.itself
        apart = [_mean(x, c.OUTSIDE, c.COUNTED) + _mean(x, c.BEFORE, c.COUNTED) for x in (f, own)]
        rim = [_mean(x, c.FIGURES + c.OUTSIDE, c.FIGURES + c.COUNTED) for x in (f, own)]
        shared = _mean(f, c.SHARED, c.COUNTED)
        depth = _mean(f, c.DEPTH, c.SHARED) - _mean(own, c.DEPTH, c.SHARED)
        appearance = _against(
            _mean(f, c.APPEARANCE_COST, c.APPEARANCE_WEIGHT),
            _mean(own, c.APPEARANCE_COST, c.APPEARANCE_WEIGHT),
            self.unlike,
        )
        appearance_share = _mean(f, c.APPEARANCE_WEIGHT, c.COUNTED)
        return (
            apart[0]
            - apart[1]
            + self.config.rim_share * (rim[0] - rim[1])
            + shared * depth
            + appearance_share * appearance
        )

    def fitted(self, found: list[Fit]) -> list[Fit]:
        """Placements aligned and judged, different ones only, best first."""
        rough = self._all_aligned([f.first_from_own for f in found], self.config.coarse)
        return self.judged(rough[: self.config.kept])

    def judged(self, found: list[Fit]) -> list[Fit]:
        """Placements that are nearly right aligned finely and judged, best first."""
        return self._all_aligned([f.first_from_own for f in found], self.config.fine, grounded=True)

    def _all_aligned(
        self, starts: Sequence[Float[Array, "4 4"]], schedule: Schedule, *, grounded: bool = False
    ) -> list[Fit]:
        """Where several starts lead, different placements only, best first."""
        if not starts:
            return []
        _ = self.pairs, self.itself, self.unlike  # all starts need them: made before threads ask for them

        def fit(start: Float[Array, "4 4"]) -> Fit:
            there = self.aligned(start, schedule, grounded=grounded)
            return Fit(there, self.cost(there))

        return distinct(list(side_by_side(fit, starts)))

    def all_around(self) -> list[Fit]:
        """Placements sought over all rotations about the two sides' surface centers, the best few, best first."""
        few = replace(self.config, judged=self.config.seek)
        thin = Inconsistency(replace(self.both, mine=_some(self.both.mine, self.config.seek_views),
                               theirs=_some(self.both.theirs, self.config.seek_views)), self.rims, few)  # fmt: skip
        center_own_m, center_common_m = self.both.surface_centers_m()
        turns = all_turns(self.config.turns)
        starts = np.tile(np.eye(4), (len(turns), 1, 1))
        starts[:, :3, :3] = turns
        starts[:, :3, 3] = [center_common_m - turn @ center_own_m for turn in turns]
        return thin._all_aligned(list(starts), self.config.seek)[: self.config.tried]

    @cached_property
    def pairs(self) -> Int[Array, "m 2"]:
        """All pairs of views of the two sides, both ways."""
        one_way = np.array([(i, j) for i in self.both.mine for j in self.both.theirs], dtype=np.int64).reshape(-1, 2)
        return np.concatenate([one_way, one_way[:, ::-1]])

    def _figures(self, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"]) -> Float[Array, " f"]:
        distance_m = float(np.median(np.linalg.norm(self.both.keyframes.store.center_m[self.both.mine], axis=1)))
        return self._terms(poses, pairs, rows(self.config.judged, distance_m)[0])[2]

    def _terms(
        self, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"], row: Float[Array, "7"]
    ) -> tuple[Float[Array, "m 6 6"], Float[Array, "m 6"], Float[Array, " f"]]:
        return _compared(self.both.keyframes.store, self.rims, poses, pairs, row)


@dataclass(frozen=True, eq=False)
class ConsistencyTerms:
    """Consistency terms between views of different tosses, for a refinement of all poses at once."""

    store: ViewStore
    rims: Rims
    pairs: Int[Array, "m 2"]
    row: Float[Array, "7"]
    weight: float
    """Of each pair: those of a view share its errors."""

    @staticmethod
    def of(
        keyframes: KeyframeDatabase, rims: Rims, use: Bool[Array, " n"], config: ConsistencyConfig
    ) -> ConsistencyTerms:
        """Between all used views of different tosses."""
        views = np.flatnonzero(use)
        pairs = [(int(i), int(j)) for i in views for j in views if keyframes.toss[i] != keyframes.toss[j]]
        distance_m = float(np.median(np.linalg.norm(keyframes.store.center_m[use], axis=1)))
        row = rows(config.fine, distance_m)[-1]
        return ConsistencyTerms(keyframes.store, rims, np.array(pairs, dtype=np.int64).reshape(-1, 2), row,
                              config.joint_share * len(views) / max(len(pairs), 1))  # fmt: skip

    def add(
        self, H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], place: Int[Array, " n"]
    ) -> None:
        """Adds to normal equations (`graph.add_pairs`)."""
        blocks, gradients, _ = _compared(self.store, self.rims, poses, self.pairs, self.row)
        add_pairs(H, g, self.weight * blocks, self.weight * gradients, place[self.pairs])


def _compared(
    store: ViewStore, rims: Rims, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"], row: Float[Array, "7"]
) -> tuple[Float[Array, "m 6 6"], Float[Array, "m 6"], Float[Array, " f"]]:
    """Normal equations of each pair, surface and rim together; figures summed over pairs, the rim's last."""
    n = len(pairs)
    blocks, gradients, total = np.zeros((n, 6, 6)), np.zeros((n, 6)), []
    views = np.ascontiguousarray(store.table[:, lay.FIRST]), np.ascontiguousarray(store.table[:, lay.COUNT])
    for points, first, count, rim in (
        (store.samples, *views, False),
        (rims.points_m, rims.first, rims.count, True),
    ):
        H, g, figures = np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros((n, c.FIGURES))
        data = (store.maps, points, first, count, store.table, store.rectified.focal, store.rectified.center, row, rim)

        def compare(some: slice, data: tuple[Any, ...] = data, out: tuple[Any, ...] = (H, g, figures)) -> None:
            c.consistency_terms(poses, pairs[some], *data, *(values[some] for values in out))

        in_parts(compare, n, PART)
        blocks, gradients = blocks + H, gradients + g
        total.append(figures.sum(0))
    return blocks, gradients, np.concatenate(total)


def _some(views: Int[Array, " a"], count: int) -> Int[Array, " b"]:
    return views[np.linspace(0, len(views) - 1, min(count, len(views))).astype(int)]


def _mean(figures: Float[Array, " f"], cost: int, weight: int) -> float:
    return float(figures[cost] / figures[weight]) if figures[weight] > 0 else 0.0


def _some_appearance(store: ViewStore, views: Int[Array, " a"], random: np.random.Generator) -> Float[Array, "n l"]:
    """Appearance of points drawn from all of some views, where the colour is the object's."""
    spans = [(int(store.table[i, lay.FIRST]), int(store.table[i, lay.COUNT])) for i in views]
    appearance = np.concatenate([store.samples[a : a + n, lay.SSHARP : lay.SSHARP + lay.APPEARANCE] for a, n in spans])
    appearance = appearance[appearance[:, 0] < 0.5 * lay.NO_APPEARANCE]
    return appearance[random.integers(0, len(appearance), 4000)] if len(appearance) else appearance


def _against(appearance: float, itself: float, unlike: float) -> float:
    """How far appearance speaks against a placement: the logarithm of the ratio of the likelihoods of "any two points"
    and "the same point", in the cost's unit.

    For appearance that errs with variance n and varies over the object with s, a point whose square is a has
    (a / n - a / s - ln(s / n)) / 2 nats. Between tosses the light differs: n is twice what the views of one toss err.
    The less the object's appearance varies, the less it says.
    """
    noise = 2.0 * itself + 0.001
    ratio = unlike / noise
    if ratio <= 1.0:
        return 0.0
    return float((appearance / noise * (1.0 - 1.0 / ratio) - np.log(ratio)) / (2.0 * FULL_NATS))


FULL_NATS = 4.5
"""What a full inconsistency, a residual of three standard deviations, costs in nats: its half square."""
