"""The scene of a film: the table as the colour camera saw it, from an eye that stands aside, the object over it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.film.raster import Canvas, covered_pixels
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.session import Toss
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration

ROOT, EYE = "root", "eye"
ASIDE_RAD, UP_RAD = np.radians(50.0), np.radians(28.0)
"""How far the eye stands beside the colour camera, around the vertical, and above the table."""
HALF_VIEW = 0.35
"""Tangent of half the eye's angle of view."""
SAMPLED_FRAMES = 9
"""Frames of a toss that the table's colours are the mean of."""
ON_TABLE_M, ON_TABLE_SHARE = 0.015, 0.02
"""Depth that differs from the plane's by less than this, and this share of it, is the table's."""
RIM_SHARE = 0.02
TABLE_RGB, FAR_RGB, SHADOW = (222, 222, 222), (245, 245, 245), 0.62
PATH_PX = 2
LEAST_REACH_M, UNKNOWN_RADIUS_M = 0.25, 0.08
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""`root_from_camera` where no world is known: z up for a camera that stands upright."""


@dataclass(frozen=True, eq=False)
class Table:
    """What the colour camera saw of the table (z = 0 of the world): mean colours, and where it saw the table at all."""

    camera: CameraModel
    world_from_camera: Transform
    rgb: UInt8[Array, "h w 3"]
    seen: Bool[Array, "h w"]

    @staticmethod
    def of(
        toss: Toss, camera: CameraModel, world_from_camera: Transform, track: ObjectTrack, shape: ObjectShape | None
    ) -> Table:
        """From frames over the whole toss, without the object (as tracked) and what depth says stands on the table."""
        size = (camera.height, camera.width)
        summed, count = np.zeros((*size, 3)), np.zeros(size)
        plane_m = _plane_depth_m(camera, world_from_camera)
        try:
            frames = toss.rgbd(camera.frame)
            for i in np.unique(np.linspace(0, len(frames) - 1, SAMPLED_FRAMES).astype(int)):
                frame = frames[int(i)]
                near = np.abs(frame.depth_m - plane_m) < ON_TABLE_M + ON_TABLE_SHARE * plane_m
                pose = track.pose(int(i))
                if shape is not None and pose is not None:
                    near &= ~_widened(covered_pixels(shape, pose, camera))
                summed[near] += frame.color_rgb[near]
                count += near
        except BadInput:  # no depth, or none that can be laid over colour
            pass
        rgb = (summed / np.maximum(count, 1)[..., None]).astype(np.uint8)
        return Table(camera, world_from_camera, rgb, count > 0)

    def at(self, points_world_m: Float[Array, "n 3"]) -> tuple[UInt8[Array, "n 3"], Bool[Array, " n"]]:
        """Colours of points of the table, and which of them were seen."""
        pixels = self.camera.project(self.world_from_camera.inverse().points(points_world_m))
        inside = self.camera.sees(pixels)
        u, v = (np.where(inside, pixels[:, k], 0).round().astype(int) for k in (0, 1))
        return self.rgb[v, u], inside & self.seen[v, u]


def _widened(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """A mask with a rim: a pose is not exact, and depth is smeared around an edge."""
    rim = 2 * round(RIM_SHARE * mask.shape[0]) + 1
    return cv2.dilate(mask.astype(np.uint8), np.ones((rim, rim), dtype=np.uint8)) > 0


def _plane_depth_m(camera: CameraModel, world_from_camera: Transform) -> Float[Array, "h w"]:
    """Depth at which each pixel's ray meets z = 0 of the world; NaN where it does not."""
    down = -world_from_camera.vectors(camera.pixel_rays())[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = world_from_camera.translation_m[2] / down
    return np.where(depth > 0, depth, np.nan)


@dataclass(frozen=True, eq=False)
class Stage:
    """Where the scene is seen from: an eye (square, pinhole), `eye_from_root`, and what stands behind the object.

    `root` is the world, or the colour camera turned upright where no world is known (`table` is then None).
    """

    eye: CameraModel
    eye_from_root: Transform
    root_from_camera: Transform
    table: Table | None
    background: UInt8[Array, "s s 3"]

    @staticmethod
    def of(
        toss: Toss, calibration: RigCalibration, track: ObjectTrack, shape: ObjectShape | None, size_px: int
    ) -> Stage:
        """An eye that sees the object at all its poses that are known."""
        camera = calibration.camera(track.camera)
        world_from_camera = calibration.find("world", camera.frame)
        if world_from_camera is None:
            root_from_camera, table = Transform(ROOT, camera.frame, UPRIGHT, np.zeros(3)), None
        else:
            root_from_camera = Transform.from_matrix(ROOT, camera.frame, world_from_camera.matrix)
            table = Table.of(toss, camera, world_from_camera, track, shape)
        places, radius_m = path_m(track, shape), _radius_m(shape)
        places = root_from_camera.points(places[np.isfinite(places[:, 0])])
        eye, eye_from_root = _eye(places, radius_m, root_from_camera, table is not None, size_px)
        return Stage(eye, eye_from_root, root_from_camera, table, _background(eye, eye_from_root, table))

    def picture(
        self,
        shape: ObjectShape | None,
        camera_from_object: Transform | None,
        path_camera_m: Float[Array, "n 3"],
        colors: tuple[tuple[int, int, int], ...],
    ) -> UInt8[Array, "s s 3"]:
        """The object at a pose (None: not drawn), and its way there in a colour per place, broken where it was lost."""
        image = self.background.copy()
        root_from_object = None if camera_from_object is None else self.root_from_camera @ camera_from_object
        if shape is not None and root_from_object is not None and self.table is not None:
            fallen = root_from_object.points(shape.vertices_m) * [1, 1, 0]
            flat = ObjectShape(ROOT, "shadow", fallen, shape.faces)
            dark = covered_pixels(flat, self.eye_from_root, self.eye)
            image[dark] = (SHADOW * image[dark]).astype(np.uint8)
        _draw_path(image, self.eye.project((self.eye_from_root @ self.root_from_camera).points(path_camera_m)), colors)
        if shape is None or root_from_object is None:
            return image
        canvas = Canvas.on(self.eye, image)
        canvas.draw(shape, self.eye_from_root @ root_from_object)
        return canvas.image()


def path_m(track: ObjectTrack, shape: ObjectShape | None) -> Float[Array, "n 3"]:
    """The way of the object's centre in the camera's frame; NaN where the pose is lost."""
    return track.camera_from_object[:, :3, :3] @ _center_m(shape) + track.camera_from_object[:, :3, 3]


def _center_m(shape: ObjectShape | None) -> Float[Array, "3"]:
    return np.zeros(3) if shape is None else 0.5 * (shape.vertices_m.min(0) + shape.vertices_m.max(0))


def _radius_m(shape: ObjectShape | None) -> float:
    if shape is None:
        return UNKNOWN_RADIUS_M
    return float(np.linalg.norm(shape.vertices_m - _center_m(shape), axis=1).max())


def _eye(
    places_m: Float[Array, "n 3"], radius_m: float, root_from_camera: Transform, on_table: bool, size_px: int
) -> tuple[CameraModel, Transform]:
    """The eye stands aside of the colour camera and looks at the middle of the way, as near as all of it allows."""
    target = places_m.mean(0) if len(places_m) else _looked_at(root_from_camera, on_table)
    reach_m = max(float(np.linalg.norm(places_m - target, axis=1).max(initial=0)) + 1.3 * radius_m, LEAST_REACH_M)
    back = (root_from_camera.translation_m - target) * [1, 1, 0]
    back = back / np.linalg.norm(back) if np.linalg.norm(back) > 1e-6 else np.array([0.0, -1.0, 0.0])
    level = rotation_exp(np.array([0, 0, ASIDE_RAD])) @ back
    towards = np.cos(UP_RAD) * level + np.array([0, 0, np.sin(UP_RAD)])
    right = np.cross([0, 0, 1.0], towards)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(-towards, right), -towards])  # rows: x right, y down, z forward
    place = target + towards * reach_m * np.hypot(1, 1 / HALF_VIEW)
    half = (size_px - 1) / 2
    K = np.array([[half / HALF_VIEW, 0, half], [0, half / HALF_VIEW, half], [0, 0, 1]])
    return CameraModel(EYE, size_px, size_px, K), Transform(EYE, ROOT, axes, -axes @ place)


