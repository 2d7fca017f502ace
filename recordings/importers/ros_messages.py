"""ROS messages to records: images, depth, joint states."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64, UInt16
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.importers.common import Warnings
from recordings.importers.images import PNG_MAGIC, read_header
from recordings.importers.ros_bag_file import Bag
from recordings.mcap.codec import decode_pixels
from recordings.records import ArmStates, ImageEncoding

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
COLOR_WANTED = "rgb8, bgr8, rgba8, bgra8, mono8, or JPEG and PNG compressed"
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
MM = 0.001
COMPRESSED_DEPTH_HEAD = 12
"""Bytes before the PNG in image_transport's compressedDepth."""


@dataclass(frozen=True)
class Pixels:
    """An image's bytes as an EncodedImage keeps them."""

    encoding: ImageEncoding
    width: int
    height: int
    data: bytes


def stamp_ns(message: Any) -> int:
    """The header's stamp in ns; 0 where the driver left it empty."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def is_compressed(message: Any) -> bool:
    return hasattr(message, "format")


def color_image(message: Any, path: Path, topic: str, *, grey: bool) -> Pixels:
    """A colour image (or, with `grey`, a one-channel one). JPEG and PNG bytes are kept; others become rgb8 or mono8."""
    if is_compressed(message):
        data = bytes(message.data)
        header = read_header(data, f"{path.name}: an image of {topic}")
        if header.bits != 8 or (header.channels == 1) is not grey:
            raise BadInput(
                f"{path}: {topic} has {header.channels} channels of {header.bits} bits; wanted 8-bit {_word(grey)}"
            )
        return Pixels(header.encoding, header.width, header.height, data)
    channels = CHANNELS.get(message.encoding)
    if channels is None or (channels == 1) is not grey:
        raise BadInput(
            f"{path}: {topic} is encoded in '{message.encoding}'; wanted {'mono8' if grey else COLOR_WANTED}"
        )
    pixels = _rows(message, path, topic, channels, np.dtype(np.uint8))
    if message.encoding in ("bgr8", "bgra8", "8UC3"):  # 8UC3 is OpenCV's order
        pixels = pixels[..., [2, 1, 0]]
    pixels = np.ascontiguousarray(pixels[..., 0] if grey else pixels[..., :3])
    return Pixels("mono8" if grey else "rgb8", int(message.width), int(message.height), pixels.tobytes())


def _word(grey: bool) -> str:
    return "grey" if grey else "colour"


def _rows(message: Any, path: Path, topic: str, channels: int, dtype: np.dtype) -> Array:
    """(h, w, channels) without the padding at the end of rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    data = np.frombuffer(bytes(message.data), dtype=np.uint8)
    if height < 1 or width < 1 or step < row or len(data) < step * height:
        raise BadInput(
            f"{path}: an image of {topic} has {len(data)} bytes for {width}x{height} {message.encoding}; it is cut off"
        )
    packed = np.ascontiguousarray(data[: step * height].reshape(height, step)[:, :row])
    order = dtype.newbyteorder(">" if getattr(message, "is_bigendian", 0) else "<")
    return packed.view(order).reshape(height, width, channels)


def depth_image(message: Any, path: Path, topic: str, float_unit_m: float) -> tuple[UInt16[Array, "h w"], float]:
    """Depth as uint16 and its unit: 16UC1 is in millimetres by ROS's convention (REP 118), 32FC1 in metres."""
    if is_compressed(message):
        return _compressed_depth(message, path, topic), MM
    if message.encoding in ("16UC1", "mono16"):
        return _rows(message, path, topic, 1, np.dtype(np.uint16))[..., 0].astype(np.uint16), MM
    if message.encoding == "32FC1":
        depth_m = _rows(message, path, topic, 1, np.dtype(np.float32))[..., 0].astype(np.float64)
        steps = np.rint(np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0) / float_unit_m)
        return np.where(steps > np.iinfo(np.uint16).max, 0, steps).astype(np.uint16), float_unit_m
    raise BadInput(f"{path}: {topic} is encoded in '{message.encoding}'; wanted depth in 16UC1 (mm) or 32FC1 (m)")


def _compressed_depth(message: Any, path: Path, topic: str) -> UInt16[Array, "h w"]:
    data = bytes(message.data)
    if "compressedDepth" in message.format and not data.startswith(PNG_MAGIC):
        data = data[COMPRESSED_DEPTH_HEAD:]
    header = read_header(data, f"{path.name}: an image of {topic}")
    if "32FC1" in message.format or header.encoding != "png" or (header.bits, header.channels) != (16, 1):
        raise BadInput(f"{path}: {topic} is '{message.format}'; wanted 16-bit PNG depth in millimetres")
    raw = decode_pixels(data, f"{path.name}: an image of {topic}")
    if raw is None or raw.dtype != np.uint16:
        raise BadInput(f"{path}: an image of {topic} cannot be decoded as a 16-bit PNG")
    return raw


def joint_states(bag: Bag, topic: str, warnings: Warnings) -> tuple[Int64[Array, " n"], ArmStates | None]:
    """Times of reception and the arm's states. Joints named `finger` are the gripper: their sum is its width.

    Where several publishers speak, the set of joints that speaks most is the arm; the others are counted and left out.
    """
    found = [(received, m) for _, received, m in bag.messages(topic) if len(m.position) == len(m.name)]
    if not found:
        return np.zeros(0, dtype=np.int64), None
    sets = Counter(tuple(m.name) for _, m in found)
    names = sets.most_common(1)[0][0]
    kept = [(received, m) for received, m in found if tuple(m.name) == names]
    if len(kept) < len(found):
        warnings.add(f"{topic}: {len(found) - len(kept)} messages of other joints than {', '.join(names)} are left out")
    position = np.array([m.position for _, m in kept], dtype=np.float64)
    velocity = np.array(
        [m.velocity if len(m.velocity) == len(names) else np.full(len(names), np.nan) for _, m in kept],
        dtype=np.float64,
    )
    finger = np.array(["finger" in name for name in names], dtype=bool)
    width_m = position[:, finger].sum(axis=1) if finger.any() else np.full(len(kept), np.nan)
    states = ArmStates(
        np.array([stamp_ns(m) or received for received, m in kept], dtype=np.int64),
        tuple(n for n, f in zip(names, finger, strict=True) if not f),
        position[:, ~finger],
        velocity[:, ~finger],
        width_m,
    )
    return np.array([received for received, _ in kept], dtype=np.int64), states
