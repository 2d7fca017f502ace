"""Bundle adjustment of cameras that look at known points: poses of cameras, views and tags, lenses where asked for.

A point p of piece g, seen by camera c in view v, lies in that camera at X = C_c V_v G_g (s_g p + d_m), with the scale
s, C = camera_from_rig, V = rig_from_body, G = body_from_piece, and d the shift of the printed mark m that p belongs to.
Each is free or fixed, and so is each camera's lens. Two more are known beforehand to be small: the marks' shifts d (no
printer puts marks quite where they should be) and a slip of each image as a whole, which makes its points err alike.
Residuals are whitened by the pixels' covariances; Huber's weight tames outliers. The normal equations are small here
(some hundred unknowns). Free poses move by left increments exp([w, t]^) P, so a pose's
covariance is that of (rotation vector, translation) in the frame it maps to.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy import sparse

from calibration.cameras.poses import exp_poses
from calibration.cameras.projection_derivatives import by_lens, by_motion, by_point, lens_numbers, projected, with_lens
from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight
from recordings.geometry import CameraModel

POSE = 6
STEPS = 100
"""Where views hardly tell focal length from distance, forty steps stop 1 % short of the least residual."""
SMALL_GAIN = 1e-6
BEHIND_PX = 1e4
"""Residual of a point that came to lie behind its camera."""


@dataclass(frozen=True, eq=False)
class Observations:
    """n points: which camera, view and piece each belongs to, where it is in its piece, where it was seen, and the
    whitening W of its pixel (W^T W = inverse covariance)."""

    camera: Int[Array, " n"]
    view: Int[Array, " n"]
    piece: Int[Array, " n"]
    points_m: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    whitening: Float[Array, "n 2 2"]
    mark: Int[Array, " n"] | None = None
    """Which printed mark a point belongs to; -1: one that lies where it is said to."""
    image: Int[Array, " n"] | None = None
    """Which image a point is in, for what shifts an image as a whole."""

    def __len__(self) -> int:
        return len(self.camera)

    def chosen(self, keep: Bool[Array, " n"]) -> Observations:
        return Observations(
            self.camera[keep],
            self.view[keep],
            self.piece[keep],
            self.points_m[keep],
            self.pixels[keep],
            self.whitening[keep],
            None if self.mark is None else self.mark[keep],
            None if self.image is None else self.image[keep],
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """The unknowns at some values. `free_*` say which of them move."""

    models: tuple[CameraModel, ...]
    camera_from_rig: Float[Array, "c 4 4"]
    rig_from_body: Float[Array, "v 4 4"]
    body_from_piece: Float[Array, "g 4 4"]
    free_cameras: Bool[Array, " c"]
    free_views: Bool[Array, " v"]
    free_pieces: Bool[Array, " g"]
    free_lenses: Bool[Array, " c"]
    scale: Float[Array, " g"]
    """True size of a piece / given size; `free_scales` let it be found."""
    free_scales: Bool[Array, " g"]
    shift_m: Float[Array, "m 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    """Of printed marks from where they should be, on their piece."""
    print_m: float | None = None
    """Standard deviation of such a shift by axis; None: the shifts stay as they are."""
    slip_px: Float[Array, "i 2"] = field(default_factory=lambda: np.zeros((0, 2)))
    """By how much an image is shifted as a whole."""
    steady_px: float | None = None
    """Standard deviation of such a slip by axis; None: they stay as they are."""
    still_numbers: tuple[int, ...] = ()
    """By camera, how many of the last numbers of its lens stay where it is free; empty: none."""

    def lens_width(self, camera: int) -> int:
        """How many numbers of a free lens move."""
        still = self.still_numbers[camera] if self.still_numbers else 0
        return len(lens_numbers(self.models[camera])) - still


@dataclass(frozen=True, eq=False)
class Solved:
    """`residual_px` (n, 2) seen minus predicted (what an image slips is left in); `covariance` of all free numbers,
    scaled by what is left over.

    `blocks[("camera", 1)]` is the slice of camera 1's six numbers in it; ("lens", 1) fx fy cx cy and the
    distortion, without what stays of it.
    """

    scene: Scene
    residual_px: Float[Array, "n 2"]
    weight: Float[Array, " n"]
    covariance: Float[Array, "u u"]
    blocks: Mapping[tuple[str, int], slice]
    scores: Float[Array, "u v"]
    """How the points of each view pull at the free numbers: minus half the gradient of their cost."""
    scale: float
    """Left over / expected: above 1, the pixels scatter more than their covariances say."""
    weakest: float
    """Smallest eigenvalue of the scaled normal matrix: near 0 when something is undetermined."""
    weakest_block: tuple[str, int]

    @property
    def rms_px(self) -> float:
        """Root mean square of a coordinate over points that count."""
        counts = self.weight > 0.2
        return float(np.sqrt((self.residual_px[counts] ** 2).mean())) if counts.any() else float("nan")

    def std(self, kind: str, number: int) -> Float[Array, " k"]:
        """Standard deviations of a block's numbers (zeros where it is fixed)."""
        where = self.blocks.get((kind, number))
        if where is None:
            return np.zeros(POSE)
        return np.sqrt(np.maximum(np.diag(self.covariance)[where], 0.0))


