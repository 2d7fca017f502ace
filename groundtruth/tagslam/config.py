"""Reading a TagSLAM configuration as it is: cameras.yaml, camera_poses.yaml and tagslam.yaml.

The tag frame has y up on the printed tag. What TagSLAM reads and does not use (`max_hamming_distance` of a body, `bits`
of a tag) is not used here either; settings of its optimiser have no counterpart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth.tagslam import checks
from groundtruth.tagslam.yaml_pieces import NoisyPose, load, matrix, noisy, rounded_ns, time_ns
from recordings.errors import BadInput
from recordings.geometry import COEFFICIENTS, CameraModel, DistortionModel

MODELS: dict[str, DistortionModel] = {
    **dict.fromkeys(("radtan", "rad_tan", "plumb_bob"), "brown-conrady"),
    **dict.fromkeys(("rational", "rational_polynomial"), "rational"),
    **dict.fromkeys(("equidistant", "equi", "fisheye"), "fisheye"),
}
DEFAULT_WIGGLE = 1e-5


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
    odom_topic: str | None = None
    body_from_odom: Float[Array, "4 4"] = field(default_factory=lambda: np.eye(4))
    odom_acceleration: tuple[float, float] = (5.0, 50.0)
    """Least and largest noise of odometry, m/s^2: a step of dt seconds has this times dt^2."""
    odom_angular_acceleration: tuple[float, float] = (5.0, 50.0)
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


@dataclass(frozen=True)
class Squash:
    """Tags to leave out: at one stamp (None: always), of one camera (None: all)."""

    tags: frozenset[int]
    stamp_ns: int | None
    camera: str | None


@dataclass(frozen=True, eq=False)
class TagSlamConfig:
    """`approximate_sync`: stamps of the topics need not be equal. `amnesia`: every stamp is solved anew, from what the
    configuration knows and the moving bodies' poses before. `minimum_tag_area_px2` is of twice a tag's area, as TagSLAM
    counts it."""

    cameras: tuple[CameraEntry, ...]
    bodies: tuple[BodyEntry, ...]
    default_body: str | None
    pixel_noise: float
    remaps: tuple[Remap, ...]
    squashes: tuple[Squash, ...]
    planes: tuple[Mapping[str, Any], ...]
    distances: tuple[Mapping[str, Any], ...]
    coordinates: tuple[Mapping[str, Any], ...]
    max_hamming: int
    approximate_sync: bool = False
    amnesia: bool = False
    minimum_tag_area_px2: float = 0.0
    minimum_viewing_deg: float = 20.0
    ambiguous_deg: float = 60.0
    """Tags seen flatter than this must have one planar solution that is clearly better:"""
    most_ambiguous: float = 0.3
    """its squared error at most this share of the other's."""
    notes: tuple[str, ...] = ()
    """What stands in the files and is not read."""

    def body(self, name: str) -> BodyEntry:
        for body in self.bodies:
            if body.name == name:
                return body
        raise BadInput(f"tagslam.yaml has no body '{name}'; it has {[b.name for b in self.bodies]}")


def read_config(folder: Path) -> TagSlamConfig:
    """Read and check the three files. Raises BadInput naming the file, the entry and what was wanted."""
    cameras = load(folder / "cameras.yaml")
    poses = load(folder / "camera_poses.yaml") if (folder / "camera_poses.yaml").exists() else {}
    main = load(folder / "tagslam.yaml")
    try:
        config = _config(cameras, poses, main)
    except (KeyError, TypeError, ValueError, AttributeError) as wrong:
        raise BadInput(f"{folder}: the TagSLAM configuration is malformed ({type(wrong).__name__}: {wrong})") from wrong
    _refuse_doubles(config.bodies)
    _refuse_unplaced_rigs(config)
    _refuse_moving_measured(config)
    return config


def _config(cameras: Mapping[str, Any], poses: Mapping[str, Any], main: Mapping[str, Any]) -> TagSlamConfig:
    parameters = main.get("tagslam_parameters") or {}
    checks.check_mode(parameters)
    if not main.get("bodies"):
        raise BadInput("tagslam.yaml has no bodies; wanted a list of them under `bodies`")
    return TagSlamConfig(
        cameras=tuple(
            checks.entry(f"cameras.yaml: {n}", partial(_camera, n, cameras[n], poses.get(n)))
            for n in checks.camera_names(cameras)
        ),
        bodies=_with_fake_odometry(_bodies(main)),
        default_body=main.get("default_body"),
        pixel_noise=float(parameters.get("pixel_noise", 1.0)),
        remaps=tuple(_remaps(main.get("tag_id_remap") or [])),
        squashes=tuple(_squash(s) for s in main.get("squash") or []),
        planes=checks.measurements(main, "plane_measurements")[-1:],
        distances=checks.measurements(main, "distance_measurements"),
        coordinates=checks.measurements(main, "coordinate_measurements"),
        max_hamming=int(main.get("max_hamming_distance", 100)),
        approximate_sync=bool(parameters.get("use_approximate_sync", False)),
        amnesia=bool(main.get("amnesia", False)),
        minimum_tag_area_px2=float(parameters.get("minimum_tag_area", 0)),
        minimum_viewing_deg=float(parameters.get("minimum_viewing_angle", 20.0)),
        ambiguous_deg=float(parameters.get("ambiguity_angle_threshold", 60.0)),
        most_ambiguous=float(parameters.get("max_ambiguity_ratio", 0.3)),
        notes=tuple(checks.unread(cameras, main)),
    )


