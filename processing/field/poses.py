"""Refining the views' poses in the field: Gauss-Newton on every view's own pixels, geometry and colour together.

Adam moves a pose by a few random rays a step and settles at twice the error of the pixels' own noise; the normal
equations of all pixels of a view are six by six and need three steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from processing.engine.parts import in_parts
from processing.field.network import ObjectField
from processing.field.rays import RayDataset
from processing.sensor.noise import PUBLISHED, DepthNoise
from recordings.constants import LUMA

PART = 2**15
"""Points in one part of the work."""


@dataclass(frozen=True)
class PoseConfig:
    iterations: int = 3
    """Gauss-Newton steps a round."""
    most_pixels: int = 1500
    """Pixels a view, drawn at random."""
    noise: DepthNoise = PUBLISHED
    """How depth errs, and how many neighbouring pixels, in colour too, say one thing: as the session shows it."""
    color_sigma: float = 0.07
    """Of luminance, 0..1."""
    prior_rotation_rad: float = 0.02
    """How far the tracker's pose may be off, standard deviation."""
    prior_translation_m: float = 0.004


def refine_poses(
    model: ObjectField, rotation: Tensor, translation: Tensor, dataset: RayDataset, config: PoseConfig
) -> tuple[Tensor, Tensor, Tensor]:
    """New `camera_from_object` rotations (n, 3, 3), translations (n, 3) and information matrices (n, 6, 6).

    The correction acts in object axes about the object's origin: x_object -> x + w x x + t. The mean correction over
    the views is taken out, because the object frame is a free choice.
    """
    rays = _draw(dataset, len(rotation), config.most_pixels)
    start_rotation, start_translation = rotation, translation
    information = torch.zeros(len(rotation), 6, 6, device=rotation.device)
    for _ in range(config.iterations):
        information, right = _normal_equations(model, rotation, translation, dataset, rays, config)
        prior = torch.tensor(
            [config.prior_rotation_rad**-2] * 3 + [config.prior_translation_m**-2] * 3, device=rotation.device
        )
        moved = _correction_between(start_rotation, start_translation, rotation, translation)
        step = torch.linalg.solve(information + torch.diag(prior), right - prior * moved)
        step = step - step.mean(0, keepdim=True)
        rotation, translation = _apply(rotation, translation, step)
    return rotation, translation, information


