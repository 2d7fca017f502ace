"""Pairing of streams on the session clock."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray as Array

UNPAIRED = -1


def pair_nearest(times_ns: Int64[Array, " n"], others_ns: Int64[Array, " m"], max_gap_ns: int) -> Int64[Array, " n"]:
    """For each time the index of its nearest other, each used at most once; UNPAIRED where none is near enough.

    When two times want the same other, the nearer one gets it and the other stays unpaired. Neither must be in order.
    """
    if len(others_ns) == 0 or len(times_ns) == 0:
        return np.full(len(times_ns), UNPAIRED, dtype=np.int64)
    order = np.argsort(others_ns, kind="stable")
    pairs = _pair_ordered(times_ns, others_ns[order], max_gap_ns)
    return np.where(pairs == UNPAIRED, UNPAIRED, order[pairs])


def _pair_ordered(times_ns: Int64[Array, " n"], others_ns: Int64[Array, " m"], max_gap_ns: int) -> Int64[Array, " n"]:
    right = np.searchsorted(others_ns, times_ns).clip(0, len(others_ns) - 1)
    left = (right - 1).clip(0)
    gap_left, gap_right = np.abs(times_ns - others_ns[left]), np.abs(times_ns - others_ns[right])
    nearest = np.where(gap_left <= gap_right, left, right)
    gaps = np.minimum(gap_left, gap_right)
    chosen = np.full(len(times_ns), UNPAIRED, dtype=np.int64)
    owner: dict[int, int] = {}
    for i in np.argsort(gaps, kind="stable"):
        if gaps[i] <= max_gap_ns and int(nearest[i]) not in owner:
            owner[int(nearest[i])] = int(i)
            chosen[i] = nearest[i]
    return chosen


def frame_period_ns(times_ns: Int64[Array, " n"]) -> int | None:
    """The median step between frames; None for fewer than two."""
    return int(np.median(np.diff(times_ns))) if len(times_ns) > 1 else None


def gaps(times_ns: Int64[Array, " n"], period_ns: int) -> list[tuple[int, int]]:
    """Where frames are missing: (position after which, how many) for every step of 1.5 periods or more."""
    steps = np.rint(np.diff(times_ns) / period_ns).astype(int)
    return [(int(i), int(steps[i]) - 1) for i in np.flatnonzero(np.diff(times_ns) >= 1.5 * period_ns)]


def clock_offset_ns(residuals: Mapping[str, Any], stream: str) -> int:
    """What to add to a stream's stamps so that they mean the colour camera's instants: 0 where nobody measured.

    `residuals` of calibration.json hold it as `time.offsets.<stream>.offset_ns`; streams are `mono` (the cameras that
    are triggered together) and `arm`. Measured by `toss-calibrate time`; recorded stamps are never changed.
    """
    offsets = residuals.get("time", {}).get("offsets", {}) if isinstance(residuals.get("time"), Mapping) else {}
    one = offsets.get(stream, {})
    return int(one.get("offset_ns", 0)) if isinstance(one, Mapping) else 0
