"""By how much one device's stamps run behind another's, from the motion that both saw.

`offset_s` is what must be ADDED to the other stream's stamps so that they mean the same instants as the reference's
(`time_ns + offset_ns`). It is found together with a constant displacement between the two (calibration errors, another
point of the body), so only the motion over time counts. Motion that no interpolation can follow (impacts) is
left out. Offsets of several tosses are pooled by their variances, widened where they scatter more than they should.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation, Slerp

from calibration.cameras.extrinsics import whitening
from calibration.cameras.pnp import most_agreed, poses_of_points
from calibration.cameras.poses import exp_poses
from calibration.cameras.targets import TargetView
from calibration.report import Finding, Report, limit
from recordings.constants import GRAVITY_M_S2, MAD_TO_SIGMA
from recordings.errors import BadInput
from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight
from recordings.geometry import CameraModel

GOOD_MS, WORST_MS = 1.0, 5.0
LEAST_SPEED_M_S = 0.15
JERKY_M_S2 = 20.0
"""Accelerations further than this from both rest and free fall belong to an impact."""
SEARCH_S, SEARCHED = 0.1, 15
FURTHEST_S = 0.02
"""The furthest that an offset moves in a step."""
STEPS, LEAST_GAIN = 6, 1e-9
RIG_TURN, RIG_SHIFT_M = 0.003, 0.003
"""How far calibration may be off (standard deviations) while the offset is found."""
OPEN_TURN, OPEN_SHIFT_M = 0.1, 0.1
"""The same where only a rough place is known."""
POINT_M, FRAME_TURN, FRAME_SHIFT_M = 0.1, 0.02, 0.02
"""The same between two trajectories: another point of the body, another frame."""
HUBER = 2.5
LEAST_FRAMES = 4


@dataclass(frozen=True, eq=False)
class Path3:
    """A body's trajectory: times in s, positions, and rotations where known."""

    time_s: Float[Array, " n"]
    position_m: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"] | None = None

    @staticmethod
    def of_poses(time_s: Float[Array, " n"], poses: Float[Array, "n 4 4"]) -> Path3:
        return Path3(time_s, poses[:, :3, 3], poses[:, :3, :3])

    def smooth_at(self, time_s: Float[Array, " m"]) -> Bool[Array, " m"]:
        """Where interpolation can be trusted: no end, no gap, no impact within the four frames around."""
        step = np.median(np.diff(self.time_s))
        after = np.searchsorted(self.time_s, time_s)
        inside = (after >= 1) & (after < len(self.time_s))
        at = after.clip(1, len(self.time_s) - 1)
        gap = self.time_s[at] - self.time_s[at - 1] > 1.6 * step
        rough = self._rough()
        near = np.zeros(len(time_s), dtype=bool)
        for shift in (-1, 0):
            near |= rough[(at + shift).clip(0, len(rough) - 1)]
        return inside & ~gap & ~near

    def _rough(self) -> Bool[Array, " n"]:
        """Frames whose second difference is neither rest nor free fall (in any direction: frames need not be level)."""
        rough = np.zeros(len(self.time_s), dtype=bool)
        if len(self.time_s) < 3:
            return rough
        before, behind = np.diff(self.time_s)[:-1], np.diff(self.time_s)[1:]
        speed = np.diff(self.position_m, axis=0) / np.diff(self.time_s)[:, None]
        bend = np.linalg.norm((speed[1:] - speed[:-1]) / ((before + behind) / 2)[:, None], axis=1)
        rough[1:-1] = bend > GRAVITY_M_S2 + JERKY_M_S2
        return rough

    def at(self, time_s: Float[Array, " m"]) -> tuple[Float[Array, "m 3"], Float[Array, "m 3 3"]]:
        """Positions by a cubic through the four nearest frames (exact in free fall), rotations by slerp."""
        t = np.clip(time_s, self.time_s[0], self.time_s[-1])
        position = _cubic(self.time_s, self.position_m, t)
        if self.rotation is None:
            return position, np.tile(np.eye(3), (len(t), 1, 1))
        return position, Slerp(self.time_s, Rotation.from_matrix(self.rotation))(t).as_matrix()


