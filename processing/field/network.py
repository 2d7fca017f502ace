"""The neural object field: signed distance and colour of points of the object frame."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from processing.field.encoding import EncodingName, make_encoding, sample_grid
from processing.field.fuse import Grid


class ObjectField(nn.Module):
    """sdf(x) = warm start(x) + truncation * residual(encoding(x)); colour likewise, through a deeper network.

    The warm start is the fused grid of distance and colour, itself a parameter. Points are metres in the object frame;
    distances are metres, positive outside. Colours are RGB, 0..1 (not clipped).
    """

    low: Tensor
    size: Tensor

    def __init__(self, grid: Grid, encoding: EncodingName, hidden: int = 32) -> None:
        super().__init__()
        shape = np.array(grid.sdf_m.shape)
        self.register_buffer("low", torch.tensor(grid.origin_m, dtype=torch.float32))
        self.register_buffer("size", torch.tensor((shape - 1) * grid.voxel_m, dtype=torch.float32))
        self.truncation_m = grid.truncation_m
        distance_m = torch.tensor(grid.sdf_m.clip(-0.03, 0.03))
        self.warm_distance = nn.Parameter(distance_m[None, None])
        self.warm_color = nn.Parameter(torch.tensor(np.ascontiguousarray(np.moveaxis(grid.rgb, -1, 0)))[None])
        self.encoding = make_encoding(encoding)
        n = self.encoding.features
        self.geometry = nn.Sequential(nn.Linear(n, hidden), nn.Softplus(beta=100), nn.Linear(hidden, 1))
        self.appearance = nn.Sequential(
            nn.Linear(n, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 3)
        )
        for last in (self.geometry[-1], self.appearance[-1]):
            assert isinstance(last, nn.Linear)
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def sdf(self, points_m: Tensor) -> Tensor:
        """Signed distance (n,) in metres."""
        unit = self._unit(points_m)
        return self._distance(unit, self.encoding(unit))

    def color(self, points_m: Tensor) -> Tensor:
        """Colour (n, 3)."""
        unit = self._unit(points_m)
        return self._color(unit, self.encoding(unit))

    def sdf_and_color(self, points_m: Tensor, colored_m: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance of some points and colour of others. One pass: the gradient of a grid is a grid, so that
        every further pass costs one more of its size."""
        unit = self._unit(torch.cat([points_m, colored_m]))
        features, n = self.encoding(unit), len(points_m)
        return self._distance(unit[:n], features[:n]), self._color(unit[n:], features[n:])

    def _unit(self, points_m: Tensor) -> Tensor:
        return (points_m - self.low) / self.size

    def _distance(self, unit: Tensor, features: Tensor) -> Tensor:
        return sample_grid(self.warm_distance, unit)[:, 0] + self.truncation_m * self.geometry(features)[:, 0]

    def _color(self, unit: Tensor, features: Tensor) -> Tensor:
        return sample_grid(self.warm_color, unit) + self.appearance(features)
