"""Trajectory hypotheses of a toss: all its poses after joint refinement, what they cost, and which of several is
selected."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion.interpolate import turn_between
from processing.motion.motion_prior import MotionConfig, change_cost
from processing.sensor.noise import PUBLISHED, DepthNoise
from processing.track.appearance_ratio import AppearanceRatioConfig, log_likelihood_ratio
from processing.track.beam import LEAST_DELAY_S, Hypothesis, Scene
from processing.track.center_of_mass import center_of_mass
from processing.track.depth_color_offset import put_at_color_times
from processing.track.flags import per_view
from processing.track.joint_refinement import (
    GraphConfig,
    Motion,
    Refined,
    choose_pairs,
    is_held,
    refine,
    round_views,
    steady_motion,
)
from processing.track.pairs import KnownFigures
from processing.track.revolution.axis import Axis, angles_between, open_axes
from processing.track.revolution.azimuth import (
    AzimuthConfig,
    Azimuths,
    estimate_azimuths,
    given_azimuths,
    inconsistency,
    with_uncertainty,
)
from processing.track.revolution.profile import BodyConfig, RoundBody, anchored, is_round, laid_on_profile
from processing.track.schedule import Schedule, rows


@dataclass(frozen=True)
class HypothesisConfig:
    """How trajectory hypotheses are refined, compared and selected."""

    graph: GraphConfig = field(default_factory=GraphConfig)
    depth_noise: DepthNoise = PUBLISHED
    """How depth errs: solved for with the poses in the last refinement of the best hypothesis ..."""
    finest: Schedule = ((0, 12, 0.0035, 0.08, 0.012, 1.0),)
    """... with these scales. Outlines of masks are off by 1.3 to 3 px (means of tosses of `choose`): .004 m at 0.8 m
    are 2.4 px of a camera of 480 px focal length; three times as much, because some ten points along an outline err as
    one (a piece in the scene's colours that is missing turns a body). Refined from the true poses, twelve tosses of six
    `choose` sessions end 4.4, 3.9, 3.5 and 3.1 degrees off (means) at .004, .008, .012 and .02."""
    steady: GraphConfig = field(default_factory=steady_motion)
    """Refinement that trusts steady motion more than what the images show."""
    agreeing_deg: float = 4.0
    """Two hypotheses of the same frames that differ by less are one."""
    appearance: AppearanceRatioConfig = field(default_factory=AppearanceRatioConfig)
    nat: float = 0.0015
    """Cost (no unit) that one nat of the appearance likelihood ratio is worth."""
    impacts: float = 0.1
    """Share of the frames in which hypotheses may differ without leaving a rotation open: blurred ones at impacts."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    azimuth: AzimuthConfig = field(default_factory=AzimuthConfig)
    round_body: GraphConfig = field(default_factory=round_views)
    """Refinement of a round body, whose azimuth stays as it was found."""
    body: BodyConfig = field(default_factory=BodyConfig)
    round_cost: float = 2.0
    """A body whose views fit so many times worse on one profile is not round: a blurred box (2.9) may look so, mugs fit
    0.9 to 1.6 times as badly."""
    round_nats: float = 5.0
    """Nor is one whose appearance speaks so much for the azimuths of free views (log likelihood ratio); both count
    together."""


@dataclass(frozen=True, eq=False)
class TrajectoryHypothesis:
    """One hypothesis after joint refinement, from the `estimated` one. `cost`: mean cost of the views and of the
    changes of motion; `azimuths`: those of a round body about its axis, as they were found."""

    estimated: Hypothesis
    use: Bool[Array, " n"]
    fixed: Bool[Array, " v"]
    joint: Refined
    center_m: Float[Array, "3"]
    motion: Motion
    cost: float
    held: Int[Array, " n"]
    """Frames with the same number are a run through which a robot's hand carries the body; -1: none does."""
    azimuths: Azimuths | None = None
    axis: Axis | None = None
    """Of a round body, all of whose views were laid onto one profile."""
    against: float = 0.0
    """Cost of its appearance against the hypothesis that fits best (log likelihood ratio times `nat`)."""

    @property
    def total(self) -> float:
        return self.cost + self.against


def all_refined(
    scene: Scene, hypotheses: list[Hypothesis], first: int, keep_first: bool, config: HypothesisConfig
) -> list[TrajectoryHypothesis]:
    """The hypotheses after joint refinement, the cheapest first. Where they agree the first will do."""
    n = len(scene.times_s)
    apart = max((apart_deg(hypotheses[0].poses[:n], s.poses[:n]) for s in hypotheses[1:]), default=0.0)
    different = hypotheses[:1] if apart < config.agreeing_deg else hypotheses
    return sorted((refined(scene, s, first, keep_first, config) for s in different), key=lambda s: s.cost)


def select(
    scene: Scene, hypotheses: list[TrajectoryHypothesis], first: int, keep_first: bool, tracked: bool,
    config: HypothesisConfig,
) -> list[TrajectoryHypothesis]:  # fmt: skip
    """The hypotheses, best first. If the body is round and all its frames together show other azimuths (which is looked
    into where the poses were `tracked`, not given), these. Where hypotheses leave a rotation open, a refinement that
    trusts steady motion first is tried too."""
    out = sorted(hypotheses, key=lambda s: s.cost)
    sought = _sought(scene, out, first, keep_first, config) if tracked else None
    if sought is not None and _is_rather_round(scene, sought, out[0], config):
        return _again([sought], scene, first, keep_first, replace(config, graph=config.round_body))
    out = _compared(scene, out, config)
    n = len(scene.times_s)
    if any(leave_open(out[0].joint.poses[:n], s.joint.poses[:n], config) for s in out[1:]):
        steady = replace(config, graph=config.steady)
        smooth = refined(scene, replace(out[0].estimated, poses=out[0].joint.poses), first, keep_first, steady)
        out.append(refined(scene, replace(smooth.estimated, poses=smooth.joint.poses), first, keep_first, config))
    best, *others = _again(_compared(scene, out, config), scene, first, keep_first, config)
    return [_unsure_of_azimuths(scene, best, first, config), *others]


def _unsure_of_azimuths(
    scene: Scene, hypothesis: TrajectoryHypothesis, first: int, config: HypothesisConfig
) -> TrajectoryHypothesis:
    """A hypothesis of free views, or on a learned shape, of a body that looks round: its views hold the azimuths, but
    wherever they came to lie (what repeats about the axis fits at many, and the shape was learned from such poses), so
    that the uncertainty is that which all frames together leave."""
    poses = hypothesis.joint.poses[: len(scene.times_s)]
    return replace(hypothesis, azimuths=open_azimuths(scene, poses, hypothesis.use, first, config))


def open_azimuths(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], first: int, config: HypothesisConfig
) -> Azimuths | None:
    """The azimuths of views of a body that looks round, as their poses have them, and what all of them leave open, from
    the first one on. None where it does not."""
    axis = _round_axis(scene, poses, use, config)
    if axis is None:
        return None
    given = given_azimuths(scene, poses, use, axis, config.azimuth)
    return with_uncertainty(given, inconsistency(scene, poses, use, given, config.azimuth), first, config.azimuth)


