"""The object's masks in every toss: followed in each, then drawn anew by what all of them show."""

from __future__ import annotations

from collections.abc import Mapping

from processing.backends import SEGMENTERS
from processing.run import Run, each
from processing.stages.masks.learn_pixels import learn_pixels
from processing.stages.masks.learned_masks import learned_masks
from processing.stages.masks.segment import segment
from processing.store import Done


def all_masks(run: Run, scene: Done, rig: Done, found: Done | None) -> dict[int, Done]:
    """As they were followed from where the object was found, or given."""
    return each(run, run.tosses, lambda t: segment(run, t, scene, rig, found))


def masks_anew(run: Run, scene: Done, masks: Mapping[int, Done]) -> dict[int, Done]:
    """Drawn anew, but where all of a toss's were given or none was found; as they are where few frames show enough to
    learn from, and where the user chose a segmenter that has learned what objects are."""
    if run.config.backends.segmenter != SEGMENTERS[0]:
        return dict(masks)
    uncertain = {t: done for t, done in masks.items() if done.result.given < done.result.frames - done.result.empty}
    pixels = learn_pixels(run, scene, uncertain) if uncertain else None
    if pixels is None or not pixels.result.usable:
        return dict(masks)
    return {**masks, **each(run, uncertain, lambda t: learned_masks(run, t, scene, masks[t], pixels))}
