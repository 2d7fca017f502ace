"""Feature points of a view and matches between views: relative motions that need no guess.

`FeatureMatcher` is the door for other matchers; SIFT needs no weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.sensor.view import Crop
from processing.sensor.view_store import ViewStore
from recordings.constants import LUMA
from recordings.geometry import rigid_fit


@dataclass(frozen=True, eq=False)
class Features:
    """Feature points of one view: positions in its camera frame (m) and descriptors."""

    points_m: Float[Array, "n 3"]
    descriptors: Float32[Array, "n d"]


@runtime_checkable
class FeatureMatcher(Protocol):
    """Finds and matches feature points on the object. One class per backend. `side_by_side`: several threads may
    match at a time."""

    name: str
    side_by_side: bool

    def describe(self, store: ViewStore, view: int) -> Features:
        """Feature points of a view that have depth."""
        ...

    def match(self, one: Features, other: Features) -> Int[Array, "m 2"]:
        """Pairs of indices (into one, into other), the more distinct first."""
        ...


@dataclass(frozen=True)
class SiftConfig:
    """SIFT on the enlarged crop."""

    enlarge: int = 3
    """The object is some 50 to 140 pixels wide: SIFT wants more."""
    most: int = 300
    contrast: float = 0.012
    edge: float = 15.0
    ratio: float = 0.85
    """A match must be this much nearer than the second best."""


class Sift:
    """Scale-invariant feature transform (Lowe 2004), from OpenCV."""

    name = "sift"
    side_by_side = True

    def __init__(self, config: SiftConfig | None = None) -> None:
        self.config = config or SiftConfig()
        self._sift = cv2.SIFT.create(
            nfeatures=self.config.most, contrastThreshold=self.config.contrast, edgeThreshold=self.config.edge
        )

    def describe(self, store: ViewStore, view: int) -> Features:
        crop = store.crops[view]
        none = Features(np.zeros((0, 3)), np.zeros((0, 128), dtype=np.float32))
        if crop is None or not store.usable(view):
            return none
        up = self.config.enlarge
        corner, image, mask = _tight(crop)
        big = cv2.resize(image, None, fx=up, fy=up, interpolation=cv2.INTER_CUBIC)
        where = cv2.resize(mask, None, fx=up, fy=up, interpolation=cv2.INTER_NEAREST)
        found, descriptors = self._sift.detectAndCompute(big, where)
        if descriptors is None:
            return none
        uv = (np.array([f.pt for f in found]) + 0.5) / up - 0.5 + corner
        points, has_depth = lifted(store, view, uv)
        return Features(points[has_depth], descriptors[has_depth])

    def match(self, one: Features, other: Features) -> Int[Array, "m 2"]:
        a, b = one.descriptors, other.descriptors
        if len(a) < 2 or len(b) < 2:
            return np.zeros((0, 2), dtype=np.int64)
        squared = (a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T)  # exact: whole numbers below 2^24
        nearest = squared.argmin(1)
        first = squared[np.arange(len(a)), nearest]
        squared[np.arange(len(a)), nearest] = np.inf
        ratio = np.sqrt(first).astype(np.float64) / np.maximum(np.sqrt(squared.min(1)), np.float32(1e-6))
        kept = np.flatnonzero(ratio < self.config.ratio)
        kept = kept[np.argsort(ratio[kept], kind="stable")]
        return np.stack([kept, nearest[kept]], axis=1)


def _tight(crop: Crop, rim: int = 4) -> tuple[Float[Array, "2"], Array, Array]:
    """Corner (u, v inside the crop), grey image 0..255 and slightly grown mask of the object alone."""
    rows, columns = np.flatnonzero(crop.mask.any(1)), np.flatnonzero(crop.mask.any(0))
    top, left = max(rows[0] - rim, 0), max(columns[0] - rim, 0)
    area = np.s_[top : rows[-1] + rim + 1, left : columns[-1] + rim + 1]
    gray = crop.color[area] @ np.array(LUMA, dtype=np.float32)
    low, high = np.quantile(gray[crop.mask[area]], [0.02, 0.98])
    stretched = np.clip((gray - low) / max(high - low, 0.05), 0, 1) * 255
    grown = cv2.dilate(crop.mask[area].astype(np.uint8), np.ones((3, 3), np.uint8))
    if crop.colorless is not None:
        grown[cv2.dilate(crop.colorless[area].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = 0
    return np.array([left, top], dtype=float), stretched.astype(np.uint8), grown


def lifted(store: ViewStore, view: int, uv: Float[Array, "n 2"]) -> tuple[Float[Array, "n 3"], Array]:
    """Points (camera frame, m) under pixel places `uv` of a view's crop, and whether there is depth."""
    crop = store.crops[view]
    assert crop is not None
    h, w = crop.mask.shape
    offset = int(store.table[view, lay.OFFSET])
    z_map = store.maps[offset : offset + h * w, lay.Z].reshape(h, w)
    cell = np.clip(np.round(uv).astype(int), 0, [w - 1, h - 1])
    z = z_map[cell[:, 1], cell[:, 0]].astype(np.float64)
    c = store.rectified.camera
    x = (uv[:, 0] + crop.corner[0] - c.cx) / c.fx
    y = (uv[:, 1] + crop.corner[1] - c.cy) / c.fy
    return np.stack([x * z, y * z, z], -1), z > 0


@dataclass(frozen=True)
class RansacConfig:
    """Three-point RANSAC between lifted matches."""

    trials: int = 300
    inlier_m: float = 0.006
    least: int = 5
    first: int = 120
    """Matches used, the most distinct first."""


@dataclass(frozen=True, eq=False)
class RelativeMotion:
    """`other_from_one` of two views' camera frames (4x4), as feature matches say, and how many agree."""

    other_from_one: Float[Array, "4 4"]
    inliers: int


def relative_motions(
    matcher: FeatureMatcher, one: Features, other: Features, config: RansacConfig, seed: int, most: int = 1
) -> list[RelativeMotion]:
    """Motions that bring `one` onto `other`, best first; the second is sought among the first one's outliers."""
    pairs = matcher.match(one, other)[: config.first]
    out: list[RelativeMotion] = []
    while len(pairs) >= config.least and len(out) < most:
        a, b = one.points_m[pairs[:, 0]], other.points_m[pairs[:, 1]]
        inlier = _ransac(a, b, config, seed)
        if inlier.sum() < config.least:
            break
        out.append(RelativeMotion(rigid_fit(a[inlier], b[inlier]), int(inlier.sum())))
        pairs = pairs[~inlier]
    return out


def _ransac(a: Float[Array, "n 3"], b: Float[Array, "n 3"], config: RansacConfig, seed: int) -> Array:
    """Which matches agree with the best of many three-point motions (all trials at once)."""
    n = len(a)
    trials = np.random.default_rng(seed).integers(0, n, (config.trials, 3))
    sides_a = np.linalg.norm(a[trials] - a[np.roll(trials, 1, 1)], axis=2)
    sides_b = np.linalg.norm(b[trials] - b[np.roll(trials, 1, 1)], axis=2)
    ok = (np.abs(sides_a - sides_b).max(1) < 2 * config.inlier_m) & (sides_a.min(1) > 0.008)
    trials = trials[ok]
    if len(trials) == 0:
        return np.zeros(n, dtype=bool)
    motion = rigid_fit(a[trials], b[trials])
    gap = np.linalg.norm(a @ np.swapaxes(motion[:, :3, :3], 1, 2) + motion[:, None, :3, 3] - b, axis=2)
    inlier = gap < config.inlier_m
    return np.asarray(inlier[int(inlier.sum(1).argmax())])
