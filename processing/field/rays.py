"""The set of rays that the field is trained on, in camera coordinates, so that poses can move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from processing.field.views import FieldView


@dataclass(frozen=True, eq=False)
class RayDataset:
    """`direction` (n, 3) with z = 1, `depth` (n,) metres along z, `plane` (n, 3), `rgb` (n, 3) in 0..1, `view` (n,).
    `colored` (n,) is 1, or 0 where the pixel's colour is not the object's.

    `passing_*`: rays that pass the object (same meaning).
    """

    direction: Tensor
    depth: Tensor
    plane: Tensor
    rgb: Tensor
    view: Tensor
    colored: Tensor
    passing_direction: Tensor
    passing_view: Tensor

    def to(self, device: str) -> RayDataset:
        return RayDataset(**{name: getattr(self, name).to(device) for name in self.__dataclass_fields__})


def make_ray_dataset(views: Sequence[FieldView]) -> RayDataset:
    """The views' object rays with depth, and their rays that surely pass the object: of each view as large a share of
    them, evenly, as it counts."""
    parts: dict[str, list[np.ndarray]] = {name: [] for name in RayDataset.__dataclass_fields__}
    for number, view in enumerate(views):
        v, u = _share(view, view.depth_m)
        parts["direction"].append(_directions(view, u, v))
        parts["depth"].append(view.depth_m[v, u])
        parts["plane"].append(view.plane[v, u])
        parts["rgb"].append(view.color_rgb[v, u].astype(np.float32) / 255)
        parts["view"].append(np.full(len(u), number))
        parts["colored"].append(np.ones(len(u)) if view.colorless is None else ~view.colorless[v, u])
        v, u = _share(view, view.outside)
        parts["passing_direction"].append(_directions(view, u, v))
        parts["passing_view"].append(np.full(len(u), number))
    joined = {name: np.concatenate(values) for name, values in parts.items()}
    return RayDataset(
        **{
            name: torch.tensor(values, dtype=torch.int64 if name.endswith("view") else torch.float32)
            for name, values in joined.items()
        }
    )


def _share(view: FieldView, where: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the pixels of an image that are not 0, or of as many of them as the view counts."""
    v, u = np.nonzero(where)
    kept = np.linspace(0, len(u) - 1, round(view.weight * len(u))).astype(int)
    return v[kept], u[kept]


def _directions(view: FieldView, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    x = (u - view.K[0, 2]) / view.K[0, 0]
    y = (v - view.K[1, 2]) / view.K[1, 1]
    return np.stack([x, y, np.ones(len(u))], -1).astype(np.float32)
