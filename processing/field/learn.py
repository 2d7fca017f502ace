"""The field of an object from its tracks: which frames are looked at, and the shape that comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray as Array

from processing.engine.parts import side_by_side
from processing.field.mesh import extract_mesh
from processing.field.train import FieldConfig, train_field
from processing.field.views import FieldView, make_view, without_strays
from processing.motion.interpolate import pose_at
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.records import RgbdFrame
from recordings.results.folder import RobotMasks
from recordings.tracks import ObjectShape, ObjectTrack, Status

SURE: tuple[Status, ...] = ("tracked",)
POSED: tuple[Status, ...] = ("tracked", "interpolated")


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
) -> tuple[ObjectShape, int]:
    """The shape of an object in the frame that all tracks share, and how many views it was learned from. Where none of
    them looks it is `prior_shape`, if there is one.

    Raises BadInput where no tracked frame shows the object; where none is tracked, none with a pose.
    """
    views = chosen_views(tosses, camera, config, SURE if any_sure(tosses) else POSED)
    trained = train_field(views, config.field, device, progress, prior_shape)
    frame = tosses[0].track.object_frame
    return extract_mesh(trained.field, trained.grid, frame, "neural field"), len(views)


def any_sure(tosses: Sequence[TossViews]) -> bool:
    """Whether there are tracked frames to learn from. (What guesses show is a guess, but tells more than nothing.)"""
    return any("tracked" in t.track.status for t in tosses)


def chosen_views(
    tosses: Sequence[TossViews], camera: CameraModel, config: LearnConfig, statuses: tuple[Status, ...] = SURE
) -> list[FieldView]:
    """Views of frames of these statuses, spread evenly over all tosses, without what is none of the object's. Raises
    BadInput where none shows the object."""
    places = [(t, i) for t in tosses for i in range(len(t.track.status)) if t.track.status[i] in statuses]
    chosen = (
        [places[i] for i in np.unique(np.linspace(0, len(places) - 1, config.most_views).astype(int))] if places else []
    )
    found = side_by_side(lambda place: _view(place[0], place[1], camera), chosen)
    views = [view for view in found if view is not None]
    if not views:
        raise BadInput(
            "no frame has a pose that is sure, so there is nothing to learn a shape from; wanted at least one: look at "
            "the masks with `toss-view`, give a first mask, or record closer and with more light"
        )
    return without_strays(views)


def _view(toss: TossViews, position: int, camera: CameraModel) -> FieldView | None:
    pose = toss.track.camera_from_object[position]
    at_depth = pose_at(toss.track, position, int(toss.depth_times_ns[position]))
    foreign = None if toss.colorless is None else toss.colorless[position]
    mask = toss.masks[position]
    robot = None if toss.robot is None else toss.robot.at(position, mask.shape)
    return make_view(toss.frames[position], mask, camera, pose, at_depth, robot, foreign)
