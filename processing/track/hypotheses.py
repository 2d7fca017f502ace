"""Stories of a toss: all its poses after joint refinement, how badly they fit, and which of several to believe."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion.motion_prior import MotionConfig, change_cost, turn_between
from processing.track.appearance_ratio import EvidenceConfig, evidence
from processing.track.beam import LEAST_DELAY_S, Hypothesis, Scene
from processing.track.center_of_mass import center_of_mass
from processing.track.depth_color_offset import put_at_color_times
from processing.track.flags import per_view
from processing.track.joint_refinement import GraphConfig, Motion, Refined, is_held, refine, round_views, steady_motion
from processing.track.revolution.axis import Axis, open_axis
from processing.track.revolution.azimuth import TurnConfig, Turned, contradiction, doubted, given_turns, turned
from processing.track.revolution.profile import BodyConfig, RoundBody, anchored, is_round


@dataclass(frozen=True)
class StoryConfig:
    """How stories are refined and compared."""

    graph: GraphConfig = field(default_factory=GraphConfig)
    steady: GraphConfig = field(default_factory=steady_motion)
    """Refinement that trusts steady motion more than what the images say."""
    agreeing_deg: float = 4.0
    """Two stories of the same frames that differ by less are one."""
    evidence: EvidenceConfig = field(default_factory=EvidenceConfig)
    nat: float = 0.0015
    """Badness that one nat of evidence by looks is worth."""
    impacts: float = 0.1
    """Share of the frames in which stories may differ without leaving a turn open: blurred ones at impacts."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    turns: TurnConfig = field(default_factory=TurnConfig)
    round_body: GraphConfig = field(default_factory=round_views)
    """Refinement of a round body, whose turn stays as it was found."""
    body: BodyConfig = field(default_factory=BodyConfig)
    round_badness: float = 2.0
    """A body whose views fit so many times worse on one profile is not round: a blurred box (2.9) may look so, mugs fit
    0.9 to 1.6 times as badly."""


@dataclass(frozen=True, eq=False)
class Story:
    """One story after joint refinement. `badness`: mean cost of the views and of the changes of motion; `turned`: how
    a round body's turn about its axis was found."""

    told: Hypothesis
    use: Bool[Array, " n"]
    fixed: Bool[Array, " v"]
    joint: Refined
    center_m: Float[Array, "3"]
    motion: Motion
    badness: float
    held: Int[Array, " n"]
    """Frames with the same number are a run through which a robot's hand carries the body; -1: none does."""
    turned: Turned | None = None
    axis: Axis | None = None
    """Of a round body, all of whose views were laid onto one profile."""
    against: float = 0.0
    """What the looks say against it, beside the story that fits best, in units of badness."""

    @property
    def total(self) -> float:
        return self.badness + self.against


def settled(scene: Scene, stories: list[Hypothesis], first: int, keep_first: bool, config: StoryConfig) -> list[Story]:
    """The stories after joint refinement, best first. Where they agree the first will do, unless the body is round and
    all its frames together say another turn about its axis. Where they do not agree, the images leave some turn open,
    and a refinement that trusts steady motion first is tried too."""
    n = len(scene.times_s)
    apart = max((apart_deg(stories[0].poses[:n], s.poses[:n]) for s in stories[1:]), default=0.0)
    agree = apart < config.agreeing_deg
    out = [refined(scene, s, first, keep_first, config) for s in (stories[:1] if agree else stories)]
    out.sort(key=lambda s: s.badness)
    sought = _sought(scene, out, first, keep_first, config) if len(stories) > 1 else None
    if sought is not None and sought.badness < config.round_badness * out[0].badness:
        return _again([sought], scene, first, keep_first, replace(config, graph=config.round_body))
    out = _heard(scene, out, config)
    if not agree and any(_leave_open(out[0].joint.poses[:n], s.joint.poses[:n], config) for s in out[1:]):
        steady = replace(config, graph=config.steady)
        smooth = refined(scene, replace(out[0].told, poses=out[0].joint.poses), first, keep_first, steady)
        out.append(refined(scene, replace(smooth.told, poses=smooth.joint.poses), first, keep_first, config))
    best, *others = _again(_heard(scene, out, config), scene, first, keep_first, config)
    return [_on_shape(scene, best, first, config) if len(scene.store) > n else best, *others]


