"""Reading a TagSLAM configuration as it is: cameras.yaml, camera_poses.yaml and tagslam.yaml.

Rotations there are axis-angle vectors, `R` is an upper-triangular root information matrix in (rotation, translation)
order, and the tag frame has y up on the printed tag.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import CameraModel, rotation_exp

MODELS = {"radtan": "brown-conrady", "plumb_bob": "brown-conrady", "equidistant": "fisheye", "fisheye": "fisheye"}
DEFAULT_WIGGLE = 1e-5


@dataclass(frozen=True, eq=False)
class NoisyPose:
    """A pose (4x4) and the root information (6x6) of what is known about it."""

    pose: Float[Array, "4 4"]
    root_information: Float[Array, "6 6"]


@dataclass(frozen=True, eq=False)
class CameraEntry:
    """A camera on a rig: `pose` is rig_from_camera where known. `wiggle`: how far (rad, m) it may move per frame."""

    name: str
    model: CameraModel
    tag_topic: str
    rig: str
    pose: NoisyPose | None
    wiggle: tuple[float, float]


@dataclass(frozen=True, eq=False)
class TagEntry:
    tag_id: int
    size_m: float
    pose: NoisyPose | None


@dataclass(frozen=True, eq=False)
class BodyEntry:
    """A rigid body: static with a pose in the world, or moving. Its tags; odometry where it has one."""

    name: str
    is_static: bool
    pose: NoisyPose | None
    default_tag_size_m: float
    tags: Mapping[int, TagEntry]
    ignored: frozenset[int]
    max_hamming: int
    odom_topic: str | None = None
    body_from_odom: Float[Array, "4 4"] = field(default_factory=lambda: np.eye(4))
    odom_acceleration: float = 5.0
    odom_angular_acceleration: float = 5.0
    odom_noise: tuple[float, float] | None = None
    fake_odom_noise: tuple[float, float] | None = None


@dataclass(frozen=True)
class Remap:
    """Tag `tag_id` seen by `camera` (None: any) between two times is another tag, `becomes`."""

    tag_id: int
    becomes: int
    camera: str | None
    start_ns: int
    end_ns: int


@dataclass(frozen=True, eq=False)
class TagSlamConfig:
    cameras: tuple[CameraEntry, ...]
    bodies: tuple[BodyEntry, ...]
    default_body: str | None
    pixel_noise: float
    remaps: tuple[Remap, ...]
    squashed: Mapping[int, frozenset[int]]
    planes: tuple[Mapping[str, Any], ...]
    distances: tuple[Mapping[str, Any], ...]
    coordinates: tuple[Mapping[str, Any], ...]
    max_hamming: int

    def body(self, name: str) -> BodyEntry:
        for body in self.bodies:
            if body.name == name:
                return body
        raise BadInput(f"tagslam.yaml has no body '{name}'; it has {[b.name for b in self.bodies]}")


def read_config(folder: Path) -> TagSlamConfig:
    """Read and check the three files. Raises BadInput naming the file, the entry and what was wanted."""
    cameras = _load(folder / "cameras.yaml")
    poses = _load(folder / "camera_poses.yaml") if (folder / "camera_poses.yaml").exists() else {}
    main = _load(folder / "tagslam.yaml")
    try:
        return _config(cameras, poses, main)
    except (KeyError, TypeError, ValueError, AttributeError) as wrong:
        raise BadInput(f"{folder}: the TagSLAM configuration is malformed ({type(wrong).__name__}: {wrong})") from wrong


def _config(cameras: Mapping[str, Any], poses: Mapping[str, Any], main: Mapping[str, Any]) -> TagSlamConfig:
    parameters = main.get("tagslam_parameters", {})
    defaults = main.get("body_defaults", {})
    bodies = tuple(_body(name, entry, defaults) for item in main["bodies"] for name, entry in item.items())
    _refuse_doubles(bodies)
    return TagSlamConfig(
        cameras=tuple(_camera(name, entry, poses.get(name)) for name, entry in cameras.items()),
        bodies=bodies,
        default_body=main.get("default_body"),
        pixel_noise=float(parameters.get("pixel_noise", 1.0)),
        remaps=tuple(_remaps(main.get("tag_id_remap") or [])),
        squashed=_squashed(main.get("squash") or []),
        planes=_measurements(main.get("plane_measurements")),
        distances=_measurements(main.get("distance_measurements")),
        coordinates=_measurements(main.get("coordinate_measurements")),
        max_hamming=int(main.get("max_hamming_distance", 100)),
    )


def _refuse_doubles(bodies: tuple[BodyEntry, ...]) -> None:
    owner: dict[int, str] = {}
    for body in bodies:
        for tag in body.tags:
            if tag in owner:
                raise BadInput(
                    f"tagslam.yaml: tag {tag} is on two bodies, '{owner[tag]}' and '{body.name}'; wanted one"
                )
            owner[tag] = body.name


def _camera(name: str, entry: Mapping[str, Any], pose: Mapping[str, Any] | None) -> CameraEntry:
    fx, fy, cx, cy = (float(v) for v in entry["intrinsics"])
    model = MODELS.get(str(entry.get("distortion_model", "radtan")))
    if model is None:
        raise BadInput(
            f"cameras.yaml: {name} has distortion_model '{entry['distortion_model']}'; wanted {list(MODELS)}"
        )
    coefficients = [float(v) for v in entry.get("distortion_coeffs", [])]
    wanted = 5 if model == "brown-conrady" else 4
    coefficients = (coefficients + [0.0] * wanted)[:wanted]
    width, height = (int(v) for v in entry["resolution"])
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    camera = CameraModel(name, width, height, K, model, tuple(coefficients))  # type: ignore[arg-type]
    wiggle = (
        float(entry.get("wiggle_rotation", DEFAULT_WIGGLE)),
        float(entry.get("wiggle_translation", DEFAULT_WIGGLE)),
    )
    topic = str(entry.get("tagtopic", ""))
    known = _camera_pose(pose["pose"]) if pose and "pose" in pose else None
    return CameraEntry(
        name, camera, topic if topic.startswith("/") else f"/{topic}", str(entry["rig_body"]), known, wiggle
    )


def _camera_pose(entry: Mapping[str, Any]) -> NoisyPose:
    if "R" in entry:
        root = np.array(entry["R"], dtype=np.float64).reshape(6, 6)
        return NoisyPose(_matrix(entry), root)
    return _noisy(entry, 1e-5, 1e-5)


def _body(name: str, entry: Mapping[str, Any], defaults: Mapping[str, Any]) -> BodyEntry:
    size_m = float(entry.get("default_tag_size", 0.0))
    position_noise = float(defaults.get("position_noise", 0.05))
    rotation_noise = float(defaults.get("rotation_noise", 0.01))
    tags = {}
    for tag in entry.get("tags") or []:
        one = _tag(tag, size_m, entry, position_noise, rotation_noise)
        tags[one.tag_id] = one
    if entry.get("type") == "board":
        tags.update(_board(entry["board"]))
    odom = (float(entry.get("odom_rotation_noise", -1)), float(entry.get("odom_translation_noise", -1)))
    fake = (float(entry.get("fake_odom_rotation_noise", -1)), float(entry.get("fake_odom_translation_noise", -1)))
    return BodyEntry(
        name=name,
        is_static=bool(entry["is_static"]),
        pose=_noisy(entry["pose"], rotation_noise, position_noise) if "pose" in entry else None,
        default_tag_size_m=size_m,
        tags=tags,
        ignored=frozenset(int(t) for t in entry.get("ignore_tags") or []),
        max_hamming=int(entry.get("max_hamming_distance", 2)),
        odom_topic=entry.get("odom_topic"),
        body_from_odom=_matrix(entry["T_body_odom"]) if "T_body_odom" in entry else np.eye(4),
        odom_acceleration=float(entry.get("odom_acceleration", 5.0)),
        odom_angular_acceleration=float(entry.get("odom_angular_acceleration", 5.0)),
        odom_noise=odom if min(odom) > 0 else None,
        fake_odom_noise=fake if min(fake) > 0 else None,
    )


def _tag(
    tag: Mapping[str, Any], size_m: float, body: Mapping[str, Any], position_noise: float, rotation_noise: float
) -> TagEntry:
    pose = _noisy(tag["pose"], rotation_noise, position_noise) if "pose" in tag else None
    over = (float(body.get("override_tag_rotation_noise", -1)), float(body.get("override_tag_position_noise", -1)))
    if pose is not None and max(over) > 0:
        rotation = np.where(over[0] > 0, over[0], 1 / np.diag(pose.root_information)[:3])
        position = np.where(over[1] > 0, over[1], 1 / np.diag(pose.root_information)[3:])
        pose = NoisyPose(
            pose.pose, np.diag(1 / np.concatenate([np.broadcast_to(rotation, 3), np.broadcast_to(position, 3)]))
        )
    size = float(tag.get("size", size_m))
    if size <= 0:
        raise BadInput(f"tagslam.yaml: tag {tag['id']} has no size; wanted a positive number of metres")
    return TagEntry(int(tag["id"]), size, pose)


def _board(board: Mapping[str, Any]) -> dict[int, TagEntry]:
    """Tags in rows and columns; `pose` is board_from_body. Spacing is the gap in tag sizes."""
    size_m, pitch = float(board["tag_size"]), float(board["tag_size"]) * (1 + float(board["tag_spacing"]))
    body_from_board = np.linalg.inv(_matrix(board["pose"])) if "pose" in board else np.eye(4)
    noise = (float(board.get("tag_rotation_noise", 1e-5)), float(board.get("tag_position_noise", 1e-5)))
    root = np.diag([1 / max(noise[0], 1e-6)] * 3 + [1 / max(noise[1], 1e-6)] * 3)
    tags, number = {}, int(board["tag_start_id"])
    for row in range(int(board["tag_rows"])):
        for column in range(int(board["tag_columns"])):
            at = np.eye(4)
            at[:2, 3] = column * pitch, row * pitch
            tags[number] = TagEntry(number, size_m, NoisyPose(body_from_board @ at, root))
            number += 1
    return tags


def _noisy(entry: Mapping[str, Any], rotation_noise: float, position_noise: float) -> NoisyPose:
    turn = _xyz(entry["rotation_noise"]) if "rotation_noise" in entry else np.full(3, rotation_noise)
    shift = _xyz(entry["position_noise"]) if "position_noise" in entry else np.full(3, position_noise)
    return NoisyPose(_matrix(entry), np.diag(1 / np.concatenate([turn, shift])))


def _matrix(entry: Mapping[str, Any]) -> Float[Array, "4 4"]:
    out = np.eye(4)
    out[:3, :3] = rotation_exp(_xyz(entry["rotation"]))
    out[:3, 3] = _xyz(entry["position"])
    return out


def _xyz(entry: Mapping[str, Any]) -> Float[Array, "3"]:
    return np.array([float(entry["x"]), float(entry["y"]), float(entry["z"])])


def _remaps(entries: list[Mapping[str, Any]]) -> list[Remap]:
    out = []
    for entry in entries:
        for remap in entry["remaps"]:
            start, end = _time_ns(remap.get("start_time", 0)), _time_ns(remap.get("end_time", 1e10))
            out.append(Remap(int(entry["id"]), int(remap["remap_id"]), remap.get("camera"), start, end))
    return out


def _squashed(entries: list[Mapping[str, Any]]) -> dict[int, frozenset[int]]:
    """Tags to leave out by stamp; key -1 with a camera would squash it everywhere, which is refused as unsupported."""
    out: dict[int, frozenset[int]] = {}
    for entry in entries:
        if "time" not in entry:
            raise BadInput("tagslam.yaml: squash entries without a time are not supported; name the stamps")
        at = _time_ns(entry["time"])
        out[at] = out.get(at, frozenset()) | frozenset(int(t) for t in entry["tags"])
    return out


def _measurements(entries: Any) -> tuple[Mapping[str, Any], ...]:
    return tuple({"name": name, **values} for item in entries or [] for name, values in item.items())


def _time_ns(value: Any) -> int:
    """Seconds since 1970 as text or number to nanoseconds, without losing digits where text was given."""
    text = str(value)
    if "e" in text.lower():
        return int(float(text) * 1e9)
    whole, _, part = text.partition(".")
    return int(whole) * 1_000_000_000 + int((part + "000000000")[:9] or 0)


class _TextLoader(yaml.SafeLoader):
    """Keeps floats as text where they are times: nanoseconds do not fit into a double."""


def _load(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text()
    except OSError as refused:
        raise BadInput(f"{path} cannot be read: {refused.strerror}; wanted a TagSLAM configuration folder") from refused
    try:
        document = yaml.load(_times_as_text(text), Loader=_TextLoader)
    except yaml.YAMLError as wrong:
        raise BadInput(f"{path} is no readable YAML ({wrong})") from wrong
    if not isinstance(document, dict):
        raise BadInput(f"{path}: wanted a mapping at the top, found {type(document).__name__}")
    return document


def _times_as_text(text: str) -> str:
    import re

    return re.sub(r"((?:start_|end_)?time:\s*)(\d+\.\d+)", r'\1"\2"', text)
