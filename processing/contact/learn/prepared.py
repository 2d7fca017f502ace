"""Tracks made ready to be learned from: moved to the learning frame, checked, cut into phases, smoothed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.learn import data_checks as checks
from processing.contact.learn.prior import Frame
from processing.contact.physics.plane import Plane
from processing.contact.physics.rollout import Start
from processing.motion.smoother import Smoothed, smooth
from processing.motion.trajectory import PoseSeries, States, Steps, steps_of
from recordings.constants import GRAVITY_M_S2
from recordings.errors import BadInput


@dataclass(frozen=True, eq=False)
class Prepared:
    """Tosses that can be learned from: about the centre of mass, in a world whose plane is z = 0."""

    tracks: tuple[PoseSeries, ...]
    smoothed: tuple[Smoothed, ...]
    left_out: Mapping[int, str]


def prepare(tracks: Sequence[PoseSeries], frame: Frame, plane: Plane, inertia: Float[Array, "3 3"]) -> Prepared:
    """Move tracks to the learning frame, check them one by one, smooth them. What cannot be used is left out and
    named."""
    level = plane.level_from_world()
    kept, smoothed, left_out = [], [], {}
    for track in tracks:
        try:
            checks.check_frames(track)
        except BadInput as wrong:
            left_out[track.toss] = str(wrong)
            continue
        moved = frame.of(track).turned(level, plane.offset_m)
        kept.append(moved)
        smoothed.append(smooth(moved, inertia))
    if not kept:
        raise BadInput(none_usable(left_out))
    return Prepared(tuple(kept), tuple(smoothed), left_out)


def starts(
    prepared: Prepared, step_s: float, inertia: Float[Array, "3 3"], begin: Sequence[int] | None = None
) -> tuple[Start, list[int]]:
    """The smoothed state each toss is rolled out from in steps of `step_s`, and its frame: `begin`, else the release
    (frame 0 where no flight was found).

    A velocity of the track is the mean over a frame's interval dt. The one at the frame itself, v0, is the one whose
    rollout covers the next interval as the track does: with v[k+1] = v[k] + h a, the mean over dt = n h is
    v0 + a (dt + h) / 2. At 30 Hz the difference to v is 0.2 m/s; and what a hand did before the release stays out.
    """
    frames = [s.phases.release or 0 for s in prepared.smoothed] if begin is None else list(begin)
    rows = [_start_row(s.states, b, step_s, inertia) for s, b in zip(prepared.smoothed, frames)]
    return Start(*(np.stack(values) for values in zip(*rows))), frames


def _start_row(states: States, frame: int, step_s: float, inertia: Float[Array, "3 3"]) -> tuple[Array, ...]:
    later = min(frame + 1, len(states) - 1)
    half = 0.5 * (states.time_s[later] - states.time_s[frame] + step_s)
    spin = states.spin_object_rad_s[later]
    turning = -np.linalg.solve(inertia, np.cross(spin, inertia @ spin))
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
    return (
        states.rotation[frame],
        states.position_m[frame],
        spin - half * turning,
        states.velocity_world_m_s[later] - half * gravity,
    )


def transitions(prepared: Prepared) -> Steps:
    """Transitions from the release on: what a hand does is not learned."""
    steps = steps_of([s.states for s in prepared.smoothed])
    release = {s.states.toss: s.phases.release or 0 for s in prepared.smoothed}
    begin = np.array([release[t] for t in steps.toss.tolist()])
    return steps.only(steps.frame >= begin + 2)


def no_contact(tosses: int, transitions: int) -> BadInput:
    """What to raise where flight explains everything."""
    return BadInput(
        f"no contact in the data: free flight explains all {transitions} transitions of {tosses} tosses; wanted tosses "
        "that are recorded until the object has hit the plane: record longer, or choose others with --train I-J"
    )


def none_usable(left_out: Mapping[int, str]) -> str:
    """Why no toss can be used: the first reasons, how many more there are, and what to do."""
    if not left_out:
        return "no tosses were given; wanted at least one"
    reasons = list(left_out.values())
    more = f"; and {len(reasons) - 3} more" if len(reasons) > 3 else ""
    return "no toss can be used: " + "; ".join(reasons[:3]) + more + "; record or import longer, steady tosses"
