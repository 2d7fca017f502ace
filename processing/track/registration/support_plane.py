"""What a body stands on is flat: the side that lies on the table is seen before or after, and lies in its plane then.

Two tosses that show different sides, or views of one toss that never meet, are tied by the table: where the body stands
still on it, what other views see of the side that is down lies in the table's plane. Nothing is known of the shape: of
all points that face the table within a few degrees only those near to it count, and each plane's height is as good as
its calibration (it is solved for, held near zero).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.motion.interpolate import turn_between
from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.revolution.unwrapping import table_of
from recordings.estimation.robust import tukey_weight


@dataclass(frozen=True)
class SupportPlaneConfig:
    """Which points lie on the table, and how exactly."""

    facing: float = 0.95
    """Least cosine between a surface's normal and the way down."""
    seen: float = 0.3
    """A surface that faces its camera by less than this cosine does not count."""
    near_m: float = 0.01
    """What is farther from the table does not lie on it (Tukey's biweight)."""
    point_m: float = 0.0035
    """Standard deviation of a point's height, many times what one errs: patches of depth err together."""
    plane_m: float = 0.0015
    """... and of the table's own height in one view."""
    least_points: int = 20
    """Of one view; fewer may be anything."""
    stands_m: float = 0.012
    """A body whose lowest pixels are no higher above the table stands on it."""
    lowest: float = 0.02
    """So large a share of its pixels may err."""
    still_rad: float = 0.02
    still_m: float = 0.002
    """What stands still seems to move no farther ..."""
    least_still: int = 3
    """... through so many views."""


@dataclass(frozen=True, eq=False)
class SupportPlane:
    """Views of one or several tosses, and in which of them the body stands on the table: `stand` (n) numbers the times
    that it stands (-1: it does not), `planes` are the table's in each view's camera axes (unit normal; NaN: unknown);
    `views` are those that take part."""

    store: ViewStore
    views: Int[Array, " m"]
    stand: Int[Array, " n"]
    planes: Float[Array, "n 4"]
    config: SupportPlaneConfig
    facing_camera: dict[int, tuple[Float[Array, "p 3"], Float[Array, "p 3"]]] = field(default_factory=dict)
    """What `_seen` gave, by view: asked for at every step and of every stand."""

    def add(
        self, H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"], place: Int[Array, " n"]
    ) -> None:
        """Adds to normal equations for the twists of the object frame per unknown (object_from_camera <- exp(twist)
        object_from_camera); `place`: each view's unknown, -1 where it is fixed."""
        stands = self.views[self.stand[self.views] >= 0]
        for number in np.unique(self.stand[stands]):
            self._add_plane(H, g, poses, place, int(stands[self.stand[stands] == number][0]))

    def _add_plane(
        self, H: Float[Array, "f f 6 6"], g: Float[Array, "f 6"], poses: Float[Array, "n 4 4"],
        place: Int[Array, " n"], stand: int,
    ) -> None:  # fmt: skip
        """The terms of one plane. Its height's error c is solved for and taken out: with r = J x + c, the sums over all
        points of w, w r and w J leave s, h and o, and c = -(h + o x) / (s + 1 / plane_m^2)."""
        c, (turn, shift) = self.config, (poses[stand, :3, :3], poses[stand, :3, 3])
        normal = turn.T @ self.planes[stand, :3]
        height = float(self.planes[stand, :3] @ shift + self.planes[stand, 3])
        total, weighed = c.plane_m**-2, 0.0
        shared = np.zeros((len(g), 6))
        for i in self.views[self.views != stand]:
            back = se3.inverse(poses[i])
            points, normals = self._seen(int(i))
            points = points[normals @ (poses[i, :3, :3] @ normal) < -c.facing]
            points = points @ back[:3, :3].T + back[:3, 3]
            above = points @ normal + height
            on = np.abs(above) < c.near_m
            if on.sum() < c.least_points:
                continue
            points, above = points[on], above[on]
            w = tukey_weight(above / c.near_m) / c.point_m**2
            total, weighed = total + float(w.sum()), weighed + float(w @ above)
            J = np.column_stack([np.tile(normal, (len(points), 1)), np.cross(points, normal)])
            A, b, o = J.T @ (w[:, None] * J), J.T @ (w * above), J.T @ w
            at = [(int(place[i]), 1.0), (int(place[stand]), -1.0)]
            for x, sign in at:
                if x < 0:
                    continue
                g[x] += sign * b
                shared[x] += sign * o
                for y, other in at:
                    if y >= 0:
                        H[x, y] += sign * other * A
        g -= shared * (weighed / total)
        touched = np.flatnonzero(np.abs(shared).sum(1) > 0)
        H[np.ix_(touched, touched)] -= np.einsum("ai,bj->abij", shared[touched], shared[touched]) / total

    def _seen(self, view: int) -> tuple[Float[Array, "p 3"], Float[Array, "p 3"]]:
        """A view's points that face its camera, and their normals (camera axes)."""
        if view not in self.facing_camera:
            first, count = int(self.store.table[view, lay.FIRST]), int(self.store.table[view, lay.COUNT])
            samples = self.store.samples[first : first + count].astype(np.float64)
            points, normals = samples[:, :3], samples[:, 3:6]
            towards = -np.einsum("pj,pj->p", points, normals) / np.linalg.norm(points, axis=1)
            seen = towards > self.config.seen
            self.facing_camera[view] = points[seen], normals[seen]
        return self.facing_camera[view]


def support_plane(
    store: ViewStore, poses: Float[Array, "n 4 4"], views: Int[Array, " m"], config: SupportPlaneConfig
) -> SupportPlane:
    """Of a toss's views in the order of time, at poses `camera_from_object`: where the body stands on the table."""
    stand, planes = np.full(len(store), -1), np.full((len(store), 4), np.nan)
    for number, run in enumerate(_still_runs(poses, [int(i) for i in views], config)):
        plane = _stood_on(store, run[0], config)
        if plane is not None:
            stand[run], planes[run] = number, plane
    return SupportPlane(store, views, stand, planes, config)


def _still_runs(poses: Float[Array, "n 4 4"], views: list[int], config: SupportPlaneConfig) -> list[list[int]]:
    """Views in a row, each as near to the first as a body that does not move: found by the poses of a finished track,
    because the masks of a body at rest flicker more than `ViewStore.stands_still` allows."""
    runs: list[list[int]] = [[]]
    for i in views:
        if runs[-1] and not _same_place(poses[runs[-1][0]], poses[i], config):
            runs.append([])
        runs[-1].append(i)
    return [run for run in runs if len(run) >= config.least_still]


def _same_place(one: Float[Array, "4 4"], two: Float[Array, "4 4"], config: SupportPlaneConfig) -> bool:
    turn = float(np.linalg.norm(turn_between(one, two)))
    return turn < config.still_rad and float(np.linalg.norm(one[:3, 3] - two[:3, 3])) < config.still_m


def _stood_on(store: ViewStore, view: int, config: SupportPlaneConfig) -> Float[Array, "4"] | None:
    """The table's plane, if the body reaches down to it."""
    crop, plane = store.crops[view], table_of(store, view)
    if crop is None or plane is None or crop.height_m is None:
        return None
    inside = crop.mask & (crop.depth_m > 0)
    if not inside.any() or float(np.quantile(crop.height_m[inside], config.lowest)) > config.stands_m:
        return None
    return np.asarray(plane / np.linalg.norm(plane[:3]))
