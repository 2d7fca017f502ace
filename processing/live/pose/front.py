"""The pose of a known shape in one frame after the other, each from the frames before it alone.

The frame's foreground near where the object is expected becomes a view (`sensor/view.py`), which is aligned to the
shape drawn from all sides and to the last view by the tracker's own kernels (depth, appearance, silhouette). Two
hypotheses are carried where the shape looks alike from two sides. What is lost is sought anew over all orientations.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.features.sift import Sift
from processing.motion.interpolate import turn_between
from processing.motion.motion_prior import gravity_in_camera
from processing.segment.background.foreground import ForegroundSettings, moved_pixels
from processing.segment.background.static_scene import StaticScene
from processing.sensor import view_layout as lay
from processing.sensor.frames import corrected_depth
from processing.sensor.noise import TRACK_COVARIANCE_SCALE, stereo_sigma_m
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig, cut
from processing.sensor.view_store import ViewStore
from processing.track.beam import BeamConfig, Hypothesis, Scene, follow
from processing.track.known_shape import ShapeConfig, center_of, located, shape_views
from recordings.geometry import CameraModel, Transform, skew
from recordings.records import RgbdFrame
from recordings.tracks import ObjectShape, Status

MEASUREMENTS, SIDEWAYS = 40.0, 0.05
"""So many samples of a view count as independent; outline and appearance hold it sideways with this share of them, to a
pixel."""
SLOTS = 3
"""Frames that are kept: two before the one that is looked at tell its motion."""


@dataclass(frozen=True)
class FrontConfig:
    """How a frame is looked at within its time."""

    beam: BeamConfig = field(
        default_factory=lambda: BeamConfig(
            width=2,
            branches=2,
            coarse=((1, 4, 0.012, 0.5, 0.010, 0.15),),
            fine=((0, 4, 0.004, 0.4, 0.006, 0.4), (0, 3, 0.0025, 0.3, 0.005, 0.6)),
            uncertain_cost=float("inf"),
            search=float("inf"),
            lost=0.25,
        )
    )
    """No feature matches and no search within a frame's time."""
    seek: ShapeConfig = field(default_factory=lambda: ShapeConfig(turns=240, tried=16, starts=8))
    foreground: ForegroundSettings = field(default_factory=ForegroundSettings)
    view: ViewConfig = field(default_factory=ViewConfig)
    reach: float = 0.75
    """The object is looked for within so many of its diagonals around where it is expected."""
    least_share: float = 0.25
    """A thing is taken for the object where it covers so much of what the object would, at its distance, at least
    ..."""
    most_share: float = 2.5
    """... and no more than so much."""
    lost_frames: int = 2
    """After so many frames without a pose the object is sought anew."""
    unsure: float = 0.02
    """A second hypothesis that costs less more than this makes the pose unsure."""


@dataclass(frozen=True, eq=False)
class LivePose:
    """One frame's pose (None: lost). `covariance`: of the rotation vector (camera axes) and of the object's origin, as
    in StampedPose; `other`: the second hypothesis, where one is left."""

    frame: int
    time_ns: int
    camera_from_object: Float[Array, "4 4"] | None
    covariance: Float[Array, "6 6"]
    status: Status
    cost: float
    other: Float[Array, "4 4"] | None = None


