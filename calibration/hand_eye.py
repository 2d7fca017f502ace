"""Where a camera stands to a robot: eye-to-hand (camera fixed, board in the gripper) and eye-in-hand (the other way).

Eye-to-hand: a board point p is seen by the fixed camera at C B_i T p, with B_i = base_from_tool of pose i,
C = camera_from_base and T = tool_from_board. Eye-in-hand: C B_i^-1 T p with C = camera_from_tool, T = base_from_board.
Both are A_i X = Y B_i for the board's pose A_i in the camera. The start (`hand_eye_start.py`) is of the
relative motions; then the reprojection errors and the robot's own errors are minimised together, each robot pose
being free within what the arm is known for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from calibration.cameras.extrinsics import LEAST_POINTS, board_pose, whitening
from calibration.cameras.poses import angle_deg, exp_poses, inverse_poses
from calibration.cameras.targets import TargetView
from calibration.hand_eye_start import best_start
from calibration.report import Finding, Report, limit
from recordings.errors import BadInput
from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight
from recordings.geometry import CameraModel

Mounting = Literal["eye-to-hand", "eye-in-hand"]
LEAST_POSES, GOOD_POSES = 5, 15
LEAST_TURN_DEG = 30.0
LEAST_SECOND_AXIS = 0.2
"""The second rotation axis must have this share of the first one's spread, or the third direction stays unknown."""
GOOD_MM, WORST_MM = 2.0, 5.0
GOOD_DEG, WORST_DEG = 0.3, 1.0
GOOD_PX, WORST_PX = 0.5, 3.0
FOLDS = 4
HUBER = 2.5
STEPS, LEAST_GAIN = 30, 1e-5
ROUNDS, CONVERGED_RATIO = 6, 1.05
DIFFERENCE, POSE_DIFFERENCE = 1e-7, 1e-4


@dataclass(frozen=True)
class ArmAccuracy:
    """How well the arm knows its tool's pose, in the tool's frame (standard deviations). A guess: the data decide."""

    turn_deg: float = 0.05
    shift_m: float = 0.0003


@dataclass(frozen=True)
class LensAccuracy:
    """Standard deviations of a lens, as `toss-calibrate intrinsics` states them; 0 where nothing is stated."""

    focal_percent: float = 0.0
    principal_point_px: float = 0.0

    @staticmethod
    def stated(uncertainty: Mapping[str, Any]) -> LensAccuracy:
        """From a report of intrinsics."""
        return LensAccuracy(*(float(uncertainty.get(f.name) or 0.0) for f in fields(LensAccuracy)))

    def others(self, model: CameraModel) -> list[CameraModel]:
        """Lenses one standard deviation off: in both focal lengths, and in each axis of the principal point."""
        longer = 1 + self.focal_percent / 100
        side_px = self.principal_point_px / np.sqrt(2)
        changes = [np.diag([model.fx, model.fy, 0.0]) * (longer - 1), *(np.zeros((3, 3)) for _ in range(2))]
        changes[1][0, 2] = changes[2][1, 2] = side_px
        return [replace(model, K=model.K + change) for change in changes if change.any()]


