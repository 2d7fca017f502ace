"""The chosen keyframes of several tosses in one store, as registration compares them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.keyframes import view_directions
from processing.track.known_shape import ShapeConfig, center_of, shape_views
from processing.track.registration.support_plane import SupportPlane, SupportPlaneConfig, support_plane
from processing.track.track_toss import TossTrack
from recordings.tracks import ObjectShape


@dataclass(frozen=True, eq=False)
class KeyframeDatabase:
    """The chosen keyframes of all tosses in one store: poses in each toss's own frame, and whose they are."""

    store: ViewStore
    poses: Float[Array, "n 4 4"]
    toss: Int[Array, " n"]
    frame: Int[Array, " n"]
    center_m: Float[Array, "3"]
    support_plane: SupportPlane


@dataclass(frozen=True, eq=False)
class Sides:
    """Views of one toss (`mine`, poses in its own frame), and those that it is to join (`theirs`, common frame)."""

    keyframes: KeyframeDatabase
    mine: Int[Array, " a"]
    theirs: Int[Array, " b"]
    common: Float[Array, "n 4 4"]
    """Poses of all views: right for `theirs` only."""

    def poses(self, common_from_own: Float[Array, "4 4"]) -> Float[Array, "n 4 4"]:
        """Poses in the common frame, where the toss lies so."""
        out = self.common.copy()
        out[self.mine] = self.keyframes.poses[self.mine] @ np.linalg.inv(common_from_own)
        return out

    def surface_centers_m(self) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
        """Center of the surface that either side's views see: of mine in the own frame, of theirs in the common one."""
        return _surface_center_m(self.keyframes.store, self.mine, self.keyframes.poses), _surface_center_m(
            self.keyframes.store, self.theirs, self.common
        )


def keyframes_of(
    tosses: Sequence[TossTrack], model: ObjectShape | None, keyframes: Sequence[int], shape: ShapeConfig,
    ground: SupportPlaneConfig,
) -> KeyframeDatabase:  # fmt: skip
    """So many keyframes of each toss; after them the drawn views of a learned shape, as if they were one more toss."""
    chosen = [_keyframes_from_all_sides(t, count) for t, count in zip(tosses, keyframes)]
    stores = [t.store.only(c) for t, c in zip(tosses, chosen)]
    poses = [t.track.camera_from_object[c] for t, c in zip(tosses, chosen)]
    center_m = tosses[0].center_m
    if model is not None:
        drawn = shape_views(model, [c for s in stores for c in s.crops], stores[0].rectified, shape)
        stores.append(ViewStore(stores[0].rectified, list(drawn.crops), stores[0].config))
        for i in range(len(drawn.crops)):
            stores[-1].fill(i)
        poses.append(drawn.poses)
        chosen.append(np.arange(len(drawn.crops)))
        center_m = center_of(model)
    whose = np.concatenate([np.full(len(c), i) for i, c in enumerate(chosen)])
    store, frame = ViewStore.joined(stores), np.concatenate(chosen)
    return KeyframeDatabase(
        store, np.concatenate(poses), whose, frame, center_m, _support_plane(tosses, store, whose, frame, ground)
    )


def _support_plane(
    tosses: Sequence[TossTrack], store: ViewStore, whose: Int[Array, " n"], frame: Int[Array, " n"],
    config: SupportPlaneConfig,
) -> SupportPlane:  # fmt: skip
    """Where the keyframes stand on the table (a learned shape's views do not)."""
    out = SupportPlane(store, np.arange(len(store)), np.full(len(store), -1), np.full((len(store), 4), np.nan), config)
    for n, toss in enumerate(tosses):
        own, mine = support_plane(toss.store, toss.track.camera_from_object, _usable(toss), config), whose == n
        stand = own.stand[frame[mine]]
        out.stand[mine] = np.where(stand >= 0, len(tosses) * stand + n, -1)
        out.planes[mine] = own.planes[frame[mine]]
    return out


def sides(
    keyframes: KeyframeDatabase, toss: int, joined: Int[Array, " j"], first_from_own: Float[Array, "t 4 4"]
) -> Sides:
    """Views of a toss, and those of the joined tosses."""
    common = keyframes.poses.copy()
    for j in joined:
        rows = keyframes.toss == j
        common[rows] = keyframes.poses[rows] @ np.linalg.inv(first_from_own[j])
    return Sides(
        keyframes, np.flatnonzero(keyframes.toss == toss), np.flatnonzero(np.isin(keyframes.toss, joined)), common
    )


def far_apart(directions: Float[Array, "n 3"], count: int) -> Int[Array, " m"]:
    """Some of many directions, each as far as possible from those before (the first included)."""
    chosen = [0]
    while len(chosen) < min(count, len(directions)):
        nearest = (directions @ directions[chosen].T).max(1)
        nearest[chosen] = np.inf
        chosen.append(int(nearest.argmin()))
    return np.sort(np.array(chosen[: len(directions)], dtype=np.int64))


def _keyframes_from_all_sides(toss: TossTrack, count: int) -> Int[Array, " m"]:
    """Well fitting keyframes, each as far as possible in direction from those before (the first and last included)."""
    poses = toss.track.camera_from_object
    usable = _usable(toss)
    if len(usable) == 0:
        return usable
    directions = view_directions(poses[usable], toss.center_m)
    cost = np.nan_to_num(toss.cost[usable], nan=0.3)
    chosen = [0]
    while len(chosen) < min(count, len(usable)):
        angle = np.degrees(np.arccos(np.clip(directions @ directions[chosen].T, -1, 1))).min(1)
        gain = np.minimum(angle, 40.0) + 0.02 * np.arange(len(usable)) - 200.0 * cost
        gain[chosen] = -np.inf
        chosen.append(int(gain.argmax()))
    return np.sort(usable[chosen])


def _usable(toss: TossTrack) -> Int[Array, " m"]:
    """Frames that have a pose and something to see: one that is not sure may be off by some degrees from the first
    one, but shows a side that the sure ones, often all of them in the hand, do not."""
    posed = ~toss.track.lost
    return np.array([i for i in np.flatnonzero(posed) if toss.store.usable(int(i))], dtype=np.int64)


def _surface_center_m(store: ViewStore, views: Int[Array, " a"], poses: Float[Array, "n 4 4"]) -> Float[Array, "3"]:
    """Center of the surface seen by several views, object frame."""
    seen = []
    for i in views:
        back = np.linalg.inv(poses[i])
        row = store.table[i]
        points = store.samples[row[lay.FIRST] : row[lay.FIRST] + row[lay.COUNT] : 5, :3]
        seen.append(points @ back[:3, :3].T + back[:3, 3])
    cloud = np.concatenate(seen)
    return np.asarray(0.5 * (np.quantile(cloud, 0.02, axis=0) + np.quantile(cloud, 0.98, axis=0)))
