"""Does the data mean what it says? Step, scale, quaternion order, velocity frames, jumps, plane, duplicates.

Every check is a physical law that the right reading fulfils: free fall accelerates at 9.81 m/s^2; velocities are
differences of poses; an impulse at a point changes spin and velocity at right angles; a resting object touches the
plane.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from processing.motion.phases import LEAST_SIGMA_M, Phases
from processing.motion.thresholds import DATA_CHECK_IMPACT_M_S
from processing.motion.trajectory import PoseSeries, differences
from recordings.constants import GRAVITY_M_S2, MAD_TO_SIGMA
from recordings.errors import BadInput

LEAST_FRAMES = 5
MOST_SPEED_M_S, MOST_SPIN_RAD_S = 8.0, 45.0
"""Beyond these, and beyond MOST_RATIO times the toss's median, a step between frames is a jump."""
MOST_RATIO = 6.0
FALL_TOLERANCE = 0.06
"""Relative error of the acceleration of free fall; 0.06 is 3 % of the step or 6 % of the scale."""
PLANE_TOLERANCE_M = 0.005
PLANE_BY_TOUCH_M = (-0.002, 0.005)
"""Where a right plane may be by the touches (touch.py): 0 for sharp edges, and above it by the radius of rounded ones
(the real cubes of ContactNets: 2 to 3 mm, theirs are rounded by 4 and their plane is 1.2 mm low). Chosen on simulated
bodies and half of the real tosses (tools/bench_plane.py)."""
SURE_STD = 2.0
FALL_FRAMES = (20, 14, 10, 7, 5, 4)
LONGEST_FALL_S = 0.2
"""Lengths of the windows in which a fall is looked for: a longer one at 30 Hz would span an impact."""
MOST_FALL_ERROR_M_S2 = 0.4
"""A window that knows its acceleration less well proves nothing."""
SAME_HEIGHT_M, SAME_TILT = 1e-8, 1e-5
SAME_FRAMES = 30


def check_frames(series: PoseSeries) -> None:
    """Raises BadInput for a toss that is too short, not in time order, or jumps."""
    name = f"toss {series.toss}"
    if len(series) < LEAST_FRAMES:
        raise BadInput(f"{name}: {len(series)} frames with a pose; wanted at least {LEAST_FRAMES}")
    if not (np.diff(series.time_s) > 0).all():
        raise BadInput(f"{name}: the times of its poses do not grow; record or import it again")
    states = differences(series)
    speed = np.linalg.norm(states.velocity_world_m_s, axis=1)
    spin = np.linalg.norm(states.spin_object_rad_s, axis=1)
    for what, values, most in (("m/s", speed, MOST_SPEED_M_S), ("rad/s", spin, MOST_SPIN_RAD_S)):
        limit = max(most, MOST_RATIO * float(np.median(values)))
        if values.max() > limit:
            raise BadInput(
                f"{name}: the pose jumps at frame {int(values.argmax())} ({values.max():.1f} {what}, "
                f"median {np.median(values):.1f}); wanted less than {limit:.0f}; track it again, or leave the toss out"
            )


@dataclass(frozen=True)
class Fall:
    """Vertical acceleration of free fall (m/s^2, upwards positive) and its standard error."""

    value: float
    error: float


def measured_fall(tosses: Sequence[PoseSeries]) -> Fall | None:
    """The acceleration of free fall: the median over tosses, each by its longest window that is a parabola within its
    pose noise and has no sideways acceleration. None where fewer than three tosses (or windows) fall."""
    found = [f for series in tosses for f in _falls(series)]
    if len(found) < 3:
        return None
    values, errors = np.array([f.value for f in found]), np.array([f.error for f in found])
    median = float(np.median(values))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(values - median)))  # at 30 Hz some windows are bounces, and scatter
    return Fall(median, 1.25 * max(spread, float(np.sqrt((errors**2).mean()))) / len(found) ** 0.5)


def _falls(series: PoseSeries) -> list[Fall]:
    """At most one fall: of the longest window length that has any, the window with the least misfit."""
    noise = _least_noise_m(series)
    for frames in FALL_FRAMES:
        if (frames - 1) * series.step_s > LONGEST_FALL_S and frames > FALL_FRAMES[-1]:
            continue
        windows = [w for i in range(len(series) - frames + 1) if (w := _parabola(series, i, frames, noise))]
        if windows:
            return [min(windows, key=lambda w: w[0])[1]]
    return []


def _least_noise_m(series: PoseSeries) -> float:
    """Pose noise from the quieter quarter of the sideways second differences: at 30 Hz contact fills the other ones."""
    dt = np.diff(series.time_s)
    bend = np.diff(np.diff(series.position_m[:, :2], axis=0) / dt[:, None], axis=0) * dt[1:, None]
    quarter = float(np.quantile(np.abs(bend), 0.25)) if len(bend) else 0.0
    return max(quarter / 0.3186 / 6**0.5, LEAST_SIGMA_M)  # 0.3186 sigma is the first quartile of a |Gaussian|