def adjust(scene: Scene, seen: Observations, huber: float | None = 3.0) -> Solved:
    """Minimise the whitened reprojection errors. `huber`: in standard deviations; None for plain least squares."""
    blocks, size = _blocks(scene)

    def expanded(at: Scene) -> _Linear:
        residual, weight, jacobian = _linearised(at, seen, blocks, size, huber)
        normal, gradient = _normal(jacobian, residual, weight, at, blocks)
        return _Linear(_cost(residual, huber) + _prior_cost(at), normal, gradient, residual, weight, jacobian)

    found = minimised(scene, expanded, lambda at, step: _moved(at, blocks, step), STEPS, SMALL_GAIN)
    return _finished(found.state, seen, blocks, found.at)


@dataclass(frozen=True, eq=False)
class _Linear(Expansion):
    """With the whitened residuals, their weights and derivatives."""

    residual: Float[Array, "n 2"]
    weight: Float[Array, " n"]
    jacobian: sparse.csr_matrix


def _finished(
    scene: Scene,
    seen: Observations,
    blocks: Mapping[tuple[str, int], slice],
    at: _Linear,
) -> Solved:
    normal, residual, weight = at.information, at.residual, at.weight
    scaling = 1.0 / np.sqrt(np.maximum(np.diag(normal), 1e-12))
    scaled = normal * np.outer(scaling, scaling) if len(normal) else np.ones((1, 1))
    values, vectors = np.linalg.eigh(scaled)
    known = sum(values.size for _, values, _ in _known_beforehand(scene))
    spare = max(1.0, 2.0 * float(weight.sum()) + known - len(normal))
    left = float((weight * (residual**2).sum(axis=1)).sum()) + 2 * _prior_cost(scene)
    scale = float(np.sqrt(left / spare))
    inverse = np.linalg.pinv(normal, hermitian=True, rcond=1e-13)
    worst = int(np.abs(vectors[:, 0]).argmax()) if len(normal) else -1
    named = next((name for name, where in blocks.items() if where.start <= worst < where.stop), ("none", -1))
    return Solved(
        scene,
        _slips(scene, seen) - np.linalg.solve(seen.whitening, residual[..., None])[..., 0],
        weight,
        inverse * max(scale, 1.0) ** 2,
        blocks,
        _scores(at.jacobian, residual, weight, seen),
        scale,
        float(values[0]),
        named,
    )


def _scores(
    jacobian: sparse.csr_matrix, residual: Float[Array, "n 2"], weight: Float[Array, " n"], seen: Observations
) -> Float[Array, "u v"]:
    views, view = np.unique(seen.view, return_inverse=True)
    rows = np.arange(2 * len(seen))
    values = -(weight[:, None] * residual).ravel()
    by_view = sparse.csr_matrix((values, (rows, np.repeat(view, 2))), shape=(len(rows), len(views)))
    return (jacobian.T @ by_view).toarray()


