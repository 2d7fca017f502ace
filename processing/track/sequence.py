"""Tracks one toss: views, a beam forward, a pass backward over the whole model, one joint refinement, honest flags.

This is the accurate tracker that the pipeline uses by default; `track_toss` is its door.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.track import kernels as k
from processing.track.beam import LEAST_DELAY_S, BeamConfig, Candidate, Hypothesis, Scene, follow, started
from processing.track.features import FeatureMatcher, Sift
from processing.track.graph import GraphConfig, Motion, flight_center, motion_residual, refine
from processing.track.motion import between, gravity_in_camera
from processing.track.views import Crop, Exposure, Optics, ViewConfig, ViewStore, cut
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.progress import Progress, Silent
from recordings.records import RgbdFrame
from recordings.tracks import ObjectTrack, Status

IMPACT_M_S = 0.35
"""A change of velocity around a frame beyond this is an impact."""


@dataclass(frozen=True)
class TrackConfig:
    """All settings of the tracker, the same for every session; chosen on simulated variety."""

    view: ViewConfig = field(default_factory=ViewConfig)
    beam: BeamConfig = field(default_factory=BeamConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    least_confidence: float = 0.2
    """Frames whose mask is less sure are not looked at."""
    tracked_cost: float = 0.25
    """After refinement, a view that fits its neighbours worse on average is lost."""
    longest_gap_s: float = 0.2
    """Frames between tracked ones that are at most this far apart get an interpolated pose."""
    gap_sigma_rad: float = 0.15
    gap_sigma_m: float = 0.02
    """Standard deviation of an interpolated pose in the middle of the longest gap."""


@dataclass(frozen=True, eq=False)
class TossTrack:
    """One toss's track and how it came about.

    `cost` (n): how badly each frame fits the frames that see the same surface, 0 perfect .. 1 (NaN: not tracked);
    `on_surface` (n): share of its points on their surface; `keyframes`: positions of the views that span the object;
    `pairs` (m, 2) compared in the joint refinement; `rejected`: candidates (camera_from_object 4x4) per position;
    `center_m`: estimated middle of mass in the object frame; `store`: the views, for registration between tosses.
    """

    track: ObjectTrack
    cost: Float[Array, " n"]
    on_surface: Float[Array, " n"]
    keyframes: tuple[int, ...]
    pairs: Int[Array, "m 2"]
    rejected: dict[int, list[Candidate]]
    center_m: Float[Array, "3"]
    margin: float
    """How much worse the best different story fits (infinite: there is none)."""
    store: ViewStore


def track_toss(
    frames: Sequence[RgbdFrame],
    masks: Sequence[Bool[Array, "h w"]],
    camera: CameraModel,
    config: TrackConfig | None = None,
    progress: Progress | None = None,
    *,
    toss: int = 0,
    object_frame: str = "object",
    confidence: Float[Array, " n"] | None = None,
    world_from_camera: Transform | None = None,
    start: Transform | None = None,
    matcher: FeatureMatcher | None = None,
) -> TossTrack:
    """Poses `camera_from_object` of all colour frames of one toss, without a model of the object.

    masks: the object's visible pixels in each colour frame; confidence: how sure each is (0..1). world_from_camera
    tells gravity and the table (z = 0). The object frame is parallel to the camera at the first usable frame, its
    origin at the middle of the cloud seen there, unless `start` gives that frame's camera_from_object.
    Raises BadInput where no frame shows enough of the object.
    """
    config, progress = config or TrackConfig(), progress or Silent()
    sure = np.ones(len(frames)) if confidence is None else np.asarray(confidence, dtype=np.float64)
    store, times_s = views_of(frames, masks, camera, sure, config, world_from_camera, progress)
    first = next((i for i in range(len(frames)) if store.usable(i)), None)
    if first is None:
        raise BadInput(
            f"toss {toss}: no frame shows the object: every mask is empty or has no depth; wanted at least "
            f"{config.view.least_samples} mask pixels with depth: look at the masks with `toss-view`, give a first mask"
        )
    pose = first_pose(store, first) if start is None else start.matrix
    world = None if world_from_camera is None else world_from_camera.matrix
    scene = Scene(store, times_s, gravity_in_camera(world), _middle_guess(store, first), matcher or Sift())
    best, margin, rejected = _followed(scene, first, pose, config, progress)
    return _refined(scene, best, first, margin, rejected, config, toss, camera.frame, object_frame, frames)


def views_of(
    frames: Sequence[RgbdFrame], masks: Sequence[Bool[Array, "h w"]], camera: CameraModel, sure: Float[Array, " n"],
    config: TrackConfig, world_from_camera: Transform | None, progress: Progress,
) -> tuple[ViewStore, Float[Array, " n"]]:  # fmt: skip
    """All frames as views (depth taken as if exposed with colour), and colour times since the first, seconds."""
    if len(frames) != len(masks) or len(frames) != len(sure):
        raise BadInput(
            f"{len(frames)} frames, {len(masks)} masks and {len(sure)} confidences; wanted one each per frame"
        )
    if len(frames) == 0:
        raise BadInput("a toss without frames; wanted at least one colour and depth frame")
    optics, exposure = Optics.of(camera), Exposure()
    camera_from_world = None if world_from_camera is None else world_from_camera.inverse().matrix
    crops: list[Crop | None] = []
    times_ns = []
    for i, frame in enumerate(frames):
        mask = np.asarray(masks[i], dtype=bool)
        gain = exposure.gain(frame.color_rgb, mask)
        seen = sure[i] >= config.least_confidence
        crops.append(cut(frame, mask, i, optics, gain, config.view, camera_from_world) if seen else None)
        times_ns.append(frame.time_ns)
        progress.step(i + 1, 3 * len(frames), "views")
    store = ViewStore(optics, crops, config.view)
    for i in range(len(frames)):
        store.fill(i)
    return store, (np.array(times_ns) - times_ns[0]) * 1e-9


def first_pose(store: ViewStore, view: int) -> Float[Array, "4 4"]:
    """Parallel to the camera, at the middle of the cloud."""
    first, count = int(store.table[view, k.FIRST]), int(store.table[view, k.COUNT])
    pose = np.eye(4)
    pose[:3, 3] = store.samples[first : first + count, :3].mean(0)
    return pose


def _middle_guess(store: ViewStore, view: int) -> Float[Array, "3"]:
    """Where the body's middle lies behind the first cloud's middle: a third of its width along the ray."""
    first, count = int(store.table[view, k.FIRST]), int(store.table[view, k.COUNT])
    points = store.samples[first : first + count, :3].astype(np.float64)
    middle = points.mean(0)
    width = float(np.ptp(points[:, :2], axis=0).mean())
    return np.asarray(middle / np.linalg.norm(middle) * width * 0.3)


def _followed(
    scene: Scene, first: int, pose: Float[Array, "4 4"], config: TrackConfig, progress: Progress
) -> tuple[Hypothesis, float, dict[int, list[Candidate]]]:
    """The beam forward, then once more backward with all that forward learned as the model."""
    n = len(scene.times_s)

    def told(i: int, beam: list[Hypothesis]) -> None:
        progress.step(n + i, 3 * n, "forward")

    ahead = follow(scene, np.arange(first + 1, n), started(scene.store, n, first, pose), config.beam, told)
    best = ahead.best
    last = best.tracked[-1]
    known = replace(best, done=(last,), total=0.0)
    back = follow(scene, np.arange(last - 1, first, -1), known, replace(config.beam, width=2))
    done = tuple(range(first, n))
    return replace(back.best, done=done, total=best.total), ahead.margin, ahead.rejected


def _refined(
    scene: Scene, best: Hypothesis, first: int, margin: float, rejected: dict[int, list[Candidate]],
    config: TrackConfig, toss: int, camera: str, object_frame: str, frames: Sequence[RgbdFrame],
) -> TossTrack:  # fmt: skip
    """Joint refinement of all tracked views, once more where depth and colour differ in time; then flags."""
    n = len(scene.times_s)
    use = np.isfinite(best.poses[:, 0, 0])
    fixed = np.zeros(n, dtype=bool)
    fixed[first] = True
    poses, center_m = best.poses, scene.center_m
    still = np.array([i > 0 and use[i] and use[i - 1] and scene.store.stands_still(i - 1, i) for i in range(n)])
    delayed = any(c is not None and abs(c.depth_delay_s) > LEAST_DELAY_S for c in scene.store.crops)
    for _ in range(2 if delayed else 1):
        if delayed:
            use &= put_at_color_times(scene, poses, use)
        center_m = center_of_mass(poses, use, scene)
        motion = Motion(scene.times_s, np.zeros(n, dtype=np.int64), scene.gravity_camera_m_s2, center_m, still)
        joint = refine(scene.store, poses, use, fixed, motion, config.graph)
        poses = joint.poses
    cost, on = _per_view(joint.pairs, joint.figures, n)
    lost = ~use | (cost > config.tracked_cost)
    lost[first] = False
    poses, status, covariance = _flagged(poses, joint.covariance, lost, scene, config)
    times_ns = np.array([f.time_ns for f in frames], dtype=np.int64)
    track = ObjectTrack(toss, camera, object_frame, times_ns, poses, status, covariance)
    keyframes = tuple(i for i in sorted(best.keyframes) if not lost[i])
    return TossTrack(track, cost, on, keyframes, joint.pairs, rejected, center_m, margin, scene.store)


def put_at_color_times(scene: Scene, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"]) -> Bool[Array, " n"]:
    """Make every view again with the motion between its two exposures, by neighbouring poses. Which are usable."""
    index = np.flatnonzero(use)
    out = use.copy()
    for a, i in enumerate(index):
        crop = scene.store.crops[i]
        if crop is None or abs(crop.depth_delay_s) < LEAST_DELAY_S or len(index) < 2:
            continue
        at_depth = _at_depth_time(scene, poses, index, a, crop.depth_delay_s)
        out[i] = scene.store.fill(int(i), poses[i] @ k.inverse(at_depth))
    return out


def _at_depth_time(
    scene: Scene, poses: Float[Array, "n 4 4"], index: Int[Array, " m"], a: int, delay_s: float
) -> Float[Array, "4 4"]:
    """Pose at depth's exposure of the view index[a]. The motion is that over both neighbours, because errors of single
    poses would move the depth that they rest on; only an impact's jump is taken from the nearer side."""
    i, t = index[a], scene.times_s
    before, after = index[max(a - 1, 0)], index[min(a + 1, len(index) - 1)]
    side = (i, after) if delay_s > 0 else (before, i)
    if side[0] == side[1] or scene.store.stands_still(int(side[0]), int(side[1])):
        return poses[i]
    speeds = []
    for x, y in ((before, after), side):
        centers = [poses[z][:3, :3] @ scene.center_m + poses[z][:3, 3] for z in (x, y)]
        speeds.append((centers[1] - centers[0]) / (t[y] - t[x]))
    x, y = side if np.linalg.norm(speeds[0] - speeds[1]) > IMPACT_M_S else (before, after)
    share = delay_s / (t[y] - t[x])
    step = between(poses[x], poses[y], abs(float(share)), scene.center_m) @ k.inverse(poses[x])  # camera axes
    return _carried(poses[i], step if share > 0 else k.inverse(step), poses[x], poses[y], float(share), scene.center_m)


