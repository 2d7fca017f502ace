"""Where the cameras stand to one another: one bundle adjustment over all views of a board of known layout.

    placed = calibrate_cameras(models, views, reference="d455")
    placed.transforms            # d455_from_mono0, ...
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from calibration.bundle import Observations, Scene, Solved, adjust
from calibration.pnp import most_agreed, poses_of_points
from calibration.poses import angle_deg, inverse_poses
from calibration.report import Finding, Report, limit
from calibration.targets import TargetView
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform

LEAST_POINTS = 8
"""Fewer points of a board in one image do not count as a sight of it."""
LEAST_VIEWS = 3
GOOD_PX, WORST_PX = 0.5, 1.5
GOOD_MM, WORST_MM = 1.0, 5.0
GOOD_DEG, WORST_DEG = 0.1, 0.5
OUTLIER_VIEW = 3.0
"""A camera's view whose rms is this many times its camera's median is left out."""
FOLDS = 4
UNDETERMINED = 1e-9


@dataclass(frozen=True, eq=False)
class PlacedCameras:
    """`transforms`: reference_from_camera of every other camera. `residual_px` by camera: (n, 2) where seen minus
    predicted, `pixels` by camera: where. `body_from_views` what else was solved: reference_from_body per view."""

    reference: str
    transforms: tuple[Transform, ...]
    report: Report
    residual_px: Mapping[str, Float[Array, "n 2"]]
    pixels: Mapping[str, Float[Array, "n 2"]]
    reference_from_body: Mapping[int, Float[Array, "4 4"]] = field(default_factory=dict)


def calibrate_cameras(
    models: Mapping[str, CameraModel], views: Mapping[str, Sequence[TargetView]], reference: str
) -> PlacedCameras:
    """Extrinsics of all cameras from simultaneous views of one rigid board: `views[camera][k]` are of one instant.

    Raises BadInput where the geometry does not connect the cameras, naming those that are cut off.
    """
    names = [reference, *sorted(n for n in models if n != reference)]
    started = _start(names, models, views)
    solved, seen, dropped = _without_bad_views(started, _observations(names, views, started))
    findings = _judge(names, solved, seen)
    if dropped:
        findings.append(Finding("note", f"left out for their residuals: {', '.join(_named(names, dropped))}"))
    hold_out = _hold_out(names, models, views, solved)
    findings += limit(hold_out["rms_px"], "the residual on views kept aside", "px", GOOD_PX, WORST_PX)
    figures = per_camera(names, solved, seen)
    report = Report(
        "cameras",
        {"rms_px": solved.rms_px, "rms_px_by_camera": {n: f["rms_px"] for n, f in figures.items()}},
        hold_out,
        _uncertainty(names, solved),
        tuple(findings),
        {"views": {n: f["views"] for n, f in figures.items()}, "points": len(seen)},
    )
    return PlacedCameras(
        reference,
        _transforms(names, solved),
        report,
        {n: solved.residual_px[seen.camera == k] for k, n in enumerate(names)},
        {n: seen.pixels[seen.camera == k] for k, n in enumerate(names)},
        {v: solved.scene.rig_from_body[v] for v in np.unique(seen.view).tolist()},
    )


def whitening(covariance_px2: Float[Array, "n 2 2"]) -> Float[Array, "n 2 2"]:
    """W with W^T W = inverse covariance."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance_px2)), -1, -2)


def _start(names: Sequence[str], models: Mapping[str, CameraModel], views: Mapping[str, Sequence[TargetView]]) -> Scene:
    poses = {n: [board_pose(models[n], view) for view in views[n]] for n in names}
    camera_from_rig = connected(names, poses)
    count = max(len(v) for v in views.values())
    rig_from_body, known = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, dtype=bool)
    for view in range(count):
        sights = [(len(views[n][view]), k, poses[n][view]) for k, n in enumerate(names) if view < len(poses[n])]
        sights = [s for s in sights if s[2]]
        if sights:
            _, k, candidates = max(sights, key=lambda s: s[0])
            rig_from_body[view], known[view] = inverse_poses(camera_from_rig[k]) @ candidates[0], True
    free = np.arange(len(names)) > 0
    lenses = np.zeros(len(names), dtype=bool)
    return Scene(
        tuple(models[n] for n in names),
        camera_from_rig,
        rig_from_body,
        np.eye(4)[None],
        free,
        known,
        np.zeros(1, dtype=bool),
        lenses,
    )


