"""What the D455 itself saw of the object's tags, where the mono cameras leave its pose open.

Next to an impact the pose at a colour frame lies between two triggers and between two motions: how it got from one to
the other is not known, and half a frame is worth millimetres and degrees. The colour image was exposed at just that
instant. Its tags are one camera's: coarser than three cameras' at their own instants, but far finer than a guess
through an impact. Where the pose is well known (flight, hand, rest), the same images tell the place of the D455, by how
much edges appear short, and the noise of its corners; nothing else of these frames is used, and their poses stay.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from calibration.tags.detect import TagDetection, detect_tags
from groundtruth import se3
from groundtruth.session_solve import Solved
from groundtruth.toss_truth import MOMENT_S, TossTruth, TrackedLimits, statuses
from recordings.estimation.levenberg_marquardt import Expansion, minimised
from recordings.estimation.robust import huber_cost, huber_weight
from recordings.geometry import CameraModel
from recordings.mcap.codec import decode_image
from recordings.progress import Progress
from recordings.session import Session

CAMERA = "d455"
STEPS, LEAST_GAIN = 12, 1e-8
NOISE_ROUNDS = 4
"""How often the noise is measured again on what is left at the place that it led to."""
NEAREST_M = 0.05
"""A corner nearer to the camera was never seen."""
CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Of a tag of size 1 in pupil-apriltags' frame and order."""


@dataclass(frozen=True)
class D455RefinementConfig:
    family: str = "tag36h11"
    sure_frames: int = 12
    """Frames of a toss whose pose is well known that are looked at, spread over it."""
    open_m: float = 0.0008
    open_rad: float = 0.008
    """An open pose is at least so uncertain (per axis), whatever the interpolation says."""
    place_m: float = 0.002
    place_rad: float = 0.002
    """How far the D455 may stand from its place in the calibration (standard deviations)."""
    short_px: float = 0.5
    """How far edges may appear short (standard deviation)."""
    late_s: float = 0.02
    """How far the mono cameras' stamps may be off (standard deviation)."""
    flip_rad: float = 0.15
    """Where the turn is less sure than this, a single tag, with its two solutions, does not do."""
    least_tags: int = 12
    """Detections at known poses below which nothing can be said of this camera."""
    huber: float = 2.0
    too_far: float = 5.0
    """A frame whose corners stay off by this many standard deviations (median) is left as it was;"""
    too_strange: float = 8.0
    """so is one that would move by so many standard deviations of what was thought before."""


@dataclass(frozen=True, eq=False)
class D455Refinement:
    """`off_m`, `off_rad`: how far the D455 stands from its place in the calibration. `corner_px`: median distance of
    its corners from where the mono cameras' poses put them, where those are sure. `offset_s`: what is to be added to
    the mono cameras' stamps so that the poses of moving frames meet the D455's view, and its standard deviation."""

    tosses: Mapping[int, TossTruth]
    off_m: float
    off_rad: float
    corner_px: float
    detections: int
    offset_s: float
    offset_std_s: float

    @property
    def frames(self) -> int:
        return int(sum(t.refined.sum() for t in self.tosses.values()))

    def document(self) -> dict[str, float | int]:
        return {
            "frames": self.frames,
            "corner_px": self.corner_px,
            "detections_at_sure_poses": self.detections,
            "camera_off_m": self.off_m,
            "camera_off_rad": self.off_rad,
            "mono_offset_ms": 1e3 * self.offset_s,
            "mono_offset_std_ms": 1e3 * self.offset_std_s,
        }


@dataclass(frozen=True, eq=False)
class ColorTags:
    """Tags in one colour frame: corners in the body (n, 3), pixels (n, 2), standard deviations (n,), and how a pixel
    moves when edges are lengthened by 1 px (n, 2)."""

    toss: int
    frame: int
    points_m: Float[Array, "n 3"]
    pixels: Float[Array, "n 2"]
    sigma_px: Float[Array, " n"]
    outwards: Float[Array, "n 2"]

    @property
    def tags(self) -> int:
        return len(self.points_m) // 4