def _carried(
    pose: Float[Array, "4 4"], turn: Float[Array, "4 4"], start: Float[Array, "4 4"], end: Float[Array, "4 4"],
    share: float, center_m: Float[Array, "3"],
) -> Float[Array, "4 4"]:  # fmt: skip
    """`pose` turned as `turn` turns, its middle moved by `share` of the way from `start`'s to `end`'s."""
    out = np.eye(4)
    out[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    way = (end[:3, :3] @ center_m + end[:3, 3]) - (start[:3, :3] @ center_m + start[:3, 3])
    out[:3, 3] = pose[:3, :3] @ center_m + pose[:3, 3] + share * way - out[:3, :3] @ center_m
    return out


def center_of_mass(poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], scene: Scene) -> Float[Array, "3"]:
    """From the longest run of views whose motion is that of free flight."""
    index = np.flatnonzero(use)
    motion = Motion(
        scene.times_s, np.zeros(len(poses), dtype=np.int64), scene.gravity_camera_m_s2, scene.center_m, ~use
    )
    fly = -scene.gravity_camera_m_s2
    free = []
    for a, b, c in zip(index, index[1:], index[2:]):
        steps = scene.times_s[[a, b, c]]
        residual, _ = motion_residual((poses[a], poses[b], poses[c]), steps, motion)
        centers = [poses[x][:3, :3] @ scene.center_m + poses[x][:3, 3] for x in (a, b, c)]
        change = (centers[2] - centers[1]) / (steps[2] - steps[1]) - (centers[1] - centers[0]) / (steps[1] - steps[0])
        falls = float(change @ -fly) / (0.5 * (steps[2] - steps[0])) > 0.6 * float(fly @ fly)
        free.append(bool(falls and np.linalg.norm(residual[:3]) < 3.0))
    run = _longest_run(free)
    flying = index[run.start : run.stop + 2] if run.stop > run.start else index[:0]
    return flight_center(poses, scene.times_s, scene.gravity_camera_m_s2, flying, scene.center_m)


