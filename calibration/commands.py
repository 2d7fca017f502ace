"""What `toss-calibrate intrinsics | cameras | hand-eye` do: read the session, solve, judge, draw, write."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from calibration import store
from calibration.cameras.extrinsics import PlacedCameras, calibrate_cameras
from calibration.cameras.intrinsics import Lens, as_good_alone, calibrate_intrinsics
from calibration.cameras.targets import Tags, TargetView
from calibration.done import TOOL, Done, done
from calibration.drift import bumps
from calibration.hand_eye import LensAccuracy, calibrate_hand_eye
from calibration.pictures import residual_picture
from calibration.report import Finding, undetected
from calibration.tags.faults import explain_absence
from calibration.views import (
    COLOR,
    TOGETHER_NS,
    VIEWS_FILE,
    BoardViews,
    board_of,
    grey_images,
    read_board_views,
    table_target,
)
from recordings.bounded.documents import as_dict
from recordings.errors import BadInput
from recordings.geometry import DistortionModel, Transform
from recordings.progress import Progress
from recordings.robot.arm import ArmPath, panda
from recordings.session import Session, Toss

DEPTH_SIZE_OFF, DEPTH_SIZE_WRONG = 0.02, 0.05
LENSES: tuple[DistortionModel, ...] = ("none", "brown-conrady", "rational")


def intrinsics(path: Path, args: argparse.Namespace, progress: Progress) -> Done:
    with Session.open(path) as session:
        views = _board_views(session, progress)
        wanted = args.camera or sorted(views.board)
        unknown = sorted(set(wanted) - set(views.board))
        if unknown:
            raise BadInput(f"no views of {', '.join(unknown)}; {VIEWS_FILE} has {', '.join(sorted(views.board))}")
        lenses: dict[str, Lens] = {}
        for name in wanted:
            given = session.calibration.cameras.get(name)
            lenses[name] = calibrate_intrinsics(
                name, views.sizes[name], views.board[name], args.lens or LENSES, given, args.anew or bool(args.lens)
            )
        lenses |= _solved_together(session, views, lenses)
        dead = undetected(views.lost)
        lenses = {n: replace(lens, report=lens.report.with_findings(dead)) for n, lens in lenses.items()}
        reports = [replace(lens.report, kind=f"intrinsics of {name}") for name, lens in lenses.items()]
        picture = _picture(session, "intrinsics", views, lenses)
        if args.dry_run or any(r.verdict == "refused" for r in reports):
            return done(reports, None, [picture], not args.dry_run)
        calibration = store.updated(session.calibration, cameras={n: lens.model for n, lens in lenses.items()})
        known = dict(calibration.residuals.get("intrinsics", {}))
        entries = {**known, **{n: lens.report.to_json() for n, lens in lenses.items()}}
        written = store.write_entry(session, calibration, "intrinsics", entries)
        return done(reports, written, [picture], True)


def _solved_together(session: Session, views: BoardViews, lenses: Mapping[str, Lens]) -> dict[str, Lens]:
    """Lenses that were fitted, solved once more with what the other cameras saw of the same board at the same instants:
    a single camera hardly tells focal length from distance, several that see one board do."""
    models = {n: lenses[n].model if n in lenses else session.calibration.cameras.get(n) for n in views.board}
    known = {n: m for n, m in models.items() if m is not None}
    fitted = [n for n, lens in lenses.items() if lens.report.details["lens"] != "given"]
    if not fitted or len(known) < 2:
        return {}
    reference = COLOR if COLOR in known else sorted(known)[0]
    still = views.table if table_target(session.calibration) else None
    try:
        placed = calibrate_cameras(known, {n: views.board[n] for n in known}, reference, still, freed=fitted)
    except BadInput:
        return {}  # cameras that share no views: each has its own answer
    return {n: _together_with(lenses[n], placed, n, views.board[n]) for n in fitted}


def _together_with(lens: Lens, placed: PlacedCameras, name: str, views: Sequence[TargetView]) -> Lens:
    """The lens of all cameras' views, where it explains this camera's own as well as its own lens does."""
    change = 100 * (placed.models[name].fx / lens.model.fx - 1)
    taken = as_good_alone(lens, placed.models[name], views)
    text = f"{name}: solved with all cameras' views together, which moved the focal length {change:+.2f} %"
    if not taken:
        text = f"{name}: solved with all cameras' views together, its own views would be explained worse: not taken"
    report = lens.report.with_findings([Finding("note", text)])
    return replace(lens, model=placed.models[name] if taken else lens.model, report=report)


def _picture(session: Session, kind: str, views: BoardViews, solved: Mapping[str, Lens]) -> Path:
    return residual_picture(
        store.work_folder(session) / f"{kind}.png",
        f"{session.name}: {kind}",
        {n: views.sizes[n] for n in solved},
        {n: lens.pixels for n, lens in solved.items()},
        {n: lens.residual_px for n, lens in solved.items()},
    )


def _board_views(session: Session, progress: Progress) -> BoardViews:
    """Raises BadInput where nobody sees the board, saying why as far as the pictures tell."""
    views = read_board_views(session, store.work_folder(session), progress)
    if views.seen_at_all:
        return views
    with Toss(session.path / VIEWS_FILE) as toss:
        images = [grey_images(toss, camera)[1] for camera in toss.cameras()]
        board = board_of(session)
        family = board.family if isinstance(board, Tags) else session.calibration.tag_family
        why = explain_absence([image for stack in images for image in stack], family)
    raise BadInput(
        f"{session.path / VIEWS_FILE}: the board is in none of the views: {why}. Look at them with "
        f"`toss-view {session.path / VIEWS_FILE}`; the board is described in session.json under `board`"
    )


def cameras(path: Path, args: argparse.Namespace, progress: Progress) -> Done:
    if args.source == "object":
        from calibration.commands_toss import cameras_from_object

        return cameras_from_object(path, args, progress)
    with Session.open(path) as session:
        views = _board_views(session, progress)
        models = {n: session.calibration.cameras[n] for n in views.board if n in session.calibration.cameras}
        if len(models) < 2:
            raise BadInput(
                f"{path}: {len(models)} cameras with known lenses in the views ({', '.join(models) or 'none'}); "
                f"wanted two or more: `toss-calibrate intrinsics {path}` finds {', '.join(sorted(views.board))}"
            )
        reference = COLOR if COLOR in models else sorted(models)[0]
        still = views.table if table_target(session.calibration) else None
        placed = calibrate_cameras(models, views.board, reference, still, args.lenses)
        findings = [*_together(views), *undetected(views.lost), *bumps(views.table)]
        if reference == COLOR:
            findings += _size_by_depth(session, views, placed)
        report = placed.report.with_findings(findings)
        picture = residual_picture(
            store.work_folder(session) / "cameras.png",
            f"{session.name}: cameras",
            {n: views.sizes[n] for n in models},
            placed.pixels,
            placed.residual_px,
        )
        if args.dry_run or report.verdict == "refused":
            return done([report], None, [picture], not args.dry_run)
        calibration = store.updated(
            session.calibration,
            cameras=placed.models if args.lenses else None,
            transforms=placed.transforms,
            replaces=[t.source for t in placed.transforms],
        )
        return done([report], store.write(session, calibration, "cameras", report), [picture], True)


def _together(views: BoardViews) -> list[Finding]:
    if views.spread_ns <= TOGETHER_NS:
        return []
    text = f"the cameras' stamps of one view lie up to {views.spread_ns / 1e6:.0f} ms apart: they are not synchronised"
    return [Finding("warning", f"{text}; the result is right only if the board stood still in every view")]


def _size_by_depth(session: Session, views: BoardViews, placed: PlacedCameras) -> list[Finding]:
    """The board's distance by its stated size against the D455's depth: a wrong size shows as their ratio."""
    model = placed.models[COLOR]
    with Toss(session.path / VIEWS_FILE) as toss:
        depths = toss.depth()
        ratios = []
        for view, pose in placed.reference_from_body.items():
            board_view = views.board[COLOR][view]
            if not len(board_view) or not len(depths):
                continue
            k = depths.nearest(int(views.times_ns[view]))
            image = depths[k]
            if image.raw.shape != (model.height, model.width):
                return []
            u, v = np.rint(board_view.pixels).astype(int).T
            inside = (u >= 0) & (v >= 0) & (u < model.width) & (v < model.height)
            measured = image.raw[v[inside], u[inside]] * image.unit_m
            predicted = (board_view.points_m @ pose[:3, :3].T + pose[:3, 3])[inside, 2]
            ratios += (measured / predicted)[measured > 0].tolist()
    if len(ratios) < 20:
        return []
    ratio = float(np.median(ratios))
    if abs(ratio - 1) < DEPTH_SIZE_OFF:
        return []
    text = f"by depth the board is {ratio:.3f} of its stated size"
    solved = placed.report.to_json().get("board_scale")
    if abs(ratio - 1) < DEPTH_SIZE_WRONG or solved is not None:
        return [Finding("warning", f"{text}: measure its tags (depth may be off by a percent)")]
    return [Finding("refused", f"wrong tag size: {text}; correct size_m in session.json")]


def hand_eye(path: Path, args: argparse.Namespace, progress: Progress) -> Done:
    with Session.open(path) as session:
        views = _board_views(session, progress)
        if args.camera not in views.board:
            raise BadInput(f"no views of {args.camera}; {VIEWS_FILE} has {', '.join(sorted(views.board))}")
        base_from_tool, kept = _robot_poses(session, views)
        board_views = [views.board[args.camera][k] for k in kept]
        model = session.calibration.camera(args.camera)
        lens = as_dict(as_dict(session.calibration.residuals.get("intrinsics")).get(args.camera))
        accuracy = LensAccuracy.stated(as_dict(lens.get("uncertainty")))
        solved = calibrate_hand_eye(model, board_views, base_from_tool, args.mounting, lens=accuracy)
        report = solved.report.with_findings(undetected(views.lost))
        picture = residual_picture(
            store.work_folder(session) / "hand_eye.png",
            f"{session.name}: {report.kind}",
            {args.camera: views.sizes[args.camera]},
            {args.camera: solved.pixels},
            {args.camera: solved.residual_px},
        )
        if args.dry_run or report.verdict == "refused":
            return done([report], None, [picture], not args.dry_run)
        mount = "base" if args.mounting == "eye-to-hand" else "tool"
        place = Transform.from_matrix(args.camera, mount, solved.camera_from_mount)
        calibration = store.updated(session.calibration, transforms=[place], replaces=[mount])
        more = {"mounting": args.mounting, "held_from_board": solved.held_from_board.tolist()}
        written = store.write(session, calibration, "hand_eye", report, **more)
        return done([report], written, [picture], True)


def _robot_poses(session: Session, views: BoardViews) -> tuple[Float[Array, "n 4 4"], list[int]]:
    """base_from_tool at every view whose time the joint states cover."""
    with Toss(session.path / VIEWS_FILE) as toss:
        states = toss.arm_states()
    if states is None:
        raise BadInput(
            f"{session.path / VIEWS_FILE} has no joint states; record views with the arm: "
            "`toss-record --calibration hand-eye`"
        )
    arm_path = ArmPath(panda(), states)
    kept = [k for k, when in enumerate(views.times_ns.tolist()) if arm_path.covers(when)]
    poses = [arm_path.links(int(views.times_ns[k]))[TOOL].matrix for k in kept]
    return np.array(poses).reshape(-1, 4, 4), kept