@dataclass(frozen=True, eq=False)
class _Place:
    """The D455 as its detections at known poses have it."""

    camera_from_world: Float[Array, "4 4"]
    short_px: float
    noise: float
    late_s: float
    late_std_s: float


@dataclass(frozen=True, eq=False)
class _Free:
    """What is solved for: the camera, how short edges appear, how late the poses come."""

    camera: Float[Array, "4 4"]
    short_px: float
    late_s: float

    def moved(self, step: Float[Array, "8"]) -> _Free:
        camera = se3.exp(step[None, :6])[0] @ self.camera
        return _Free(camera, self.short_px + float(step[6]), self.late_s + float(step[7]))


def refine_by_d455(
    session: Session,
    truths: Mapping[int, TossTruth],
    solved: Solved,
    limits: TrackedLimits,
    config: D455RefinementConfig,
    progress: Progress,
) -> tuple[D455Refinement | None, int]:
    """Open poses corrected by what the D455 saw, None where nothing is open, or its place or tags are not known; and on
    how many of its images the tag detector died."""
    calibration = session.calibration
    wanted = {toss: _wanted(truth, config) for toss, truth in truths.items()}
    if CAMERA not in calibration.cameras or not any(t.open.any() for t in truths.values()):
        return None, 0
    model = calibration.cameras[CAMERA]
    world = calibration.find("world", model.frame)
    if world is None:
        return None, 0
    seen, lost = _detections(session, wanted, solved, config, progress)
    return by_detections(model, np.linalg.inv(world.matrix), seen, truths, limits, config), lost


def by_detections(
    model: CameraModel,
    camera_from_world: Float[Array, "4 4"],
    seen: Sequence[ColorTags],
    truths: Mapping[int, TossTruth],
    limits: TrackedLimits,
    config: D455RefinementConfig,
) -> D455Refinement | None:
    """Open poses corrected by these detections. None where too few of them are at poses that are sure."""
    sure = [s for s in seen if not truths[s.toss].open[s.frame]]
    if sum(s.tags for s in sure) < config.least_tags:
        return None
    place, left_px = _placed(model, camera_from_world, sure, truths, config)
    corrected = {}
    for toss, truth in truths.items():
        mine = [s for s in seen if s.toss == toss]
        corrected[toss] = _corrected(model, place, truth, mine, limits, config)
    off = se3.log((place.camera_from_world @ np.linalg.inv(camera_from_world))[None])[0]
    off_rad, off_m = (float(np.linalg.norm(part)) for part in np.split(off, 2))
    seen_at_sure = sum(s.tags for s in sure)
    return D455Refinement(corrected, off_m, off_rad, left_px, seen_at_sure, -place.late_s, place.late_std_s)


def _wanted(truth: TossTruth, config: D455RefinementConfig) -> list[int]:
    """Open frames, and some of the others."""
    placed = np.isfinite(truth.world_from_tagged).all(axis=(1, 2))
    sure = np.flatnonzero(placed & ~truth.open)
    some = sure[np.unique(np.linspace(0, len(sure) - 1, config.sure_frames).round().astype(int))] if len(sure) else sure
    return sorted({*np.flatnonzero(placed & truth.open).tolist(), *some.tolist()})


def _detections(
    session: Session, wanted: Mapping[int, list[int]], solved: Solved, config: D455RefinementConfig, progress: Progress
) -> tuple[list[ColorTags], int]:
    """The body's tags in the colour images of these frames, and on how many images the detector died."""
    total = sum(map(len, wanted.values()))
    lists = detect_tags(_images(session, wanted), config.family, None, progress, response="srgb", total=total)
    every = iter(lists)
    found = []
    for toss, frames in wanted.items():
        for frame in frames:
            tags = [t for t in next(every) if t.tag_id in solved.layout and t.refined]
            ids = [t.tag_id for t in tags]
            tags = [t for t in tags if ids.count(t.tag_id) == 1]
            if tags:
                found.append(color_tags(toss, frame, tags, solved.layout, solved.sizes_m))
    return found, len(lists.lost)


