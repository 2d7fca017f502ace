"""What the field learns from: cropped, undistorted views of the object with its pose at both exposure times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8
from numpy import ndarray as Array
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame

MARGIN_PX = 12
"""Pixels kept around the mask: rays that pass the object tell where it is not."""
EDGE_PX = 2
"""Half width of the band along the mask's border that tells nothing: mixed pixels, fattened depth edges."""


@dataclass(frozen=True, eq=False)
class FieldView:
    """One masked RGBD view, undistorted and cropped. `K` belongs to the crop.

    `depth_m` is 0 where there is no trustworthy return on the object. `plane` is the local surface in camera
    coordinates as n with n . X = 1 (fitted to inverse depth). `outside` marks rays that surely pass the object,
    `unmasked` all that are not the mask's; neither where something may hide it.
    `camera_from_object` is the pose at the colour exposure, `camera_from_object_at_depth` at the depth exposure, to
    which colours and masks are moved: as a plane at the object's median depth moves.
    `colorless` marks pixels whose colour is not the object's (None: there are none). `weight` is how much the view
    counts against one whose pose is sure (1).
    """

    K: Float[Array, "3 3"]
    color_rgb: UInt8[Array, "h w 3"]
    depth_m: Float32[Array, "h w"]
    plane: Float32[Array, "h w 3"]
    inside: Bool[Array, "h w"]
    outside: Bool[Array, "h w"]
    unmasked: Bool[Array, "h w"]
    camera_from_object: Float[Array, "4 4"]
    camera_from_object_at_depth: Float[Array, "4 4"]
    colorless: Bool[Array, "h w"] | None = None
    weight: float = 1.0

    def posed(self, at_color: Float[Array, "4 4"], at_depth: Float[Array, "4 4"]) -> FieldView:
        return replace(self, camera_from_object=at_color, camera_from_object_at_depth=at_depth)


