"""Trajectories made of two others' parts: of several hypotheses each is right somewhere, and none everywhere.

Up to some frame the poses are those of one hypothesis; from there on it turns and moves as another one does, so that
an error of either on its own side is left behind. The likeliest are refined jointly and may be crossed again: a
one-point crossover of which each child is refined locally (Holland, "Adaptation in Natural and Artificial Systems",
1975; Moscato, "On Evolution, Search, Optimization, Genetic Algorithms and Martial Arts", Caltech C3P 826, 1989). They
are judged by the same cost as all hypotheses: it is the search that is widened, nothing else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.track.beam import Hypothesis, Scene
from processing.track.flags import per_view
from processing.track.hypotheses import (
    HypothesisConfig,
    TrajectoryHypothesis,
    anchored_to,
    apart_deg,
    own_cost,
    refined,
)
from processing.track.pairs import KnownFigures

Cut = tuple[int, int, int]
"""Positions of two parents among all, and the last frame that is the first one's."""
NO_POSE = 1.0
"""Cost of a frame without a pose: the worst that a view can cost."""


@dataclass(frozen=True)
class CrossoverConfig:
    """How hypotheses are crossed."""

    rounds: int = 4
    """So often at most, and only as long as the best cost falls (0: never)."""
    parents: int = 10
    compared: int = 80
    """Children whose pairs of views are compared: those whose parents' frames cost least on their sides of the cut."""
    refined: int = 4
    """Children of a round that are refined: those whose pairs cost least."""
    alike_deg: float = 2.0
    """Where two parents turn alike from frame to frame one cut is enough."""


def crossed(
    scene: Scene, first: int, hypotheses: Sequence[TrajectoryHypothesis], config: CrossoverConfig,
    refinement: HypothesisConfig, report: Callable[[float], None] = lambda _: None,
) -> list[TrajectoryHypothesis]:  # fmt: skip
    """The cheapest refined child of the hypotheses (the best one first) and of their children, through the best one's
    pose of frame `first`; none where no child costs less than all of them. The views are a toss's frames alone, not a
    model's. `report` is told the share of the work that is done."""
    everyone, tried = list(hypotheses), set[Cut]()
    for done in range(config.rounds):
        report(done / config.rounds)
        parents = sorted(range(len(everyone)), key=lambda i: everyone[i].cost)[: config.parents]
        children = _children(scene, first, everyone, parents, tried, config, refinement)
        born = [refined(scene, child.estimated, first, True, refinement) for child in children]
        if min((h.cost for h in born), default=np.inf) >= everyone[parents[0]].cost:
            break
        everyone += born
    return sorted(everyone[len(hypotheses) :], key=lambda h: h.cost)[:1]


def crossed_at(
    one: TrajectoryHypothesis, other: TrajectoryHypothesis, cut: int, first: int, best: Hypothesis
) -> TrajectoryHypothesis:
    """One hypothesis up to and with frame `cut`, where both have a pose, and then as the other goes on from there; in
    the object frame of the `best` one by frame `first`, if it has that. Not refined."""
    after = np.arange(len(one.use)) > cut
    use, poses = np.where(after, other.use, one.use), one.joint.poses.copy()
    poses[after] = other.joint.poses[after] @ (np.linalg.inv(other.joint.poses[cut]) @ poses[cut])
    poses[~use] = np.nan
    estimated = anchored_to(replace(one.estimated, poses=poses), best, first)
    return replace(one, use=use, estimated=estimated, joint=replace(one.joint, poses=estimated.poses))


def cuts_between(
    one: TrajectoryHypothesis, other: TrajectoryHypothesis, config: CrossoverConfig, agreeing_deg: float
) -> Int[Array, " c"]:
    """Frames at which two hypotheses may be cut: both have a pose there, they differ before and after it, and not one
    frame more of a stretch in which they turn alike."""
    index = np.flatnonzero(one.use & other.use)
    if len(index) < 2:
        return index[:0]
    turned = [poses[index, :3, :3] for poses in (one.joint.poses, other.joint.poses)]
    step, its_step = (r[1:] @ r[:-1].transpose(0, 2, 1) for r in turned)
    cosine = (np.einsum("nij,nij->n", step, its_step) - 1) / 2
    apart_by = np.degrees(np.arccos(np.clip(cosine, -1, 1)))  # of the step after each frame
    differ = apart_by > agreeing_deg
    cut = np.arange(1, len(apart_by))  # after the step to it, before the step from it
    differs = np.cumsum(differ)
    both = (differs[cut - 1] > 0) & (differs[-1] > differs[cut - 1])
    alike = (apart_by[cut - 1] < config.alike_deg) & (apart_by[cut] < config.alike_deg)
    return index[cut[both & ~alike]]


def _children(
    scene: Scene, first: int, everyone: Sequence[TrajectoryHypothesis], parents: Sequence[int], tried: set[Cut],
    config: CrossoverConfig, refinement: HypothesisConfig,
) -> list[TrajectoryHypothesis]:  # fmt: skip
    """The children whose pairs cost least, no two alike and none like a parent; those `tried` are left out, and what
    is compared is added to them."""
    best = everyone[0].estimated
    costs = {i: _frame_costs(everyone[i]) for i in parents}
    cuts: list[tuple[float, Cut]] = []
    for a, b in permutations(parents, 2):
        for cut in map(int, cuts_between(everyone[a], everyone[b], config, refinement.agreeing_deg)):
            if (a, b, cut) not in tried:
                cuts.append((float(costs[a][: cut + 1].sum() + costs[b][cut + 1 :].sum()), (a, b, cut)))
    likeliest = [cut for _, cut in sorted(cuts)[: config.compared]]
    tried.update(likeliest)
    children = [crossed_at(everyone[a], everyone[b], cut, first, best) for a, b, cut in likeliest]
    figures = KnownFigures()
    children.sort(key=lambda child: own_cost(scene, child, refinement, figures))
    chosen: list[TrajectoryHypothesis] = []
    known = [everyone[i].joint.poses for i in parents]
    for child in children:
        poses = child.joint.poses
        if len(chosen) < config.refined and all(apart_deg(poses, k) > refinement.agreeing_deg for k in known):
            chosen.append(child)
            known.append(poses)
    return chosen


def _frame_costs(hypothesis: TrajectoryHypothesis) -> Float[Array, " n"]:
    """What each frame's pairs cost, `NO_POSE` where it has none."""
    joint = hypothesis.joint
    cost = per_view(joint.pairs, joint.figures, len(joint.poses))[0]
    return np.where(hypothesis.use & np.isfinite(cost), cost, NO_POSE)
