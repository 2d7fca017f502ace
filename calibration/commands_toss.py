"""What `toss-calibrate time | cameras --from object` do: they work on the tosses themselves."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy import ndarray as Array

from calibration import store
from calibration.cameras.extrinsics import spread
from calibration.cameras.poses import inverse_poses
from calibration.cameras.targets import Tags, tag_view
from calibration.done import TOOL, Done, done
from calibration.pictures import offsets_picture, residual_picture
from calibration.report import Finding, Report, limit, undetected
from calibration.tags.tagged_object import TaggedObject, solve_tagged_object
from calibration.tags.toss_object import SolvedToss, solve_toss, tag_ids, tag_sizes, triggered
from calibration.time_offset import (
    Path3,
    TimeOffset,
    offset_of_corners,
    offset_of_paths,
    offset_report,
    place_by_motion,
)
from calibration.views import (
    COLOR,
    TossTags,
    mono_cameras,
    read_toss_tags,
    table_target,
)
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.progress import Progress
from recordings.robot.arm import ArmPath, panda
from recordings.session import Session, Toss
from recordings.sync import clock_offset_ns

OBJECT_PX, WORST_OBJECT_PX = 0.5, 1.5
ARM_STEP_NS = 5_000_000
FINGERS_OPEN_M = 0.002


def time(path: Path, args: argparse.Namespace, progress: Progress) -> Done:
    with Session.open(path) as session:
        mono: dict[int, TimeOffset] = {}
        arm: dict[int, TimeOffset] = {}
        failed: dict[int, str] = {}
        findings: list[Finding] = []
        for number in session.tosses:
            toss = session.toss(number)
            if not mono_cameras(session, toss.cameras()):
                continue
            try:
                solved = solve_toss(session, number, args, progress)
                mono[number] = _mono_offset(session, solved)
                findings += [f for f in solved.findings if f not in findings]
            except BadInput as wrong:
                failed[number] = str(wrong)
                continue
            try:
                found = _arm_offset(session, toss, solved, mono[number])
            except BadInput as wrong:
                findings.append(Finding("note", f"toss {number}: no offset of the arm: {wrong}"))
                continue
            if found is not None:
                arm[number] = found
        if not mono:
            reasons = "; ".join(f"toss {k}: {v}" for k, v in failed.items()) or "no toss has images of mono cameras"
            raise BadInput(f"no time offset could be found: {reasons}")
        reports = {"mono": offset_report("mono", COLOR, mono, failed)}
        if arm:
            reports["arm"] = offset_report("arm", COLOR, arm, {})
        reports["mono"] = reports["mono"].with_findings(findings)
        picture = _offsets_picture(session, reports, {"mono": mono, "arm": arm})
        if args.dry_run or any(r.verdict == "refused" for r in reports.values()):
            return done(list(reports.values()), None, [picture], not args.dry_run)
        offsets = {name: _offset_entry(report) for name, report in reports.items()}
        entry = {"reference": COLOR, "offsets": offsets, **{n: r.to_json() for n, r in reports.items()}}
        written = store.write_entry(session, session.calibration, "time", entry)
        return done(list(reports.values()), written, [picture], True)


def _offsets_picture(
    session: Session, reports: Mapping[str, Report], by_toss: Mapping[str, Mapping[int, TimeOffset]]
) -> Path:
    values = {
        stream: {
            **{str(k): (1e3 * o.offset_s, 1e3 * o.std_s) for k, o in sorted(by_toss[stream].items())},
            "pooled": (float(report.residuals["offset_ms"]), float(report.uncertainty["offset_ms"])),
        }
        for stream, report in reports.items()
    }
    return offsets_picture(store.work_folder(session) / "time.png", f"{session.name}: clocks", values)


def _offset_entry(report: Report) -> dict[str, int]:
    """What recordings.sync.clock_offset_ns reads: to be added to the stream's stamps."""
    return {
        "offset_ns": round(1e6 * report.residuals["offset_ms"]),
        "std_ns": round(1e6 * report.uncertainty["offset_ms"]),
    }


def _mono_offset(session: Session, solved: SolvedToss) -> TimeOffset:
    """What to add to the mono cameras' stamps, so that they mean the colour camera's instants."""
    body = Tags(session.calibration.tag_family, solved.size_m, solved.body.body_from_tag)
    stamps = solved.tags.times_ns[COLOR] / 1e9
    frames = [(float(t), tag_view(body, tags)) for t, tags in zip(stamps, solved.tags.tags[COLOR])]
    found = offset_of_corners(solved.trajectory, session.calibration.camera(COLOR), np.eye(4), frames)
    return replace(found, offset_s=-found.offset_s)


def _arm_offset(session: Session, toss: Toss, solved: SolvedToss, mono: TimeOffset) -> TimeOffset | None:
    """The arm's trajectory against that of the held object; None without an arm, or where its base is unknown."""
    states = toss.arm_states()
    base = session.calibration.find("base", COLOR)
    if states is None or base is None:
        return None
    arm_path = ArmPath(panda(), states)
    release = toss.window().release_time_ns or _fingers_open_ns(states.time_ns, states.finger_width_m)
    times = np.arange(states.time_ns[0], min(states.time_ns[-1], release), ARM_STEP_NS)
    tool = np.array([arm_path.links(int(t))[TOOL].matrix for t in times])
    held = solved.trajectory.time_s + mono.offset_s < release / 1e9
    if held.sum() < 4:
        raise BadInput(f"the object is seen in {int(held.sum())} images before the release; wanted 4")
    other = Path3(
        solved.trajectory.time_s[held] + mono.offset_s,
        base.points(solved.trajectory.position_m[held]),
    )
    found = offset_of_paths(Path3.of_poses(times / 1e9, tool), other)
    std = float(np.hypot(found.std_s, mono.std_s))
    return replace(found, offset_s=-found.offset_s, std_s=std)


