"""Reprojection: the refined shape at the estimated poses, drawn into depth images D' and masks M' (the paper's step 4).

The default renderer casts one ray per pixel (Open3D, exact, lens distortion included); Drake's, which the paper used,
stands behind the same protocol and needs the extra `sim`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt32
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame
from recordings.system_libraries import install_line
from recordings.tracks import ObjectShape

Occlusion = Literal["fill", "subtract"]
RendererName = Literal["raycast", "drake"]


@runtime_checkable
class Renderer(Protocol):
    """Draws one shape into depth images of one camera."""

    name: str

    def depth(self, camera_from_object: Float[Array, "4 4"]) -> Float32[Array, "h w"]:
        """Depth along the optical axis in metres of the shape at a pose; 0 where no ray meets it."""
        ...


@dataclass(frozen=True, eq=False)
class Hits:
    """A `box` of the image (rows, columns) in which the shape lies: depth (m; 0: no ray meets it), the face that each
    ray meets, and where on it (barycentric weights of its corners)."""

    box: tuple[slice, slice]
    depth_m: Float32[Array, "h w"]
    face: UInt32[Array, "h w"]
    weight: Float32[Array, "h w 3"]


class RaycastRenderer:
    """One ray through the centre of every pixel, against the triangles themselves."""

    name = "raycast"

    def __init__(self, shape: ObjectShape, camera: CameraModel) -> None:
        self._camera = camera
        self._rays = camera.pixel_rays()
        self.show(shape)

    def show(self, shape: ObjectShape) -> None:
        """Draws this shape from now on."""
        import open3d as o3d

        self._core: Any = o3d.core
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            o3d.core.Tensor(shape.vertices_m.astype(np.float32)), o3d.core.Tensor(shape.faces.astype(np.uint32))
        )
        self._outer_m = _outermost(shape.vertices_m, bent=self._camera.distortion_model != "none")

    def depth(self, camera_from_object: Float[Array, "4 4"]) -> Float32[Array, "h w"]:
        out = np.zeros((self._camera.height, self._camera.width), dtype=np.float32)
        box = self._box(camera_from_object)
        out[box] = _met(self._cast(camera_from_object, box))
        return out

    def hits(self, camera_from_object: Float[Array, "4 4"]) -> Hits:
        """What the rays meet where the shape may be in the image."""
        box = self._box(camera_from_object)
        found = self._cast(camera_from_object, box)
        depth_m, uv = _met(found), found["primitive_uvs"].numpy()
        face = np.where(depth_m > 0, found["primitive_ids"].numpy(), 0)
        return Hits(box, depth_m, face, np.concatenate([1 - uv.sum(-1, keepdims=True), uv], -1))

    def _cast(self, camera_from_object: Float[Array, "4 4"], box: tuple[slice, slice]) -> Any:
        object_from_camera = np.linalg.inv(camera_from_object)
        along = self._rays[box] @ object_from_camera[:3, :3].T
        rays = np.empty((*along.shape[:2], 6), dtype=np.float32)
        rays[..., :3], rays[..., 3:] = object_from_camera[:3, 3], along
        return self._scene.cast_rays(self._core.Tensor(rays))

    def _box(self, camera_from_object: Float[Array, "4 4"]) -> tuple[slice, slice]:
        """The part of the image that the shape can touch, and two pixels around it; all of it when a vertex is near or
        behind the camera."""
        points = self._outer_m @ camera_from_object[:3, :3].T + camera_from_object[:3, 3]
        whole, none = (slice(0, self._camera.height), slice(0, self._camera.width)), (slice(0, 0), slice(0, 0))
        if points[:, 2].max() <= 0:
            return none
        pixels = self._camera.project(points)
        if not np.isfinite(pixels).all():
            return whole
        low = np.floor(pixels.min(0)).astype(int) - 2
        high = np.ceil(pixels.max(0)).astype(int) + 3
        rows = slice(max(low[1], 0), min(high[1], self._camera.height))
        columns = slice(max(low[0], 0), min(high[0], self._camera.width))
        return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else none


def _met(found: Any) -> Float32[Array, "h w"]:
    """How far each ray goes; 0 where it meets nothing. Rays have z = 1, so it is depth along the axis."""
    hit = found["t_hit"].numpy()
    return np.where(np.isfinite(hit), hit, np.float32(0.0))


def _outermost(vertices_m: Float[Array, "v 3"], bent: bool, parts: int = 8) -> Float[Array, "n 3"]:
    """Points of the convex hull, the farthest out in any image: its corners, and where a lens has `bent` what lies
    between them, points along its edges."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices_m)
    except (QhullError, ValueError):  # flat, or too few
        return vertices_m
    if not bent:
        return vertices_m[hull.vertices]
    faces = hull.simplices
    ends = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1), axis=0)
    share = np.arange(parts + 1)[:, None, None] / parts
    return ((1 - share) * vertices_m[ends[:, 0]] + share * vertices_m[ends[:, 1]]).reshape(-1, 3)