@dataclass(frozen=True, eq=False)
class HandEye:
    """`camera_from_mount`: camera_from_base (eye-to-hand) or camera_from_tool (eye-in-hand); `held_from_board`:
    tool_from_board or base_from_board. `covariance` 6x6 of camera_from_mount: (rotation vector in the camera, m)."""

    mounting: Mounting
    camera_from_mount: Float[Array, "4 4"]
    held_from_board: Float[Array, "4 4"]
    covariance: Float[Array, "6 6"]
    report: Report
    residual_px: Float[Array, "n 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    pixels: Float[Array, "n 2"] = field(default_factory=lambda: np.zeros((0, 2)))


def calibrate_hand_eye(
    model: CameraModel,
    views: Sequence[TargetView],
    base_from_tool: Float[Array, "n 4 4"],
    mounting: Mounting,
    arm: ArmAccuracy | None = None,
    lens: LensAccuracy | None = None,
) -> HandEye:
    """From one view of the board per robot pose. Views without the board are left out. The lens is kept as given; how
    far another one within its accuracy would move the camera counts into the covariance.

    Raises BadInput where too few views show it. Too little rotation is a refusal in the report, with the motion that is
    missing.
    """
    arm, lens = arm or ArmAccuracy(), lens or LensAccuracy()
    camera_from_board, used = _board_poses(model, views)
    if len(used) < LEAST_POSES:
        raise BadInput(
            f"the board is seen in {len(used)} of {len(views)} robot poses; wanted at least {LEAST_POSES}, better 20: "
            "`toss-record --calibration hand-eye`"
        )
    moved = base_from_tool[used] if mounting == "eye-to-hand" else inverse_poses(base_from_tool[used])
    missing = missing_motion(moved)
    start = best_start(camera_from_board, moved)
    observations = _Observations(model, [views[k] for k in used], moved, mounting, lens)
    solved = _refine(observations, start, arm)
    hold_out = _hold_out(observations, (solved.camera_from_mount, solved.held_from_board), arm)
    findings = [Finding("refused", text) for text in missing] + _judge(solved, hold_out, len(used))
    mm, deg = _std_mm_deg(solved.covariance)
    report = Report(
        f"hand-eye ({mounting})",
        {"rms_px": solved.rms_px, "robot_deg": solved.robot_deg, "robot_mm": solved.robot_mm, "poses": len(used)},
        hold_out,
        {"position_mm": mm, "direction_deg": deg},
        tuple(findings),
        {"rotation_span_deg": _span_deg(moved), "views_without_board": len(views) - len(used)},
    )
    return HandEye(
        mounting,
        solved.camera_from_mount,
        solved.held_from_board,
        solved.covariance,
        report,
        solved.residual_px,
        np.concatenate([views[k].pixels for k in used]),
    )


def missing_motion(moved: Float[Array, "n 4 4"]) -> list[str]:
    """What rotations the poses lack, in words a person at the rig can act on; nothing when they suffice."""
    span = _span_deg(moved)
    if span < LEAST_TURN_DEG:
        return [
            f"the robot turned by {span:.0f} deg at most between poses, wanted {LEAST_TURN_DEG:.0f} or more (45 is "
            "good): turn the tool about two different axes, for instance roll +-30 deg and pitch +-30 deg"
        ]
    vectors = _relative_rotations(moved)
    values, axes = np.linalg.eigh(vectors.T @ vectors)
    if np.sqrt(values[1] / values[2]) < LEAST_SECOND_AXIS:
        axis = axes[:, 2]
        named = "xyz"[int(np.abs(axis).argmax())]
        others = " or ".join(a for a in "xyz" if a != named)
        return [
            f"the robot turned about one axis only (near its {named}: {np.round(axis, 2).tolist()}), so the camera's "
            f"place along it cannot be found: add poses that turn the tool about its {others} by 30 deg or more"
        ]
    return []


def _relative_rotations(moved: Float[Array, "n 4 4"]) -> Float[Array, "m 3"]:
    first, second = np.triu_indices(len(moved), 1)
    turns = np.swapaxes(moved[first, :3, :3], 1, 2) @ moved[second, :3, :3]
    return Rotation.from_matrix(turns).as_rotvec()


def _span_deg(moved: Float[Array, "n 4 4"]) -> float:
    return float(np.degrees(np.linalg.norm(_relative_rotations(moved), axis=1).max(initial=0.0)))


def _board_poses(model: CameraModel, views: Sequence[TargetView]) -> tuple[Float[Array, "n 4 4"], list[int]]:
    found = {k: board_pose(model, view) for k, view in enumerate(views) if len(view) >= LEAST_POINTS}
    used = [k for k, candidates in found.items() if candidates]
    return np.array([found[k][0] for k in used]).reshape(-1, 4, 4), used


@dataclass(frozen=True, eq=False)
class _Refined:
    camera_from_mount: Float[Array, "4 4"]
    held_from_board: Float[Array, "4 4"]
    covariance: Float[Array, "6 6"]
    residual_px: Float[Array, "n 2"]
    robot_deg: float
    robot_mm: float

    @property
    def rms_px(self) -> float:
        return float(np.sqrt((self.residual_px**2).mean()))


@dataclass(frozen=True, eq=False)
class _Observations:
    """The board's views and the robot's motion, one each per pose."""

    model: CameraModel
    views: Sequence[TargetView]
    moved: Float[Array, "n 4 4"]
    mounting: Mounting
    lens: LensAccuracy

    def some(self, keep: Array) -> _Observations:
        return replace(self, views=[v for v, k in zip(self.views, keep) if k], moved=self.moved[keep])

    def corrected(self, off: Float[Array, "n 6"]) -> Float[Array, "n 4 4"]:
        """The arm errs in its tool's frame, which is on the right of base_from_tool and on the left of its inverse."""
        small = exp_poses(off)
        return self.moved @ small if self.mounting == "eye-to-hand" else small @ self.moved


def _refine(observations: _Observations, start: tuple[Array, Array], arm: ArmAccuracy) -> _Refined:
    """Joint least squares; then again with the arm's accuracy that the first round found, and as long as the poses need
    a worse arm still: a deviation stated from an arm taken for better than it is holds nothing."""
    solved, assumed = _solve(observations, start, arm), arm
    for _ in range(ROUNDS):
        arm = _measured_arm(solved, assumed, len(observations.views))
        solved = _solve(observations, (solved.camera_from_mount, solved.held_from_board), arm)
        worse = _measured_arm(solved, assumed, len(observations.views))
        if worse.turn_deg < CONVERGED_RATIO * arm.turn_deg and worse.shift_m < CONVERGED_RATIO * arm.shift_m:
            break
    return solved


def _measured_arm(solved: _Refined, assumed: ArmAccuracy, poses: int) -> ArmAccuracy:
    """What the arm's corrections come to by axis; a third of what was assumed at least, for few poses agree by luck."""
    spare = np.sqrt(max(0.2, 1.0 - 2.0 / poses))
    turn, shift = solved.robot_deg / np.sqrt(3) / spare, 1e-3 * solved.robot_mm / np.sqrt(3) / spare
    return ArmAccuracy(max(turn, assumed.turn_deg / 3), max(shift, assumed.shift_m / 3))


def _solve(observations: _Observations, start: tuple[Array, Array], arm: ArmAccuracy) -> _Refined:
    """Over X, T and a small correction of every robot pose, weighted by the pixels' and the arm's accuracy."""
    count = len(observations.views)
    owner = np.repeat(np.arange(count), [len(v) for v in observations.views])
    points = np.concatenate([v.points_m for v in observations.views])
    pixels = np.concatenate([v.pixels for v in observations.views])
    white = whitening(np.concatenate([v.covariance_px2 for v in observations.views]))
    sigma = np.array([np.radians(arm.turn_deg)] * 3 + [arm.shift_m] * 3)

    def split(numbers: Array) -> tuple[Array, Array, Array]:
        X = exp_poses(numbers[None, :6])[0] @ start[0]
        return X, exp_poses(numbers[None, 6:12])[0] @ start[1], numbers[12:].reshape(count, 6) * sigma

    def gaps(numbers: Array, model: CameraModel = observations.model) -> Array:
        X, T, off = split(numbers)
        chain = (X[None] @ observations.corrected(off) @ T[None])[owner]
        seen = model.project(np.einsum("nij,nj->ni", chain[:, :3, :3], points) + chain[:, :3, 3])
        return np.where(np.isfinite(seen), seen - pixels, 1e3)

    def residuals(numbers: Array) -> Array:
        return np.concatenate([np.einsum("nij,nj->ni", white, gaps(numbers)).ravel(), numbers[12:]])

    def expanded(numbers: Array) -> _Linear:
        plain = residuals(numbers)
        weight = np.sqrt(huber_weight(np.abs(plain), HUBER))
        J, left = weight[:, None] * _jacobian(residuals, numbers, plain, owner), weight * plain
        return _Linear(float(huber_cost(np.abs(plain), HUBER).sum()), J.T @ J, J.T @ left, J, left, weight)

    found = minimised(np.zeros(12 + 6 * count), expanded, np.add, STEPS, LEAST_GAIN)
    numbers, J, left, weight = found.state, found.at.jacobian, found.at.residuals, found.at.weight
    X, T, off = split(numbers)
    scale = max(1.0, float(left @ left) / max(1, len(left) - len(numbers)))
    inverse = np.linalg.pinv(J.T @ J, hermitian=True)
    covariance = scale * inverse[:6, :6]
    for other in observations.lens.others(observations.model):
        change = np.einsum("nij,nj->ni", white, gaps(numbers, other) - gaps(numbers)).ravel()
        moved = -(inverse @ J.T @ (weight * np.append(change, np.zeros(6 * count))))[:6]
        covariance += np.outer(moved, moved)
    turns, shifts = np.linalg.norm(off[:, :3], axis=1), np.linalg.norm(off[:, 3:], axis=1)
    robot_deg, robot_mm = (float(np.sqrt((v**2).mean())) for v in (np.degrees(turns), 1e3 * shifts))
    return _Refined(X, T, covariance, -gaps(numbers), robot_deg, robot_mm)


@dataclass(frozen=True, eq=False)
class _Linear(Expansion):
    """With the weighted derivatives and residuals that it is made of, and the roots of Huber's weights."""

    jacobian: Float[Array, "n u"]
    residuals: Float[Array, " n"]
    weight: Float[Array, " n"]


def _jacobian(residuals: Callable[[Array], Array], at: Array, here: Array, owner: Array) -> Array:
    """By differences. A pose's own numbers move only its own residuals, so all poses are moved at once."""
    rows = np.repeat(owner, 2)
    count = (len(at) - 12) // 6
    out = np.zeros((len(here), len(at)))
    for k in range(12):
        out[:, k] = (residuals(at + DIFFERENCE * np.eye(len(at))[k]) - here) / DIFFERENCE
    for k in range(6):
        ahead = at.copy()
        ahead[12 + k :: 6] += POSE_DIFFERENCE
        change = (residuals(ahead) - here) / POSE_DIFFERENCE
        out[np.arange(len(rows)), 12 + k + 6 * rows] = change[: len(rows)]
        own = np.arange(count) * 6 + k
        out[len(rows) + own, 12 + own] = change[len(rows) + own]
    return out


def _hold_out(observations: _Observations, start: tuple[Array, Array], arm: ArmAccuracy) -> dict[str, float]:
    """Each quarter of the poses kept aside once: their boards, predicted by the arm alone, against where they are."""
    gaps_px, turns, shifts = [], [], []
    for fold in range(FOLDS):
        aside = np.arange(len(observations.views)) % FOLDS == fold
        if (~aside).sum() < LEAST_POSES - 1 or not aside.any():
            continue
        solved = _solve(observations.some(~aside), start, arm)
        for view, moved in zip(observations.some(aside).views, observations.moved[aside]):
            predicted = solved.camera_from_mount @ moved @ solved.held_from_board
            points = view.points_m @ predicted[:3, :3].T + predicted[:3, 3]
            gaps_px.append(observations.model.project(points) - view.pixels)
            seen = board_pose(observations.model, view)[0]
            off = inverse_poses(predicted) @ seen
            turns.append(angle_deg(off[:3, :3]))
            shifts.append(1e3 * float(np.linalg.norm(predicted[:3, 3] - seen[:3, 3])))
    if not gaps_px:
        return {"rms_px": float("nan"), "median_mm": float("nan"), "median_deg": float("nan")}
    rms = float(np.sqrt(np.nanmean(np.concatenate(gaps_px) ** 2)))
    return {"rms_px": rms, "median_mm": float(np.median(shifts)), "median_deg": float(np.median(turns))}


def _std_mm_deg(covariance: Float[Array, "6 6"]) -> tuple[float, float]:
    """Standard deviations in mm and deg, as lengths."""
    variance = np.diag(covariance)
    return 1e3 * float(np.sqrt(variance[3:].sum())), float(np.degrees(np.sqrt(variance[:3].sum())))


def _judge(solved: _Refined, hold_out: dict[str, float], poses: int) -> list[Finding]:
    mm, deg = _std_mm_deg(solved.covariance)
    found = limit(solved.rms_px, "the residual", "px", GOOD_PX, WORST_PX)
    found += limit(mm, "the standard deviation of the camera's position", "mm", GOOD_MM, WORST_MM)
    found += limit(deg, "the standard deviation of the camera's direction", "deg", GOOD_DEG, WORST_DEG)
    found += limit(hold_out["median_mm"], "the board's error in poses kept aside", "mm", GOOD_MM, 2 * WORST_MM)
    found += limit(hold_out["median_deg"], "the board's turn in poses kept aside", "deg", GOOD_DEG, 2 * WORST_DEG)
    if poses < GOOD_POSES:
        found.append(Finding("warning", f"{poses} poses, wanted {GOOD_POSES} or more"))
    return found
