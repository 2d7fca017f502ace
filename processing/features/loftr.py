"""LoFTR (Sun et al., CVPR 2021) through kornia: matches of two pictures without keypoints of either alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray as Array

from processing.features.learned import Picture, PictureConfig, no_pairs, open_kornia, picture_of, points_under
from processing.features.sift import Features
from processing.published_weights import LOFTR, check_layers, find_weights, read_weights
from processing.sensor.view_store import ViewStore
from recordings.errors import BadInput

HALF_CELL = 0.5
"""LoFTR's pixel centres lie half a pixel further right and down than ours."""


@dataclass(frozen=True)
class LoftrConfig:
    """How LoFTR is run."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    grid_px: float = 0.5
    """A match is put to the nearest point of a grid with this step, in pixels of the image as it came."""
    kept_views: int = 12
    """Views whose network features are kept: some 12 MB each."""


@dataclass(frozen=True, eq=False)
class Grid(Features):
    """All places of a view that a match may fall on, and the picture that LoFTR sees. There are no descriptors."""

    picture: Picture | None
    index: Int[Array, "a b"]
    """Row in `points_m` of each place of the grid, or -1."""
    step_px: float
    """Of the grid, in the picture."""

    def rows(self, uv: Float[Array, "n 2"]) -> Int[Array, " n"]:
        """Row in `points_m` nearest to places in the picture, -1 where that is not the object."""
        h, w = self.index.shape
        cell = np.round(uv / self.step_px).astype(int)
        inside = ((cell >= 0) & (cell < [w, h])).all(1)
        cell = np.clip(cell, 0, [w - 1, h - 1])
        return np.where(inside, self.index[cell[:, 1], cell[:, 0]], -1)


class Loftr:
    """FeatureMatcher by LoFTR. See `FeatureMatcher`; it matches what it described itself."""

    name = "loftr"
    side_by_side = False

    def __init__(self, network: Any, config: LoftrConfig | None = None, device: str = "cpu") -> None:
        self.config = config or LoftrConfig()
        self._network, self._device = network.to(device).eval(), device
        self._seen = lru_cache(self.config.kept_views)(self._network_features)

    @staticmethod
    def from_weights(folder: Path | None, config: LoftrConfig | None = None, device: str = "cpu") -> Loftr:
        """With the published weights in a user's folder. Raises BadInput that says where they come from."""
        path = find_weights(LOFTR, folder)
        network = open_kornia(LOFTR.option).LoFTR(pretrained=None)
        stored = {n.removeprefix("matcher."): t for n, t in read_weights(path, LOFTR, inside="state_dict").items()}
        check_layers(stored, {n: tuple(t.shape) for n, t in network.state_dict().items()}, path, LOFTR)
        network.load_state_dict(stored)
        return Loftr(network, config, device)

    def describe(self, store: ViewStore, view: int) -> Grid:
        picture = picture_of(store, view, self.config.picture)
        if picture is None:
            return Grid(np.zeros((0, 3)), np.zeros((0, 0), np.float32), None, np.full((1, 1), -1), 1.0)
        step = self.config.grid_px * picture.scale
        h, w = picture.gray.shape
        u, v = np.meshgrid(np.arange(0, w, step), np.arange(0, h, step))
        points, good = points_under(store, view, picture, np.stack([u.ravel(), v.ravel()], -1))
        index = np.where(good, np.cumsum(good) - 1, -1).reshape(u.shape)
        return Grid(points[good], np.zeros((int(good.sum()), 0), np.float32), picture, index, step)

    def match(self, one: Features, other: Features) -> Int[Array, "m 2"]:
        if not isinstance(one, Grid) or not isinstance(other, Grid):
            raise BadInput("loftr matches pictures that it described itself; describe both views with it")
        if len(one.points_m) == 0 or len(other.points_m) == 0:
            return no_pairs()
        uv_one, uv_other, sure = self._ask(one, other)
        pairs = np.stack([one.rows(uv_one), other.rows(uv_other)], -1)
        order = np.argsort(-sure, kind="stable")
        return np.asarray(pairs[order][(pairs[order] >= 0).all(1)], dtype=np.int64)

    def _ask(self, one: Grid, other: Grid) -> tuple[Float[Array, "m 2"], Float[Array, "m 2"], Float32[Array, " m"]]:
        """Matched places in both pictures and LoFTR's confidence."""
        import torch

        (features_one, mask_one), (features_other, mask_other) = self._seen(one), self._seen(other)
        asked = {"features0": features_one, "features1": features_other, "mask0": mask_one, "mask1": mask_other}
        with torch.inference_mode():
            said = self._network(asked)
        places = (said[f"keypoints{side}"].cpu().numpy().astype(np.float64) - HALF_CELL for side in (0, 1))
        return *places, said["confidence"].cpu().numpy()

    def _network_features(self, grid: Grid) -> tuple[Any, Any]:
        import torch

        assert grid.picture is not None
        with torch.inference_mode():
            image = torch.tensor(grid.picture.gray, device=self._device)[None, None]
            return self._network.extract_features(image), torch.tensor(grid.picture.mask, device=self._device)[None]
