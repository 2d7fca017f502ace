"""Factors between poses: what was measured, and for all factors of a kind at once their residuals and Jacobians.

Each `..._terms` gives whitened residuals (m, d), their Jacobians (m, d, 6) by each pose, and the poses' indices (m, k).
Jacobians are by a twist (rotation, translation) on the right of a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from calibration.cameras.poses import inverse_poses
from groundtruth import se3

Terms = tuple[Array, list[Array], Array]
CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
"""Corners of a tag of size 1 in TagSLAM's tag frame (y up on the printed tag)."""


@dataclass(frozen=True)
class Projection:
    """One tag seen by one camera: indices of the four poses in the chain, and the corners (4, 2) in pixels."""

    camera: int
    rig_from_camera: int
    world_from_rig: int
    world_from_body: int
    body_from_tag: int
    size_m: float
    corners_px: Float[Array, "4 2"]
    sigma_px: float


@dataclass(frozen=True)
class Prior:
    pose: int
    mean: Float[Array, "4 4"]
    root_information: Float[Array, "6 6"]


@dataclass(frozen=True)
class Between:
    """pose_a^-1 pose_b is about `delta`."""

    pose_a: int
    pose_b: int
    delta: Float[Array, "4 4"]
    root_information: Float[Array, "6 6"]


@dataclass(frozen=True)
class Coordinate:
    """direction . (world point of a tag's corner, or of its centre for corner -1) is about `length_m`."""

    world_from_body: int
    body_from_tag: int
    point_tag_m: Float[Array, "3"]
    direction: Float[Array, "3"]
    length_m: float
    sigma_m: float


@dataclass(frozen=True)
class Distance:
    """The distance between two points on tags is about `length_m`."""

    world_from_body: tuple[int, int]
    body_from_tag: tuple[int, int]
    points_tag_m: tuple[Float[Array, "3"], Float[Array, "3"]]
    length_m: float
    sigma_m: float


@dataclass(frozen=True)
class Arc:
    """Three poses of one body in time order on one ballistic arc: the centre of mass `center_m` (in the body) has the
    acceleration of gravity and the body turns evenly. Weights (0..1) are those of a robust loss."""

    poses: tuple[int, int, int]
    steps_s: tuple[float, float]
    center_m: Float[Array, "3"]
    gravity_m_s2: Float[Array, "3"]
    sigma_m_s2: float
    sigma_rad_s2: float
    weight: float = 1.0
    turn_weight: float = 1.0


def arc_terms(arcs: list[Arc], poses: Array) -> Terms:
    """r = sqrt(w) (2 ((x2 - x1)/h2 - (x1 - x0)/h1) / (h1 + h2) - g) / sigma with x the centre of mass, and the same of
    the turns log(R0' R1), log(R1' R2) with nothing in gravity's place."""
    index = np.array([a.poses for a in arcs])
    h = np.array([a.steps_s for a in arcs])
    before, after = 2 / (h[:, 0] * h.sum(1)), 2 / (h[:, 1] * h.sum(1))
    center = np.stack([a.center_m for a in arcs])
    root_x = np.sqrt([a.weight for a in arcs]) / np.array([a.sigma_m_s2 for a in arcs])
    root_w = np.sqrt([a.turn_weight for a in arcs]) / np.array([a.sigma_rad_s2 for a in arcs])
    R = poses[index][..., :3, :3]
    x = poses[index][..., :3, 3] + (R @ center[:, None, :, None])[..., 0]
    phi = se3.log(se3.rotations(np.swapaxes(R[:, :2], -1, -2) @ R[:, 1:]).reshape(-1, 4, 4))[:, :3].reshape(-1, 2, 3)
    shares = np.stack([before, -(before + after), after], axis=1)
    residual = np.empty((len(arcs), 6))
    residual[:, :3] = (shares[..., None] * x).sum(1) - np.stack([a.gravity_m_s2 for a in arcs])
    residual[:, 3:] = after[:, None] * phi[:, 1] - before[:, None] * phi[:, 0]
    residual *= np.concatenate([np.repeat(root_x[:, None], 3, 1), np.repeat(root_w[:, None], 3, 1)], axis=1)
    right = _turn_jacobian_inverse(phi.reshape(-1, 3)).reshape(-1, 2, 3, 3)  # d log(A exp(e)) / d e
    back = -_turn_jacobian_inverse(-phi.reshape(-1, 3)).reshape(-1, 2, 3, 3)  # d log(exp(-e) A) / d e
    by_turn = [
        -before[:, None, None] * back[:, 0],
        after[:, None, None] * back[:, 1] - before[:, None, None] * right[:, 0],
        after[:, None, None] * right[:, 1],
    ]
    jacobians = []
    for i in range(3):
        J = np.zeros((len(arcs), 6, 6))
        J[:, :3, :3] = -(shares[:, i] * root_x)[:, None, None] * (R[:, i] @ se3.skew(center))
        J[:, :3, 3:] = (shares[:, i] * root_x)[:, None, None] * R[:, i]
        J[:, 3:, :3] = root_w[:, None, None] * by_turn[i]
        jacobians.append(J)
    return residual, jacobians, index