class DrakeRenderer:
    """Drake's VTK renderer, as the authors used it; a distorted lens is drawn ideal and looked up at its rays."""

    name = "drake"
    WIDER = 1.15
    """How much wider than the distorted image the ideal one is drawn."""
    DENSER = 3.0
    """How many of its pixels lie along one of the distorted image's, so that the outline is as sharp."""

    def __init__(self, shape: ObjectShape, camera: CameraModel) -> None:
        import tempfile

        try:
            import pydrake.geometry  # noqa: F401
        except ImportError as missing:
            raise BadInput(
                "the drake renderer needs Drake, which is not installed; run `pip install -e .[sim]`, "
                "or leave out `--renderer drake`"
            ) from missing
        if not _opengl_driver():
            raise BadInput(
                "the drake renderer draws with OpenGL, and no driver for it was found; as root, type: "
                f"{install_line(['libegl-mesa0', 'libgl1-mesa-dri'])}, or leave out `--renderer drake`"
            )
        import trimesh

        self._camera = camera
        straight = camera.distortion_model == "none"
        self._ideal = camera if straight else _ideal_camera(camera, self.WIDER).scaled(self.DENSER)
        self._folder = tempfile.TemporaryDirectory()
        path = f"{self._folder.name}/shape.obj"
        trimesh.Trimesh(shape.vertices_m, shape.faces, process=False).export(path, include_normals=True)
        self._path = path

    def depth(self, camera_from_object: Float[Array, "4 4"]) -> Float32[Array, "h w"]:
        ideal = self._draw(camera_from_object)
        if self._ideal is self._camera:
            return ideal
        pixels = self._ideal.project(self._camera.pixel_rays()).astype(np.float32)
        return _look_up_depth(ideal, pixels)

    def _draw(self, camera_from_object: Float[Array, "4 4"]) -> Float32[Array, "h w"]:
        from pydrake.common.eigen_geometry import Isometry3
        from pydrake.geometry import (
            ClippingRange,
            DepthRange,
            DepthRenderCamera,
            GeometryInstance,
            MakeRenderEngineVtk,
            Mesh,
            PerceptionProperties,
            RenderCameraCore,
            RenderEngineVtkParams,
            RenderLabel,
            Rgba,
            SceneGraph,
        )
        from pydrake.math import RigidTransform
        from pydrake.systems.sensors import CameraInfo

        c = self._ideal
        scene = SceneGraph()
        scene.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
        source = scene.RegisterSource("tosslab")
        pose = RigidTransform(Isometry3(camera_from_object))
        instance = GeometryInstance(pose, Mesh(self._path, 1.0), "shape")
        properties = PerceptionProperties()
        properties.AddProperty("label", "id", RenderLabel(1))
        properties.AddProperty("phong", "diffuse", Rgba(1, 1, 1, 1))
        instance.set_perception_properties(properties)
        scene.RegisterAnchoredGeometry(source, instance)
        # Drake's image coordinates put the centre of the first pixel at (0.5, 0.5)
        info = CameraInfo(c.width, c.height, c.fx, c.fy, c.cx + 0.5, c.cy + 0.5)
        core = RenderCameraCore("vtk", info, ClippingRange(0.05, 5.0), RigidTransform())
        context = scene.CreateDefaultContext()
        query = scene.get_query_output_port().Eval(context)
        image = query.RenderDepthImage(
            DepthRenderCamera(core, DepthRange(0.06, 4.9)), scene.world_frame_id(), RigidTransform()
        )
        depth_m = np.array(image.data)[..., 0]
        return np.where(np.isfinite(depth_m), depth_m, 0).astype(np.float32)


