"""Follows the object from frame to frame with several hypotheses: one frame of a symmetric body leaves its pose open.

Each hypothesis is a list of poses; its model is the views at those poses, so a new branch costs nothing. A frame's
candidates (motion prior, shift of the cloud, feature matches, a grid of rotations when all else fits badly) are aligned
and ranked by the cost of the fit plus that of the change of motion; the best few live on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from numpy import ndarray as Array

from processing.features.sift import FeatureMatcher, Features, RansacConfig, RelativeMotion, relative_motions
from processing.motion import se3_kernels as se3
from processing.motion.interpolate import carried_on, moved, turn_between
from processing.motion.motion_prior import MotionConfig, change_cost, steady_spin
from processing.motion.rotation_grid import turn_grid
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k
from processing.track.keyframes import KeyframeConfig, Sides, extended
from processing.track.schedule import Schedule, rows

LEAST_DELAY_S = 0.0003
"""Between colour and depth: less is no motion."""


@dataclass(frozen=True)
class BeamConfig:
    """How hypotheses are made, ranked and dropped."""

    width: int = 4
    """Hypotheses kept."""
    branches: int = 3
    """Candidates of one hypothesis that may live on."""
    coarse: Schedule = ((1, 6, 0.012, 0.5, 0.010, 0.15), (1, 4, 0.006, 0.4, 0.008, 0.3))
    fine: Schedule = ((0, 5, 0.004, 0.2, 0.006, 0.4), (0, 6, 0.0025, 0.15, 0.005, 1.0))
    grid: Schedule = ((1, 5, 0.012, 0.5, 0.010, 0.1),)
    uncertain_cost: float = 0.07
    """A frame whose best fit costs more asks for feature matches."""
    search: float = 0.13
    """A frame whose best fit costs more even then asks for the grid of rotations."""
    lost: float = 0.33
    """A frame whose best fit costs more is no basis for others."""
    least_on_surface: float = 0.15
    apart_deg: float = 6.0
    """Nearer candidates are the same."""
    spread: float = 0.35
    """Worse than the best by more than this: dropped."""
    grid_deg: tuple[float, ...] = (20.0, 40.0, 65.0)
    grid_axes: int = 20
    hold: float = 60.0
    """The pull towards the predicted pose weighs as much as so many independent samples ..."""
    hold_deg: float = 2.0
    hold_m: float = 0.01
    """... of this standard deviation."""
    still_share: float = 0.2
    """Of that standard deviation, where the images say that nothing moved, or the robot's hand moves the object."""
    motion: MotionConfig = field(default_factory=MotionConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    ransac: RansacConfig = field(default_factory=RansacConfig)


def seconds(times_ns: Int64[Array, " n"]) -> Float[Array, " n"]:
    """Times from the first one on."""
    return np.asarray((times_ns - times_ns[0]) * 1e-9)


@dataclass(frozen=True, eq=False)
class Scene:
    """What the beam reads: views, their times, gravity, where the body's center of mass is (object frame)."""

    store: ViewStore
    times_s: Float[Array, " n"]
    gravity_camera_m_s2: Float[Array, "3"]
    center_m: Float[Array, "3"]
    matcher: FeatureMatcher
    features: dict[int, Features] = field(default_factory=dict)
    matched: dict[tuple[int, int], list[RelativeMotion]] = field(default_factory=dict)
    flying: Bool[Array, " n"] | None = None
    """Frames in which nothing touches the body (processing/track/flight.py); None: not known of any."""
    hand: Float[Array, "n 4 4"] | None = None
    """The robot's hand (camera_from_hand), which may hold the object; NaN where it is not known."""

    def carried(self, before: int, now: int) -> Float[Array, "4 4"] | None:
        """How the hand moves from one frame to another (camera axes); None where that is not known."""
        if self.hand is None or not np.isfinite(self.hand[[before, now], 0, 0]).all():
            return None
        return np.asarray(self.hand[now] @ se3.inverse(self.hand[before]))

    def free(self, frames: Sequence[int]) -> bool:
        """Whether the body flies in all these frames."""
        return self.flying is not None and bool(self.flying[list(frames)].all())

    def before_flight(self, frame: int) -> bool:
        """Whether the body's flight is still to come."""
        return self.flying is not None and bool(self.flying[frame:].any() and not self.flying[: frame + 1].any())

    def described(self, view: int) -> Features:
        if view not in self.features:
            self.features[view] = self.matcher.describe(self.store, view)
        return self.features[view]

    def motions(self, one: int, other: int, ransac: RansacConfig) -> list[RelativeMotion]:
        """Between two views, as their features say: the same for every hypothesis."""
        if (one, other) not in self.matched:
            both = self.described(one), self.described(other)
            self.matched[one, other] = relative_motions(self.matcher, *both, ransac, seed=other, most=2)
        return self.matched[one, other]

    def forget(self, view: int) -> None:
        """What was found of a view, whose place another one takes."""
        self.features.pop(view, None)
        for pair in [p for p in self.matched if view in p]:
            del self.matched[pair]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Poses, NaN where not tracked yet or lost (after the n frames, those of a known shape's drawn views); views that
    serve as model; the sum of what they cost."""

    poses: Float[Array, "v 4 4"]
    costs: Float[Array, " n"]
    on_surface: Float[Array, " n"]
    done: tuple[int, ...]
    keyframes: tuple[int, ...]
    total: float

    @property
    def tracked(self) -> tuple[int, ...]:
        done = np.array(self.done, dtype=np.int64)
        return tuple(done[np.isfinite(self.poses[done, 0, 0])].tolist())


@dataclass(frozen=True, eq=False)
class Candidate:
    """One pose for one frame: what it costs to fit, what its motion costs, and how much lies on the surface."""

    pose: Float[Array, "4 4"]
    fit: float
    motion_cost: float
    on_surface: float
    source: str

    @property
    def cost(self) -> float:
        return self.fit + self.motion_cost


def follow(
    scene: Scene, order: Int[Array, " m"], beam: list[Hypothesis], config: BeamConfig, on_step: object = None
) -> tuple[Hypothesis, dict[int, list[Candidate]]]:
    """Track the views in `order` (forward or backward in time) from what the hypotheses in `beam` already hold. The
    best hypothesis, and the candidates that were rejected."""
    rejected: dict[int, list[Candidate]] = {}
    for i in order:
        i = int(i)
        if not scene.store.usable(i):
            beam = [replace(h, done=(*h.done, i)) for h in beam]
            continue
        _put_at_color_time(scene, beam[0], i, config)
        grown: list[Hypothesis] = []
        for h in beam:
            kept, others = _branches(scene, h, i, config)
            rejected.setdefault(i, []).extend(others)
            grown += [_extended(h, i, c, scene, config) for c in kept]
        beam = _pruned(grown, i, config)
        if callable(on_step):
            on_step(i, beam)
    return beam[0], rejected


def _put_at_color_time(scene: Scene, h: Hypothesis, i: int, config: BeamConfig) -> None:
    """Where depth is exposed at another time than colour: make the view with the motion that the poses foretell, then
    with the motion to the pose that fits it best."""
    crop, tracked = scene.store.crops[i], [j for j in h.tracked if j != i]
    if crop is None or abs(crop.depth_delay_s) < LEAST_DELAY_S or len(tracked) < 2 or np.isfinite(h.poses[i, 0, 0]):
        return
    if scene.store.stands_still(tracked[-1], i):
        return
    # over three poses, not two: an error of the last pose must not move the depth that the next one rests on
    a, b = tracked[max(-3, -len(tracked))], tracked[-1]
    step_s = scene.times_s[b] - scene.times_s[a]
    spin = steady_spin(h.poses[tracked[-6:]], scene.times_s[tracked[-6:]])
    gravity = scene.gravity_camera_m_s2 * (not scene.before_flight(i))
    color, depth = (
        moved(h.poses[a], h.poses[b], step_s, t - scene.times_s[b], scene.center_m, gravity, spin)
        for t in (scene.times_s[i], scene.times_s[i] + crop.depth_delay_s)
    )
    scene.store.fill(i, color @ se3.inverse(depth))
    found = _aligned_all(scene, h, i, _usual_starts(scene, h, i), config)
    if found and found[0].fit < config.lost:
        three = np.array([h.poses[tracked[-2]], h.poses[b], found[0].pose])
        times_s = scene.times_s[[tracked[-2], b, i]]
        scene.store.fill(i, se3.inverse(carried_on(three, times_s, crop.depth_delay_s, scene.center_m)))


def started(count: int, view: int, pose: Float[Array, "4 4"]) -> Hypothesis:
    """A hypothesis that knows one view's pose."""
    poses = np.full((count, 4, 4), np.nan)
    poses[view] = pose
    costs, on = np.full(count, np.nan), np.full(count, np.nan)
    costs[view], on[view] = 0.0, 1.0
    return Hypothesis(poses, costs, on, (view,), (view,), 0.0)


def _extended(h: Hypothesis, i: int, c: Candidate, scene: Scene, config: BeamConfig) -> Hypothesis:
    """The hypothesis with one more frame; a frame that fits too badly stays without a pose."""
    if c.fit > config.lost or c.on_surface < config.least_on_surface:
        return replace(h, done=(*h.done, i), total=h.total + config.lost + 0.1)
    poses, costs, on = h.poses.copy(), h.costs.copy(), h.on_surface.copy()
    poses[i], costs[i], on[i] = c.pose, c.fit, c.on_surface
    keys = extended(h.keyframes, poses, (i,), config.keyframes)
    return Hypothesis(poses, costs, on, (*h.done, i), keys, h.total + c.cost)


def _pruned(grown: list[Hypothesis], i: int, config: BeamConfig) -> list[Hypothesis]:
    """The best few that differ from each other."""
    grown = sorted(grown, key=lambda h: h.total)
    kept: list[Hypothesis] = []
    for h in grown:
        if h.total > grown[0].total + config.spread or len(kept) >= config.width:
            break
        if all(_differ(h, other, i, config) for other in kept):
            kept.append(h)
    return kept


def _differ(a: Hypothesis, b: Hypothesis, i: int, config: BeamConfig) -> bool:
    """Whether two hypotheses disagree about this frame."""
    one, two = a.poses[i], b.poses[i]
    if not (np.isfinite(one[0, 0]) and np.isfinite(two[0, 0])):
        return bool(np.isfinite(one[0, 0]) != np.isfinite(two[0, 0])) and a.done != b.done
    return bool(np.degrees(np.linalg.norm(turn_between(one, two))) > config.apart_deg)


def _branches(scene: Scene, h: Hypothesis, i: int, config: BeamConfig) -> tuple[list[Candidate], list[Candidate]]:
    """Candidates of one hypothesis for frame i: those that may live on, best first, and the others."""
    known = _standing(scene, h, i, config) or _carried(scene, h, i, config)
    if known is not None:
        return [known], []
    starts = _usual_starts(scene, h, i)
    found = merged(_aligned_all(scene, h, i, starts, config) + _held(scene, h, i, starts, config), config)
    if not found or found[0].fit > config.uncertain_cost:
        found = merged(found + _aligned_all(scene, h, i, _feature_starts(scene, h, i, config), config), config)
    if not found or found[0].fit > config.search:
        found = merged(found + _searched(scene, h, i, starts, config), config)
    if not found:
        nothing = Candidate(np.full((4, 4), np.nan), 1.0, 0.0, 0.0, "none")
        return [nothing], []
    kept = [c for c in found if c.cost < found[0].cost + config.spread][: config.branches]
    return kept, [c for c in found if c not in kept]


def _usual_starts(scene: Scene, h: Hypothesis, i: int) -> list[tuple[str, Float[Array, "4 4"]]]:
    """Motion prior, the same put on the seen cloud, the last pose put on the seen cloud."""
    tracked = h.tracked
    last = h.poses[tracked[-1]]
    shift = scene.store.center_m[i] - scene.store.center_m[tracked[-1]]
    shifted = last.copy()
    shifted[:3, 3] += shift
    starts = [("shift", shifted)]
    if np.isfinite(h.poses[i, 0, 0]):
        starts = [("as before", h.poses[i]), *starts]
    if len(tracked) > 1:
        a, b = tracked[-2], tracked[-1]
        step_s, next_s = scene.times_s[b] - scene.times_s[a], scene.times_s[i] - scene.times_s[b]
        recent = list(tracked[-6:])
        spin = steady_spin(h.poses[recent], scene.times_s[recent])
        prior = moved(h.poses[a], last, step_s, next_s, scene.center_m, scene.gravity_camera_m_s2, spin)
        on_cloud = prior.copy()
        on_cloud[:3, 3] = last[:3, 3] + shift
        starts = [*starts, ("prior", prior), ("prior on cloud", on_cloud)]
    return starts


def _feature_starts(scene: Scene, h: Hypothesis, i: int, config: BeamConfig) -> list[tuple[str, Float[Array, "4 4"]]]:
    """Poses that feature matches to the last view and to the keyframes support."""
    starts = []
    for j in dict.fromkeys((h.tracked[-1], *(j for j in reversed(h.keyframes[-8:]) if j != i))):
        for motion in scene.motions(j, i, config.ransac):
            starts.append((f"features of {j}", motion.other_from_one @ h.poses[j]))
    return starts[:8]


def _searched(
    scene: Scene, h: Hypothesis, i: int, starts: list[tuple[str, Float[Array, "4 4"]]], config: BeamConfig
) -> list[Candidate]:
    """Coarse alignment from a grid of rotations about the body's center of mass; the best few aligned finely."""
    base = [s for s in starts if s[0] in ("shift", "prior on cloud")]
    tries = []
    for _, pose in base:
        center = pose[:3, :3] @ scene.center_m + pose[:3, 3]
        for turn in turn_grid(config.grid_deg, config.grid_axes):
            turned = pose.copy()
            turned[:3, :3] = turn @ pose[:3, :3]
            turned[:3, 3] = center - turned[:3, :3] @ scene.center_m
            tries.append(turned)
    tried = [_aligned(scene, h, i, t, config.grid, config, "grid") for t in tries]
    return _refined(scene, h, i, merged([c for c in tried if c is not None], config)[:8], config)


def _aligned_all(
    scene: Scene, h: Hypothesis, i: int, starts: list[tuple[str, Float[Array, "4 4"]]], config: BeamConfig
) -> list[Candidate]:
    coarse = [_aligned(scene, h, i, pose, config.coarse, config, name) for name, pose in starts]
    return _refined(scene, h, i, merged([c for c in coarse if c is not None], config)[:4], config)


def _refined(scene: Scene, h: Hypothesis, i: int, rough: list[Candidate], config: BeamConfig) -> list[Candidate]:
    fine = [_aligned(scene, h, i, c.pose, config.fine, config, c.source) for c in rough]
    return merged([c for c in fine if c is not None], config)


def _held(
    scene: Scene, h: Hypothesis, i: int, starts: list[tuple[str, Float[Array, "4 4"]]], config: BeamConfig
) -> list[Candidate]:
    """The predicted motion, moved only where images insist: a uniform body must not turn with its shading."""
    prior = next((pose for name, pose in starts if name == "prior"), None)
    coarse = None if prior is None else _aligned(scene, h, i, prior, config.coarse, config, "prior", held=prior)
    fine = None if coarse is None else _aligned(scene, h, i, coarse.pose, config.fine, config, "held", held=prior)
    return [] if fine is None else [fine]


def _standing(scene: Scene, h: Hypothesis, i: int, config: BeamConfig) -> Candidate | None:
    """The last pose, where the images say that nothing moved: what looks the same from all sides must not turn."""
    last = h.tracked[-1]
    if abs(last - i) != 1 or not scene.store.stands_still(last, i):
        return None
    found = _aligned(scene, h, i, h.poses[last], config.fine, config, "standing", h.poses[last], config.still_share)
    return found if found is not None and found.fit < config.search else None


def _carried(scene: Scene, h: Hypothesis, i: int, config: BeamConfig) -> Candidate | None:
    """The last pose moved as the robot's hand moves, where the images agree: then the hand holds the object."""
    if (motion := scene.carried(h.tracked[-1], i)) is None:
        return None
    pose = motion @ h.poses[h.tracked[-1]]
    found = _aligned(scene, h, i, pose, config.fine, config, "carried", pose, config.still_share)
    return found if found is not None and found.fit < config.uncertain_cost else None


def merged(candidates: list[Candidate], config: BeamConfig) -> list[Candidate]:
    """Sorted by cost, without those that agree with a better one."""
    kept: list[Candidate] = []
    near = 1 + 2 * np.cos(np.radians(config.apart_deg))  # the trace of a turn by that angle
    for c in sorted(candidates, key=lambda c: c.cost):
        if all(np.vdot(c.pose[:3, :3], o.pose[:3, :3]) < near for o in kept):
            kept.append(c)
    return kept


def _aligned(
    scene: Scene, h: Hypothesis, i: int, pose: Float[Array, "4 4"], schedule: Schedule, config: BeamConfig, source: str,
    held: Float[Array, "4 4"] | None = None, share: float = 1.0,
) -> Candidate | None:  # fmt: skip
    """One candidate aligned to the nearest views of the model, held to the pose that the motion predicts where it is
    given; None where nothing faces it."""
    sides = Sides(h.poses, tuple(j for j in h.keyframes if j != i), h.tracked[-1], scene.center_m)
    refs = sides.references(pose, config.keyframes)
    if len(refs) == 0:
        return None
    store = scene.store
    distance = float(np.linalg.norm(store.center_m[i]))
    pull, wanted = (np.zeros(6), np.eye(4)) if held is None else (_hold(config) / share**2, held)
    aligned, _, fit, on, _ = k.align_view(
        np.ascontiguousarray(pose), i, refs, np.ascontiguousarray(h.poses[refs]), store.maps, store.samples,
        store.table, store.rectified.focal, store.rectified.center, rows(schedule, distance), pull, wanted,
    )  # fmt: skip
    if not np.isfinite(aligned).all():
        return None
    return Candidate(aligned, float(fit), _motion_cost(scene, h, i, aligned, config), float(on), source)


def _hold(config: BeamConfig) -> Float[Array, "6"]:
    """Information of the pull towards the predicted pose (translation, rotation)."""
    turn = config.hold / np.radians(config.hold_deg) ** 2
    return np.array([config.hold / config.hold_m**2] * 3 + [turn] * 3)


def _motion_cost(scene: Scene, h: Hypothesis, i: int, pose: Float[Array, "4 4"], config: BeamConfig) -> float:
    tracked = h.tracked
    times = scene.times_s
    if len(tracked) < 2:
        spin = np.linalg.norm(turn_between(pose, h.poses[tracked[-1]])) / max(abs(times[i] - times[tracked[-1]]), 1e-3)
        ratio = (float(spin) / config.motion.usual_turn_rad_s) ** 2
        return config.motion.impact_cost * ratio / (1 + ratio)
    a, b = tracked[-2], tracked[-1]
    three = (h.poses[a], h.poses[b], pose)
    steps = (times[b] - times[a], times[i] - times[b])
    recent = list(tracked[-6:])
    spin = steady_spin(h.poses[recent], times[recent])
    return change_cost(
        three, steps, scene.center_m, scene.gravity_camera_m_s2, config.motion, spin, scene.free([a, b, i])
    )