def _longest_run(flags: list[bool]) -> range:
    best, start = range(0), 0
    for i, flag in enumerate([*flags, False]):
        if not flag:
            if i - start > len(best):
                best = range(start, i)
            start = i + 1
    return best


def _per_view(pairs: Int[Array, "m 2"], figures: Float[Array, "m 3"], n: int) -> tuple[Array, Array]:
    """Median cost and share on the surface over the pairs that a view is in; NaN where it is in none."""
    cost, on = np.full(n, np.nan), np.full(n, np.nan)
    for i in np.unique(pairs):
        mine = (pairs == i).any(1)
        cost[i], on[i] = np.median(figures[mine, 0]), np.median(figures[mine, 1])
    return cost, on


def _flagged(
    poses: Float[Array, "n 4 4"], covariance: Float[Array, "n 6 6"], lost: Bool[Array, " n"], scene: Scene,
    config: TrackConfig,
) -> tuple[Float[Array, "n 4 4"], tuple[Status, ...], Float[Array, "n 6 6"]]:  # fmt: skip
    """NaN for lost frames, poses from the motion for short gaps between tracked ones, covariance in camera axes."""
    out, status = poses.copy(), ["tracked"] * len(poses)
    sigma = np.full((len(poses), 6, 6), np.nan)
    tracked = np.flatnonzero(~lost)
    for i in tracked:
        sigma[i] = camera_covariance(poses[i], covariance[i])
    for i in np.flatnonzero(lost):
        out[i], status[i] = np.nan, "lost"
        before, after = tracked[tracked < i], tracked[tracked > i]
        if len(before) == 0 or len(after) == 0:
            continue
        gap_s = scene.times_s[after[0]] - scene.times_s[before[-1]]
        if gap_s <= config.longest_gap_s:
            out[i], status[i] = _in_gap(poses, before, after, int(i), scene), "interpolated"
            share = gap_s / config.longest_gap_s
            sigma[i] = np.diag([(config.gap_sigma_rad * share) ** 2] * 3 + [(config.gap_sigma_m * share) ** 2] * 3)
    return out, tuple(status), sigma  # type: ignore[arg-type]


