"""How high the plane is by the touches alone: no shape, no inertia, no friction, no loss.

A plane z = h carries the body in a pose (R, p): then u . x >= h - p_z holds for all its points x, with equality where
it touches, u = R' e_z. All carried poses together leave the body K(h), the intersection of these half-spaces, and K(h)
must reach each of them. With a plane that is put too low it always does: K(h) is the body with rounded edges. With one
that is put too high it cannot: of a cube that rests, half its edge has lost as much as the plane rose, and a corner
sqrt(3) times that. So the gaps that K(h) leaves are flat up to the right height and grow from there (a hinge).

Edges rounded by r are the same as a plane that is r higher, to everything that a plane touches: the height found is the
plane's only for a body with sharp edges, and else above it. It is never below.

Only poses count in which the plane carries the body steadily: in an impact a frame is early or late, and the contact
gives way. (The ContactNets loss takes them all; it was 4 mm off on right planes.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion.phases import pose_noise
from processing.motion.trajectory import PoseSeries
from recordings.constants import GRAVITY_M_S2

LEAST_LOAD_G, MOST_LOAD_G = 0.3, 2.5
"""What the plane carries in a frame, in weights of the body; the frames beside it may carry twice the most."""
LONGEST_STEP_S = 0.01
"""Between frames further apart a body may strike and leave: the mean load says nothing of the frame."""
MOST_NOISE_G = 0.3
"""Poses whose noise makes the load less certain than this do not say what carries: 0.06 mm at 148 Hz."""
TURNED_RAD = 0.02
"""A pose that is turned less than this against the one before tells nothing new."""
ALIKE_RAD, ALIKE = 0.1, 5
"""Touches of so similar an attitude share a weight, from this many on: most tosses end on few faces."""
MARGIN_M, MOST_GAP_M, BOUND_M = 0.0005, 0.01, 0.5
"""The half-spaces stand off by the noise of heights; a gap counts up to a size (a finger, a second surface); no object
is larger."""
HEIGHTS_M = 0.001 * np.arange(-24, 25)
FLAT = 5
"""So many of the lowest heights give each touch's gap at a plane that is surely too low."""
ANSWERS_M, FOOT_M = 0.001, (0.0006, 0.0014)
"""Touches that answer to the highest plane by this gap; the hinge is where the line through these two mean gaps of
theirs begins."""
LEAST_STD_M = 0.0003
LEAST_WEIGHT, LEAST_TOSSES, REPEATS = 0.8, 3, 20


@dataclass(frozen=True)
class TouchedPlane:
    """Height of the plane (m, above where it was said to be) by the touches of a sharp-edged body, its standard
    deviation by drawing tosses anew, and how many attitudes answer."""

    height_m: float
    std_m: float
    weight: float


@dataclass(frozen=True, eq=False)
class Touches:
    """Poses that the plane carries: its upward normal in object axes, the height of the object's origin, whose toss."""

    up_object: Float[Array, "n 3"]
    height_m: Float[Array, " n"]
    toss: Int[Array, " n"]

    def of(self, keep: Bool[Array, " n"]) -> Touches:
        return Touches(self.up_object[keep], self.height_m[keep], self.toss[keep])


def plane_by_touch(tracks: Sequence[PoseSeries], releases: Sequence[int], seed: int = 0) -> TouchedPlane | None:
    """The plane by the touches of all tosses, from each one's release on. None where poses are too far apart or too
    noisy, where nothing tilted is carried, or where fewer than LEAST_TOSSES tosses tell."""
    found = [touches(t, r, i) for i, (t, r) in enumerate(zip(tracks, releases)) if _steady(t)]
    if len(found) < LEAST_TOSSES:
        return None
    every = Touches(*(np.concatenate([getattr(f, n) for f in found]) for n in ("up_object", "height_m", "toss")))
    height_m, weight = hinge(every)
    if not np.isfinite(height_m) or weight < LEAST_WEIGHT:
        return None
    rng, numbers = np.random.default_rng(seed), np.unique(every.toss)
    drawn = [rng.choice(numbers, len(numbers)) for _ in range(REPEATS)]
    again = np.array([hinge(every.of(np.isin(every.toss, d)))[0] for d in drawn])
    again = again[np.isfinite(again)]
    if len(again) < REPEATS // 2:
        return None
    low, high = np.quantile(again, [0.16, 0.84])  # a few draws lose all that tilts, and answer anything
    return TouchedPlane(height_m, max(float(high - low) / 2, LEAST_STD_M), weight)


