"""Contact learning for the pipeline: vision's tracks and mesh in; corrected mesh, contact model, rollouts out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.contact.fuse import Field, FusionConfig, Readings, Sizes, Surface, likely_sizes, thinned
from processing.contact.learn.convexity import ClassName, GeometryChoice, choose_geometry, measured_prior, start_points
from processing.contact.learn.data_checks import of_own_tracks
from processing.contact.learn.fit import FRICTION, Model, fit_lbfgs
from processing.contact.learn.learn import (
    ContactConfig,
    ContactLearning,
    learn_contact,
    results_of,
    slow_friction,
    with_friction,
)
from processing.contact.learn.prior import Prior
from processing.contact.learn.resting_plane import plane_of_rests
from processing.contact.learn.shape_comparison import losses_of, mean_loss_j, series_of, usable
from processing.contact.physics.geometry import SCALE_M, FreePoints, pieces_mesh
from processing.contact.physics.inertia import Physics, uniform_physics
from processing.contact.physics.loss import REFERENCE_MASS_KG, contact_loss, find_contacts, point_velocity
from processing.contact.physics.plane import Plane
from processing.contact.report.result import left_out_notice, result_document, warnings_of
from processing.contact.report.rollout_errors import FIGURE_4_STEPS, Evaluation, evaluate
from processing.motion.trajectory import PoseSeries
from recordings.constants import GRAVITY_M_S2
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.notices import Notice
from recordings.progress import Progress, Silent
from recordings.tracks import ContactModel, ObjectShape, ObjectTrack

REACH = 0.15
"""Neighbourhood of a touched point in which the prior is compared with it, as a share of the mean extent."""
BLUR = 0.1
"""What a touch reads is blurred by this share of the point's way between two frames: the impact was somewhere on it."""
NEAR_M = 0.005
"""A point this near to the plane may read the surface."""


@dataclass(frozen=True)
class TracksConfig:
    """The settings of contact learning from vision's tracks."""

    contact: ContactConfig = field(default_factory=lambda: ContactConfig(bootstrap_repeats=12, penetration=20.0))
    geometry: ClassName | None = None
    """None: chosen from the data."""
    fusion: FusionConfig = field(default_factory=FusionConfig)
    held_seen_m: float = 0.003
    """While contact learns, a support point that a camera saw is held this tightly: rather too loosely, for the meeting
    of vision and contact (fusion) comes afterwards."""
    held_unseen_m: float = 0.03
    """One that no camera saw."""
    least_tracked: float = 0.25
    """Share of a toss's frames; a toss tracked in fewer is left out. Not more: only sure frames are learned from, and
    how little few of them tell the intervals say (of .48 and .38 of choose-034's: .27 [.12, 1.22] for .12)."""


@dataclass(frozen=True, eq=False)
class TrackLearning:
    """What contact learning on vision's tracks gives. Everything is in the object frame of the tracks.

    `shape` has vision's triangles, moved by `moved_m` (metres, per vertex) where contact knew better. `learning` is
    that of contact alone, `fused` the same with the fused geometry.
    """

    shape: ObjectShape
    model: ContactModel
    moved_m: Float[Array, " v"]
    rollouts: Evaluation
    document: Mapping[str, Any]
    learning: ContactLearning
    fused: ContactLearning
    choice: GeometryChoice
    left_out: Mapping[int, str]
    plane: Plane
    """The one that contact was learned on."""
    plane_off: Notice | None
    """What to say where it is not the one that was given."""


def learn_from_tracks(
    tracks: Mapping[int, ObjectTrack],
    shape: ObjectShape,
    world_from_camera: Transform,
    plane: Plane | None = None,
    physics: Physics | None = None,
    config: TracksConfig | None = None,
    progress: Progress | None = None,
) -> TrackLearning:
    """Learn contact geometry and friction from tracks of one or more tosses in one object frame, with vision's mesh as
    the prior, and correct the mesh by what contact knows better.

    `physics` None: unit mass, uniform density over the mesh. `plane` None: z = 0 of `world`.
    Raises BadInput for tracks without contact, a plane that contradicts what the camera saw, other object frames.
    """
    config = config or TracksConfig()
    _check_frames(tracks, shape, world_from_camera)
    left_out = usable(list(tracks.values()), config.least_tracked)
    series = [s for s in series_of(tracks, world_from_camera) if s.toss not in left_out]
    if not series:
        raise BadInput("no toss can be learned from: " + "; ".join(f"toss {t}: {why}" for t, why in left_out.items()))
    with of_own_tracks():
        return learn_from_series(series, shape, plane, physics, config, progress, left_out)


