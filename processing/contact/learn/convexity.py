"""Convex or not: which class of contact geometry the data ask for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial import ConvexHull

from processing.contact.fuse import Surface
from processing.contact.learn.learn import ContactConfig, learn_contact
from processing.contact.learn.prepared import prepare
from processing.contact.learn.prior import Prior, prior_from_shape
from processing.contact.learn.shape_comparison import losses_of
from processing.contact.physics.geometry import SCALE_M
from processing.contact.physics.inertia import Physics
from processing.contact.physics.loss import Weights
from processing.contact.physics.plane import Plane
from processing.contact.physics.support import surface_samples, trimmed_vertices, volume_m3
from processing.motion.trajectory import PoseSeries
from recordings.tracks import ObjectShape

ClassName = Literal["hull", "nonconvex"]
CLASSES: tuple[ClassName, ...] = get_args(ClassName)
CONVEX = 0.06
"""A mesh that leaves up to this share of its trimmed hull empty counts as convex."""
DEEP, DEEP_SHARE = 0.06, 0.02
"""A notch is deeper than this share of the mean extent; so little surface in notches counts as none."""


@dataclass(frozen=True, eq=False)
class GeometryChoice:
    """Which class of contact geometry, and why."""

    name: ClassName
    concavity: float | None
    reason: str
    held_out_loss_j: Mapping[str, float]


def measured_prior(name: ClassName, shape: ObjectShape, physics: Physics, seen_m: float, unseen_m: float) -> Prior:
    """A prior from vision's mesh, which holds its points where a camera saw them and lets them go where none did.

    Not `measured` as a whole: a part that no camera saw may be far off without the plane being wrong.
    """
    prior = prior_from_shape(name, shape, physics, trimmed=True)
    points = prior.frame.back(start_points(prior))
    unseen = Surface(shape.vertices_m, shape.observed).unseen(points)
    sigma = np.sqrt((1 - unseen) * seen_m**2 + unseen * unseen_m**2)
    return replace(prior, measured=False, sigma_m=sigma)


def start_points(prior: Prior) -> Float[Array, "v 3"]:
    """The prior's support points in the learning frame."""
    return np.asarray(prior.geometry.start().reshape(-1, 3) * SCALE_M)


def choose_geometry(
    series: Sequence[PoseSeries],
    shape: ObjectShape,
    physics: Physics,
    plane: Plane,
    config: ContactConfig,
    sigmas_m: tuple[float, float],
    wanted: ClassName | None = None,
) -> GeometryChoice:
    """Convex or not: from how much of its trimmed hull the mesh leaves empty; contact has a veto.

    Against a plane a body touches with its convex hull only, so contact cannot prove a notch: a union of pieces is kept
    unless it explains held-out tosses worse than the hull does (by two paired standard errors).
    """
    if wanted is not None:
        return GeometryChoice(wanted, None, "asked for", {})
    inside = volume_m3(shape)
    if inside is None:
        return GeometryChoice(
            "hull", None, "the mesh is not closed, so it has no volume to compare with its hull's", {}
        )
    hull = float(ConvexHull(trimmed_vertices(shape.vertices_m, shape.faces)).volume)
    empty, deep = 1 - inside / hull, _deep_share(shape)
    if empty <= CONVEX or deep <= DEEP_SHARE:
        why = f"the mesh fills {100 * (1 - empty):.0f} % of its hull; {100 * deep:.1f} % of its surface lies deep in it"
        return GeometryChoice("hull", empty, why, {})
    if len(series) < 4:
        why = f"the mesh leaves {100 * empty:.0f} % of its hull empty; too few tosses to test it on held-out ones"
        return GeometryChoice("nonconvex", empty, why, {})
    return _tested_choice(series, shape, physics, plane, config, sigmas_m, empty)


def _deep_share(shape: ObjectShape) -> float:
    """The share of the surface that lies deeper below the trimmed hull than bumps and spikes can explain."""
    points = surface_samples(shape.vertices_m, shape.faces, 3000)
    planes = ConvexHull(trimmed_vertices(shape.vertices_m, shape.faces)).equations
    below = -(points @ planes[:, :3].T + planes[:, 3]).max(1)
    return float((below > DEEP * np.ptp(points, axis=0).mean()).mean())


def _tested_choice(
    series: Sequence[PoseSeries],
    shape: ObjectShape,
    physics: Physics,
    plane: Plane,
    config: ContactConfig,
    sigmas_m: tuple[float, float],
    empty: float,
) -> GeometryChoice:
    """Learn both on every second toss with few iterations, and compare the contact loss of the others."""
    quick = replace(
        config,
        bootstrap_repeats=0,
        weights=config.weights or Weights(dissipation=config.one_toss_dissipation, penetration=config.penetration),
        fit=replace(config.fit, adam_iterations=60),
    )
    learned, held_out = series[::2], series[1::2]
    losses: dict[str, Float[Array, " n"]] = {}
    for name in CLASSES:
        prior = measured_prior(name, shape, physics, *sigmas_m)
        found = learn_contact(learned, prior, physics, plane, quick)
        prepared = prepare(held_out, found.frame, plane, found.fitted.inertia_kgm2)
        points = found.body().points_m.cpu().numpy()
        each = losses_of(prepared, points, found.friction.value, found.fitted.inertia_kgm2)
        losses[name] = np.array([x.loss_j for x in each.values()])
    worse = losses["nonconvex"] - losses["hull"]
    standard_error = float(worse.std(ddof=1)) / len(worse) ** 0.5 if len(worse) > 1 else 0.0
    means = {k: float(v.mean()) for k, v in losses.items()}
    if float(worse.mean()) > 2 * standard_error and float(worse.mean()) > 0.02 * means["hull"]:
        return GeometryChoice("hull", empty, "the union of pieces explains held-out tosses worse than its hull", means)
    return GeometryChoice(
        "nonconvex", empty, f"the mesh leaves {100 * empty:.0f} % of its hull empty, and contact does not object", means
    )