def with_azimuths_sought(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], config: HypothesisConfig
) -> tuple[Float[Array, "n 4 4"], Axis | None]:
    """The poses of views of a body that looks round with the azimuths that fit all of them together (most views stay),
    and its axis. As they are, and None, where it does not look round."""
    axis = _round_axis(scene, poses, use, config) if use.any() else None
    if axis is None:
        return poses, None
    found = estimate_azimuths(scene, poses, [], use, int(use.argmax()), axis, config.azimuth)
    turn = angles_between(found.poses[use], poses[use], axis)
    most = turn[np.abs(np.sin(0.5 * (turn[:, None] - turn))).sum(1).argmin()]
    out = poses.copy()
    out[use] = found.poses[use] @ axis.rotation(float(most))
    return out, axis


def _round_axis(
    scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], config: HypothesisConfig
) -> Axis | None:
    """The axis about which views look round; None where they do not."""
    lines = open_axes(scene, poses, use, config.azimuth.axis)
    laid = [laid_on_profile(scene.store, poses, use, line, config.body) for line in lines]
    if not laid:
        return None
    axis, _ = max(laid, key=lambda found: found[1])
    return axis if is_round(scene.store, poses, use, axis, config.body) else None


def _is_rather_round(
    scene: Scene, sought: TrajectoryHypothesis, free: TrajectoryHypothesis, config: HypothesisConfig
) -> bool:
    """Whether a round body explains the views about as well as free ones do: its one profile leaves it less freedom,
    its azimuths must not contradict what is printed on it."""
    if sought.cost >= config.round_cost * free.cost:
        return False
    n, ratio = len(scene.times_s), max(sought.cost, 1e-9) / free.cost
    worse = float(np.log(ratio) / np.log(config.round_cost))
    nats = log_likelihood_ratio(
        scene, free.joint.poses[:n], sought.joint.poses[:n], free.use & sought.use, config.appearance
    )
    return bool(worse + nats / config.round_nats < 1.0)