def _turn_jacobian_inverse(phi: Float[Array, "n 3"]) -> Float[Array, "n 3 3"]:
    """Inverse right Jacobian of SO(3) to second order."""
    W = se3.skew(phi)
    return np.eye(3) + 0.5 * W + W @ W / 12


def prior_terms(priors: list[Prior], poses: Array) -> Terms:
    """r = root log(mean^-1 pose)."""
    index = np.array([[p.pose] for p in priors])
    root = np.stack([p.root_information for p in priors])
    mean = np.stack([p.mean for p in priors])
    error = se3.log(inverse_poses(mean) @ poses[index[:, 0]])
    return (root @ error[..., None])[..., 0], [root @ _right_jacobian_inverse(error)], index


def between_terms(betweens: list[Between], poses: Array) -> Terms:
    """r = root log(delta^-1 pose_a^-1 pose_b)."""
    index = np.array([[b.pose_a, b.pose_b] for b in betweens])
    root = np.stack([b.root_information for b in betweens])
    delta = np.stack([b.delta for b in betweens])
    relative = inverse_poses(poses[index[:, 0]]) @ poses[index[:, 1]]
    error = se3.log(inverse_poses(delta) @ relative)
    by_b = root @ _right_jacobian_inverse(error)
    by_a = -by_b @ se3.adjoint(inverse_poses(relative))
    return (root @ error[..., None])[..., 0], [by_a, by_b], index


def _right_jacobian_inverse(error: Float[Array, "n 6"]) -> Float[Array, "n 6 6"]:
    """Inverse right Jacobian of SE(3) to second order: I + ad/2 + ad^2/12; exact enough below a radian."""
    ad = np.zeros((len(error), 6, 6))
    w, v = se3.skew(error[:, :3]), se3.skew(error[:, 3:])
    ad[:, :3, :3], ad[:, 3:, 3:], ad[:, 3:, :3] = w, w, v
    return np.eye(6) + 0.5 * ad + ad @ ad / 12


def coordinate_terms(items: list[Coordinate], poses: Array) -> Terms:
    """r = (direction . world point - length) / sigma."""
    index = np.array([[c.world_from_body, c.body_from_tag] for c in items])
    direction = np.stack([c.direction for c in items])[:, None, :]
    points = np.stack([c.point_tag_m for c in items])[:, None, :]
    sigma = np.array([c.sigma_m for c in items])
    world, (by_body, by_tag) = _world_point(poses[index[:, 0]], poses[index[:, 1]], points)
    residual = ((direction[:, 0] * world).sum(-1) - np.array([c.length_m for c in items])) / sigma
    scale = 1 / sigma[:, None, None]
    return residual[:, None], [direction @ by_body * scale, direction @ by_tag * scale], index


def distance_terms(items: list[Distance], poses: Array) -> Terms:
    """r = (|world point 1 - world point 0| - length) / sigma."""
    index = np.array(
        [[d.world_from_body[0], d.body_from_tag[0], d.world_from_body[1], d.body_from_tag[1]] for d in items]
    )
    sigma = np.array([d.sigma_m for d in items])
    ends, jacobians = [], []
    for i in (0, 1):
        points = np.stack([d.points_tag_m[i] for d in items])[:, None, :]
        world, J = _world_point(poses[index[:, 2 * i]], poses[index[:, 2 * i + 1]], points)
        ends.append(world)
        jacobians.append(J)
    gap = ends[1] - ends[0]
    length = np.linalg.norm(gap, axis=-1)
    along = (gap / np.maximum(length, 1e-9)[:, None] / sigma[:, None])[:, None, :]
    residual = (length - np.array([d.length_m for d in items])) / sigma
    out = [-along @ jacobians[0][0], -along @ jacobians[0][1], along @ jacobians[1][0], along @ jacobians[1][1]]
    return residual[:, None], out, index


def _world_point(body: Array, tag: Array, points: Float[Array, "n 1 3"]) -> tuple[Array, tuple[Array, Array]]:
    """World position (n, 3) of a point of a tag, and its Jacobians (n, 3, 6) by body and tag."""
    in_body = move(tag, points)
    world = move(body, in_body)[:, 0]
    identity = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    by_body = body[:, :3, :3] @ np.concatenate([-se3.skew(in_body[:, 0]), identity], -1)
    by_tag = body[:, :3, :3] @ tag[:, :3, :3] @ np.concatenate([-se3.skew(points[:, 0]), identity], -1)
    return world, (by_body, by_tag)


def move(poses: Float[Array, "m 4 4"], points: Float[Array, "m k 3"]) -> Float[Array, "m k 3"]:
    """Points of each pose's source frame, moved."""
    return points @ np.swapaxes(poses[:, :3, :3], -1, -2) + poses[:, None, :3, 3]
