"""A round body's azimuth from its contact with the table: it rolls there, and nothing of it sinks in.

No image shows a mug's azimuth while its handle is hidden. But what lies or leans on the table touches it in a place
that stands still (rolling without slipping: friction holds), so that the velocity of the axis and the turns across it,
which every image shows, leave one spin about the axis. And a handle that was seen before stops on the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray as Array

from processing.sensor.view_store import ViewStore
from processing.track.revolution.axis import Axis
from processing.track.revolution.unwrapping import across, table_of


@dataclass(frozen=True)
class RollConfig:
    """When a round body rolls, how exactly, and what sinks into the table."""

    touches_m: float = 0.003
    """A body whose lowest point is no higher above the table touches it ..."""
    beside_m: float = 0.0015
    """... and with all points no higher than this above that one."""
    longest_s: float = 0.1
    """Between two views; a longer step may hide a bounce."""
    slip_m: float = 0.0015
    """Standard deviation of the way from view to view; what slides is an outlier (Cauchy) ..."""
    off_share: float = 0.2
    """... and where the body seems off the table or in it, its poses err by this share of that more."""
    least_points: int = 10
    """Pixels of what stands off the body; fewer may be anything ..."""
    points: int = 40
    """... and more than about so many add nothing."""
    lowest: float = 0.1
    """So large a share of them may be lower than they are."""
    sunk_m: float = 0.002
    """That far below the table is sunk, with this standard deviation; ..."""
    pose_share: float = 0.5
    """... where the body itself seems in it, so much of that is its pose's error (and the rest its profile's)."""


@dataclass(frozen=True, eq=False)
class ExpectedSteps:
    """From view to view: the turn about the axis that is expected from something else than the images, as
    `Pace.base_rad` counts it, and its standard deviation (infinite where nothing is expected)."""

    step_rad: Float[Array, " r"]
    sigma_rad: Float[Array, " r"]


@dataclass(frozen=True, eq=False)
class Grounded:
    """Views (camera_from_object) of a round body, and each one's table (its plane; None where it is not known)."""

    poses: Float[Array, "v 4 4"]
    table: list[Float[Array, "4"] | None]
    axis: Axis
    rings: Float[Array, "h 2"]

    def low_m(self, view: int) -> Float[Array, " h"]:
        """Each ring's lowest point above the table."""
        plane = self.table[view]
        assert plane is not None
        up, along = plane[:3] / np.linalg.norm(plane[:3]), self.along(view)
        reach = self.rings[:, 1] * np.linalg.norm(_less(up, along))
        return np.asarray(self.ring_centers(view) @ plane[:3] + plane[3] - reach)

    def along(self, view: int) -> Float[Array, "3"]:
        """The axis's direction (camera axes)."""
        return np.asarray(self.poses[view, :3, :3] @ self.axis.direction)

    def ring_centers(self, view: int) -> Float[Array, "h 3"]:
        """Centers of the rings (camera axes)."""
        own = self.axis.point_m + self.rings[:, :1] * self.axis.direction
        return np.asarray(own @ self.poses[view, :3, :3].T + self.poses[view, :3, 3])


def grounded(
    store: ViewStore, views: Int[Array, " v"], poses: Float[Array, "v 4 4"], axis: Axis, rings: Float[Array, "h 2"]
) -> Grounded:
    """`rings`: place along the axis and radius (m) of circles of the body."""
    return Grounded(poses, [table_of(store, int(i)) for i in views], axis, rings)


def rolled(body: Grounded, steps_s: Float[Array, " r"], config: RollConfig) -> ExpectedSteps:
    """The steps that the poses of consecutive views let expect, whatever their azimuths.

    The point p of the body that touches the table does not move: v + w x (p - c) = 0, where w = s a + what turns the
    axis a, gives s."""
    turn, sigma = np.zeros(len(steps_s)), np.full(len(steps_s), np.inf)
    for one, two in pairwise(range(len(body.poses))):
        plane = body.table[one]
        if plane is None or body.table[two] is None or steps_s[one] > config.longest_s:
            continue
        low = body.low_m(one), body.low_m(two)
        before, after = body.along(one), body.along(two)
        along = (before + after) / np.linalg.norm(before + after)
        down = -_less(plane[:3] / np.linalg.norm(plane[:3]), along)
        if max(x.min() for x in low) > config.touches_m or np.linalg.norm(down) < 1e-3:
            continue
        down /= np.linalg.norm(down)
        mean = 0.5 * (low[0] + low[1])
        touching = body.rings[mean < mean.min() + config.beside_m].mean(0)
        point = (touching[0] - body.rings[:, 0].mean()) * along + touching[1] * down
        arm = np.cross(along, point)
        way = (body.ring_centers(two) - body.ring_centers(one)).mean(0) + np.cross(np.cross(before, after), point)
        turn[one] = float(way @ arm) / float(arm @ arm)
        off = max(abs(float(x.min())) for x in low)
        sigma[one] = float(np.hypot(config.slip_m, config.off_share * off) / np.linalg.norm(arm))
    return ExpectedSteps(turn, sigma)


def sunk(
    body: Grounded, standing: list[Float32[Array, "_ s"]], pairs: Int[Array, "m 2"], azimuths_rad: Float[Array, " d"],
    config: RollConfig,
) -> Float[Array, "m d"]:  # fmt: skip
    """How deep what stands off the body in one view of each pair is in the table in the other, in nats, where the first
    is turned by so much more than the second."""
    out = np.zeros((len(pairs), len(azimuths_rad)))
    one, two = across(body.axis)
    parts = []
    for pose, seen in zip(body.poses, standing):
        seen = seen[:: max(len(seen) // config.points, 1)]
        own = (seen[:, :3].astype(np.float64) - pose[:3, 3]) @ pose[:3, :3] - body.axis.point_m
        parts.append((own @ body.axis.direction, np.hypot(own @ one, own @ two), np.arctan2(own @ two, own @ one)))
    low = [np.inf if plane is None else float(body.low_m(n).min()) for n, plane in enumerate(body.table)]
    reach = max((float(np.max(r)) for _, r, _ in parts if len(r)), default=0.0)
    for m, pair in enumerate(pairs):
        for (i, j), sign in ((pair, -1.0), (pair[::-1], 1.0)):
            plane = body.table[j]
            if plane is None or len(standing[i]) < config.least_points or low[j] > reach:
                continue
            turn = body.poses[j, :3, :3]
            foot = plane[:3] @ (turn @ body.axis.point_m + body.poses[j, :3, 3]) + plane[3]
            rise, x, y = (float(plane[:3] @ turn @ d) for d in (body.axis.direction, one, two))
            along, radius, angle = parts[i]
            around = angle[:, None] + sign * azimuths_rad
            height = foot + (along * rise)[:, None] + radius[:, None] * (x * np.cos(around) + y * np.sin(around))
            allowed = config.pose_share * min(low[j], 0.0) - config.sunk_m
            deep = allowed - np.quantile(height, config.lowest, axis=0)
            out[m] += 0.5 * (np.maximum(deep, 0.0) / config.sunk_m) ** 2
    return out


def _less(vector: Float[Array, "3"], along: Float[Array, "3"]) -> Float[Array, "3"]:
    """The part across a direction."""
    return np.asarray(vector - (vector @ along) * along)
