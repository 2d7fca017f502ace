"""The coverage floor of scope one: what one toss's frames, fused at the true poses, can show of the shape at all."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from processing.evaluate.score import Value, chamfers, true_mesh
from processing.field.fuse import fuse
from processing.field.learn import TossViews, chosen_views
from processing.field.mesh import grid_mesh
from processing.run import Run
from recordings.errors import BadInput
from recordings.results.folder import RobotMasks, VariantRecord, read_masks, read_shape, write_shape
from recordings.session import RgbdFrames
from recordings.tracks import ObjectTrack, Status

if TYPE_CHECKING:
    from processing.evaluate.truth import Truth


VERSION = 4
WHERE = "each toss fused at its true poses, rigid ICP"


@dataclass(frozen=True)
class FloorResult:
    """Frames that were fused."""

    views: int


def coverage_floor(
    run: Run, frames: Mapping[int, RgbdFrames], record: VariantRecord, truth: Truth
) -> tuple[dict[str, Value], tuple[str, ...]]:
    """`cd_floor`: mean Chamfer distance over the tosses, each toss's frames fused at its true poses; and of which
    tosses it could not be computed, and why. Uses the truth, so it is called by the scorer only."""
    mesh = true_mesh(truth)
    if mesh is None:
        return {}, ()
    found, failed = [], []
    for entry in (t for t in record.tosses if t.toss in run.tosses):
        try:
            folder = _fused(run, entry.toss, frames[entry.toss], run.store.results / str(entry.masks), truth)
        except BadInput as why:
            failed.append(f"toss {entry.toss}: what its frames show of the shape (floor) is not known: {why}")
            continue
        found.append(chamfers(read_shape(folder), np.eye(4), mesh).fitted.cm)
    values = {"cd_floor": Value(float(np.mean(found)), "cm", len(found), WHERE)} if found else {}
    return values, tuple(failed)


def _fused(run: Run, toss: int, frames: RgbdFrames, masks: Path, truth: Truth) -> Path:
    """Stage `floor` of one toss. Raises BadInput where the truth has no poses of it or no frame shows the object."""
    track = ObjectTrack.nowhere(toss, run.camera.frame, frames.times_ns)
    poses = truth.camera_from_object(track)
    if poses is None or not np.isfinite(poses).any():
        raise BadInput("the truth has no pose of its frames")
    status: tuple[Status, ...] = tuple("tracked" if np.isfinite(p).all() else "lost" for p in poses)
    known = replace(track, camera_from_object=poses, status=status)
    inputs = {f"toss_{toss:02d}": run.keys[f"toss_{toss:02d}"], "masks": masks.name,
              "truth": hashlib.sha256(np.nan_to_num(poses).tobytes()).hexdigest()}  # fmt: skip

    def compute(folder: Path) -> FloorResult:
        robot = RobotMasks.of(masks, toss)
        seen = TossViews(frames, frames.depth_times_ns, read_masks(masks, toss), known, robot=robot)
        views = chosen_views([seen], run.camera, run.config.shape)
        write_shape(folder, grid_mesh(fuse(views, run.config.shape.field.fuse)))
        return FloorResult(len(views))

    return run.store.run("floor", VERSION, run.config.shape.field.fuse, inputs, FloorResult, compute).folder
