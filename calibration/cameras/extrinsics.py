"""Where the cameras stand to one another: one bundle adjustment over all views of a board of known layout.

placed = calibrate_cameras(models, views, reference="d455")
placed.transforms            # d455_from_mono0, ...
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from calibration.cameras.bundle import Observations, Scene, Solved, adjust
from calibration.cameras.lens_prior import still_numbers
from calibration.cameras.pnp import connected, poses_of_points
from calibration.cameras.poses import angle_deg, inverse_poses
from calibration.cameras.targets import TargetView, numbered_marks
from calibration.report import Finding, Report, limit
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
AS_GOOD = 1.02
"""Given lenses are kept unless their hold-out error is this many times that of freed ones."""
UNDETERMINED = 1e-9
BOARD, TABLE = 0, 1
TABLE_PX = 0.8
BOARD_SCALE = 0.003
GOOD_PRINT_MM, WORST_PRINT_MM = 0.4, 1.5
PRINT_M = 1.5e-4
"""A printed mark lies where it should be within this (standard deviation by axis): printer, paper, plate."""
STEADY_PX = 0.05
"""A camera's image of one view is off as a whole by as much: nobody holds a board quite still while cameras expose."""


@dataclass(frozen=True, eq=False)
class PlacedCameras:
    """`transforms`: reference_from_camera of every other camera. `residual_px` by camera: (n, 2) where seen minus
    predicted, `pixels` by camera: where. `body_from_views` what else was solved: reference_from_body per view."""

    reference: str
    transforms: tuple[Transform, ...]
    models: Mapping[str, CameraModel]
    report: Report
    residual_px: Mapping[str, Float[Array, "n 2"]]
    pixels: Mapping[str, Float[Array, "n 2"]]
    reference_from_body: Mapping[int, Float[Array, "4 4"]] = field(default_factory=dict)


def calibrate_cameras(
    models: Mapping[str, CameraModel],
    views: Mapping[str, Sequence[TargetView]],
    reference: str,
    table: Mapping[str, Sequence[TargetView]] | None = None,
    lenses_free: bool = False,
    freed: Sequence[str] = (),
) -> PlacedCameras:
    """Extrinsics of all cameras from simultaneous views of one rigid board: `views[camera][k]` are of one instant.

    `table`: what the same images show of tags fixed to the table (points in the world). They span more than a board
    does, so they give the scale, and the board's own is found: a printer is off by a part in a thousand easily. Tags
    that do not lie where they are said to are left out, and the report says so. `lenses_free`: the lenses are solved
    with the places, and taken where they explain views kept aside better than the given ones do; `freed`: those of
    these cameras are, on the board as it is laid out (a bent board moves focal lengths otherwise), and are taken in any
    case. `models` of the result holds them.
    Raises BadInput where the geometry does not connect the cameras, naming those that are cut off.
    """
    names = [reference, *sorted(n for n in models if n != reference)]
    setup = _Setup(names, models, views, _still(names, table))
    findings, setup = _table_or_not(setup)
    solved, seen, dropped = _without_bad_views(setup.start, setup.observations(setup.start))
    hold_out = _hold_out(setup, solved)
    if lenses_free or freed:
        free = np.isin(names, freed) if freed else np.ones(len(names), dtype=bool)
        start = replace(solved.scene, free_lenses=free, still_numbers=tuple(map(still_numbers, solved.scene.models)))
        if freed:
            start = replace(start, shift_m=np.zeros_like(start.shift_m), print_m=None)
        without = adjust(start, seen)
        hold_out_without = _hold_out(setup, without)
        given_px, freed_px = hold_out["rms_px"], hold_out_without["rms_px"]
        if freed or given_px > AS_GOOD * freed_px:
            solved, hold_out = without, hold_out_without
        else:
            text = f"the given lenses explain views kept aside as well ({given_px:.4f} px) as freed ones"
            findings.append(Finding("note", f"{text} ({freed_px:.4f} px): kept"))
    findings += _judge(names, solved, seen)
    if dropped:
        named = [f"{setup.names[k]} {'the table' if view == setup.count else f'view {view}'}" for k, view in dropped]
        findings.append(Finding("note", f"left out for their residuals: {', '.join(named)}"))
    findings += limit(hold_out["rms_px"], "the residual on views kept aside", "px", GOOD_PX, WORST_PX)
    figures = per_camera(names, solved, seen)
    report = Report(
        "cameras",
        {"rms_px": solved.rms_px, "rms_px_by_camera": {n: f["rms_px"] for n, f in figures.items()}},
        hold_out,
        _uncertainty(names, solved),
        tuple(findings),
        {
            "views": {n: f["views"] for n, f in figures.items()},
            "points": len(seen),
            "board_scale": _printed_scale(solved, seen) if solved.scene.free_scales[BOARD] else None,
        },
    )
    return PlacedCameras(
        reference,
        _transforms(names, solved),
        dict(zip(names, solved.scene.models)),
        report,
        {n: solved.residual_px[seen.camera == k] for k, n in enumerate(names)},
        {n: seen.pixels[seen.camera == k] for k, n in enumerate(names)},
        {v: solved.scene.rig_from_body[v] for v in np.unique(seen.view[seen.piece == BOARD]).tolist()},
    )


