"""What to throw next: the throw that is expected to shrink most what is not known yet, and why, in one line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.live.friction import LawSoFar, shrink_by
from processing.live.sides import Start, TossSides, next_starts, surface_sigma_m
from recordings.geometry import Transform

ALIKE = 0.25
"""A throw whose spin or height differs from the others' median by a smaller share is called alike."""


@dataclass(frozen=True)
class Throw:
    """How one toss was thrown, from its track: the spin in flight, and the height it fell from to its first impact."""

    spin_rad_s: float
    fall_m: float


@dataclass(frozen=True)
class Option:
    """A throw, by what share it is expected to shrink the standard deviation of what it is for, and the reason."""

    text: str
    shrink: float


def options(
    sides: Sequence[TossSides],
    now_camera_from_object: Float[Array, "4 4"] | None,
    center_m: Float[Array, "3"],
    extent_m: float,
    world_from_camera: Transform | None,
    law: LawSoFar | None,
    throws: Mapping[int, Throw],
) -> list[Option]:
    """All that was weighed, best first; empty where nothing is known yet. `now_camera_from_object`: how the object lies
    now, after the last toss (None: not known)."""
    found = []
    if sides and now_camera_from_object is not None:
        now = surface_sigma_m(np.sum([s.information for s in sides], axis=0), extent_m)
        starts = next_starts(sides, now_camera_from_object, center_m, world_from_camera, extent_m)
        found += [_start(s, now) for s in starts]
    if law is not None:
        found += [_like(t, law, throws) for t in law.information if t in throws]
    elif world_from_camera is not None and sides:
        found.append(Option("a toss that flies, hits the table and comes to rest: only such tell friction", 0.0))
    return sorted(found, key=lambda o: -o.shrink)


def _start(start: Start, now_m: float) -> Option:
    shrink = 1 - start.sigma_m / now_m
    why = [w for w, is_so in (("not seen", start.unseen), ("not touched", start.untouched)) if is_so]
    reason = f"that side was {' and '.join(why)} yet" if why else "it was seen least"
    text = (
        f"begin with the side that {start.side} now towards the camera: {reason}; the surface's uncertainty "
        f"{1e3 * now_m:.1f} mm is expected to shrink by {100 * shrink:.0f} %"
    )
    return Option(text, shrink)


def _like(toss: int, law: LawSoFar, throws: Mapping[int, Throw]) -> Option:
    shrink = shrink_by(law, toss)
    return Option(
        f"throw like toss {toss}{_differs(toss, throws)}: of all it told most of friction; its interval is expected to "
        f"shrink by {100 * shrink:.0f} %",
        shrink,
    )


def _differs(toss: int, throws: Mapping[int, Throw]) -> str:
    """How that toss was thrown, beside the others."""
    others = [t for k, t in throws.items() if k != toss]
    if not others:
        return ""
    own, words = throws[toss], []
    spin = float(np.median([t.spin_rad_s for t in others]))
    fall = float(np.median([t.fall_m for t in others]))
    if abs(own.spin_rad_s - spin) > ALIKE * max(spin, 0.1):
        words.append("more spin" if own.spin_rad_s > spin else "less spin")
    if abs(own.fall_m - fall) > ALIKE * max(fall, 0.01):
        words.append("higher" if own.fall_m > fall else "lower")
    return f" ({', '.join(words)})" if words else ""