def _bodies(main: Mapping[str, Any]) -> tuple[BodyEntry, ...]:
    defaults = main.get("body_defaults") or {}
    return tuple(
        checks.entry(f"tagslam.yaml: body '{name}'", partial(_body, name, values, defaults))
        for item in main["bodies"]
        for name, values in item.items()
    )


def _with_fake_odometry(bodies: tuple[BodyEntry, ...]) -> tuple[BodyEntry, ...]:
    """Where one body has fake odometry, all that move have it in TagSLAM: to a radian and a metre where not stated."""
    if all(b.fake_odom_noise is None for b in bodies):
        return bodies
    return tuple(
        b if b.is_static or b.fake_odom_noise is not None else replace(b, fake_odom_noise=(1.0, 1.0)) for b in bodies
    )


def _refuse_unplaced_rigs(config: TagSlamConfig) -> None:
    if config.default_body is not None and config.body(config.default_body).default_tag_size_m <= 0:
        raise BadInput(f"tagslam.yaml: the default body '{config.default_body}' has no default_tag_size")
    for rig in {c.rig: config.body(c.rig) for c in config.cameras}.values():
        mine = [c for c in config.cameras if c.rig == rig.name]
        if any(c.pose is not None for c in mine) or (rig.is_static and rig.pose is not None):
            continue
        raise BadInput(
            f"camera_poses.yaml: no camera on '{rig.name}' ({', '.join(c.name for c in mine)}) has a pose; wanted one "
            "at least, for it says where the body's frame is"
        )


