"""How a track came about, in rerun: masks, feature matches, keyframes, rejected poses, what was seen so far, residuals.

Drawn for the shown body from what its stages keep; what they do not keep is left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import rerun as rr
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.records import RgbdFrame
from recordings.results.track_notes import Matches, Rejected, TrackNotes
from recordings.view.layers import Clock, Thinned, image_entity, plotted
from recordings.view.scene import Body, Color, Scene

MODEL, SEEN, VIEWPOINTS = "model/{}", "model/{}/seen", "model/{}/keyframes"
REJECTED, FIGURES, MATCHES = "world/rejected/{}", "track", "{}/matches_{}"
AGREES, STRAYS, TRIED = (70, 220, 110), (235, 70, 70), (170, 170, 170)
MASK_OPACITY = 70
CAMERA_M, AXES_M, MOST_REJECTED = 0.25, 0.03, 6
CELLS, STEP_M = 150_000, 0.02
"""Grid cells of an image at most in the seen surface, and the depth step over which no triangle is spanned."""


def log_tracking(clock: Clock, scene: Scene, body: Body, camera: str = "d455") -> None:
    """Every layer of one body in one toss."""
    notes, masks = body.notes.get(clock.toss), body.masks.get(clock.toss)
    times_ns = np.array([pose.time_ns for pose in body.poses.get(clock.toss, ())], dtype=np.int64)
    poses = np.array([pose.matrix for pose in body.poses.get(clock.toss, ())]).reshape(-1, 4, 4)
    if len(times_ns) == 0:
        return
    if masks is not None and len(masks) == len(times_ns):
        log_masks(clock, f"{image_entity(scene, camera)}/mask_{body.name}", times_ns, masks, body.color)
        log_figure(clock, body, "mask_confidence", times_ns, masks.confidence)
    if notes is None or len(notes.residual) != len(times_ns):
        return
    log_figure(clock, body, "residual", times_ns, notes.residual)
    log_figure(clock, body, "on_surface", times_ns, notes.on_surface)
    log_viewpoints(clock, body, times_ns, poses, notes)
    log_rejected(clock, scene, body, times_ns, notes.rejected, camera)
    model = scene.calibration.cameras.get(camera)
    if model is not None:
        log_matches(clock, MATCHES.format(image_entity(scene, camera), body.name), times_ns, notes.matches, model)
    if model is not None and masks is not None and len(masks) == len(times_ns):
        log_seen(clock, scene, body, model, masks, notes.keyframes, poses)


def log_figure(clock: Clock, body: Body, name: str, times_ns: Int64[Array, " n"], values: Float[Array, " n"]) -> None:
    """A number per frame as a plot."""
    entity = f"{FIGURES}/{name}/{body.name}"
    style = rr.SeriesLines(names=[f"{name.replace('_', ' ')}: {body.label}"], colors=[body.color])
    clock.at(int(times_ns[0])).log(entity, style, static=True)
    clock.columns(entity, *plotted(times_ns, values))


def log_masks(
    clock: Clock, entity: str, times_ns: Int64[Array, " n"], masks: Sequence[Bool[Array, "h w"]], color: Color
) -> None:
    """The object's mask over every colour image: a transparent PNG, because plain pixels would fill the recording."""
    for time_ns, mask in zip(times_ns, masks):
        clock.at(int(time_ns)).log(entity, rr.EncodedImage(contents=mask_png(mask, color), media_type="image/png"))


def mask_png(mask: Bool[Array, "h w"], color: Color) -> bytes:
    """The mask in a colour, half transparent, nothing elsewhere."""
    bgra = np.zeros((*mask.shape, 4), dtype=np.uint8)
    bgra[mask] = (*color[::-1], MASK_OPACITY)
    return cv2.imencode(".png", bgra)[1].tobytes()


def log_matches(clock: Clock, entity: str, times_ns: Int64[Array, " n"], matches: Matches, model: CameraModel) -> None:
    """Where matched points lay in the other frame and lie in this one; red: the final poses say otherwise."""
    if len(matches.frames) == 0:
        return
    ends = model.project(matches.points_m.reshape(-1, 3)).reshape(-1, 2, 2)
    for i, time_ns in enumerate(times_ns):
        mine = matches.frames[:, 0] == i
        colors = np.where(matches.agrees[mine, None], AGREES, STRAYS).astype(np.uint8)
        lines = rr.LineStrips2D(ends[mine][:, ::-1], colors=colors, radii=-0.75)
        clock.at(int(time_ns)).log(entity, lines)


