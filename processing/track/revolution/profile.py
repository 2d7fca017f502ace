"""A round body as one shape that all views see at once: where its axis lies in each of them.

Views that follow each other tie their poses by what both see, and small errors add up as the body turns over. But a
body of revolution shows every view the same profile, whatever its turn: radius by height, height by radius at its ends,
and outlines that end there. The profile is solved together with the poses (its unknowns are eliminated, so that poses
feel each other through it); it knows nothing of the turn about the axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.revolution import profile_kernels as rk
from processing.track.revolution.axis import Axis
from processing.track.revolution.unwrapping import across
from processing.track.schedule import USUAL_DISTANCE_M
from recordings.geometry import rotation_log

FAR_PX = 100.0
"""Distance to the rim of pixels that something nearer may cover."""


@dataclass(frozen=True)
class BodyConfig:
    """How a body of revolution is compared with its views."""

    row_m: float = 0.003
    """Spacing of the profile's nodes."""
    depth_m: float = 0.0015
    """Standard deviation of depth (at 0.8 m) ..."""
    off_m: float = 0.005
    """... and what is farther off than this stands off the body (at 0.8 m)."""
    patch_px: float = 60.0
    """Depth of so many pixels errs as one."""
    outline_px: float = 0.35
    """Standard deviation of an outline's point ..."""
    together: float = 3.0
    """... of which so many err as one."""
    into_px: float = 2.25
    beyond_px: float = 3.0
    """Where the outline lies farther out (a handle) or in (something covers the body), nothing is compared ..."""
    near_px: float = 6.0
    """... nor so near to such a place."""
    wall_step_m: float = 0.004
    """Points of the outline along the wall."""
    bias_px: float = 0.15
    """Standard deviation of what all masks are too large by, known beforehand ..."""
    outline_bias_m: float = 0.0005
    """... and of a radius in outlines against one in depth."""
    bend_m: float = 0.0013
    """Usual bend of a profile from node to node, known for each four views."""
    round_share: float = 0.65
    """A body is round where so much of its outlines is that of a body of revolution: mugs', cans' and bottles' .73 and
    more; a prism's, a box's, a truck's, a banana's and a blob's .33 to .60, the blob's .73 in its other toss."""
    tries: int = 6
    """Steps after which that is asked."""
    rounds: int = 2
    axis_steps: int = 10
    """Times that a profile is begun, and steps of each, in which the axis is sought for it."""
    least_pixels: int = 12
    """A node that fewer samples saw is unknown."""


