"""The mask stages of the pipeline: the scene without the object, and the object's mask in every frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from processing.segment.background import BackgroundSegmenter
from processing.segment.segmenter import Example
from processing.segment.static_scene import StaticScene, calibrated_table_depth, learn_scene, sample_positions
from processing.stage import Counts, Done
from recordings.records import RgbdFrame
from recordings.results import write_masks

if TYPE_CHECKING:
    from processing.pipeline import Run

CAMERA = "d455"


def static_scene(run: Run) -> Done:
    """Stage `scene`: what the camera sees without the object, from frames of all tosses of the run."""
    inputs = {name: run.keys[name] for name in ("calibration", *(f"toss_{t:02d}" for t in run.tosses))}
    return run.store.run("scene", 1, run.config.scene, inputs, lambda folder: _learn_scene(run, folder))


def _learn_scene(run: Run, folder: Path) -> Counts:
    streams = [run.session.toss(t).rgbd(CAMERA) for t in run.tosses]
    chosen = sample_positions([len(s) for s in streams], run.config.scene.frames)
    progress = run.progress("static scene")

    def frames() -> Iterator[RgbdFrame]:
        for done, (toss, position) in enumerate(chosen):
            progress.step(done, len(chosen))
            yield streams[toss][position]

    scene = learn_scene(frames(), calibrated_table_depth(run.session.calibration, CAMERA), run.config.scene)
    with open(folder / "scene.npz", "wb") as out:
        np.savez(out, **vars(scene))
    return {"frames": len(chosen), "pixels_with_depth": int((scene.depth_m > 0).sum())}


def object_masks(run: Run, toss: int, scene: Done) -> Done:
    """Stage `segment`: the object's mask in every frame of one toss."""
    name = f"toss_{toss:02d}"
    inputs = {"scene": scene.key, name: run.keys[name], "calibration": run.keys["calibration"]}
    given = run.session.toss(toss).masks()
    first = {i: given[i] for i in sorted(given)[:1]}
    shown = None if first else _toss_with_mask(run)
    if shown is not None:
        inputs["example"] = run.keys[f"toss_{shown:02d}"]

    def compute(folder: Path) -> Counts:
        with np.load(scene.folder / "scene.npz", allow_pickle=False) as stored:
            learned = StaticScene(**stored)
        frames = run.session.toss(toss).rgbd(CAMERA)
        segmenter = BackgroundSegmenter(learned, run.session.calibration.camera(CAMERA), run.config.masks)
        example = None if shown is None else _example(run, shown)
        progress = run.progress(f"toss {toss}: masks")
        found = sorted(segmenter.masks(frames, first, example, None, progress), key=lambda m: m.position)
        write_masks(folder, toss, [m.mask for m in found], np.array([m.confidence for m in found]))
        empty = sum(not m.mask.any() for m in found)
        return {"frames": len(found), "empty": empty, "given": len(first), "without_depth": len(frames.without_depth)}

    return run.store.run("segment", 1, run.config.masks, inputs, compute)


def _toss_with_mask(run: Run) -> int | None:
    """The first toss that came with a mask: it shows what the object looks like."""
    return next((t for t in run.tosses if run.session.toss(t).masks()), None)


def _example(run: Run, toss: int) -> Example:
    position, mask = min(run.session.toss(toss).masks().items())
    return Example(run.session.toss(toss).rgbd(CAMERA)[position], mask)
