"""Stage `fuse`: the frames of some tosses in one signed-distance grid, without the network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from processing.field.fuse import fuse
from processing.field.learn import chosen_views
from processing.field.mesh import grid_mesh
from processing.images import Images
from processing.run import Run
from processing.store import Done
from recordings.results.folder import read_track, write_shape

VERSION = 5


@dataclass(frozen=True)
class FuseResult:
    """Whose frames, and how many."""

    tosses: tuple[int, ...]
    views: int


def fuse_frames(run: Run, together: Done, images: Mapping[int, Images], tosses: Sequence[int]) -> Done[FuseResult]:
    """The surface that these tosses' frames show at the poses of `together`."""
    inputs = {"together": together.key}
    inputs |= {f"masks_{t:02d}": images[t].inputs["masks"] for t in tosses}

    def compute(folder: Path) -> FuseResult:
        seen = [images[t].open().views(read_track(together.folder, t)) for t in tosses]
        views = chosen_views(seen, run.camera, run.config.shape)
        write_shape(folder, grid_mesh(fuse(views, run.config.shape.field.fuse), seen[0].track.object_frame))
        return FuseResult(tuple(tosses), len(views))

    return run.store.run("fuse", VERSION, run.config.shape.field.fuse, inputs, FuseResult, compute)