def board_pose(model: CameraModel, view: TargetView) -> list[Float[Array, "4 4"]]:
    """camera_from_board; of the two poses of a flat board the second only where it explains the view about as well."""
    if len(view) < LEAST_POINTS:
        return []
    found = poses_of_points(model, view.points_m, view.pixels)
    return [pose for pose, error in found if error < 1.5 * found[0][1] + 0.05]


def connected(
    names: Sequence[str], poses: Mapping[str, Sequence[Sequence[Float[Array, "4 4"]]]]
) -> Float[Array, "c 4 4"]:
    """camera_from_rig, the rig being the first camera, by chaining relative poses that many views agree on.

    Raises BadInput naming the cameras that share too few views with the others.
    """
    found = {names[0]: np.eye(4)}
    while len(found) < len(names):
        best: tuple[int, str, Array] | None = None
        for here, there in ((a, b) for a in found for b in names if b not in found):
            looks = [
                [there_pose @ inverse_poses(here_pose) for there_pose in q for here_pose in p]
                for p, q in zip(poses[here], poses[there])
            ]
            agreed = most_agreed([look for look in looks if look], 5.0, 0.05)
            if agreed is not None and (best is None or agreed[1] > best[0]):
                best = (agreed[1], there, agreed[0] @ found[here])
        if best is None or best[0] < min(2, LEAST_VIEWS):
            cut = [n for n in names if n not in found]
            raise BadInput(
                f"degenerate geometry: {', '.join(cut)} shares no views of the board with {', '.join(found)}, so its "
                "place is undetermined; record views in which both see the board: `toss-record --calibration board`"
            )
        found[best[1]] = best[2]
    return np.array([found[n] for n in names])


def _observations(names: Sequence[str], views: Mapping[str, Sequence[TargetView]], scene: Scene) -> Observations:
    parts = [
        (k, number, view)
        for k, n in enumerate(names)
        for number, view in enumerate(views[n])
        if len(view) >= LEAST_POINTS and scene.free_views[number]
    ]
    counts = [len(view) for _, _, view in parts]
    return Observations(
        np.repeat([k for k, _, _ in parts], counts),
        np.repeat([number for _, number, _ in parts], counts),
        np.zeros(sum(counts), dtype=np.int64),
        np.concatenate([view.points_m for _, _, view in parts]),
        np.concatenate([view.pixels for _, _, view in parts]),
        whitening(np.concatenate([view.covariance_px2 for _, _, view in parts])),
    )


def _without_bad_views(scene: Scene, seen: Observations) -> tuple[Solved, Observations, list[tuple[int, int]]]:
    """Solve, leave out a camera's views that do not fit, solve again."""
    solved = adjust(scene, seen)
    bad = bad_views(solved, seen)
    if not bad:
        return solved, seen, []
    drop = np.zeros(len(seen), dtype=bool)
    for camera, view in bad:
        drop |= (seen.camera == camera) & (seen.view == view)
    kept = seen.chosen(~drop)
    scene = replace(solved.scene, free_views=np.isin(np.arange(len(scene.free_views)), kept.view))
    return adjust(scene, kept), kept, bad


def bad_views(solved: Solved, seen: Observations) -> list[tuple[int, int]]:
    """(camera, view) whose rms is far above its camera's usual one."""
    bad = []
    for camera in np.unique(seen.camera).tolist():
        mine = seen.camera == camera
        numbers = np.unique(seen.view[mine])
        rms = np.array(
            [np.sqrt((solved.residual_px[mine & (seen.view == v)] ** 2).mean()) for v in numbers.tolist()]
        )
        usual = max(float(np.median(rms)), 0.05)
        bad += [(camera, v) for v, r in zip(numbers.tolist(), rms) if r > OUTLIER_VIEW * usual]
    return bad


def _named(names: Sequence[str], bad: Sequence[tuple[int, int]]) -> list[str]:
    return [f"{names[camera]} view {view}" for camera, view in bad]


def per_camera(names: Sequence[str], solved: Solved, seen: Observations) -> dict[str, dict[str, float]]:
    out = {}
    for k, name in enumerate(names):
        mine = seen.camera == k
        rms = float(np.sqrt((solved.residual_px[mine] ** 2).mean())) if mine.any() else float("nan")
        out[name] = {"rms_px": rms, "views": len(np.unique(seen.view[mine]))}
    return out


