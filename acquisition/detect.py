"""A toss, watched while it happens: release, first impact, rest, from the gripper's width and thumbnails of depth.

Everything above the table that is not the arm is the object. In flight its centroid follows a parabola; where it leaves
it, the object has hit something. Live, the watcher only has to know when the toss is over; the events are worked out
from all that was seen, once it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, UInt16
from numpy import ndarray as Array

from acquisition.arm.limits import ArmModel
from recordings.constants import GRAVITY_M_S2
from recordings.geometry import CameraModel, Transform
from recordings.records import TossEvent

TABLE_M = 0.008
"""Points lower than this belong to the table."""
HIGHEST_M = 1.2
REACH_M = 0.6
"""Half width of the square over the table that is looked at."""
ARM_MARGIN_M = 0.03
MOVED_M = 0.012
"""A pixel shows something new when it is nearer than before by this."""
FAR_M = 0.3
"""The object is not further from where it was expected."""
LINK_M = 0.06
"""Object points hang together within this."""
FEWEST_POINTS = 6
LEFT_PARABOLA_M = 0.02
FEWEST_FALLING, FALLS_WITHIN_M = 6, 0.01
"""Six frames at 30 Hz fall 3 cm off a straight line: more than this tolerance forgives."""
STILL_M = 0.0025
LOST_FROM_VIEW_S = 1.0
STILL_FOR_S = 0.25
OPENED_M = 0.002
LONGEST_FLIGHT_S = 1.5


@dataclass(frozen=True, eq=False)
class Glimpse:
    """The object in one thumbnail: centroid, lowest point (world), how many points."""

    time_s: float
    centroid_m: Float[Array, "3"]
    lowest_m: float
    points: int


@dataclass(frozen=True)
class Moment:
    """A time on the session clock with its standard deviation."""

    time_s: float
    sigma_s: float
    source: str


@dataclass
class TossEvents:
    """What was found; None where it did not show."""

    release: Moment | None = None
    first_impact: Moment | None = None
    rest: Moment | None = None

    def records(self) -> list[TossEvent]:
        """As they are written to a session."""
        found = []
        for kind, moment in (("release", self.release), ("first_impact", self.first_impact), ("rest", self.rest)):
            if moment is not None:
                time_ns = max(round(moment.time_s * 1e9), 0)
                found.append(TossEvent(time_ns, kind, moment.source, "", moment.sigma_s))  # type: ignore[arg-type]
        return found


class Eye:
    """Turns thumbnails into glimpses. `stride`: every how many pixels of the camera's image one was taken."""

    def __init__(
        self,
        camera: CameraModel,
        world_from_camera: Transform,
        stride: int,
        arm: ArmModel | None = None,
        world_from_base: Transform | None = None,
    ) -> None:
        self._arm, self._world_from_base = arm, world_from_base
        rows, columns = np.mgrid[0 : camera.height : stride, 0 : camera.width : stride]
        self.shape = rows.shape
        pixels = np.stack([columns, rows], -1).reshape(-1, 2).astype(np.float64)
        rays = camera.rays(pixels)
        self._background: Array | None = None
        self._rays_world = (rays / rays[:, 2:]) @ world_from_camera.rotation.T
        self._origin_m = world_from_camera.translation_m

    def learn(self, raws: Sequence[UInt16[Array, "h w"]], unit_m: float) -> None:
        """What stands there before the toss is no object, as long as it is where it was."""
        if len(raws):
            stack = np.array([raw.reshape(-1) for raw in raws]).astype(np.float64) * unit_m
            self._background = np.median(np.where(stack > 0, stack, np.inf), axis=0)

    def tool_m(self, q_rad: Float[Array, " j"] | None) -> Float[Array, "3"] | None:
        """Where the hand is, in the world; None where nobody knows."""
        if q_rad is None or self._arm is None or self._world_from_base is None:
            return None
        return self._world_from_base.points(self._arm.base_from_tool(q_rad).translation_m[None])[0]

    def see(
        self,
        time_s: float,
        raw: UInt16[Array, "h w"],
        unit_m: float,
        q_rad: Float[Array, " j"] | None,
        near_m: Float[Array, "3"] | None,
    ) -> Glimpse | None:
        """The object; None where nothing of it shows. Of several things, the one nearest to `near_m`."""
        depth = raw.reshape(-1).astype(np.float64) * unit_m
        points = self._origin_m + depth[:, None] * self._rays_world
        keep = (depth > 0) & (points[:, 2] > TABLE_M) & (points[:, 2] < HIGHEST_M)
        keep &= (np.abs(points[:, :2]) < REACH_M).all(axis=1)
        if self._background is not None:
            keep &= depth < self._background - MOVED_M
        found = points[keep]
        if q_rad is not None and self._arm is not None and self._world_from_base is not None and len(found):
            found = found[~self._on_arm(found, q_rad)]
        if len(found) < FEWEST_POINTS:
            return None
        found = found[self._one_thing(found, near_m)]
        if len(found) < FEWEST_POINTS or (near_m is not None and np.linalg.norm(found.mean(axis=0) - near_m) > FAR_M):
            return None
        return Glimpse(time_s, np.median(found, axis=0), float(np.percentile(found[:, 2], 3)), len(found))

    def _on_arm(self, points_m: Float[Array, "n 3"], q_rad: Float[Array, " j"]) -> Bool[Array, " n"]:
        assert self._arm is not None
        assert self._world_from_base is not None
        a, b, radius = self._arm.segments(q_rad)
        a, b = self._world_from_base.points(a), self._world_from_base.points(b)
        inside = np.zeros(len(points_m), dtype=bool)
        for start, end, r in zip(a, b, radius):
            inside |= _distance_to_segment(points_m, start, end) < r + ARM_MARGIN_M
        return inside

    def _one_thing(self, points_m: Float[Array, "n 3"], near_m: Array | None) -> Bool[Array, " n"]:
        """Points that hang together: grown from the point nearest to where the object is thought to be."""
        if near_m is None:
            near_m = np.median(points_m, axis=0)
        inside = np.zeros(len(points_m), dtype=bool)
        fresh = np.array([int(np.linalg.norm(points_m - near_m, axis=1).argmin())])
        while len(fresh):
            inside[fresh] = True
            rest = np.flatnonzero(~inside)
            if len(rest) == 0:
                break
            low, high = points_m[fresh].min(axis=0) - LINK_M, points_m[fresh].max(axis=0) + LINK_M
            rest = rest[((points_m[rest] > low) & (points_m[rest] < high)).all(axis=1)]
            if len(rest) == 0:
                break
            gaps = np.linalg.norm(points_m[rest][:, None] - points_m[fresh][None, :: max(1, len(fresh) // 60)], axis=2)
            fresh = rest[gaps.min(axis=1) < LINK_M]
        return inside


def _distance_to_segment(
    points_m: Float[Array, "n 3"], a_m: Float[Array, "3"], b_m: Float[Array, "3"]
) -> Float[Array, " n"]:
    along = b_m - a_m
    share = np.clip((points_m - a_m) @ along / max(float(along @ along), 1e-12), 0, 1)
    return np.linalg.norm(points_m - a_m - share[:, None] * along, axis=1)


@dataclass
class TossWatcher:
    """Follows one toss. Feed it in time order; `over` says that the object has come to rest.

    `by_hand`: no gripper tells of the release, so it is where a free fall begins.
    """

    by_hand: bool = False
    glimpses: list[Glimpse] = field(default_factory=list)
    widths: list[tuple[float, float]] = field(default_factory=list)

    def expected_m(self, time_s: float, tool_m: Float[Array, "3"] | None) -> Float[Array, "3"] | None:
        """Where to look for the object: at the hand until it is released, then on from where it was last seen."""
        if tool_m is not None and (self.released is None or time_s < self.released.time_s + 0.03):
            return tool_m
        if not self.glimpses:
            return None
        last = self.glimpses[-1]
        if len(self.glimpses) < 2 or time_s - last.time_s > 0.1:
            return last.centroid_m
        before = self.glimpses[-2]
        return last.centroid_m + (last.centroid_m - before.centroid_m) * (time_s - last.time_s) / (
            last.time_s - before.time_s
        )

    def saw(self, glimpse: Glimpse | None) -> None:
        if glimpse is not None:
            self.glimpses.append(glimpse)

    def width(self, time_s: float, width_m: float) -> None:
        self.widths.append((time_s, width_m))

    @property
    def released(self) -> Moment | None:
        return release_from_widths(np.array(self.widths)) if self.widths else None

    def over(self, now_s: float) -> bool:
        """Whether the object has been still for a while after it was released."""
        released = self.released
        since_s = released.time_s if released is not None else None
        if self.by_hand:
            since_s = flight_start_s(self.glimpses)
        if since_s is None or not self.glimpses or self.glimpses[-1].time_s < since_s + 0.2:
            return False
        still = still_since_s([g for g in self.glimpses if g.time_s > since_s])
        return still is not None and now_s - still > STILL_FOR_S

    def waits_for(self, now_s: float) -> str:
        """What has not been seen yet of a toss that is not over, in words."""
        since_s = flight_start_s(self.glimpses) if self.by_hand else self.released.time_s if self.released else None
        if since_s is None:
            return "no free fall was seen" if self.by_hand else "the fingers were not seen to open"
        after = [g for g in self.glimpses if g.time_s > since_s]
        if not after:
            return "the object was not seen since it was let go: is it in the depth camera's view?"
        if now_s - after[-1].time_s > LOST_FROM_VIEW_S:
            return f"the object left the depth camera's view {now_s - after[-1].time_s:.1f} s ago"
        still = still_since_s(after)
        if still is None:
            return "the object still moves"
        return f"the object is still since {max(now_s - still, 0.0):.1f} s, {STILL_FOR_S:g} s are wanted"

    def events(self) -> TossEvents:
        """Release, first impact and rest, as far as they show in what was seen."""
        return find_events(self.glimpses, self.released, self.by_hand)


def release_from_widths(widths: Float[Array, "n 2"]) -> Moment | None:
    """When the fingers began to open: back along the opening to the width that was held before."""
    if len(widths) < 3:
        return None
    times, width = widths[:, 0], widths[:, 1]
    floor = np.minimum.accumulate(width)
    opened = np.flatnonzero((width - floor > OPENED_M) & (np.arange(len(width)) > 0))
    lasting = [k for k in opened if (width[k : k + 3] - floor[k] > OPENED_M).all()]
    if not lasting:
        return None
    k = lasting[0]
    held = float(np.median(width[max(0, k - 10) : k]))
    before_s, step_s = float(times[k - 1]), float(times[k] - times[k - 1])
    speeds = [(width[k] - held) / step_s]
    if k + 1 < len(width):
        speeds.append((width[k + 1] - width[k]) / float(times[k + 1] - times[k]))
    started = float(times[k] - (width[k] - held) / max(speeds))
    return Moment(float(np.clip(started, before_s, times[k])), max(0.3 * step_s, 1e-3), "gripper width")


def flight_start_s(glimpses: Sequence[Glimpse]) -> float | None:
    """When a free fall begins (tosses by hand)."""
    run = _longest_flight(glimpses)
    return None if run is None else glimpses[run[0]].time_s


def _longest_flight(glimpses: Sequence[Glimpse]) -> tuple[int, int] | None:
    """First and last glimpse of the longest stretch that falls as a stone does."""
    if len(glimpses) < FEWEST_FALLING:
        return None
    t = np.array([g.time_s for g in glimpses])
    p = np.array([g.centroid_m for g in glimpses])
    best: tuple[int, int] | None = None
    for first in range(len(t) - FEWEST_FALLING + 1):
        last = first + FEWEST_FALLING - 1
        while last < len(t) and t[last] - t[first] < LONGEST_FLIGHT_S:
            if not _falls(t[first : last + 1], p[first : last + 1]):
                break
            last += 1
        if last - first >= FEWEST_FALLING and (best is None or last - 1 - first > best[1] - best[0]):
            best = (first, last - 1)
    return best


def _falls(t: Float[Array, " n"], p: Float[Array, "n 3"]) -> bool:
    """Whether a trajectory is a parabola of free fall: its residual is small, and a resting thing's is not."""
    s = t - t[0]
    free = p + np.outer(s**2, [0, 0, GRAVITY_M_S2 / 2])
    design = np.stack([np.ones_like(s), s], 1)
    left = free - design @ np.linalg.lstsq(design, free, rcond=None)[0]
    moved = np.linalg.norm(p[-1] - p[0]) > 0.04
    return bool(np.sqrt((left**2).sum(axis=1)).max() < FALLS_WITHIN_M and moved)


def still_since_s(glimpses: Sequence[Glimpse]) -> float | None:
    """When the object stopped for good: from there on its centroid stays where it is at the end, but for noise."""
    if len(glimpses) < 6:
        return None
    p = np.array([g.centroid_m for g in glimpses])
    end = np.median(p[-6:], axis=0)
    noise_m = float(np.median(np.linalg.norm(p[-6:] - end, axis=1)))
    away = np.linalg.norm(p - end, axis=1) > np.clip(3.5 * noise_m, 2 * STILL_M, 5 * STILL_M)
    last = int(np.flatnonzero(away)[-1]) if away.any() else -1
    if last + 1 >= len(glimpses) - 1:
        return None
    return glimpses[last + 1].time_s


def find_events(glimpses: Sequence[Glimpse], released: Moment | None, by_hand: bool = False) -> TossEvents:
    """Everything that the glimpses of a toss tell."""
    flight = _flight_after(glimpses, released) if released is not None or by_hand else None
    if flight is None:
        return TossEvents(released)
    first, last = flight
    period_s = float(np.median(np.diff([g.time_s for g in glimpses])))
    if released is None:
        released = Moment(glimpses[first].time_s - 0.5 * period_s, 0.4 * period_s, "onset of free fall")
    impact = _impact(glimpses, first, last, period_s)
    still = still_since_s(glimpses[last:])
    rest = Moment(still, period_s, "depth") if still is not None else None
    return TossEvents(released, impact, rest)


def _flight_after(glimpses: Sequence[Glimpse], released: Moment | None) -> tuple[int, int] | None:
    """First glimpse and last glimpse of the free flight."""
    if released is None:
        return _longest_flight(glimpses)
    after = [i for i, g in enumerate(glimpses) if g.time_s > released.time_s + 0.045]
    if len(after) < 4:
        return None
    t = np.array([glimpses[i].time_s for i in after])
    p = np.array([glimpses[i].centroid_m for i in after])
    for count in range(4, len(after)):
        s = t[:count] - t[0]
        fall = p[:count, 2] + GRAVITY_M_S2 / 2 * s**2
        trend = np.polyfit(s, fall, 1)
        ahead = t[count] - t[0]
        predicted = np.polyval(trend, ahead) - GRAVITY_M_S2 / 2 * ahead**2
        if p[count, 2] - predicted > LEFT_PARABOLA_M:
            return after[0], after[count - 1]
    return after[0], after[-1]


def _impact(glimpses: Sequence[Glimpse], first: int, last: int, period_s: float) -> Moment | None:
    """Between the last glimpse of the flight and the next one; where the lowest point would pass the table."""
    if last + 1 >= len(glimpses):
        return None
    flight = glimpses[first : last + 1]
    t = np.array([g.time_s for g in flight])
    s = t - t[-1]
    low = np.array([g.lowest_m for g in flight]) + GRAVITY_M_S2 / 2 * s**2
    slope, level = np.polyfit(s, low, 1)
    # level + slope s - g s^2 / 2 = 0
    root = (slope + np.sqrt(max(slope**2 + 2 * GRAVITY_M_S2 * max(level, 0.0), 0.0))) / GRAVITY_M_S2
    begin, end = glimpses[last].time_s, glimpses[last + 1].time_s
    return Moment(float(np.clip(begin + root, begin - 0.5 * period_s, end)), 0.3 * period_s, "depth")
