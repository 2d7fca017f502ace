"""Stage `learn-pixels`: what tells the object's pixels from all others, learned from the masks of all tosses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from processing.engine.parts import side_by_side
from processing.run import CAMERA, Run, toss_keys
from processing.segment.background.static_scene import StaticScene
from processing.segment.learned.masks import half_of, sizes_px
from processing.segment.learned.network import learned, samples_of
from processing.segment.learned.toss_looks import TossLooks
from processing.stages.masks.segment import SegmentResult
from processing.store import Done, plain
from recordings.results.folder import RobotMasks, read_masks

VERSION = 2
HALVES = (0, 1)
FEWEST = 4
"""A half with fewer frames teaches nothing: then masks stay as they are."""


@dataclass(frozen=True)
class PixelsResult:
    """Frames that each half was learned from; `usable`: whether both have enough."""

    frames: tuple[int, int]
    usable: bool


def learn_pixels(run: Run, scene: Done, masks: Mapping[int, Done[SegmentResult]]) -> Done[PixelsResult]:
    """Two networks that tell the object's pixels from all others, each from one half of the frames."""
    inputs = {"scene": scene.key, **{f"masks_{t:02d}": done.key for t, done in masks.items()}}
    for toss in masks:
        inputs |= toss_keys(run, toss)
    s = run.config.learned_masks
    every = max(1, -(-sum(done.result.frames for done in masks.values()) // s.most_frames))

    def compute(folder: Path) -> PixelsResult:
        def samples(toss: int) -> list[tuple[int, tuple[np.ndarray, np.ndarray]]]:
            found = []
            of_toss = toss_looks(run, toss, scene, masks[toss])
            for i in range(0, len(of_toss.masks), every):
                seen = of_toss.look(i, of_toss.masks[i])
                if seen is None:
                    continue
                outside = cv2.distanceTransform((~seen.mask).astype(np.uint8), cv2.DIST_L2, 5)
                chosen = samples_of(seen.features, seen.mask, outside, s.network, (toss, i))
                found.append((half_of(toss, i, s), chosen))
            return found

        found = [sample for part in side_by_side(samples, list(masks)) for sample in part]
        halves = [[sample for half, sample in found if half == k] for k in HALVES]
        if min(map(len, halves)) < FEWEST:
            return PixelsResult((len(halves[0]), len(halves[1])), usable=False)
        arrays: dict[str, np.ndarray] = {}
        for k, half in enumerate(halves):
            rows, labels = (np.concatenate([sample[j] for sample in half]) for j in (0, 1))
            arrays |= learned(rows, labels, s.network).arrays(f"half{k}")
        np.savez(folder / "networks.npz", **arrays)  # type: ignore[arg-type]
        return PixelsResult((len(halves[0]), len(halves[1])), usable=True)

    return run.store.run("learn-pixels", VERSION, mask_settings(run), inputs, PixelsResult, compute)


def toss_looks(run: Run, toss: int, scene: Done, masks: Done[SegmentResult]) -> TossLooks:
    """What a toss's frames show around its masks."""
    seen, s = read_masks(masks.folder, toss), run.config.learned_masks
    settings = replace(run.config.masks, foreground=run.config.masks.foreground.for_camera(run.camera))
    return TossLooks(
        run.session.toss(toss).rgbd(CAMERA), seen, StaticScene.read(scene.folder),
        RobotMasks.of(masks.folder, toss), sizes_px([int(m.sum()) for m in seen], s), settings, s,
    )  # fmt: skip


def mask_settings(run: Run) -> dict[str, object]:
    """The settings that masks are drawn anew with."""
    return {"learned": plain(run.config.learned_masks), "background": plain(run.config.masks)}
