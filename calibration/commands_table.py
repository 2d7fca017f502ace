"""What `toss-calibrate table` does: tags on the table, depth of it, and things falling on it."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array

from calibration import store
from calibration.cameras.extrinsics import still_view
from calibration.cameras.poses import inverse_poses
from calibration.cameras.targets import Tags, TargetView, tag_view
from calibration.done import Done, done
from calibration.ground_plane import (
    Gravity,
    Plane,
    find_flight,
    fit_table,
    gravity_from_flight,
    judge_table,
    place_world,
    table_points,
)
from calibration.pictures import table_picture
from calibration.report import Finding, undetected
from calibration.tags.detect import detect_tags
from calibration.tags.faults import explain_absence
from calibration.tags.toss_object import solve_toss
from calibration.views import (
    COLOR,
    camera_from_rig,
    grey_images,
    mono_cameras,
    response_of,
    table_target,
)
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.progress import Progress
from recordings.records import depth_in_metres
from recordings.session import Session

STILL_IMAGES = 5
DEPTH_IMAGES = 12
PAPER_M = 0.003
"""Tags whose given place is within this of z = 0 lie on the table; how far above is the paper's thickness."""
INDEPENDENT_CORNERS = 3


def table(path: Path, args: argparse.Namespace, progress: Progress) -> Done:
    with Session.open(path) as session:
        calibration = session.calibration
        table_views, lost = _table_views(session, progress)
        models = {n: calibration.cameras[n] for n in table_views}
        places = camera_from_rig(calibration, list(table_views), COLOR)
        target = table_target(calibration)
        tags_px, hold_out, tags, rig_from_world = None, {}, None, None
        unseen = undetected(lost)
        if target is not None and any(len(v) >= 4 for v in table_views.values()):
            solved = place_world(models, places, table_views)
            tags_px, rig_from_world = solved.rms_px, solved.scene.rig_from_body[0]
            covariance = solved.covariance[solved.blocks["view", 0], solved.blocks["view", 0]]
            tags = _corners_in_rig(target, table_views, rig_from_world, covariance)
            hold_out = _without_one_camera(models, places, table_views, rig_from_world)
        elif target is not None:
            why = explain_absence(grey_images(session.toss(session.tosses[0]), COLOR)[1], calibration.tag_family)
            unseen.append(Finding("warning", f"no table tags found: {why}"))
        depth_points = _depth_points(session)
        height_m = _paper_m(target) if tags is not None else 0.0
        plane, scale, residuals = fit_table(tags, depth_points, height_m)
        world_from_rig = _world_from_rig(session, rig_from_world, args.move_world)
        plane_world = plane.in_frame(world_from_rig)
        gravity = _gravity(session, args, world_from_rig, progress)
        report = judge_table(plane_world, residuals, hold_out, tags_px, scale, gravity).with_findings(unseen)
        picture = _picture(session, plane_world, world_from_rig, depth_points, scale, target)
        if args.dry_run or report.verdict == "refused":
            return done([report], None, [picture], not args.dry_run)
        moved = [world_from_rig] if args.move_world else []
        changed = store.updated(calibration, transforms=moved, replaces=["world"] if moved else [])
        written = store.write(session, changed, "table", report, **_plane_entry(plane_world, tags, depth_points))
        return done([report], written, [picture], True)


def _picture(
    session: Session,
    plane_world: Plane,
    world_from_rig: Transform,
    depth_m: Float[Array, "n 3"] | None,
    scale: float | None,
    target: Tags | None,
) -> Path:
    """Depth over the table, its scale taken out as the plane's fit had it."""
    near = np.zeros((0, 3)) if depth_m is None else depth_m / (scale or 1.0)
    points = world_from_rig.points(near)
    corners = [target.corners_m(i)[:, :2] for i in target.board_from_tag] if target is not None else []
    return table_picture(
        store.work_folder(session) / "table.png",
        f"{session.name}: table",
        points,
        plane_world.heights_m(points),
        np.concatenate([np.zeros((0, 2)), *corners]),
    )


def _plane_entry(plane: Plane, tags: object, depth: object) -> dict[str, object]:
    source = "+".join(name for name, given in (("tags", tags), ("depth", depth)) if given is not None)
    return {
        "normal_world": plane.normal.tolist(),
        "offset_m": plane.offset_m,
        "std_m": plane.std_m,
        "source": source,
    }


def _table_views(session: Session, progress: Progress) -> tuple[dict[str, TargetView], int]:
    """The table's tags in every camera, over images of several tosses, and on how many the detector died."""
    target = table_target(session.calibration)
    table_views: dict[str, TargetView] = {}
    lost = 0
    if target is None:
        return table_views, lost
    with_mono = [n for n in session.tosses if mono_cameras(session, session.toss(n).cameras())]
    for camera in sorted({c for n in session.tosses[:1] + tuple(with_mono[:1]) for c in session.toss(n).cameras()}):
        if camera not in session.calibration.cameras:
            continue
        number = session.tosses[0] if camera == COLOR else with_mono[0]
        times_ns, images = grey_images(session.toss(number), camera)
        some = [images[k] for k in np.unique(np.linspace(0, len(times_ns) - 1, STILL_IMAGES).astype(int))]
        found = detect_tags(some, target.family, store.work_folder(session), progress, response=response_of(camera))
        lost += len(found.lost)
        view = still_view([tag_view(target, tags) for tags in found])
        if view is not None:
            table_views[camera] = view
    return table_views, lost


