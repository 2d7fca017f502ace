"""Poses between measured poses: ballistic in flight, smooth in the hand and at rest, never across an impact.

The measured poses are world_from_body at times t_k; `center` is the centre of mass in the body. An interval is

- `ballistic`: the centre of mass takes the parabola through both ends, x(t) = chord - g (t - t_k)(t_k+1 - t) / 2, and
  the body turns at constant speed. Nothing but the two ends is needed.
- `smooth`: a cubic through both ends with the slopes of its neighbours.
- `impact`: the motion before is carried on and the motion after carried back; where they meet in the interval is the
  impact, and each holds on its own side. What is left of a gap between them is shared out linearly. Where they do not
  meet (a second impact, a contact that lasts) it is bridged by a cubic as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from recordings.constants import GRAVITY_M_S2

Kind = Literal["ballistic", "smooth", "impact"]
GRAVITY_WORLD_M_S2 = np.array([0.0, 0.0, -GRAVITY_M_S2])


@dataclass(frozen=True)
class InterpolationConfig:
    jolt_m: float = 0.002
    """Third differences of position above this are no smooth motion."""
    jolt_rad: float = 0.012
    longest_gap: float = 1.6
    """An interval longer than this many usual ones is a gap: what lies in it is uncertain."""
    meet_share: float = 0.25
    """Motions before and after an impact meet when they come nearer than this share of what parts them elsewhere."""
    meet_sigma_share: float = 0.05
    """This share of it is doubt that one impact was all."""
    impact_steps: int = 40
    """Instants of an interval at which an impact is tried."""
    reach: float = 0.6
    """Before the first and after the last pose, poses are carried on for this share of the usual interval."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Measured poses in time order, and what kind of motion each interval holds."""

    time_s: Float[Array, " n"]
    poses: Float[Array, "n 4 4"]
    center_m: Float[Array, "3"]
    kinds: tuple[Kind, ...]

    @property
    def period_s(self) -> float:
        return float(np.median(np.diff(self.time_s))) if len(self.time_s) > 1 else 0.0


@dataclass(frozen=True, eq=False)
class Interpolated:
    """Poses (NaN where there is none) and what is added to the uncertainty of the measured ones, m and rad.
    `before`: the interval of each, -1 and n - 1 outside; `weight`: how far along it (0..1) each lies."""

    poses: Float[Array, "m 4 4"]
    extra_m: Float[Array, " m"]
    extra_rad: Float[Array, " m"]
    before: Int[Array, " m"]
    weight: Float[Array, " m"]


def classify(
    time_s: Float[Array, " n"],
    poses: Float[Array, "n 4 4"],
    center_m: Float[Array, "3"],
    ballistic: Bool[Array, " n"],
    config: InterpolationConfig | None = None,
) -> Motion:
    """Kinds of all intervals. `ballistic[k]`: poses k-1, k, k+1 lie on one arc."""
    config = config or InterpolationConfig()
    turns = _rotations(poses)
    centers = poses[:, :3, 3] + poses[:, :3, :3] @ center_m
    kinds: list[Kind] = []
    for k in range(len(time_s) - 1):
        on_arc = bool(ballistic[k] or ballistic[k + 1])
        kinds.append("ballistic" if on_arc else "smooth" if _smooth(time_s, centers, turns, k, config) else "impact")
    return Motion(time_s, poses, center_m, tuple(kinds))


def _rotations(poses: Float[Array, "n 4 4"]) -> Float[Array, "m 3"]:
    """Rotation vectors from each pose to the next, in the body."""
    R = Rotation.from_matrix(poses[:, :3, :3])
    return (R[:-1].inv() * R[1:]).as_rotvec() if len(poses) > 1 else np.zeros((0, 3))


