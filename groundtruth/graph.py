"""A factor graph over poses: tag corners, priors, relative poses and measured lengths, solved by Levenberg-Marquardt.

The model is TagSLAM's (Pfrommer and Daniilidis 2019): a corner of a tag on a body, seen by a camera on a rig,

    pixel = project( rig_from_camera^-1  world_from_rig^-1  world_from_body  body_from_tag  corner )

with every pose a variable. All factors of a kind are linearised at once in numpy and the sparse normal equations are
factorised by SuperLU: a Python callback per factor, as GTSAM's bindings would need, costs fifty times as much. What
TagSLAM lacks: pixel residuals are robust (Huber), and a variable that nothing determines is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy import sparse
from scipy.sparse.linalg import splu

from calibration.cameras.poses import inverse_poses
from groundtruth import se3
from groundtruth.blocks import BlockPattern
from groundtruth.factors import (
    CORNERS,
    Arc,
    Between,
    Coordinate,
    Distance,
    Prior,
    Projection,
    Terms,
    arc_terms,
    between_terms,
    coordinate_terms,
    distance_terms,
    move,
    prior_terms,
)
from recordings.errors import TosslabError
from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight
from recordings.geometry import CameraModel


class Undetermined(TosslabError):
    """The graph does not fix some pose. `names` says whose."""

    exit_code = 1

    def __init__(self, names: Sequence[str], why: str) -> None:
        self.names = tuple(names)
        super().__init__(f"the solution is singular: {why} ({', '.join(self.names[:8])})")


@dataclass(frozen=True)
class SolverConfig:
    iterations: int = 60
    """Levenberg-Marquardt steps at most."""
    huber_px: float | None = 3.0
    """Pixel residuals beyond this many standard deviations count linearly; None as TagSLAM, which trusts all."""
    least_gain: float = 1e-9
    """Stops when a step lowers the cost by less than this share."""
    weakest: float = 1e-6
    """A pose whose information (in 1/rad^2 or 1/m^2) is below this is not determined. 0: never asked."""
    loosest_rad: float = 0.5
    """Nor is one that does not move, when its turn is known no better than this (standard deviation)."""


@dataclass
class Graph:
    """Poses by index with their names, and the factors between them."""

    cameras: list[CameraModel]
    names: list[str] = field(default_factory=list)
    start: list[Float[Array, "4 4"]] = field(default_factory=list)
    stamps: list[int | None] = field(default_factory=list)
    projections: list[Projection] = field(default_factory=list)
    priors: list[Prior] = field(default_factory=list)
    betweens: list[Between] = field(default_factory=list)
    coordinates: list[Coordinate] = field(default_factory=list)
    distances: list[Distance] = field(default_factory=list)
    arcs: list[Arc] = field(default_factory=list)

    def add_pose(self, name: str, start: Float[Array, "4 4"], stamp_ns: int | None) -> int:
        """`stamp_ns` is None for what does not move: such poses are eliminated last (see elimination_order)."""
        self.names.append(name)
        self.stamps.append(stamp_ns)
        self.start.append(np.asarray(start, dtype=np.float64))
        return len(self.names) - 1


@dataclass(frozen=True, eq=False)
class Solution:
    """`poses` (n, 4, 4); `residuals_px` (m, 4, 2): projected minus seen, by projection; `iterations` used."""

    poses: Float[Array, "n 4 4"]
    residuals_px: Float[Array, "m 4 2"]
    cost: float
    iterations: int
    information: sparse.csc_matrix
    order: Int[Array, " d"]

    @property
    def reprojection_px(self) -> Float[Array, "m 4"]:
        """Corner distances in pixels."""
        return np.linalg.norm(self.residuals_px, axis=-1)


def solve(graph: Graph, config: SolverConfig) -> Solution:
    """Minimise the graph's cost from its start. Raises Undetermined where a pose is not fixed."""
    system, order = _System(graph, config), elimination_order(graph)
    found = minimised(
        np.stack(graph.start),
        system.expanded,
        lambda poses, step: poses @ se3.exp(step.reshape(-1, 6)),
        config.iterations,
        config.least_gain,
        lambda information, right, damping: _damped_solution(graph, information, right, damping, order),
    )
    information = found.at.information
    _check_determined(graph, information, config, order)
    return Solution(found.state, system.residuals_px(found.state), found.at.cost, found.steps, information, order)


def covariances(solution: Solution, poses: Sequence[int]) -> Float[Array, "k 6 6"]:
    """Marginal covariance of each pose, (rotation, translation) in its own frame."""
    factor = Factor(solution.information, solution.order)
    out = np.empty((len(poses), 6, 6))
    for i, pose in enumerate(poses):
        unit = np.zeros((solution.information.shape[0], 6))
        unit[6 * pose : 6 * pose + 6] = np.eye(6)
        out[i] = factor.solve(unit)[6 * pose : 6 * pose + 6]
    return out