def _parabola(series: PoseSeries, first: int, frames: int, noise_m: float) -> tuple[float, Fall] | None:
    t, p = series.time_s[first : first + frames], series.position_m[first : first + frames]
    t = t - t.mean()
    A = np.stack([np.ones_like(t), t, 0.5 * t * t], 1)
    inverse = np.linalg.inv(A.T @ A)
    fit = inverse @ A.T @ p
    left = float(np.sqrt(((p - A @ fit) ** 2).sum() / (3 * max(frames - 3, 1))))
    error = float(noise_m * inverse[2, 2] ** 0.5)
    sideways = float(np.abs(fit[2, :2]).max())
    if (
        left > 2 * noise_m
        or abs(fit[2, 2]) < 5 * error
        or error > MOST_FALL_ERROR_M_S2
        or sideways > 0.05 * abs(fit[2, 2]) + 3 * error
    ):
        return None
    return left, Fall(float(fit[2, 2]), error)


class InconsistentPoses(BadInput):
    """Poses that break a law of mechanics. Imported ones were read wrongly, which the message says; `of_own_tracks` is
    what to say where they are vision's: nobody read them wrongly, so something that was measured is off."""

    def __init__(self, message: str, of_own_tracks: str) -> None:
        super().__init__(message)
        self.of_own_tracks = of_own_tracks


@contextmanager
def of_own_tracks() -> Iterator[None]:
    """Around all that learns from vision's own tracks: what is said of a contradiction is what is true of those."""
    try:
        yield
    except InconsistentPoses as wrong:
        raise BadInput(wrong.of_own_tracks) from wrong


def check_fall(tosses: Sequence[PoseSeries]) -> float | None:
    """The acceleration of free fall. Raises BadInput where it is not gravity's, beyond its own error: the step or the
    scale is wrong."""
    found = measured_fall(tosses)
    if found is None:
        return None
    fall = found.value
    if abs(fall + GRAVITY_M_S2) <= max(FALL_TOLERANCE * GRAVITY_M_S2, 4 * found.error):
        return fall
    if fall > 0:
        raise BadInput(f"free fall accelerates upwards ({fall:.2f} m/s^2): z of `world` must point up, against gravity")
    step, scale = tosses[0].step_s, GRAVITY_M_S2 / -fall
    reads = f"free fall reads {-fall:.2f} m/s^2 instead of {GRAVITY_M_S2} (+- {found.error:.2f})"
    raise InconsistentPoses(
        f"{reads}: either the time step is wrong ({step * 1e3:.3f} ms is said, {step * 1e3 / scale**0.5:.3f} ms would "
        f"fit) or the scale (1 m in the data would be {scale:.4f} m); import it again with the right `--dt` or "
        "`--scale`",
        f"{reads} in the tracks: most likely depth is scaled (by {1 / scale:.3f}; `toss-calibrate table SESSION` "
        f"measures it), less likely the frames' stamps are (a frame lasts {step * 1e3:.2f} ms by them, "
        f"{step * 1e3 / scale**0.5:.2f} ms would fit: `toss-session verify SESSION`)",
    )


def _permuted(series: PoseSeries) -> PoseSeries:
    """What the poses would be if their quaternions had been stored as xyzw and read as wxyz."""
    q = Rotation.from_matrix(series.rotation).as_quat()[:, [3, 0, 1, 2]]  # what was read, in the order it was stored
    return replace(series, rotation=Rotation.from_quat(q).as_matrix())


READINGS = {
    "quaternions stored as x y z w (they were read as w x y z)": _permuted,
    "inverse rotations (object_from_world)": lambda s: replace(s, rotation=np.swapaxes(s.rotation, 1, 2).copy()),
}


def impact_angle(tosses: Sequence[PoseSeries], inertia: Float[Array, "3 3"]) -> tuple[float, int]:
    """|dL . dv| / (|dL| |dv|) over impacts, weighted by the product, and how many impacts: near 0 where
    orientations are
    read right, about 0.5 where they are not. An impulse J at r gives m dv = J and dL = r x J."""
    across = along = 0.0
    count = 0
    for series in tosses:
        states = differences(series)
        gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
        dv = np.diff(states.velocity_world_m_s[1:], axis=0) - np.diff(series.time_s)[1:, None] * gravity
        momentum = np.einsum("nij,jk,nk->ni", states.rotation, inertia, states.spin_object_rad_s)[1:]
        dL = np.diff(momentum, axis=0)
        hit = np.linalg.norm(dv, axis=1) > DATA_CHECK_IMPACT_M_S
        across += float(np.abs((dL * dv).sum(1))[hit].sum())
        along += float((np.linalg.norm(dL, axis=1) * np.linalg.norm(dv, axis=1))[hit].sum())
        count += int(hit.sum())
    return (across / along if along > 0 else 0.0), count


