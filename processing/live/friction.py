"""Friction and restitution from the tosses so far: forecasts of their tracks with the shape so far as it is.

The geometry is not learned here (the stage `contact` does that at the end); the law is the one that the pipeline finds
(`contact/friction/estimate.py`), with its intervals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from processing.contact.friction.estimate import (
    FRICTIONS,
    RESTITUTION_ASSUMED,
    Interval,
    friction_by_forecasts,
    observed_trajectories,
)
from processing.contact.friction.forecast import RigidBody
from processing.contact.learn.shape_comparison import series_of
from processing.contact.physics.inertia import uniform_physics
from processing.contact.physics.loss import REFERENCE_MASS_KG
from processing.contact.physics.plane import calibrated_plane
from processing.contact.physics.support import trimmed_hull
from processing.motion.smoother import Smoothed, smooth
from processing.motion.trajectory import PoseSeries
from recordings.geometry import Transform
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration

CONTACTS, POINTS = 6, 24
"""Points that may touch at once, and of the hull: a first look wants no more."""


@dataclass(frozen=True)
class LawSoFar:
    """Friction and restitution; `information` on friction by toss: the curvature of its score over log friction,
    nothing where it said nothing."""

    friction: Interval
    restitution: Interval
    information: Mapping[int, float]

    def text(self) -> str:
        """With 95 % intervals."""
        f, e = self.friction, self.restitution
        return (
            f"friction {f.value:.2f} ({f.low:.2f} to {f.high:.2f}), restitution {e.value:.2f} "
            f"({e.low:.2f} to {e.high:.2f}; {RESTITUTION_ASSUMED})"
        )


def law_so_far(
    tracks: Mapping[int, ObjectTrack], shape: ObjectShape, world_from_camera: Transform, calibration: RigCalibration
) -> LawSoFar | None:
    """From tracks in the shape's object frame; None where none of them hits the table."""
    body, series, smoothed = _prepared(tracks, shape, world_from_camera, calibration)
    hit = [s.toss for s, m in zip(series, smoothed) if observed_trajectories([s], [m])]
    found = friction_by_forecasts(body, series, smoothed)
    if found is None:
        return None
    bends = np.diff(found.scores, 2, axis=0)
    nearest = int(np.abs(np.log(FRICTIONS[1:-1] / found.friction.value)).argmin())
    bend = bends[max(nearest - 1, 0) : nearest + 2].mean(0)
    information = {t: max(float(b), 0.0) for t, b in zip(hit, bend)} if len(hit) == len(bend) else {}
    return LawSoFar(found.friction, found.restitution, information)


def _prepared(
    tracks: Mapping[int, ObjectTrack], shape: ObjectShape, world_from_camera: Transform, calibration: RigCalibration
) -> tuple[RigidBody, Sequence[PoseSeries], Sequence[Smoothed]]:
    """The body about its centre of mass, and the tracks of that point above the plane."""
    physics, plane = uniform_physics(shape), calibrated_plane(calibration)
    inertia = REFERENCE_MASS_KG / physics.mass_kg * physics.inertia_kgm2
    points = trimmed_hull(shape.vertices_m, shape.faces, POINTS) - physics.center_of_mass_m
    level = plane.level_from_world()
    about = [
        s.about(physics.center_of_mass_m).turned(level, plane.offset_m)
        for s in series_of(tracks, world_from_camera)
        if len(s) > 4
    ]
    return RigidBody(points, CONTACTS, inertia), about, [smooth(s, inertia) for s in about]


def shrink_by(law: LawSoFar, toss: int) -> float:
    """By what share friction's interval is expected to shrink with one more toss like this one (its part that tosses
    can take away: what the law itself does not know stays)."""
    total, more = sum(law.information.values()), law.information.get(toss, 0.0)
    return 1.0 - float(np.sqrt(total / (total + more))) if total > 0 else 0.0
