"""`joint`: one objective over shape, poses and friction, beyond the paper's alternation.

E = sum of squares of residuals, each divided by its measured noise, over
  views      the tracker's objective over depth, appearance and outline of all pairs of views, in its quadratic form,
  depth      raw depth points against the surface (signed distance along the normal), robust,
  flight     change of velocity against gravity, change of spin against none, for every three frames of free flight,
  rest       motion from frame to frame at rest,
  plane      what lies below the plane (hinge) anywhere after release, and the lowest points at rest on it,
  shape      offsets of the surface along its normals, smooth (a Gaussian process at control points).
Poses and shape are solved together by Gauss-Newton on the sparse normal equations. Friction enters only the contact
loss, so its minimum given poses and shape is contact learning's: the pipeline runs that after every round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy import sparse
from scipy.sparse.linalg import splu

from processing.motion.tangents import about
from processing.refine.icp import ShapeSurface
from processing.refine.joint_terms import (
    Block,
    Controls,
    depth_block,
    flight_block,
    plane_block,
    rest_block,
    shape_block,
    views_block,
)
from processing.sensor import noise
from recordings.tracks import ObjectShape


@dataclass(frozen=True)
class JointConfig:
    rounds: int = 4
    """Gauss-Newton steps, each with new matches, renderings and noise estimates."""
    depth_points: int = 250
    controls: int = 160
    shape_sigma_m: float = 0.0006
    """How far vision's surface may be off locally."""
    shape_reach: float = 0.12
    """Reach of a control point, as a share of the shape's mean extent."""
    points_per_measurement: float = noise.JOINT_POINTS_PER_MEASUREMENT
    """Depth errors are alike over patches and from frame to frame, and `views` has seen them once: so many samples
    weigh as one independent measurement."""
    most_turn_rad: float = 0.05
    most_shift_m: float = 0.01
    """A frame that would move further in one step stays where it is in that step."""


@dataclass(frozen=True, eq=False)
class FrameData:
    """One tracked frame: which toss and position, its time, raw depth points (camera frame, at depth's exposure, where
    the pose is `at_depth` after the colour's), and the tracker's covariance (rotation vector, shift; camera axes)."""

    toss: int
    position: int
    time_s: float
    points_m: Float[Array, "n 3"]
    at_depth: Float[Array, "4 4"]
    covariance: Float[Array, "6 6"]


@dataclass(frozen=True, eq=False)
class World:
    """What is known of the outside, and of the motion in it. `inertia` is about the centre of mass, in object axes, up
    to a factor. Indices are of frames: `flights` three each, `rests` pairs, `resting` at rest, `released` after
    release."""

    world_from_camera: Float[Array, "4 4"]
    normal: Float[Array, "3"]
    offset_m: float
    center_m: Float[Array, "3"]
    inertia: Float[Array, "3 3"]
    flights: Int[Array, "f 3"]
    rests: Int[Array, "r 2"]
    resting: Int[Array, " q"]
    released: Int[Array, " p"]


@dataclass(frozen=True, eq=False)
class Joined:
    """Poses (n, 4, 4), the shape with its surface moved, information (n, 6, 6) of each pose (rotation vector, shift;
    object axes, about the centre), and per round the weighted cost of every term."""

    poses: Float[Array, "n 4 4"]
    shape: ObjectShape
    information: Float[Array, "n 6 6"]
    center_m: Float[Array, "3"]
    costs: tuple[dict[str, float], ...]


def solve_jointly(
    frames: Sequence[FrameData],
    poses: Float[Array, "n 4 4"],
    shape: ObjectShape,
    world: World | None,
    config: JointConfig,
) -> Joined:
    """Poses and shape that explain views, depth, flight, rest and plane best together, from a start near the answer."""
    controls = Controls.of(shape, config.controls, config.shape_reach)
    offsets = np.zeros(len(controls.points_m))
    begun = poses
    poses, center = poses.copy(), controls.center_m if world is None else world.center_m
    costs: list[dict[str, float]] = []
    information = np.zeros((len(frames), 6, 6))
    for _ in range(config.rounds):
        moved = controls.moved(shape, offsets)
        blocks = _blocks(frames, begun, poses, moved, controls, offsets, world, center, config)
        costs.append(_costs(blocks))
        step, normal = _step(blocks, len(frames), len(offsets))
        information = np.stack([normal[6 * i : 6 * i + 6, 6 * i : 6 * i + 6].toarray() for i in range(len(frames))])
        turns, shifts = step[: 6 * len(frames)].reshape(-1, 2, 3)[:, 0], step[: 6 * len(frames)].reshape(-1, 2, 3)[:, 1]
        for i in range(len(frames)):
            small = np.linalg.norm(turns[i]) < config.most_turn_rad and np.linalg.norm(shifts[i]) < config.most_shift_m
            if small:
                poses[i] = poses[i] @ about(center, turns[i], shifts[i])
        offsets = offsets + step[6 * len(frames) :]
    return Joined(poses, controls.moved(shape, offsets), information, center, tuple(costs))


def _costs(blocks: Sequence[Block]) -> dict[str, float]:
    """The weighted cost of every term, over all its blocks."""
    found: dict[str, float] = {}
    for block in blocks:
        found[block.name] = found.get(block.name, 0.0) + float(block.weight @ block.residual**2)
    return found


def _blocks(
    frames: Sequence[FrameData], begun: Float[Array, "n 4 4"], poses: Float[Array, "n 4 4"], shape: ObjectShape,
    controls: Controls, offsets: Float[Array, " k"], world: World | None, center: Float[Array, "3"],
    config: JointConfig,
) -> list[Block]:  # fmt: skip
    surface = ShapeSurface(shape)
    out = [shape_block(controls, offsets, config.shape_sigma_m, 6 * len(frames))]
    for i, frame in enumerate(frames):
        at = poses[i] @ frame.at_depth
        out.append(depth_block(i, frame.points_m, at, surface, controls, center, 6 * len(frames),
                               config.points_per_measurement))  # fmt: skip
        out.append(views_block(i, begun[i], poses[i], frame.covariance, center))
    if world is not None:
        times_s = np.array([f.time_s for f in frames])
        in_world = world.world_from_camera @ poses
        out.append(flight_block(world.flights, times_s, in_world, center, world.inertia))
        out.append(rest_block(world.rests, in_world, center))
        out.append(plane_block(world.released, world.resting, in_world, shape, controls, center, world.normal,
                               world.offset_m, 6 * len(frames)))  # fmt: skip
    return [b for b in out if len(b.residual)]


def _step(blocks: Sequence[Block], frames: int, controls: int) -> tuple[Float[Array, " u"], sparse.csc_matrix]:
    """The Gauss-Newton step and the normal matrix."""
    size = 6 * frames + controls
    rows, columns, values, residual, weight = [], [], [], [], []
    first = 0
    for block in blocks:
        rows.append(block.row + first)
        columns.append(block.column)
        values.append(block.value)
        residual.append(block.residual)
        weight.append(block.weight)
        first += len(block.residual)
    place = (np.concatenate(rows), np.concatenate(columns))
    jacobian = sparse.csr_matrix((np.concatenate(values), place), shape=(first, size))
    weighted = jacobian.multiply(np.concatenate(weight)[:, None]).tocsr()
    normal = (jacobian.T @ weighted).tocsc() + sparse.identity(size, format="csc") * 1e-6
    right = -(weighted.T @ np.concatenate(residual))
    return np.asarray(splu(normal.tocsc()).solve(right)), normal
