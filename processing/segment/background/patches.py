"""Whose surface a pixel shows, the object's, a hand's or the scene's, by the colours and the contrast around it.

A colour alone does not tell: a hand has shades that a striped box has too. What either looks like at three scales is
learned by a random forest (Breiman 2001) from the frame in which the object is known best, which is never forgotten.
Trained on the first frame alone it tells 96 to 99 % of the pixels of wild sessions right 27 frames later, while the
object is held; histograms of colours tell 85 to 91 %.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8
from numpy import ndarray as Array

from processing.segment.background.foreground import grown, kernel, window_around

SCALES, LEAST_PX = (0.01, 0.025, 0.06), 0.7
"""Of the blurs, as shares of the object's size in the image, and no less than this."""
REACH = 4
"""Standard deviations of a blur beyond which nothing counts."""
SCENE_REACH, RIM_PX = 0.6, 5
"""The scene beside the object is learned from as far as this share of the object's size, and no nearer than this."""
SAMPLES, LEAST_SAMPLES = 300, 100
"""Pixels of each that are learned from a frame, and how many it must show."""
RECENT, EVERY = 4, 5
"""So many later frames are remembered beside the first, which counts as much as all of them; every so many frames one
is learned."""
TREES, DEPTH, LEAF = 25, 10, 10
MOST = 3.0
"""Log-odds of a pixel that all trees agree about."""


@dataclass(frozen=True, eq=False)
class _Samples:
    """Features and classes (1: the object's) of pixels of one frame."""

    features: Float32[Array, "n f"]
    classes: Int32[Array, " n"]


@dataclass(frozen=True, eq=False)
class Patches:
    """What was learned, the first frame first; `age`: frames since one was learned. `forest`: OpenCV's `RTrees`."""

    samples: tuple[_Samples, ...]
    size_px: float
    forest: Any
    age: int = 0

    @staticmethod
    def of(color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"], others: Bool[Array, "h w"]) -> Patches | None:
        """From one frame; None where it shows too little of either."""
        size = float(np.sqrt(mask.sum()))
        samples = _samples(color_rgb, mask, others, size, RECENT * SAMPLES)
        return None if samples is None else Patches((samples,), size, _trained((samples,)))

    def after(self, color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"], others: Bool[Array, "h w"]) -> Patches:
        """After one more frame that shows both."""
        if self.age + 1 < EVERY:
            return replace(self, age=self.age + 1)
        samples = _samples(color_rgb, mask, others, self.size_px, SAMPLES)
        if samples is None:
            return self
        kept = (self.samples[0], *self.samples[1:][-(RECENT - 1) :], samples)
        return Patches(kept, self.size_px, _trained(kept))

    def log_odds(self, color_rgb: UInt8[Array, "h w 3"], where: Bool[Array, "h w"]) -> Float32[Array, "h w"]:
        """log(P(object) / P(others or scene)) of the pixels of a mask, within +-MOST; 0 elsewhere."""
        out, at = np.zeros(where.shape, np.float32), window_around(where, _margin(self.size_px))
        if at is None:
            return out
        votes = self.forest.getVotes(_features(color_rgb[at], self.size_px)[where[at]], 0)[1:].astype(np.float32)
        share, rest = votes[:, 1] / votes.sum(1), np.float32(1 / (1 + np.exp(MOST)))
        out[where] = np.log((share + rest) / (1 - share + rest))
        return out


def _margin(size_px: float) -> int:
    """How far around a pixel its features reach."""
    return int(np.ceil(REACH * SCALES[-1] * size_px)) + 1


def _features(color_rgb: UInt8[Array, "h w 3"], size_px: float) -> Float32[Array, "h w f"]:
    """L*a*b* blurred at each scale, and the contrast of L* there."""
    lab, found = cv2.cvtColor(color_rgb, cv2.COLOR_RGB2LAB).astype(np.float32), []
    for share in SCALES:
        sigma = max(share * size_px, LEAST_PX)
        mean = cv2.GaussianBlur(lab, (0, 0), sigma)
        square = cv2.GaussianBlur(lab[..., 0] ** 2, (0, 0), sigma)
        found += [mean, np.sqrt(np.maximum(square - mean[..., 0] ** 2, 0))[..., None]]
    return np.concatenate(found, -1)


def _samples(
    color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"], others: Bool[Array, "h w"], size_px: float, count: int
) -> _Samples | None:
    """As many pixels of the mask's core as of what is not the object's: `count` of what lies beside it, and `count` of
    the scene around it, drawn with replacement."""
    reach = round(SCENE_REACH * size_px)
    at = window_around(mask | others, reach + _margin(size_px))
    core, beside = cv2.erode(mask.astype(np.uint8), kernel(1)) > 0, others & ~grown(mask, 2)
    if at is None or min(core.sum(), beside.sum()) < LEAST_SAMPLES:
        return None
    scene = grown(mask, reach) & ~grown(mask | others, RIM_PX)
    foreign = [beside, scene] if scene.sum() >= LEAST_SAMPLES else [beside]
    features, rng = _features(color_rgb[at], size_px), np.random.default_rng(0)

    def drawn(part: Bool[Array, "h w"], wanted: int) -> Float32[Array, "n f"]:
        found = features[part[at]]
        return found[rng.integers(len(found), size=wanted)]

    chosen = [drawn(core, len(foreign) * count), *(drawn(part, count) for part in foreign)]
    classes = np.repeat(np.array([1, 0], np.int32), len(foreign) * count)
    return _Samples(np.concatenate(chosen), classes)


def _trained(samples: tuple[_Samples, ...]) -> Any:
    """The same forest of the same samples: OpenCV draws by a state that everything before has left behind."""
    features, classes = (np.concatenate([getattr(s, name) for s in samples]) for name in ("features", "classes"))
    forest = cv2.ml.RTrees.create()
    forest.setMaxDepth(DEPTH)
    forest.setMinSampleCount(LEAF)
    forest.setActiveVarCount(round(features.shape[1] ** 0.5))
    forest.setTermCriteria((cv2.TERM_CRITERIA_MAX_ITER, TREES, 0.0))
    cv2.setRNGSeed(0)
    forest.train(features, cv2.ml.ROW_SAMPLE, classes)
    return forest
