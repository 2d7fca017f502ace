"""The field of an object from its tracks: which frames are looked at, and the shape that comes out."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray as Array

from processing.engine.parts import side_by_side
from processing.field.fuse import LEAST_SEEN
from processing.field.mesh import extract_mesh
from processing.field.train import FieldConfig, train_field
from processing.field.views import FieldView, make_view, object_surface, without_strays
from processing.motion.interpolate import pose_at
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.records import RgbdFrame
from recordings.results.folder import RobotMasks
from recordings.tracks import ObjectShape, ObjectTrack

SURE_M = 0.004
"""A view whose pose may put the surface off by so much (root mean square) counts half, one that is surer more
(docs/decisions/fusion-weights.md)."""


@dataclass(frozen=True)
class LearnConfig:
    most_views: int = 160
    """Frames looked at, spread evenly over all tosses: more cost time and add nothing to the surface."""
    field: FieldConfig = field(default_factory=FieldConfig)


@dataclass(frozen=True, eq=False)
class TossViews:
    """One toss as the field sees it: frames are read when they are chosen. `colorless`: pixels of each mask whose
    colour is not the object's. `robot`: what may stand before the object; rays that end there tell nothing of it."""

    frames: Sequence[RgbdFrame]
    depth_times_ns: Int64[Array, " n"]
    masks: Sequence[Bool[Array, "h w"]]
    track: ObjectTrack
    colorless: Sequence[Bool[Array, "h w"]] | None = None
    robot: RobotMasks | None = None


def learn_shape(
    tosses: Sequence[TossViews],
    camera: CameraModel,
    config: LearnConfig,
    device: str,
    progress: Progress,
    prior_shape: ObjectShape | None = None,
) -> tuple[ObjectShape, int, bool]:
    """The shape of an object in the frame that all tracks share, how many views it was learned from, and whether poses
    among theirs are sure. Where none of them looks it is `prior_shape`, if there is one. Raises BadInput where no frame
    with a pose shows the object.
    """
    views, sure = _sure_or_all(tosses, camera, config)
    trained = train_field(views, config.field, device, progress, prior_shape)
    frame = tosses[0].track.object_frame
    return extract_mesh(trained.field, trained.grid, frame, "neural field"), len(views), sure


def _sure_or_all(tosses: Sequence[TossViews], camera: CameraModel, config: LearnConfig) -> tuple[list[FieldView], bool]:
    """The views by how sure their poses are; where none is, all alike, for what guesses show is a guess, but tells more
    than nothing."""
    if any("tracked" in t.track.status for t in tosses):
        with suppress(BadInput):  # by their covariances they may be guesses all the same
            return chosen_views(tosses, camera, config), True
    return chosen_views(tosses, camera, config, alike=True), False


def chosen_views(
    tosses: Sequence[TossViews], camera: CameraModel, config: LearnConfig, alike: bool = False
) -> list[FieldView]:
    """Views of frames that have a pose, spread evenly over all tosses, without what is none of the object's; each
    counts by how sure its pose is, unless all count `alike`. Raises BadInput where none (that is sure) shows the
    object."""
    places = [(t, i) for t in tosses for i in np.flatnonzero(~t.track.lost)]
    chosen = (
        [places[i] for i in np.unique(np.linspace(0, len(places) - 1, config.most_views).astype(int))] if places else []
    )
    cut = side_by_side(lambda place: _view(place[0], int(place[1]), camera), chosen)
    found = [(place, view) for place, view in zip(chosen, cut, strict=True) if view is not None]
    views = without_strays([view for _, view in found])
    if views and not alike:
        surface = np.concatenate([object_surface(view) for view in views])
        sigmas_m = surface_sigmas_m([(t.track, int(i)) for (t, i), _ in found], surface)
        views = [replace(v, weight=SURE_M**2 / (SURE_M**2 + s**2)) for v, s in zip(views, sigmas_m)]
    if sum(view.weight for view in views) < LEAST_SEEN:
        raise BadInput(
            "no frame has a pose that is sure, so there is nothing to learn a shape from; wanted at least one: look at "
            "the masks with `toss-view`, give a first mask, or record closer and with more light"
        )
    return views


def surface_sigmas_m(places: Sequence[tuple[ObjectTrack, int]], surface: Float[Array, "n 2 3"]) -> Float[Array, " p"]:
    """For frames of tracks the root mean square, metres, by which the body's surface (points and normals, object frame)
    is off along its normals where the frame's pose puts it, as its covariance says, times the square root of 3: as far
    as its points are off, if alike in all directions. A round body's turn about its axis moves nothing of its surface.
    0 where the covariance is not known, which is no doubt."""
    sigmas_m = np.zeros(len(places))
    if len(surface) == 0:
        return sigmas_m
    slopes = np.concatenate([np.cross(surface[:, 0], surface[:, 1]), surface[:, 1]], axis=1)
    squares = slopes.T @ slopes / len(slopes)
    for k, (track, i) in enumerate(places):
        rotation, covariance = track.camera_from_object[i, :3, :3], track.covariance[i]
        if np.isfinite(covariance).all():
            in_camera = np.kron(np.eye(2), rotation)
            sigmas_m[k] = np.sqrt(max(3 * np.sum(covariance * (in_camera @ squares @ in_camera.T)), 0.0))
    return sigmas_m


def _view(toss: TossViews, position: int, camera: CameraModel) -> FieldView | None:
    pose = toss.track.camera_from_object[position]
    at_depth = pose_at(toss.track, position, int(toss.depth_times_ns[position]))
    foreign = None if toss.colorless is None else toss.colorless[position]
    mask = toss.masks[position]
    robot = None if toss.robot is None else toss.robot.at(position, mask.shape)
    return make_view(toss.frames[position], mask, camera, pose, at_depth, robot, foreign)
