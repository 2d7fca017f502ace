"""The terms of the joint objective: residuals, their weights by measured noise, and their derivatives.

Parameters: per frame a turn and a shift of the object about its centre in object axes (camera_from_object <-
camera_from_object about(turn, shift)), then the offsets of the control points along the surface's normals (metres).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.linalg import solve_triangular
from scipy.spatial import cKDTree

from processing.contact.physics.support import trimmed_hull
from processing.refine.icp import ShapeSurface
from processing.sensor import noise
from recordings.constants import GRAVITY_M_S2, MAD_TO_SIGMA
from recordings.estimation.robust import TUKEY_95, tukey_weight
from recordings.geometry import rotation_log, skew
from recordings.tracks import ObjectShape

LEAST_M, LEAST_RAD = 1e-4, 1e-3
LEAST_PLANE_M = 0.0005
REACH_M = 0.008
"""Depth further than this from the surface is something else."""


@dataclass(frozen=True, eq=False)
class Block:
    """Residuals of one term with weights (1 / variance, robust), and the entries of their Jacobian."""

    name: str
    residual: Float[Array, " m"]
    weight: Float[Array, " m"]
    row: Int[Array, " e"]
    column: Int[Array, " e"]
    value: Float[Array, " e"]


def _dense(name: str, residual: Array, weight: Array, columns: Array, values: Array) -> Block:
    """A block whose rows all have as many entries: columns and values are (m, e)."""
    row = np.repeat(np.arange(len(residual)), columns.shape[1] if len(residual) else 0)
    return Block(name, residual, weight, row, columns.reshape(-1).astype(np.int64), values.reshape(-1))


def _robust_sigma(residual: Float[Array, "*n"], least: float) -> float:
    return max(MAD_TO_SIGMA * float(np.median(np.abs(residual))), least) if residual.size else least


def _tukey(residual: Float[Array, " n"], sigma: float) -> Float[Array, " n"]:
    return np.asarray(tukey_weight(residual / (TUKEY_95 * sigma)) / sigma**2)


@dataclass(frozen=True, eq=False)
class Controls:
    """Control points on a surface: how it may move along its normals."""

    points_m: Float[Array, "k 3"]
    reach_m: float
    center_m: Float[Array, "3"]
    tree: cKDTree

    NEAR = 6

    @staticmethod
    def of(shape: ObjectShape, count: int, reach: float) -> Controls:
        """Spread over the vertices, each as far as possible from those before."""
        vertices = shape.vertices_m
        chosen, gap = [0], np.linalg.norm(vertices - vertices[0], axis=1)
        while len(chosen) < min(count, len(vertices)):
            chosen.append(int(gap.argmax()))
            gap = np.minimum(gap, np.linalg.norm(vertices - vertices[chosen[-1]], axis=1))
        points = vertices[chosen]
        extent_m = float(np.ptp(vertices, axis=0).mean())
        center = 0.5 * (vertices.min(0) + vertices.max(0))
        return Controls(points, reach * extent_m, center, cKDTree(points))

    def weights(self, points_m: Float[Array, "n 3"]) -> tuple[Int[Array, "n c"], Float[Array, "n c"]]:
        """Which control points move a point, and by how much of their offsets."""
        gap, near = self.tree.query(points_m, k=min(self.NEAR, len(self.points_m)))
        pull = np.exp(-0.5 * (gap / self.reach_m) ** 2) + 1e-12
        return near.astype(np.int64), pull / pull.sum(1, keepdims=True)

    def moved(self, shape: ObjectShape, offsets_m: Float[Array, " k"]) -> ObjectShape:
        """The shape with its vertices moved along their normals."""
        near, pull = self.weights(shape.vertices_m)
        along = (offsets_m[near] * pull).sum(1)
        return replace(shape, source="joint", vertices_m=shape.vertices_m + along[:, None] * vertex_normals(shape))


def vertex_normals(shape: ObjectShape) -> Float[Array, "v 3"]:
    """Outward unit normals, weighted by the area of the faces around."""
    a, b, c = (shape.vertices_m[shape.faces[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    out = np.zeros_like(shape.vertices_m)
    for k in range(3):
        np.add.at(out, shape.faces[:, k], face)
    return np.asarray(out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-15))


def shape_block(controls: Controls, offsets_m: Float[Array, " k"], sigma_m: float, first: int) -> Block:
    """The Gaussian process of the offsets, whitened by the Cholesky factor of its covariance."""
    square = ((controls.points_m[:, None] - controls.points_m[None]) ** 2).sum(-1)
    covariance = sigma_m**2 * (np.exp(-0.5 * square / controls.reach_m**2) + 0.05 * np.eye(len(square)))
    white = solve_triangular(np.linalg.cholesky(covariance), np.eye(len(square)), lower=True)
    columns = np.tile(first + np.arange(len(square)), (len(square), 1))
    return _dense("shape", white @ offsets_m, np.ones(len(square)), columns, white)


def depth_block(
    frame: int, points_m: Float[Array, "n 3"], camera_from_object: Float[Array, "4 4"], surface: ShapeSurface,
    controls: Controls, center_m: Float[Array, "3"], first: int, points_per_measurement: float,
) -> Block:  # fmt: skip
    """Signed distances of raw depth points to the surface."""
    inverse = np.linalg.inv(camera_from_object)
    points = points_m @ inverse[:3, :3].T + inverse[:3, 3]
    nearest, normal = surface.nearest(points)
    eye = inverse[:3, 3]
    facing = ((eye - nearest) * normal).sum(1) > 0
    gap = ((points - nearest) * normal).sum(1)
    use = facing & (np.abs(gap) < REACH_M)
    points, nearest, normal, gap = points[use], nearest[use], normal[use], gap[use]
    weight = _tukey(gap, _robust_sigma(gap, noise.JOINT_LEAST_SIGMA_M)) / points_per_measurement
    pose = np.concatenate([-np.cross(points - center_m, normal), -normal], 1)
    near, pull = controls.weights(nearest)
    columns = np.concatenate([np.tile(6 * frame + np.arange(6), (len(gap), 1)), first + near], 1)
    return _dense("depth", gap, weight, columns, np.concatenate([pose, -pull], 1))


def views_block(
    frame: int, begun: Float[Array, "4 4"], camera_from_object: Float[Array, "4 4"], covariance: Float[Array, "6 6"],
    center_m: Float[Array, "3"],
) -> Block:  # fmt: skip
    """What the tracker's own objective (depth, appearance and outline of every pair of views) says about a pose, in its
    quadratic form about where it ended: the deviation from there, whitened by the covariance there."""
    change = np.linalg.inv(begun) @ camera_from_object
    deviation = np.concatenate([rotation_log(change[:3, :3]), change[:3, :3] @ center_m + change[:3, 3] - center_m])
    R = begun[:3, :3]
    to = np.zeros((6, 6))  # (rotation vector, shift of the origin; camera axes) to (turn, shift about the centre)
    to[:3, :3], to[3:, :3], to[3:, 3:] = R.T, -R.T @ skew(R @ center_m), R.T
    spread = to @ covariance @ to.T
    spread += np.diag(np.r_[np.full(3, LEAST_RAD / 3), np.full(3, LEAST_M / 3)] ** 2)
    white = solve_triangular(np.linalg.cholesky(spread), np.eye(6), lower=True)
    columns = np.tile(6 * frame + np.arange(6), (6, 1))
    return _dense("views", white @ deviation, np.ones(6), columns, white)


def flight_block(
    flights: Int[Array, "f 3"], times_s: Float[Array, " n"], world_from_object: Float[Array, "n 4 4"],
    center_m: Float[Array, "3"], inertia: Float[Array, "3 3"],
) -> Block:  # fmt: skip
    """Free flight over three frames: the centre's velocity changes by gravity, the spin by its own momentum only."""
    R = world_from_object[:, :3, :3]
    place = R @ center_m + world_from_object[:, :3, 3]
    gravity = np.array([0.0, 0.0, -GRAVITY_M_S2])
    residual, columns, values = [], [], []
    for a, b, c in flights:
        d1, d2 = times_s[b] - times_s[a], times_s[c] - times_s[b]
        scale = 0.5 * (d1 + d2)
        fall = (place[c] - place[b]) / d2 - (place[b] - place[a]) / d1 - gravity * scale
        turn1, turn2 = rotation_log(R[b] @ R[a].T), rotation_log(R[c] @ R[b].T)
        spin = R[b].T @ (0.5 * (turn1 / d1 + turn2 / d2))
        free = R[b] @ np.linalg.solve(inertia, np.cross(inertia @ spin, spin))
        change = turn2 / d2 - turn1 / d1 - free * scale
        residual.append(np.concatenate([fall, change]) * scale)
        columns.append(np.concatenate([6 * f + np.arange(6) for f in (a, b, c)]))
        J = np.zeros((6, 18))
        for k, (f, share) in enumerate(((a, 1 / d1), (b, -1 / d1 - 1 / d2), (c, 1 / d2))):
            J[:3, 6 * k + 3 : 6 * k + 6] = share * R[f]
        left1, right1 = np.eye(3) - skew(turn1) / 2, np.eye(3) + skew(turn1) / 2
        left2, right2 = np.eye(3) - skew(turn2) / 2, np.eye(3) + skew(turn2) / 2
        J[3:, 0:3] = right1 @ R[a] / d1
        J[3:, 6:9] = -right2 @ R[b] / d2 - left1 @ R[b] / d1
        J[3:, 12:15] = left2 @ R[c] / d2
        values.append(J * scale)
    return _chained("flight", residual, columns, values)