def _on_shape(scene: Scene, story: Story, first: int, config: StoryConfig) -> Story:
    """A round body's story on a learned shape: its views hold the turns, but the poses that it was learned from may
    have been wrong, so that the doubt is that which the frames themselves leave."""
    poses = story.joint.poses[: len(scene.times_s)]
    axis = open_axis(scene, poses, story.use, config.turns.axis)
    if axis is None or not is_round(scene.store, poses, story.use, axis, config.body):
        return story
    given = given_turns(scene, poses, story.use, axis, config.turns)
    said = _contradiction(scene, story, given, config)
    return replace(story, turned=doubted(given, said, first, config.turns))


def _heard(scene: Scene, stories: list[Story], config: StoryConfig) -> list[Story]:
    """Best first, what the looks say of each against the one that fits best added to how badly it fits."""
    n, best = len(scene.times_s), min(stories, key=lambda s: s.badness)
    out = [replace(best, against=0.0)]
    for s in (s for s in stories if s is not best):
        nats = evidence(scene, best.joint.poses[:n], s.joint.poses[:n], best.use & s.use, config.evidence)
        out.append(replace(s, against=config.nat * nats))
    return sorted(out, key=lambda s: s.total)


def _sought(scene: Scene, stories: list[Story], first: int, keep_first: bool, config: StoryConfig) -> Story | None:
    """A round body's story with the turns that all frames together say; None where the body is not round."""
    n, best = len(scene.times_s), stories[0]
    axis = open_axis(scene, best.joint.poses[:n], best.use, config.turns.axis)
    if axis is None or len(scene.store) > n:
        return None
    if not is_round(scene.store, best.joint.poses[:n], best.use, axis, config.body):
        return None
    easy = replace(config, graph=config.round_body)
    straight = refined(scene, replace(best.told, poses=best.joint.poses), first, keep_first, easy, axis, held=True)
    assert straight.axis is not None
    rivals = [s.joint.poses[:n] for s in stories[1:]]
    found = turned(scene, straight.joint.poses[:n], rivals, straight.use, first, straight.axis, config.turns)
    if len(stories) == 1 and apart_deg(straight.joint.poses[:n], found.poses) < config.agreeing_deg:
        return refined(scene, replace(best.told, poses=straight.joint.poses), first, keep_first, config, straight.axis)
    told = replace(best.told, poses=found.poses)
    kept = refined(scene, told, first, keep_first, easy, found.axis, held=True)
    said = _contradiction(scene, kept, found, config)
    if len(stories) == 1 and _contradiction(scene, straight, found, config) < said:
        return refined(scene, replace(best.told, poses=straight.joint.poses), first, keep_first, config, straight.axis)
    return replace(kept, turned=doubted(replace(found, axis=kept.axis or axis), said, first, config.turns))


def _contradiction(scene: Scene, story: Story, found: Turned, config: StoryConfig) -> float:
    own = found if story.axis is None else replace(found, axis=story.axis)
    return contradiction(scene, story.joint.poses[: len(scene.times_s)], story.use, own, config.turns)


def _again(stories: list[Story], scene: Scene, first: int, keep_first: bool, config: StoryConfig) -> list[Story]:
    """The best story once more, finely, where depth and colour differ in time: its motion is known better now."""
    if not _delayed(scene):
        return stories
    best = replace(stories[0].told, poses=stories[0].joint.poses)
    found = stories[0].turned
    axis = stories[0].axis
    fine = replace(config, graph=replace(config.graph, schedule=config.graph.schedule[-1:]))
    again = refined(scene, best, first, keep_first, fine, axis, held=found is not None)
    return [replace(again, turned=found, against=stories[0].against), *stories[1:]]