def make_view(
    frame: RgbdFrame,
    mask: Bool[Array, "h w"],
    camera: CameraModel,
    camera_from_object: Float[Array, "4 4"],
    camera_from_object_at_depth: Float[Array, "4 4"],
    hidden: Bool[Array, "h w"] | None = None,
    colorless: Bool[Array, "h w"] | None = None,
) -> FieldView | None:
    """Cut a view out of a frame; None when the mask is empty. `hidden`: pixels of something that may stand in front
    of the object (the robot): their rays tell nothing. `colorless`: pixels of the mask that show its colour instead of
    the object's. Raises BadInput for a mask of another size."""
    if mask.shape != frame.depth_m.shape:
        raise BadInput(f"frame {frame.index}: a mask of {mask.shape}, the image has {frame.depth_m.shape}")
    pinhole = replace(camera, distortion_model="none", distortion=())
    maps = _undistortion(camera, pinhole)
    mask = _remap(mask.astype(np.uint8), maps, cv2.INTER_NEAREST) > 0
    if not mask.any():
        return None
    depth_m, color_rgb = _remap(frame.depth_m, maps, cv2.INTER_NEAREST), _remap(frame.color_rgb, maps, cv2.INTER_LINEAR)
    foreign = None
    if colorless is not None and colorless.any():
        foreign = _dilate(_remap(colorless.astype(np.uint8), maps, cv2.INTER_NEAREST) > 0, 1)
    motion = camera_from_object_at_depth @ np.linalg.inv(camera_from_object)
    seen, moved = depth_m[mask & (depth_m > 0)], np.eye(3)
    if len(seen) and not np.allclose(motion, np.eye(4), atol=1e-6):
        moved = _plane_motion(motion, float(np.median(seen)), camera.K)
        mask = _warped(mask.astype(np.uint8), moved, cv2.INTER_NEAREST, _whole(mask)) > 0
        if not mask.any():
            return None
    ys, xs = np.nonzero(mask)
    box = (
        slice(max(ys.min() - MARGIN_PX, 0), min(ys.max() + MARGIN_PX + 1, mask.shape[0])),
        slice(max(xs.min() - MARGIN_PX, 0), min(xs.max() + MARGIN_PX + 1, mask.shape[1])),
    )
    mask, color_rgb = mask[box], _warped(color_rgb, moved, cv2.INTER_LINEAR, box)
    if foreign is not None:
        foreign = _warped(foreign.astype(np.uint8), moved, cv2.INTER_NEAREST, box) > 0
    K = camera.K.copy()
    K[0, 2] -= box[1].start
    K[1, 2] -= box[0].start
    inside, outside, unmasked = _erode(mask, EDGE_PX // 2), ~_dilate(mask, EDGE_PX), ~mask
    if hidden is not None:
        open_px = ~_dilate(_remap(hidden.astype(np.uint8), maps, cv2.INTER_NEAREST)[box] > 0, EDGE_PX)
        outside, unmasked = outside & open_px, unmasked & open_px
    depth_m, plane = _trusted(np.where(inside, depth_m[box], 0).astype(np.float32), K)
    return FieldView(
        K, color_rgb, depth_m, plane, inside, outside, unmasked, camera_from_object, camera_from_object_at_depth,
        foreign,
    )  # fmt: skip


def _plane_motion(motion: Float[Array, "4 4"], depth_m: float, K: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Homography by which a plane that faces the camera at this depth is seen to make the motion (camera frame)."""
    plane = motion[:3, :3] + np.outer(motion[:3, 3], [0.0, 0.0, 1.0 / depth_m])
    return np.asarray(K @ plane @ np.linalg.inv(K))


def _warped(image: Array, homography: Float[Array, "3 3"], how: int, box: tuple[slice, slice]) -> Array:
    """The image moved by a homography, in a box (rows, columns) of it."""
    rows, columns = box
    if np.array_equal(homography, np.eye(3)):
        return image[box]
    to_box = np.array([[1.0, 0.0, -columns.start], [0.0, 1.0, -rows.start], [0.0, 0.0, 1.0]])
    size = (int(columns.stop - columns.start), int(rows.stop - rows.start))
    return np.asarray(cv2.warpPerspective(image, to_box @ homography, size, flags=how))


def _whole(image: Array) -> tuple[slice, slice]:
    return slice(0, image.shape[0]), slice(0, image.shape[1])


def object_box(views: Sequence[FieldView], trim: float = 0.002) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Low and high corner, in the object frame, of the box round all depth points but the outermost share `trim`."""
    clouds = [object_points(v) for v in views]
    points_m = np.concatenate([c for c in clouds if len(c)]) if any(len(c) for c in clouds) else np.zeros((0, 3))
    if len(points_m) < 100:
        raise BadInput(f"only {len(points_m)} depth points on the object in {len(views)} views; wanted at least 100")
    return np.quantile(points_m, trim, axis=0), np.quantile(points_m, 1 - trim, axis=0)


STRAY_CELL_M = 0.008
"""Width of the cells in which points are counted; pieces with fewer than `STRAY_GAP` of them between each other are
one."""
STRAY_GAP = 3
STRAY_SHARE = 0.25
"""Of the views that saw the largest piece, counted in each of its cells: a piece apart from it that so many did not see
is none of the object's."""


def without_strays(views: Sequence[FieldView]) -> list[FieldView]:
    """The views without depth far beside what most of them show: of what is seen past the edge of a mask, or through it
    where depth is exposed at another time than colour. It lies elsewhere on the body in each view.

    Left in, it makes the grid large and the hull of what was seen larger, and may outgrow the object.
    """
    cells = [_cells(object_points(view)) for view in views]
    each, times_seen = np.unique(np.concatenate([np.unique(c) for c in cells] or [np.zeros(0)]), return_counts=True)
    count, piece = _pieces(each.astype(np.int64))
    if count <= 1:
        return list(views)
    evidence = np.bincount(piece, weights=times_seen)
    kept = each[(evidence >= STRAY_SHARE * evidence.max())[piece]]
    return [_without(view, ~np.isin(own, kept)) for view, own in zip(views, cells)]


CELL_BITS = 21
"""A cell's place along each axis, in one number: unique numbers are found ten times as fast as unique rows."""


def _cells(points_m: Float[Array, "n 3"]) -> Int64[Array, " n"]:
    at = np.floor(points_m / STRAY_CELL_M).astype(np.int64) + (1 << (CELL_BITS - 1))
    return np.asarray((at[:, 0] << 2 * CELL_BITS) | (at[:, 1] << CELL_BITS) | at[:, 2])


def _pieces(cells: Int64[Array, " m"]) -> tuple[int, Int64[Array, " m"]]:
    """How many pieces cells make, and which one each belongs to."""
    last = (1 << CELL_BITS) - 1
    at = np.stack([cells >> 2 * CELL_BITS, (cells >> CELL_BITS) & last, cells & last], axis=1)
    near = cKDTree(at).query_pairs(STRAY_GAP, p=np.inf, output_type="ndarray")
    joined = coo_array((np.ones(len(near)), tuple(near.T)), shape=(len(cells), len(cells)))
    count, piece = connected_components(joined, directed=False)
    return int(count), piece.astype(np.int64)


def _without(view: FieldView, stray: Bool[Array, " n"]) -> FieldView:
    """The view without these of its depth points."""
    if not stray.any():
        return view
    depth_m = view.depth_m.copy()
    v, u = np.nonzero(depth_m)
    depth_m[v[stray], u[stray]] = 0
    return replace(view, depth_m=depth_m)


def object_surface(view: FieldView) -> Float[Array, "n 2 3"]:
    """The view's depth points in the object frame, and the surface's normals there."""
    v, u = np.nonzero(view.depth_m)
    normal = view.plane[v, u] / np.maximum(np.linalg.norm(view.plane[v, u], axis=1, keepdims=True), 1e-9)
    return np.stack([object_points(view), normal @ view.camera_from_object_at_depth[:3, :3]], axis=1)


def object_points(view: FieldView) -> Float[Array, "n 3"]:
    """The view's depth points in the object frame."""
    v, u = np.nonzero(view.depth_m)
    z = view.depth_m[v, u].astype(np.float64)
    in_camera = np.stack([(u - view.K[0, 2]) / view.K[0, 0] * z, (v - view.K[1, 2]) / view.K[1, 1] * z, z], -1)
    pose = view.camera_from_object_at_depth
    return (in_camera - pose[:3, 3]) @ pose[:3, :3]


def _trusted(
    depth_m: Float32[Array, "h w"], K: Float[Array, "3 3"], window: int = 7, steepest: float = 0.15
) -> tuple[Float32[Array, "h w"], Float32[Array, "h w 3"]]:
    """Depth without flying pixels and grazing surfaces, and the local plane n (n . X = 1) of each pixel.

    Over a plane 1/z is linear in pixel coordinates: 1/z = n . (x, y, 1), fitted by least squares in a window.
    """
    h, w = depth_m.shape
    valid = depth_m > 0
    inverse = np.where(valid, 1.0 / np.maximum(depth_m, 1e-3), 0.0)
    x = np.broadcast_to((np.arange(w) - K[0, 2]) / K[0, 0], (h, w))
    y = np.broadcast_to(((np.arange(h) - K[1, 2]) / K[1, 1])[:, None], (h, w))
    basis = np.stack([x, y, np.ones((h, w))], -1)
    normal_matrix, right = np.empty((h, w, 3, 3)), np.empty((h, w, 3))
    for i in range(3):
        right[..., i] = _box(basis[..., i] * inverse, window)
        for j in range(3):
            normal_matrix[..., i, j] = _box(basis[..., i] * basis[..., j] * valid, window)
    scale = np.trace(normal_matrix, axis1=-2, axis2=-1)
    solvable = valid & (_box(valid.astype(np.float64), window) > 0.4)
    plane = np.zeros((h, w, 3))
    safe = normal_matrix[solvable] + 1e-9 * scale[solvable, None, None] * np.eye(3)
    plane[solvable] = np.linalg.solve(safe, right[solvable][..., None])[..., 0]
    fitted = (plane * basis).sum(-1)
    length = np.linalg.norm(plane, axis=-1)
    facing = fitted / np.maximum(length * np.linalg.norm(basis, axis=-1), 1e-9)
    on_surface = np.abs(inverse - fitted) < 0.008 * inverse
    keep = solvable & (facing > steepest) & on_surface
    plane = plane * np.where(keep, inverse / np.where(keep, fitted, 1.0), 0.0)[..., None]
    return np.where(keep, depth_m, 0).astype(np.float32), plane.astype(np.float32)


def _box(values: Float[Array, "h w"], window: int) -> Float[Array, "h w"]:
    return cv2.boxFilter(values, cv2.CV_64F, (window, window), normalize=True, borderType=cv2.BORDER_CONSTANT)


def _erode(mask: Bool[Array, "h w"], by: int) -> Bool[Array, "h w"]:
    kernel = np.ones((2 * by + 1, 2 * by + 1), np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0


def _dilate(mask: Bool[Array, "h w"], by: int) -> Bool[Array, "h w"]:
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * by + 1, 2 * by + 1), np.uint8)) > 0


def _undistortion(camera: CameraModel, pinhole: CameraModel) -> tuple[Array, Array] | None:
    """Maps for cv2.remap; None for a camera without distortion."""
    if camera.distortion_model == "none":
        return None
    key = (camera.distortion_model, camera.distortion, camera.K.tobytes(), camera.width, camera.height)
    if key not in _MAPS:
        source = camera.project(pinhole.pixel_rays()).astype(np.float32)
        _MAPS.clear()
        _MAPS[key] = (source[..., 0].copy(), source[..., 1].copy())
    return _MAPS[key]


_MAPS: dict[tuple[object, ...], tuple[Array, Array]] = {}


def _remap(image: Array, maps: tuple[Array, Array] | None, how: int) -> Array:
    if maps is None:
        return image
    return cv2.remap(image, maps[0], maps[1], how, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
