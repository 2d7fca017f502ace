"""Whether the columns of a toss file mean what their format says: step, scale, quaternion order, frame of the spin."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.constants import GRAVITY_M_S2
from recordings.errors import BadInput
from recordings.importers.common import Warnings

SAME_Z_M = 1e-9
"""Tosses whose heights agree to this are one recording (turning it about z leaves the heights)."""
STEP_WARNED, STEP_REFUSED = 0.005, 0.05
FLIGHT_STEPS = 10
"""A toss file begins in flight: its first steps tell gravity."""
FALL_REFUSED = 0.3
MOVING_M_S, TURNING_RAD_S = 0.2, 1.0


@dataclass(frozen=True, eq=False)
class States:
    """One toss in SI: positions and velocities in the world, quaternions world_from_object, spin in the object."""

    position_m: Float[Array, "t 3"]
    quaternion_wxyz: Float[Array, "t 4"]
    velocity_m_s: Float[Array, "t 3"]
    spin_rad_s: Float[Array, "t 3"]


@dataclass(frozen=True)
class Checks:
    """Medians over all tosses. None where the motion does not tell.

    `step_ratio`: the step that velocities and positions say, over the one used. `fall_m_s2`: acceleration along z in
    the first steps. `spin_mismatch_rad_s`: stored spins against quaternion differences, read as wxyz in the object
    frame (as the format says), the same in the world frame, and read as xyzw.
    """

    step_ratio: float | None
    fall_m_s2: float | None
    spin_mismatch_rad_s: float | None
    spin_mismatch_world_rad_s: float | None
    spin_mismatch_xyzw_rad_s: float | None


def check_all(tosses: Mapping[int, States], dt_s: float, warnings: Warnings) -> Checks:
    """Compare what the columns say of each other. Raises BadInput where they contradict the format or the units."""
    all_of = tosses.values()
    checks = Checks(
        step_ratio=_median([_step_ratios(t, dt_s) for t in all_of]),
        fall_m_s2=_median([_first_accelerations(t, dt_s)[:, 2] for t in all_of]),
        spin_mismatch_rad_s=_median([_spin_gaps(t, dt_s, t.quaternion_wxyz) for t in all_of]),
        spin_mismatch_world_rad_s=_median([_spin_gaps(t, dt_s, t.quaternion_wxyz, world=True) for t in all_of]),
        spin_mismatch_xyzw_rad_s=_median([_spin_gaps(t, dt_s, np.roll(t.quaternion_wxyz, 1, axis=1)) for t in all_of]),
    )
    _judge_step(checks.step_ratio, dt_s, warnings)
    _judge_spin(checks, warnings)
    _judge_velocity(all_of, dt_s, warnings)
    sideways = _median([np.linalg.norm(_first_accelerations(t, dt_s)[:, :2], axis=1) for t in all_of])
    _judge_fall(checks.fall_m_s2, sideways, warnings)
    return checks


def duplicates(tosses: Mapping[int, States]) -> list[list[int]]:
    """Groups of tosses with equal heights (over the frames that both have), each in the order of their numbers."""
    numbers = sorted(tosses, key=lambda n: (tosses[n].position_m[0, 2], n))
    groups: list[list[int]] = []
    for i, number in enumerate(numbers):
        for other in reversed(numbers[:i]):
            if tosses[number].position_m[0, 2] - tosses[other].position_m[0, 2] > SAME_Z_M:
                break
            if _same_heights(tosses[number], tosses[other]):
                (next((g for g in groups if other in g), None) or _new(groups, other)).append(number)
                break
    return sorted(sorted(group) for group in groups)


def _new(groups: list[list[int]], first: int) -> list[int]:
    groups.append([first])
    return groups[-1]


def _same_heights(a: States, b: States) -> bool:
    n = min(len(a.position_m), len(b.position_m))
    return bool(np.abs(a.position_m[:n, 2] - b.position_m[:n, 2]).max() <= SAME_Z_M)


def _median(parts: list[Array]) -> float | None:
    joined = np.concatenate(parts) if parts else np.zeros(0)
    return float(np.median(joined)) if len(joined) else None


def _step_ratios(toss: States, dt_s: float) -> Float[Array, " n"]:
    """|p[k+1] - p[k]| / (|v[k+1]| dt): velocities are backward differences. Steps in motion only."""
    moved = np.linalg.norm(np.diff(toss.position_m, axis=0), axis=1)
    speed = np.linalg.norm(toss.velocity_m_s[1:], axis=1)
    fast = speed > MOVING_M_S
    return moved[fast] / (speed[fast] * dt_s)


def _first_accelerations(toss: States, dt_s: float) -> Float[Array, "n 3"]:
    velocities = np.diff(toss.position_m[: FLIGHT_STEPS + 2], axis=0) / dt_s
    return np.diff(velocities, axis=0) / dt_s


def _spin_gaps(
    toss: States, dt_s: float, quaternions: Float[Array, "t 4"], *, world: bool = False
) -> Float[Array, " n"]:
    """|stored spin - spin of the quaternion differences|, rad/s, in the object (or the world), for turning steps."""
    conjugate = quaternions * [1, -1, -1, -1]
    turn = _product(quaternions[1:], conjugate[:-1]) if world else _product(conjugate[:-1], quaternions[1:])
    turn *= np.where(turn[:, :1] < 0, -1.0, 1.0)
    sine = np.linalg.norm(turn[:, 1:], axis=1)
    angle = 2 * np.arctan2(sine, turn[:, 0])
    spin = turn[:, 1:] * (angle / np.maximum(sine, 1e-12) / dt_s)[:, None]
    turning = np.linalg.norm(toss.spin_rad_s[1:], axis=1) > TURNING_RAD_S
    return np.linalg.norm(spin - toss.spin_rad_s[1:], axis=1)[turning]


def _product(a: Float[Array, "n 4"], b: Float[Array, "n 4"]) -> Float[Array, "n 4"]:
    """Quaternion product a b, wxyz."""
    aw, av, bw, bv = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    w = aw * bw - (av * bv).sum(axis=1, keepdims=True)
    return np.hstack([w, aw * bv + bw * av + np.cross(av, bv)])


def _judge_step(ratio: float | None, dt_s: float, warnings: Warnings) -> None:
    if ratio is None or abs(ratio - 1) <= STEP_WARNED:
        return
    off = f"{100 * (ratio - 1):+.2g} % off the given {dt_s:.6g} s"
    said = f"positions and velocities say a step of {ratio * dt_s:.6g} s, {off}"
    if abs(ratio - 1) > STEP_REFUSED:
        raise BadInput(f"{said}; give the right one: --dt {ratio * dt_s:.6g}")
    warnings.add(said)


def _judge_spin(checks: Checks, warnings: Warnings) -> None:
    here, xyzw = checks.spin_mismatch_rad_s, checks.spin_mismatch_xyzw_rad_s
    if here is None or xyzw is None or here < TURNING_RAD_S:
        return
    if xyzw < here / 3:
        raise BadInput(
            "the quaternions fit the spins when read as x y z w; wanted files with w x y z, as the format says"
        )
    world = checks.spin_mismatch_world_rad_s
    if world is not None and world < here / 3:
        warnings.add(
            "the spins fit the quaternions when read in the world frame; the format wants them in the object frame. "
            "Poses are kept as they are, velocities are made from them"
        )
        return
    warnings.add(
        f"spins and quaternions disagree (median {here:.2g} rad/s): is the spin in another frame? Poses are "
        "kept as they are"
    )


def _judge_velocity(tosses: Iterable[States], dt_s: float, warnings: Warnings) -> None:
    """Linear velocities belong to the world; in the object frame they have the right length and a wrong direction."""
    gaps = [_velocity_gaps(t, dt_s) for t in tosses]
    world, object_ = _median([g[0] for g in gaps]), _median([g[1] for g in gaps])
    if world is None or object_ is None or world < MOVING_M_S:
        return
    if object_ < world / 3:
        warnings.add(
            "the linear velocities fit the positions when read in the object frame; the format wants them in the world "
            "frame. Poses are kept as they are, velocities are made from them"
        )
        return
    warnings.add(f"linear velocities and positions disagree (median {world:.2g} m/s): are they in another frame?")


def _velocity_gaps(toss: States, dt_s: float) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """|stored velocity - difference of positions|, m/s, read in the world and in the object frame, for moving steps."""
    moved, stored = np.diff(toss.position_m, axis=0) / dt_s, toss.velocity_m_s[1:]
    q = toss.quaternion_wxyz[1:]
    pure = np.hstack([np.zeros((len(stored), 1)), stored])
    turned = _product(_product(q, pure), q * [1, -1, -1, -1])[:, 1:]
    fast = np.linalg.norm(stored, axis=1) > MOVING_M_S
    return np.linalg.norm(stored - moved, axis=1)[fast], np.linalg.norm(turned - moved, axis=1)[fast]


def _judge_fall(fall: float | None, sideways: float | None, warnings: Warnings) -> None:
    if fall is None or sideways is None or fall > -0.1 or sideways > 0.5 * abs(fall):
        warnings.add("no free fall along -z in the first steps: gravity's direction and the scale could not be checked")
        return
    if abs(fall / -GRAVITY_M_S2 - 1) > FALL_REFUSED:
        raise BadInput(
            f"with this scale things fall at {-fall:.3g} m/s^2; wanted about {GRAVITY_M_S2}: is --scale (metres "
            "per unit of "
            f"position) {GRAVITY_M_S2 / -fall:.3g} times as large?"
        )
