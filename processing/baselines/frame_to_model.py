"""The baseline `frame-to-model`: point-to-plane ICP of each frame to a TSDF that grows with it (KinectFusion's scheme).

It is what users have today without learned weights and without a GPU. It knows no symmetry, no features and no
several hypotheses: a cube that turns by more than 45 degrees between two frames is taken for its twin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray as Array
from scipy.spatial import cKDTree

from processing.motion.tangents import about
from processing.sensor import noise
from recordings.errors import BadInput
from recordings.geometry import CameraModel, nearest_rotation
from recordings.progress import Progress
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape, ObjectTrack, Status


@dataclass(frozen=True)
class FrameToModelSettings:
    """How the baseline tracks. Distances are for an object of some 0.1 m seen from 0.4 to 1.2 m."""

    voxel_m: float = 0.002
    """Edge of a TSDF voxel."""
    truncation_voxels: float = 6.0
    """Half width of the band around the surface, in voxels."""
    coarse_m: float = 0.02
    """Correspondences of the first ICP round."""
    fine_m: float = 0.008
    """Correspondences of the second ICP round; also what counts as agreeing."""
    most_points: int = 3000
    """Points of a frame that ICP uses."""
    least_points: int = 150
    """A frame with fewer is lost."""
    least_fitness: float = 0.5
    """A frame of whose points a smaller share agrees with the model is lost."""
    sure_fitness: float = 0.9
    """Below this share, the other starting rotation is tried as well."""
    border_px: int = 1
    """Depth this near to the mask's border is not used: it may be the background's."""
    most_steps: int = 20
    """Steps of either round."""
    still: float = 2e-5
    """ICP ends when a step is smaller than this (rad, m)."""
    edge_m: float = 0.012
    """A depth pixel this far from its neighbours' median is a flying pixel."""


@dataclass(frozen=True, eq=False)
class _View:
    """One frame cut to the object: pinhole depth and colour, and its points in the camera frame."""

    depth_m: Float32[Array, "h w"]
    color_rgb: UInt8[Array, "h w 3"]
    points_m: Float[Array, "n 3"]

    @property
    def center_m(self) -> Float[Array, "3"]:
        return 0.5 * (self.points_m.min(0) + self.points_m.max(0)) if len(self.points_m) < 10 else self.points_m.mean(0)


@dataclass(frozen=True, eq=False)
class Tracked:
    """One toss's track and the shape in the object frame of that track."""

    track: ObjectTrack
    shape: ObjectShape


class FrameToModel:
    """Tracker that aligns each frame to the model fused from the frames before it. See `Tracker`."""

    name = "frame-to-model"

    def __init__(self, settings: FrameToModelSettings | None = None) -> None:
        self._settings = settings or FrameToModelSettings()

    def track(
        self,
        toss: int,
        frames: Sequence[RgbdFrame],
        masks: Sequence[Bool[Array, "h w"]],
        camera: CameraModel,
        object_frame: str,
        progress: Progress,
    ) -> Tracked:
        """Poses `camera_from_object` of all frames, and the fused mesh. The object frame starts parallel to the
        camera at the centroid of the first masked cloud. Raises BadInput where no frame holds enough of the object."""
        s = self._settings
        poses = np.full((len(frames), 4, 4), np.nan)
        covariance = np.full((len(frames), 6, 6), np.nan)
        model: _Model | None = None
        motion = _Motion()
        times = np.zeros(len(frames), dtype=np.int64)
        flat = _Flattener(camera)
        for i in range(len(frames)):
            frame = frames[i]
            times[i] = frame.time_ns
            view = flat.view(frame, masks[i], s)
            progress.step(i + 1, len(frames), f"toss {toss}, tracking")
            if len(view.points_m) < s.least_points:
                continue
            if model is None:
                model = _Model(camera, s)
                pose, spread = _start_pose(view), np.zeros((6, 6))
            else:
                found = _align(view, model, motion.starts(view), s)
                if found is None:
                    continue
                pose, spread = found
            model.fuse(view, pose)
            motion.moved(pose, view)
            poses[i], covariance[i] = pose, spread
        if model is None:
            raise BadInput(
                f"toss {toss}: no frame holds {s.least_points} depth pixels of the object; "
                "wanted a mask that covers it and depth within it (look with `toss-view`)"
            )
        lost = np.isnan(poses[:, 0, 0])
        status: tuple[Status, ...] = tuple("lost" if x else "tracked" for x in lost)
        track = ObjectTrack(toss, camera.frame, object_frame, times, poses, status, covariance)
        return Tracked(
            track, model.shape(object_frame, f"frame-to-model TSDF of toss {toss}, {int((~lost).sum())} frames")
        )


