"""Tracks one toss: views, a beam forward, a pass backward over the whole model, one joint refinement, honest flags.

This is the accurate tracker that the pipeline uses by default; `track_toss` is its door.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float, Int, Int64
from numpy import ndarray as Array

from processing.features.sift import FeatureMatcher, Features, Sift
from processing.motion.motion_prior import gravity_in_camera
from processing.sensor import view_layout as lay
from processing.sensor.photometric_gain import PhotometricGain
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig, cut
from processing.sensor.view_store import ViewStore
from processing.track.beam import BeamConfig, Candidate, Hypothesis, Scene, follow, seconds, started
from processing.track.center_of_mass import first_center_m
from processing.track.crossover import CrossoverConfig, crossed
from processing.track.depth_color_offset import unknown_motion
from processing.track.flags import (
    FlagConfig,
    contradicting,
    flagged,
    per_view,
    uncertainty,
    unjoined,
    unjoined_uncertainty,
)
from processing.track.flight import FlightConfig, flights_followed, flying
from processing.track.hypotheses import (
    HypothesisConfig,
    TrajectoryHypothesis,
    all_refined,
    anchored_to,
    apart_deg,
    own_cost,
    select,
)
from processing.track.keyframes import extended
from processing.track.known_shape import (
    ShapeConfig,
    ShapeViews,
    center_of,
    located,
    path_through,
    shape_views,
    with_model,
)
from processing.track.windows import WindowConfig, through_windows
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.progress import Progress, Silent
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape, ObjectTrack


@dataclass(frozen=True)
class TrackConfig:
    """All settings of the tracker, the same for every session; chosen on simulated variety."""

    view: ViewConfig = field(default_factory=ViewConfig)
    beam: BeamConfig = field(default_factory=BeamConfig)
    windows: WindowConfig = field(default_factory=WindowConfig)
    crossover: CrossoverConfig = field(default_factory=CrossoverConfig)
    hypotheses: HypothesisConfig = field(default_factory=HypothesisConfig)
    flags: FlagConfig = field(default_factory=FlagConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    flight: FlightConfig = field(default_factory=FlightConfig)
    separate_deg: float = 20.0
    """What is estimated forward is a hypothesis of its own where those estimated backward differ from it by more."""
    least_confidence: float = 0.2
    """Frames whose mask is less sure are not looked at."""


@dataclass(frozen=True, eq=False)
class TossTrack:
    """One toss's track and how it came about.

    `cost` (n): how badly each frame fits the frames that see the same surface, 0 perfect .. 1 (NaN: not tracked);
    `on_surface` (n): share of its points on their surface; `keyframes`: positions of the views that span the object;
    `pairs` (m, 2) compared in the joint refinement; `rejected`: candidates (camera_from_object 4x4) per position;
    `center_m`: estimated center of mass in the object frame; `store`: the views, for registration between tosses;
    `features`: those of the views whose features were looked at on the way, by position.
    """

    track: ObjectTrack
    cost: Float[Array, " n"]
    on_surface: Float[Array, " n"]
    keyframes: tuple[int, ...]
    pairs: Int[Array, "m 2"]
    rejected: dict[int, list[Candidate]]
    center_m: Float[Array, "3"]
    store: ViewStore
    features: dict[int, Features]
    held: Int[Array, " n"]
    """Frames with the same number are a run through which a robot's hand carries the body; -1: none does."""
    own_cost: float | None = None
    """Mean of what the frames' own pairs and their motion cost, by which two tracks of the same frames are compared;
    None: read from a file, which does not keep it."""
    round_body: bool = False
    """Whether the body is round and its azimuth was found from all frames at once: pairs of views alone would spoil
    it."""

    @property
    def tied(self) -> Int[Array, " n"]:
        """Frames with the same number lie to each other as they do; -1: to no others."""
        return np.zeros_like(self.held) if self.round_body else self.held


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known before tracking. Poses are camera_from_object (4x4, NaN where unknown)."""

    start: Float[Array, "4 4"] | None
    start_frame: int | None
    poses: Float[Array, "n 4 4"] | None
    model: ShapeViews | None


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
    start_frame: int | None = None,
    poses: Float[Array, "n 4 4"] | None = None,
    model: ObjectShape | None = None,
    colorless: Sequence[Bool[Array, "h w"]] | None = None,
    matcher: FeatureMatcher | None = None,
    hand: Float[Array, "n 4 4"] | None = None,
) -> TossTrack:
    """Poses `camera_from_object` of all colour frames of one toss, without a model of the object unless one is given.

    masks: the object's visible pixels in each colour frame; confidence: how sure each is (0..1); colorless: pixels of
    the masks that show something else's colour (an occluder before depth that was drawn). world_from_camera gives
    gravity and the table (z = 0); hand: camera_from_hand of a robot that may hold the object (NaN where it does not).

    The object frame is parallel to the camera at the first usable frame, its origin at the center of the cloud seen
    there; or `start` gives camera_from_object of frame `start_frame` (None: the first usable one), which is kept.
    `poses` (NaN where unknown) are refined, only unknown frames are sought. With `model` the object frame is the
    model's: the object is located anew in the first frame (or starts from `start` or `poses`), then tracked against
    the model's surface and colours and what the frames themselves show.
    Raises BadInput where no frame shows enough of the object, or where what is given does not fit together.
    """
    config, progress = config or TrackConfig(), progress or Silent()
    if hand is not None and hand.shape != (len(frames), 4, 4):
        raise BadInput(f"a hand of shape {hand.shape} for {len(frames)} frames; wanted a 4x4 pose per frame, or NaN")
    sure = np.ones(len(frames)) if confidence is None else np.asarray(confidence, dtype=np.float64)
    store, times_ns, drawn = views_of(
        frames, masks, camera, sure, config, world_from_camera, progress, colorless=colorless, model=model
    )
    known = _known(start, start_frame, poses, drawn, len(frames))
    first = _first(store, known, len(frames), toss, config)
    gravity = gravity_in_camera(None if world_from_camera is None else world_from_camera.matrix)
    given = known.start if known.poses is None else known.poses[first]
    center_m = first_center_m(store, first, given) if model is None else center_of(model)
    scene = Scene(store, seconds(times_ns), gravity, center_m, matcher or Sift(), hand=hand)
    n = len(frames)
    scene = replace(scene, flying=np.isin(np.arange(n), flying(scene, n, config.flight)))
    if known.poses is None:
        hypotheses, rejected = _followed(scene, first, known, config, progress)
    else:
        hypothesis, rejected = _filled_in(scene, known, config, progress)
        hypotheses = [hypothesis]
    keep_first = model is None or known.start is not None
    found = all_refined(scene, hypotheses, first, keep_first, config.hypotheses)
    if known.poses is None and known.model is None:
        found += through_windows(
            scene, first, found, config.beam.keyframes, config.windows, config.hypotheses,
            lambda share: progress.step(2 * n + int(share * n), 3 * n, "windows"),
        )  # fmt: skip
        found += crossed(
            scene, first, sorted(found, key=lambda h: h.cost), config.crossover, config.hypotheses,
            lambda share: progress.step(2 * n + int(share * n), 3 * n, "crossovers"),
        )  # fmt: skip
    joint = select(scene, found, first, keep_first, known.poses is None, config.hypotheses)
    object_frame = object_frame if model is None else model.object_frame
    return _as_track(scene, joint, first, rejected, config, toss, camera.frame, object_frame, times_ns)


def _known(
    start: Transform | None, start_frame: int | None, poses: Float[Array, "n 4 4"] | None, drawn: ShapeViews | None,
    count: int,
) -> _Known:  # fmt: skip
    """What was given, checked."""
    if poses is not None and start is not None:
        raise BadInput("both a start and poses of all frames were given; wanted one of them")
    if poses is not None and poses.shape != (count, 4, 4):
        raise BadInput(f"poses of shape {poses.shape} for {count} frames; wanted ({count}, 4, 4), NaN where unknown")
    if start_frame is not None and (start is None or not 0 <= start_frame < count):
        raise BadInput(f"start_frame {start_frame} of {count} frames; wanted a frame's position, together with a start")
    return _Known(None if start is None else start.matrix, start_frame, poses, drawn)


def _first(store: ViewStore, known: _Known, count: int, toss: int, config: TrackConfig) -> int:
    """The frame that tracking starts from."""
    usable = [i for i in range(count) if store.usable(i)]
    if not usable:
        raise BadInput(
            f"toss {toss}: no frame shows the object: every mask is empty or has no depth; wanted at least "
            f"{config.view.least_samples} mask pixels with depth: look at the masks with `toss-view`, give a first mask"
        )
    if known.poses is not None:
        posed = [i for i in usable if np.isfinite(known.poses[i]).all()]
        if not posed:
            raise BadInput(f"toss {toss}: none of the {len(usable)} usable frames has one of the given poses")
        return posed[0]
    if known.start_frame is not None and known.start_frame not in usable:
        raise BadInput(f"toss {toss}: frame {known.start_frame}, whose pose is given, does not show the object")
    return usable[0] if known.start_frame is None else known.start_frame


def views_of(
    frames: Sequence[RgbdFrame], masks: Sequence[Bool[Array, "h w"]], camera: CameraModel, sure: Float[Array, " n"],
    config: TrackConfig, world_from_camera: Transform | None, progress: Progress,
    colorless: Sequence[Bool[Array, "h w"]] | None = None, model: ObjectShape | None = None,
) -> tuple[ViewStore, Int64[Array, " n"], ShapeViews | None]:  # fmt: skip
    """All frames as views (depth taken as if exposed with colour), and their times; after them in the store the views
    of a model, where there is one, and their poses."""
    if len(frames) != len(masks) or len(frames) != len(sure):
        found = f"{len(frames)} frames, {len(masks)} masks and {len(sure)} confidences"
        raise BadInput(f"{found}; wanted one each per frame")
    if len(frames) == 0:
        raise BadInput("a toss without frames; wanted at least one colour and depth frame")
    if colorless is not None and len(colorless) != len(frames):
        raise BadInput(f"{len(frames)} frames and {len(colorless)} masks of colourless pixels; wanted one per frame")
    rectified, brightness = Rectification.of(camera), PhotometricGain()
    camera_from_world = None if world_from_camera is None else world_from_camera.inverse().matrix
    crops: list[Crop | None] = []
    times_ns = []
    for i, frame in enumerate(frames):
        mask = np.asarray(masks[i], dtype=bool)
        gain = brightness.gain(frame.color_rgb, mask)
        foreign = None if colorless is None or not colorless[i].any() else np.asarray(colorless[i], dtype=bool)
        seen = sure[i] >= config.least_confidence
        crops.append(cut(frame, mask, i, rectified, gain, config.view, camera_from_world, foreign) if seen else None)
        times_ns.append(frame.time_ns)
        progress.step(i + 1, 3 * len(frames), "views")
    drawn = None if model is None else shape_views(model, crops, rectified, config.shape)
    store = ViewStore(rectified, [*crops, *(drawn.crops if drawn else ())], config.view)
    for i in range(len(store)):
        store.fill(i)
    store.take_light_out(len(frames))
    return store, np.array(times_ns, dtype=np.int64), drawn


def first_pose(store: ViewStore, view: int) -> Float[Array, "4 4"]:
    """Parallel to the camera, at the center of the cloud."""
    first, count = int(store.table[view, lay.FIRST]), int(store.table[view, lay.COUNT])
    pose = np.eye(4)
    pose[:3, 3] = store.samples[first : first + count, :3].mean(0)
    return pose


def _followed(
    scene: Scene, first: int, known: _Known, config: TrackConfig, progress: Progress
) -> tuple[list[Hypothesis], dict[int, list[Candidate]]]:
    """Hypotheses of the same frames: the beam forward, then once more backward to the first frame with all that forward
    learned as the model; a beam backward that knows nothing of that but where the last frame is; and the beam forward
    itself, where both differ from it. Where they leave its flight open, that solved as one adds its own. On a known
    shape, which tells where each frame is by itself, the path through these."""
    n = len(scene.times_s)
    beam, wide = _starts(scene, first, known, config)
    ahead = np.arange(first + 1, n)
    best, rejected = follow(scene, ahead, beam, wide, lambda i, _: progress.step(n + i, 3 * n, "forward"))
    last = best.tracked[-1]
    all_done = replace(best, done=(last,), total=0.0)
    stop = first if known.model is not None and known.start is not None else first - 1
    narrow, starts = replace(config.beam, width=2), [all_done]
    if known.model is None and last > first + 1:
        starts.append(started(n, last, best.poses[last]))
    hypotheses = [follow(scene, np.arange(last - 1, stop, -1), [h], narrow)[0] for h in starts]
    if known.model is None:
        hypotheses = [anchored_to(h, best, first) for h in hypotheses]
    if len(starts) > 1:
        if all(apart_deg(best.poses[:n], s.poses[:n]) > config.separate_deg for s in hypotheses):
            hypotheses.append(best)
        hypotheses += _through_flights(scene, first, best, hypotheses, narrow, config)
    out = []
    for hypothesis in hypotheses:
        if any(scene.store.usable(i) for i in range(first)):
            done = (*(i for i in hypothesis.done if i != first), first)
            hypothesis = follow(scene, np.arange(first - 1, -1, -1), [replace(hypothesis, done=done)], narrow)[0]
        out.append(replace(hypothesis, done=tuple(range(n)), total=best.total))
    if known.model is not None and known.start is None:
        path = path_through(
            scene, known.model, config.beam, config.windows, config.shape,
            lambda share: progress.step(2 * n + int(share * n), 3 * n, "frames on the shape"),
        )  # fmt: skip
        out += [_filled_in(scene, replace(known, poses=path), config, Silent())[0]] if np.isfinite(path).any() else []
    return out, rejected


def _through_flights(
    scene: Scene, first: int, best: Hypothesis, others: list[Hypothesis], beam: BeamConfig, config: TrackConfig
) -> list[Hypothesis]:
    """What the beam makes of the flight solved as one, where that is none of the others."""
    n = len(scene.times_s)
    found = [anchored_to(h, best, first) for h in flights_followed(scene, first, best, others, beam, config.flight)]
    return [
        h
        for h in found
        if np.isfinite(h.poses[first, 0, 0])
        and all(apart_deg(h.poses[:n], s.poses[:n]) > config.separate_deg for s in others)
    ]


def _starts(scene: Scene, first: int, known: _Known, config: TrackConfig) -> tuple[list[Hypothesis], BeamConfig]:
    """The hypotheses that tracking starts from, and how many are carried."""
    n = len(scene.times_s)
    if known.model is None:
        pose = first_pose(scene.store, first) if known.start is None else known.start
        return [started(n, first, pose)], config.beam
    if known.start is not None:
        return [with_model(started(n, first, known.start), known.model)], config.beam
    found = located(scene, first, known.model, config.beam, config.shape)
    if not found:
        raise BadInput("the given shape fits nothing that the first frame shows; is it a shape of this object?")
    beam = [replace(with_model(started(n, first, c.pose), known.model), total=c.fit) for c in found]
    return beam, replace(config.beam, width=max(config.beam.width, config.shape.starts))


def _filled_in(
    scene: Scene, known: _Known, config: TrackConfig, progress: Progress
) -> tuple[Hypothesis, dict[int, list[Candidate]]]:
    """The given poses as one hypothesis; usable frames without one are sought from the known frames around them."""
    assert known.poses is not None
    n = len(scene.times_s)
    given = [i for i in range(n) if scene.store.usable(i) and np.isfinite(known.poses[i]).all()]
    poses = np.full((n, 4, 4), np.nan)
    poses[given] = known.poses[given]
    h = Hypothesis(poses, np.full(n, np.nan), np.full(n, np.nan), tuple(given), (given[0],), 0.0)
    if known.model is not None:
        h = with_model(h, known.model)
    h = replace(h, keyframes=extended(h.keyframes, h.poses, given, config.beam.keyframes))
    rejected: dict[int, list[Candidate]] = {}
    for i in range(n):
        if i in given or not scene.store.usable(i):
            continue
        posed = np.flatnonzero(np.isfinite(h.poses[:n, 0, 0]))
        around = posed[posed < i] if (posed < i).any() else posed[::-1]
        h, of_this = follow(scene, np.array([i]), [replace(h, done=tuple(int(j) for j in around))], config.beam)
        rejected |= of_this
        progress.step(n + i, 3 * n, "frames without a pose")
    return replace(h, done=tuple(range(n))), rejected


def _as_track(
    scene: Scene, hypotheses: list[TrajectoryHypothesis], first: int,
    rejected: dict[int, list[Candidate]], config: TrackConfig, toss: int, camera: str, object_frame: str,
    times_ns: Int64[Array, " n"],
) -> TossTrack:  # fmt: skip
    """The best hypothesis with honest flags."""
    n, best = len(scene.times_s), hypotheses[0]
    joint = best.joint
    cost, on = (figure[:n] for figure in per_view(joint.pairs, joint.figures, len(scene.store)))
    lost = ~best.use | (cost > config.flags.tracked_cost)
    lost[first] &= not best.fixed[first]
    twists = config.flags.correlated * joint.covariance[:n]
    if best.azimuths is not None:
        twists = twists + best.azimuths.covariance
    for other in hypotheses[1:]:
        apart = other.total - best.total
        twists = twists + uncertainty(joint.poses[:n], other.joint.poses[:n], apart, config.flags)
    twists = twists + unknown_motion(scene, joint.poses[:n], best.use)
    hanging = unjoined(joint.pairs, joint.figures, (first, *range(n, len(scene.store))), best.use & ~lost, config.flags)
    slipped = contradicting(
        scene.store, joint.poses[:n], first, best.use & ~lost, joint.pairs, joint.figures, config.flags
    )
    twists = twists + unjoined_uncertainty(hanging | slipped, best.center_m, config.flags)
    poses, status, covariance = flagged(joint.poses[:n], twists, lost, scene, config.flags)
    track = ObjectTrack(toss, camera, object_frame, times_ns, poses, status, covariance)
    keyframes = tuple(i for i in sorted(best.estimated.keyframes) if i < n and not lost[i])
    pairs = joint.pairs[(joint.pairs < n).all(1)]
    own = own_cost(scene, best, config.hypotheses)
    return TossTrack(track, cost, on, keyframes, pairs, rejected, best.center_m, scene.store,
                     scene.features, best.held, own, best.axis is not None)  # fmt: skip
