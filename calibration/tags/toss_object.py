"""The tagged object in one toss: its tags found, sized and solved with the mono cameras whose places are known."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy import ndarray as Array

from calibration import store
from calibration.cameras.targets import Tags
from calibration.drift import age_findings, drift_findings
from calibration.report import Finding, limit, undetected
from calibration.tags.faults import explain_absence, sizes_by_triangulation, wrong_sizes
from calibration.tags.tagged_object import TaggedObject, solve_tagged_object
from calibration.time_offset import (
    Path3,
)
from calibration.views import (
    COLOR,
    TossTags,
    camera_from_rig,
    grey_images,
    mono_cameras,
    read_toss_tags,
    table_target,
)
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.session import Session

OBJECT_PX, WORST_OBJECT_PX = 0.5, 3.0
SAME_TRIGGER_NS = 2_000_000


@dataclass(frozen=True, eq=False)
class SolvedToss:
    """One toss's tagged object: its trajectory in the D455's frame, stamps of the mono cameras (s)."""

    tags: TossTags
    body: TaggedObject
    trajectory: Path3
    size_m: Mapping[int, float]
    findings: tuple[Finding, ...]

    def centered(self) -> Path3:
        """The trajectory of the centre of the tags, which is nearer to the centre of mass than one tag is."""
        middle = np.mean([place[:3, 3] for place in self.body.body_from_tag.values()], axis=0)
        assert self.trajectory.rotation is not None
        return replace(self.trajectory, position_m=self.trajectory.position_m + self.trajectory.rotation @ middle)


def solve_toss(session: Session, number: int, args: argparse.Namespace, progress: Progress) -> SolvedToss:
    """The object's tags in the mono cameras, whose places must be known. Raises BadInput where that cannot be."""
    places = camera_from_rig(session.calibration, mono_cameras(session, session.toss(number).cameras()), COLOR)
    if not places:
        raise BadInput(
            f"toss {number}: no mono camera whose place is known; first `toss-calibrate cameras {session.path}`"
        )
    asked = tag_ids(args)
    tags = read_toss_tags(session, number, store.work_folder(session), progress)
    fixed = table_target(session.calibration)
    of_object = tags.of_object(asked, fixed)
    models = {c: session.calibration.cameras[c] for c in places}
    detections, times_ns = triggered(tags, of_object, list(places))
    if not any(t for lists in detections.values() for t in lists):
        with session.toss(number) as toss:
            why = explain_absence(grey_images(toss, next(iter(places)))[1], session.calibration.tag_family)
        raise BadInput(f"toss {number}: no tags on the object: {why}")
    measured = sizes_by_triangulation(models, places, detections)
    size_m = tag_sizes(args, of_object, measured)
    body = solve_tagged_object(models, detections, size_m, places)
    findings = [
        *undetected(tags.lost, f"toss {number}: "),
        *(wrong_sizes(size_m, measured) if args.tag_size else []),
        *_moved(session, fixed, tags),
    ]
    findings += limit(
        body.solved.rms_px, f"toss {number}: the residual of the object's tags", "px", OBJECT_PX, WORST_OBJECT_PX
    )
    trajectory = Path3.of_poses(times_ns[body.instants] / 1e9, body.rig_from_body)
    return SolvedToss(tags, body, trajectory, size_m, tuple(findings))


def _moved(session: Session, fixed: Tags | None, tags: TossTags) -> list[Finding]:
    found = drift_findings(session.calibration, fixed, tags.tags) if fixed else []
    created = session.start.get("created_unix_ns")
    if session.calibration.created_unix_s is not None and isinstance(created, (int, float)):
        found += age_findings(session.calibration, created / 1e9)
    return found


def triggered(tags: TossTags, of_object: Mapping, cameras: Sequence[str]) -> tuple[dict, Array]:
    """Images of the triggered cameras by trigger: the first camera's stamps, the others within 2 ms of them."""
    times_ns = tags.times_ns[cameras[0]]
    out = {}
    for camera in cameras:
        other = tags.times_ns[camera]
        nearest = [int(np.abs(other - t).argmin()) if len(other) else 0 for t in times_ns]
        out[camera] = [
            of_object[camera][k] if len(other) and abs(int(other[k] - t)) < SAME_TRIGGER_NS else []
            for k, t in zip(nearest, times_ns)
        ]
    return out, times_ns


def tag_ids(args: argparse.Namespace) -> list[int] | None:
    if not args.tags:
        return None
    try:
        first, _, last = str(args.tags).partition("-")
        return list(range(int(first), int(last or first) + 1))
    except ValueError as wrong:
        raise BadInput(f"--tags {args.tags}; wanted an id or a range as 0-5") from wrong


def tag_sizes(
    args: argparse.Namespace, of_object: Mapping, measured: Mapping[int, tuple[float, int]]
) -> dict[int, float]:
    """As stated, or as the calibrated cameras measure it."""
    ids = {t.tag_id for lists in of_object.values() for tags in lists for t in tags}
    if args.tag_size:
        return dict.fromkeys(sorted(ids), float(args.tag_size))
    if not measured:
        raise BadInput(
            "the size of the object's tags is not known; state it: --tag-size 0.0614 (side of the black square, m)"
        )
    common = float(np.median([size for size, _ in measured.values()]))
    return {
        i: measured[i][0] if i in measured and abs(measured[i][0] / common - 1) > 0.1 else common for i in sorted(ids)
    }
