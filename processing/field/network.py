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
        warm = np.concatenate([grid.sdf_m[None].clip(-0.03, 0.03), np.moveaxis(grid.rgb, -1, 0)])
        self.warm = nn.Parameter(torch.tensor(warm)[None])
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

    def forward(self, points_m: Tensor) -> tuple[Tensor, Tensor]:
        """Signed distance (n,) in metres and colour (n, 3)."""
        unit = (points_m - self.low) / self.size
        features = self.encoding(unit)
        warm = sample_grid(self.warm, unit)
        sdf_m = warm[:, 0] + self.truncation_m * self.geometry(features)[:, 0]
        return sdf_m, warm[:, 1:] + self.appearance(features)

    def sdf(self, points_m: Tensor) -> Tensor:
        """Signed distance (n,) in metres."""
        unit = (points_m - self.low) / self.size
        residual = self.geometry(self.encoding(unit))[:, 0]
        return sample_grid(self.warm[:, :1], unit)[:, 0] + self.truncation_m * residual
