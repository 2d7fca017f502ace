"""The infrared dots of a depth camera, as a camera without an infrared filter sees them: whether they disturb tag
corners there, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from calibration.report import Finding
from calibration.tags.detect import TagDetection

MOST_PX = 0.2
ADVICE = (
    "put an infrared cut filter on this camera, lower the D455's laser power, or add lamps and shorten the exposure"
)
DOT_SIGMA_PX = 0.9


def with_infrared_dots(
    image: UInt8[Array, "h w"], strength: float, spacing_px: float, rng: np.random.Generator
) -> UInt8[Array, "h w"]:
    """The image with dots of light on every surface: each reflects them as it reflects the lamps, so a dot multiplies
    what is there. `strength`: a dot's peak against the lamps' light; `spacing_px`: mean distance of the dots."""
    height, width = image.shape
    count = round(height * width / spacing_px**2)
    pattern = np.zeros((height, width), np.float32)
    at = (rng.uniform(0, height, count).astype(int), rng.uniform(0, width, count).astype(int))
    np.add.at(pattern, at, rng.uniform(0.6, 1.4, count))
    blurred = cv2.GaussianBlur(pattern, (0, 0), DOT_SIGMA_PX) * np.float32(2 * np.pi * DOT_SIGMA_PX**2)
    return np.clip(np.rint(image * (1 + np.float32(strength) * blurred)), 0, 255).astype(np.uint8)


def corner_noise_px(first: Sequence[Sequence[TagDetection]], second: Sequence[Sequence[TagDetection]]) -> float:
    """Deviation of a corner's coordinate between two series of images of a scene that stands still, from the scatter of
    each tag about its median in `second`; NaN where no tag is in both."""
    medians = {tag: np.median(seen, axis=0) for tag, seen in _by_id(second).items()}
    gaps = [c - medians[tag] for tag, seen in _by_id(first).items() if tag in medians for c in seen]
    return float(np.sqrt((np.array(gaps) ** 2).mean())) if gaps else float("nan")


def dots_advice(
    camera: str, with_dots: Sequence[Sequence[TagDetection]], without: Sequence[Sequence[TagDetection]]
) -> list[Finding]:
    """Nothing while corners stay within 0.2 px of where they are without dots; else why not, and what helps."""
    lost = sorted(set(_by_id(without)) - set(_by_id(with_dots)))
    noise = corner_noise_px(with_dots, without)
    found = []
    if lost:
        text = f"{camera}: the infrared dots hide tags {', '.join(map(str, lost[:8]))}"
        found.append(Finding("warning", f"{text}: {ADVICE}"))
    if noise > MOST_PX:
        text = f"{camera}: the infrared dots move tag corners by {noise:.2f} px, wanted at most {MOST_PX:g}"
        found.append(Finding("warning", f"{text}: {ADVICE}"))
    return found


def _by_id(images: Sequence[Sequence[TagDetection]]) -> dict[int, list]:
    out: dict[int, list] = {}
    for tags in images:
        for tag in tags:
            out.setdefault(tag.tag_id, []).append(tag.corners_px)
    return out
