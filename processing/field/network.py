"""The neural object field: signed distance and colour of points of the object frame."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from processing.field.fuse import Grid

RESOLUTION, FEATURES, HIDDEN = 64, 4, 32
"""Nodes of the feature grid along an axis, features of a node, width of the networks' layers."""


class ObjectField(nn.Module):
    """sdf(x) = warm start(x) + truncation * residual(features(x)); colour likewise, through a deeper network.

    The warm start is the fused grid of distance and colour, itself a parameter, and so is the grid of features. Points
    are metres in the object frame; distances are metres, positive outside. Colours are RGB, 0..1 (not clipped).
    """

    low: Tensor
    size: Tensor

    def __init__(self, grid: Grid) -> None:
        super().__init__()
        shape = np.array(grid.sdf_m.shape)
        self.register_buffer("low", torch.tensor(grid.origin_m, dtype=torch.float32))
        self.register_buffer("size", torch.tensor((shape - 1) * grid.voxel_m, dtype=torch.float32))
        self.truncation_m = grid.truncation_m
        distance_m = torch.tensor(grid.sdf_m.clip(-0.03, 0.03))
        self.warm_distance = nn.Parameter(distance_m[None, None])
        self.warm_color = nn.Parameter(torch.tensor(np.ascontiguousarray(np.moveaxis(grid.rgb, -1, 0)))[None])
        self.features = nn.Parameter(torch.zeros(1, FEATURES, RESOLUTION, RESOLUTION, RESOLUTION))
        nn.init.uniform_(self.features, -1e-2, 1e-2)
        self.geometry = nn.Sequential(nn.Linear(FEATURES, HIDDEN), nn.Softplus(beta=100), nn.Linear(HIDDEN, 1))
        self.appearance = nn.Sequential(
            nn.Linear(FEATURES, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 3)
        )
        for last in (self.geometry[-1], self.appearance[-1]):
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def sdf(self, points_m: Tensor) -> Tensor:
        """Signed distance (n,) in metres."""
        unit = self._unit(points_m)
        return self._distance(unit, sample_grid(self.features, unit))

    def color(self, points_m: Tensor) -> Tensor:
        """Colour (n, 3)."""
        unit = self._unit(points_m)
        return self._color(unit, sample_grid(self.features, unit))

    def sdf_and_color(self, points_m: Tensor, colored_m: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance of some points and colour of others. One pass: the gradient of a grid is a grid, so that
        every further pass costs one more of its size."""
        unit = self._unit(torch.cat([points_m, colored_m]))
        features, n = sample_grid(self.features, unit), len(points_m)
        return self._distance(unit[:n], features[:n]), self._color(unit[n:], features[n:])

    def _unit(self, points_m: Tensor) -> Tensor:
        return (points_m - self.low) / self.size

    def _distance(self, unit: Tensor, features: Tensor) -> Tensor:
        return sample_grid(self.warm_distance, unit)[:, 0] + self.truncation_m * self.geometry(features)[:, 0]

    def _color(self, unit: Tensor, features: Tensor) -> Tensor:
        return sample_grid(self.warm_color, unit) + self.appearance(features)


def sample_grid(grid: Tensor, points: Tensor) -> Tensor:
    """Trilinear values (n, c) of a grid (1, c, a, b, k) at points (n, 3) in [0, 1] along its three axes."""
    at = (points.flip(-1) * 2 - 1).reshape(1, 1, 1, -1, 3)
    out = functional.grid_sample(grid, at, mode="bilinear", padding_mode="border", align_corners=True)
    return out.reshape(grid.shape[1], -1).T
