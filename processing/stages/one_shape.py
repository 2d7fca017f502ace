"""Do the tosses that were brought into one object frame show one shape there?

A registration can fit what two tosses see in common and still be turned (a prism's faces look alike); then their frames
fused together explain neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from processing.field.fuse import fuse
from processing.field.learn import TossViews, chosen_views
from processing.field.mesh import grid_mesh
from processing.stages.cycle import judge_stage
from processing.store import Counts, Done
from recordings.results.folder import RobotMasks, read_masks, read_track, write_shape

if TYPE_CHECKING:
    from processing.pipeline import Run


def of_one_shape(
    run: Run, together: Done, shape: Done, masks: Mapping[int, Done], joined: Sequence[int]
) -> tuple[list[int], list[int]]:
    """Tosses that one shape explains, and those that it does not. The outline decides: the share of a toss's mask and
    the drawn shape that is not common to both, against `CycleConfig.apart_mask`; and half of that must be more than
    what the toss's own frames fused alone leave (a pixel of a small mask is much, a gripper hides some).

    Where the shape of all explains all, that is it. Else tosses are added one by one to the first, each kept only where
    the frames fused so far explain every toss among them.
    """
    if not _unexplained(run, together, shape, masks, joined):
        return list(joined), []
    kept: list[int] = list(joined[:1])
    for toss in joined[1:]:
        tried = [*kept, toss]
        fused = _fused_stage(run, together, {t: masks[t] for t in tried})
        if not _unexplained(run, together, fused, masks, tried):
            kept = tried
    return kept, [t for t in joined if t not in kept]


def _unexplained(run: Run, together: Done, shape: Done, masks: Mapping[int, Done], tosses: Sequence[int]) -> list[int]:
    """Tosses whose outline the shape does not explain, although their own frames alone do."""
    limit = run.config.cycle.apart_mask
    left = _left(run, together, dict.fromkeys(tosses, shape), masks)
    odd = [t for t in tosses if left[t] > limit]
    if not odd:
        return []
    alone = _left(run, together, {t: _fused_stage(run, together, {t: masks[t]}) for t in odd}, masks)
    return [t for t in odd if left[t] > alone[t] + 0.5 * limit]


def _left(run: Run, together: Done, shapes: Mapping[int, Done], masks: Mapping[int, Done]) -> dict[int, float]:
    """Share of outline and drawn shape that is not common, median over a toss's frames; 0 where none can be judged."""
    judged = judge_stage(run, "one shape", dict.fromkeys(shapes, together), shapes, {t: masks[t] for t in shapes})
    with np.load(judged.folder / "residuals.npz", allow_pickle=False) as stored:
        rows = stored["rows"]
    return {t: float(np.median(rows[rows[:, 0] == t, 3])) if (rows[:, 0] == t).any() else 0.0 for t in shapes}


def _fused_stage(run: Run, together: Done, masks: Mapping[int, Done]) -> Done:
    """Stage `fused`: the frames of some tosses in one signed-distance grid, without the network."""
    inputs = {"together": together.key, **{f"masks_{t:02d}": d.key for t, d in masks.items()}}

    def compute(folder: Path) -> Counts:
        seen = []
        for toss, done in masks.items():
            frames = run.frames(toss)
            track = read_track(together.folder, toss)
            robot = RobotMasks.of(done.folder, toss)
            seen.append(TossViews(frames, frames.depth_times_ns, read_masks(done.folder, toss), track, robot=robot))
        views = chosen_views(seen, run.camera, run.config.shape)
        write_shape(folder, grid_mesh(fuse(views, run.config.shape.field.fuse), seen[0].track.object_frame))
        return {"tosses": list(masks), "views": len(views)}

    return run.store.run("fused", 3, run.config.shape.field.fuse, inputs, compute)