def _compared(
    scene: Scene, hypotheses: list[TrajectoryHypothesis], config: HypothesisConfig
) -> list[TrajectoryHypothesis]:
    """Best first, the appearance likelihood ratio of each against the one that fits best added to its cost."""
    n, best = len(scene.times_s), min(hypotheses, key=lambda s: s.cost)
    out = [replace(best, against=0.0)]
    for s in (s for s in hypotheses if s is not best):
        nats = log_likelihood_ratio(scene, best.joint.poses[:n], s.joint.poses[:n], best.use & s.use, config.appearance)
        out.append(replace(s, against=config.nat * nats))
    return sorted(out, key=lambda s: s.total)


def _sought(
    scene: Scene, hypotheses: list[TrajectoryHypothesis], first: int, keep_first: bool, config: HypothesisConfig
) -> TrajectoryHypothesis | None:
    """A round body's hypothesis with the azimuths that fit all frames together; None where the body is not round."""
    n, best = len(scene.times_s), hypotheses[0]
    axis = None if len(scene.store) > n else _round_axis(scene, best.joint.poses[:n], best.use, config)
    if axis is None:
        return None
    easy = replace(config, graph=config.round_body)
    straight = refined(scene, replace(best.estimated, poses=best.joint.poses), first, keep_first, easy, axis, held=True)
    assert straight.axis is not None
    rivals = [s.joint.poses[:n] for s in hypotheses[1:]]
    found = estimate_azimuths(
        scene, straight.joint.poses[:n], rivals, straight.use, first, straight.axis, config.azimuth
    )
    if len(hypotheses) == 1 and apart_deg(straight.joint.poses[:n], found.poses) < config.agreeing_deg:
        return refined(
            scene, replace(best.estimated, poses=straight.joint.poses), first, keep_first, config, straight.axis
        )
    estimated = replace(best.estimated, poses=found.poses)
    kept = refined(scene, estimated, first, keep_first, easy, found.axis, held=True)
    disagreement = _inconsistency(scene, kept, found, config)
    if len(hypotheses) == 1 and _inconsistency(scene, straight, found, config) < disagreement:
        return refined(
            scene, replace(best.estimated, poses=straight.joint.poses), first, keep_first, config, straight.axis
        )
    return replace(
        kept, azimuths=with_uncertainty(replace(found, axis=kept.axis or axis), disagreement, first, config.azimuth)
    )


def _inconsistency(scene: Scene, hypothesis: TrajectoryHypothesis, found: Azimuths, config: HypothesisConfig) -> float:
    own = found if hypothesis.axis is None else replace(found, axis=hypothesis.axis)
    return inconsistency(scene, hypothesis.joint.poses[: len(scene.times_s)], hypothesis.use, own, config.azimuth)


