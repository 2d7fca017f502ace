"""Stage `track-to-model`, the baseline: point-to-plane ICP to a TSDF; its folder holds its shape too."""

from __future__ import annotations

from pathlib import Path

from processing.baselines.frame_to_model import FrameToModel
from processing.images import Images
from processing.run import Run
from processing.stages.track import TrackResult
from processing.store import Done
from recordings.results.folder import write_shape, write_track

VERSION = 3


def track_to_model(run: Run, images: Images) -> Done[TrackResult]:
    """The poses of one toss and the surface that grew with them."""

    def compute(folder: Path) -> TrackResult:
        seen, toss = images.open(), images.toss
        tracker, progress = FrameToModel(run.config.frame_to_model), run.progress(f"toss {toss}: poses")
        tracked = tracker.track(toss, seen.frames, seen.masks, run.camera, f"object_toss_{toss:02d}", progress)
        write_track(folder, tracked.track)
        write_shape(folder, tracked.shape)
        status = tracked.track.status
        return TrackResult(len(status), status.count("interpolated"), int(tracked.track.lost.sum()))

    config = {"tracker": run.tracker, **vars(run.config.frame_to_model)}
    return run.store.run("track-to-model", VERSION, config, images.inputs, TrackResult, compute)
