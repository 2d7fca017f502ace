"""Whether a depth camera's infrared dots disturb tag corners in a ground-truth camera, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calibration.report import Finding
from calibration.tags.detect import TagDetection

MOST_PX = 0.2
ADVICE = (
    "put an infrared cut filter on this camera, lower the D455's laser power, or add lamps and shorten the exposure"
)


def corner_noise_px(first: Sequence[Sequence[TagDetection]], second: Sequence[Sequence[TagDetection]]) -> float:
    """Deviation of a corner's coordinate between two series of images of a scene that stands still, from the scatter of
    each tag about its median in `second`; NaN where no tag is in both."""
    middles = {tag: np.median(seen, axis=0) for tag, seen in _by_id(second).items()}
    gaps = [c - middles[tag] for tag, seen in _by_id(first).items() if tag in middles for c in seen]
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