class _Motion:
    """The last two tracked poses, from which the next one is guessed."""

    def __init__(self) -> None:
        self._poses: list[Float[Array, "4 4"]] = []
        self._center_m = np.zeros(3)

    def moved(self, pose: Float[Array, "4 4"], view: _View) -> None:
        self._poses = [*self._poses[-1:], pose]
        self._center_m = view.center_m

    def starts(self, view: _View) -> list[Float[Array, "4 4"]]:
        """Constant spin, then no spin; the shift of the visible cloud's centroid in both."""
        last = self._poses[-1]
        still = last.copy()
        still[:3, 3] += view.center_m - self._center_m
        if len(self._poses) < 2:
            return [still]
        spinning = still.copy()
        spinning[:3, :3] = last[:3, :3] @ self._poses[-2][:3, :3].T @ last[:3, :3]
        return [spinning, still]


class _Flattener:
    """Cuts frames to the object and takes lens distortion out, so that the TSDF sees a pinhole."""

    def __init__(self, camera: CameraModel) -> None:
        self._camera = camera
        u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
        self._rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
        self._map: Float32[Array, "h w 2"] | None = None
        if camera.distortion_model != "none":
            self._map = camera.project(self._rays).astype(np.float32)

    def view(self, frame: RgbdFrame, mask: Bool[Array, "h w"], s: FrameToModelSettings) -> _View:
        """Depth inside the eroded mask without flying pixels, 0 elsewhere."""
        side = 2 * s.border_px + 1
        inside = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
        depth = np.where(inside, frame.depth_m, 0).astype(np.float32)
        median = cv2.medianBlur(np.where(mask, frame.depth_m, 0).astype(np.float32), 5)
        depth[np.abs(depth - median) > s.edge_m] = 0
        color: Array = frame.color_rgb
        if self._map is not None:
            depth = cv2.remap(depth, self._map, np.empty(0), cv2.INTER_NEAREST).astype(np.float32)
            color = cv2.remap(color, self._map, np.empty(0), cv2.INTER_LINEAR)
        at = depth > 0
        points = self._rays[at] * depth[at].astype(np.float64)[:, None]
        return _View(depth, np.ascontiguousarray(color), points)


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of a surface with their normals, in the object frame."""

    points_m: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]


class _Model:
    """A TSDF in sparse blocks, and its surface points."""

    def __init__(self, camera: CameraModel, s: FrameToModelSettings) -> None:
        import open3d

        self._s = s
        self._o3d = open3d
        core = open3d.core
        half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # Open3D cuts a projected pixel to its integer part
        self._K = core.Tensor(camera.K + half)
        self._grid: Any = open3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"), (core.float32, core.float32, core.float32), ((1), (1), (3)), s.voxel_m, 8, 4000
        )

    def fuse(self, view: _View, camera_from_object: Float[Array, "4 4"]) -> None:
        """Integrate a view at its pose."""
        image = self._o3d.t.geometry.Image
        depth = image(view.depth_m)
        color = image(view.color_rgb.astype(np.float32) / 255)
        extrinsic = self._o3d.core.Tensor(camera_from_object)
        blocks = self._grid.compute_unique_block_coordinates(
            depth, self._K, extrinsic, 1.0, 10.0, self._s.truncation_voxels
        )
        hashed = self._grid.hashmap()  # all blocks, not the new ones only: what a ray passes through is carved away
        hashed.activate(blocks)
        blocks = hashed.key_tensor()[hashed.active_buf_indices().to(self._o3d.core.int64)]
        self._grid.integrate(blocks, depth, color, self._K, self._K, extrinsic, 1.0, 10.0, self._s.truncation_voxels)

    def facing(self, camera_from_object: Float[Array, "4 4"]) -> Surface:
        """What faces a camera at this pose."""
        cloud = self._grid.extract_point_cloud(weight_threshold=0.5)
        points, normals = (np.asarray(cloud.point[n].numpy(), dtype=np.float64) for n in ("positions", "normals"))
        order = np.lexsort(points.T)  # Open3D's threads leave them in any order
        points, normals = points[order], normals[order]
        eye = -camera_from_object[:3, :3].T @ camera_from_object[:3, 3]
        towards = eye - points
        facing = (towards * normals).sum(1) > 0.1 * np.linalg.norm(towards, axis=1)
        return Surface(points[facing], normals[facing])

    def shape(self, object_frame: str, source: str) -> ObjectShape:
        """The largest connected piece of the surface, with its colours."""
        mesh = self._grid.extract_triangle_mesh(weight_threshold=1.5).to_legacy()
        if len(mesh.triangles) == 0:
            mesh = self._grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
        labels, counts, _ = mesh.cluster_connected_triangles()
        if len(counts):
            mesh.remove_triangles_by_mask(np.asarray(labels) != int(np.argmax(counts)))
            mesh.remove_unreferenced_vertices()
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.triangles, dtype=np.int64)
        order = np.lexsort(vertices.T)  # Open3D's threads leave vertices and faces in any order
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        faces = _ordered_faces(rank[faces])
        rgb = np.clip(np.asarray(mesh.vertex_colors)[order] * 255 + 0.5, 0, 255).astype(np.uint8)
        return ObjectShape(object_frame, source, vertices[order], faces, rgb, np.ones(len(order), dtype=bool))


def _ordered_faces(faces: Int[Array, "f 3"]) -> Int[Array, "f 3"]:
    """Each face from its smallest vertex on, faces in order of their vertices; the winding stays."""
    if len(faces) == 0:
        return faces
    first = faces.argmin(1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, 1)
    return turned[np.lexsort(turned.T[::-1])]


def _start_pose(view: _View) -> Float[Array, "4 4"]:
    """Parallel to the camera, origin at the centroid of the visible cloud."""
    pose = np.eye(4)
    pose[:3, 3] = view.points_m.mean(0)
    return pose


def _align(
    view: _View, model: _Model, starts: Sequence[Float[Array, "4 4"]], s: FrameToModelSettings
) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]] | None:
    """Pose of a view by ICP to the model, and its covariance; None where too little agrees."""
    step = max(1, len(view.points_m) // s.most_points)
    points = view.points_m[::step]
    best: tuple[float, _Fit, Surface] | None = None
    for start in starts:
        surface = model.facing(start)
        if len(surface.points_m) < s.least_points:
            continue
        fit = align_to_surface(points, surface, np.linalg.inv(start), s)
        score = fit.fitness - 0.2 * fit.rmse_m / s.fine_m
        if best is None or score > best[0]:
            best = (score, fit, surface)
        if best[1].fitness >= s.sure_fitness:
            break
    if best is None or best[1].fitness < s.least_fitness:
        return None
    _, fit, surface = best
    pose = np.linalg.inv(fit.object_from_camera)
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    return pose, covariance_of(points[fit.pairs[:, 0]], surface.normals[fit.pairs[:, 1]], pose, fit.rmse_m * step**-0.5)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Where ICP ended. `pairs`: position of a frame's point and of the model's, within the fine reach."""

    object_from_camera: Float[Array, "4 4"]
    fitness: float
    rmse_m: float
    pairs: Int[Array, "k 2"]


