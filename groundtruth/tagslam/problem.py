"""From a TagSLAM configuration and a recording to the unknown poses and what was seen of them.

Every pose has a key: ("camera", name), ("tag", id), ("body", name, stamp) with stamp 0 for a static body, and
("eye", name, stamp) for a camera that may wiggle on its rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth.factors import CORNERS
from groundtruth.tagslam.config import BodyEntry, CameraEntry, TagEntry, TagSlamConfig
from groundtruth.tagslam.detections import DetectedTag, Recording
from groundtruth.tagslam.synchronise import StampSet, approximate_sets, exact_sets
from recordings.errors import BadInput
from recordings.geometry import CameraModel

Key = tuple[str, str, int]


def tag_key(tag_id: int) -> Key:
    return ("tag", str(tag_id), 0)


def camera_key(name: str) -> Key:
    return ("camera", name, 0)


def body_key(body: BodyEntry, stamp_ns: int) -> Key:
    return ("body", body.name, 0 if body.is_static else stamp_ns)


@dataclass(frozen=True, eq=False)
class Observation:
    """One tag in one image. `candidates` (k, 4, 4): camera_from_tag of the planar solutions, the better one first;
    `errors_px`: their mean corner distances."""

    stamp_ns: int
    camera: int
    rig: BodyEntry
    body: BodyEntry
    tag: TagEntry
    corners_px: Float[Array, "4 2"]
    candidates: Float[Array, "k 4 4"]
    errors_px: Float[Array, " k"]
    area_px2: float
    sigma_px: float | None = None
    """Of a corner's coordinate, where the detector tells; None: the configuration's `pixel_noise`."""

    @property
    def rig_key(self) -> Key:
        return body_key(self.rig, self.stamp_ns)

    @property
    def body_key(self) -> Key:
        return body_key(self.body, self.stamp_ns)


@dataclass(frozen=True, eq=False)
class Problem:
    """`stamps`: where TagSLAM answers: all topics have a message, and a tag is seen or odometry is there.
    `odometry[body][stamp]`: the odometry's pose."""

    config: TagSlamConfig
    stamps: tuple[int, ...]
    observations: tuple[Observation, ...]
    tags: dict[int, TagEntry]
    owner: dict[int, BodyEntry]
    odometry: Mapping[str, Mapping[int, Float[Array, "4 4"]]]
    ignored: int


def make_problem(config: TagSlamConfig, recording: Recording, most_frames: int | None = None) -> Problem:
    """Match topics to cameras, apply squashes and remaps, solve each tag's two planar poses.

    `most_frames`: only so many stamps. Raises BadInput where a camera's topic is not in the recording.
    """
    for camera in config.cameras:
        config.body(camera.rig)
        if camera.tag_topic not in recording.frames:
            raise BadInput(
                f"no detections on {camera.tag_topic} of {camera.name}; the recording has {sorted(recording.frames)}"
            )
    sets = _synchronised(config, recording)
    collector = _Collector(config, recording)
    odometry: dict[str, dict[int, Float[Array, "4 4"]]] = {
        b.name: {} for b in config.bodies if b.odom_topic in recording.odometry
    }
    always = bool(odometry) or any(b.fake_odom_noise for b in config.bodies)
    answered = []
    for stamps in sets[:most_frames]:
        stamp = stamps[config.cameras[0].tag_topic]
        for body in config.bodies:
            if body.name in odometry and body.odom_topic is not None:
                odometry[body.name][stamp] = recording.odometry_at(body.odom_topic, stamps[body.odom_topic])
        if collector.collect(stamp, stamps) or always:
            answered.append(stamp)
    return Problem(
        config,
        tuple(answered),
        collector.observed(),
        collector.tags,
        collector.owner,
        odometry,
        collector.ignored,
    )


def _synchronised(config: TagSlamConfig, recording: Recording) -> list[StampSet]:
    """Sets of stamps, one of each camera's topic and each odometry's."""
    stamps: dict[str, list[int]] = {c.tag_topic: sorted(recording.frames[c.tag_topic]) for c in config.cameras}
    for body in config.bodies:
        if body.odom_topic is not None and body.odom_topic in recording.odometry:
            stamps[body.odom_topic] = [int(s) for s in recording.odometry[body.odom_topic][0]]
    return approximate_sets(stamps) if config.approximate_sync else exact_sets(stamps)


class _Collector:
    """Turns detections into observations; tags that the configuration does not place go to the default body."""

    def __init__(self, config: TagSlamConfig, recording: Recording) -> None:
        self.config = config
        self.recording = recording
        self.observations: list[Observation] = []
        self.ignored = 0
        self.tags, self.owner = _tags(config)

    def collect(self, stamp_ns: int, stamps: StampSet) -> bool:
        """Add what all cameras saw; whether there was any tag."""
        before = len(self.observations)
        for number, camera in enumerate(self.config.cameras):
            seen_here: set[int] = set()
            for detected in self.recording.frames[camera.tag_topic][stamps[camera.tag_topic]]:
                observation = self._observe(stamp_ns, number, camera, detected, seen_here)
                if observation is None:
                    self.ignored += 1
                else:
                    seen_here.add(observation.tag.tag_id)
                    self.observations.append(observation)
        return len(self.observations) > before

    def _observe(
        self, stamp_ns: int, number: int, camera: CameraEntry, detected: DetectedTag, seen: set[int]
    ) -> Observation | None:
        config = self.config
        if detected.hamming > config.max_hamming or _squashed(config, detected.tag_id, camera, stamp_ns):
            return None
        tag_id = _remapped(config, detected.tag_id, camera, stamp_ns)
        body = self.owner.get(tag_id) or _adopt(config, tag_id, self.tags, self.owner)
        area = _area_px2(detected.corners_px)
        if body is None or tag_id in seen:
            return None
        tag, rig = self.tags[tag_id], config.body(camera.rig)
        return Observation(stamp_ns, number, rig, body, tag, detected.corners_px, *NOT_YET, area)

    def observed(self) -> tuple[Observation, ...]:
        """All observations with their planar solutions. What is seen too flat or too small has none to start from; its
        corners still count (TagSLAM sets small tags aside, and takes them up once the poses round them are there)."""
        flat = np.radians(self.config.minimum_viewing_deg)
        out = list(self.observations)
        for number, camera in enumerate(self.config.cameras):
            mine = [i for i, o in enumerate(out) if o.camera == number]
            sizes = np.array([out[i].tag.size_m for i in mine])
            corners = np.array([out[i].corners_px for i in mine]).reshape(-1, 4, 2)
            for i, (poses, errors) in zip(mine, planar_poses(camera.model, sizes, corners), strict=True):
                small = 2 * out[i].area_px2 < self.config.minimum_tag_area_px2
                keep = len(poses) if len(poses) and not small and _view_angle_rad(poses[0]) >= flat else 0
                out[i] = replace(out[i], candidates=poses[:keep], errors_px=errors[:keep])
        return tuple(out)