def _corners_in_rig(
    target: Tags, table_views: Mapping[str, TargetView], rig_from_world: Array, covariance: Float[Array, "6 6"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 3"]]:
    """Corners of the tags that were seen, in the rig, with covariances. All share one pose's error, so each is given
    the weight of a few independent points together."""
    seen = sorted({i // 4 for view in table_views.values() for i in view.ids.tolist()})
    corners = np.concatenate([target.corners_m(i) for i in seen if i in target.board_from_tag])
    points = corners @ rig_from_world[:3, :3].T + rig_from_world[:3, 3]
    cross = np.array([[[0, z, -y], [-z, 0, x], [y, -x, 0]] for x, y, z in points])
    J = np.concatenate([cross, np.tile(np.eye(3), (len(points), 1, 1))], axis=2)
    spread_m2 = J @ covariance @ np.swapaxes(J, 1, 2)
    return points, spread_m2 * max(1.0, len(points) / INDEPENDENT_CORNERS)


def _without_one_camera(
    models: Mapping, places: Mapping, table_views: Mapping[str, TargetView], full: Float[Array, "4 4"]
) -> dict[str, float]:
    """How far the table rises or sinks under the world's origin when a camera is left out."""
    changes = []
    for out in table_views:
        rest = {n: v for n, v in table_views.items() if n != out}
        if sum(len(v) for n, v in rest.items() if n in places) < 8:
            continue
        other = place_world(models, places, rest).scene.rig_from_body[0]
        changes.append(1e3 * abs(float((other[:3, 3] - full[:3, 3]) @ full[:3, 2])))
    return {"height_without_one_camera_mm": max(changes)} if changes else {}


def _paper_m(target: Tags | None) -> float:
    heights = [float(place[2, 3]) for place in target.board_from_tag.values()] if target else []
    low = [h for h in heights if abs(h) < PAPER_M]
    return float(np.median(low)) if low else 0.0


def _world_from_rig(session: Session, rig_from_world: Array | None, move: bool) -> Transform:
    known = session.calibration.find("world", COLOR)
    if (move or known is None) and rig_from_world is not None:
        return Transform.from_matrix("world", COLOR, inverse_poses(rig_from_world))
    if known is None:
        raise BadInput(
            "nobody says where the world is: calibration.json has neither world_from_d455 nor tags on the table; "
            "add `table_tags` with their places"
        )
    return known


def _depth_points(session: Session) -> Float[Array, "m 3"] | None:
    """Points on the table from the median of some depth images (the object moves out of it)."""
    camera = session.calibration.cameras.get(f"{COLOR}_depth", session.calibration.cameras.get(COLOR))
    to_color = session.calibration.find(COLOR, camera.frame) if camera is not None else None
    stack = _some_depth(session)
    if camera is None or to_color is None or not stack:
        return None
    median = np.ma.median(np.ma.masked_equal(np.array(stack), 0), axis=0).filled(0).astype(np.float32)
    near = None
    world = session.calibration.find(camera.frame, "world")
    if world is not None:
        near = Plane(np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 0.0).in_frame(world)
    return to_color.points(table_points(median, camera, near))


def _some_depth(session: Session) -> list[Float32[Array, "h w"]]:
    tosses = [session.tosses[k] for k in np.unique(np.linspace(0, len(session.tosses) - 1, 4).astype(int))]
    each = max(1, DEPTH_IMAGES // max(1, len(tosses)))
    found = []
    for number in tosses:
        frames = session.toss(number).depth()
        for k in np.unique(np.linspace(0, len(frames) - 1, each).astype(int)) if len(frames) else ():
            found.append(depth_in_metres(frames[int(k)]))
    return found


def _gravity(
    session: Session, args: argparse.Namespace, world_from_rig: Transform, progress: Progress
) -> list[Gravity]:
    """From the flight of every toss with mono images of a tagged object; none where there is no such toss."""
    found = []
    for number in session.tosses:
        if not mono_cameras(session, session.toss(number).cameras()):
            continue
        try:
            trajectory = solve_toss(session, number, args, progress).centered()
        except BadInput:
            continue
        release_ns = session.toss(number).window().release_time_ns
        flight = find_flight(trajectory, None if release_ns is None else release_ns / 1e9)
        if flight is not None:
            in_rig = gravity_from_flight(trajectory, flight)
            found.append(replace(in_rig, down=world_from_rig.vectors(in_rig.down[None])[0]))
    return found