def _delayed(scene: Scene) -> bool:
    return any(c is not None and abs(c.depth_delay_s) > LEAST_DELAY_S for c in scene.store.crops)


def _leave_open(one: Float[Array, "n 4 4"], other: Float[Array, "n 4 4"], config: StoryConfig) -> bool:
    """Whether two stories differ in more frames than an impact blurs: then the images leave a turn open."""
    turns = _turns_deg(one, other)
    return bool(np.mean(turns > config.agreeing_deg) > config.impacts) if len(turns) else False


def _turns_deg(one: Float[Array, "n 4 4"], other: Float[Array, "n 4 4"]) -> Float[Array, " m"]:
    """Turn between two stories' poses of each frame that both have."""
    both = np.flatnonzero(np.isfinite(one[:, 0, 0]) & np.isfinite(other[:, 0, 0]))
    return np.degrees([float(np.linalg.norm(turn_between(one[i], other[i]))) for i in both])


def apart_deg(one: Float[Array, "n 4 4"], other: Float[Array, "n 4 4"]) -> float:
    """Largest turn between two stories' poses of a frame."""
    return float(max(_turns_deg(one, other), default=0.0))


def refined(
    scene: Scene, best: Hypothesis, first: int, keep_first: bool, config: StoryConfig, axis: Axis | None = None,
    held: bool = False,
) -> Story:  # fmt: skip
    """Joint refinement of all tracked views, depth moved to colour's exposure by the story's own motion; of a round
    body, where its `axis` is given, with its profile, and turns about it stay where they are `held`."""
    n, all_views = len(scene.times_s), len(scene.store)
    use = np.isfinite(best.poses[:n, 0, 0])
    fixed = np.arange(all_views) >= n
    fixed[first] = keep_first
    poses = best.poses
    still = np.array([0 < i < n and use[i] and use[i - 1] and scene.store.stands_still(i - 1, i)
                      for i in range(all_views)])  # fmt: skip
    whose = np.maximum(np.arange(all_views) - n + 1, 0)  # a model's views follow each other in no time
    times_s = np.concatenate([scene.times_s, np.zeros(all_views - n)])
    drawn = np.array([scene.store.usable(i) for i in range(n, all_views)], dtype=bool)
    if _delayed(scene):
        use = use & put_at_color_times(scene, poses[:n], use)
    center_m = center_of_mass(poses[:n], use, scene)
    motion = Motion(times_s, whose, scene.gravity_camera_m_s2, center_m, still, _carried(scene, use))
    seen = np.concatenate([use, drawn])
    if axis is None:
        joint = refine(scene.store, poses, seen, fixed, motion, config.graph)
    else:
        body = RoundBody(scene.store, poses, use, axis, config.body)
        twist = axis.twist if held else None
        joint = refine(scene.store, poses, seen, np.zeros_like(fixed), motion, config.graph, twist, beside=(body,))
        moved, spread, axis = anchored(joint.poses, joint.covariance, axis, first, poses[first])
        joint = replace(joint, poses=moved, covariance=spread)
    fit = np.nanmean(per_view(joint.pairs, joint.figures, all_views)[0][:n]) if len(joint.pairs) else 0.0
    price = mean_price(joint.poses[:n], use, scene, center_m, config.motion)
    runs = _held(joint.poses, use, motion, config.graph)
    return Story(best, use, fixed, joint, center_m, motion, float(fit + price), runs, axis=axis)


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


def mean_price(
    poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], scene: Scene, center_m: Float[Array, "3"],
    config: MotionConfig,
) -> float:  # fmt: skip
    """Mean over the used frames of what the changes of motion cost."""
    index, t = np.flatnonzero(use), scene.times_s
    prices = [
        change_cost(
            (poses[a], poses[b], poses[c]), (t[b] - t[a], t[c] - t[b]), center_m, scene.gravity_camera_m_s2, config
        )
        for a, b, c in zip(index, index[1:], index[2:])
    ]
    return float(np.sum(prices) / max(len(index), 1))
