"""The plane that resting tosses lie on: what a camera saw of the object touches it.

Where every toss rests as far above or below the calibrated plane, most likely that is off, or the size of the shape;
contact is the same on a plane that is moved to them. Where tosses differ, their poses are wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from processing.contact.learn.convexity import start_points
from processing.contact.learn.data_checks import PLANE_TOLERANCE_M, check_frames, check_plane, lowest_point_m, say_alike
from processing.contact.learn.prior import Prior
from processing.contact.physics.inertia import Physics
from processing.contact.physics.plane import Plane
from processing.contact.physics.support import surface_samples
from processing.motion.phases import find_phases
from processing.motion.trajectory import PoseSeries
from recordings.errors import BadInput
from recordings.notices import Notice
from recordings.tracks import ObjectShape

SUNK_SHARE = 0.01
"""So much of the surface must lie below the plane before the shape counts as sunk into it; less is spikes."""
SURFACE_POINTS = 4000
MOST_OFF_M = 0.03
"""By more than this no calibration is off: another table was meant ..."""
MOST_OFF_BY_ONE_M = 0.01
"""... and where one toss alone says so, by more than this its pose at rest is more likely wrong: cameras are placed to
0 to 8 mm in labs."""


def plane_of_rests(
    series: Sequence[PoseSeries], shape: ObjectShape, prior: Prior, physics: Physics, plane: Plane
) -> tuple[Plane, Notice | None]:
    """The plane, moved to where the tosses rest (`moved_to`), and what to say where it was.

    `prior`: the hull of the shape, by whose points it touches."""
    return moved_to(_rest_heights_m(series, shape, prior, physics, plane), plane)


def moved_to(heights_m: Mapping[int, float], plane: Plane) -> tuple[Plane, Notice | None]:
    """The plane moved along its normal by as much as all tosses say (by toss, how high above it what a camera saw
    rests), and what to say of that.

    Its standard deviation is then what it was off by: the shape lies on it by construction, so that touches say nothing
    of the shape's size. Raises BadInput where objects rest more than 5 mm off it and tosses differ, or it is more than
    3 cm (1 cm where there is one toss)."""
    height_m = float(np.median(list(heights_m.values()))) if heights_m else 0.0
    alone = len(heights_m) == 1
    most_m = MOST_OFF_BY_ONE_M if alone else MOST_OFF_M if say_alike(heights_m) else PLANE_TOLERANCE_M
    if not PLANE_TOLERANCE_M < abs(height_m) <= most_m:
        check_plane(heights_m, "vision's shape (a part that a camera saw)")
        return plane, None
    who, side = "one toss rests" if alone else "all tosses rest", "above" if height_m > 0 else "below"
    each = ", ".join(f"toss {t}: {1e3 * h:.1f} mm" for t, h in heights_m.items())
    seen = (
        f"{who} {1e3 * abs(height_m):.1f} mm {side} the table as it was calibrated ({each}): contact was learned on a "
        "plane there"
    )
    do = "most likely something lies on the table (a mat), or it is calibrated too low: " if height_m > 0 else ""
    do += "`toss-calibrate table SESSION`, or `--table-from-depth`; less likely the shape is too large or too small"
    do += ", or the pose at rest is off" if alone else ""
    moved = replace(
        plane,
        offset_m=plane.offset_m + height_m,
        std_m=abs(height_m),
        source=f"where tosses rest, {1e3 * abs(height_m):.1f} mm {side} {plane.source}",
    )
    return moved, Notice("contact", "high", seen, do, "possible" if alone else "likely")


def _rest_heights_m(
    series: Sequence[PoseSeries], shape: ObjectShape, prior: Prior, physics: Physics, plane: Plane
) -> Mapping[int, float]:
    """By toss, how high above the plane what touches it rests: the lowest point, if a camera saw it. What no camera saw
    proves nothing, and neither does a spike that reaches below the plane."""
    local = prior.frame.inside(shape.vertices_m)
    points, surface = start_points(prior), surface_samples(local, shape.faces, SURFACE_POINTS)
    seen = np.ones(len(points), dtype=bool)
    if shape.observed is not None:
        seen = shape.observed[cKDTree(local).query(points)[1]]
    inertia, level_from_world = prior.frame.inertia(physics.inertia_kgm2), plane.level_from_world()
    heights = {}
    for toss in series:
        try:
            check_frames(toss)
        except BadInput:  # left out and named where it is learned from
            continue
        track = prior.frame.of(toss).turned(level_from_world, plane.offset_m)
        phases = find_phases(track, inertia)
        if phases.rest is None:
            continue
        reach = track.rotation[phases.rest :, 2].mean(0) @ points.T
        if seen[reach.argmin()]:
            lowest = lowest_point_m(track, points, phases) or 0.0
            sunk = lowest_point_m(track, surface, phases, SUNK_SHARE) or 0.0
            heights[toss.toss] = lowest if lowest > 0 else max(lowest, min(sunk, 0.0))
    return heights
