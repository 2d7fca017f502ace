"""A toss from short windows: what no beam can slide away from, because no window rests on another.

Over a few frames a body's centre runs on a parabola and its spin hardly changes, whether it flies, rolls or hangs in a
moving hand; only impacts break that. All spins that the camera's rate can tell apart are tried in every window. What
the windows and the hypotheses so far foretell of each step from frame to frame is linked through the toss by what the
pairs of views one and two frames apart say (the cheapest path, Viterbi), refined jointly, and linked again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.motion.interpolate import turn_between
from processing.track import kernels as k
from processing.track.beam import Hypothesis, Scene
from processing.track.flight import FlightConfig, solved
from processing.track.hypotheses import HypothesisConfig, TrajectoryHypothesis, leave_open, refined
from processing.track.keyframes import KeyframeConfig, extended
from processing.track.pairs import compared
from processing.track.schedule import Schedule, rows

Motions = list[Float[Array, "4 4"]]
"""Of the camera's axes from one frame to the next (the later pose is the motion times the earlier one)."""


@dataclass(frozen=True)
class WindowConfig:
    """How windows are laid, solved and linked."""

    frames: int = 5
    every: int = 2
    """Frames from one window's start to the next one's."""
    longest_step: float = 3.5
    """A window holds no gap of more than so many usual steps of time."""
    solved: FlightConfig = field(default_factory=lambda: FlightConfig(hypotheses=3))
    alone: Schedule = ((1, 4, 0.008, 0.2, 0.010, 0.25), (0, 4, 0.004, 0.12, 0.006, 0.5))
    """A step is tried as foretold and aligned to its two views alone: at an impact nothing foretells it."""
    compared: Schedule = ((1, 0, 0.006, 0.15, 0.008, 0.4),)
    """Scales at which two views are compared when steps are linked."""
    impact: float = 0.02
    """Cost (no unit) of a change of spin that is an impact; a small one costs its share ..."""
    change_deg: float = 6.0
    """... half of it where the turns from frame to frame differ by so much."""
    same_deg: float = 2.0
    same_m: float = 0.002
    """Motions that are nearer to each other are one."""
    rounds: int = 3
    """How often steps are linked and refined (0: no windows are laid); each time adds what the refinement found to the
    motions that are linked."""


def through_windows(
    scene: Scene, first: int, hypotheses: Sequence[TrajectoryHypothesis], keyframes: KeyframeConfig,
    config: WindowConfig, refinement: HypothesisConfig, report: Callable[[float], None] = lambda _: None,
) -> list[TrajectoryHypothesis]:  # fmt: skip
    """The hypothesis that the windows' steps and those of the `hypotheses` (the best one first) make together, through
    the best one's pose of frame `first`; none where all of them agree, which leaves nothing open, or where frames are
    too few. `report` is told the share of the work that is done."""
    n, best = len(scene.times_s), hypotheses[0].joint.poses
    usable = np.array([i for i in range(n) if scene.store.usable(i)], dtype=np.int64)
    unsure = any(leave_open(best[:n], h.joint.poses[:n], refinement) for h in hypotheses[1:])
    if config.rounds == 0 or not unsure or len(usable) < config.frames:
        return []
    still = np.array([scene.store.stands_still(int(i), int(j)) for i, j in zip(usable, usable[1:])])
    steps = _foretold(scene, usable, still, config, lambda share: report(0.6 * share))
    for h in hypotheses:
        _remember(steps, h.joint.poses, usable, still)
    found: list[TrajectoryHypothesis] = []
    for done in range(config.rounds):
        report(0.6 + 0.4 * done / config.rounds)
        poses = _poses(_linked(scene, usable, steps, config), usable, first, best[first], n)
        keys = extended((first,), poses, usable.tolist(), keyframes)
        linked = Hypothesis(poses, np.full(n, np.nan), np.full(n, np.nan), tuple(range(n)), keys, 0.0)
        found.append(refined(scene, linked, first, True, refinement))
        _remember(steps, found[-1].joint.poses, usable, still)
    return [min(found, key=lambda h: h.cost)]


def _foretold(
    scene: Scene, usable: Int[Array, " u"], still: Bool[Array, " s"], config: WindowConfig,
    report: Callable[[float], None],
) -> list[Motions]:  # fmt: skip
    """What windows foretell of each step between usable frames; a window speaks of the steps beside it, too, because
    an impact may have come before or after them."""
    steps: list[Motions] = [[] for _ in still]
    usual_s = float(np.median(np.diff(scene.times_s[usable])))
    for b in range(0, len(usable) - config.frames + 1, config.every):
        frames = usable[b : b + config.frames]
        gap_s = float(np.diff(scene.times_s[frames]).max())
        if still[b : b + config.frames - 1].all() or gap_s > config.longest_step * usual_s:
            continue
        report(b / len(usable))
        for window in solved(_falling(scene, frames), frames, config.solved):
            motions = [two @ se3.inverse(one) for one, two in zip(window.poses, window.poses[1:])]
            for a, motion in zip(range(b - 1, b + config.frames), [motions[0], *motions, motions[-1]]):
                if 0 <= a < len(steps):
                    steps[a].append(motion)
    for a, (i, j) in enumerate(zip(map(int, usable), map(int, usable[1:]))):
        shift = np.eye(4)
        if still[a]:
            steps[a] = [shift]
            continue
        shift[:3, 3] = scene.store.center_m[j] - scene.store.center_m[i]
        carried = scene.carried(i, j)
        center_m = scene.store.center_m[i]
        raw = _distinct([*([] if carried is None else [carried]), *steps[a], shift], center_m, config)
        steps[a] = _distinct([*raw, *(_alone(scene, i, j, m, config) for m in raw)], center_m, config)
    return steps


