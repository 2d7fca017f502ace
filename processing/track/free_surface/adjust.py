"""Bundle adjustment of all tosses' poses with the surface free: what each toss's frames show of it is what all show.

Toss by toss (block coordinate descent), the others' poses held, their views telling the surface's offsets: the work
grows with the tosses, not with their square or cube.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from scipy.linalg import cho_factor, cho_solve

from processing.sensor.noise import ADJUST_PAIRS_PER_MEASUREMENT
from processing.track.beam import Scene
from processing.track.depth_color_offset import put_at_color_times
from processing.track.flags import per_view
from processing.track.free_surface.surface import FreeSurface
from processing.track.free_surface.terms import SurfaceMeasurements, SurfaceTerms
from processing.track.hypotheses import HypothesisConfig, motion_of
from processing.track.joint_refinement import refine
from recordings.progress import Progress
from recordings.tracks import ObjectShape


@dataclass(frozen=True, eq=False)
class PosedToss:
    """One toss's views, and its poses (camera_from_object, 4x4; NaN where unknown) in the frame of the shape."""

    scene: Scene
    poses: Float[Array, "n 4 4"]


@dataclass(frozen=True, eq=False)
class AdjustedToss:
    """Poses after the adjustment, their covariances (twist of the object frame, translation first) with the surface's
    own doubt in them, and how badly each view fits its neighbours (NaN where it took no part: it is as it was)."""

    poses: Float[Array, "n 4 4"]
    covariance: Float[Array, "n 6 6"]
    cost: Float[Array, " n"]


def adjusted(
    tosses: Sequence[PosedToss], shape: ObjectShape, config: HypothesisConfig, progress: Progress
) -> list[AdjustedToss]:
    """Tosses after they were refined with what all of them show of the shape's surface. Frames without a pose, or that
    show too little, stay as they are."""
    surface = FreeSurface(shape, tosses[0].scene.store.rectified.camera)
    poses, used = [t.poses.copy() for t in tosses], [_used(t) for t in tosses]
    measured = [SurfaceMeasurements(surface, t.scene.store, config.depth_noise) for t in tosses]
    said = [_said(*each) for each in zip(measured, poses, used)]
    square, gradient = np.sum(said, axis=0)
    offsets_m = -cho_solve(cho_factor(surface.prior + np.diag(square)), gradient)
    for each, there, use in zip(measured, poses, used):
        each.learn({int(i): each.of(int(i), there[i])[0] for i in np.flatnonzero(use)}, offsets_m)
    said = [_said(*each) for each in zip(measured, poses, used)]
    graph = replace(config.graph, schedule=config.finest, depth_errors=config.depth_noise,
                    shared_noise=ADJUST_PAIRS_PER_MEASUREMENT)  # fmt: skip
    after = []
    for t, toss in enumerate(tosses):
        spread, cost = np.full((len(poses[t]), 6, 6), np.nan), np.full(len(poses[t]), np.nan)
        if used[t].any():
            others = np.sum(said, axis=0) - said[t]
            terms = SurfaceTerms(measured[t], np.flatnonzero(used[t]), others)
            motion = motion_of(toss.scene, poses[t], used[t])
            none = np.zeros(len(used[t]), dtype=bool)
            joint = refine(toss.scene.store, poses[t], used[t], none, motion, graph, priors=(terms,))
            poses[t], spread[used[t]] = joint.poses, joint.covariance[used[t]]
            cost[used[t]] = per_view(joint.pairs, joint.figures, len(cost))[0][used[t]]
            said[t] = _said(measured[t], poses[t], used[t])
        after.append(AdjustedToss(poses[t], spread, cost))
        progress.step(t + 1, len(tosses), "tosses")
    return after


def _used(toss: PosedToss) -> Bool[Array, " n"]:
    """Frames that take part, their depth moved to colour's exposure."""
    scene = toss.scene
    use = np.isfinite(toss.poses[:, 0, 0]) & np.array([scene.store.usable(i) for i in range(len(toss.poses))])
    return use & put_at_color_times(scene, toss.poses, use)


def _said(
    measured: SurfaceMeasurements, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"]
) -> Float[Array, "2 k"]:  # fmt: skip
    """What a toss's views at their poses say of the offsets (`Residuals.of_offsets`)."""
    said = np.zeros((2, measured.surface.count))
    for i in np.flatnonzero(use):
        for residuals in measured.of(int(i), poses[i]):
            said += residuals.of_offsets(len(said[0]))
    return said
