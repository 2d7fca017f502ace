"""Rigid transforms that know their frames, and camera models with lens distortion.

Conventions: right-handed frames, metres, radians, quaternions wxyz. A camera's optical frame is OpenCV's
(x right, y down, z forward) and the centre of pixel (0, 0) lies at (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from recordings.errors import BadInput, FrameMismatch

ORTHONORMAL_TOLERANCE = 1e-6


@dataclass(frozen=True, eq=False)
class Transform:
    """Maps points of frame `source` to frame `target`. Name it `target_from_source`."""

    target: str
    source: str
    rotation: Float[Array, "3 3"]
    translation_m: Float[Array, "3"]

    def __post_init__(self) -> None:
        rotation = np.asarray(self.rotation, dtype=np.float64)
        translation_m = np.asarray(self.translation_m, dtype=np.float64)
        if not (np.isfinite(rotation).all() and np.isfinite(translation_m).all()):
            raise BadInput(f"{self} holds NaN or infinity; wanted finite numbers")
        off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if off > ORTHONORMAL_TOLERANCE or np.linalg.det(rotation) < 0:
            raise BadInput(
                f"{self}: not a rotation matrix (off by {off:.1e}, determinant {np.linalg.det(rotation):.3f})"
            )
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation_m", translation_m)

    def __str__(self) -> str:
        return f"{self.target}_from_{self.source}"

    def __matmul__(self, inner: Transform) -> Transform:
        if self.source != inner.target:
            raise FrameMismatch(f"cannot chain {self} with {inner}: '{self.source}' does not meet '{inner.target}'")
        return Transform(
            self.target,
            inner.source,
            self.rotation @ inner.rotation,
            self.rotation @ inner.translation_m + self.translation_m,
        )

    def inverse(self) -> Transform:
        return Transform(self.source, self.target, self.rotation.T, -self.rotation.T @ self.translation_m)

    def points(self, points_m: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """Move positions: rotate, then shift."""
        return points_m @ self.rotation.T + self.translation_m

    def vectors(self, vectors: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """Turn directions and velocities: rotate only."""
        return vectors @ self.rotation.T

    @property
    def matrix(self) -> Float[Array, "4 4"]:
        """Homogeneous 4x4 matrix."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation, self.translation_m
        return out

    @property
    def quaternion_wxyz(self) -> Float[Array, "4"]:
        """Unit quaternion with w >= 0."""
        return quaternion_from_rotation(self.rotation)

    @staticmethod
    def identity(target: str, source: str) -> Transform:
        return Transform(target, source, np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(target: str, source: str, matrix: Float[Array, "4 4"]) -> Transform:
        """From a homogeneous matrix; a rotation off by rounding (up to 1e-3) is projected onto SO(3)."""
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise BadInput(f"{target}_from_{source}: wanted a finite 4x4 matrix, found shape {matrix.shape}")
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
            raise BadInput(f"{target}_from_{source}: the last row is {matrix[3]}, wanted 0 0 0 1")
        return Transform(target, source, nearest_rotation(matrix[:3, :3]), matrix[:3, 3].copy())

    @staticmethod
    def from_quaternion(
        target: str, source: str, quaternion_wxyz: Float[Array, "4"], translation_m: Float[Array, "3"]
    ) -> Transform:
        return Transform(
            target, source, rotation_from_quaternion(quaternion_wxyz), np.array(translation_m, dtype=np.float64)
        )


def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation nearest to a matrix that is one up to rounding. Raises BadInput beyond 1e-3."""
    u, _, vt = np.linalg.svd(matrix)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    off = float(np.abs(rotation - matrix).max())
    if off > 1e-3:
        raise BadInput(f"not a rotation matrix: off by {off:.2g}; wanted orthonormal columns and determinant +1")
    return rotation if off > 1e-12 else matrix.copy()  # what is exact comes back from a file to the last bit


def rigid_fit(source_m: Float[Array, "*b n 3"], target_m: Float[Array, "*b n 3"]) -> Float[Array, "*b 4 4"]:
    """Least-squares rotation and shift that lay source on target (Kabsch 1976), for any number of sets at once."""
    a, b = source_m.mean(-2, keepdims=True), target_m.mean(-2, keepdims=True)
    u, _, vt = np.linalg.svd(np.swapaxes(source_m - a, -1, -2) @ (target_m - b))
    v, ut = np.swapaxes(vt, -1, -2), np.swapaxes(u, -1, -2)
    sign = np.ones((*u.shape[:-2], 3))
    sign[..., 2] = np.sign(np.linalg.det(v @ ut))
    out = np.zeros((*u.shape[:-2], 4, 4))
    out[..., :3, :3] = (v * sign[..., None, :]) @ ut
    out[..., :3, 3] = b[..., 0, :] - (out[..., :3, :3] @ a[..., 0, :, None])[..., 0]
    out[..., 3, 3] = 1
    return out


def rotation_from_quaternion(quaternion_wxyz: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation of a quaternion wxyz of any non-zero length. Raises BadInput for zero or NaN."""
    q = np.asarray(quaternion_wxyz, dtype=np.float64)
    length = float(np.linalg.norm(q))
    if not np.isfinite(length) or length < 1e-9:
        raise BadInput(f"quaternion {q} has no direction; wanted four finite numbers w x y z, not all zero")
    w, x, y, z = q / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(rotation: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """Unit quaternion wxyz with w >= 0 (Shepperd's method: the largest component first, so pi is no trouble)."""
    m = np.asarray(rotation, dtype=np.float64)
    squares = np.array(
        [
            1 + m[0, 0] + m[1, 1] + m[2, 2],
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
        ]
    )
    pairs = np.array(
        [
            [0.0, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 0.0, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 0.0, m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 0.0],
        ]
    )
    largest = int(squares.argmax())
    q = pairs[largest].copy()
    q[largest] = squares[largest]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def skew(vector: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The matrix of the cross product: skew(a) @ b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(rotation_vector_rad: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rodrigues' formula: rotation by |v| about v. Exact to rounding also near 0 and pi."""
    v = np.asarray(rotation_vector_rad, dtype=np.float64)
    half = 0.5 * float(np.linalg.norm(v))
    return rotation_from_quaternion(np.concatenate([[np.cos(half)], 0.5 * np.sinc(half / np.pi) * v]))


def rotation_log(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Rotation vector of length <= pi (the inverse of rotation_exp)."""
    w, *xyz = quaternion_from_rotation(rotation)
    vector = np.array(xyz)
    length = float(np.linalg.norm(vector))
    if length < 1e-12:
        return 2.0 * vector
    return 2.0 * np.arctan2(length, w) / length * vector


def rotation_angle_rad(rotation: Float[Array, "3 3"]) -> float:
    """Geodesic angle of a rotation, 0..pi."""
    return float(np.linalg.norm(rotation_log(rotation)))


DistortionModel = Literal["none", "brown-conrady", "rational", "fisheye"]
COEFFICIENTS: dict[DistortionModel, int] = {"none": 0, "brown-conrady": 5, "rational": 8, "fisheye": 4}
UNDISTORT_STEPS = 30
UNDISTORT_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class CameraModel:
    """A pinhole camera with lens distortion, in OpenCV's conventions.

    `distortion_model` and its coefficients in order: `none` (); `brown-conrady` (k1 k2 p1 p2 k3);
    `rational` (k1 k2 p1 p2 k3 k4 k5 k6); `fisheye` (k1 k2 k3 k4, Kannala and Brandt 2006, equidistant).
    `frame` is the optical frame that its points are in.
    """

    frame: str
    width: int
    height: int
    K: Float[Array, "3 3"]
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        wanted = COEFFICIENTS.get(self.distortion_model)
        if wanted is None:
            raise BadInput(
                f"camera {self.frame}: unknown distortion model '{self.distortion_model}'; wanted {list(COEFFICIENTS)}"
            )
        if len(self.distortion) != wanted:
            found = len(self.distortion)
            raise BadInput(f"camera {self.frame}: {self.distortion_model} takes {wanted} coefficients, found {found}")
        object.__setattr__(self, "K", np.asarray(self.K, dtype=np.float64))
        object.__setattr__(self, "distortion", tuple(float(k) for k in self.distortion))
        for problem in self.problems():
            raise BadInput(f"camera {self.frame}: {problem}")

    def problems(self) -> list[str]:
        """What makes these intrinsics implausible, in words; empty when all is well."""
        found = []
        if self.width < 1 or self.height < 1:
            return [f"image size {self.width}x{self.height}; wanted at least 1x1"]
        if self.K.shape != (3, 3):
            return [f"a camera matrix of shape {self.K.shape}; wanted 3x3"]
        if not np.isfinite(self.K).all() or not np.isfinite(self.distortion).all():
            return ["NaN or infinity in the intrinsics; wanted finite numbers"]
        if min(self.fx, self.fy) <= 0:
            found.append(f"focal length {self.fx:g}, {self.fy:g} px; wanted positive numbers")
        if not (0 <= self.cx <= self.width - 1 and 0 <= self.cy <= self.height - 1):
            found.append(
                f"principal point ({self.cx:g}, {self.cy:g}) lies outside the {self.width}x{self.height} image; "
                "check that the camera matrix belongs to this resolution"
            )
        return found

    @property
    def fx(self) -> float:
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        return float(self.K[1, 2])

    def scaled(self, factor: float) -> CameraModel:
        """The same lens seen by an image resized by `factor` (pixel centres at integers)."""
        K = self.K.copy()
        K[:2, :2] *= factor
        K[:2, 2] = (K[:2, 2] + 0.5) * factor - 0.5
        return replace(self, width=round(self.width * factor), height=round(self.height * factor), K=K)

    def project(self, points_m: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
        """Pixels of points in the optical frame. Points at or behind the camera give NaN."""
        points_m = np.asarray(points_m, dtype=np.float64)
        z = np.where(points_m[..., 2:] > 1e-9, points_m[..., 2:], np.nan)
        return self._pixels(self._distort(points_m[..., :2] / z))

    def rays(self, pixels: Float[Array, "*n 2"]) -> Float[Array, "*n 3"]:
        """Directions (x, y, 1) in the optical frame through pixels: multiply by depth along the axis for points.

        x and y are NaN for a pixel that no ray reaches through this lens (outside its distortion's valid range).
        """
        pixels = np.asarray(pixels, dtype=np.float64)
        y = (pixels[..., 1] - self.cy) / self.fy
        x = (pixels[..., 0] - self.cx - self.K[0, 1] * y) / self.fx
        ideal = (
            _invert(self._distort, np.stack([x, y], -1)) if self.distortion_model != "none" else np.stack([x, y], -1)
        )
        return np.concatenate([ideal, np.ones_like(ideal[..., :1])], -1)

    def back_project(self, pixels: Float[Array, "*n 2"], depth_m: Float[Array, "*n"]) -> Float[Array, "*n 3"]:
        """Points in the optical frame seen at `pixels` with depth along the optical axis."""
        return self.rays(pixels) * np.asarray(depth_m, dtype=np.float64)[..., None]

    def pixel_rays(self) -> Float[Array, "h w 3"]:
        """The ray (x, y, 1) of every pixel."""
        u, v = np.meshgrid(np.arange(self.width, dtype=np.float64), np.arange(self.height, dtype=np.float64))
        return self.rays(np.stack([u, v], -1))

    def sees(self, pixels: Float[Array, "*n 2"]) -> Bool[Array, "*n"]:
        """Whether each pixel position lies on the image (NaN: no)."""
        u, v = pixels[..., 0], pixels[..., 1]
        return (u >= -0.5) & (u <= self.width - 0.5) & (v >= -0.5) & (v <= self.height - 0.5)

    def _pixels(self, xy: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        u = self.fx * xy[..., 0] + self.K[0, 1] * xy[..., 1] + self.cx
        return np.stack([u, self.fy * xy[..., 1] + self.cy], -1)

    def _distort(self, xy: Float[Array, "*n 2"]) -> Float[Array, "*n 2"]:
        if self.distortion_model == "none":
            return xy
        if self.distortion_model == "fisheye":
            return _distort_fisheye(xy, self.distortion)
        return _distort_radial(xy, self.distortion)


def _distort_radial(xy: Float[Array, "*n 2"], k: tuple[float, ...]) -> Float[Array, "*n 2"]:
    """Brown-Conrady (5) and rational (8) model in OpenCV's order k1 k2 p1 p2 k3 [k4 k5 k6]."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*k, 0.0, 0.0, 0.0)[:8]
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([x * radial + dx, y * radial + dy], -1)


def _distort_fisheye(xy: Float[Array, "*n 2"], k: tuple[float, ...]) -> Float[Array, "*n 2"]:
    """Kannala-Brandt: theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)."""
    r = np.linalg.norm(xy, axis=-1)
    theta = np.arctan(r)
    t2 = theta * theta
    bent = theta * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
    return xy * scale[..., None]


def _invert(
    distort: Callable[[Float[Array, "*n 2"]], Float[Array, "*n 2"]], wanted: Float[Array, "*n 2"]
) -> Float[Array, "*n 2"]:
    """Solve distort(xy) = wanted by damped Newton steps. NaN where there is no solution before the lens folds back."""
    xy = wanted.copy()
    for _ in range(UNDISTORT_STEPS):
        gap = wanted - distort(xy)
        if np.nanmax(np.abs(gap), initial=0.0) < 1e-13:
            break
        jx, jy, det = _jacobian(distort, xy)
        det = np.where(np.abs(det) < 1e-9, 1e-9, det)
        move = np.stack(
            [
                (gap[..., 0] * jy[..., 1] - gap[..., 1] * jy[..., 0]) / det,
                (gap[..., 1] * jx[..., 0] - gap[..., 0] * jx[..., 1]) / det,
            ],
            -1,
        )
        length = np.linalg.norm(move, axis=-1, keepdims=True)
        xy = xy + move * np.minimum(1.0, 0.5 / np.maximum(length, 1e-12))
    solved = np.abs(wanted - distort(xy)).max(axis=-1) < UNDISTORT_TOLERANCE
    # a polynomial has more roots: past the fold the image is turned inside out (det < 0) or on the other side
    upright = (_jacobian(distort, xy)[2] > 0) & ((xy * wanted).sum(axis=-1) > -UNDISTORT_TOLERANCE)
    return np.where((solved & upright)[..., None], xy, np.nan)


def _jacobian(
    distort: Callable[[Float[Array, "*n 2"]], Float[Array, "*n 2"]], xy: Float[Array, "*n 2"], step: float = 1e-6
) -> tuple[Float[Array, "*n 2"], Float[Array, "*n 2"], Float[Array, "*n"]]:
    """Central differences of `distort` along x and along y, and their determinant."""
    dx, dy = np.array([step, 0.0]), np.array([0.0, step])
    jx = (distort(xy + dx) - distort(xy - dx)) / (2 * step)
    jy = (distort(xy + dy) - distort(xy - dy)) / (2 * step)
    return jx, jy, np.asarray(jx[..., 0] * jy[..., 1] - jx[..., 1] * jy[..., 0])