def _cubic(times: Float[Array, " n"], values: Float[Array, "n 3"], at: Float[Array, " m"]) -> Float[Array, "m 3"]:
    """Lagrange's cubic through the two frames before and the two after (three or two at the ends)."""
    first = (np.searchsorted(times, at) - 2).clip(0, max(0, len(times) - 4))
    count = min(4, len(times))
    out = np.zeros((len(at), 3))
    for k in range(count):
        share = np.ones(len(at))
        for j in range(count):
            if j != k:
                share *= (at - times[first + j]) / (times[first + k] - times[first + j])
        out += share[:, None] * values[first + k]
    return out


@dataclass(frozen=True)
class TimeOffset:
    """Add `offset_s` to the other stream's stamps. `frames`: how many of its frames took part."""

    offset_s: float
    std_s: float
    frames: int
    rms: float
    """What is left over: mm between trajectories, px between corners."""


def offset_of_paths(reference: Path3, other: Path3) -> TimeOffset:
    """Between two trajectories of one rigid body, in frames that may differ by a constant displacement on either side.

    With rotations on the reference the other's point may be anywhere on the body. Raises BadInput where nothing moves.
    """

    def gap(offset_s: float, numbers: Array) -> Array:
        position, rotation = reference.at(other.time_s + offset_s)
        carried = position + rotation @ numbers[:3] if reference.rotation is not None else position
        turned = carried @ exp_poses(np.concatenate([numbers[3:6], np.zeros(3)])[None])[0, :3, :3].T + numbers[6:9]
        return 1e3 * (turned - other.position_m)

    weight = 1.0 / np.array([POINT_M] * 3 + [FRAME_TURN] * 3 + [FRAME_SHIFT_M] * 3)
    return _solve(reference, other.time_s, gap, weight, np.zeros(9), whiten=None)[0]


def offset_of_corners(
    reference: Path3,
    model: CameraModel,
    camera_from_rig: Float[Array, "4 4"],
    frames: Sequence[tuple[float, TargetView]],
) -> TimeOffset:
    """Between a trajectory of poses (rig_from_body) and tag corners that a camera with its own stamps saw: `frames` are
    (stamp in s, corners with their places on the body). The camera's place may be off by a few mm and mrad."""
    return _corner_fit(reference, model, camera_from_rig, frames, RIG_TURN, RIG_SHIFT_M)[0]


def _corner_fit(
    reference: Path3,
    model: CameraModel,
    camera_from_rig: Float[Array, "4 4"],
    frames: Sequence[tuple[float, TargetView]],
    turn: float,
    shift_m: float,
) -> tuple[TimeOffset, Float[Array, "4 4"]]:
    """Offset and the camera's place, which is known to `turn` and `shift_m` (standard deviations)."""
    frames = [f for f in frames if len(f[1]) >= 4]
    if len(frames) < LEAST_FRAMES:
        raise BadInput(f"the camera sees the object's tags in {len(frames)} frames; wanted at least {LEAST_FRAMES}")
    stamps = np.repeat([t for t, _ in frames], [len(v) for _, v in frames])
    points = np.concatenate([v.points_m for _, v in frames])
    pixels = np.concatenate([v.pixels for _, v in frames])
    white = whitening(np.concatenate([v.covariance_px2 for _, v in frames]))

    def gap(offset_s: float, numbers: Array) -> Array:
        position, rotation = reference.at(stamps + offset_s)
        in_rig = np.einsum("nij,nj->ni", rotation, points) + position
        placed = exp_poses(numbers[None])[0] @ camera_from_rig
        seen = model.project(in_rig @ placed[:3, :3].T + placed[:3, 3])
        return np.where(np.isfinite(seen), seen - pixels, 1e3)

    weight = 1.0 / np.array([turn] * 3 + [shift_m] * 3)
    found, numbers = _solve(reference, stamps, gap, weight, np.zeros(6), whiten=white)
    return found, exp_poses(numbers[None])[0] @ camera_from_rig