def _looked_at(root_from_camera: Transform, on_table: bool) -> Float[Array, "3"]:
    """Where the camera's axis meets the table; a metre ahead where it does not."""
    ahead, place = root_from_camera.rotation[:, 2], root_from_camera.translation_m
    meets = on_table and place[2] > 0 and ahead[2] < -0.1
    return place + ahead * (place[2] / -ahead[2] if meets else 1.0)


def _background(eye: CameraModel, eye_from_root: Transform, table: Table | None) -> UInt8[Array, "s s 3"]:
    """The table through every pixel of the eye: as seen, grey where it was not seen, light where there is no table."""
    image = np.full((eye.height, eye.width, 3), FAR_RGB, dtype=np.uint8)
    if table is None:
        return image
    root_from_eye = eye_from_root.inverse()
    depth_m = _plane_depth_m(eye, root_from_eye)
    meets = np.isfinite(depth_m)
    points = root_from_eye.points(eye.pixel_rays()[meets] * depth_m[meets][:, None])
    colors, seen = table.at(points)
    image[meets] = np.where(seen[:, None], colors, np.array(TABLE_RGB, dtype=np.uint8))
    return cv2.medianBlur(image, 3).astype(np.uint8)


def _draw_path(
    image: UInt8[Array, "h w 3"], pixels: Float[Array, "n 2"], colors: tuple[tuple[int, int, int], ...]
) -> None:
    known = np.isfinite(pixels).all(axis=1)
    drawn: Int64[Array, "n 2"] = np.where(known[:, None], pixels.clip(-1e4, 1e4), 0).round().astype(np.int64)
    for k in range(1, len(drawn)):
        if known[k - 1] and known[k]:
            start, end = ([int(x) for x in drawn[j]] for j in (k - 1, k))
            cv2.line(image, start, end, colors[k], PATH_PX, cv2.LINE_AA)