def _in_gap(
    poses: Float[Array, "n 4 4"], before: Int[Array, " a"], after: Int[Array, " b"], i: int, scene: Scene
) -> Float[Array, "4 4"]:
    """Constant spin from the last tracked pose to the next, the centre on a parabola between them."""
    a, b = int(before[-1]), int(after[0])
    t = scene.times_s
    whole = t[b] - t[a]
    share = float((t[i] - t[a]) / whole)
    pose = between(poses[a], poses[b], share, scene.center_m)
    held = np.linalg.norm(poses[b][:3, 3] - poses[a][:3, 3]) < 0.002
    if not held:
        pose[:3, 3] -= 0.5 * scene.gravity_camera_m_s2 * whole**2 * share * (1 - share)
    return pose


def camera_covariance(pose: Float[Array, "4 4"], twist_covariance: Float[Array, "6 6"]) -> Float[Array, "6 6"]:
    """From a twist of the object frame (translation, rotation) to (rotation vector, translation) in camera axes.

    camera_from_object <- camera_from_object exp(-twist): the rotation turns by -R w, the origin moves by -R v.
    """
    R = pose[:3, :3]
    J = np.zeros((6, 6))
    J[:3, 3:], J[3:, :3] = -R, -R
    return np.asarray(J @ twist_covariance @ J.T)
