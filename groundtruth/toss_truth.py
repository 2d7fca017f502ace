"""The truth of one toss: the body at the D455's exposures, with covariance and status."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray as Array

from groundtruth.interpolate import classify, interpolate
from groundtruth.session_solve import Solved

Status = Literal["tracked", "interpolated", "lost"]


MOMENT_S = 0.001


@dataclass(frozen=True)
class TrackedLimits:
    """A pose is `tracked` when its standard deviations (over all axes) are below the first two, `lost` when one is
    above the last two (a guess is no truth), else `interpolated`."""

    position_m: float = 0.0015
    turn_rad: float = 0.01
    lost_m: float = 0.01
    lost_rad: float = 0.1


@dataclass(frozen=True, eq=False)
class TossTruth:
    """The body at the D455's colour frames; NaN where lost. Covariances are in the world: (rotation, translation), the
    turn about the body's origin. `open`: an impact or a gap lies round the frame, its covariance is that of a guess.
    `refined`: the D455's own view of the tags has placed it. `soon`: the same poses a millisecond later."""

    time_ns: Int64[Array, " n"]
    world_from_tagged: Float[Array, "n 4 4"]
    covariance: Float[Array, "n 6 6"]
    status: tuple[Status, ...]
    open: Bool[Array, " n"]
    refined: Bool[Array, " n"]
    soon: Float[Array, "n 4 4"]

    def without_guesses(self) -> TossTruth:
        """A frame that counts as lost has no pose."""
        lost = np.array([s == "lost" for s in self.status], dtype=bool)[:, None, None]
        poses, covariance = (np.where(lost, np.nan, a) for a in (self.world_from_tagged, self.covariance))
        return replace(self, world_from_tagged=poses, covariance=covariance)


def at_color_frames(toss: int, times_ns: Int64[Array, " n"], solved: Solved, limits: TrackedLimits) -> TossTruth:
    """The track at the D455's exposures (at the mono cameras' own, where `times_ns` is empty)."""
    track = solved.tracks[toss]
    if len(times_ns) == 0:
        times_ns = track.time_ns
    start = int(track.time_ns[0]) if len(track.time_ns) else 0
    motion = classify((track.time_ns - start) / 1e9, track.world_from_tagged, solved.center_m, track.on_arc)
    found = interpolate(motion, (times_ns - start) / 1e9)
    soon = interpolate(motion, (times_ns - start) / 1e9 + MOMENT_S).poses
    covariance = np.full((len(times_ns), 6, 6), np.nan)
    for i in np.flatnonzero(np.isfinite(found.poses).all(axis=(1, 2))):
        own = _between(track.covariance, int(found.before[i]), float(found.weight[i]))
        own[range(3), range(3)] += found.extra_rad[i] ** 2
        own[range(3, 6), range(3, 6)] += found.extra_m[i] ** 2
        turn = np.kron(np.eye(2), found.poses[i, :3, :3])
        covariance[i] = turn @ own @ turn.T
    loose = (found.extra_m > 0) | (found.extra_rad > 0)
    nobody = np.zeros(len(times_ns), dtype=bool)
    return TossTruth(times_ns, found.poses, covariance, statuses(covariance, limits), loose, nobody, soon)


def statuses(covariance: Float[Array, "n 6 6"], limits: TrackedLimits) -> tuple[Status, ...]:
    """By the standard deviations; NaN is lost."""
    turn = np.sqrt(np.einsum("nii->n", covariance[:, :3, :3]))
    shift = np.sqrt(np.einsum("nii->n", covariance[:, 3:, 3:]))
    sure = (turn <= limits.turn_rad) & (shift <= limits.position_m)
    known = (turn <= limits.lost_rad) & (shift <= limits.lost_m)  # false for NaN
    return tuple("tracked" if a else "interpolated" if b else "lost" for a, b in zip(sure, known))


def _between(covariance: Float[Array, "n 6 6"], before: int, weight: float) -> Float[Array, "6 6"]:
    """Of a pose between two: as if what they share (cameras, layout) does not average out."""
    a, b = covariance[max(before, 0)], covariance[min(before + 1, len(covariance) - 1)]
    return ((1 - weight) * a + weight * b).copy()