def check_orientations(tosses: Sequence[PoseSeries], inertia: Float[Array, "3 3"]) -> float:
    """How far impacts are from a right angle (0..1). Raises BadInput where another reading of the rotations fits
    far better."""
    here, count = impact_angle(tosses, inertia)
    if count < 5:
        return here
    for name, read in READINGS.items():
        other, _ = impact_angle([read(s) for s in tosses], inertia)
        if here > 0.3 and other < 0.6 * here:
            raise InconsistentPoses(
                f"impacts do not fit the orientations (misfit {here:.2f}), but they do ({other:.2f}) when the "
                f"rotations are {name}; import the data again in that reading",
                f"at impacts the tracked object does not turn as a rigid body that is hit would (misfit {here:.2f}, "
                "wanted below 0.3): most likely its orientation is off (blur, or an object that looks alike from "
                "several sides: look at the impacts with `toss-view`), less likely the table's place is "
                "(`toss-calibrate table SESSION`)",
            )
    return here


def check_velocities(tosses: Sequence[PoseSeries]) -> None:
    """Where a recording claims velocities: raises BadInput if they are not the differences of its poses, and says which
    other frame or quaternion order would fit."""
    claimed = [s for s in tosses if s.velocity_world_m_s is not None and s.spin_object_rad_s is not None]
    if not claimed:
        return
    named = {
        "linear velocity": _linear_gaps(claimed),
        "angular velocity": _angular_gaps(claimed),
    }
    for what, (size, gaps) in named.items():
        right, *others = gaps.items()
        best = min(others, key=lambda item: item[1])
        if right[1] > 0.25 * size and best[1] < 0.5 * right[1]:
            raise BadInput(
                f"the claimed {what} is not the difference of the poses (off by {right[1]:.3g}, typical size "
                f"{size:.3g}), "
                f"but it is ({best[1]:.3g}) read as {best[0]}; wanted: {right[0]}"
            )
        if right[1] > 0.25 * size:
            raise BadInput(
                f"the claimed {what} is not the difference of the poses (off by {right[1]:.3g}, typical size "
                f"{size:.3g}): "
                "check the time step"
            )


Gaps = tuple[float, dict[str, float]]


def _median_gap(pairs: Sequence[tuple[Array, Array]]) -> float:
    return float(np.median(np.concatenate([np.linalg.norm(a - b, axis=1)[1:] for a, b in pairs])))


def _linear_gaps(tosses: Sequence[PoseSeries]) -> Gaps:
    found: dict[str, list] = {"metres per second in the world frame": [], "velocity in the object frame": []}
    for s in tosses:
        own = differences(s).velocity_world_m_s
        given = np.asarray(s.velocity_world_m_s)
        found["metres per second in the world frame"].append((given, own))
        found["velocity in the object frame"].append((np.einsum("nij,nj->ni", s.rotation, given), own))
    zero = [(own, np.zeros_like(own)) for _, own in found["metres per second in the world frame"]]
    return _median_gap(zero), {name: _median_gap(pairs) for name, pairs in found.items()}


def _angular_gaps(tosses: Sequence[PoseSeries]) -> Gaps:
    body = "radians per second in the object frame, quaternions w x y z"
    found: dict[str, list] = {body: [], "angular velocity in the world frame": [], "degrees per second": []}
    found["quaternions stored as x y z w (they were read as w x y z)"] = []
    for s in tosses:
        own, given = differences(s).spin_object_rad_s, np.asarray(s.spin_object_rad_s)
        found[body].append((given, own))
        found["angular velocity in the world frame"].append((np.einsum("nji,nj->ni", s.rotation, given), own))
        found["degrees per second"].append((np.radians(given), own))
        permuted = differences(_permuted(s)).spin_object_rad_s
        found["quaternions stored as x y z w (they were read as w x y z)"].append((given, permuted))
    return _median_gap([(own, np.zeros_like(own)) for _, own in found[body]]), {
        name: _median_gap(pairs) for name, pairs in found.items()
    }


def lowest_point_m(
    series: PoseSeries, points_m: Float[Array, "v 3"], phases: Phases, share: float = 0.0
) -> float | None:
    """Height of the lowest point above the plane (z = 0), or that which a share of the points lies below; median over
    the rest at the end. None where it does not rest."""
    if phases.rest is None:
        return None
    rest = slice(phases.rest, None)
    heights = series.rotation[rest, 2] @ points_m.T
    lowest = heights.min(1) if share == 0 else np.quantile(heights, share, axis=1)
    return float(np.median(lowest + series.position_m[rest, 2]))