def learn_from_series(
    series: Sequence[PoseSeries],
    shape: ObjectShape,
    plane: Plane | None = None,
    physics: Physics | None = None,
    config: TracksConfig | None = None,
    progress: Progress | None = None,
    left_out: Mapping[int, str] | None = None,
) -> TrackLearning:
    """The same from `world_from_object` poses in the object frame of the shape."""
    torch.set_num_threads(1)  # the batches are small: more threads only wait for each other
    plane, config, progress = plane or Plane(), config or TracksConfig(), progress or Silent()
    physics = physics or uniform_physics(shape)
    sigmas = (config.held_seen_m, config.held_unseen_m)
    hull = measured_prior("hull", shape, physics, *sigmas)
    plane, off = plane_of_rests(series, shape, hull, physics, plane)
    choice = choose_geometry(series, shape, physics, plane, config.contact, sigmas, config.geometry)
    prior = hull if choice.name == "hull" else measured_prior(choice.name, shape, physics, *sigmas)
    alone = replace(config.contact, friction_by_forecasts=False)  # they are made once the geometry is fused
    learning = learn_contact(series, prior, physics, plane, alone, progress)
    surface = Surface(shape.vertices_m, shape.observed)
    readings, plane_m = readings_of(learning, prior), config.fusion.plane_m if plane.std_m is None else plane.std_m
    sizes = likely_sizes(readings, surface, config.fusion, plane_m)
    field_ = Field(readings, sizes, config.fusion, surface, plane_m)
    moved = field_.at(shape.vertices_m)
    refined = ObjectShape(
        shape.object_frame, "contact", shape.vertices_m + moved, shape.faces, shape.vertex_rgb, shape.observed
    )
    fused = _fused(learning, prior, physics, plane, field_, config.contact)
    rollouts = evaluate(
        fused, series, plane, FIGURE_4_STEPS, config.contact.rollout_step_s, "release", ready=learning.prepared
    )
    left_out = {**(left_out or {}), **learning.left_out}
    length = np.linalg.norm(moved, axis=1)
    document = _document(learning, fused, rollouts, prior, choice, readings, sizes, length, shape, left_out, plane, off)
    return TrackLearning(
        refined, fused.model, length, rollouts, document, learning, fused, choice, left_out, plane, off
    )


def _check_frames(tracks: Mapping[int, ObjectTrack], shape: ObjectShape, world_from_camera: Transform) -> None:
    frames = {t.object_frame for t in tracks.values()} | {shape.object_frame}
    if len(frames) > 1:
        raise BadInput(
            f"tracks and shape are in different object frames: {sorted(frames)}; wanted one (register the tosses first)"
        )
    cameras = {t.camera for t in tracks.values()}
    if cameras - {world_from_camera.source} or world_from_camera.target != "world":
        raise BadInput(f"tracks in {sorted(cameras)} cannot be moved by {world_from_camera}; wanted world_from_camera")


def readings_of(learning: ContactLearning, prior: Prior) -> Readings:
    """What each touch says about the prior's support, in the object frame."""
    data, body = learning.data, learning.body()
    contacts = learning.fitted.geometry.contacts
    impulses = contact_loss(data, body, contacts, learning.weights).impulses
    found = find_contacts(data.rotation, data.position_m, body, contacts)
    least = 0.05 * REFERENCE_MASS_KG * GRAVITY_M_S2 * data.step_s[impulses.rows]
    touch = (impulses.impulse[..., 2] > least[:, None]) & (found.height_m[impulses.rows].abs() < NEAR_M)
    touch &= (data.weight[impulses.rows] > 0)[:, None]
    row, column = touch.nonzero().cpu().numpy().T
    rows = impulses.rows.cpu().numpy()[row]
    point = found.index.cpu().numpy()[rows, column]
    down = -data.rotation.cpu().numpy()[rows, 2]
    moved = point_velocity(data.rotation, found.arm_m, data.spin, data.velocity).norm(dim=-1)
    blur = BLUR * (moved * data.step_s[:, None]).cpu().numpy()[rows, column]
    kept = thinned(point, down, -blur)
    return _compared(learning, prior, body.points_m.cpu().numpy(), point[kept], down[kept], blur[kept])


def _compared(
    learning: ContactLearning,
    prior: Prior,
    points: Float[Array, "v 3"],
    touched: Int[Array, " j"],
    direction: Float[Array, "j 3"],
    blur_m: Float[Array, " j"],
) -> Readings:
    """Learned against prior support near the touched points, along the directions they were touched in."""
    start = start_points(prior)
    gap = np.linalg.norm(points[touched][:, None] - start[None], axis=-1)
    near = gap < REACH * np.ptp(start, axis=0).mean()
    near[np.arange(len(touched)), touched] = True
    reach = np.where(near, direction @ start.T, -np.inf)
    further = (direction * points[touched]).sum(1) - reach.max(1)
    at = start[reach.argmax(1)]
    if learning.spread.points_m is None:
        width = np.broadcast_to(0.5 * learning.spread.extents_m, (len(touched), 3))
    else:
        width = learning.spread.points_m[touched]
    sigma = np.sqrt(((direction * width / 1.96) ** 2).sum(1) + blur_m**2)
    axes = prior.frame.axes
    return Readings(prior.frame.back(at), direction @ axes.T, further, sigma)


