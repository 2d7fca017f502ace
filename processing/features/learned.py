"""What matchers with learned weights share: the enlarged picture of the object, kornia, points under keypoints.

Each backend has its own file: loftr.py, xfeat.py, lightglue.py. SIFT is in sift.py.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from processing.features.sift import lifted
from processing.sensor.view_store import ViewStore
from recordings.constants import LUMA
from recordings.errors import BadInput

STRIDE = 32
"""The networks want sides that are multiples of this."""


@dataclass(frozen=True)
class PictureConfig:
    """How the object is shown to a network."""

    side_px: int = 288
    """The longer side of the object's box is enlarged to about this."""
    most_enlarged: float = 5.0
    """A tiny object is enlarged no further: blur is no texture."""
    rim_px: int = 4
    """Of the image as it came, around the object's box."""


@dataclass(frozen=True, eq=False)
class Picture:
    """The part of a crop that shows the object, enlarged."""

    gray: Float32[Array, "h w"]
    """0..1, the object's own darkest to brightest."""
    mask: Bool[Array, "h w"]
    corner: Float[Array, "2"]
    """Place (u, v) in the crop of the picture's first pixel before enlarging."""
    scale: float

    def in_crop(self, uv: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        """Places in the crop of places in the picture; pixel centres lie at integers in both."""
        return (uv + 0.5) / self.scale - 0.5 + self.corner

    def on_object(self, uv: Float[Array, "n 2"]) -> Bool[Array, " n"]:
        """Which places lie on the object."""
        h, w = self.mask.shape
        cell = np.clip(np.round(uv).astype(int), 0, [w - 1, h - 1])
        return np.asarray(self.mask[cell[:, 1], cell[:, 0]])


def picture_of(store: ViewStore, view: int, config: PictureConfig) -> Picture | None:
    """The object in a view; None where the view shows too little."""
    crop = store.crops[view]
    if crop is None or not store.usable(view):
        return None
    rows, columns = np.flatnonzero(crop.mask.any(1)), np.flatnonzero(crop.mask.any(0))
    top, left = max(int(rows[0]) - config.rim_px, 0), max(int(columns[0]) - config.rim_px, 0)
    area = np.s_[top : int(rows[-1]) + config.rim_px + 1, left : int(columns[-1]) + config.rim_px + 1]
    gray, mask = crop.color[area] @ np.array(LUMA, dtype=np.float32), crop.mask[area]
    low, high = np.quantile(gray[mask], [0.02, 0.98])
    shown = np.clip((gray - low) / max(high - low, 0.05), 0, 1)
    scale = float(np.clip(config.side_px / max(shown.shape), 1.0, config.most_enlarged))
    large, where = _enlarged(shown, scale, cv2.INTER_CUBIC), _enlarged(mask.astype(np.uint8), scale, cv2.INTER_NEAREST)
    inside = np.zeros(large.shape, dtype=bool)
    inside[: round(mask.shape[0] * scale), : round(mask.shape[1] * scale)] = True
    return Picture(
        np.clip(large, 0, 1).astype(np.float32), (where > 0) & inside, np.array([left, top], dtype=float), scale
    )


def _enlarged(image: Array, scale: float, how: int) -> Array:
    """Exactly `scale` times as large, about pixel centres at integers, with a rim to a multiple of STRIDE."""
    h, w = (-(-round(side * scale) // STRIDE) * STRIDE for side in image.shape)
    shift = 0.5 / scale - 0.5
    to_source = np.array([[1 / scale, 0, shift], [0, 1 / scale, shift]])
    flags = how | cv2.WARP_INVERSE_MAP
    return cv2.warpAffine(image, to_source, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)


def points_under(
    store: ViewStore, view: int, picture: Picture, uv: Float[Array, "n 2"]
) -> tuple[Float[Array, "n 3"], Bool[Array, " n"]]:
    """Points (camera frame, m) under places of a picture, and which of them are the object's and have depth."""
    points, has_depth = lifted(store, view, picture.in_crop(uv))
    return points, np.asarray(has_depth & picture.on_object(uv))


def no_pairs() -> Int[Array, "0 2"]:
    """No matches."""
    return np.zeros((0, 2), dtype=np.int64)


def open_kornia(option: str) -> Any:
    """kornia's feature module. Raises BadInput that says what to install; `option` is what asked for it, as typed."""
    try:
        return import_module("kornia.feature")
    except ImportError as missing:
        raise BadInput(
            f"{option} needs kornia, which is not installed; run `pip install -e .[learned]`, or take --matcher sift"
        ) from missing