def _steady(track: PoseSeries) -> bool:
    if len(track) < 5 or track.step_s > LONGEST_STEP_S:
        return False
    return 6**0.5 * pose_noise(track).position_m / track.step_s**2 / GRAVITY_M_S2 < MOST_NOISE_G


def touches(track: PoseSeries, release: int, name: int) -> Touches:
    """The frames after the release that the plane carries steadily, without those that are turned as the one before."""
    dt = np.diff(track.time_s)
    speed = np.diff(track.position_m[:, 2]) / dt
    load = np.zeros(len(track))
    load[1:-1] = np.diff(speed) / (0.5 * (dt[1:] + dt[:-1])) / GRAVITY_M_S2 + 1
    carried = (load > LEAST_LOAD_G) & (load < MOST_LOAD_G)
    bearing = (load > LEAST_LOAD_G) & (load < 2 * MOST_LOAD_G)
    carried[1:-1] &= bearing[:-2] & bearing[2:]
    up, kept = track.rotation[:, 2], list[int]()
    for k in np.flatnonzero(carried[release + 1 : -1]) + release + 1:
        if not kept or up[k] @ up[kept[-1]] < np.cos(TURNED_RAD):
            kept.append(int(k))
    return Touches(up[kept], track.position_m[kept, 2], np.full(len(kept), name, dtype=np.int64))


def gaps(found: Touches, plane_m: float) -> Float[Array, " n"] | None:
    """How far K(plane) ends above the plane in each touch; None where nothing is left of K."""
    from scipy.spatial import HalfspaceIntersection

    offset = plane_m - found.height_m - MARGIN_M
    if offset.max() > -2 * MARGIN_M:
        return None
    around = np.concatenate([np.eye(3), -np.eye(3)])
    walls = np.column_stack([around, np.full(6, -BOUND_M)])
    sides = np.concatenate([np.column_stack([-found.up_object, offset]), walls])
    corners = HalfspaceIntersection(sides, np.zeros(3)).intersections
    corners = corners[np.isfinite(corners).all(1)]
    return (found.up_object @ corners.T).min(1) - offset


def hinge(found: Touches) -> tuple[float, float]:
    """The height from which on K misses touches (NaN: none answers), and the weight of those that answer."""
    curves = []
    for h in HEIGHTS_M:
        gap = gaps(found, float(h)) if len(found.height_m) > 3 else None
        if gap is None:
            break
        curves.append(np.clip(gap, 0.0, MOST_GAP_M))
    if len(curves) < 2 * FLAT:
        return float("nan"), 0.0
    gap_m = np.array(curves) - np.mean(curves[:FLAT], axis=0)
    alike = (found.up_object @ found.up_object.T > np.cos(ALIKE_RAD)).sum(1)
    weight = np.where(gap_m[-1] > ANSWERS_M, 1 / np.maximum(alike, ALIKE), 0.0)
    if not weight.any():
        return float("nan"), 0.0
    mean_m = np.maximum.accumulate(gap_m @ weight / weight.sum())
    if mean_m[-1] < FOOT_M[1]:
        return float("nan"), 0.0
    low, high = np.interp(FOOT_M, mean_m + 1e-12 * np.arange(len(mean_m)), HEIGHTS_M[: len(mean_m)])
    return float(low - (high - low) * FOOT_M[0] / (FOOT_M[1] - FOOT_M[0])), float(weight.sum())