def rest_block(
    rests: Int[Array, "r 2"], world_from_object: Float[Array, "n 4 4"], center_m: Float[Array, "3"]
) -> Block:
    """No motion between two frames at rest."""
    R = world_from_object[:, :3, :3]
    place = R @ center_m + world_from_object[:, :3, 3]
    residual, columns, values = [], [], []
    for a, b in rests:
        turn = rotation_log(R[b] @ R[a].T)
        residual.append(np.concatenate([place[b] - place[a], turn]))
        columns.append(np.concatenate([6 * a + np.arange(6), 6 * b + np.arange(6)]))
        J = np.zeros((6, 12))
        J[:3, 3:6], J[:3, 9:12] = -R[a], R[b]
        J[3:, 0:3], J[3:, 6:9] = -(np.eye(3) + skew(turn) / 2) @ R[a], (np.eye(3) - skew(turn) / 2) @ R[b]
        values.append(J)
    return _chained("rest", residual, columns, values)


def _chained(name: str, residual: list[Array], columns: list[Array], values: list[Array]) -> Block:
    """Six residuals a link: shifts in metres, turns in radians, each by its own measured noise."""
    if not residual:
        empty = np.zeros(0)
        return _dense(name, empty, empty, np.zeros((0, 1)), np.zeros((0, 1)))
    r = np.stack(residual)
    sigma = np.r_[np.full(3, _robust_sigma(r[:, :3], LEAST_M)), np.full(3, _robust_sigma(r[:, 3:], LEAST_RAD))]
    share = np.clip(np.abs(r) / (4.685 * sigma), 0, 1)
    weight = (1 - share**2) ** 2 / sigma**2
    wide = np.repeat(np.stack(columns)[:, None], 6, 1)
    return _dense(name, r.reshape(-1), weight.reshape(-1), wide.reshape(-1, wide.shape[-1]),
                  np.stack(values).reshape(-1, wide.shape[-1]))  # fmt: skip