def _blocks(scene: Scene) -> tuple[dict[tuple[str, int], slice], int]:
    blocks: dict[tuple[str, int], slice] = {}
    at = 0
    for kind, free in (("camera", scene.free_cameras), ("view", scene.free_views), ("piece", scene.free_pieces)):
        for number in np.flatnonzero(free).tolist():
            blocks[kind, number] = slice(at, at + POSE)
            at += POSE
    for number in np.flatnonzero(scene.free_lenses).tolist():
        count = scene.lens_width(number)
        blocks["lens", number] = slice(at, at + count)
        at += count
    for number in np.flatnonzero(scene.free_scales).tolist():
        blocks["scale", number] = slice(at, at + 1)
        at += 1
    for kind, values, _ in _known_beforehand(scene):
        for number in range(len(values)):
            blocks[kind, number] = slice(at, at + values.shape[1])
            at += values.shape[1]
    return blocks, at


def _known_beforehand(scene: Scene) -> list[tuple[str, Float[Array, "m k"], float]]:
    """The free numbers that are 0 give or take a standard deviation."""
    both = (("mark", scene.shift_m, scene.print_m), ("image", scene.slip_px, scene.steady_px))
    return [(kind, values, std) for kind, values, std in both if std is not None and len(values)]


def _chained(scene: Scene, seen: Observations) -> tuple[Array, Array, Array]:
    """The points in their body, in the rig and in their camera."""
    g, v, c = scene.body_from_piece[seen.piece], scene.rig_from_body[seen.view], scene.camera_from_rig[seen.camera]
    on_piece = scene.scale[seen.piece, None] * seen.points_m
    if seen.mark is not None and len(scene.shift_m):
        on_piece = on_piece + np.where(seen.mark[:, None] >= 0, scene.shift_m[seen.mark], 0.0)
    in_body = np.einsum("nij,nj->ni", g[:, :3, :3], on_piece) + g[:, :3, 3]
    in_rig = np.einsum("nij,nj->ni", v[:, :3, :3], in_body) + v[:, :3, 3]
    return in_body, in_rig, np.einsum("nij,nj->ni", c[:, :3, :3], in_rig) + c[:, :3, 3]


def _whitened(scene: Scene, seen: Observations) -> tuple[Float[Array, "n 2"], Float[Array, "n 3"]]:
    """Whitened predicted minus seen, and the points in their cameras."""
    in_camera = _chained(scene, seen)[2]
    gap = projected(scene.models, seen.camera, in_camera) - seen.pixels
    gap = gap + _slips(scene, seen)
    gap = np.where(np.isfinite(gap), gap, BEHIND_PX)
    return np.einsum("nij,nj->ni", seen.whitening, gap), in_camera


def _slips(scene: Scene, seen: Observations) -> Float[Array, "n 2"]:
    """Of the image that each point is in."""
    if seen.image is None or not len(scene.slip_px):
        return np.zeros((len(seen), 2))
    return scene.slip_px[seen.image]


def _cost(residual: Float[Array, "n 2"], huber: float | None) -> float:
    length = np.linalg.norm(residual, axis=1)
    return float((0.5 * length**2 if huber is None else huber_cost(length, huber)).sum())


def _linearised(
    scene: Scene, seen: Observations, blocks: Mapping[tuple[str, int], slice], size: int, huber: float | None
) -> tuple[Float[Array, "n 2"], Float[Array, " n"], sparse.csr_matrix]:
    residual, in_camera = _whitened(scene, seen)
    length = np.maximum(np.linalg.norm(residual, axis=1), 1e-12)
    weight = np.ones(len(length)) if huber is None else huber_weight(length, huber)
    rows, columns, values = [], [], []
    owners = {"view": seen.view, "piece": seen.piece, "scale": seen.piece, "mark": seen.mark, "image": seen.image}
    for kind, part in _derivatives(scene, seen, in_camera).items():
        owner = owners.get(kind, seen.camera)
        if owner is None:
            continue
        for number in np.unique(owner).tolist():
            where = blocks.get((kind, number))
            if where is None:
                continue
            mine = np.flatnonzero(owner == number)
            width = where.stop - where.start
            row = (2 * mine[:, None, None] + np.arange(2)[None, :, None]) + np.zeros(width, dtype=np.int64)
            rows.append(row.ravel())
            columns.append(np.broadcast_to(np.arange(where.start, where.stop), row.shape).ravel())
            values.append(part[mine][:, :, :width].ravel())
    shape = (2 * len(seen), size)
    if not rows:
        return residual, weight, sparse.csr_matrix(shape)
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return residual, weight, sparse.csr_matrix(entries, shape=shape)