def _falling(scene: Scene, frames: Int[Array, " m"]) -> Scene:
    """The scene with the acceleration of the centre of what is seen in these frames in gravity's place."""
    t = scene.times_s[frames] - scene.times_s[frames[len(frames) // 2]]
    powers = np.stack([np.ones_like(t), t, 0.5 * t * t], -1)
    fit, *_ = np.linalg.lstsq(powers, scene.store.center_m[frames], rcond=None)
    return replace(scene, gravity_camera_m_s2=fit[2])


def _distinct(motions: Motions, center_m: Float[Array, "3"], config: WindowConfig) -> Motions:
    """Without those that move the body as one before them does."""
    kept: Motions = []
    for m in motions:
        place = m[:3, :3] @ center_m + m[:3, 3]
        if all(
            np.degrees(np.linalg.norm(turn_between(m, o))) > config.same_deg
            or np.linalg.norm(place - o[:3, :3] @ center_m - o[:3, 3]) > config.same_m
            for o in kept
        ):
            kept.append(m)
    return kept


def _alone(scene: Scene, i: int, j: int, motion: Float[Array, "4 4"], config: WindowConfig) -> Float[Array, "4 4"]:
    """The motion after view j was aligned to view i alone."""
    store, distance = scene.store, float(np.linalg.norm(scene.store.center_m[i]))
    aligned, *_ = k.align_view(
        np.ascontiguousarray(motion), j, np.array([i]), np.eye(4)[None], store.maps, store.samples, store.table,
        store.rectified.focal, store.rectified.center, rows(config.alone, distance), np.zeros(6), np.eye(4),
    )  # fmt: skip
    return np.asarray(aligned) if np.isfinite(aligned).all() else motion


def _remember(
    steps: list[Motions], poses: Float[Array, "v 4 4"], usable: Int[Array, " u"], still: Bool[Array, " s"]
) -> None:
    """Adds the steps of a trajectory where it has both poses and something moves."""
    for a, (i, j) in enumerate(zip(usable, usable[1:])):
        if not still[a] and np.isfinite(poses[[i, j], 0, 0]).all():
            steps[a].append(poses[j] @ se3.inverse(poses[i]))


def _linked(scene: Scene, usable: Int[Array, " u"], steps: list[Motions], config: WindowConfig) -> Motions:
    """The motions, one a step, that cost least together: each by the pair of its views, two in a row by the pair two
    frames apart and by the change of spin."""
    distance = float(np.median(np.linalg.norm(scene.store.center_m[usable], axis=1)))
    row = rows(config.compared, distance)[0]
    total = pair_costs(scene, int(usable[0]), int(usable[1]), steps[0], row)
    back: list[Int[Array, " m"]] = []
    for a in range(1, len(steps)):
        i, now, j = map(int, usable[a - 1 : a + 2])
        both = [two @ one for one in steps[a - 1] for two in steps[a]]
        across = pair_costs(scene, i, j, both, row).reshape(len(steps[a - 1]), -1)
        spans_s = np.diff(scene.times_s[[i, now, j]])
        paths = total[:, None] + across + change_costs(steps[a - 1], steps[a], spans_s, config)
        back.append(np.argmin(paths, axis=0))
        total = paths.min(axis=0) + pair_costs(scene, now, j, steps[a], row)
    at = int(np.argmin(total))
    out = [steps[-1][at]]
    for motions, came_from in zip(steps[-2::-1], back[::-1]):
        at = int(came_from[at])
        out.append(motions[at])
    return out[::-1]


def _changes_deg(ones: Motions, twos: Motions, spans_s: Float[Array, "2"]) -> Float[Array, "a b"]:
    """How far each second motion's turn, in the first one's time, is from each first one's."""
    before, after = ([turn_between(m, np.eye(4)) for m in motions] for motions in (ones, twos))
    gaps = np.array(before)[:, None] - np.array(after)[None] * spans_s[0] / spans_s[1]
    return np.degrees(np.linalg.norm(gaps, axis=-1))


def change_costs(
    ones: Motions, twos: Motions, spans_s: Float[Array, "2"], config: WindowConfig, free: bool = False
) -> Float[Array, "a b"]:
    """What the change of spin from each first motion to each second one costs; without a limit where nothing touches
    the body (`free`)."""
    ratio = (_changes_deg(ones, twos, spans_s) / config.change_deg) ** 2
    return config.impact * (ratio if free else ratio / (1 + ratio))


def pair_costs(
    scene: Scene, i: int, j: int, motions: Motions, row: Float[Array, "7"], unseen: float = 0.0
) -> Float[Array, " m"]:
    """Mean cost of two views, both ways, under each motion from one to the other; `unseen`: of a point that has no
    counterpart in the other view."""
    pairs = np.array([[i, j], [j, i]], dtype=np.int64)
    poses = np.zeros((max(i, j) + 1, 4, 4))
    poses[i] = np.eye(4)
    out = np.empty(len(motions))
    for m, poses[j] in enumerate(motions):
        figures = compared(scene.store, poses, pairs, row, shaded=False)[2]
        out[m] = (figures[:, 0] + unseen * (1 - figures[:, 1])).mean()
    return out


def _poses(
    motions: Motions, usable: Int[Array, " u"], first: int, pose: Float[Array, "4 4"], count: int
) -> Float[Array, "n 4 4"]:
    """camera_from_object of the usable frames, that of frame `first` being `pose`; NaN elsewhere."""
    out, at = np.full((count, 4, 4), np.nan), int(np.searchsorted(usable, first))
    out[first] = pose
    for a in range(at, len(motions)):
        out[usable[a + 1]] = motions[a] @ out[usable[a]]
    for a in range(at - 1, -1, -1):
        out[usable[a]] = se3.inverse(motions[a]) @ out[usable[a + 1]]
    return out