def _judge(names: Sequence[str], solved: Solved, seen: Observations) -> list[Finding]:
    findings: list[Finding] = []
    for name, figures in per_camera(names, solved, seen).items():
        findings += limit(figures["rms_px"], f"{name}'s residual", "px", GOOD_PX, WORST_PX)
        if figures["views"] < LEAST_VIEWS:
            findings.append(Finding("warning", f"{name} sees the board in {figures['views']:.0f} views only, wanted 3"))
    if solved.weakest < UNDETERMINED:
        kind, number = solved.weakest_block
        what = names[number] if kind == "camera" else f"the board in view {number}"
        findings.append(Finding("refused", f"degenerate geometry: {what} is undetermined"))
    for k, name in enumerate(names[1:], 1):
        mm, deg = spread(solved, k)
        findings += limit(mm, f"the standard deviation of {name}'s position", "mm", GOOD_MM, WORST_MM)
        findings += limit(deg, f"the standard deviation of {name}'s direction", "deg", GOOD_DEG, WORST_DEG)
    return findings


def spread(solved: Solved, camera: int) -> tuple[float, float]:
    """Standard deviations of a camera's position in mm and its direction in deg, both as lengths.

    The increment (w, t) of camera_from_rig moves the camera's centre by -R^T t.
    """
    std = solved.std("camera", camera)
    return 1e3 * float(np.linalg.norm(std[3:])), float(np.degrees(np.linalg.norm(std[:3])))


def _uncertainty(names: Sequence[str], solved: Solved) -> dict[str, dict[str, float]]:
    out = {}
    for k, name in enumerate(names[1:], 1):
        mm, deg = spread(solved, k)
        out[name] = {"position_mm": mm, "direction_deg": deg}
    return out


def _transforms(names: Sequence[str], solved: Solved) -> tuple[Transform, ...]:
    return tuple(
        Transform.from_matrix(names[0], name, inverse_poses(solved.scene.camera_from_rig[k]))
        for k, name in enumerate(names)
        if k > 0
    )


def _hold_out(
    names: Sequence[str], models: Mapping[str, CameraModel], views: Mapping[str, Sequence[TargetView]], full: Solved
) -> dict[str, float]:
    """Each quarter of the views is kept aside once: cameras from the others, then only the board's pose from its own
    views. Also how far the cameras move without a quarter."""
    count = len(full.scene.free_views)
    gaps, moves_mm, turns_deg = [], [], []
    for fold in range(min(FOLDS, count)):
        aside = np.arange(count) % FOLDS == fold
        try:
            rest = _solved_on(names, models, views, full, ~aside)
        except BadInput:
            continue
        moved = inverse_poses(rest.scene.camera_from_rig) @ full.scene.camera_from_rig
        moves_mm += [1e3 * float(np.linalg.norm(m[:3, 3])) for m in moved[1:]]
        turns_deg += [angle_deg(m[:3, :3]) for m in moved[1:]]
        scene = replace(full.scene, camera_from_rig=rest.scene.camera_from_rig, free_cameras=np.zeros(len(names), bool))
        seen = _observations(names, views, replace(scene, free_views=full.scene.free_views & aside))
        if len(seen):
            kept = replace(scene, free_views=np.isin(np.arange(count), seen.view))
            gaps.append(adjust(kept, seen).residual_px)
    rms = float(np.sqrt((np.concatenate(gaps) ** 2).mean())) if gaps else float("nan")
    return {
        "rms_px": rms,
        "cameras_move_mm": max(moves_mm, default=float("nan")),
        "cameras_turn_deg": max(turns_deg, default=float("nan")),
    }


def _solved_on(
    names: Sequence[str],
    models: Mapping[str, CameraModel],
    views: Mapping[str, Sequence[TargetView]],
    full: Solved,
    keep: Bool[Array, " v"],
) -> Solved:
    scene = replace(full.scene, free_views=full.scene.free_views & keep)
    seen = _observations(names, views, scene)
    if len(np.unique(seen.camera)) < len(names):
        raise BadInput("a camera has no views left")
    return adjust(replace(scene, free_views=np.isin(np.arange(len(keep)), seen.view)), seen)