def align_to_surface(
    points_m: Float[Array, "n 3"], surface: Surface, object_from_camera: Float[Array, "4 4"], s: FrameToModelSettings
) -> _Fit:
    """Two rounds of ICP of camera points to the model: Gauss-Newton on point-to-plane residuals (Chen, Medioni 1992).

    Where the visible faces slide along themselves, nothing holds them: that is this baseline's weakness.
    """
    tree = cKDTree(surface.points_m)
    at = object_from_camera
    for reach, part in ((s.coarse_m, points_m[::3]), (s.fine_m, points_m)):
        for _ in range(s.most_steps):
            moved = part @ at[:3, :3].T + at[:3, 3]
            distance, nearest = tree.query(moved, distance_upper_bound=reach)
            near = np.isfinite(distance)
            if near.sum() < 10:
                break
            step = _gauss_newton(moved[near], surface, nearest[near])
            at = about(np.zeros(3), step[:3], step[3:]) @ at
            if float(np.abs(step).max()) < s.still:
                break
    moved = points_m @ at[:3, :3].T + at[:3, 3]
    distance, nearest = tree.query(moved, distance_upper_bound=s.fine_m)
    near = np.flatnonzero(np.isfinite(distance))
    pairs = np.stack([near, nearest[near]], -1)
    off = ((moved[near] - surface.points_m[pairs[:, 1]]) * surface.normals[pairs[:, 1]]).sum(1)
    rmse = float(np.sqrt(np.mean(off**2))) if len(off) else np.inf
    return _Fit(at, len(near) / len(points_m), rmse, pairs)


def _gauss_newton(moved_m: Float[Array, "k 3"], surface: Surface, nearest: Int[Array, " k"]) -> Float[Array, "6"]:
    """The step (rotation vector, translation) that brings moved points onto the planes of their nearest points."""
    normals, gap = surface.normals[nearest], moved_m - surface.points_m[nearest]
    rows = np.hstack([np.cross(moved_m, normals), normals])
    hessian = rows.T @ rows
    gradient = rows.T @ (gap * normals).sum(1)
    return -np.linalg.solve(hessian + 1e-9 * np.trace(hessian) * np.eye(6), gradient)


def covariance_of(
    points_m: Float[Array, "k 3"], normals_object: Float[Array, "k 3"], pose: Float[Array, "4 4"], sigma_m: float
) -> Float[Array, "6 6"]:
    """Inverse of the Gauss-Newton Hessian of the point-to-plane residuals, in the camera frame.

    The pose moves as (exp(w) R, t + d); a point x on a plane with normal n gives the row [(x - t) x n, n] for (w, d).
    `sigma_m` is per pixel of the whole image, thinning taken out. Directions that no plane holds stay at 1 rad, 1 m.
    """
    normals = normals_object @ pose[:3, :3].T
    rows = np.hstack([np.cross(points_m - pose[:3, 3], normals), normals])
    information = rows.T @ rows / (noise.BASELINE_PIXELS_PER_MEASUREMENT * max(sigma_m, 1e-4) ** 2)
    return np.linalg.inv(information + np.eye(6))