def _images(session: Session, wanted: Mapping[int, list[int]]) -> Iterator[UInt8[Array, "h w"]]:
    for toss, frames in wanted.items():
        color = session.toss(toss).color(CAMERA)
        for frame in frames:
            image: Array = decode_image(color[frame])
            yield cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image


def color_tags(
    toss: int,
    frame: int,
    tags: Sequence[TagDetection],
    layout: Mapping[int, Float[Array, "4 4"]],
    sizes_m: Mapping[int, float],
) -> ColorTags:
    """Detections of one colour image as corners in the body; `layout` is body_from_tag."""
    points, outwards = [], []
    for tag in tags:
        place = layout[tag.tag_id]
        points.append(sizes_m[tag.tag_id] * CORNERS @ place[:3, :3].T + place[:3, 3])
        corners = tag.corners_px
        edge = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean()
        outwards.append((corners - corners.mean(axis=0)) / edge)
    sigma = np.repeat([tag.sigma_px for tag in tags], 4)
    pixels = np.concatenate([tag.corners_px for tag in tags])
    return ColorTags(toss, frame, np.concatenate(points), pixels, np.hypot(sigma, 0.05), np.concatenate(outwards))


def _placed(
    model: CameraModel,
    known: Float[Array, "4 4"],
    sure: list[ColorTags],
    truths: Mapping[int, TossTruth],
    config: D455RefinementConfig,
) -> tuple[_Place, float]:
    """The camera's place (a twist on its left), how short edges appear, how late the poses come, and the noise against
    what is stated: robust least squares over all corners at poses that are sure. Also the median distance left."""
    now = [truths[s.toss].world_from_tagged[s.frame] for s in sure]
    then = [truths[s.toss].soon[s.frame] for s in sure]
    world, soon = (
        np.concatenate([s.points_m @ p[:3, :3].T + p[:3, 3] for s, p in zip(sure, poses)]) for poses in (now, then)
    )
    speed = np.nan_to_num((soon - world) / MOMENT_S)
    pixels, outwards = (np.concatenate([getattr(s, name) for s in sure]) for name in ("pixels", "outwards"))
    sigma = np.concatenate([s.sigma_px for s in sure])
    prior = np.diag(np.array([config.place_rad] * 3 + [config.place_m] * 3 + [config.short_px, config.late_s]) ** -2.0)

    def left(at: _Free) -> tuple[Array, Array]:
        """Corners in the camera, and how far they are from where they were seen (px)."""
        inside = (world + at.late_s * speed) @ at.camera[:3, :3].T + at.camera[:3, 3]
        return inside, model.project(inside) - pixels - at.short_px * outwards

    def expanded(at: _Free) -> Expansion:
        inside, residual = left(at)
        size = np.linalg.norm(residual, axis=1) / (sigma * noise)
        root = np.sqrt(huber_weight(size, config.huber)) / (sigma * noise)
        arm = np.concatenate([-se3.skew(inside), np.broadcast_to(np.eye(3), (len(inside), 3, 3))], -1)
        by_point = _by_point(model, inside)
        by_time = by_point @ (speed @ at.camera[:3, :3].T)[..., None]
        J = np.concatenate([by_point @ arm, -outwards[..., None], by_time], -1)
        cost = float(huber_cost(size, config.huber).sum())
        seen = Expansion.of_residuals(residual * root[:, None], J * root[:, None, None], cost)
        off = se3.log((at.camera @ np.linalg.inv(known))[None])[0]
        return seen.with_prior(prior, np.concatenate([off, [at.short_px, at.late_s]]))

    at = _Free(known, 0.0, 0.0)
    for _ in range(NOISE_ROUNDS):
        size = np.linalg.norm(left(at)[1], axis=1) / sigma
        noise = max(1.0, float(np.median(size)) / 1.177)  # the median of a two-dimensional normal's length
        found = minimised(at, expanded, _Free.moved, STEPS, LEAST_GAIN)
        at = found.state
    late_std_s = float(np.sqrt(np.linalg.inv(found.at.information)[7, 7]))
    return _Place(at.camera, at.short_px, noise, at.late_s, late_std_s), float(
        np.median(np.linalg.norm(left(at)[1], axis=1))
    )


