"""What stands still (cameras, table tags) and what moves (the object as truth and estimates have it), in rerun."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings.geometry import CameraModel, Transform, rotation_angle_rad
from recordings.tracks import TagPlacement, runs
from recordings.view.body_point import at_same_point
from recordings.view.layers import CAMERA, FRUSTUM_M, MOTION, Clock, image_entity, plotted, quaternions_xyzw
from recordings.view.mesh import outline_px, shaded_mesh
from recordings.view.scene import Body, Color, Scene, root_poses

BODY, PATH, TAGS = "world/object/{}", "world/path/{}", "world/table_tags"
CAMERA_COLORS: dict[bool, Color] = {True: (90, 170, 255), False: (170, 170, 170)}
TAG_COLOR: Color = (255, 225, 60)
SOLID = 190
"""Opacity of a mesh: what was measured shines through."""
AXES_M = 0.06
AXES_COLORS: tuple[Color, ...] = ((255, 80, 90), (60, 180, 90), (110, 120, 255))


def log_rig(recording: rr.RecordingStream, scene: Scene) -> None:
    """The world's axes, cameras with their frusta, the table's tags in the world and in the images."""
    upright = rr.ViewCoordinates.RIGHT_HAND_Z_UP if scene.root == "world" else rr.ViewCoordinates.RDF
    recording.log("world", upright, static=True)
    if scene.root == "world":
        recording.log("world/origin", rr.TransformAxes3D(0.1), static=True)
    for name, model in scene.calibration.cameras.items():
        if not name.endswith("_depth"):
            log_camera(recording, scene, name, model)
    log_table_tags(recording, scene)


def log_camera(recording: rr.RecordingStream, scene: Scene, name: str, model: CameraModel) -> None:
    """A frustum with its image at the camera's place; without a place the image is shown flat only."""
    place = scene.root_from(model.frame)
    if place is None:
        return
    color = CAMERA_COLORS["mono" not in name]
    holder = CAMERA.format(name)
    recording.log(holder, placed(place), static=True)
    recording.log(f"{holder}/name", rr.Points3D([[0, 0, 0]], labels=[name], colors=[color], radii=[0.004]), static=True)
    pinhole = rr.Pinhole(
        image_from_camera=model.K,
        width=model.width,
        height=model.height,
        image_plane_distance=FRUSTUM_M,
        color=color,
    )
    recording.log(image_entity(scene, name), pinhole, static=True)


def log_table_tags(recording: rr.RecordingStream, scene: Scene) -> None:
    """Where the calibration has the table's tags: outlines on the table and, through the lens, in every image."""
    tags, world = scene.calibration.table_tags, scene.root_from("world")
    if not tags or world is None:
        return
    corners = [tag_corners_world(tag) for tag in tags]
    labels = [f"tag {tag.tag_id}" for tag in tags]
    loops = [np.vstack([c, c[:1]]) for c in corners]
    recording.log(TAGS, rr.LineStrips3D(loops, colors=[TAG_COLOR], labels=labels, radii=0.0015), static=True)
    for name, model in scene.calibration.cameras.items():
        camera_from_world = scene.calibration.find(model.frame, "world")
        if camera_from_world is None or name.endswith("_depth"):
            continue
        seen = [model.project(camera_from_world.points(loop)) for loop in loops]
        seen = [pixels for pixels in seen if model.sees(pixels).all()]
        if seen:
            strips = rr.LineStrips2D(seen, colors=[TAG_COLOR], radii=-1.0)
            recording.log(f"{image_entity(scene, name)}/table_tags", strips, static=True)


def tag_corners_world(tag: TagPlacement) -> Float[Array, "4 3"]:
    """Corners of the black square in the world, in the order of pupil-apriltags: (-,+), (+,+), (+,-), (-,-)."""
    h = tag.size_m / 2
    return tag.world_from_tag.points(np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]]))


def log_bodies(recording: rr.RecordingStream, scene: Scene, toss: int) -> None:
    """Every body in one toss: its shape, its moving pose, its path, its outline in the colour image, its motion."""
    clock = Clock(recording, toss, scene.shift_ns[toss])
    start_ns = scene.spans_ns[toss][0]
    for body in scene.bodies:
        clock.at(start_ns).log(BODY.format(body.name), rr.Clear(recursive=True))
        times_ns, matrices = root_poses(scene, body.poses.get(toss, ()))
        followed = at_same_point(scene, body, toss, times_ns, matrices)
        log_path(clock, body, start_ns, followed)
        if len(times_ns) == 0:
            continue
        log_poses(clock, scene, body, times_ns, matrices)
        log_motion(clock, scene, body, times_ns, followed)
        if body.shown:
            log_outlines(clock, scene, body, times_ns, matrices)


def log_poses(
    clock: Clock, scene: Scene, body: Body, times_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"]
) -> None:
    """The body at its poses. While it is lost nothing is drawn: it is cleared, and drawn anew where it is found."""
    entity = BODY.format(body.name)
    known = np.isfinite(matrices).all(axis=(1, 2))
    half_m = guessed_half_m(scene, matrices)
    for first, after in runs(known):
        log_shape(clock, body, int(times_ns[first]), half_m)
        if after < len(known):
            clock.at(int(times_ns[after])).log(entity, rr.Clear(recursive=True))
    if known.any():
        turned = quaternions_xyzw(matrices[known, :3, :3])
        columns = rr.Transform3D.columns(translation=matrices[known, :3, 3], quaternion=turned)
        clock.columns(entity, times_ns[known], columns)