def _smooth(
    time_s: Float[Array, " n"],
    centers: Float[Array, "n 3"],
    turns: Float[Array, "m 3"],
    k: int,
    config: InterpolationConfig,
) -> bool:
    """Whether acceleration hardly changes over the four poses round interval k (three, at an end)."""
    lo, hi = max(0, k - 1), min(len(time_s), k + 3)
    h = np.diff(time_s[lo:hi])
    speeds = np.diff(centers[lo:hi], axis=0) / h[:, None]
    spins = turns[lo : hi - 1] / h[:, None]
    scale = h.mean()
    if len(h) < 2:
        return True
    change, turn = np.diff(speeds, axis=0) * scale, np.diff(spins, axis=0) * scale
    if len(h) == 3:
        change, turn = np.diff(change, axis=0), np.diff(turn, axis=0)
    return bool(
        np.linalg.norm(change, axis=1).max() < config.jolt_m and np.linalg.norm(turn, axis=1).max() < config.jolt_rad
    )


def interpolate(motion: Motion, times_s: Float[Array, " m"], config: InterpolationConfig | None = None) -> Interpolated:
    """Poses at any times; NaN farther outside than `reach`."""
    config = config or InterpolationConfig()
    n, m = len(motion.time_s), len(times_s)
    poses, extra_m, extra_rad = np.full((m, 4, 4), np.nan), np.zeros(m), np.zeros(m)
    before = np.searchsorted(motion.time_s, times_s, side="right") - 1
    weight = np.zeros(m)
    for i, t in enumerate(times_s):
        k = int(before[i])
        if n == 0:
            continue
        if k < 0 or k >= n - 1:
            poses[i], extra_m[i], extra_rad[i] = _outside(motion, float(t), config)
            continue
        weight[i] = (t - motion.time_s[k]) / (motion.time_s[k + 1] - motion.time_s[k])
        poses[i], extra_m[i], extra_rad[i] = _inside(motion, k, float(t), config)
    return Interpolated(poses, extra_m, extra_rad, before, weight)


def _inside(motion: Motion, k: int, t: float, config: InterpolationConfig) -> tuple[Float[Array, "4 4"], float, float]:
    h = motion.time_s[k + 1] - motion.time_s[k]
    gap = max(0.0, h / motion.period_s - config.longest_gap)
    kind = motion.kinds[k]
    if kind == "ballistic":
        pose = _arc(motion, k, t)
    elif kind == "smooth":
        pose = _cubic(motion, k, t)
    else:
        return _through_impact(motion, k, t, config)
    u = (t - motion.time_s[k]) / h
    loose = gap * u * (1 - u)
    return pose, 0.02 * loose, 0.2 * loose


def _center(motion: Motion, k: int) -> Float[Array, "3"]:
    return motion.poses[k, :3, 3] + motion.poses[k, :3, :3] @ motion.center_m


def _pose(motion: Motion, R: Float[Array, "3 3"], center: Float[Array, "3"]) -> Float[Array, "4 4"]:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, center - R @ motion.center_m
    return out


def _arc(motion: Motion, k: int, t: float) -> Float[Array, "4 4"]:
    """The arc through poses k and k+1, also outside their interval."""
    a, b = motion.time_s[k], motion.time_s[k + 1]
    u = (t - a) / (b - a)
    x = (1 - u) * _center(motion, k) + u * _center(motion, k + 1) - 0.5 * GRAVITY_WORLD_M_S2 * (t - a) * (b - t)
    turn = _rotations(motion.poses[k : k + 2])[0]
    return _pose(motion, motion.poses[k, :3, :3] @ Rotation.from_rotvec(u * turn).as_matrix(), x)


def _cubic(motion: Motion, k: int, t: float) -> Float[Array, "4 4"]:
    """A cubic through both ends of interval k: centre and rotation vector, with the slopes of the neighbours."""
    h = float(motion.time_s[k + 1] - motion.time_s[k])
    u = (t - motion.time_s[k]) / h
    (va, wa), (vb, wb) = _slope(motion, k, k - 1), _slope(motion, k, k + 1)
    x = _hermite(u, h, _center(motion, k), _center(motion, k + 1), va, vb)
    turn = _rotations(motion.poses[k : k + 2])[0]
    phi = _hermite(u, h, np.zeros(3), turn, wa, wb)
    return _pose(motion, motion.poses[k, :3, :3] @ Rotation.from_rotvec(phi).as_matrix(), x)


