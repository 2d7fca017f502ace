"""XFeat keypoints (Potje et al., CVPR 2024) through kornia, matched where both descriptors are each other's best."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from numpy import ndarray as Array

from processing.features.learned import PictureConfig, no_pairs, open_kornia, picture_of, points_under
from processing.features.sift import Features
from processing.published_weights import XFEAT, check_layers, find_weights, read_weights
from processing.sensor.view_store import ViewStore


@dataclass(frozen=True)
class XFeatConfig:
    """How XFeat is run."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    most: int = 400
    least_score: float = 0.05
    """Of a keypoint: its probability within its 8x8 cell."""
    least_likeness: float = 0.82
    """Cosine of the angle between matched descriptors."""


class XFeat:
    """FeatureMatcher by XFeat. See `FeatureMatcher`."""

    name = "xfeat"
    side_by_side = False

    def __init__(self, network: Any, config: XFeatConfig | None = None, device: str = "cpu") -> None:
        self.config = config or XFeatConfig()
        self._network, self._device = network.to(device).eval(), device

    @staticmethod
    def from_weights(folder: Path | None, config: XFeatConfig | None = None, device: str = "cpu") -> XFeat:
        """With the published weights in a user's folder. Raises BadInput that says where they come from."""
        path = find_weights(XFEAT, folder)
        network = open_kornia(XFEAT.option).XFeat()
        stored = read_weights(path, XFEAT)
        check_layers(stored, {n: tuple(t.shape) for n, t in network.net.state_dict().items()}, path, XFEAT)
        network.net.load_state_dict(stored)
        return XFeat(network, config, device)

    def describe(self, store: ViewStore, view: int) -> Features:
        import torch

        picture = picture_of(store, view, self.config.picture)
        if picture is None:
            return Features(np.zeros((0, 3)), np.zeros((0, 64), dtype=np.float32))
        image = torch.tensor(picture.gray, device=self._device)[None, None]
        found = self._network.detectAndCompute(image, self.config.most, self.config.least_score)[0]
        uv = found["keypoints"].cpu().numpy().astype(np.float64)
        points, good = points_under(store, view, picture, uv)
        return Features(points[good], found["descriptors"].cpu().numpy()[good])

    def match(self, one: Features, other: Features) -> Int[Array, "m 2"]:
        if len(one.descriptors) == 0 or len(other.descriptors) == 0:
            return no_pairs()
        likeness = one.descriptors @ other.descriptors.T
        theirs, mine = likeness.argmax(1), likeness.argmax(0)
        index = np.arange(len(theirs))
        best = likeness[index, theirs]
        kept = np.flatnonzero((mine[theirs] == index) & (best >= self.config.least_likeness))
        kept = kept[np.argsort(-best[kept], kind="stable")]
        return np.stack([kept, theirs[kept]], -1)