def place_by_motion(
    reference: Path3, model: CameraModel, frames: Sequence[tuple[float, TargetView]]
) -> Float[Array, "4 4"] | None:
    """camera_from_rig of a camera that sees the body's tags at its own times: what most of its frames agree on, then
    all of them with the place wide open and the offset of its stamps solved along. None where they do not agree."""
    frames = [f for f in frames if len(f[1]) >= 4]
    stamps = np.array([t for t, _ in frames])
    smooth = reference.smooth_at(stamps) if len(frames) else np.zeros(0, dtype=bool)
    candidates = []
    for (stamp, view), fine in zip(frames, smooth):
        if fine:
            position, rotation = reference.at(np.array([stamp]))
            back = np.eye(4)
            back[:3, :3], back[:3, 3] = rotation[0].T, -rotation[0].T @ position[0]
            candidates.append([pose @ back for pose, _ in poses_of_points(model, view.points_m, view.pixels)])
    agreed = most_agreed([c for c in candidates if c], 5.0, 0.05)
    if agreed is None or agreed[1] < LEAST_FRAMES:
        return None
    return _corner_fit(reference, model, agreed[0], frames, OPEN_TURN, OPEN_SHIFT_M)[1]


def _solve(
    reference: Path3,
    stamps: Float[Array, " n"],
    gap: Callable[[float, Array], Array],
    prior: Float[Array, " k"],
    start: Float[Array, " k"],
    whiten: Float[Array, "n 2 2"] | None,
) -> tuple[TimeOffset, Float[Array, " k"]]:
    """Coarse search for the offset, then least squares over offset and displacement with a robust kernel."""
    speed_m_s = np.linalg.norm(np.diff(reference.position_m, axis=0), axis=1) / np.diff(reference.time_s)
    if not len(speed_m_s) or np.quantile(speed_m_s, 0.9) < LEAST_SPEED_M_S:
        raise BadInput(
            f"the body hardly moves ({np.max(speed_m_s, initial=0):.2f} m/s at most), so its motion shows no time "
            "offset; wanted a toss"
        )

    def residual(numbers: Array) -> Array:
        raw = gap(numbers[0], numbers[1:])
        return raw if whiten is None else np.einsum("nij,nj->ni", whiten, raw)

    best: tuple[float, Array] | None = None
    for offset in np.linspace(-SEARCH_S, SEARCH_S, SEARCHED):
        numbers = _fit(residual, np.concatenate([[offset], start]), prior, _used(reference, stamps, offset), 1, True)
        error = _error(residual, numbers, _used(reference, stamps, numbers[0]))
        if np.isfinite(error) and (best is None or error < best[0]):
            best = (error, numbers)
    if best is None:
        raise BadInput("the two streams do not overlap in time within 0.1 s; are they of the same toss and clock?")
    numbers = best[1]
    for _ in range(3):
        numbers = _fit(residual, numbers, prior, _used(reference, stamps, numbers[0]), STEPS, False)
    used = _used(reference, stamps, numbers[0])
    return _finished(residual, gap, numbers, prior, used, stamps), numbers[1:]


def _used(reference: Path3, stamps: Float[Array, " n"], offset_s: float) -> Bool[Array, " n"]:
    return reference.smooth_at(stamps + offset_s)


def _error(residual: Callable[[Array], Array], numbers: Array, used: Bool[Array, " n"]) -> float:
    if used.sum() < LEAST_FRAMES:
        return float("inf")
    return float(np.median(np.abs(residual(numbers)[used])))


def _expanded(
    residual: Callable[[Array], Array], numbers: Array, prior: Array, used: Bool[Array, " n"], scale: float
) -> Expansion:
    """Huber's cost of the residuals in units of their scale, and of the displacement beside its prior."""
    here = residual(numbers)[used].ravel()
    steps = np.concatenate([[1e-5], np.full(len(numbers) - 1, 1e-6)])
    J = np.stack(
        [(residual(numbers + s * np.eye(len(numbers))[k])[used].ravel() - here) / s for k, s in enumerate(steps)], -1
    )
    size = np.abs(here) / scale
    root = np.sqrt(huber_weight(size, HUBER)) / scale
    seen = Expansion.of_residuals(root * here, root[:, None] * J, float(huber_cost(size, HUBER).sum()))
    return seen.with_prior(np.diag(np.concatenate([[0.0], prior**2])), numbers)


def _scale(residual: Callable[[Array], Array], numbers: Array, used: Bool[Array, " n"]) -> float:
    """The residuals' robust standard deviation."""
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residual(numbers)[used]))), 1e-9)