def _slope(motion: Motion, inside: int, neighbour: int) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Velocity and spin at the pose between two intervals, for the one inside: the mean of both, each weighted by the
    other's length; that of the arc where the one beside flies."""
    h = np.diff(motion.time_s)
    v, w = _rates(motion, inside)
    if not 0 <= neighbour < len(h):
        return v, w
    other_v, other_w = _rates(motion, neighbour)
    if motion.kinds[neighbour] == "ballistic":
        sign = 0.5 if neighbour < inside else -0.5
        return other_v + sign * h[neighbour] * GRAVITY_WORLD_M_S2, other_w
    share = h[neighbour] / (h[neighbour] + h[inside])
    return share * v + (1 - share) * other_v, share * w + (1 - share) * other_w


def _rates(motion: Motion, k: int) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Mean velocity of the centre and mean spin over an interval."""
    h = float(motion.time_s[k + 1] - motion.time_s[k])
    return (_center(motion, k + 1) - _center(motion, k)) / h, _rotations(motion.poses[k : k + 2])[0] / h


def _hermite(u: float, h: float, a: Array, b: Array, slope_a: Array, slope_b: Array) -> Array:
    return (
        (1 + 2 * u) * (1 - u) ** 2 * a
        + u * (1 - u) ** 2 * h * slope_a
        + u**2 * (3 - 2 * u) * b
        - u**2 * (1 - u) * h * slope_b
    )


def _through_impact(
    motion: Motion, k: int, t: float, config: InterpolationConfig
) -> tuple[Float[Array, "4 4"], float, float]:
    """Way and turn each for itself: where the motions before and after meet, along them; else on the cubic."""
    if k == 0 or k + 1 >= len(motion.kinds):
        return _bridged(motion, k, t, 1 if k == 0 else k - 1)
    a, b = float(motion.time_s[k]), float(motion.time_s[k + 1])
    tried = np.linspace(a, b, config.impact_steps)
    before = np.array([_carried(motion, k - 1, s) for s in tried])
    after = np.array([_carried(motion, k + 1, s) for s in tried])
    x_before, x_after = (p[:, :3, 3] + p[:, :3, :3] @ motion.center_m for p in (before, after))
    ways = x_after - x_before
    turns = Rotation.from_matrix(np.swapaxes(before[:, :3, :3], -1, -2) @ after[:, :3, :3]).as_rotvec()
    pose, loose_m, loose_rad = _bridged(motion, k, t, k - 1)
    x, R = pose[:3, 3] + pose[:3, :3] @ motion.center_m, pose[:3, :3]
    alone = motion.kinds[k - 1] == "ballistic" and motion.kinds[k + 1] != "impact"
    met = _meeting(tried, ways, t, config) if alone else None  # in contact a way curves, and would meet anywhere
    if met is not None:
        at = _carried(motion, k - 1 if met.early else k + 1, t)
        x, loose_m = at[:3, 3] + at[:3, :3] @ motion.center_m + met.correction, met.loose
    met = _meeting(tried, turns, t, config)
    if met is not None:
        at = _carried(motion, k - 1 if met.early else k + 1, t)
        R, loose_rad = at[:3, :3] @ Rotation.from_rotvec(met.correction).as_matrix(), met.loose
    return _pose(motion, R, x), loose_m, loose_rad


@dataclass(frozen=True, eq=False)
class _Meeting:
    """`early`: the time is before the impact. `correction`: the share of the gap that this time has to make up."""

    early: bool
    correction: Float[Array, "3"]
    loose: float


def _meeting(
    tried: Float[Array, " s"], gaps: Float[Array, "s 3"], t: float, config: InterpolationConfig
) -> _Meeting | None:
    """The instant at which two motions are nearest, if that is near against what parts them at the interval's ends."""
    distance = np.linalg.norm(gaps, axis=1)
    best = int(np.argmin(distance))
    if distance[best] > config.meet_share * max(distance[0], distance[-1]):
        return None
    a, b, impact = float(tried[0]), float(tried[-1]), float(tried[best])
    share = (impact - a) / (b - a)
    loose = 0.5 * float(distance[best]) + config.meet_sigma_share * float(max(distance[0], distance[-1]))
    if t < impact:
        along = (t - a) / (impact - a)
        return _Meeting(True, share * along * gaps[best], loose * along)
    along = (b - t) / max(b - impact, 1e-9)
    return _Meeting(False, -(1 - share) * along * gaps[best], loose * along)


