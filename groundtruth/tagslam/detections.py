"""Tag detections and odometry by stamp, from a TagSLAM recording: detections.npz or the ROS 1 bag itself."""

from __future__ import annotations

import bz2
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings.bounded.limits import copy_unpacked, open_npz
from recordings.errors import BadInput


@dataclass(frozen=True, eq=False)
class DetectedTag:
    """One tag in one image: corners (4, 2) in OpenCV's pixels, in TagSLAM's order (-,-), (+,-), (+,+), (-,+)."""

    tag_id: int
    hamming: int
    corners_px: Float[Array, "4 2"]


@dataclass(frozen=True, eq=False)
class Recording:
    """`frames[topic][stamp_ns]`: the tags of that image, empty where it shows none. `odometry[topic]`: stamps (n,) and
    poses (n, 4, 4)."""

    frames: Mapping[str, Mapping[int, tuple[DetectedTag, ...]]]
    odometry: Mapping[str, tuple[Int64[Array, " n"], Float[Array, "n 4 4"]]]

    def odometry_at(self, topic: str, stamp_ns: int) -> Float[Array, "4 4"]:
        """The pose of exactly this stamp."""
        stamps, poses = self.odometry[topic]
        return poses[int(np.searchsorted(stamps, stamp_ns))]


def read_recording(folder: Path) -> Recording:
    """detections.npz where it is, else tag_detections.bag or .bag.bz2. Raises BadInput."""
    if (folder / "detections.npz").exists():
        return _read_npz(folder / "detections.npz")
    for name in ("tag_detections.bag", "tag_detections.bag.bz2"):
        if (folder / name).exists():
            return _read_bag(folder / name)
    packed = Path(f"{(folder / 'tag_detections.bag').resolve()}.bz2")  # a link to another test's bag, packed there
    if packed.exists():
        return _read_bag(packed)
    raise BadInput(f"{folder} holds no detections; wanted detections.npz, tag_detections.bag or tag_detections.bag.bz2")


def _slashed(topic: str) -> str:
    return topic if topic.startswith("/") else f"/{topic}"


def _read_npz(path: Path) -> Recording:
    try:
        with open_npz(path) as stored:
            data = {name: stored[name] for name in stored.files}
        topics = [_slashed(str(t)) for t in data["topics"]]
        frames: dict[str, dict[int, tuple[DetectedTag, ...]]] = {}
        for topic, stamp in zip(data["frame_topic"], data["frame_stamp_ns"], strict=True):
            frames.setdefault(topics[int(topic)], {})[int(stamp)] = ()
        for i, (topic, stamp) in enumerate(zip(data["topic"], data["stamp_ns"], strict=True)):
            seen = DetectedTag(
                int(data["tag_id"][i]), int(data["hamming"][i]), data["corners_px"][i].astype(np.float64)
            )
            by_stamp = frames.setdefault(topics[int(topic)], {})
            by_stamp[int(stamp)] = (*by_stamp.get(int(stamp), ()), seen)
        odometry = {}
        for name in data:
            if name.startswith("odom_stamp_ns__"):
                tail = name[len("odom_stamp_ns__") :]
                odometry["/" + tail.replace("__", "/")] = (data[name], _poses(data[f"odom_xyz_qxyzw__{tail}"]))
        return Recording(frames, odometry)
    except (KeyError, ValueError, OSError, IndexError, TypeError) as wrong:
        raise BadInput(f"{path} is not a recording of detections ({type(wrong).__name__}: {wrong})") from wrong


def _poses(rows: Float[Array, "n 7"]) -> Float[Array, "n 4 4"]:
    from scipy.spatial.transform import Rotation

    out = np.tile(np.eye(4), (len(rows), 1, 1))
    out[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
    out[:, :3, 3] = rows[:, :3]
    return out


def _read_bag(path: Path) -> Recording:
    """Through `rosbags`, with the message definitions that the bag itself carries."""
    from rosbags.highlevel import AnyReader

    from recordings.importers.ros_bounds import BoundedBag1

    with tempfile.TemporaryDirectory() as scratch:
        bag = path
        if path.suffix == ".bz2":
            bag = Path(scratch) / "tag_detections.bag"
            try:
                with bz2.open(path) as packed, open(bag, "wb") as out:
                    copy_unpacked(packed, out, path.stat().st_size)
            except (OSError, EOFError, ValueError) as wrong:
                raise BadInput(f"{path} cannot be unpacked ({wrong})") from wrong
        try:
            reader = AnyReader([bag])
            reader.readers = [BoundedBag1(bag)]
            with reader:
                return _collect(reader)
        except BadInput:
            raise
        except Exception as wrong:  # rosbags raises a family of its own for every kind of damage
            raise BadInput(f"{path} cannot be read as a ROS bag ({type(wrong).__name__}: {wrong})") from wrong


def _collect(reader: Any) -> Recording:
    frames: dict[str, dict[int, tuple[DetectedTag, ...]]] = {}
    odometry: dict[str, list[tuple[int, list[float]]]] = {}
    for connection, _, raw in reader.messages():
        kind = connection.msgtype.rsplit("/", 1)[-1]
        if kind not in ("ApriltagArrayStamped", "Odometry"):
            continue
        message = reader.deserialize(raw, connection.msgtype)
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        if kind == "Odometry":
            p, q = message.pose.pose.position, message.pose.pose.orientation
            odometry.setdefault(_slashed(connection.topic), []).append((stamp, [p.x, p.y, p.z, q.x, q.y, q.z, q.w]))
            continue
        seen = tuple(
            DetectedTag(int(t.id), int(t.hamming), np.array([[c.x, c.y] for c in t.corners])) for t in message.apriltags
        )
        frames.setdefault(_slashed(connection.topic), {})[stamp] = seen
    if not frames:
        raise BadInput(f"the bag has no tag detections; it has {sorted({c.topic for c in reader.connections})}")
    return Recording(
        frames,
        {t: (np.array([r[0] for r in rows]), _poses(np.array([r[1] for r in rows]))) for t, rows in odometry.items()},
    )