def _fit(
    residual: Callable[[Array], Array],
    numbers: Array,
    prior: Array,
    used: Bool[Array, " n"],
    steps: int,
    hold_offset: bool,
) -> Array:
    if used.sum() < LEAST_FRAMES:
        return numbers
    scale = _scale(residual, numbers, used)

    def expanded(at: Array) -> Expansion:
        found = _expanded(residual, at, prior, used, scale)
        if not hold_offset:
            return found
        information, gradient = found.information.copy(), found.gradient.copy()
        information[0], information[:, 0], gradient[0] = 0.0, 0.0, 0.0
        return replace(found, information=information, gradient=gradient)

    def moved(at: Array, step: Array) -> Array:
        return at + np.concatenate([np.clip(step[:1], -FURTHEST_S, FURTHEST_S), step[1:]])

    return minimised(numbers, expanded, moved, steps, LEAST_GAIN).state


def _finished(
    residual: Callable[[Array], Array],
    gap: Callable[[float, Array], Array],
    numbers: Array,
    prior: Array,
    used: Bool[Array, " n"],
    stamps: Array,
) -> TimeOffset:
    scale = _scale(residual, numbers, used)
    size = np.abs(residual(numbers)[used]) / scale
    left_over = max(1.0, float((huber_weight(size, HUBER) * size**2).mean()))
    frames = len(np.unique(stamps[used]))
    per_frame = max(1.0, used.sum() / max(frames, 1))
    # points of one frame err together (interpolation, pose), so frames count, not points
    information = _expanded(residual, numbers, prior, used, scale).information
    variance = np.linalg.pinv(information, hermitian=True)[0, 0] * left_over * per_frame
    rms = float(np.sqrt((gap(numbers[0], numbers[1:])[used] ** 2).mean()))
    return TimeOffset(float(numbers[0]), float(np.sqrt(variance)), frames, rms)


def pooled(offsets: Sequence[TimeOffset]) -> TimeOffset:
    """Several tosses' offsets as one, weighted by their variances; wider where they scatter more than they say."""
    if not offsets:
        raise BadInput("no toss gave a time offset")
    value, variance = (np.array([getattr(o, n) for o in offsets]) for n in ("offset_s", "std_s"))
    weight = 1.0 / np.maximum(variance, 1e-6) ** 2
    mean = float((weight * value).sum() / weight.sum())
    std = float(1.0 / np.sqrt(weight.sum()))
    if len(offsets) > 1:
        std *= max(1.0, float(np.sqrt((weight * (value - mean) ** 2).sum() / (len(offsets) - 1))))
    return TimeOffset(mean, std, sum(o.frames for o in offsets), float(np.median([o.rms for o in offsets])))


def offset_report(stream: str, reference: str, by_toss: Mapping[int, TimeOffset], failed: Mapping[int, str]) -> Report:
    """Pooled offset, each toss against the pool of the others as hold-out, and a verdict."""
    whole = pooled(list(by_toss.values()))
    aside = [
        1e3 * (one.offset_s - pooled([o for k, o in by_toss.items() if k != toss]).offset_s)
        for toss, one in by_toss.items()
        if len(by_toss) > 1
    ]
    findings = limit(1e3 * whole.std_s, f"the standard deviation of {stream}'s offset", "ms", GOOD_MS, WORST_MS)
    if failed:
        listed = "; ".join(f"{k}: {v}" for k, v in failed.items())
        findings.append(Finding("note", f"tosses without an offset: {listed}"))
    if len(by_toss) > 2:
        spread = float(np.std([o.offset_s for o in by_toss.values()]))
        expected = float(np.sqrt(np.mean([o.std_s**2 for o in by_toss.values()])))
        if spread > 3 * expected + 2e-4:
            text = f"{stream}'s offset scatters by {1e3 * spread:.2f} ms between tosses, expected {1e3 * expected:.2f}"
            findings.append(Finding("warning", f"{text}: its stamps are not synchronised with {reference}'s"))
    return Report(
        f"time of {stream} against {reference}",
        {"offset_ms": 1e3 * whole.offset_s, "rms_left": whole.rms, "tosses": len(by_toss), "frames": whole.frames},
        {"toss_against_others_ms": aside},
        {"offset_ms": 1e3 * whole.std_s},
        tuple(findings),
        {"by_toss_ms": {str(k): [1e3 * o.offset_s, 1e3 * o.std_s] for k, o in by_toss.items()}},
    )
