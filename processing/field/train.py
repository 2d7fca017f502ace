"""Training the neural object field on masked RGBD views, with the poses refined jointly.

After BundleSDF (Wen et al. 2023): three regions along each ray (near the surface, free space, rays that pass the
object), an Eikonal term and a colour term. Two departures: a sample's target distance is measured to the pixel's local
plane and not along the ray, and the network starts at the fused grid.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from processing.engine.adam import Adam
from processing.engine.parts import side_by_side
from processing.field.fuse import FuseConfig, Grid, fuse
from processing.field.network import ObjectField
from processing.field.poses import PoseConfig, refine_poses
from processing.field.rays import RayDataset, make_ray_dataset
from processing.field.views import FieldView
from recordings.geometry import nearest_rotation
from recordings.progress import Progress, Silent
from recordings.tracks import ObjectShape


@dataclass(frozen=True)
class FieldConfig:
    fuse: FuseConfig = field(default_factory=lambda: FuseConfig(truncation_m=0.005))
    """The warm start."""
    steps: int = 60
    """Optimiser steps."""
    rays: int = 2048
    """Object rays a step; a quarter as many rays that pass the object."""
    near_samples: int = 3
    """Samples of each ray within the truncation."""
    learning_rate: float = 1e-3
    """Adam's, of networks and features; decays to a tenth."""
    warm_learning_rate: float = 1e-5
    """Of the warm-start grid, metres a step."""
    pose_rounds: int = 2
    """How often the views are fused anew and their poses refined in what came out; 0 keeps the poses."""
    round_voxel_m: float = 0.002
    """Edge of a cell of what is fused for a round, where the surface matters and not its detail."""
    poses: PoseConfig = field(default_factory=PoseConfig)
    """The Gauss-Newton refinement of a round."""
    eikonal_weight: float = 0.02
    color_weight: float = 0.05
    free_weight: float = 0.2
    passing_weight: float = 0.2
    seed: int = 0


@dataclass(frozen=True, eq=False)
class TrainedField:
    """The field, its warm start, the refined views, and the loss of every tenth step."""

    field: ObjectField
    grid: Grid
    views: tuple[FieldView, ...]
    losses: tuple[float, ...]


def train_field(
    views: Sequence[FieldView],
    config: FieldConfig,
    device: str = "cpu",
    progress: Progress | None = None,
    prior_shape: ObjectShape | None = None,
) -> TrainedField:
    """Refine the poses and learn the field of one object. Raises BadInput when the views hold too few depth points.

    `prior_shape`: a shape, in the views' object frame, for what no view sees; without it that is the hull of the rest.

    Rounds of fusing and Gauss-Newton come first, because they are cheap; the network is trained once, at the end.
    """
    progress = progress or Silent()
    torch.manual_seed(config.seed)
    dataset = make_ray_dataset(views).to(device)
    total = config.pose_rounds + config.steps
    for done in range(config.pose_rounds):
        start = ObjectField(fuse(views, replace(config.fuse, voxel_m=config.round_voxel_m))).to(device)
        views = refined_views(start, views, dataset, config.poses)
        progress.step(done + 1, total, "field: poses")
    grid = fuse(views, config.fuse, prior_shape)
    model = ObjectField(grid).to(device)
    losses = _optimise(model, stack_poses(views, device), dataset, config, progress)
    return TrainedField(model, grid, tuple(views), losses)


def refined_views(
    model: ObjectField, views: Sequence[FieldView], dataset: RayDataset, config: PoseConfig
) -> list[FieldView]:
    """The views with both their poses moved by the correction that the field asks for."""
    rotation, translation = stack_poses(views, str(dataset.depth.device))
    rotation, translation, _ = refine_poses(model, rotation, translation, dataset, config)
    out = []
    for view, R, t in zip(views, rotation.double().cpu().numpy(), translation.double().cpu().numpy(), strict=True):
        at_depth = np.eye(4)
        at_depth[:3, :3], at_depth[:3, 3] = nearest_rotation(R), t
        old_from_new = np.linalg.inv(view.camera_from_object_at_depth) @ at_depth
        out.append(view.posed(view.camera_from_object @ old_from_new, at_depth))
    return out