def whitening(covariance_px2: Float[Array, "n 2 2"]) -> Float[Array, "n 2 2"]:
    """W with W^T W = inverse covariance."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance_px2)), -1, -2)


@dataclass(frozen=True, eq=False)
class _Setup:
    """Everything that is given; the table, where it is used, is one more view (the last) of one more piece."""

    names: Sequence[str]
    models: Mapping[str, CameraModel]
    views: Mapping[str, Sequence[TargetView]]
    still: Mapping[str, TargetView]

    @property
    def count(self) -> int:
        return max(len(v) for v in self.views.values())

    @cached_property
    def start(self) -> Scene:
        poses = {n: [board_pose(self.models[n], view) for view in self.views[n]] for n in self.names}
        camera_from_rig = connected(self.names, poses)
        rig_from_body = np.tile(np.eye(4), (self.count + 1, 1, 1))
        known = np.zeros(self.count + 1, dtype=bool)
        instants = [*({n: (self.views[n][v], poses[n][v]) for n in self.names} for v in range(self.count))]
        instants.append({n: (v, board_pose(self.models[n], v)) for n, v in self.still.items()})
        for view, seen_by in enumerate(instants):
            usable = [(len(seen), n, candidates) for n, (seen, candidates) in seen_by.items() if candidates]
            if usable:
                _, n, candidates = max(usable, key=lambda s: s[0])
                rig_from_body[view] = inverse_poses(camera_from_rig[self.names.index(n)]) @ candidates[0]
                known[view] = True
        cameras, pieces = len(self.names), np.zeros(2, dtype=bool)
        _, marks = numbered_marks([(piece, view) for _, _, piece, view in self.parts])
        return Scene(
            tuple(self.models[n] for n in self.names),
            camera_from_rig,
            rig_from_body,
            np.tile(np.eye(4), (2, 1, 1)),
            np.arange(cameras) > 0,
            known,
            pieces,
            np.zeros(cameras, dtype=bool),
            np.ones(2),
            np.array([bool(self.still), False]),
            np.zeros((marks, 3)),
            PRINT_M,
            np.zeros((len(self.parts), 2)),
            STEADY_PX,
        )

    @cached_property
    def parts(self) -> list[tuple[int, int, int, TargetView]]:
        """Every image in which enough is seen: camera, view, piece, what."""
        parts = [
            (k, number, BOARD, view)
            for k, n in enumerate(self.names)
            for number, view in enumerate(self.views[n])
            if len(view) >= LEAST_POINTS
        ]
        return parts + [(self.names.index(n), self.count, TABLE, view) for n, view in self.still.items()]

    def observations(self, scene: Scene) -> Observations:
        marks, _ = numbered_marks([(piece, view) for _, _, piece, view in self.parts])
        used = [i for i, (_, number, piece, _) in enumerate(self.parts) if piece == TABLE or scene.free_views[number]]
        parts = [self.parts[i] for i in used]
        counts = [len(view) for *_, view in parts]
        return Observations(
            np.repeat([p[0] for p in parts], counts).astype(np.int64),
            np.repeat([p[1] for p in parts], counts).astype(np.int64),
            np.repeat([p[2] for p in parts], counts).astype(np.int64),
            np.concatenate([view.points_m for *_, view in parts]),
            np.concatenate([view.pixels for *_, view in parts]),
            whitening(np.concatenate([view.covariance_px2 for *_, view in parts])),
            np.concatenate([marks[i] for i in used]),
            np.repeat(used, counts).astype(np.int64),
        )


def still_view(instants: Sequence[TargetView]) -> TargetView | None:
    """What all images of a camera show of something that stands still, as one view: each point's median place, as sure
    as in one image (the same pixels err alike in every image). None where nothing is seen in half of them."""
    instants = [view for view in instants if len(view)]
    if not instants:
        return None
    ids = np.concatenate([v.ids for v in instants])
    points, pixels, covariance = (
        np.concatenate([getattr(v, part) for v in instants]) for part in ("points_m", "pixels", "covariance_px2")
    )
    known = [i for i in np.unique(ids).tolist() if (ids == i).sum() >= 0.5 * len(instants)]
    if not known:
        return None
    rows = [ids == i for i in known]
    return TargetView(
        np.array(known),
        np.array([points[r][0] for r in rows]),
        np.array([np.median(pixels[r], axis=0) for r in rows]),
        np.array([covariance[r].mean(axis=0) for r in rows]),
    )


def _still(names: Sequence[str], table: Mapping[str, Sequence[TargetView]] | None) -> dict[str, TargetView]:
    found = {name: still_view(table.get(name, ())) for name in names} if table else {}
    return {name: view for name, view in found.items() if view is not None}


def _table_or_not(setup: _Setup) -> tuple[list[Finding], _Setup]:
    """Whether the table's tags lie where they are said to: otherwise they are not used, and that is said."""
    without = replace(setup, still={})
    if len(setup.still) < 2 or not setup.start.free_views[setup.count]:
        return [], without
    seen = setup.observations(setup.start)
    solved = adjust(setup.start, seen)
    on_table = seen.piece == TABLE
    rms = float(np.sqrt((solved.residual_px[on_table] ** 2).mean()))
    if rms > TABLE_PX:
        text = (
            f"the table's tags do not lie where they are said to (residual {rms:.2f} px, wanted {TABLE_PX:g}): not used"
        )
        return [Finding("warning", f"{text}; measure their places, or run `toss-calibrate table`")], without
    scale = _printed_scale(solved, seen)
    if abs(scale - 1) > BOARD_SCALE:
        text = f"the board is {100 * scale:.2f} % of the size it is said to be, by the table's tags"
        return [Finding("warning", f"{text}; measure its tags and correct size_m")], setup
    return [], setup