def _fused(
    learning: ContactLearning, prior: Prior, physics: Physics, plane: Plane, moves: Field, contact_config: ContactConfig
) -> ContactLearning:
    """The prior's support moved by the field, and the friction that goes with it."""
    frame, geometry = prior.frame, learning.fitted.geometry
    start = frame.back(start_points(prior))
    points = frame.inside(start + moves.at(start))
    config = replace(learning.fitted.config, learn_shape=False)
    model = Model(FreePoints(points, geometry.pieces(), geometry.contacts), learning.fitted.inertia_kgm2, config)
    begin = np.append(points.ravel() / SCALE_M, learning.fit.parameters[FRICTION])
    found = fit_lbfgs(model, begin, learning.data, learning.weights, 20)
    slow = slow_friction(model, found.parameters, learning.prepared, contact_config)
    found, spread = with_friction(found, learning.spread, slow, learning.prepared, contact_config)
    moved = replace(prior, geometry=model.geometry)
    contact, _, friction, sizes = results_of(
        model, found.parameters, spread, slow, moved, physics, plane, learning.touched
    )
    return replace(
        learning,
        model=contact,
        shape=_support_mesh(contact, learning.touched),
        friction=friction,
        extents=sizes,
        spread=spread,
        fit=found,
        fitted=model,
        solver_failures=learning.solver_failures + found.last_failures,
        law=None if slow is None else slow.law,
        restitution=None if slow is None else slow.restitution,
    )


def _support_mesh(model: ContactModel, touched: Bool[Array, " v"]) -> ObjectShape:
    """The hulls of a model's pieces as one mesh."""
    vertices, faces = pieces_mesh(model.support_vertices_m, model.pieces)
    at = np.linalg.norm(model.support_vertices_m[None] - vertices[:, None], axis=-1).argmin(1)
    return ObjectShape(model.object_frame, "contact", vertices, faces, None, touched[at])


def _document(
    learning: ContactLearning,
    fused: ContactLearning,
    rollouts: Evaluation,
    prior: Prior,
    choice: GeometryChoice,
    readings: Readings,
    sizes: Sizes,
    moved_m: Float[Array, " v"],
    shape: ObjectShape,
    left_out: Mapping[int, str],
    plane: Plane,
    plane_off: Notice | None,
) -> dict[str, Any]:
    """Everything a reader needs to judge it, as JSON values."""
    seen = np.ones(len(moved_m), dtype=bool) if shape.observed is None else shape.observed
    inertia = learning.fitted.inertia_kgm2
    losses = {
        name: mean_loss_j(losses_of(learning.prepared, points, friction, inertia))
        for name, points, friction in (
            ("vision", start_points(prior), fused.friction.value),
            ("contact_alone", learning.body().points_m.cpu().numpy(), learning.friction.value),
            ("refined", fused.body().points_m.cpu().numpy(), fused.friction.value),
        )
    }
    return {
        **result_document(fused, rollouts),
        "geometry_choice": {
            "name": choice.name,
            "empty_share_of_hull": choice.concavity,
            "reason": choice.reason,
            "held_out_loss_j": dict(choice.held_out_loss_j),
        },
        "contact_alone": {
            "friction": learning.friction.to_json(),
            "extents_m": [e.to_json() for e in learning.extents],
        },
        "fusion": {
            "readings": len(readings),
            "median_reading_m": float(np.median(readings.further_m)) if len(readings) else None,
            "vision_sigma_seen_m": sizes.seen_m,
            "vision_sigma_unseen_m": sizes.unseen_m,
            "vision_sigma_scale": sizes.scale,
            "moved_seen_m": _moves(moved_m[seen]),
            "moved_unseen_m": _moves(moved_m[~seen]),
        },
        "contact_loss_j": losses,
        "plane": {"offset_m": plane.offset_m, "normal": list(map(float, plane.normal_world)), "source": plane.source},
        "left_out": {str(t): why for t, why in left_out.items()},
        "warnings": [
            n.to_json()
            for n in (
                *([plane_off] if plane_off else ()),
                *(left_out_notice(t, why) for t, why in left_out.items() if t not in learning.left_out),
                *warnings_of(fused),
            )
        ],
    }


def _moves(lengths_m: Float[Array, " v"]) -> dict[str, float] | None:
    if len(lengths_m) == 0:
        return None
    return {
        "mean": float(lengths_m.mean()),
        "p95": float(np.quantile(lengths_m, 0.95)),
        "most": float(lengths_m.max()),
    }