def _by_point(model: CameraModel, points: Float[Array, "n 3"]) -> Float[Array, "n 2 3"]:
    h = 1e-6 * np.maximum(points[:, 2:], 0.05)
    columns = [(model.project(points + h * axis) - model.project(points - h * axis)) / (2 * h) for axis in np.eye(3)]
    return np.stack(columns, axis=-1)


def _corrected(
    model: CameraModel,
    place: _Place,
    truth: TossTruth,
    seen: list[ColorTags],
    limits: TrackedLimits,
    config: D455RefinementConfig,
) -> TossTruth:
    """Every open frame that the D455 saw tags in: its pose and covariance with them."""
    poses, covariance = truth.world_from_tagged.copy(), truth.covariance.copy()
    refined = np.zeros(len(poses), dtype=bool)
    floor = np.diag([config.open_rad**2] * 3 + [config.open_m**2] * 3)
    for s in seen:
        if not truth.open[s.frame]:
            continue
        answer = _fused(model, place, s, poses[s.frame], covariance[s.frame] + floor, config)
        if answer is not None:
            poses[s.frame], covariance[s.frame] = answer
            refined[s.frame] = True
    return replace(
        truth,
        world_from_tagged=poses,
        covariance=covariance,
        status=statuses(covariance, limits),
        refined=refined,
    )


def _fused(
    model: CameraModel,
    place: _Place,
    seen: ColorTags,
    pose: Float[Array, "4 4"],
    covariance: Float[Array, "6 6"],
    config: D455RefinementConfig,
) -> tuple[Float[Array, "4 4"], Float[Array, "6 6"]] | None:
    """The pose that agrees with the corners and with where it was thought to be; the posterior's covariance.

    Unknown are a turn about the body's origin and a shift, both in the world: X = p + d + exp(w) R x.
    """
    if seen.tags < 2 and np.sqrt(np.trace(covariance[:3, :3])) > config.flip_rad:
        return None
    prior, sigma = np.linalg.inv(covariance), seen.sigma_px * place.noise
    pixels = seen.pixels + place.short_px * seen.outwards

    def left(at: Array) -> tuple[Array, Array, Array]:
        """Corners about the body's origin (world axes) and in the camera, and how far they are from where they were
        seen, in standard deviations."""
        arm = seen.points_m @ at[:3, :3].T
        inside = (arm + at[:3, 3]) @ place.camera_from_world[:3, :3].T + place.camera_from_world[:3, 3]
        return arm, inside, (model.project(inside) - pixels) / sigma[:, None]

    def off(at: Array) -> Array:
        return np.concatenate([se3.log(se3.rotations(at[:3, :3] @ pose[:3, :3].T)[None])[0, :3], (at - pose)[:3, 3]])

    def expanded(at: Array) -> Expansion:
        arm, inside, residual = left(at)
        size = np.linalg.norm(residual, axis=1)
        root = np.sqrt(huber_weight(size, config.huber))[:, None]
        by_pose = np.concatenate([-se3.skew(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], -1)
        J = _by_point(model, inside) @ place.camera_from_world[:3, :3] @ by_pose
        cost = float(huber_cost(size, config.huber).sum()) if (inside[:, 2] > NEAREST_M).all() else np.inf
        found = Expansion.of_residuals(residual * root, J * (root / sigma[:, None])[..., None], cost)
        return found.with_prior(prior, off(at))

    def moved(at: Array, step: Array) -> Array:
        out = se3.exp(np.concatenate([step[:3], np.zeros(3)])[None])[0]
        out[:3, :3], out[:3, 3] = out[:3, :3] @ at[:3, :3], at[:3, 3] + step[3:]
        return out

    if (left(pose)[1][:, 2] < NEAREST_M).any():
        return None
    found = minimised(pose, expanded, moved, STEPS, LEAST_GAIN)
    total, far = off(found.state), np.median(np.linalg.norm(left(found.state)[2], axis=1))
    if far > config.too_far or total @ prior @ total > config.too_strange**2:
        return None
    return found.state, np.linalg.inv(found.at.information)
