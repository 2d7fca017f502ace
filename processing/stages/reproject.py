"""Stage `reproject` (the paper's steps 4 and 5) of one toss: the poses at which the shape is drawn into its images,
laid onto raw depth first where wanted, and the masks M' (M'') there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from processing.images import Images, TossImages, track_and_image_keys
from processing.motion.interpolate import pose_at
from processing.refine.icp import align_frames, count_verdicts
from processing.refine.redrawn_frames import SecondFrames
from processing.run import Run
from processing.sensor.render import make_renderer
from processing.store import Done
from recordings.results.folder import read_shape, read_track, write_masks, write_track
from recordings.session import Frames
from recordings.tracks import ObjectShape, ObjectTrack

VERSION = 5


@dataclass(frozen=True)
class ReprojectResult:
    """Frames by ICP's verdict; empty without ICP."""

    icp: Mapping[str, int]


def reproject(run: Run, name: str, track: Done, shape: Done, raw: Images, icp: bool) -> Done[ReprojectResult]:
    """One toss. With `icp` the shape is first laid onto the raw depth of every frame; a rejected frame keeps its pose,
    and is counted. Depth is compared at its own exposure time, the pose is corrected at both."""
    toss, cycle = raw.toss, run.config.cycle
    inputs = {**track_and_image_keys({toss: track}, {toss: raw}), "shape": shape.key}
    config = {"icp": vars(cycle.icp) if icp else None, "redraw": vars(cycle.redraw), "renderer": cycle.renderer}

    def compute(folder: Path) -> ReprojectResult:
        run.progress(f"{name}: reprojection").step(0, 1, f"toss {toss}")
        body, poses, seen = read_shape(shape.folder), read_track(track.folder, toss), raw.open()
        counts: dict[str, int] = {}
        if icp:
            poses, counts, details = _laid_on_depth(run, poses, body, seen)
            np.savez(folder / f"toss_{toss:02d}.icp.npz", **details)
        write_track(folder, poses)
        write_masks(folder, toss, _drawn(run, poses, body, seen).masks, seen.confidence)
        return ReprojectResult(counts)

    return run.store.run("reproject", VERSION, config, inputs, ReprojectResult, compute)


def drawn_images(run: Run, drawn: Done, shape: Done, raw: Images) -> Images:
    """(RGB, D'', M'') of one toss: the shape at the poses of `drawn`, drawn when asked for."""

    def opened() -> TossImages:
        seen, body = raw.open(), read_shape(shape.folder)
        frames = _drawn(run, read_track(drawn.folder, raw.toss), body, seen)
        return replace(seen, frames=frames, depth_times_ns=frames.depth_times_ns, masks=frames.masks,
                       colorless=frames.colorless)  # fmt: skip

    return Images(raw.toss, {"masks": raw.inputs["masks"], "drawn": drawn.key, "shape": shape.key}, opened)


def _drawn(run: Run, track: ObjectTrack, body: ObjectShape, seen: TossImages) -> SecondFrames:
    renderer = make_renderer(run.config.cycle.renderer, body, run.camera)
    return SecondFrames(
        seen.frames, track.time_ns, seen.masks, track.camera_from_object, renderer, run.config.cycle.redraw
    )


def _laid_on_depth(
    run: Run, track: ObjectTrack, body: ObjectShape, seen: TossImages
) -> tuple[ObjectTrack, dict[str, int], dict[str, Any]]:
    times_ns = seen.depth_times_ns
    at_depth = np.stack([pose_at(track, i, int(times_ns[i])) for i in range(len(track.status))])
    depths = Frames(times_ns, lambda i: seen.frames[i].depth_m)
    found = align_frames(body, depths, seen.masks, run.camera, at_depth, run.config.cycle.icp, track.covariance)
    poses = track.camera_from_object.copy()
    for i, alignment in enumerate(found):
        if alignment.verdict == "aligned":
            poses[i] = poses[i] @ np.linalg.inv(at_depth[i]) @ alignment.camera_from_object
    details = {
        "verdict": np.array([a.verdict for a in found]),
        "fitness": np.array([a.fitness for a in found]),
        "rmse_m": np.array([a.rmse_m for a in found]),
        "held": np.array([a.held for a in found]),
    }
    return replace(track, camera_from_object=poses), count_verdicts(found), details