def _bridged(motion: Motion, k: int, t: float, clean: int | None) -> tuple[Float[Array, "4 4"], float, float]:
    """On the cubic between the ends of interval k, and how far the motion may be off it."""
    u = float((t - motion.time_s[k]) / (motion.time_s[k + 1] - motion.time_s[k]))
    bend_m, bend_rad = _bend(motion, k, clean)
    return _cubic(motion, k, t), bend_m * 4 * u * (1 - u), bend_rad * 4 * u * (1 - u)


def _carried(motion: Motion, k: int, t: float) -> Float[Array, "4 4"]:
    """Interval k's motion carried on to a time outside it: its arc in flight, else its speeds at the end."""
    if motion.kinds[k] == "ballistic":
        return _arc(motion, k, t)
    return _line(motion, k, t)


def _line(motion: Motion, k: int, t: float) -> Float[Array, "4 4"]:
    """Constant speed and turn through poses k and k+1."""
    a, b = float(motion.time_s[k]), float(motion.time_s[k + 1])
    u = (t - a) / (b - a)
    turn = _rotations(motion.poses[k : k + 2])[0]
    x = (1 - u) * _center(motion, k) + u * _center(motion, k + 1)
    return _pose(motion, motion.poses[k, :3, :3] @ Rotation.from_rotvec(u * turn).as_matrix(), x)


def _bend(motion: Motion, k: int, clean: int | None) -> tuple[float, float]:
    """How far from the chord the motion may be (m, rad) where one side of an impact is not known: by the change of
    speed against the side that is; half of it where none is."""
    h = float(motion.time_s[k + 1] - motion.time_s[k])
    spins = _rotations(motion.poses[k : k + 2])[0] / h
    speed = (_center(motion, k + 1) - _center(motion, k)) / h
    if clean is None:
        return 0.125 * h * float(np.linalg.norm(speed)), 0.125 * h * float(np.linalg.norm(spins))
    g = float(motion.time_s[clean + 1] - motion.time_s[clean])
    other = (_center(motion, clean + 1) - _center(motion, clean)) / g
    spun = _rotations(motion.poses[clean : clean + 2])[0] / g
    return 0.25 * h * float(np.linalg.norm(speed - other)), 0.25 * h * float(np.linalg.norm(spins - spun))


def _outside(motion: Motion, t: float, config: InterpolationConfig) -> tuple[Float[Array, "4 4"], float, float]:
    """Carried on a little before the first and after the last pose; the uncertainty grows with the speed there."""
    n = len(motion.time_s)
    first = t < motion.time_s[0]
    end = float(motion.time_s[0] if first else motion.time_s[-1])
    if t == end:
        return motion.poses[0 if first else -1], 0.0, 0.0
    if n < 2 or abs(t - end) > config.reach * motion.period_s:
        return np.full((4, 4), np.nan), 0.0, 0.0
    k = 0 if first else n - 2
    h = float(motion.time_s[k + 1] - motion.time_s[k])
    way = float(np.linalg.norm(_center(motion, k + 1) - _center(motion, k))) / h * abs(t - end)
    turn = float(np.linalg.norm(_rotations(motion.poses[k : k + 2])[0])) / h * abs(t - end)
    return _carried(motion, k, t), 0.2 * way, 0.2 * turn
