"""Small looping pictures for the report: every toss's flight, with the object's outline in its status's colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int64, UInt8
from numpy import ndarray as Array

from processing.engine.parts import side_by_side
from processing.evaluate.report_mesh import thinned
from processing.evaluate.report_shapes import Shown
from processing.evaluate.table import Row
from recordings.film.file import looping_webp
from recordings.film.film import STATUS_RGB
from recordings.film.raster import covered_pixels, outlined
from recordings.geometry import CameraModel
from recordings.mcap.codec import decode_image
from recordings.results.folder import Results
from recordings.session import Session
from recordings.tracks import ObjectShape, ObjectTrack

WIDTH_PX, HEIGHT_PX = 300, 240
FRAMES, FEWEST = 480, 10
"""Frames of all loops together (half a kilobyte to six each), and at least of one."""
OUTLINE_FACES = 4_000
MOVES_M = 0.002
"""From frame to frame; less is rest."""
AROUND = 4
"""Frames shown before the motion and after it."""
MARGIN, QUALITY, SLOWED = 0.15, 55, 3
LOST_EDGE_PX = 4


@dataclass(frozen=True)
class Loop:
    """The moving picture of one toss (WebP), and how many frames it has."""

    toss: int
    webp: bytes
    frames: int


def toss_loops(results: Results, row: Row, session: Session) -> list[Loop]:
    """A loop for every toss of a row whose colour images are there."""
    each = max(FEWEST, FRAMES // max(len(row.tracks), 1))
    stages = {toss: row.record.toss(toss).shape or row.record.shape for toss in row.tracks}
    a_toss = {stage: toss for toss, stage in stages.items()}
    shapes = {stage: _outline_shape(results, row, toss) for stage, toss in a_toss.items()}

    def loop(toss: int) -> Loop | None:
        track = row.tracks[toss]
        images = loop_images(session, row, track, shapes[stages[toss]], each)
        if not images:
            return None
        shown = chosen_frames(track, each)
        times_s = SLOWED * 1e-9 * (track.time_ns[shown] - track.time_ns[shown[0]]).astype(np.float64)
        return Loop(toss, looping_webp(images, times_s, QUALITY), len(images))

    return [found for found in side_by_side(loop, list(row.tracks)) if found is not None]


def loop_images(
    session: Session, row: Row, track: ObjectTrack, shape: ObjectShape, most: int
) -> list[UInt8[Array, "h w 3"]]:
    """The cut-out frames: outline in the status's colour; a lost frame has none, and an edge in red."""
    frames = session.toss(track.toss).color(track.camera)
    camera = row.record.calibration.camera(track.camera)
    if len(frames) != len(track.status):
        return []
    cut = flight_cut(track, shape, camera)
    factor = min(WIDTH_PX / (cut[1].stop - cut[1].start), HEIGHT_PX / (cut[0].stop - cut[0].start))
    out = []
    for i in chosen_frames(track, most):
        image = cv2.resize(decode_image(frames[int(i)])[cut], None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        color, pose = STATUS_RGB[track.status[i]], track.pose(int(i))
        if pose is None:
            height, width = image.shape[:2]
            cv2.rectangle(image, (0, 0), (width - 1, height - 1), color, LOST_EDGE_PX)
        else:
            mask = covered_pixels(shape, pose, camera)[cut].astype(np.uint8)
            small = cv2.resize(mask, image.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
            image = outlined(image, small, color, 2)
        out.append(np.asarray(image, dtype=np.uint8))
    return out


def chosen_frames(track: ObjectTrack, most: int) -> Int64[Array, " k"]:
    """Frames of the motion and a little around it, evenly, at most so many; all of the toss where nothing moves."""
    step_m = np.linalg.norm(np.diff(track.camera_from_object[:, :3, 3], axis=0), axis=1)
    moving = np.flatnonzero(~(step_m < MOVES_M))  # a lost pose may be anywhere
    first, last = (moving[0], moving[-1] + 1) if len(moving) else (0, len(track.status) - 1)
    first, last = max(0, int(first) - AROUND), min(len(track.status) - 1, int(last) + AROUND)
    return np.unique(np.linspace(first, last, min(most, last - first + 1)).round().astype(np.int64))


def flight_cut(track: ObjectTrack, shape: ObjectShape, camera: CameraModel) -> tuple[slice, slice]:
    """Rows and columns of the image that hold the object at all its poses, with a margin; all where it is not seen."""
    low, high = shape.vertices_m.min(0), shape.vertices_m.max(0)
    box = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    known = track.camera_from_object[~track.lost]
    points = np.einsum("nij,kj->nki", known[:, :3, :3], box) + known[:, None, :3, 3]
    pixels: Float[Array, "m 2"] = camera.project(points).reshape(-1, 2)
    size = np.array([camera.width, camera.height])
    pixels = pixels[np.isfinite(pixels).all(axis=1)].clip(0, size)
    if len(pixels) == 0 or (np.ptp(pixels, axis=0) < 8).any():
        return slice(0, camera.height), slice(0, camera.width)
    edge = MARGIN * np.ptp(pixels, axis=0)
    (left, top), (right, bottom) = (pixels.min(0) - edge).clip(0, size), (pixels.max(0) + edge).clip(0, size)
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def _outline_shape(results: Results, row: Row, toss: int) -> ObjectShape:
    shape = results.shape(row.record.name, row.record.scope, toss)
    return thinned(Shown("", shape, np.eye(4)), OUTLINE_FACES).shape