def log_viewpoints(
    clock: Clock, body: Body, times_ns: Int64[Array, " n"], poses: Float[Array, "n 4 4"], notes: TrackNotes
) -> None:
    """From where the keyframes up to now look at the object, in its own frame; lost ones have no pose."""
    shown: list[tuple[int, Float[Array, "3"]]] = []
    entity = VIEWPOINTS.format(body.name)
    clock.at(int(times_ns[0])).log(entity, rr.Clear(recursive=True))
    for i in sorted(notes.keyframes):
        if not np.isfinite(poses[i]).all():
            continue
        from_object = -poses[i, :3, :3].T @ poses[i, :3, 3]
        shown.append((i, from_object / np.linalg.norm(from_object) * CAMERA_M))
        places = np.array([place for _, place in shown])
        arrows = rr.Arrows3D(
            origins=places, vectors=-0.4 * places, colors=[body.color], labels=[str(n) for n, _ in shown], radii=0.0015
        )
        clock.at(int(times_ns[i])).log(entity, arrows)


def log_rejected(
    clock: Clock, scene: Scene, body: Body, times_ns: Int64[Array, " n"], rejected: Rejected, camera: str
) -> None:
    """The best of the poses that were not taken, as small axes with their cost."""
    model = scene.calibration.cameras.get(camera)
    root_from_camera = scene.root_from(model.frame) if model is not None else None
    if root_from_camera is None or len(rejected.frame) == 0:
        return
    for i, time_ns in enumerate(times_ns):
        mine = np.flatnonzero(rejected.frame == i)
        mine = mine[np.argsort(rejected.cost[mine], kind="stable")][:MOST_REJECTED]
        at = root_from_camera.matrix @ rejected.pose[mine]
        origins = np.repeat(at[:, :3, 3], 3, axis=0)
        vectors = AXES_M * np.swapaxes(at[:, :3, :3], 1, 2).reshape(-1, 3)
        labels = [text for cost in rejected.cost[mine] for text in (f"{cost:.2f}", "", "")]
        axes = rr.Arrows3D(origins=origins, vectors=vectors, colors=[TRIED], labels=labels, radii=0.0008)
        clock.at(int(time_ns)).log(REJECTED.format(body.name), axes)


def log_seen(
    clock: Clock,
    scene: Scene,
    body: Body,
    model: CameraModel,
    masks: Sequence[Bool[Array, "h w"]],
    keyframes: Sequence[int],
    poses: Float[Array, "n 4 4"],
) -> None:
    """The model as it grows: what each keyframe up to now saw of the surface, in the object's frame."""
    recorded = scene.toss(clock.toss)
    if recorded is None or not len(recorded.color()) or not len(recorded.depth()):
        return
    frames, entity = recorded.rgbd(), SEEN.format(body.name)
    clock.at(int(frames.times_ns[0])).log(entity, rr.Clear(recursive=True))
    try:
        for i, surface in seen_surfaces(frames, masks, model, sorted(keyframes), poses):
            clock.at(int(frames.times_ns[i])).log(f"{entity}/{i}", surface)
    except BadInput:  # depth that cannot be laid over colour: the point cloud's layer says so
        return


def seen_surfaces(
    frames: Sequence[RgbdFrame],
    masks: Sequence[Bool[Array, "h w"]],
    model: CameraModel,
    keyframes: Sequence[int],
    poses: Float[Array, "n 4 4"],
) -> Iterator[tuple[int, rr.Mesh3D]]:
    """Position and surface of every keyframe that has a pose."""
    thin = Thinned.of(model, CELLS)
    for i in keyframes:
        if not np.isfinite(poses[i]).all():
            continue
        frame = frames[i]
        depth_m = np.where(masks[i], frame.depth_m, 0)[:: thin.step, :: thin.step].astype(np.float32)
        points_m, faces, pixels = spanned(thin.rays, depth_m)
        if len(faces) == 0:
            continue
        object_from_camera = Transform.from_matrix("camera", "object", poses[i]).inverse()
        colors = frame.color_rgb[:: thin.step, :: thin.step].reshape(-1, 3)[pixels]
        yield (
            i,
            rr.Mesh3D(
                vertex_positions=object_from_camera.points(points_m).astype(np.float32),
                triangle_indices=faces,
                vertex_colors=colors,
            ),
        )


def spanned(
    rays: Float[Array, "h w 3"], depth_m: Float32[Array, "h w"]
) -> tuple[Float[Array, "v 3"], Int64[Array, "f 3"], Int64[Array, " v"]]:
    """Points (camera frame), triangles between neighbouring pixels, and which pixels; none over steps or holes."""
    h, w = depth_m.shape
    known = (depth_m > 0) & np.isfinite(rays).all(-1)
    number = np.arange(h * w).reshape(h, w)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    z = np.where(known, depth_m, np.nan).ravel()[faces]
    faces = faces[np.isfinite(z).all(1) & (np.ptp(z, axis=1) < STEP_M)]
    pixels, renumbered = np.unique(faces, return_inverse=True)
    points_m = (rays * depth_m[..., None].astype(np.float64)).reshape(-1, 3)[pixels]
    return points_m, renumbered.reshape(-1, 3).astype(np.int64), pixels.astype(np.int64)