def _fingers_open_ns(times_ns: Array, width_m: Array) -> int:
    known = np.isfinite(width_m)
    if not known.any():
        return int(times_ns[-1])
    opened = known & (width_m > width_m[known][0] + FINGERS_OPEN_M)
    return int(times_ns[opened][0]) if opened.any() else int(times_ns[-1])


def cameras_from_object(path: Path, args: argparse.Namespace, progress: Progress) -> Done:
    """Places of the mono cameras from the tagged object in a toss; the first of them stays where it is."""
    with Session.open(path) as session:
        number = next((n for n in session.tosses if len(mono_cameras(session, session.toss(n).cameras())) > 1), None)
        if number is None or not args.tag_size:
            raise BadInput(
                "--from object needs a toss seen by two or more mono cameras, and --tag-size "
                "(side of the object's tags, m)"
            )
        tags = read_toss_tags(session, number, store.work_folder(session), progress, refinement="pattern")
        cameras = mono_cameras(session, list(tags.tags))
        of_object = tags.of_object(tag_ids(args), table_target(session.calibration))
        detections, times_ns = triggered(tags, of_object, cameras)
        models = {c: session.calibration.cameras[c] for c in cameras}
        solved = solve_tagged_object(models, detections, tag_sizes(args, of_object, {}), None)
        places = solved.solved.scene.camera_from_rig
        rig = solved.cameras[0]
        transforms = [
            Transform.from_matrix(rig, c, inverse_poses(places[k])) for k, c in enumerate(solved.cameras) if k
        ]
        color = _color_place(session, tags, solved, times_ns, args)
        if color is not None:
            # everything hangs on the D455 where it can be tied to the object too
            transforms = [color, *(color @ t for t in transforms)]
        report = _object_report(solved, color is not None).with_findings(undetected(tags.lost))
        picture = residual_picture(
            store.work_folder(session) / "cameras_from_object.png",
            f"{session.name}: cameras from the tagged object",
            {c: (models[c].width, models[c].height) for c in cameras},
            {c: solved.seen.pixels[solved.seen.camera == k] for k, c in enumerate(solved.cameras)},
            {c: solved.solved.residual_px[solved.seen.camera == k] for k, c in enumerate(solved.cameras)},
        )
        if args.dry_run or report.verdict == "refused":
            return done([report], None, [picture], not args.dry_run)
        replaced = [t.source for t in transforms]
        calibration = store.updated(session.calibration, transforms=transforms, replaces=replaced)
        return done([report], store.write(session, calibration, "cameras", report), [picture], True)


def _color_place(
    session: Session, tags: TossTags, solved: TaggedObject, times_ns: Array, args: argparse.Namespace
) -> Transform | None:
    """d455_from_rig from the object in the D455's own frames, its stamps' offset solved with it; None where it does not
    see the tags."""
    if COLOR not in tags.tags:
        return None
    body = Tags(session.calibration.tag_family, tag_sizes(args, tags.tags, {}), solved.body_from_tag)
    offset_s = clock_offset_ns(session.calibration.residuals, "mono") / 1e9
    trajectory = Path3.of_poses(times_ns[solved.instants] / 1e9 + offset_s, solved.rig_from_body)
    stamps = tags.times_ns[COLOR] / 1e9
    frames = [(float(t), tag_view(body, seen)) for t, seen in zip(stamps, tags.tags[COLOR])]
    place = place_by_motion(trajectory, session.calibration.camera(COLOR), frames)
    return None if place is None else Transform.from_matrix(COLOR, solved.cameras[0], place)


def _object_report(solved: TaggedObject, with_color: bool) -> Report:
    findings = limit(solved.solved.rms_px, "the residual", "px", OBJECT_PX, WORST_OBJECT_PX)
    uncertainty = {}
    for k, camera in enumerate(solved.cameras[1:], 1):
        mm, deg = spread(solved.solved, k)
        uncertainty[camera] = {"position_mm": mm, "direction_deg": deg}
        findings += limit(mm, f"the standard deviation of {camera}'s position", "mm", 1.0, 10.0)
        findings += limit(deg, f"the standard deviation of {camera}'s direction", "deg", 0.1, 1.0)
    if not with_color:
        findings.append(Finding("warning", "the D455 does not see the object's tags: its place is not tied to these"))
    if solved.undetermined_tags:
        listed = ", ".join(map(str, solved.undetermined_tags))
        findings.append(Finding("note", f"tags never seen together with the others: {listed}"))
    residuals = {"rms_px": solved.solved.rms_px, "instants": len(solved.instants), "left_out": solved.left_out}
    return Report("cameras from the object", residuals, {}, uncertainty, tuple(findings))
