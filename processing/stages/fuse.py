"""Stage `fuse`: the frames of some tosses in one signed-distance grid, without the network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from processing.field.fuse import fuse
from processing.field.learn import chosen_views
from processing.field.mesh import grid_mesh
from processing.images import Images, track_and_image_keys
from processing.run import Run
from processing.store import Done, plain
from recordings.results.folder import read_track, write_shape

VERSION = 11
DRAFT = 2.0
"""Of a draft the cells are so many times as wide: far narrower than the band around a surface all the same."""


@dataclass(frozen=True)
class FuseResult:
    """Whose frames, and how many."""

    tosses: tuple[int, ...]
    views: int


def fuse_frames(
    run: Run, tracks: Mapping[int, Done], images: Mapping[int, Images], draft: bool = False
) -> Done[FuseResult]:
    """The surface that these tosses' frames show at their tracks' poses, which are in one object frame. A `draft` is
    for judging the poses: coarser, and of frames whose pose is not sure too."""
    inputs = track_and_image_keys(tracks, images)
    config = run.config.shape.field.fuse
    config = replace(config, voxel_m=DRAFT * config.voxel_m) if draft else config

    def compute(folder: Path) -> FuseResult:
        seen = [images[t].open().views(read_track(done.folder, t)) for t, done in tracks.items()]
        views = chosen_views(seen, run.camera, run.config.shape, alike=draft)
        write_shape(folder, grid_mesh(fuse(views, config), seen[0].track.object_frame))
        return FuseResult(tuple(tracks), len(views))

    return run.store.run("fuse", VERSION, {**plain(config), "draft": draft}, inputs, FuseResult, compute)