def _optimise(
    model: ObjectField, poses: Poses, dataset: RayDataset, config: FieldConfig, progress: Progress
) -> tuple[float, ...]:
    networks = [model.features, *model.geometry.parameters(), *model.appearance.parameters()]
    warm = [model.warm_distance, model.warm_color]
    groups = [Adam(networks, config.learning_rate), Adam(warm, config.warm_learning_rate)]
    decay, losses = 0.1 ** (1 / max(config.steps, 1)), []
    for step in range(config.steps):
        loss = _with_gradients(halves_of_loss(model, poses, dataset, config), [*networks, *warm])
        list(side_by_side(lambda group: group.step(decay), groups))
        if step % 10 == 0:
            losses.append(loss)
        progress.step(config.pose_rounds + step + 1, config.pose_rounds + config.steps, "field: network")
    return tuple(losses)


def _with_gradients(halves: Sequence[Callable[[], Tensor]], parameters: Sequence[Tensor]) -> float:
    """The sum of the halves of a loss, each with its gradients in a thread of its own; their sum is left at the
    parameters."""

    def of(half: Callable[[], Tensor]) -> tuple[float, Sequence[Tensor | None]]:
        loss = half()
        return float(loss.detach()), torch.autograd.grad(loss, parameters, allow_unused=True)

    (one, gradients), (other, more) = side_by_side(of, halves)
    for parameter, a, b in zip(parameters, gradients, more, strict=True):
        parameter.grad = b if a is None else a if b is None else a.add_(b)
    return one + other


Poses = tuple[Tensor, Tensor]
"""Rotations (n, 3, 3) and translations (n, 3) of `camera_from_object` at depth exposure."""


def stack_poses(views: Sequence[FieldView], device: str) -> Poses:
    poses = torch.tensor(np.stack([v.camera_from_object_at_depth for v in views]), dtype=torch.float32, device=device)
    return poses[:, :3, :3], poses[:, :3, 3]


def to_object(poses: Poses, in_camera: Tensor, view: Tensor) -> Tensor:
    """Points (n, 3) of the camera into the object frame, each by its view's pose."""
    rotation, translation = poses
    return ((in_camera - translation[view])[:, None, :] @ rotation[view])[:, 0]


@dataclass(frozen=True, eq=False)
class Samples:
    """Points (n, 3) of the object frame where a loss term wants the distance, with what it wants there."""

    points_m: Tensor
    target_m: Tensor
    weight: Tensor


