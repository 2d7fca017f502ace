"""Where the field keeps what it learns: features of points in the unit cube, by a dense grid or a hash grid.

Both have one interface: `forward(points)` of (n, 3) in [0, 1] gives (n, features). On a CPU the dense grid reaches the
same surface in the fraction of the time (tools/bench_field.py measures it); the hash grid pays on a GPU.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

EncodingName = Literal["dense", "hash"]
_PRIMES = (1, 2_654_435_761, 805_459_861)


class DenseGrid(nn.Module):
    """One grid of feature vectors, trilinear between its nodes."""

    def __init__(self, resolution: int = 64, features: int = 4) -> None:
        super().__init__()
        self.features = features
        self.table = nn.Parameter(torch.zeros(1, features, resolution, resolution, resolution))
        nn.init.uniform_(self.table, -1e-2, 1e-2)

    def forward(self, points: Tensor) -> Tensor:
        return sample_grid(self.table, points)


class HashGrid(nn.Module):
    """Multi-resolution hash encoding (Mueller et al. 2022): levels of trilinear grids with hashed tables."""

    corners: Tensor

    def __init__(
        self, levels: int = 8, coarsest: int = 16, finest: int = 128, table_bits: int = 16, features: int = 2
    ) -> None:
        super().__init__()
        self.features = levels * features
        growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
        self.resolutions = [int(np.floor(coarsest * growth**i)) for i in range(levels)]
        self.size = 1 << table_bits
        self.tables = nn.Parameter(torch.empty(levels, self.size, features))
        nn.init.uniform_(self.tables, -1e-2, 1e-2)
        corners = torch.tensor([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        self.register_buffer("corners", corners, persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        return torch.cat([self._level(points, i, r) for i, r in enumerate(self.resolutions)], dim=-1)

    def _level(self, points: Tensor, level: int, resolution: int) -> Tensor:
        scaled = points.clamp(0, 1) * (resolution - 1)
        base = scaled.detach().floor()
        inner = scaled - base
        nodes = base.long()[:, None, :] + self.corners
        corner_share = torch.where(self.corners.bool(), inner[:, None, :], 1 - inner[:, None, :]).prod(-1)
        return (self.tables[level][self._slot(nodes, resolution)] * corner_share[..., None]).sum(1)

    def _slot(self, nodes: Tensor, resolution: int) -> Tensor:
        if resolution**3 <= self.size:
            return (nodes[..., 0] * resolution + nodes[..., 1]) * resolution + nodes[..., 2].clamp(max=resolution - 1)
        mixed = nodes[..., 0] * _PRIMES[0] ^ nodes[..., 1] * _PRIMES[1] ^ nodes[..., 2] * _PRIMES[2]
        return mixed % self.size


def make_encoding(name: EncodingName) -> DenseGrid | HashGrid:
    return DenseGrid() if name == "dense" else HashGrid()


def sample_grid(grid: Tensor, points: Tensor) -> Tensor:
    """Trilinear values (n, c) of a grid (1, c, a, b, k) at points (n, 3) in [0, 1] along its three axes."""
    at = (points.flip(-1) * 2 - 1).reshape(1, 1, 1, -1, 3)
    out = functional.grid_sample(grid, at, mode="bilinear", padding_mode="border", align_corners=True)
    return out.reshape(grid.shape[1], -1).T