def elimination_order(graph: Graph) -> Int[Array, " d"]:
    """Unknowns in the order of elimination. What does not move comes last. Of what moves, every second stamp comes
    first, then every second one of the rest, and so on: a chain of odometry taken from its end would drag along all
    tags that it ever saw, and a frame would cost the more the later it is. Within a stamp, what was added last (a
    camera's own pose) hangs on what was added first (its rig), so it goes first.
    """
    last = np.iinfo(np.int64).max
    stamps = np.array([last if s is None else s for s in graph.stamps], dtype=np.int64)
    rank = np.searchsorted(np.unique(stamps), stamps) + 1
    level = np.where(stamps == last, 64, np.log2(rank & -rank))
    poses = np.lexsort((-np.arange(len(stamps)), stamps, level))
    return (6 * poses[:, None] + np.arange(6)).ravel()


class Factor:
    """A symmetric positive matrix, factorised in a given order of elimination. Raises RuntimeError where singular."""

    def __init__(self, matrix: sparse.spmatrix, order: Int[Array, " d"]) -> None:
        self._order = order
        permuted = matrix.tocsr()[order][:, order].tocsc()
        self._lu = splu(permuted, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def solve(self, right: Float[Array, "*d"]) -> Float[Array, "*d"]:
        out = np.empty_like(right)
        out[self._order] = self._lu.solve(right[self._order])
        return out


def _damped_solution(
    graph: Graph, information: sparse.csc_matrix, right: Float[Array, " d"], damping: float, order: Int[Array, " d"]
) -> Float[Array, " d"]:
    diagonal = information.diagonal()
    if not np.isfinite(diagonal).all() or (diagonal <= 0).any():
        bad = sorted({graph.names[i // 6] for i in np.flatnonzero(~(diagonal > 0))})
        raise Undetermined(bad, "no factor touches a pose")
    try:
        factor = Factor(information + sparse.diags(damping * diagonal), order)
    except RuntimeError as singular:
        raise Undetermined([_weakest_name(graph, information)], "the normal equations cannot be solved") from singular
    return factor.solve(right)


def _check_determined(
    graph: Graph, information: sparse.csc_matrix, config: SolverConfig, order: Int[Array, " d"]
) -> None:
    """Find directions that nothing holds, by inverse iteration on the smallest eigenvalue of the scaled information."""
    scale = 1 / np.sqrt(np.maximum(information.diagonal(), 1e-12))
    scaled = sparse.diags(scale) @ information @ sparse.diags(scale)
    try:
        factor = Factor(scaled + 1e-14 * sparse.eye(len(scale)), order)
    except RuntimeError as singular:
        raise Undetermined([_weakest_name(graph, information)], "the normal equations cannot be solved") from singular
    v = np.random.default_rng(0).normal(size=len(scale))
    for _ in range(6):
        v = factor.solve(v)
        v /= np.linalg.norm(v)
    direction = scale * v
    sigma = 1 / np.sqrt(max(float(direction @ (information @ direction)), 1e-30))
    turn_rad, shift_m = (np.linalg.norm(part, axis=1) * sigma for part in np.split(direction.reshape(-1, 6), 2, axis=1))
    still = np.array([s is None for s in graph.stamps])
    loose = still & (turn_rad > config.loosest_rad)
    loose |= np.maximum(turn_rad, shift_m) > 1 / np.sqrt(max(config.weakest, 1e-30))
    if config.weakest > 0 and loose.any():
        first = [i for i in np.argsort(-turn_rad - shift_m) if loose[i]]
        names = [graph.names[i] for i in sorted(first, key=lambda i: not still[i])[:4]]
        turn, shift = np.degrees(turn_rad[loose].max()), shift_m[loose].max()
        raise Undetermined(names, f"what was measured and assumed leaves {turn:.0f} deg and {shift:.2g} m open")


def _weakest_name(graph: Graph, information: sparse.csc_matrix) -> str:
    return graph.names[int(np.argmin(information.diagonal())) // 6]


class _System:
    """The graph's factors as arrays, evaluated all at once."""

    def __init__(self, graph: Graph, config: SolverConfig) -> None:
        self._graph = graph
        self._config = config
        p = graph.projections
        self._chain = np.array(
            [[q.rig_from_camera, q.world_from_rig, q.world_from_body, q.body_from_tag] for q in p], dtype=np.int64
        ).reshape(-1, 4)
        self._camera = np.array([q.camera for q in p], dtype=np.int64)
        self._corners = np.stack([q.size_m * CORNERS for q in p]) if p else np.zeros((0, 4, 3))
        self._seen = np.stack([q.corners_px for q in p]) if p else np.zeros((0, 4, 2))
        self._sigma = np.array([q.sigma_px for q in p])
        self._pattern: BlockPattern | None = None

    def expanded(self, poses: Float[Array, "n 4 4"]) -> Expansion:
        """The cost, J' W J and J' W r over all factors."""
        terms: list[Terms] = []
        cost = 0.0
        if len(self._chain):
            residual, jacobians = self._linearised(poses)
            each, weight = self._robust(np.linalg.norm(residual, axis=-1) / self._sigma[:, None])
            cost = float(each.sum())
            root = np.sqrt(weight) / self._sigma[:, None]
            residual = (residual * root[..., None]).reshape(len(residual), 8)
            scaled = [(J * root[..., None, None]).reshape(len(residual), 8, 6) for J in jacobians]
            terms.append((residual, scaled, self._chain))
        others = self._others(poses)
        cost += sum(0.5 * float((residuals**2).sum()) for residuals, *_ in others)
        terms += others
        if self._pattern is None:
            self._pattern = BlockPattern(len(poses), [index for _, _, index in terms])
        information, right = self._pattern.sum(terms)
        return Expansion(cost, information, -right)

    def residuals_px(self, poses: Float[Array, "n 4 4"]) -> Float[Array, "m 4 2"]:
        return self._pixels(poses)[0]

    def _pixels(self, poses: Float[Array, "n 4 4"]) -> tuple[Array, Array, Array, Array]:
        """Residuals (m, 4, 2), points in the body, rig and camera frames (m, 4, 3)."""
        camera, rig, body, tag = (poses[self._chain[:, i]] for i in range(4))
        in_body = move(tag, self._corners)
        in_rig = move(inverse_poses(rig), move(body, in_body))
        in_camera = move(inverse_poses(camera), in_rig)
        return self._project(in_camera) - self._seen, in_body, in_rig, in_camera

    def _project(self, points: Float[Array, "m k 3"]) -> Float[Array, "m k 2"]:
        """Pixels; points at or behind the camera give a huge residual instead of none."""
        safe = points.copy()
        safe[..., 2] = np.maximum(safe[..., 2], 0.01)
        out = np.empty((*points.shape[:2], 2))
        for number, camera in enumerate(self._graph.cameras):
            mine = self._camera == number
            out[mine] = camera.project(safe[mine])
        return out

    def _linearised(self, poses: Float[Array, "n 4 4"]) -> tuple[Array, list[Array]]:
        """Residuals and their Jacobians (m, 4, 2, 6) by the four poses of the chain."""
        residual, in_body, in_rig, in_camera = self._pixels(poses)
        h = 1e-6 * np.maximum(in_camera[..., 2:], 0.05)
        columns = []
        for axis in np.eye(3):
            columns.append((self._project(in_camera + h * axis) - self._project(in_camera - h * axis)) / (2 * h))
        by_point = np.stack(columns, axis=-1)  # (m, 4, 2, 3)
        camera, rig, body, tag = (poses[self._chain[:, i]][:, None, :3, :3] for i in range(4))
        turn_camera = np.swapaxes(camera, -1, -2)
        turn_rig = turn_camera @ np.swapaxes(rig, -1, -2)
        identity = np.broadcast_to(np.eye(3), (*in_rig.shape, 3))
        by_camera = np.concatenate([se3.skew(in_camera), -identity], -1)
        by_rig = turn_camera @ np.concatenate([se3.skew(in_rig), -identity], -1)
        by_body = turn_rig @ body @ np.concatenate([-se3.skew(in_body), identity], -1)
        by_tag = turn_rig @ body @ tag @ np.concatenate([-se3.skew(self._corners), identity], -1)
        return residual, [by_point @ J for J in (by_camera, by_rig, by_body, by_tag)]

    def _robust(self, scaled: Float[Array, "m 4"]) -> tuple[Float[Array, "m 4"], Float[Array, "m 4"]]:
        """Huber's cost and weight of residuals in standard deviations."""
        k = self._config.huber_px
        if k is None:
            return 0.5 * scaled**2, np.ones_like(scaled)
        return huber_cost(scaled, k), huber_weight(scaled, k)

    def _others(self, poses: Float[Array, "n 4 4"]) -> list[tuple[Array, list[Array], Int[Array, "m k"]]]:
        """Whitened residuals (m, d), Jacobians (m, d, 6) by pose, and the poses' indices, of all other factors."""
        out = []
        if self._graph.priors:
            out.append(prior_terms(self._graph.priors, poses))
        if self._graph.betweens:
            out.append(between_terms(self._graph.betweens, poses))
        if self._graph.coordinates:
            out.append(coordinate_terms(self._graph.coordinates, poses))
        if self._graph.distances:
            out.append(distance_terms(self._graph.distances, poses))
        if self._graph.arcs:
            out.append(arc_terms(self._graph.arcs, poses))
        return out