class RoundBody:
    """The profile of a round body about `axis`, solved with the poses of its views."""

    def __init__(
        self, store: ViewStore, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: BodyConfig
    ) -> None:
        self.axis, self.config = axis, config
        self._store, self._views = store, np.flatnonzero(use)
        self._axes = np.stack([*across(axis), axis.direction])
        self._outline_distance_px = _outline_distance_px(store, self._views)
        self._pixels = {int(i): _pixels(store, int(i)) for i in self._views}
        self._before: tuple[Array, ...] | None = None
        self._outline = np.zeros((len(self._views), 3))
        self._start(poses)

    def _start(self, poses: Float[Array, "n 4 4"]) -> None:
        """The profile as the poses have it: medians of what each node saw."""
        row = self.config.row_m
        height, radius, kind = (np.concatenate(x) for x in zip(*(self._placed(int(i), poses[i]) for i in self._views)))
        self._low_m = float(np.quantile(height, 0.001)) - 3 * row
        heights = int((np.quantile(height, 0.999) - self._low_m) / row) + 5
        radii = int(np.quantile(radius[kind == rk.OUTSIDE], 0.99) / row) + 5
        self._sizes = np.array([heights, heights, radii, radii], dtype=np.int64)
        self._y, self._seen = np.zeros(self._sizes.sum() + 4), np.zeros(self._sizes.sum(), dtype=bool)
        for c, first in enumerate(np.cumsum([0, *self._sizes[:-1]])):
            mine = kind == c
            at, value = (height[mine] - self._low_m, radius[mine]) if c < rk.TOP else (radius[mine], height[mine])
            node = np.round(at / row).astype(int)
            for q in range(self._sizes[c]):
                if (node == q).sum() >= self.config.least_pixels:
                    self._y[first + q], self._seen[first + q] = np.median(value[node == q]), True
        wall = np.flatnonzero(self._seen[:heights])
        ends = self._low_m + np.array([wall[0] - 0.5, wall[-1] + 0.5]) * row
        self._y[rk.LOW], self._y[rk.HIGH] = ends

    @property
    def radius_m(self) -> float:
        """Median radius of the outside."""
        outside = int(self._sizes[0])
        return float(np.median(self._y[:outside][self._seen[:outside]]))

    @property
    def outline_share(self) -> float:
        """How much of the outlines that a body of revolution would have is there."""
        counted, looked_at, _ = self._outline.sum(0)
        return float(counted / max(looked_at, 1))

    def _placed(self, i: int, pose: Float[Array, "4 4"]) -> tuple[Array, Array, Array]:
        """Height, distance from the axis and curve (-1: none) of a view's samples."""
        seen = self._samples(i).astype(np.float64)
        own = (seen[:, :3] - pose[:3, 3]) @ pose[:3, :3] - self.axis.point_m
        x, y, height = (own @ self._axes.T).T
        nx, ny, along = (seen[:, lay.SNX : lay.SNZ + 1] @ pose[:3, :3] @ self._axes.T).T
        radius = np.maximum(np.hypot(x, y), 1e-6)
        away = (nx * x + ny * y) / radius
        sides = [away > rk.ALONG, away < -rk.ALONG, along > rk.ALONG, along < -rk.ALONG]
        return height, radius, np.select(sides, [rk.OUTSIDE, rk.INSIDE, rk.TOP, rk.FOOT], -1)

    def _samples(self, i: int) -> Float32[Array, "n s"]:
        first, count = self._store.table[i, [lay.FIRST, lay.COUNT]]
        return np.asarray(self._store.samples[first : first + count])

    def add(
        self, H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], place: Int[Array, " n"]
    ) -> None:
        """Adds the normal equations of all views' poses (place -1: fixed) with the profile eliminated from them. Each
        call first moves the profile as the poses have moved since the last."""
        self._follow(poses)
        blocks, gradients, cross, Hyy, gy = self._terms(poses)
        self._known_before(Hyy, gy)
        self._before = (poses[self._views].copy(), cross, Hyy, gy)
        solved = np.linalg.solve(Hyy, np.concatenate([cross.reshape(-1, len(gy)), gy[None]]).T)
        between = np.einsum("aic,cbj->abij", cross, solved[:, :-1].reshape(len(gy), len(self._views), 6))
        gradients -= cross @ solved[:, -1]
        at = place[self._views]
        free = at >= 0
        H[np.ix_(at[free], at[free])] -= between[np.ix_(free, free)]
        H[at[free], at[free]] += blocks[free]
        g[at[free]] += gradients[free]

    def _follow(self, poses: Float[Array, "n 4 4"]) -> None:
        """The profile that fits poses that have moved, to first order."""
        if self._before is None:
            return
        before, cross, Hyy, gy = self._before
        moved = np.zeros((len(self._views), 6))
        for n, i in enumerate(self._views):
            gap = se3.inverse(poses[i]) @ before[n]
            moved[n] = [*gap[:3, 3], *rotation_log(gap[:3, :3])]
        step = -np.linalg.solve(Hyy, gy + np.einsum("aic,ai->c", cross, moved))
        most = np.full(len(step), 0.004)
        most[rk.BIAS] = 1.0
        self._y += np.clip(step, -most, most)

    def _terms(self, poses: Float[Array, "n 4 4"]) -> tuple[Array, Array, Array, Array, Array]:
        views, unknowns, c = len(self._views), len(self._y), self.config
        H, g, cross = np.zeros((views, 6, 6)), np.zeros((views, 6)), np.zeros((views, 6, unknowns))
        Hyy, gy = np.zeros((unknowns, unknowns)), np.zeros(unknowns)
        settings = np.array(
            [c.row_m, self._low_m, c.off_m, c.depth_m, c.outline_px, c.into_px, c.beyond_px, c.near_px, c.wall_step_m]
        )
        rectified, axis, profile = (
            self._store.rectified,
            (self._axes, self.axis.point_m),
            (self._y, self._seen, self._sizes),
        )
        self._outline = np.zeros((views, 3))
        for n, i in enumerate(self._views):
            row, samples = self._store.table[i], self._samples(int(i))
            scale = float(np.clip((np.median(samples[:, lay.PZ]) / USUAL_DISTANCE_M) ** 2, 0.5, 4.0))
            weight = self._pixels[int(i)] / c.patch_px / len(samples)
            out = H[n], g[n], cross[n], Hyy, gy
            rk.surface_terms(samples, poses[i], *axis, *profile, settings, scale, weight, *out)
            self._outline[n] = rk.outline_terms(
                self._outline_distance_px,
                row,
                rectified.focal,
                rectified.center,
                poses[i],
                *axis,
                *profile,
                settings,
                1 / c.together,
                *out,
            )
        return H, g, cross, Hyy, gy

    def _known_before(self, H: Float[Array, "y y"], g: Float[Array, " y"]) -> None:
        """Smooth curves, masks and depth that are about right."""
        views, c = len(self._views), self.config
        for first, size in zip(np.cumsum([0, *self._sizes[:-1]]), self._sizes):
            for j in range(first, first + size - 2):
                three, bend = slice(j, j + 3), np.array([1.0, -2.0, 1.0])
                weight = views / 4 / c.bend_m**2
                H[three, three] += weight * np.outer(bend, bend)
                g[three] += weight * bend * (bend @ self._y[three])
        for unknown, usual in ((rk.BIAS, c.bias_px), (rk.RADIUS_BIAS, c.outline_bias_m)):
            H[unknown, unknown] += views / usual**2
            g[unknown] += views * self._y[unknown] / usual**2
        H[np.diag_indices(len(g))] += 1e-6 * H.diagonal() + 1.0