def _printed_scale(solved: Solved, seen: Observations) -> float:
    """Size of the board as it is, marks shifted as they are, to the size it is said to be."""
    on_board = seen.piece == BOARD
    assert seen.mark is not None
    said_m = seen.points_m[on_board]
    true_m = solved.scene.scale[BOARD] * said_m + solved.scene.shift_m[seen.mark[on_board]]
    return float(np.sqrt((true_m.var(axis=0)).sum() / said_m.var(axis=0).sum()))


def board_pose(model: CameraModel, view: TargetView) -> list[Float[Array, "4 4"]]:
    """camera_from_board; of the two poses of a flat board the second only where it explains the view about as well."""
    if len(view) < LEAST_POINTS:
        return []
    found = poses_of_points(model, view.points_m, view.pixels)
    return [pose for pose, error in found if error < 1.5 * found[0][1] + 0.05]


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
        rms = np.array([np.sqrt((solved.residual_px[mine & (seen.view == v)] ** 2).mean()) for v in numbers.tolist()])
        usual = max(float(np.median(rms)), 0.05)
        bad += [(camera, v) for v, r in zip(numbers.tolist(), rms) if r > OUTLIER_VIEW * usual]
    return bad


def per_camera(names: Sequence[str], solved: Solved, seen: Observations) -> dict[str, dict[str, float]]:
    out = {}
    for k, name in enumerate(names):
        mine = seen.camera == k
        rms = float(np.sqrt((solved.residual_px[mine] ** 2).mean())) if mine.any() else float("nan")
        out[name] = {"rms_px": rms, "views": len(np.unique(seen.view[mine]))}
    return out


