"""From a TagSLAM configuration and a recording to the unknown poses and what was seen of them.

Every pose has a key: ("camera", name), ("tag", id), ("body", name, stamp) with stamp 0 for a static body, and
("eye", name, stamp) for a camera that may wiggle on its rig.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from groundtruth.detections import Recording
from groundtruth.factors import CORNERS
from groundtruth.tagslam_config import BodyEntry, CameraEntry, TagEntry, TagSlamConfig
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

    @property
    def rig_key(self) -> Key:
        return body_key(self.rig, self.stamp_ns)

    @property
    def body_key(self) -> Key:
        return body_key(self.body, self.stamp_ns)


@dataclass(frozen=True, eq=False)
class Problem:
    """`stamps`: where TagSLAM answers: all topics have a message, and a tag is seen or odometry is there."""

    config: TagSlamConfig
    stamps: tuple[int, ...]
    observations: tuple[Observation, ...]
    tags: dict[int, TagEntry]
    owner: dict[int, BodyEntry]
    ignored: int
    incomplete_stamps: int


def make_problem(config: TagSlamConfig, recording: Recording, most_frames: int | None = None) -> Problem:
    """Match topics to cameras, apply remaps and squashes, solve each tag's two planar poses.

    `most_frames`: only so many stamps. Raises BadInput where a camera's topic is not in the recording.
    """
    for camera in config.cameras:
        if camera.tag_topic not in recording.frames:
            raise BadInput(
                f"no detections on {camera.tag_topic} of {camera.name}; the recording has {sorted(recording.frames)}"
            )
    stamps, incomplete = _complete_stamps(config, recording)
    tags, owner = _tags(config)
    observations: list[Observation] = []
    answered, ignored = [], 0
    has_odometry = bool(moving_with_odometry(config, recording)) or any(b.fake_odom_noise for b in config.bodies)
    for stamp in stamps[:most_frames]:
        before = len(observations)
        for number, camera in enumerate(config.cameras):
            seen_here: set[int] = set()
            for sighting in recording.frames[camera.tag_topic][stamp]:
                tag_id = _remapped(config, sighting.tag_id, camera, stamp)
                body = owner.get(tag_id) or _adopt(config, tag_id, tags, owner)
                squashed = tag_id in config.squashed.get(stamp, frozenset())
                if (
                    body is None
                    or squashed
                    or tag_id in seen_here
                    or sighting.hamming > min(body.max_hamming, config.max_hamming)
                ):
                    ignored += 1
                    continue
                seen_here.add(tag_id)
                rig = config.body(camera.rig)
                observations.append(_observe(stamp, number, camera, rig, body, tags[tag_id], sighting.corners_px))
        if len(observations) > before or has_odometry:
            answered.append(stamp)
    return Problem(config, tuple(answered), tuple(observations), tags, owner, ignored, incomplete)


Odometry = tuple[Int64[Array, " n"], Float[Array, "n 4 4"]]


def moving_with_odometry(config: TagSlamConfig, recording: Recording) -> list[tuple[BodyEntry, Odometry]]:
    """Bodies whose odometry is in the recording, with its stamps and poses."""
    bodies = [(b, b.odom_topic) for b in config.bodies if b.odom_topic is not None]
    return [(b, recording.odometry[topic]) for b, topic in bodies if topic in recording.odometry]


def _complete_stamps(config: TagSlamConfig, recording: Recording) -> tuple[list[int], int]:
    """Stamps at which every camera and every odometry has a message, and how many others there were."""
    sets = [set(recording.frames[c.tag_topic]) for c in config.cameras]
    sets += [{int(s) for s in odometry[0]} for _, odometry in moving_with_odometry(config, recording)]
    both = set.intersection(*sets)
    return sorted(both), len(set.union(*sets)) - len(both)


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
    for remap in config.remaps:
        named = remap.camera is None or remap.camera == camera.name
        if remap.tag_id == tag_id and named and remap.start_ns <= stamp_ns <= remap.end_ns:
            return remap.becomes
    return tag_id


def _observe(
    stamp_ns: int,
    number: int,
    camera: CameraEntry,
    rig: BodyEntry,
    body: BodyEntry,
    tag: TagEntry,
    corners_px: Float[Array, "4 2"],
) -> Observation:
    poses, errors = planar_poses(camera.model, tag.size_m, corners_px)
    area = 0.5 * abs(float(np.cross(corners_px[2] - corners_px[0], corners_px[3] - corners_px[1])))
    return Observation(stamp_ns, number, rig, body, tag, corners_px, poses, errors, area)


def planar_poses(
    camera: CameraModel, size_m: float, corners_px: Float[Array, "4 2"]
) -> tuple[Float[Array, "k 4 4"], Float[Array, " k"]]:
    """camera_from_tag of a single tag: the two solutions of the planar problem (Collins and Bartoli 2014), by error."""
    ideal = camera.rays(corners_px)[:, :2]
    if not np.isfinite(ideal).all():
        return np.zeros((0, 4, 4)), np.zeros(0)
    # OpenCV wants the corners from (-,+) clockwise
    order = [3, 2, 1, 0]
    found = cv2.solvePnPGeneric(
        size_m * CORNERS[order], np.ascontiguousarray(ideal[order]), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    poses, errors = [], []
    for turn, shift in zip(found[1], found[2], strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        points = size_m * CORNERS @ pose[:3, :3].T + pose[:3, 3]
        if not np.isfinite(pose).all() or (points[:, 2] < 1e-3).any():
            continue
        poses.append(pose)
        errors.append(float(np.linalg.norm(camera.project(points) - corners_px, axis=1).mean()))
    order_of_error = np.argsort(errors)
    return np.array(poses).reshape(-1, 4, 4)[order_of_error], np.array(errors)[order_of_error]
