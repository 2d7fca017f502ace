"""Bundle adjustment of all tosses' poses with the surface free: what each toss's frames show of it is what all show.

In turns: the surface is moved to where the views say that it is and drawn at every pose; on it the colours of pairs of
views are compared, so that no view's colours lie on the errors of its own depth. Depth and outlines are compared with
the surface itself. Toss by toss (block coordinate descent), the others' poses held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.track.beam import Scene
from processing.track.depth_color_offset import put_at_color_times
from processing.track.flags import per_view
from processing.track.free_surface.appearance import AppearanceTerms
from processing.track.free_surface.drawn import DrawnViews
from processing.track.free_surface.surface import FreeSurface
from processing.track.free_surface.terms import SurfaceMeasurements, SurfaceTerms, said_by
from processing.track.hypotheses import HypothesisConfig, motion_of
from processing.track.joint_refinement import Motion, choose_pairs, refine
from processing.track.pairs import compared
from processing.track.revolution.axis import Axis
from processing.track.schedule import rows
from recordings.progress import Progress
from recordings.tracks import ObjectShape

APPEARANCE_SCALES = (0.16, 0.08, 0.04)
"""Of differences of colour, turn by turn. Without the first a toss of choose-034 stays 4.5 degrees off for 3.7."""


@dataclass(frozen=True, eq=False)
class PosedToss:
    """One toss's views, its poses (camera_from_object, 4x4; NaN where unknown) in the frame of the shape, and a round
    body's axis: its azimuths, which pairs of views would spoil, stay."""

    scene: Scene
    poses: Float[Array, "n 4 4"]
    axis: Axis | None = None


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
    used, after = [_used(t) for t in tosses], [_unchanged(t) for t in tosses]
    measured = [SurfaceMeasurements(surface, t.scene.store, config.depth_noise) for t in tosses]
    drawn = DrawnViews([t.scene.store for t in tosses])
    for turn, scale in enumerate(APPEARANCE_SCALES):
        _follow(surface, measured, after, used)
        for t, (toss, use) in enumerate(zip(after, used)):
            drawn.draw(t, surface, toss.poses, use)
        said = [said_by(m.of_all(a.poses, use), surface.count) for m, a, use in zip(measured, after, used)]
        for t in range(len(tosses)):
            if used[t].any():
                free, others = np.flatnonzero(used[t]), np.sum(said, axis=0) - said[t]
                terms = SurfaceTerms(measured[t], drawn.of_toss[t], free, others)
                after[t] = _refined(t, tosses, after, used, drawn, terms, scale, config)
                if t + 1 < len(tosses):  # for the others of this turn; before the next all are drawn
                    drawn.draw(t, surface, after[t].poses, used[t])
                    said[t] = said_by(measured[t].of_all(after[t].poses, used[t]), surface.count)
            progress.step(turn * len(tosses) + t + 1, len(APPEARANCE_SCALES) * len(tosses), "tosses")
    return after


def _unchanged(toss: PosedToss) -> AdjustedToss:
    n = len(toss.poses)
    return AdjustedToss(toss.poses.copy(), np.full((n, 6, 6), np.nan), np.full(n, np.nan))


def _follow(
    surface: FreeSurface, measured: Sequence[SurfaceMeasurements], tosses: Sequence[AdjustedToss],
    used: Sequence[Bool[Array, " n"]],
) -> None:  # fmt: skip
    """Moves the surface to where the views at their poses say that it is."""
    for _ in range(2):  # how far outlines err is told by what the surface leaves of them, and weighs them for it
        views = [each.of_all(toss.poses, use) for each, toss, use in zip(measured, tosses, used)]
        square, gradient = np.sum([said_by(residuals, surface.count) for residuals in views], axis=0)
        offsets_m = -surface.prior.with_more(square).solver()(gradient + surface.pull)
        for each, residuals in zip(measured, views):
            each.learn({i: outline for i, (outline, _) in residuals.items()}, offsets_m)
    surface.move(offsets_m)
    for each in measured:
        each.redraw()


def _refined(
    t: int, tosses: Sequence[PosedToss], now: Sequence[AdjustedToss], used: Sequence[Bool[Array, " n"]],
    drawn: DrawnViews, terms: SurfaceTerms, scale: float, config: HypothesisConfig,
) -> AdjustedToss:  # fmt: skip
    """Toss `t`, its views' colours compared with all tosses' at this scale."""
    poses, use, views = np.concatenate([toss.poses for toss in now]), np.concatenate(used), drawn.of_toss[t]
    fixed = np.ones(len(use), dtype=bool)
    fixed[views] = False
    motion = _together([motion_of(*each) for each in zip([x.scene for x in tosses], [x.poses for x in now], used)], t)
    pairs = choose_pairs(poses, use, motion.toss, motion.center_m, motion.still, config.graph)
    pairs = pairs[~fixed[pairs].all(axis=1) & np.isfinite(drawn.at[pairs]).all(axis=(1, 2, 3))]
    colors = AppearanceTerms(drawn, pairs, scale)
    graph = replace(config.graph, schedule=config.finest, neighbours=0, loops=0)
    axis = tosses[t].axis
    held = None if axis is None else axis.twist
    joint = refine(drawn.store, poses, use, fixed, motion, graph, held, priors=(terms, colors))
    poses, spread = joint.poses[views], np.full((len(used[t]), 6, 6), np.nan)
    spread[used[t]] = joint.covariance[views][used[t]]
    own = pairs[~fixed[pairs].any(axis=1)] - views.start
    return AdjustedToss(poses, spread, _costs(tosses[t].scene, poses, used[t], own, config))


def _together(each: Sequence[Motion], t: int) -> Motion:
    """The motion of all tosses' views, of which those of toss `t` are free."""
    lengths = [len(m.times_s) for m in each]
    first = sum(lengths[:t])
    return replace(
        each[t], times_s=np.concatenate([m.times_s for m in each]), toss=np.repeat(np.arange(len(each)), lengths),
        still=np.concatenate([m.still for m in each]),
        carried={(first + a, first + b): moved for (a, b), moved in each[t].carried.items()},
    )  # fmt: skip


def _costs(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], pairs: Int[Array, "m 2"],
    config: HypothesisConfig,
) -> Float[Array, " n"]:  # fmt: skip
    """How badly each view, with the depth that it saw, fits those that it was compared with."""
    (row,) = rows(config.finest, float(np.median(np.linalg.norm(scene.store.center_m[use], axis=1))))
    figures = compared(scene.store, poses, pairs, row, shaded=False)[2]
    return np.where(use, per_view(pairs, figures, len(use))[0], np.nan)


def _used(toss: PosedToss) -> Bool[Array, " n"]:
    """Frames that take part, their depth moved to colour's exposure."""
    scene = toss.scene
    use = np.isfinite(toss.poses[:, 0, 0]) & np.array([scene.store.usable(i) for i in range(len(toss.poses))])
    return use & put_at_color_times(scene, toss.poses, use)