def _again(
    hypotheses: list[TrajectoryHypothesis], scene: Scene, first: int, keep_first: bool, config: HypothesisConfig
) -> list[TrajectoryHypothesis]:
    """The best hypothesis once more, finely: its motion is known better now, by which depth moves to colour's time;
    and the errors of depth are solved for with the poses, but of a round body, whose profile holds these."""
    best = replace(hypotheses[0].estimated, poses=hypotheses[0].joint.poses)
    found, axis = hypotheses[0].azimuths, hypotheses[0].axis
    if found is None and axis is None:
        graph = replace(config.graph, schedule=config.finest, depth_errors=config.depth_noise)
    elif _delayed(scene):
        graph = replace(config.graph, schedule=config.graph.schedule[-1:])
    else:
        return hypotheses
    fine = replace(config, graph=graph)
    again = refined(scene, best, first, keep_first, fine, axis, held=found is not None)
    return [replace(again, azimuths=found, against=hypotheses[0].against), *hypotheses[1:]]


def _delayed(scene: Scene) -> bool:
    return any(c is not None and abs(c.depth_delay_s) > LEAST_DELAY_S for c in scene.store.crops)


def leave_open(one: Float[Array, "n 4 4"], other: Float[Array, "n 4 4"], config: HypothesisConfig) -> bool:
    """Whether two hypotheses differ in more frames than an impact blurs: then the images leave a rotation open."""
    rotations = _rotations_deg(one, other)
    return bool(np.mean(rotations > config.agreeing_deg) > config.impacts) if len(rotations) else False


def _rotations_deg(one: Float[Array, "n 4 4"], other: Float[Array, "n 4 4"]) -> Float[Array, " m"]:
    """Rotation between two hypotheses' poses of each frame that both have."""
    both = np.flatnonzero(np.isfinite(one[:, 0, 0]) & np.isfinite(other[:, 0, 0]))
    return np.degrees([float(np.linalg.norm(turn_between(one[i], other[i]))) for i in both])


def apart_deg(one: Float[Array, "n 4 4"], other: Float[Array, "n 4 4"]) -> float:
    """Largest rotation between two hypotheses' poses of a frame."""
    return float(max(_rotations_deg(one, other), default=0.0))


def anchored_to(hypothesis: Hypothesis, other: Hypothesis, first: int) -> Hypothesis:
    """The hypothesis in the object frame in which the first frame's pose is that of the other one."""
    if not np.isfinite(hypothesis.poses[first, 0, 0]):
        return hypothesis
    own_from_other = np.linalg.inv(hypothesis.poses[first]) @ other.poses[first]
    poses = hypothesis.poses @ own_from_other
    poses[first] = other.poses[first]
    return replace(hypothesis, poses=poses)


def refined(
    scene: Scene, best: Hypothesis, first: int, keep_first: bool, config: HypothesisConfig, axis: Axis | None = None,
    held: bool = False,
) -> TrajectoryHypothesis:  # fmt: skip
    """Joint refinement of all tracked views, depth moved to colour's exposure by the hypothesis's own motion; of a
    round body, where its `axis` is given, with its profile, and azimuths about it stay where they are `held`."""
    n, all_views = len(scene.times_s), len(scene.store)
    use = np.isfinite(best.poses[:n, 0, 0])
    fixed = np.arange(all_views) >= n
    fixed[first] = keep_first
    poses = best.poses
    drawn = np.array([scene.store.usable(i) for i in range(n, all_views)], dtype=bool)
    if _delayed(scene):
        use = use & put_at_color_times(scene, poses[:n], use)
    motion = motion_of(scene, poses, use)
    center_m = motion.center_m
    seen = np.concatenate([use, drawn])
    if axis is None:
        joint = refine(scene.store, poses, seen, fixed, motion, config.graph)
    else:
        body = RoundBody(scene.store, poses, use, axis, config.body)
        twist = axis.twist if held else None
        joint = refine(scene.store, poses, seen, np.zeros_like(fixed), motion, config.graph, twist, priors=(body,))
        moved, spread, axis = anchored(joint.poses, joint.covariance, axis, first, poses[first])
        joint = replace(joint, poses=moved, covariance=spread)
    fit = np.nanmean(per_view(joint.pairs, joint.figures, all_views)[0][:n]) if len(joint.pairs) else 0.0
    motion_cost = mean_motion_cost(joint.poses[:n], use, scene, center_m, config.motion)
    runs = _held(joint.poses, use, motion, config.graph)
    return TrajectoryHypothesis(best, use, fixed, joint, center_m, motion, float(fit + motion_cost), runs, axis=axis)


