"""A ROS bag of either generation: its topics without decoding, its messages of the standard types decoded."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

from recordings.errors import BadInput

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JOINT_STATE = "sensor_msgs/msg/JointState"
TRANSFORMS = "tf2_msgs/msg/TFMessage"


class Bag:
    """A bag, opened: `types` is the message type of each topic.

    Only the standard types are decoded, by their standard definitions: a bag's other topics may hold anything.
    Raises BadInput for what is no bag, is damaged, or is encoded in an unknown way.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not path.exists():
            raise BadInput(f"{path} does not exist; wanted a ROS bag: .bag, a folder with metadata.yaml, .mcap or .db3")
        from rosbags.rosbag2 import Reader as Reader2
        from rosbags.typesys import Stores, get_typestore

        from recordings.importers.ros_bounds import BoundedBag1, check_bag2

        self._is_ros1 = path.suffix == ".bag"
        self._typestore = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        try:
            if not self._is_ros1:
                check_bag2(path)
            self._reader: Any = BoundedBag1(path) if self._is_ros1 else Reader2(path)
            self._reader.open()
        except BadInput:
            raise
        except Exception as wrong:  # rosbags raises its own, the decompressors', yaml's and sqlite's errors
            raise BadInput(
                f"{path} cannot be read as a bag of ROS 1, or of ROS 2 in cdr: {_one_line(wrong)}"
            ) from wrong
        self.types = {c.topic: c.msgtype for c in self._reader.connections}
        self._refuse_other_encodings()

    def close(self) -> None:
        self._reader.close()

    def topics(self, msgtype: str) -> list[str]:
        """Topics of a type that hold messages, in order."""
        return sorted({c.topic for c in self._reader.connections if c.msgtype == msgtype and c.msgcount != 0})

    def messages(self, *topics: str) -> Generator[tuple[str, int, Any], None, None]:
        """(topic, time of reception in ns, decoded message) of these topics, in the order of reception."""
        chosen = [c for c in self._reader.connections if c.topic in topics]
        decode = self._typestore.deserialize_ros1 if self._is_ros1 else self._typestore.deserialize_cdr
        try:
            for connection, received_ns, data in self._reader.messages(connections=chosen):
                yield connection.topic, int(received_ns), decode(data, connection.msgtype)
        except BadInput:
            raise
        except Exception as wrong:
            raise BadInput(f"{self.path}: {', '.join(topics)} cannot be read to its end: {_one_line(wrong)}") from wrong

    def first(self, topic: str) -> Any | None:
        """The first message of a topic; None if there is none."""
        messages = self.messages(topic)
        try:
            return next((message for _, _, message in messages), None)
        finally:
            messages.close()

    def _refuse_other_encodings(self) -> None:
        for connection in self._reader.connections:
            encoding = getattr(connection.ext, "serialization_format", "cdr")
            if not self._is_ros1 and encoding != "cdr":
                self.close()
                raise BadInput(f"{self.path}: topic {connection.topic} is encoded in '{encoding}'; wanted cdr")


def _one_line(wrong: Exception) -> str:
    return " ".join(str(wrong).split())[:200] or type(wrong).__name__
