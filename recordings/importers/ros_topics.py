"""Which topic of a bag is what, and the cameras that belong to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from recordings.errors import BadInput
from recordings.geometry import CameraModel, DistortionModel, Transform
from recordings.importers.common import Warnings
from recordings.importers.images import read_header
from recordings.importers.ros_bag_file import CAMERA_INFO, COMPRESSED, IMAGE, JOINT_STATE, TRANSFORMS, Bag
from recordings.importers.ros_messages import CHANNELS, DEPTH_ENCODINGS, is_compressed
from recordings.tracks import RigCalibration

_MODELS: dict[str, tuple[DistortionModel, int]] = {
    "plumb_bob": ("brown-conrady", 5),
    "radtan": ("brown-conrady", 5),
    "rational_polynomial": ("rational", 8),
    "equidistant": ("fisheye", 4),
    "fisheye": ("fisheye", 4),
}


@dataclass(frozen=True)
class Topics:
    """The topics of a bag that become a toss. `mono` by camera name."""

    color: str | None
    depth: str | None
    mono: dict[str, str]
    joints: str | None


def choose(bag: Bag, color: str | None, depth: str | None) -> Topics:
    """Find colour, depth, grey and joint topics. Raises BadInput where there are no images, or several colours."""
    kinds = {topic: _kind(bag, topic) for topic in (*bag.topics(IMAGE), *bag.topics(COMPRESSED))}
    for asked in (color, depth):
        if asked is not None and asked not in kinds:
            raise BadInput(f"{bag.path} has no images on {asked}; it has {sorted(kinds) or sorted(bag.types)}")
    if not kinds:
        named = ", ".join(f"{t} ({kind})" for t, kind in sorted(bag.types.items())) or "none"
        raise BadInput(f"{bag.path} holds no images (sensor_msgs Image or CompressedImage); its topics are: {named}")
    unknown = {t: kind for t, kind in kinds.items() if kind not in ("color", "depth", "grey")}
    colors, depths = ([t for t, kind in kinds.items() if kind == k] for k in ("color", "depth"))
    if unknown and not colors:
        topic, encoding = next(iter(unknown.items()))
        raise BadInput(f"{bag.path}: {topic} is encoded in '{encoding}'; wanted {', '.join(CHANNELS)}, JPEG or PNG")
    chosen_color = color or _one(bag, _without_twins(colors), "--color")
    chosen_depth = depth or _one(bag, _aligned_first(_without_twins(depths)), "--depth")
    grey = _without_twins([t for t, kind in kinds.items() if kind == "grey" and t not in (color, depth)])
    joints = bag.topics(JOINT_STATE)
    return Topics(
        chosen_color, chosen_depth, {f"mono{i}": t for i, t in enumerate(grey)}, joints[0] if joints else None
    )


def _kind(bag: Bag, topic: str) -> str:
    """`color`, `depth`, `grey`, or the encoding that is none of them."""
    message = bag.first(topic)
    if message is None:
        return "nothing"
    if not is_compressed(message):
        if message.encoding in DEPTH_ENCODINGS:
            return "depth"
        channels = CHANNELS.get(message.encoding)
        return str(message.encoding) if channels is None else ("grey" if channels == 1 else "color")
    if "compressedDepth" in message.format:
        return "depth"
    header = read_header(bytes(message.data), f"{bag.path.name}: the first image of {topic}")
    return "depth" if header.bits == 16 else ("grey" if header.channels == 1 else "color")


def _base(topic: str) -> str:
    """image_transport publishes one image on several topics: `.../image_raw`, `.../image_raw/compressed`."""
    for transport in ("/compressedDepth", "/compressed"):
        topic = topic.removesuffix(transport)
    return topic


def _without_twins(topics: Sequence[str]) -> list[str]:
    """One topic of each image: the raw one where it is there."""
    return [t for t in sorted(topics) if _base(t) == t or _base(t) not in topics]


def _aligned_first(topics: Sequence[str]) -> list[str]:
    aligned = [t for t in topics if "aligned" in t]
    return aligned or list(topics)


def _one(bag: Bag, topics: Sequence[str], option: str) -> str | None:
    if len(topics) > 1:
        raise BadInput(
            f"{bag.path} has several topics that fit: {', '.join(topics)}; say which by {option} {topics[0]}"
        )
    return topics[0] if topics else None


def describe(bag: Bag, topics: Topics, warnings: Warnings) -> RigCalibration:
    """Camera models from camera_info, the place of the depth camera from tf_static. Raises BadInput where depth
    cannot be laid on colour."""
    cameras: dict[str, CameraModel] = {}
    transforms: list[Transform] = []
    infos = {name: _info(bag, topic) for name, topic in {"d455": topics.color, **topics.mono}.items() if topic}
    for name, info in infos.items():
        if info is None:
            warnings.add(f"{name}: no camera_info beside its images; calibrate it: `toss-calibrate intrinsics SESSION`")
        else:
            cameras[name] = _camera(info, name)
    if topics.color is None:
        warnings.add("the bag has no colour images: nothing can be tracked in it")
    if topics.depth is None:
        warnings.add("the bag has no depth images: nothing can be tracked in it")
    elif topics.color is not None:
        _place_depth(bag, topics.depth, cameras, infos.get("d455"), transforms, warnings)
    warnings.add(
        "the camera's place in the world is not known: `toss-calibrate table SESSION` or edit calibration.json"
    )
    return RigCalibration(cameras, tuple(transforms))


def _info(bag: Bag, topic: str) -> Any | None:
    """camera_info beside an image topic: in its own namespace."""
    wanted = f"{_base(topic).rsplit('/', 1)[0]}/camera_info"
    return bag.first(wanted) if wanted in bag.topics(CAMERA_INFO) else None


def _camera(info: Any, frame: str) -> CameraModel:
    K = np.array(getattr(info, "k", getattr(info, "K", None)), dtype=np.float64).reshape(3, 3)
    numbers = tuple(float(d) for d in getattr(info, "d", getattr(info, "D", ())))
    if not any(numbers):
        return CameraModel(frame, int(info.width), int(info.height), K)
    if info.distortion_model not in _MODELS:
        raise BadInput(
            f"{frame}: camera_info says distortion_model '{info.distortion_model}'; wanted {', '.join(_MODELS)}"
        )
    model, count = _MODELS[info.distortion_model]
    return CameraModel(frame, int(info.width), int(info.height), K, model, (*numbers, *(0.0,) * count)[:count])


def _place_depth(
    bag: Bag,
    topic: str,
    cameras: dict[str, CameraModel],
    color_info: Any | None,
    transforms: list[Transform],
    warnings: Warnings,
) -> None:
    """Nothing to do where depth is aligned to colour; else its camera and its place, or a refusal."""
    info = _info(bag, topic)
    if "aligned" in topic or info is None or color_info is None:
        if "aligned" not in topic:
            warnings.add(f"{topic} has no camera_info to tell by: taken as aligned to colour")
        return
    depth = _camera(info, "d455_depth")
    color = cameras["d455"]
    same_size = (depth.width, depth.height) == (color.width, color.height)
    if same_size and np.allclose(depth.K, color.K, atol=1e-3) and info.header.frame_id == color_info.header.frame_id:
        return
    place = _static_transform(bag, color_info.header.frame_id, info.header.frame_id)
    if place is None:
        raise BadInput(
            f"{bag.path}: {topic} is not aligned to colour, and /tf_static does not connect its frame "
            f"'{info.header.frame_id}' to '{color_info.header.frame_id}'; record the aligned depth topic, or "
            "tf_static too"
        )
    cameras["d455_depth"] = depth
    transforms.append(Transform.from_matrix("d455", "d455_depth", place.matrix))
    warnings.add(f"{topic} is not aligned to colour: kept as it is, and aligned by its calibration when read")


def _static_transform(bag: Bag, target: str, source: str) -> Transform | None:
    edges: list[Transform] = []
    for topic in bag.topics(TRANSFORMS):
        if not topic.endswith("tf_static"):
            continue
        for _, _, message in bag.messages(topic):
            for one in message.transforms:
                t, q = one.transform.translation, one.transform.rotation
                frames = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
                wxyz, xyz = np.array([q.w, q.x, q.y, q.z]), np.array([t.x, t.y, t.z])
                edges.append(Transform.from_quaternion(*frames, wxyz, xyz))
    return RigCalibration({}, tuple(edges)).find(target.lstrip("/"), source.lstrip("/"))
