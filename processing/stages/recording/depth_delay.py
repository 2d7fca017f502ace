"""Stage `depth-delay`: how much later than its stamps say depth is exposed, once the masks show where the object is."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processing.engine.parts import side_by_side
from processing.run import CAMERA, Run
from processing.segment.background.depth_delay import OutlineShifts, delay_of, outline_shifts, posterior_delay
from processing.segment.background.static_scene import StaticScene
from processing.sensor.depth_stamps import with_depth_later
from processing.store import Done
from recordings.notices import Notice
from recordings.results.folder import read_masks

VERSION = 3


@dataclass(frozen=True)
class DepthDelayResult:
    """Depth's exposure after colour's as stamped and as the images show it, its standard deviation (s; None: too
    little moves), and what is added to depth's stamps; `frames`: that show the object moving."""

    stamped_s: float
    seen_s: float | None
    sigma_s: float | None
    added_s: float
    frames: int


def with_depth_in_time(run: Run, scene: Done, masks: Mapping[int, Done]) -> Run:
    """The run with depth's stamps put right; the very same run where they are."""
    settings = run.config.depth_delay
    inputs = {"scene": scene.key, **{f"masks_{t:02d}": done.key for t, done in masks.items()}}

    def compute(folder: Path) -> DepthDelayResult:
        learned = StaticScene.read(scene.folder)
        frames = {t: run.session.toss(t).rgbd(CAMERA) for t in masks}
        seen = list(side_by_side(
            lambda t: outline_shifts(frames[t], read_masks(masks[t].folder, t), learned, settings), list(masks)
        ))  # fmt: skip
        stamps_s = [(f.depth_times_ns - f.times_ns) * 1e-9 for f in frames.values()]
        stamped_s = float(np.median(np.concatenate(stamps_s)))
        found = delay_of(OutlineShifts.joined(seen), settings)
        added_s = posterior_delay(found, stamped_s, settings)
        if found is None:
            return DepthDelayResult(stamped_s, None, None, added_s, 0)
        return DepthDelayResult(stamped_s, found.delay_s, found.sigma_s, added_s, found.frames)

    result = run.store.run("depth-delay", VERSION, settings, inputs, DepthDelayResult, compute).result
    if result.added_s == 0.0:
        return run
    later_ns = round(1e9 * result.added_s)
    keys = {f"toss_{t:02d}": hashlib.sha256(f"{run.keys[f'toss_{t:02d}']} depth {later_ns}".encode()).hexdigest()
            for t in run.recorded}  # fmt: skip
    return replace(run, session=with_depth_later(run.session, later_ns), keys={**run.keys, **keys},
                   warnings=(*run.warnings, _late_depth(result)))  # fmt: skip


def _late_depth(result: DepthDelayResult) -> Notice:
    assert result.seen_s is not None
    assert result.sigma_s is not None
    seen = (
        f"depth shows the moving object {1e3 * abs(result.seen_s):.1f} +- {1e3 * result.sigma_s:.1f} ms "
        f"{'after' if result.seen_s > 0 else 'before'} colour, its stamps say {1e3 * result.stamped_s:.1f} ms: depth's "
        f"times were put right by {1e3 * result.added_s:.1f} ms"
    )
    return Notice("rig", "low", seen, "record depth's own stamps, or the exposure of both", "likely")
