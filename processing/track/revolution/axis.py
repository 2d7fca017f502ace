"""The axis of a round body: a line that the normals of its surface meet."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.track.beam import Scene
from recordings.estimation.robust import geman_mcclure_weight
from recordings.geometry import rotation_exp


@dataclass(frozen=True)
class AxisConfig:
    """When a body may be round, and about which lines; whether it is, its outlines decide (profile.py)."""

    round_ratio: float = 0.2
    """A rotation about which depth carries less than this share of the information of the next one is open ..."""
    round_share: float = 0.45
    """... where so many normals meet the axis ..."""
    round_cells: int = 10
    """... and point in so many of 36 directions around it (a box's point in four; noisy ones in ten)."""
    meets: float = 0.1
    """A normal that passes the axis by less than this share of the body's size meets it."""
    facing: float = 0.5
    """Cosine between a normal that is used and its camera."""
    lines: int = 3
    """Lines that are tried: of eleven tosses of mugs, cans and bottles the first or the second was the axis."""
    same: float = 0.98
    """Lines whose directions have this cosine (11 degrees) are one."""
    steps: int = 40
    steady: float = 1 - 1e-7
    """Solutions for a line at most, and the cosine between two of them after which it stays (.03 degrees)."""


@dataclass(frozen=True, eq=False)
class Axis:
    """A line of the object frame: unit direction, and its point nearest the origin."""

    direction: Float[Array, "3"]
    point_m: Float[Array, "3"]

    def rotation(self, angle_rad: float) -> Float[Array, "4 4"]:
        """Object points turned about the line."""
        out = np.eye(4)
        out[:3, :3] = rotation_exp(self.direction * angle_rad)
        out[:3, 3] = self.point_m - out[:3, :3] @ self.point_m
        return out

    def seen_from(self, new_from_old: Float[Array, "4 4"]) -> Axis:
        """The same line in another object frame."""
        direction = new_from_old[:3, :3] @ self.direction
        return Axis(direction, _foot(new_from_old[:3, :3] @ self.point_m + new_from_old[:3, 3], direction))

    @property
    def twist(self) -> Float[Array, "6"]:
        """Per radian (translation, rotation)."""
        return np.concatenate([-np.cross(self.direction, self.point_m), self.direction])


def open_axes(scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], config: AxisConfig) -> list[Axis]:
    """Lines that the normals of all frames meet but for a handle's (Pottmann and Wallner 2001, robustly), best first;
    none where they leave no rotation open.

    Minimises over twists (v, d), |d| = 1, the sum of (n . v + (p x n) . d)^2: how far a rotation moves points along
    normals. Of a body about as high as wide many lines do nearly so, hence from several directions.
    """
    points, normals = _surface(scene, poses, use, config)
    center = np.median(points, axis=0)
    size = float(np.median(np.linalg.norm(points - center, axis=1)))
    lever = np.concatenate([normals, np.cross((points - center) / size, normals)], axis=1)
    lines = sorted((_met(lever, start, config) for start in _STARTS), key=lambda line: line.cost)
    out: list[Axis] = []
    for line in lines:
        meeting = np.abs(line.gap) < 2 * config.meets
        open_about = line.ratio < config.round_ratio and float(meeting.mean()) > config.round_share
        if not open_about or any(abs(line.direction @ o.direction) > config.same for o in out):
            continue
        if _directions_around(normals[meeting], line.direction) >= config.round_cells:
            foot = _foot(center + size * np.cross(line.direction, line.shift), line.direction)
            out.append(Axis(line.direction, foot))
    return out[: config.lines]


@dataclass(frozen=True, eq=False)
class _Line:
    """A line that normals meet: its twist (`shift`, `direction`), what each passes it by (`gap`), the mean of that as
    it is weighed, and how much less information about its rotation there is than about the next one."""

    shift: Float[Array, "3"]
    direction: Float[Array, "3"]
    gap: Float[Array, " m"]
    cost: float
    ratio: float


_STARTS = [np.array(d) / np.linalg.norm(d) for d in product((-1.0, 0.0, 1.0), repeat=3) if d > (0.0, 0.0, 0.0)]
"""Thirteen directions 35 to 55 degrees apart."""


def _met(lever: Float[Array, "m 6"], start: Float[Array, "3"], config: AxisConfig) -> _Line:
    """The line near a start that the normals meet."""
    direction, weight, ratio = start, np.ones(len(lever)), 0.0
    for step in range(config.steps):
        M = (lever * weight[:, None]).T @ lever
        shift_of = np.linalg.solve(M[:3, :3] + 1e-9 * np.trace(M) * np.eye(3), M[:3, 3:])
        before = direction
        if step > 0:
            eigenvalues, eigenvectors = np.linalg.eigh(M[3:, 3:] - M[3:, :3] @ shift_of)
            direction, ratio = eigenvectors[:, 0], float(eigenvalues[0] / eigenvalues[1])
        shift = -shift_of @ direction
        gap = lever @ np.concatenate([shift, direction])
        weight = geman_mcclure_weight((gap / config.meets) ** 2)
        if step > 1 and abs(before @ direction) > config.steady:
            break
    squared = (gap / config.meets) ** 2
    return _Line(shift, direction, gap, float((squared / (1 + squared)).mean()), ratio)


def _directions_around(normals: Float[Array, "m 3"], direction: Float[Array, "3"], cells: int = 36) -> int:
    """How many of the directions around the axis a fair share of the normals has."""
    side = np.cross(direction, np.eye(3)[int(np.abs(direction).argmin())])
    side /= np.linalg.norm(side)
    across = normals[np.abs(normals @ direction) < 0.5]
    around = np.arctan2(across @ np.cross(direction, side), across @ side)
    counts = np.bincount(np.floor((around + np.pi) / (2 * np.pi) * cells).astype(int) % cells, minlength=cells)
    return int((counts > 0.4 * max(len(across), 1) / cells).sum())


def _foot(point_m: Float[Array, "3"], direction: Float[Array, "3"]) -> Float[Array, "3"]:
    return np.asarray(point_m - direction * float(point_m @ direction))


def _surface(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], config: AxisConfig
) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"]]:
    """Points and normals that face their camera well, object frame."""
    points, normals = [], []
    for i in np.flatnonzero(use):
        first, count = int(scene.store.table[i, lay.FIRST]), int(scene.store.table[i, lay.COUNT])
        seen = scene.store.samples[first : first + count : 5].astype(np.float64)
        p, n = seen[:, :3], seen[:, lay.SNX : lay.SNZ + 1]
        facing = -np.sum(p * n, 1) / np.linalg.norm(p, axis=1)
        p, n = p[facing > config.facing], n[facing > config.facing]
        R = poses[i][:3, :3]
        points.append((p - poses[i][:3, 3]) @ R)
        normals.append(n @ R)
    return np.concatenate(points), np.concatenate(normals)


def angles_between(poses: Float[Array, "v 4 4"], others: Float[Array, "v 4 4"], axis: Axis) -> Float[Array, " v"]:
    """The turn (rad) about the axis that leads from each pose to the other hypothesis's."""
    out = np.zeros(len(poses))
    for n, (p, o) in enumerate(zip(poses, others)):
        if np.isfinite(o).all():
            turn = p[:3, :3].T @ o[:3, :3]
            d = axis.direction
            sine = 0.5 * float(d @ [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            out[n] = np.arctan2(sine, 0.5 * (float(np.trace(turn)) - float(d @ turn @ d)))
    return out
