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
from processing.store import Done
from recordings.results.folder import read_track, write_shape

VERSION = 6


@dataclass(frozen=True)
class FuseResult:
    """Whose frames, and how many."""

    tosses: tuple[int, ...]
    views: int


def fuse_frames(
    run: Run, tracks: Mapping[int, Done], images: Mapping[int, Images], unsure: bool = False
) -> Done[FuseResult]:
    """The surface that these tosses' frames show at their tracks' poses, which are in one object frame; with `unsure`
    those whose pose is not sure too."""
    inputs = track_and_image_keys(tracks, images) | ({"unsure": "too"} if unsure else {})

    def compute(folder: Path) -> FuseResult:
        found = {t: read_track(done.folder, t) for t, done in tracks.items()}
        if unsure:
            found = {
                t: replace(f, status=tuple("lost" if gone else "tracked" for gone in f.lost)) for t, f in found.items()
            }
        seen = [images[t].open().views(track) for t, track in found.items()]
        views = chosen_views(seen, run.camera, run.config.shape)
        write_shape(folder, grid_mesh(fuse(views, run.config.shape.field.fuse), seen[0].track.object_frame))
        return FuseResult(tuple(tracks), len(views))

    return run.store.run("fuse", VERSION, run.config.shape.field.fuse, inputs, FuseResult, compute)