def log_shape(clock: Clock, body: Body, time_ns: int, half_m: float | None) -> None:
    """The mesh in the body's colour; where no shape is known, axes and a box as high as the pose rests."""
    entity = BODY.format(body.name)
    shape = body.shape(clock.toss)
    if shape is not None:
        clock.at(time_ns).log(f"{entity}/shape", shaded_mesh(shape, (*body.color, SOLID)))
        return
    axes = rr.Arrows3D(vectors=np.eye(3) * AXES_M, colors=AXES_COLORS)  # rerun's own axes cannot be cleared
    clock.at(time_ns).log(f"{entity}/axes", axes)
    if half_m is not None:
        box = rr.Boxes3D(half_sizes=[[half_m] * 3], colors=[body.color], labels=["shape not known"])
        clock.at(time_ns).log(f"{entity}/box", box)


def guessed_half_m(scene: Scene, matrices: Float[Array, "n 4 4"]) -> float | None:
    """How high above the table the body's origin rests, if that is plausible as half the size of an object."""
    heights = matrices[np.isfinite(matrices[:, 2, 3]), 2, 3]
    if scene.root != "world" or len(heights) == 0 or not 0.005 < heights[-1] < 0.2:
        return None
    return float(heights[-1])


def log_path(clock: Clock, body: Body, start_ns: int, matrices: Float[Array, "n 4 4"]) -> None:
    """The way of the body's point that is followed through the toss; broken where it was lost."""
    strips = unbroken(matrices[:, :3, 3])
    clock.at(start_ns).log(PATH.format(body.name), rr.LineStrips3D(strips, colors=[body.color], radii=0.001))


def unbroken(points: Float[Array, "n 3"]) -> list[Float[Array, "m 3"]]:
    """Runs of finite points, each of two or more."""
    return [points[a:b] for a, b in runs(np.isfinite(points).all(axis=1)) if b - a > 1]


def log_motion(
    clock: Clock, scene: Scene, body: Body, times_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"]
) -> None:
    """Height over the table and speed of the point that is followed, and spin, as plots; a lost frame leaves a gap."""
    values = {"speed_m_s": speeds_m_s(times_ns, matrices), "spin_rad_s": spins_rad_s(times_ns, matrices)}
    if scene.root == "world":
        values["height_m"] = matrices[:, 2, 3]
    for name, value in values.items():
        entity = f"{MOTION}/{name}/{body.name}"
        style = rr.SeriesLines(names=[body.label], colors=[body.color])
        clock.at(int(times_ns[0])).log(entity, style, static=True)
        clock.columns(entity, *plotted(times_ns, value))


def speeds_m_s(times_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"]) -> Float[Array, " n"]:
    """|p[k] - p[k-1]| / dt; the first is NaN."""
    steps = np.linalg.norm(np.diff(matrices[:, :3, 3], axis=0), axis=1)
    return np.r_[np.nan, steps / np.maximum(np.diff(times_ns) / 1e9, 1e-9)]


def spins_rad_s(times_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"]) -> Float[Array, " n"]:
    """Angle between neighbouring rotations over dt; the first is NaN, as is every step to or from a lost frame."""
    turns = np.full(len(matrices), np.nan)
    for k in range(1, len(matrices)):
        turn = matrices[k - 1, :3, :3].T @ matrices[k, :3, :3]
        if np.isfinite(turn).all():
            turns[k] = rotation_angle_rad(turn)
    turns[1:] /= np.maximum(np.diff(times_ns) / 1e9, 1e-9)
    return turns


def log_outlines(
    clock: Clock,
    scene: Scene,
    body: Body,
    times_ns: Int64[Array, " n"],
    matrices: Float[Array, "n 4 4"],
    camera: str = "d455",
) -> None:
    """The body's outline over the colour image, projected through the lens at each pose."""
    shape, model = body.shape(clock.toss), scene.calibration.cameras.get(camera)
    camera_from_root = scene.calibration.find(model.frame, scene.root) if model is not None else None
    if shape is None or model is None or camera_from_root is None:
        return
    for time_ns, matrix in zip(times_ns, matrices):
        borders: Sequence[Float[Array, "n 2"]] = ()
        if np.isfinite(matrix).all():
            root_from_object = Transform.from_matrix(scene.root, shape.object_frame, matrix)
            borders = outline_px(shape, model, camera_from_root @ root_from_object)
        strips = rr.LineStrips2D(borders, colors=[body.color], radii=-1.0)
        clock.at(int(time_ns)).log(f"{image_entity(scene, camera)}/outline_{body.name}", strips)


def placed(place: Transform) -> rr.Transform3D:
    """A transform that stands still."""
    w, x, y, z = place.quaternion_wxyz
    return rr.Transform3D(translation=place.translation_m, quaternion=[x, y, z, w])