def _opengl_driver() -> bool:
    """Whether EGL has any driver at all: VTK does not ask, and the process ends in a segmentation fault."""
    import ctypes
    import sys

    if not sys.platform.startswith("linux"):
        return True  # the system's own
    try:
        egl = ctypes.CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglQueryString.restype = ctypes.c_char_p
    no_display, extensions = None, 0x3055  # EGL_NO_DISPLAY, EGL_EXTENSIONS
    return bool(egl.eglQueryString(no_display, extensions))  # no client extensions: no vendor's library behind it


def _look_up_depth(depth_m: Float32[Array, "h w"], pixels: Float32[Array, "hc wc 2"]) -> Float32[Array, "hc wc"]:
    """Depth between pixels: inverse depth is linear over a plane; at the outline the nearest pixel decides."""
    import cv2

    drawn = (depth_m > 0).astype(np.float32)
    inverse = np.divide(1, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
    u, v = pixels[..., 0], pixels[..., 1]
    share, between = cv2.remap(drawn, u, v, cv2.INTER_LINEAR), cv2.remap(inverse, u, v, cv2.INTER_LINEAR)
    nearest = cv2.remap(depth_m, u, v, cv2.INTER_NEAREST)
    whole = share > 0.999
    return np.where(whole, 1 / np.where(whole, between, 1), nearest).astype(np.float32)


def _ideal_camera(camera: CameraModel, wider: float) -> CameraModel:
    """A pinhole camera with the same focal length that sees more than the distorted image does."""
    width, height = int(camera.width * wider), int(camera.height * wider)
    K = camera.K.copy()
    K[0, 2] += (width - camera.width) / 2
    K[1, 2] += (height - camera.height) / 2
    return replace(camera, width=width, height=height, K=K, distortion_model="none", distortion=())


def make_renderer(name: RendererName, shape: ObjectShape, camera: CameraModel) -> Renderer:
    """A renderer by its name. Raises BadInput when the package it needs is missing."""
    return RaycastRenderer(shape, camera) if name == "raycast" else DrakeRenderer(shape, camera)


@dataclass(frozen=True, eq=False)
class Reprojection:
    """What one frame looks like with the learned shape in it.

    `depth_m` (D') is 0 outside `mask` (M'). `colorless` marks pixels of the mask where something else (the robot)
    stands in front: the shape is there, but the picture's colour is not the object's.
    """

    depth_m: Float32[Array, "h w"]
    mask: Bool[Array, "h w"]
    colorless: Bool[Array, "h w"]

    def frame(self, raw: RgbdFrame) -> RgbdFrame:
        """The raw frame with D' in place of its depth inside M'; its own depth stays outside."""
        return replace(raw, depth_m=np.where(self.mask, self.depth_m, raw.depth_m).astype(np.float32))


def reproject(
    renderer: Renderer,
    camera_from_object: Float[Array, "4 4"],
    occluder: Bool[Array, "h w"] | None = None,
    occlusion: Occlusion = "fill",
) -> Reprojection:
    """D' and M' of one frame.

    `fill` (the paper's text) keeps the shape where the occluder hides it and marks it colourless; `subtract` (the
    authors' code) cuts the occluder out of both.
    """
    depth_m = renderer.depth(camera_from_object)
    mask = depth_m > 0
    hidden = mask & occluder if occluder is not None else np.zeros_like(mask)
    if occlusion == "subtract":
        mask = mask & ~hidden
        return Reprojection(np.where(mask, depth_m, 0).astype(np.float32), mask, np.zeros_like(mask))
    return Reprojection(depth_m, mask, hidden)
