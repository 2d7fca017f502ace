"""How two sets of views of one body contradict each other where one of them is placed wrongly.

Two tosses may show different sides of a body: then no two views see the same surface, and only outlines and free space
tell how they belong together. So every view is compared with every view of the other side (consistency_kernels.py).
What the views of one toss contradict each other is taken off: masks and poses are not perfect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from processing.motion.motion_prior import all_turns
from processing.sensor.view import ViewStore
from processing.track import kernels as k
from processing.track.beam import Schedule, rows
from processing.track.joint_refinement import add_pairs
from processing.track.keyframes import view_directions
from processing.track.registration import consistency_kernels as c
from processing.track.registration.keyframe_database import Pool, Sides, far_apart
from processing.track.registration.proposals import Fit, distinct, stepped


@dataclass(frozen=True)
class ContradictionConfig:
    """How placements are aligned and judged, and how they are sought all around."""

    views: int = 16
    """Views of the joined tosses that take part, spread over directions."""
    seek: Schedule = ((1, 6, 0.012, 0.5, 0.02, 0.125),)
    coarse: Schedule = ((1, 4, 0.008, 0.4, 0.012, 0.125), (0, 4, 0.005, 0.3, 0.006, 0.25))
    fine: Schedule = ((0, 6, 0.003, 0.2, 0.004, 0.25), (0, 4, 0.003, 0.2, 0.003, 0.5))
    judged: Schedule = ((0, 1, 0.003, 0.3, 0.002, 1.0),)
    """The scales at which a placement is judged: so much is a clear contradiction by a third."""
    rim_share: float = 0.25
    """What a contradicted point of the rim counts, against one of the surface."""
    joint_share: float = 0.02
    """What contradictions count in a refinement of all poses, against pairs that see the same side, which err less."""
    turns: int = 216
    """Turns tried all around ..."""
    seek_views: int = 5
    """... with so many views of each side; ..."""
    tried: int = 12
    """... the best of them that are aligned coarsely, ..."""
    kept: int = 5
    """... and finely."""


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
    row, optics = store.table[i], store.optics
    h, w = int(row[k.HEIGHT]), int(row[k.WIDTH])
    if row[k.COUNT] == 0:
        return np.zeros((0, 3))
    pixels = store.maps[row[k.OFFSET] : row[k.OFFSET] + w * h].reshape(h, w, k.CHANNELS)
    seen = pixels[..., k.Z] > 0
    reach, label = cv2.distanceTransformWithLabels((~seen).astype(np.uint8), cv2.DIST_L2, 5,
                                                   labelType=cv2.DIST_LABEL_PIXEL)  # fmt: skip
    source = np.zeros(int(label.max()) + 1, dtype=np.int64)
    source[label[seen]] = np.flatnonzero(seen)
    at = np.flatnonzero((_outline(pixels[..., k.OUTSIDE]) & (reach < RIM_REACH_PX)).ravel())
    plane = pixels.reshape(-1, k.CHANNELS)[source[label.ravel()[at]]]
    rays, there = (np.stack([(p % w + row[k.U0] - optics.center[0]) / optics.focal[0],
                             (p // w + row[k.V0] - optics.center[1]) / optics.focal[1], np.ones(len(p))], -1)
                   for p in (at, source[label.ravel()[at]]))  # fmt: skip
    normal, depth_m = plane[:, k.NX : k.NZ + 1], plane[:, k.Z]
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
class Opposed:
    """Two sides to be compared, their views thinned out, and what they contradict themselves."""

    both: Sides
    rims: Rims
    config: ContradictionConfig

    @staticmethod
    def of(both: Sides, rims: Rims, config: ContradictionConfig) -> Opposed:
        """Of the joined views only some take part, from everywhere."""
        directions = view_directions(both.common[both.theirs], both.pool.center_m)
        return Opposed(replace(both, theirs=both.theirs[far_apart(directions, config.views)]), rims, config)

    @cached_property
    def itself(self) -> Float[Array, " f"]:
        """Figures of pairs of views of the same toss, summed: the surface's (FIGURES), then the rim's."""
        both, toss = self.both, self.both.pool.toss
        views = np.concatenate([both.mine, both.theirs])
        pairs = [(i, j) for i in views for j in views if i != j and toss[i] == toss[j]]
        poses = both.common.copy()
        poses[both.mine] = both.pool.poses[both.mine]
        return self._figures(poses, np.array(pairs, dtype=np.int64).reshape(-1, 2))

    @cached_property
    def unlike(self) -> float:
        """What the looks of two points cost that have nothing to do with each other."""
        store, random = self.both.pool.store, np.random.default_rng(0)
        looks = [_some_looks(store, views, random) for views in (self.both.mine, self.both.theirs)]
        if min(len(x) for x in looks) == 0:
            return 0.0
        gap = (looks[0] - looks[1]) / self.config.judged[0][k.INTENSITY]
        return float(np.minimum(gap**2 / 9, 1.0).mean())

    def aligned(
        self, common_from_own: Float[Array, "4 4"], schedule: Schedule, *, grounded: bool = False
    ) -> Float[Array, "4 4"]:
        """Gauss-Newton over all pairs of views of the two sides: nothing beside an outline, nothing before a surface,
        and the surfaces that both see together; `grounded`: what one stands on is where the table was."""
        distance_m = float(np.median(np.linalg.norm(self.both.pool.store.center_m[self.both.mine], axis=1)))
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
        replace(both.pool.footing, views=views).add(H[None, None], g[None], poses, place)

    def cost(self, common_from_own: Float[Array, "4 4"]) -> float:
        """What speaks against a placement, mean over the points: near 0 (or below) for the right one, where the two
        sides contradict each other no more than each contradicts itself.

        Looks speak for a placement where they agree better than chance would have it, and against it where they do
        not; looks of an object that is the same all over say nothing.
        """
        f, own = self._figures(self.both.poses(common_from_own), self.pairs), self.itself
        apart = [_mean(x, c.BESIDE, c.COUNTED) + _mean(x, c.BEFORE, c.COUNTED) for x in (f, own)]
        rim = [_mean(x, c.FIGURES + c.BESIDE, c.FIGURES + c.COUNTED) for x in (f, own)]
        shared = _mean(f, c.SHARED, c.COUNTED)
        depth = _mean(f, c.DEPTH, c.SHARED) - _mean(own, c.DEPTH, c.SHARED)
        looks = _against(_mean(f, c.LOOKS_COST, c.LOOKED), _mean(own, c.LOOKS_COST, c.LOOKED), self.unlike)
        looked = _mean(f, c.LOOKED, c.COUNTED)
        return apart[0] - apart[1] + self.config.rim_share * (rim[0] - rim[1]) + shared * depth + looked * looks

    def fitted(self, found: list[Fit]) -> list[Fit]:
        """Placements aligned and judged, different ones only, best first."""
        coarse = [self.aligned(f.first_from_own, self.config.coarse) for f in found]
        rough = distinct([Fit(x, self.cost(x)) for x in coarse])[: self.config.kept]
        return self.judged(rough)

    def judged(self, found: list[Fit]) -> list[Fit]:
        """Placements that are nearly right aligned finely and judged, best first."""
        fine = [self.aligned(f.first_from_own, self.config.fine, grounded=True) for f in found]
        return distinct([Fit(x, self.cost(x)) for x in fine])

    def all_around(self) -> list[Fit]:
        """Placements sought over all turns about the two sides' middles, the best few, best first."""
        few = replace(self.config, judged=self.config.seek)
        thin = Opposed(replace(self.both, mine=_some(self.both.mine, self.config.seek_views),
                               theirs=_some(self.both.theirs, self.config.seek_views)), self.rims, few)  # fmt: skip
        middle_own, middle_common = self.both.middles()
        found = []
        for turn in all_turns(self.config.turns):
            start = np.eye(4)
            start[:3, :3], start[:3, 3] = turn, middle_common - turn @ middle_own
            there = thin.aligned(start, self.config.seek)
            found.append(Fit(there, thin.cost(there)))
        return distinct(found)[: self.config.tried]

    @cached_property
    def pairs(self) -> Int[Array, "m 2"]:
        """All pairs of views of the two sides, both ways."""
        one_way = np.array([(i, j) for i in self.both.mine for j in self.both.theirs], dtype=np.int64).reshape(-1, 2)
        return np.concatenate([one_way, one_way[:, ::-1]])

    def _figures(self, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"]) -> Float[Array, " f"]:
        distance_m = float(np.median(np.linalg.norm(self.both.pool.store.center_m[self.both.mine], axis=1)))
        return self._terms(poses, pairs, rows(self.config.judged, distance_m)[0])[2]

    def _terms(
        self, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"], row: Float[Array, "7"]
    ) -> tuple[Float[Array, "m 6 6"], Float[Array, "m 6"], Float[Array, " f"]]:
        return _compared(self.both.pool.store, self.rims, poses, pairs, row)


@dataclass(frozen=True, eq=False)
class Contradictions:
    """What views of different tosses contradict each other, for a refinement of all poses at once (joint_refinement.py)."""

    store: ViewStore
    rims: Rims
    pairs: Int[Array, "m 2"]
    row: Float[Array, "7"]
    weight: float
    """Of each pair: those of a view share its errors."""

    @staticmethod
    def of(pool: Pool, rims: Rims, use: Bool[Array, " n"], config: ContradictionConfig) -> Contradictions:
        """Between all used views of different tosses."""
        views = np.flatnonzero(use)
        pairs = [(int(i), int(j)) for i in views for j in views if pool.toss[i] != pool.toss[j]]
        distance_m = float(np.median(np.linalg.norm(pool.store.center_m[use], axis=1)))
        row = rows(config.fine, distance_m)[-1]
        return Contradictions(pool.store, rims, np.array(pairs, dtype=np.int64).reshape(-1, 2), row,
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
    views = np.ascontiguousarray(store.table[:, k.FIRST]), np.ascontiguousarray(store.table[:, k.COUNT])
    for points, first, count, rim in (
        (store.samples, *views, False),
        (rims.points_m, rims.first, rims.count, True),
    ):
        H, g, figures = np.zeros((n, 6, 6)), np.zeros((n, 6)), np.zeros((n, c.FIGURES))
        c.contradictions(poses, pairs, store.maps, points, first, count, store.table, store.optics.focal,
                         store.optics.center, row, rim, H, g, figures)  # fmt: skip
        blocks, gradients = blocks + H, gradients + g
        total.append(figures.sum(0))
    return blocks, gradients, np.concatenate(total)


def _some(views: Int[Array, " a"], count: int) -> Int[Array, " b"]:
    return views[np.linspace(0, len(views) - 1, min(count, len(views))).astype(int)]


def _mean(figures: Float[Array, " f"], cost: int, weight: int) -> float:
    return float(figures[cost] / figures[weight]) if figures[weight] > 0 else 0.0


def _some_looks(store: ViewStore, views: Int[Array, " a"], random: np.random.Generator) -> Float[Array, "n l"]:
    """Looks of points drawn from all of some views, where the colour is the object's."""
    spans = [(int(store.table[i, k.FIRST]), int(store.table[i, k.COUNT])) for i in views]
    looks = np.concatenate([store.samples[a : a + n, k.SSHARP : k.SSHARP + k.LOOKS] for a, n in spans])
    looks = looks[looks[:, 0] < 0.5 * k.NO_LOOK]
    return looks[random.integers(0, len(looks), 4000)] if len(looks) else looks


def _against(looks: float, itself: float, unlike: float) -> float:
    """How far looks speak against a placement: their cost above that at which agreement is as likely as chance.

    For looks that err with variance n and vary over the object with s, the likelihoods of "the same point" and of
    "any two points" are equal at a cost of n ln(s / n) s / (s - n). Between tosses the light differs: n is twice what
    the views of one toss err. The less the object's looks vary, the less they say.
    """
    noise = 2.0 * itself + 0.001
    ratio = unlike / noise
    if ratio <= 1.0:
        return 0.0
    return (looks - noise * float(np.log(ratio)) * ratio / (ratio - 1.0)) * (1.0 - 1.0 / ratio)
