"""Is a shape better or worse, without truth? By the contact loss at given poses.

What raw depth says of a shape: processing/refine/image_residuals.py.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.learn.data_checks import lowest_point_m
from processing.contact.learn.prepared import Prepared, prepare, transitions
from processing.contact.learn.prior import Frame
from processing.contact.physics.loss import (
    REFERENCE_MASS_KG,
    Body,
    StepData,
    Weights,
    contact_loss,
    idle_terms,
    step_terms,
)
from processing.contact.physics.plane import Plane
from processing.motion.trajectory import PoseSeries
from recordings.geometry import Transform
from recordings.tracks import ContactModel, ObjectTrack

CONTACTS = 10
JUDGING = Weights(dissipation=30.0, penetration=20.0)
"""One set of weights for everything that is compared."""


@dataclass(frozen=True)
class TossLoss:
    """Contact loss of one toss: mean over its transitions from the release on, in J, and its terms before weighting
    (J, N s m, N s m, m^2); the height (m) of the lowest point at rest, None where it does not come to rest."""

    toss: int
    loss_j: float
    prediction: float
    complementarity: float
    dissipation: float
    penetration: float
    transitions: int
    rest_height_m: float | None


def contact_loss_of(
    tracks: Mapping[int, ObjectTrack],
    points: Float[Array, "v 3"],
    model: ContactModel,
    world_from_camera: Transform,
    plane: Plane | None = None,
    weights: Weights = JUDGING,
) -> dict[int, TossLoss]:
    """The contact loss per toss at given poses of the points (object frame) that may touch, with friction and inertia
    of a model. Lower is better; compare tosses that neither was learned from. Raises BadInput where no toss can be
    used."""
    plane = plane or Plane(model.plane_normal_world, model.plane_offset_m, "the contact model")
    frame = Frame(np.eye(3), model.center_of_mass_m)
    prepared = prepare(series_of(tracks, world_from_camera), frame, plane, _scaled(model))
    return losses_of(prepared, frame.inside(points), model.friction, _scaled(model), weights)


def _scaled(model: ContactModel) -> Float[Array, "3 3"]:
    return np.asarray(REFERENCE_MASS_KG / model.mass_kg * model.inertia_kgm2)


def losses_of(
    prepared: Prepared,
    points_m: Float[Array, "v 3"],
    friction: float,
    inertia_kgm2: Float[Array, "3 3"],
    weights: Weights = JUDGING,
) -> dict[int, TossLoss]:
    """The same for prepared tosses; points about the centre of mass, inertia at the reference mass."""

    def number(value: Any) -> torch.Tensor:
        return torch.as_tensor(np.asarray(value), dtype=torch.float64)

    body = Body(number(points_m), number(friction), number(inertia_kgm2))
    data = StepData(transitions(prepared))
    impulses = contact_loss(data, body, CONTACTS, weights).impulses
    names = ("prediction", "complementarity", "dissipation", "penetration")
    terms = np.zeros((len(data), 4))
    for part in (step_terms(data, body, impulses, CONTACTS), idle_terms(data, body, impulses, CONTACTS)):
        terms[part.rows.numpy()] = np.stack([getattr(part, n).numpy() for n in names], 1)
    total = terms @ [getattr(weights, n) for n in names]
    found = {}
    for track, smoothed in zip(prepared.tracks, prepared.smoothed):
        rows = data.steps.toss == track.toss
        if rows.any():
            height = lowest_point_m(track, points_m, smoothed.phases)
            a, b, c, d = (float(x) for x in terms[rows].mean(0))
            found[track.toss] = TossLoss(track.toss, float(total[rows].mean()), a, b, c, d, int(rows.sum()), height)
    return found


def mean_loss_j(losses: Mapping[int, TossLoss]) -> float:
    """Mean over tosses, each weighing the same."""
    return float(np.mean([x.loss_j for x in losses.values()]))


def series_of(tracks: Mapping[int, ObjectTrack], world_from_camera: Transform) -> list[PoseSeries]:
    """`world_from_object` of tracks, without lost frames; interpolated ones are a guess and are left out too."""
    out = []
    for toss, track in sorted(tracks.items()):
        kept = np.array([s == "tracked" for s in track.status], dtype=bool)
        moved = world_from_camera.matrix @ track.camera_from_object[kept]
        time_s = 1e-9 * (track.time_ns[kept] - track.time_ns[0]) if len(track.time_ns) else np.zeros(0)
        out.append(PoseSeries(toss, time_s, moved[:, :3, :3].copy(), moved[:, :3, 3].copy()))
    return out


def usable(tracks: Sequence[ObjectTrack], least: float) -> dict[int, str]:
    """Why tosses cannot be learned from: their track is lost for most of the toss."""
    found = {}
    for track in tracks:
        share = np.mean([s == "tracked" for s in track.status]) if track.status else 0.0
        if share < least:
            found[track.toss] = f"tracked in {100 * share:.0f} % of its frames; wanted at least {100 * least:.0f} %"
    return found