def halves_of_loss(
    model: ObjectField, poses: Poses, dataset: RayDataset, config: FieldConfig
) -> tuple[Callable[[], Tensor], Callable[[], Tensor]]:
    """Two parts of about the same work whose sum is the weighted sum over one random batch; each term is mean-square or
    mean-absolute in units of the truncation. The batch is drawn here, whatever thread computes what."""
    device = dataset.depth.device
    chosen = torch.randint(len(dataset.depth), (config.rays,), device=device)
    passing = torch.randint(max(len(dataset.passing_view), 1), (config.rays // 4,), device=device)
    near = near_surface_samples(model, poses, dataset, chosen, config.near_samples)
    free = free_space_samples(model, poses, dataset, chosen[: config.rays // 4])
    passing_m = passing_points(model, poses, dataset, passing) if len(dataset.passing_view) else near.points_m[:0]
    around_m = eikonal_points(near.points_m[: config.rays // 2].detach())
    surface_m = to_object(poses, dataset.direction[chosen] * dataset.depth[chosen][:, None], dataset.view[chosen])

    def measured() -> Tensor:
        parts = [near.points_m, free.points_m]
        distances, rgb = model.sdf_and_color(torch.cat(parts), surface_m)
        at_near, at_free = distances.split([len(p) for p in parts])
        loss = near_surface_loss(at_near, near, model.truncation_m)
        loss = loss + config.free_weight * free_space_loss(at_free, free, model.truncation_m)
        return loss + config.color_weight * ((rgb - dataset.rgb[chosen]).abs() * dataset.colored[chosen, None]).mean()

    def regular() -> Tensor:
        at_passing, at_around = model.sdf(torch.cat([passing_m, around_m])).split([len(passing_m), len(around_m)])
        loss = config.eikonal_weight * eikonal_loss(at_around)
        if len(passing_m) == 0:
            return loss
        inside = inside_only(model, passing_m, at_passing)
        return loss + config.passing_weight * passing_loss(inside, model.truncation_m)

    return measured, regular


def near_surface_samples(model: ObjectField, poses: Poses, dataset: RayDataset, chosen: Tensor, each: int) -> Samples:
    """Points within the truncation of the measured surface and their distance to the pixel's plane,
    (1 - n . x) / |n|."""
    rays = chosen.repeat_interleave(each)
    direction, depth, plane = dataset.direction[rays], dataset.depth[rays], dataset.plane[rays]
    along = (torch.rand(len(rays), device=depth.device) * 2 - 1) * model.truncation_m
    in_camera = direction * (depth + along / direction.norm(dim=-1))[:, None]
    target = (1 - (plane * in_camera).sum(-1)) / plane.norm(dim=-1)
    behind = torch.where(target < 0, 1 + target / model.truncation_m, torch.ones_like(target)).clamp(0.05)
    sharp = (dataset.depth.median() / depth) ** 4
    return Samples(to_object(poses, in_camera, dataset.view[rays]), target, behind * sharp.clamp(max=4))


def near_surface_loss(distance_m: Tensor, wanted: Samples, truncation_m: float) -> Tensor:
    """Weighted mean of the Huber loss of sdf(x) against x's distance to the pixel's plane."""
    gap = (distance_m - wanted.target_m) / truncation_m
    huber = torch.nn.functional.huber_loss(gap, torch.zeros_like(gap), reduction="none", delta=0.3)
    return (wanted.weight * huber).mean()


def free_space_samples(model: ObjectField, poses: Poses, dataset: RayDataset, chosen: Tensor) -> Samples:
    """Points well before the surface and the least distance there."""
    direction, depth = dataset.direction[chosen], dataset.depth[chosen]
    before = model.truncation_m * (1.5 + 4 * torch.rand(len(chosen), device=depth.device))
    in_camera = direction * (depth - before / direction.norm(dim=-1))[:, None]
    plane = dataset.plane[chosen]
    distance = (1 - (plane * in_camera).sum(-1)) / plane.norm(dim=-1)
    wanted = distance.clamp(0, model.truncation_m)
    return Samples(to_object(poses, in_camera, dataset.view[chosen]), wanted, torch.ones_like(wanted))


def free_space_loss(distance_m: Tensor, wanted: Samples, truncation_m: float) -> Tensor:
    """Mean square of what is missing to the least distance."""
    return ((wanted.target_m - distance_m).clamp(min=0) / truncation_m).square().mean()


PASSING_SAMPLES = 8
"""Points looked at on a ray that passes the object."""


def passing_points(model: ObjectField, poses: Poses, dataset: RayDataset, chosen: Tensor) -> Tensor:
    """Points on rays beside the mask, where they cross the box of the object."""
    view = dataset.passing_view[chosen]
    centre = poses[1][view] + (poses[0][view] @ (model.low + model.size / 2)[:, None])[..., 0]
    reach, k = model.size.norm() / 2, PASSING_SAMPLES
    steps = (torch.arange(k, device=view.device) + torch.rand(len(chosen), 1, device=view.device)) / k * 2 - 1
    in_camera = dataset.passing_direction[chosen][:, None, :] * (centre[:, 2:3] + reach * steps)[..., None]
    return to_object(poses, in_camera.reshape(-1, 3), view.repeat_interleave(k))


def inside_only(model: ObjectField, points_m: Tensor, distance_m: Tensor) -> Tensor:
    """How deep inside the object points are (n,), metres; 0 outside it and outside the grid."""
    unit = (points_m - model.low) / model.size
    within = ((unit > 0) & (unit < 1)).all(-1)
    return torch.where(within, (-distance_m).clamp(min=0), torch.zeros(()).to(points_m))


def passing_loss(inside_m: Tensor, truncation_m: float) -> Tensor:
    """A ray beside the mask never enters the object: mean square of the depth of its worst sample."""
    return (inside_m.reshape(-1, PASSING_SAMPLES).amax(1) / truncation_m).square().mean()


EIKONAL_M = 0.002
"""Half the base of the central differences."""


def eikonal_points(points_m: Tensor) -> Tensor:
    """Six neighbours (6 n, 3) of each point, two along each axis."""
    shifts = torch.eye(3, device=points_m.device) * EIKONAL_M
    return torch.cat([points_m + s for s in (*shifts, *-shifts)])


def eikonal_loss(distance_m: Tensor) -> Tensor:
    """Mean square of |gradient| - 1 from the distances at `eikonal_points`."""
    ahead, behind = distance_m.reshape(2, 3, -1)
    return ((ahead - behind).norm(dim=0) / (2 * EIKONAL_M) - 1).square().mean()