def _derivatives(scene: Scene, seen: Observations, in_camera: Float[Array, "n 3"]) -> dict[str, Array]:
    """Of the whitened residual by each kind of unknown: (n, 2, 6) for poses, (n, 2, k) for lenses."""
    in_body, in_rig, _ = _chained(scene, seen)
    moved = seen.whitening @ by_point(scene.models, seen.camera, in_camera)
    R_c, R_v = scene.camera_from_rig[seen.camera, :3, :3], scene.rig_from_body[seen.view, :3, :3]
    found = {
        "camera": moved @ by_motion(in_camera),
        "view": moved @ R_c @ by_motion(in_rig),
        "piece": moved @ R_c @ R_v @ by_motion(in_body),
    }
    if scene.free_scales.any():
        along = np.einsum("nij,nj->ni", scene.body_from_piece[seen.piece, :3, :3], seen.points_m)
        found["scale"] = moved @ R_c @ R_v @ along[:, :, None]
    if scene.print_m is not None and seen.mark is not None:
        found["mark"] = moved @ R_c @ R_v @ scene.body_from_piece[seen.piece, :3, :3]
    if scene.steady_px is not None and seen.image is not None:
        found["image"] = seen.whitening
    if scene.free_lenses.any():
        found["lens"] = seen.whitening @ by_lens(scene.models, scene.free_lenses, seen.camera, in_camera)
    return {kind: np.nan_to_num(part) for kind, part in found.items()}


def _normal(
    jacobian: sparse.csr_matrix,
    residual: Float[Array, "n 2"],
    weight: Float[Array, " n"],
    scene: Scene,
    blocks: Mapping[tuple[str, int], slice],
) -> tuple[Float[Array, "u u"], Float[Array, " u"]]:
    """Of what was seen, and of where marks are known to lie beforehand."""
    weights = np.repeat(weight, 2)
    weighted = jacobian.multiply(weights[:, None]).tocsr()
    normal, gradient = (jacobian.T @ weighted).toarray(), weighted.T @ residual.ravel()
    for kind, values, std in _known_beforehand(scene):
        where = np.arange(values.size) + blocks[kind, 0].start
        normal[where, where] += 1 / std**2
        gradient[where] += values.ravel() / std**2
    return normal, gradient


def _prior_cost(scene: Scene) -> float:
    return sum((0.5 * float((values**2).sum()) / std**2 for _, values, std in _known_beforehand(scene)), 0.0)


def _moved(scene: Scene, blocks: Mapping[tuple[str, int], slice], step: Float[Array, " u"]) -> Scene:
    poses = {
        "camera": scene.camera_from_rig.copy(),
        "view": scene.rig_from_body.copy(),
        "piece": scene.body_from_piece.copy(),
    }
    models, scale = list(scene.models), scene.scale.copy()
    slight = {"mark": scene.shift_m.copy(), "image": scene.slip_px.copy()}
    for (kind, number), where in blocks.items():
        if kind == "lens":
            moved = lens_numbers(models[number])
            moved[: where.stop - where.start] += step[where]
            moved[:2] = np.maximum(moved[:2], 1.0)
            moved[2:4] = np.clip(moved[2:4], 0, [models[number].width - 1, models[number].height - 1])
            models[number] = with_lens(models[number], moved)
        elif kind == "scale":
            scale[number] *= np.exp(step[where][0] / scale[number])
        elif kind in slight:
            slight[kind][number] += step[where]
        else:
            poses[kind][number] = exp_poses(step[where][None])[0] @ poses[kind][number]
    return replace(
        scene,
        models=tuple(models),
        scale=scale,
        shift_m=slight["mark"],
        slip_px=slight["image"],
        camera_from_rig=poses["camera"],
        rig_from_body=poses["view"],
        body_from_piece=poses["piece"],
    )
