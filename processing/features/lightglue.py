"""SIFT keypoints matched by LightGlue (Lindenberger et al., ICCV 2023) through kornia."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, Int
from numpy import ndarray as Array

from processing.features.learned import PictureConfig, no_pairs, open_kornia, picture_of, points_under
from processing.features.sift import Features
from processing.published_weights import LIGHTGLUE, check_layers, find_weights, read_weights
from processing.sensor.view_store import ViewStore
from recordings.errors import BadInput


@dataclass(frozen=True)
class LightGlueConfig:
    """How keypoints are found for LightGlue. The detector's settings are those that its weights were trained with."""

    picture: PictureConfig = field(default_factory=PictureConfig)
    most: int = 400
    contrast: float = 0.0066667
    edge: float = 10.0
    octave_layers: int = 4


@dataclass(frozen=True, eq=False)
class Keypoints(Features):
    """Features and where they lie in their picture, which LightGlue reads too."""

    uv: Float32[Array, "n 2"]
    size_px: Float32[Array, " n"]
    angle_rad: Float32[Array, " n"]
    picture_px: tuple[int, int]
    """Width and height of the picture."""


class LightGlue:
    """FeatureMatcher by LightGlue on SIFT. See `FeatureMatcher`; it matches what it described itself."""

    name = "lightglue"
    side_by_side = False

    def __init__(self, network: Any, config: LightGlueConfig | None = None, device: str = "cpu") -> None:
        self.config = config or LightGlueConfig()
        self._network, self._device = network.to(device).eval(), device
        c = self.config
        self._sift = cv2.SIFT.create(c.most, c.octave_layers, c.contrast, c.edge)

    @staticmethod
    def from_weights(folder: Path | None, config: LightGlueConfig | None = None, device: str = "cpu") -> LightGlue:
        """With the published weights in a user's folder. Raises BadInput that says where they come from."""
        path = find_weights(LIGHTGLUE, folder)
        network = empty_network(open_kornia(LIGHTGLUE.option))
        layers = network.state_dict()
        derived = {"confidence_thresholds": layers["confidence_thresholds"]}
        stored = derived | {_todays_name(n): t for n, t in read_weights(path, LIGHTGLUE).items()}
        check_layers(stored, {n: tuple(t.shape) for n, t in layers.items()}, path, LIGHTGLUE)
        network.load_state_dict(stored)
        return LightGlue(network, config, device)

    def describe(self, store: ViewStore, view: int) -> Keypoints:
        picture = picture_of(store, view, self.config.picture)
        if picture is None:
            return _none((0, 0))
        height, width = picture.gray.shape
        mask = cv2.dilate(picture.mask.astype(np.uint8), np.ones((3, 3), np.uint8))
        found, descriptors = self._sift.detectAndCompute((picture.gray * 255).astype(np.uint8), mask)
        if descriptors is None:
            return _none((width, height))
        uv = np.array([f.pt for f in found], dtype=np.float32)
        points, good = points_under(store, view, picture, uv.astype(np.float64))
        good &= _first_at_place(uv)
        size, angle = np.array([(f.size, np.deg2rad(f.angle)) for f in found], dtype=np.float32).T
        return Keypoints(points[good], root_sift(descriptors[good]), uv[good], size[good], angle[good], (width, height))

    def match(self, one: Features, other: Features) -> Int[Array, "m 2"]:
        import torch

        if not isinstance(one, Keypoints) or not isinstance(other, Keypoints):
            raise BadInput("lightglue matches keypoints that it described itself; describe both views with it")
        if len(one.points_m) < 2 or len(other.points_m) < 2:
            return no_pairs()
        with torch.inference_mode():
            said = self._network({"image0": self._asked(one), "image1": self._asked(other)})
        pairs, scores = said["matches"][0].cpu().numpy(), said["scores"][0].cpu().numpy()
        return np.asarray(pairs[np.argsort(-scores, kind="stable")], dtype=np.int64).reshape(-1, 2)

    def _asked(self, points: Keypoints) -> dict[str, Any]:
        import torch

        asked = {"keypoints": points.uv, "descriptors": points.descriptors}
        asked |= {"scales": points.size_px, "oris": points.angle_rad}
        asked["image_size"] = np.array(points.picture_px, dtype=np.float32)
        return {name: torch.tensor(values, device=self._device)[None] for name, values in asked.items()}


def empty_network(kornia_feature: Any, **changed: Any) -> Any:
    """LightGlue for SIFT without weights: kornia downloads nothing where no features are named."""
    return kornia_feature.LightGlue(None, **({"input_dim": 128, "add_scale_ori": True} | changed))


def root_sift(descriptors: Float32[Array, "n 128"]) -> Float32[Array, "n 128"]:
    """Square roots of the descriptor's shares (Arandjelovic and Zisserman 2012), of length 1."""
    shares = descriptors / np.maximum(np.abs(descriptors).sum(1, keepdims=True), 1e-6)
    root = np.sqrt(np.maximum(shares, 1e-6))
    return np.asarray(root / np.linalg.norm(root, axis=1, keepdims=True), dtype=np.float32)


def _first_at_place(uv: Float32[Array, "n 2"]) -> Array:
    """Which keypoints are the first at their pixel: SIFT repeats one that has two orientations."""
    first = np.zeros(len(uv), dtype=bool)
    first[np.unique(np.round(uv).astype(int), axis=0, return_index=True)[1]] = True
    return first


def _none(picture_px: tuple[int, int]) -> Keypoints:
    empty = np.zeros(0, dtype=np.float32)
    return Keypoints(np.zeros((0, 3)), empty.reshape(0, 128), empty.reshape(0, 2), empty, empty, picture_px)


def _todays_name(layer: str) -> str:
    """The published file names layers by an older order of their parts."""
    return re.sub(r"^(self|cross)_attn\.(\d+)\.", r"transformers.\2.\1_attn.", layer.removeprefix("matcher."))
