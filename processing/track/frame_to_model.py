"""The baseline `frame-to-model`: point-to-plane ICP of each frame to a TSDF that grows with it (KinectFusion's scheme).

It is what users have today without learned weights and without a GPU. It knows no symmetry, no features and no
several hypotheses: a cube that turns by more than 45 degrees between two frames is taken for its twin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray as Array

from processing.track.tracker import Tracked
from recordings.errors import BadInput
from recordings.geometry import CameraModel, nearest_rotation
from recordings.progress import Progress
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape, ObjectTrack, Status

if TYPE_CHECKING:
    import open3d

CORRELATED_PX = 9.0
"""Neighbouring depth pixels share their noise: so many count as one measurement in the covariance."""


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
        """Poses of all frames and the fused mesh. See `Tracker.track`."""
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
        """Constant spin, then no spin; the shift of the visible cloud's middle in both."""
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


class _Model:
    """A TSDF in sparse blocks, and its surface points."""

    def __init__(self, camera: CameraModel, s: FrameToModelSettings) -> None:
        import open3d

        self._s = s
        self._o3d = open3d
        core = open3d.core
        self._K = core.Tensor(camera.K)
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

    def facing(self, camera_from_object: Float[Array, "4 4"]) -> open3d.geometry.PointCloud:
        """Surface points with normals that face a camera at this pose, in the object frame."""
        cloud = self._grid.extract_point_cloud(weight_threshold=0.5).to_legacy()
        eye = -camera_from_object[:3, :3].T @ camera_from_object[:3, 3]
        towards = eye - np.asarray(cloud.points)
        facing = (towards * np.asarray(cloud.normals)).sum(1) > 0.1 * np.linalg.norm(towards, axis=1)
        return cloud.select_by_index(np.flatnonzero(facing))

    def shape(self, object_frame: str, source: str) -> ObjectShape:
        """The largest connected piece of the surface, with its colours."""
        mesh = self._grid.extract_triangle_mesh(weight_threshold=1.5).to_legacy()
        if len(mesh.triangles) == 0:
            mesh = self._grid.extract_triangle_mesh(weight_threshold=0.5).to_legacy()
        labels, counts, _ = mesh.cluster_connected_triangles()
        if len(counts):
            mesh.remove_triangles_by_mask(np.asarray(labels) != int(np.argmax(counts)))
            mesh.remove_unreferenced_vertices()
        rgb = np.clip(np.asarray(mesh.vertex_colors) * 255 + 0.5, 0, 255).astype(np.uint8)
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        faces = np.asarray(mesh.triangles, dtype=np.int64)
        return ObjectShape(object_frame, source, vertices, faces, rgb, np.ones(len(vertices), dtype=bool))


def _start_pose(view: _View) -> Float[Array, "4 4"]:
    """Parallel to the camera, origin at the middle of the visible cloud."""
    pose = np.eye(4)
    pose[:3, 3] = view.points_m.mean(0)
    return pose


def _align(
    view: _View, model: _Model, starts: Sequence[Float[Array, "4 4"]], s: FrameToModelSettings
) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]] | None:
    """Pose of a view by ICP to the model, and its covariance; None where too little agrees."""
    step = max(1, len(view.points_m) // s.most_points)
    points = view.points_m[::step]
    best: tuple[float, Float[Array, "4 4"], Any, Any] | None = None
    for start in starts:
        cloud = model.facing(start)
        if len(cloud.points) < s.least_points:
            continue
        result = _icp(points, cloud, np.linalg.inv(start), s)
        score = result.fitness - result.inlier_rmse / s.fine_m * 0.2
        if np.isfinite(result.transformation).all() and (best is None or score > best[0]):
            best = (score, np.linalg.inv(result.transformation), result, cloud)
        if best is not None and best[2].fitness >= s.sure_fitness:
            break
    if best is None or best[2].fitness < s.least_fitness:
        return None
    _, pose, result, cloud = best
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    return pose, _covariance(
        points, cloud, np.asarray(result.correspondence_set), pose, result.inlier_rmse * step**-0.5
    )


def _icp(
    points_m: Float[Array, "n 3"], cloud: Any, object_from_camera: Float[Array, "4 4"], s: FrameToModelSettings
) -> Any:
    """Two rounds of point-to-plane ICP of camera points to the model's points."""
    import open3d

    registration = open3d.pipelines.registration
    source = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points_m))
    at = object_from_camera
    for reach, most in ((s.coarse_m, 40), (s.fine_m, 30)):
        plane = registration.TransformationEstimationPointToPlane()
        stop = registration.ICPConvergenceCriteria(1e-6, 1e-6, most)
        result = registration.registration_icp(source, cloud, reach, at, plane, stop)
        at = result.transformation
    return result


def _covariance(
    points_m: Float[Array, "n 3"], cloud: Any, pairs: Any, pose: Float[Array, "4 4"], sigma_m: float
) -> Float[Array, "6 6"]:
    """Inverse of the Gauss-Newton Hessian of the point-to-plane residuals, in the camera frame.

    The pose moves as (exp(w) R, t + d); a point x on a plane with normal n gives the row [(x - t) x n, n] for (w, d).
    `sigma_m` is per pixel of the whole image, thinning taken out. Directions that no plane holds stay at 1 rad, 1 m.
    """
    normals = np.asarray(cloud.normals)[pairs[:, 1]] @ pose[:3, :3].T
    arms = points_m[pairs[:, 0]] - pose[:3, 3]
    rows = np.hstack([np.cross(arms, normals), normals])
    information = rows.T @ rows / (CORRELATED_PX * max(sigma_m, 1e-4) ** 2)
    return np.linalg.inv(information + np.eye(6))