def unambiguous(config: TagSlamConfig, o: Observation) -> bool:
    """Whether TagSLAM would start a pose from this detection: from the front, or one solution is clearly better."""
    if len(o.candidates) == 0:
        return False
    if len(o.errors_px) < 2 or _view_angle_rad(o.candidates[0]) >= np.radians(config.ambiguous_deg):
        return True
    return bool(o.errors_px[0] ** 2 <= config.most_ambiguous * o.errors_px[1] ** 2)


NOT_YET = (np.zeros((0, 4, 4)), np.zeros(0))


def _squashed(config: TagSlamConfig, tag_id: int, camera: CameraEntry, stamp_ns: int) -> bool:
    return any(
        tag_id in s.tags and s.stamp_ns in (None, stamp_ns) and s.camera in (None, camera.name) for s in config.squashes
    )


def _view_angle_rad(camera_from_tag: Float[Array, "4 4"]) -> float:
    """Between the tag's plane and the ray to its centre: pi/2 is seen from the front."""
    ray = camera_from_tag[:3, 3] / max(float(np.linalg.norm(camera_from_tag[:3, 3])), 1e-9)
    return float(np.arcsin(np.clip(abs(ray @ camera_from_tag[:3, 2]), 0.0, 1.0)))


def _area_px2(corners_px: Float[Array, "4 2"]) -> float:
    (ax, ay), (bx, by) = corners_px[2] - corners_px[0], corners_px[3] - corners_px[1]
    return 0.5 * abs(float(ax * by - ay * bx))


def _tags(config: TagSlamConfig) -> tuple[dict[int, TagEntry], dict[int, BodyEntry]]:
    tags = {t: entry for body in config.bodies for t, entry in body.tags.items()}
    owner = {t: body for body in config.bodies for t in body.tags}
    return tags, owner


def _adopt(
    config: TagSlamConfig, tag_id: int, tags: dict[int, TagEntry], owner: dict[int, BodyEntry]
) -> BodyEntry | None:
    """A tag that the configuration does not place belongs to the default body, at a pose to be found."""
    if config.default_body is None:
        return None
    body = config.body(config.default_body)
    if tag_id in body.ignored or body.default_tag_size_m <= 0:
        return None
    tags[tag_id] = TagEntry(tag_id, body.default_tag_size_m, None)
    owner[tag_id] = body
    return body


def _remapped(config: TagSlamConfig, tag_id: int, camera: CameraEntry, stamp_ns: int) -> int:
    for remap in reversed(config.remaps):
        named = remap.camera is None or remap.camera == camera.name
        if remap.tag_id == tag_id and named and remap.start_ns <= stamp_ns <= remap.end_ns:
            return remap.becomes
    return tag_id


def planar_poses(
    camera: CameraModel, sizes_m: Float[Array, " n"], corners_px: Float[Array, "n 4 2"]
) -> list[tuple[Float[Array, "k 4 4"], Float[Array, " k"]]]:
    """camera_from_tag of single tags: the two solutions of the planar problem (Collins and Bartoli 2014) and their mean
    corner errors in pixels, the better one first."""
    ideal = camera.rays(corners_px)[..., :2]
    found = [_two_poses(size, xy) for size, xy in zip(sizes_m, ideal, strict=True)]
    owner = np.repeat(np.arange(len(found)), [len(f) for f in found])
    poses = np.array([pose for f in found for pose in f]).reshape(-1, 4, 4)
    points = sizes_m[owner, None, None] * CORNERS @ np.swapaxes(poses[:, :3, :3], -1, -2) + poses[:, None, :3, 3]
    errors = np.linalg.norm(camera.project(points) - corners_px[owner], axis=-1).mean(axis=-1)
    out = []
    for i in range(len(found)):
        mine = np.arange(*np.searchsorted(owner, [i, i + 1]))
        mine = mine[np.argsort(errors[mine])]
        out.append((poses[mine], errors[mine]))
    return out


def _two_poses(size_m: float, ideal: Float[Array, "4 2"]) -> list[Float[Array, "4 4"]]:
    if not np.isfinite(ideal).all():
        return []
    # OpenCV wants the corners from (-,+) clockwise
    order = [3, 2, 1, 0]
    found = cv2.solvePnPGeneric(
        size_m * CORNERS[order], np.ascontiguousarray(ideal[order]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    poses = []
    for turn, shift in zip(found[1], found[2], strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        if np.isfinite(pose).all() and ((size_m * CORNERS @ pose[:3, :3].T + pose[:3, 3])[:, 2] > 1e-3).all():
            poses.append(pose)
    return poses