def check_plane(heights_m: Mapping[int, float], what: str) -> float | None:
    """The median height of the resting object's lowest point. Raises BadInput where it is more than 5 mm off the
    plane."""
    if not heights_m:
        return None
    height = float(np.median(list(heights_m.values())))
    if abs(height) > PLANE_TOLERANCE_M:
        side = "above" if height > 0 else "below"
        raise BadInput(
            f"at rest the lowest point of {what} is {abs(height) * 1e3:.1f} mm {side} the plane (median of "
            f"{len(heights_m)} tosses); wanted within {PLANE_TOLERANCE_M * 1e3:.0f} mm. {_causes(heights_m)}"
        )
    return height


def say_alike(heights_m: Mapping[int, float]) -> bool:
    """Whether two tosses or more rest as far off the plane, within half of it."""
    off = np.array(list(heights_m.values()))
    return len(off) > 1 and bool(np.abs(off - np.median(off)).max() <= 0.5 * abs(float(np.median(off))))


def _causes(heights_m: Mapping[int, float]) -> str:
    """Why a resting object is not on the plane, the likeliest first: a wrong plane or size is off by as much in every
    toss, wrong poses are not."""
    poses = "the poses at rest (look at them with `toss-view`) or parts of the shape that were not seen"
    plane = "the plane (`toss-calibrate table SESSION`, or by `--table-from-depth`) or the size of the shape"
    if len(heights_m) < 2:
        return f"One toss cannot tell which is wrong: {poses}, or {plane}"
    if not say_alike(heights_m):
        return f"Tosses differ, so most likely wrong are {poses}; less likely {plane}"
    return f"Every toss says the same, so most likely wrong is {plane}; less likely {poses}"


def plane_warning(height_m: float | None, std_m: float | None) -> str | None:
    """What to say of the plane's height by the touches (touch.plane_by_touch): nothing where one standard deviation
    leaves it possible."""
    if height_m is None or std_m is None:
        return None
    if height_m + std_m < PLANE_BY_TOUCH_M[0]:
        side, but, size = "below", "and lower still if the object's edges are rounded", "small"
    elif height_m - std_m > PLANE_BY_TOUCH_M[1]:
        side, but, size = "above", "unless the object's edges are rounded by as much", "large"
    else:
        return None
    return (
        f"the poses in which the plane carries the object put it {1e3 * abs(height_m):.0f} +- {1e3 * std_m:.0f} mm "
        f"{side} where it was said to be, {but}; the size is then too {size} by about twice as much. Most likely the "
        "plane is off (`toss-calibrate table SESSION`; without cameras: residuals.table of calibration.json, "
        "normal_world and offset_m), less likely the heights of the poses"
    )


def check_touched_plane(height_m: float | None, std_m: float | None) -> None:
    """Raises BadInput where the touches fit no body, sharp or round, on a plane less than 5 mm lower: surely."""
    if height_m is not None and std_m is not None and height_m + SURE_STD * std_m < -PLANE_TOLERANCE_M:
        raise BadInput(f"{plane_warning(height_m, std_m)}; wanted within {PLANE_TOLERANCE_M * 1e3:.0f} mm")


def duplicate_groups(tosses: Sequence[PoseSeries]) -> list[tuple[int, ...]]:
    """Groups of tosses that are one recording: equal heights and tilts over their first frames (turning about z keeps
    both; heights alone are also equal where a simulation drops everything from one height)."""
    groups: list[tuple[int, ...]] = []
    taken: set[int] = set()
    for i, a in enumerate(tosses):
        if a.toss in taken:
            continue
        same = [b.toss for b in tosses[i + 1 :] if b.toss not in taken and _same_motion(a, b)]
        if same:
            groups.append((a.toss, *same))
            taken.update(groups[-1])
    return groups


def _same_motion(a: PoseSeries, b: PoseSeries) -> bool:
    n = min(len(a), len(b), SAME_FRAMES)
    higher = np.abs(a.position_m[:n, 2] - b.position_m[:n, 2]).max()
    return bool(higher < SAME_HEIGHT_M and np.abs(a.rotation[:n, 2] - b.rotation[:n, 2]).max() < SAME_TILT)


def refuse_leaks(train: Sequence[int], test: Sequence[int], groups: Sequence[Sequence[int]]) -> None:
    """Raises BadInput where a recording is both learned from and tested on."""
    both = sorted(set(train) & set(test))
    if both:
        raise BadInput(f"tosses {both} are in --train and in --test; wanted two separate sets")
    for group in groups:
        learned, tested = sorted(set(group) & set(train)), sorted(set(group) & set(test))
        if learned and tested:
            raise BadInput(
                f"toss {tested[0]} of --test is the same recording as toss {learned[0]} of --train; leave one of them "
                "out"
            )