def _with_gradient(function: Callable[[Tensor], Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
    """Values (n,) of a function of points and their gradients (n, 3)."""

    def of_some(some: slice) -> tuple[Tensor, Tensor]:
        chosen = points[some].detach().requires_grad_(True)
        values = function(chosen)
        (gradient,) = torch.autograd.grad(values.sum(), chosen)
        return values.detach(), gradient

    values, gradients = zip(*in_parts(of_some, len(points), PART), strict=True)
    return torch.cat(values), torch.cat(gradients)


def _draw(dataset: RayDataset, views: int, most: int) -> Tensor:
    """Indices of at most `most` rays of each view."""
    order = torch.randperm(len(dataset.view), device=dataset.view.device)
    view = dataset.view[order]
    by_view = torch.argsort(view, stable=True)
    start = torch.searchsorted(view[by_view].contiguous(), torch.arange(views, device=view.device))
    rank = torch.arange(len(by_view), device=view.device) - start[view[by_view]]
    return order[by_view[rank < most]]


def _normal_equations(
    model: ObjectField, rotation: Tensor, translation: Tensor, dataset: RayDataset, rays: Tensor, config: PoseConfig
) -> tuple[Tensor, Tensor]:
    view = dataset.view[rays]
    direction = dataset.direction[rays]
    in_camera = direction * dataset.depth[rays][:, None]
    points = ((in_camera - translation[view])[:, None, :] @ rotation[view])[:, 0]
    along = (direction[:, None, :] @ rotation[view])[:, 0]
    sdf, sdf_gradient = _with_gradient(lambda x: model.sdf(x), points)
    facing = (sdf_gradient * along).sum(-1)
    facing = torch.where(facing < -0.2, facing, torch.full_like(facing, -0.2))
    on_surface = points - (sdf / facing).clamp(-0.004, 0.004)[:, None] * along
    luma, luma_gradient = _with_gradient(lambda x: model.color(x) @ torch.tensor(LUMA, device=x.device), on_surface)
    luma_gradient = luma_gradient - sdf_gradient * ((luma_gradient * along).sum(-1) / facing)[:, None]
    seen = dataset.rgb[rays] @ torch.tensor(LUMA, device=points.device)
    depth_sigma = config.noise.sigma_at_1m * dataset.depth[rays] ** 2
    independent = _independent(dataset, rays, len(rotation), config.noise.patch_px)
    colored = dataset.colored[rays]
    difference = _less_exposure(luma - seen, view, len(rotation), colored)
    information = torch.zeros(len(rotation), 6, 6, device=points.device)
    right = torch.zeros(len(rotation), 6, device=points.device)
    for residual, gradient, sigma, outlier in (
        (sdf, sdf_gradient, depth_sigma, 6.0),
        (difference, luma_gradient, torch.full_like(depth_sigma, config.color_sigma), float("inf")),
    ):
        jacobian = torch.cat([torch.linalg.cross(points, gradient), gradient], -1)
        scaled = (residual / sigma).abs()
        weight = torch.where(scaled < 1.5, torch.ones_like(scaled), 1.5 / scaled) / sigma**2
        weight = torch.where(scaled < outlier, weight, torch.zeros_like(weight)) * independent
        if residual is difference:
            weight = weight * colored
        information.index_add_(0, view, weight[:, None, None] * jacobian[:, :, None] * jacobian[:, None, :])
        right.index_add_(0, view, -(weight * residual)[:, None] * jacobian)
    return information, right


def _independent(dataset: RayDataset, rays: Tensor, views: int, patch_px: float) -> Tensor:
    """Weight of each drawn ray (1 at most) by which all of a view count as its pixels would if one in `patch_px` were
    independent."""
    seen, drawn = (torch.bincount(v, minlength=views) for v in (dataset.view, dataset.view[rays]))
    return (seen / (patch_px * drawn.clamp(min=1))).clamp(max=1.0)[dataset.view[rays]]


def _less_exposure(difference: Tensor, view: Tensor, views: int, colored: Tensor) -> Tensor:
    """Luminance differences less their mean in each view over coloured pixels: auto exposure drifts."""
    total = torch.zeros(views, device=difference.device).index_add_(0, view, difference * colored)
    count = torch.zeros(views, device=difference.device).index_add_(0, view, colored)
    return difference - (total / count.clamp(min=1))[view]


def _apply(rotation: Tensor, translation: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
    """camera_from_object after the correction x -> exp(w) x + t of object coordinates."""
    turn = torch.linalg.matrix_exp(_skew(step[:, :3]))
    new_rotation = rotation @ turn.transpose(1, 2)
    return new_rotation, translation - (new_rotation @ step[:, 3:, None])[..., 0]


def _correction_between(rotation_a: Tensor, translation_a: Tensor, rotation_b: Tensor, translation_b: Tensor) -> Tensor:
    """The correction (w, t) that leads from pose a to pose b (small angles)."""
    turn = rotation_b.transpose(1, 2) @ rotation_a
    w = 0.5 * torch.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], -1
    )
    t = (rotation_b.transpose(1, 2) @ (translation_a - translation_b)[..., None])[..., 0]
    return torch.cat([w, t], -1)


def _skew(w: Tensor) -> Tensor:
    zero = torch.zeros_like(w[:, 0])
    rows = [zero, -w[:, 2], w[:, 1], w[:, 2], zero, -w[:, 0], -w[:, 1], w[:, 0], zero]
    return torch.stack(rows, -1).reshape(-1, 3, 3)
