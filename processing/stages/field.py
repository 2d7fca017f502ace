"""Stage `field`: the shape that the tracked frames show, in the frame that their tracks share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from processing.field.learn import LearnConfig, learn_shape
from processing.images import Images, track_and_image_keys
from processing.run import Run
from processing.sensor.noise import DepthNoise
from processing.store import Done, plain
from recordings.results.folder import read_shape, read_track, write_shape

VERSION = 15


@dataclass(frozen=True)
class FieldResult:
    """Frames that were looked at, vertices of the mesh, and the share of them that no frame saw; whether the poses of
    these frames are sure."""

    views: int
    vertices: int
    unobserved_share: float
    sure: bool = True


def learn_field(
    run: Run, name: str, tracks: Mapping[int, Done], images: Mapping[int, Images], prior_shape: Done | None = None
) -> Done[FieldResult]:
    """O. Where no frame looks it is the shape `prior_shape`, if there is one (else the hull of what was seen)."""
    inputs = {"for": name, **track_and_image_keys(tracks, images)}
    inputs |= {} if prior_shape is None else {"prior_shape": prior_shape.key}
    config = _with_noise(run.config.shape, run.noise)

    def compute(folder: Path) -> FieldResult:
        views = [images[t].open().views(read_track(done.folder, t)) for t, done in tracks.items()]
        body = None if prior_shape is None else read_shape(prior_shape.folder)
        progress = run.progress(f"{name}: shape")
        shape, used, sure = learn_shape(views, run.camera, config, run.device, progress, body)
        write_shape(folder, shape)
        unseen = 0.0 if shape.observed is None else float((~shape.observed).mean())
        return FieldResult(used, len(shape.vertices_m), round(unseen, 4), sure)

    return run.store.run("field", VERSION, plain(config), inputs, FieldResult, compute)


def _with_noise(config: LearnConfig, noise: DepthNoise) -> LearnConfig:
    poses = replace(config.field.poses, noise=noise)
    return replace(config, field=replace(config.field, poses=poses))