def laid_on_profile(
    store: ViewStore, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: BodyConfig
) -> tuple[Axis, float]:
    """The axis near this one about which one profile fits all views at these poses best, and the share of its outlines
    that is there.

    To move the axis is to move all poses by one twist: their normal equations, summed. Normals alone leave the axis of
    a body about as high as wide open by many degrees; its outlines, which are even about it, do not.
    """
    for _ in range(config.rounds):
        body, moved = RoundBody(store, poses, use, axis, config), poses.copy()
        views = np.flatnonzero(use)
        place = np.full(len(poses), -1)
        place[views] = np.arange(len(views))
        along = np.concatenate([axis.direction, np.zeros(3)])
        kept = np.outer(axis.twist, axis.twist) / float(axis.twist @ axis.twist) + np.outer(along, along)
        old_from_new = np.eye(4)
        for _ in range(config.axis_steps):
            H, g = np.zeros((len(views), len(views), 6, 6)), np.zeros((len(views), 6))
            body.add(H, g, moved, place)
            total = H.sum((0, 1))
            total += np.trace(total) * (1e3 * kept + 1e-9 * np.eye(6))
            step = se3.inverse(se3.exponential(_at_most(-np.linalg.solve(total, g.sum(0)))))
            moved, old_from_new = moved @ step, old_from_new @ step
        axis = axis.seen_from(old_from_new)
    return axis, body.outline_share


def _at_most(twist: Float[Array, "6"]) -> Float[Array, "6"]:
    """The twist, no longer than .01 m and .1 rad."""
    size = max(float(np.linalg.norm(twist[:3])) / 0.01, float(np.linalg.norm(twist[3:])) / 0.1, 1.0)
    return np.asarray(twist / size)


def is_round(
    store: ViewStore, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], axis: Axis, config: BodyConfig
) -> bool:
    """Whether views show outlines of a body of revolution about this axis or nearly so, at nearly these poses."""
    body, poses = RoundBody(store, poses, use, axis, config), poses.copy()
    views = np.flatnonzero(use)
    place = np.full(len(poses), -1)
    place[views] = np.arange(len(views))
    turn = np.kron(np.eye(len(views)), np.outer(axis.twist, axis.twist) / float(axis.twist @ axis.twist))
    for _ in range(config.tries):
        blocks, g = np.zeros((len(views), len(views), 6, 6)), np.zeros((len(views), 6))
        body.add(blocks, g, poses, place)
        H = blocks.transpose(0, 2, 1, 3).reshape(6 * len(views), -1)
        H += np.diag(1e-6 * H.diagonal() + 1e-3) + 1e3 * np.trace(H) / len(H) * turn
        for i, twist in zip(views, -np.linalg.solve(H, g.reshape(-1)).reshape(-1, 6)):
            poses[i] = poses[i] @ se3.inverse(se3.exponential(_at_most(twist)))
    return body.outline_share > config.round_share


def _outline_distance_px(store: ViewStore, views: Int[Array, " v"]) -> Float32[Array, " p"]:
    """Distance to the rim of the mask, negative inside, a little smooth; far where something may cover the object."""
    out = np.full(len(store.maps), FAR_PX, dtype=np.float32)
    for i in views:
        crop = store.crops[i]
        assert crop is not None  # a view in use has one
        inside = crop.mask.astype(np.uint8)
        distance = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5) - cv2.distanceTransform(inside, cv2.DIST_L2, 5)
        distance = cv2.GaussianBlur(
            np.where(inside > 0, distance + 0.5, distance - 0.5).astype(np.float32), (0, 0), 1.0
        )
        distance[cv2.dilate(crop.covered.astype(np.uint8), np.ones((7, 7))) > 0] = FAR_PX
        first = int(store.table[i, lay.OFFSET])
        out[first : first + inside.size] = distance.ravel()
    return out


def _pixels(store: ViewStore, view: int) -> int:
    """How many of a view's pixels have depth."""
    offset, size = int(store.table[view, lay.OFFSET]), int(store.table[view, lay.WIDTH] * store.table[view, lay.HEIGHT])
    return int((store.maps[offset : offset + size, lay.Z] > 0).sum())


def anchored(
    poses: Float[Array, "n 4 4"], covariance: Float[Array, "n 6 6"], axis: Axis, first: int, pose: Float[Array, "4 4"]
) -> tuple[Float[Array, "n 4 4"], Float[Array, "n 6 6"], Axis]:
    """Poses, their covariances and the axis in the object frame in which view `first` has `pose`; that view has no
    covariance then, and the others its own beside theirs."""
    old_from_new = se3.inverse(poses[first]) @ pose
    spread = covariance + covariance[first]
    spread[first] = 0.0
    return poses @ old_from_new, spread, axis.seen_from(se3.inverse(old_from_new))