def _judge(names: Sequence[str], solved: Solved, seen: Observations) -> list[Finding]:
    findings: list[Finding] = judge_print(solved)
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


def judge_print(solved: Solved) -> list[Finding]:
    """Whether the board is laid out as it is said to be: a wrong size of its tags shows as marks out of place."""
    shift_mm = 1e3 * float(np.sqrt((solved.scene.shift_m**2).sum(axis=1).mean())) if len(solved.scene.shift_m) else 0.0
    what = "the distance of the board's marks from where its layout in session.json (sizes, pitch) has them"
    return limit(shift_mm, what, "mm", GOOD_PRINT_MM, WORST_PRINT_MM)


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


def _hold_out(setup: _Setup, full: Solved) -> dict[str, float]:
    """Each quarter of the views is kept aside once: cameras from the others, then only the board's pose from its own
    views. Also how far the cameras move without a quarter."""
    numbers = np.arange(setup.count + 1)
    gaps, moves_mm, turns_deg = [], [], []
    for fold in range(min(FOLDS, setup.count)):
        aside = (numbers % FOLDS == fold) & (numbers < setup.count)
        rest = _solved_on(setup, full, ~aside)
        if rest is None:
            continue
        moved = inverse_poses(rest.scene.camera_from_rig) @ full.scene.camera_from_rig
        moves_mm += [1e3 * float(np.linalg.norm(m[:3, 3])) for m in moved[1:]]
        turns_deg += [angle_deg(m[:3, :3]) for m in moved[1:]]
        fixed = np.zeros(len(setup.names), dtype=bool)
        scene = replace(
            rest.scene, free_cameras=fixed, free_lenses=fixed, free_scales=np.zeros(2, dtype=bool), print_m=None
        )
        kept = replace(scene, free_views=full.scene.free_views & aside)
        seen = replace(setup, still={}).observations(kept)
        if len(seen):
            gaps.append(adjust(replace(kept, free_views=np.isin(numbers, seen.view)), seen).residual_px)
    rms = float(np.sqrt((np.concatenate(gaps) ** 2).mean())) if gaps else float("nan")
    return {
        "rms_px": rms,
        "cameras_move_mm": max(moves_mm, default=float("nan")),
        "cameras_turn_deg": max(turns_deg, default=float("nan")),
    }


def _solved_on(setup: _Setup, full: Solved, keep: Bool[Array, " v"]) -> Solved | None:
    """The cameras from some of the views; None where one of them then sees nothing."""
    scene = replace(full.scene, free_views=full.scene.free_views & keep)
    if not scene.free_views[: setup.count].any():
        return None
    seen = setup.observations(scene)
    if len(np.unique(seen.camera)) < len(setup.names):
        return None
    return adjust(replace(scene, free_views=np.isin(np.arange(len(keep)), seen.view)), seen)