class PoseFront:
    """What is known between frames. `see` one frame after the other, in time order; some may be missing."""

    def __init__(
        self, camera: CameraModel, shape: ObjectShape, background: StaticScene, world_from_camera: Transform | None,
        config: FrontConfig | None = None, depth_scale: float = 1.0,
    ) -> None:  # fmt: skip
        self._config, self._background, self._scale = config or FrontConfig(), background, depth_scale
        self._rectified = Rectification.of(camera)
        self._camera_from_world = None if world_from_camera is None else world_from_camera.inverse().matrix
        self._size_m = float(np.linalg.norm(np.ptp(shape.vertices_m, axis=0)))
        self._focal = float(camera.K[0, 0])
        drawn = shape_views(shape, [], self._rectified, self._config.seek)
        room = _largest_crop(camera, self._config.view)
        store = ViewStore(self._rectified, [*([room] * SLOTS), *drawn.crops], self._config.view)
        for i in range(SLOTS, len(store)):
            store.fill(i)
        self._drawn = drawn
        gravity = gravity_in_camera(None if world_from_camera is None else world_from_camera.matrix)
        self._scene = Scene(store, np.zeros(SLOTS), gravity, center_of(shape), Sift())
        self._beam: list[Hypothesis] = []
        self._slot, self._without = 0, 0
        self._keyframes = tuple(range(SLOTS, len(store)))

    @property
    def tracking(self) -> bool:
        """Whether a pose is carried from frame to frame."""
        return bool(self._beam)

    def see(self, frame: RgbdFrame) -> LivePose:
        """The pose in this frame (depth as reported), from it and those before it."""
        time_s = frame.time_ns * 1e-9
        crop = self._crop(frame, time_s)
        if crop is None:
            return self._missed(frame)
        self._slot = (self._slot + 1) % SLOTS
        slot = self._slot
        self._scene.store.crops[slot] = replace(crop, position=slot)
        self._scene.times_s[slot] = time_s
        self._scene.forget(slot)
        if not self._scene.store.fill(slot):
            return self._missed(frame)
        if not self._beam:
            return self._sought(frame, slot)
        beam = [_without(h, slot) for h in self._beam]
        grown = _beam_of(self._scene, slot, beam, self._config.beam)
        best = [h for h in grown if np.isfinite(h.poses[slot, 0, 0])]
        if not best:
            return self._missed(frame)
        self._without = 0
        self._beam = [replace(h, keyframes=self._keyframes, total=h.total - best[0].total) for h in best]
        return self._pose(frame, slot)

    def _crop(self, frame: RgbdFrame, time_s: float) -> Crop | None:
        mask = self._mask(frame, self._expected_m(time_s))
        if mask is None:
            return None
        metric = replace(frame, depth_m=corrected_depth(frame.depth_m, self._scale))
        crop = cut(metric, mask, 0, self._rectified, 1.0, self._config.view, self._camera_from_world)
        room = self._scene.store.crops[self._slot]
        return None if crop is None or room is None or crop.mask.size > self._room_px() else crop

    def _room_px(self) -> int:
        table = self._scene.store.table
        return int(table[1, lay.OFFSET] - table[0, lay.OFFSET])

    def _expected_m(self, time_s: float) -> Float[Array, "3"] | None:
        """Where the object's center is expected, by its last two poses; None where it is lost."""
        if not self._beam:
            return None
        h = self._beam[0]
        at = [h.poses[i, :3, :3] @ self._scene.center_m + h.poses[i, :3, 3] for i in h.tracked[-2:]]
        if len(at) < 2:
            return np.asarray(at[-1])
        a, b = (self._scene.times_s[i] for i in h.tracked[-2:])
        return np.asarray(at[-1] + (at[-1] - at[-2]) / max(b - a, 1e-3) * min(time_s - b, 0.1))

    def _mask(self, frame: RgbdFrame, expected_m: Float[Array, "3"] | None) -> Bool[Array, "h w"] | None:
        """What is new before the scene: near where the object is expected, else whatever has its size."""
        found = np.zeros(frame.depth_m.shape, dtype=bool)
        if expected_m is None:
            at = np.s_[:, :]
        else:
            u, v = self._pixel(expected_m)
            r = round(self._config.reach * self._size_m * self._focal / expected_m[2])
            at = np.s_[max(v - r, 0) : max(v + r, 0), max(u - r, 0) : max(u + r, 0)]
        color, depth_m = np.ascontiguousarray(frame.color_rgb[at]), np.ascontiguousarray(frame.depth_m[at])
        part = replace(frame, color_rgb=color, depth_m=depth_m)
        if part.depth_m.size < 100:
            return None
        scene = StaticScene(**{name: np.ascontiguousarray(value[at]) for name, value in vars(self._background).items()})
        moved = moved_pixels(part, scene, self._config.foreground)
        count, labels, about, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8))
        best = 0
        for label in range(1, count):
            if about[label, cv2.CC_STAT_AREA] > (about[best, cv2.CC_STAT_AREA] if best else 0) and self._fits(
                labels == label, part.depth_m
            ):
                best = label
        if not best:
            return None
        found[at] = labels == best
        return found

    def _pixel(self, point_m: Float[Array, "3"]) -> tuple[int, int]:
        u, v = point_m[:2] / point_m[2] * self._rectified.focal + self._rectified.center
        return round(float(u)), round(float(v))

    def _fits(self, thing: Bool[Array, "h w"], depth_m: Array) -> bool:
        """Whether a thing covers as much as the object would at its distance."""
        seen = depth_m[thing & (depth_m > 0)]
        if len(seen) < self._config.view.least_samples:
            return False
        expected_px = (0.6 * self._size_m * self._focal / float(np.median(seen))) ** 2
        return bool(self._config.least_share < thing.sum() / expected_px < self._config.most_share)

    def _sought(self, frame: RgbdFrame, slot: int) -> LivePose:
        """All orientations; the best two that differ are carried on."""
        starts = located(self._scene, slot, self._drawn, self._config.beam, self._config.seek)
        if not starts or starts[0].fit > self._config.beam.lost:
            return self._missed(frame)
        self._beam = []
        for start in starts[: self._config.beam.width]:
            poses = np.concatenate([np.full((SLOTS, 4, 4), np.nan), self._drawn.poses])
            poses[slot] = start.pose
            costs, on = np.full(SLOTS, np.nan), np.full(SLOTS, np.nan)
            costs[slot], on[slot] = start.fit, start.on_surface
            self._beam.append(Hypothesis(poses, costs, on, (slot,), self._keyframes, start.fit - starts[0].fit))
        self._without = 0
        return self._pose(frame, slot)

    def _missed(self, frame: RgbdFrame) -> LivePose:
        self._without += 1
        if self._without >= self._config.lost_frames:
            self._beam = []
        nothing = np.full((6, 6), np.nan)
        return LivePose(frame.index, frame.time_ns, None, nothing, "lost", float("nan"))

    def _pose(self, frame: RgbdFrame, slot: int) -> LivePose:
        best, *others = self._beam
        other = next((h for h in others if h.total < self._config.unsure), None)
        covariance = self._covariance(best, slot)
        status: Status = "tracked"
        if other is not None:
            turn = turn_between(best.poses[slot], other.poses[slot])
            turned = best.poses[slot, :3, :3] @ turn
            covariance[:3, :3] += 0.25 * np.outer(turned, turned)
            status = "interpolated"
        return LivePose(frame.index, frame.time_ns, best.poses[slot].copy(), covariance, status,
                        float(best.costs[slot]), None if other is None else other.poses[slot].copy())  # fmt: skip

    def _covariance(self, h: Hypothesis, slot: int) -> Float[Array, "6 6"]:
        """From the view's own samples: depth noise along their normals, outlines and appearance as good as a pixel; a
        view's samples share their noise (`TRACK_COVARIANCE_SCALE`)."""
        row = self._scene.store.table[slot]
        samples = self._scene.store.samples[row[lay.FIRST] : row[lay.FIRST] + row[lay.COUNT]].astype(np.float64)
        center = h.poses[slot, :3, :3] @ self._scene.center_m + h.poses[slot, :3, 3]
        points, normals = samples[:, :3], samples[:, 3:6]
        sigma = stereo_sigma_m(points[:, 2].astype(np.float32)).astype(np.float64)
        depth = np.concatenate([np.cross(points - center, normals), normals], 1) / sigma[:, None]
        pixel = float(np.median(points[:, 2])) / self._focal
        side = np.zeros((2 * len(points), 6))
        for k in range(2):
            axis = np.eye(3)[k]
            side[k::2] = np.concatenate([np.cross(points - center, axis), np.tile(axis, (len(points), 1))], 1) / pixel
        information = (depth.T @ depth + SIDEWAYS * side.T @ side) / max(len(points) / MEASUREMENTS, 1.0)
        about_center = TRACK_COVARIANCE_SCALE * np.linalg.inv(information + 1e-3 * np.eye(6))
        origin = np.eye(6)  # from (turn, shift of the center) to (turn, shift of the origin)
        origin[3:, :3] = -skew(h.poses[slot, :3, 3] - center)
        return np.asarray(origin @ about_center @ origin.T)


def _without(h: Hypothesis, slot: int) -> Hypothesis:
    """The hypothesis without the frame whose slot is used anew."""
    poses = h.poses.copy()
    poses[slot] = np.nan
    return replace(h, poses=poses, done=tuple(i for i in h.done if i != slot))


def _beam_of(scene: Scene, slot: int, beam: list[Hypothesis], config: BeamConfig) -> list[Hypothesis]:
    """All hypotheses after one more frame, best first."""
    grown: list[list[Hypothesis]] = []
    follow(scene, np.array([slot]), beam, config, lambda _, found: grown.append(found))
    return grown[-1] if grown else []


def _largest_crop(camera: CameraModel, view: ViewConfig) -> Crop:
    """Room for one frame's view: a quarter of the image."""
    shape = (camera.height // 2, camera.width // 2)
    none = np.zeros(shape, dtype=bool)
    return Crop(0, (0, 0), none, none.astype(np.float32), np.zeros((*shape, 3), dtype=np.float32), none, None, 0.0)