def _refuse_moving_measured(config: TagSlamConfig) -> None:
    moving = {tag: body.name for body in config.bodies if not body.is_static for tag in body.tags}
    for m in (*config.distances, *config.coordinates):
        for tag in (m[t] for t in ("tag", "tag1", "tag2") if t in m):
            if int(tag) in moving:
                raise BadInput(
                    f"tagslam.yaml: '{m['name']}' measures tag {tag} on '{moving[int(tag)]}', which moves; wanted a "
                    "static body"
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
    given = [float(v) for v in entry.get("distortion_coeffs") or []]
    if model == "brown-conrady" and len(given) > COEFFICIENTS[model]:
        model = "rational"  # OpenCV's order goes on with k4 k5 k6
    if len(given) > COEFFICIENTS[model]:
        raise BadInput(f"cameras.yaml: {name} has {len(given)} distortion_coeffs; wanted at most {COEFFICIENTS[model]}")
    coefficients = given + [0.0] * (COEFFICIENTS[model] - len(given))
    width, height = (int(v) for v in entry["resolution"])
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    camera = CameraModel(name, width, height, K, model, tuple(coefficients))
    wiggle = (
        float(entry.get("wiggle_rotation", DEFAULT_WIGGLE)),
        float(entry.get("wiggle_translation", DEFAULT_WIGGLE)),
    )
    topic = str(entry.get("tagtopic", ""))
    known = noisy(pose["pose"], 1e-5, 1e-5) if pose and "pose" in pose else None
    return CameraEntry(
        name, camera, topic if topic.startswith("/") else f"/{topic}", str(entry["rig_body"]), known, wiggle
    )


def _body(name: str, entry: Mapping[str, Any], defaults: Mapping[str, Any]) -> BodyEntry:
    size_m = float(entry.get("default_tag_size", 0.0))
    noises = (float(defaults.get("rotation_noise", 0.01)), float(defaults.get("position_noise", 0.05)))
    if "pose" in entry and not entry["is_static"]:
        raise BadInput(f"tagslam.yaml: body '{name}' moves, yet it has a pose; wanted is_static: true, or no pose")
    return BodyEntry(
        name=name,
        is_static=bool(entry["is_static"]),
        pose=noisy(entry["pose"], *noises) if "pose" in entry else None,
        default_tag_size_m=size_m,
        tags=_body_tags(name, entry, size_m, noises),
        ignored=frozenset(int(t) for t in entry.get("ignore_tags") or []),
        odom_topic=_slashed(entry.get("odom_topic")),
        body_from_odom=matrix(entry["T_body_odom"]) if "T_body_odom" in entry else np.eye(4),
        odom_acceleration=_range(entry, "odom_acceleration"),
        odom_angular_acceleration=_range(entry, "odom_angular_acceleration"),
        odom_noise=_both(entry, "odom_rotation_noise", "odom_translation_noise"),
        fake_odom_noise=_both(entry, "fake_odom_rotation_noise", "fake_odom_translation_noise"),
    )


def _slashed(topic: Any) -> str | None:
    return None if not topic else str(topic) if str(topic).startswith("/") else f"/{topic}"


def _range(entry: Mapping[str, Any], name: str) -> tuple[float, float]:
    """The least and the largest noise; the older name without `_noise_min` counts where the newer is not given."""
    least = float(entry.get(f"{name}_noise_min", entry.get(name, 5.0)))
    return least, float(entry.get(f"{name}_noise_max", 10 * least))


def _both(entry: Mapping[str, Any], rotation: str, translation: str) -> tuple[float, float] | None:
    """Two noises that count only together."""
    noise = (float(entry.get(rotation, -1)), float(entry.get(translation, -1)))
    return noise if min(noise) > 0 else None


def _body_tags(
    name: str, entry: Mapping[str, Any], size_m: float, noises: tuple[float, float]
) -> Mapping[int, TagEntry]:
    kind = str(entry.get("type", "simple"))
    if kind in ("board", "staggered_board"):
        found = _board(entry[kind], staggered=kind == "staggered_board")
    elif kind in ("simple", "camera_rig"):
        found = [_tag(tag, size_m, noises) for tag in entry.get("tags") or []]
    else:
        raise BadInput(f"tagslam.yaml: body '{name}' has type '{kind}'; wanted one of simple, board, staggered_board")
    over = _both(entry, "override_tag_rotation_noise", "override_tag_position_noise")
    root = None if over is None else np.diag([1 / over[0]] * 3 + [1 / over[1]] * 3)
    return {
        t.tag_id: t if root is None or t.pose is None else replace(t, pose=NoisyPose(t.pose.pose, root)) for t in found
    }


def _tag(tag: Mapping[str, Any], size_m: float, noises: tuple[float, float]) -> TagEntry:
    size = float(tag.get("size", size_m))
    if size <= 0:
        raise BadInput(f"tagslam.yaml: tag {tag['id']} has no size; wanted a positive number of metres")
    return TagEntry(int(tag["id"]), size, noisy(tag["pose"], *noises) if "pose" in tag else None)


def _board(board: Mapping[str, Any], staggered: bool) -> list[TagEntry]:
    """Tags in rows and columns; `pose` is board_from_body. Spacing is the gap in tag sizes.

    A staggered board has its tags on the black fields of a chessboard, rows downwards.
    """
    size_m, pitch = float(board["tag_size"]), float(board["tag_size"]) * (1 + float(board["tag_spacing"]))
    body_from_board = np.linalg.inv(matrix(board["pose"])) if "pose" in board else np.eye(4)
    noise = (float(board.get("tag_rotation_noise", 0.0)), float(board.get("tag_position_noise", 0.0)))
    root = np.diag([1 / max(noise[0], 1e-6)] * 3 + [1 / max(noise[1], 1e-6)] * 3)
    tags, number = [], int(board["tag_start_id"])
    for row in range(int(board["tag_rows"])):
        for column in range(row % 2 if staggered else 0, int(board["tag_columns"]), 2 if staggered else 1):
            at = np.eye(4)
            at[:2, 3] = column * pitch, -row * pitch if staggered else row * pitch
            tags.append(TagEntry(number, size_m, NoisyPose(body_from_board @ at, root)))
            number += 1
    return tags


def _remaps(entries: list[Mapping[str, Any]]) -> list[Remap]:
    out = []
    for entry in entries:
        for remap in entry["remaps"]:
            start, end = rounded_ns(remap.get("start_time", 0)), rounded_ns(remap.get("end_time", 1e10))
            out.append(Remap(int(entry["id"]), int(remap["remap_id"]), remap.get("camera"), start, end))
    return out


def _squash(entry: Mapping[str, Any]) -> Squash:
    at, camera = entry.get("time"), entry.get("camera")
    if at is None and camera is None:
        raise BadInput("tagslam.yaml: a squash entry names neither a time nor a camera; wanted at least one of them")
    return Squash(frozenset(int(t) for t in entry["tags"]), None if at is None else time_ns(at), camera)
