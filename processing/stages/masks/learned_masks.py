"""Stage `learned-masks`: the object's masks drawn anew by what all masks of the session show of it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.run import Run, toss_keys
from processing.segment.learned.again import Judged, found_again
from processing.segment.learned.masks import half_of, redrawn
from processing.segment.learned.network import PixelNetwork
from processing.stages.masks.find import given_masks
from processing.stages.masks.learn_pixels import HALVES, PixelsResult, mask_settings, toss_looks
from processing.stages.masks.segment import SegmentResult
from processing.store import Done
from recordings.results.folder import write_masks
from recordings.results.stage_files import read_arrays

VERSION = 3


def learned_masks(
    run: Run, toss: int, scene: Done, masks: Done[SegmentResult], pixels: Done[PixelsResult]
) -> Done[SegmentResult]:
    """The masks of one toss by the network of the half that a frame does not belong to; given masks as they are."""
    inputs = {"scene": scene.key, "masks": masks.key, "pixels": pixels.key, **toss_keys(run, toss)}
    s = run.config.learned_masks

    def compute(folder: Path) -> SegmentResult:
        arrays = read_arrays(pixels.folder / "networks.npz")
        networks = [PixelNetwork.of(arrays, f"half{k}") for k in HALVES]
        given, seen = given_masks(run, toss), toss_looks(run, toss, scene, masks)
        progress = run.progress(f"toss {toss}: masks by what all frames show")

        def network_of(i: int) -> PixelNetwork:
            return networks[1 - half_of(toss, i, s)]

        def drawn(i: int, mask: Bool[Array, "h w"], rough: bool = False) -> Judged | None:
            found = seen.look(i, mask)
            return None if found is None else redrawn(found, network_of(i), mask.shape, seen.settings, s, rough)

        def drawn_roughly(i: int, mask: Bool[Array, "h w"]) -> Judged | None:
            found = drawn(i, seen.free(i, mask), rough=True)
            fine = None if found is None else drawn(i, found.mask)
            return found if found is None or fine is None else replace(fine, support=found.support)

        judged = []
        for i, mask in enumerate(seen.masks):
            found = None if i in given else drawn(i, mask)
            judged.append(found or Judged(mask, float(seen.masks.confidence[i]), float(i in given)))
            progress.step(i + 1, len(seen.masks), "masks")
        judged = found_again(
            judged, seen.sizes_px**2, [i in given for i in range(len(judged))],
            lambda i, at: network_of(i).log_odds(seen.features(i, at)),
            drawn_roughly, s.again,
        )  # fmt: skip
        write_masks(folder, toss, [j.mask for j in judged], np.array([j.sure for j in judged]))
        for name in (f"toss_{toss:02d}.robot", f"toss_{toss:02d}.hand.npy"):
            if (masks.folder / name).is_dir():
                shutil.copytree(masks.folder / name, folder / name)
            elif (masks.folder / name).exists():
                shutil.copyfile(masks.folder / name, folder / name)
        return replace(masks.result, empty=sum(not j.mask.any() for j in judged))

    return run.store.run("learned-masks", VERSION, mask_settings(run), inputs, SegmentResult, compute)