def motion_of(scene: Scene, poses: Float[Array, "v 4 4"], use: Bool[Array, " n"]) -> Motion:
    """What is known of how the body moves through the used frames; a model's views follow each other in no time."""
    n, all_views = len(scene.times_s), len(scene.store)
    still = np.array([0 < i < n and use[i] and use[i - 1] and scene.store.stands_still(i - 1, i)
                      for i in range(all_views)])  # fmt: skip
    whose = np.maximum(np.arange(all_views) - n + 1, 0)
    times_s = np.concatenate([scene.times_s, np.zeros(all_views - n)])
    center_m = center_of_mass(poses[:n], use, scene)
    return Motion(times_s, whose, scene.gravity_camera_m_s2, center_m, still, _carried(scene, use))


def own_cost(
    scene: Scene, hypothesis: TrajectoryHypothesis, config: HypothesisConfig, known: KnownFigures | None = None
) -> float:
    """What the frames' own pairs and their motion cost at the poses, as `cost` does, whatever else these rest on.
    `known`: figures of the scene's pairs so far."""
    n, use, poses = len(scene.times_s), hypothesis.use, hypothesis.joint.poses
    motion, store = hypothesis.motion, scene.store
    frames = np.concatenate([use, np.zeros(len(poses) - n, dtype=bool)])
    pairs = choose_pairs(poses, frames, motion.toss, hypothesis.center_m, motion.still, config.graph)
    fit = 0.0
    if len(pairs):
        distance_m = float(np.median(np.linalg.norm(store.center_m[:n][use], axis=1)))
        figures = (known or KnownFigures()).of(store, poses, pairs, rows(config.graph.schedule, distance_m)[-1])
        fit = float(np.nanmean(per_view(pairs, figures, len(poses))[0][:n]))
    return fit + mean_motion_cost(poses[:n], use, scene, hypothesis.center_m, config.motion)


def _carried(scene: Scene, use: Bool[Array, " n"]) -> dict[tuple[int, int], Float[Array, "4 4"]]:
    """How the robot's hand moves from each used frame to the next."""
    found = {(int(a), int(b)): scene.carried(int(a), int(b)) for a, b in pairwise(np.flatnonzero(use))}
    return {pair: moved for pair, moved in found.items() if moved is not None}


def _held(
    poses: Float[Array, "v 4 4"], use: Bool[Array, " n"], motion: Motion, config: GraphConfig
) -> Int[Array, " n"]:
    """Runs of frames through which the robot's hand carries the body, numbered; -1 elsewhere."""
    out = np.full(len(use), -1)
    for a, b in pairwise(map(int, np.flatnonzero(use))):
        if is_held(poses, a, b, motion, config):
            out[a] = out[b] = out[a] if out[a] >= 0 else out.max() + 1
    return out


def mean_motion_cost(
    poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], scene: Scene, center_m: Float[Array, "3"],
    config: MotionConfig,
) -> float:  # fmt: skip
    """Mean over the used frames of what the changes of motion cost."""
    index, t = np.flatnonzero(use), scene.times_s
    costs = [
        change_cost(
            (poses[a], poses[b], poses[c]),
            (t[b] - t[a], t[c] - t[b]),
            center_m,
            scene.gravity_camera_m_s2,
            config,
            flying=scene.free([int(a), int(b), int(c)]),
        )
        for a, b, c in zip(index, index[1:], index[2:])
    ]
    return float(np.sum(costs) / max(len(index), 1))