def plane_block(
    released: Int[Array, " p"], resting: Int[Array, " q"], world_from_object: Float[Array, "n 4 4"],
    shape: ObjectShape, controls: Controls, center_m: Float[Array, "3"], normal: Float[Array, "3"], offset_m: float,
    first: int, lowest: int = 4,
) -> Block:  # fmt: skip
    """Points below the plane after release; the lowest points at rest, which lie on it."""
    corners = trimmed_hull(shape.vertices_m, shape.faces)  # a measured mesh's spikes support nothing
    along = _hull_normals(corners)
    near, pull = controls.weights(corners)
    rows: list[tuple[int, int, float, float]] = []
    at_rest = {int(i) for i in resting}
    for i in released:
        R, t = world_from_object[i, :3, :3], world_from_object[i, :3, 3]
        height = corners @ (R.T @ normal) + t @ normal - offset_m
        order = np.argsort(height)[:lowest]
        wanted = order[:3] if int(i) in at_rest else order[height[order] < 0]
        rows += [(int(i), int(j), float(height[j]), 0.0) for j in wanted]
    if not rows:
        empty = np.zeros(0)
        return _dense("plane", empty, empty, np.zeros((0, 1)), np.zeros((0, 1)))
    frame, corner = np.array([r[0] for r in rows]), np.array([r[1] for r in rows])
    residual = np.array([r[2] for r in rows])
    up = np.einsum("nij,i->nj", world_from_object[frame][:, :3, :3], normal)
    pose = np.concatenate([np.cross(corners[corner] - center_m, up), up], 1)
    grows = (up * along[corner]).sum(1)[:, None] * pull[corner]
    columns = np.concatenate([6 * frame[:, None] + np.arange(6), first + near[corner]], 1)
    weight = _tukey(residual, _robust_sigma(residual, LEAST_PLANE_M)) / noise.JOINT_CONTACTS_PER_MEASUREMENT
    return _dense("plane", residual, weight, columns, np.concatenate([pose, grows], 1))


def _hull_normals(corners_m: Float[Array, "c 3"]) -> Float[Array, "c 3"]:
    """Outward directions at a hull's corners: from its middle."""
    out = corners_m - corners_m.mean(0)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))
