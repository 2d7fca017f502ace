"""Writing one MCAP file of a session (a toss, its truth, the views of a board), complete in itself."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from jaxtyping import Bool
from numpy import ndarray as Array

from recordings.bounded.documents import FORMAT_VERSION
from recordings.errors import BadInput, WriteFailed
from recordings.geometry import Transform
from recordings.mcap import arm_codec, codec
from recordings.mcap.writer import McapWriter
from recordings.records import ArmStates, DepthImage, EncodedImage, HealthLine, StampedPose, TossCommand, TossEvent
from recordings.tracks import RigCalibration
from recordings.whole_file import json_bytes


class TossWriter:
    """One file of a session, complete in itself. As a context: finished on a clean exit and on Ctrl-C (its stop record
    then says `interrupted`), left recoverable after an error. Each stream may be written by a thread of its own."""

    def __init__(
        self, path: Path, start: Mapping[str, Any], calibration: RigCalibration, kind: str, info: Mapping[str, Any]
    ) -> None:
        self.path = path
        self.sha256: str | None = None
        self._calibration = calibration
        self._writer = McapWriter(path)
        self._channels: dict[str, tuple[int, Any]] = {}
        self._schemas: dict[Any, int] = {}
        self._sizes: dict[str, tuple[int, int]] = {}
        self._dropped: dict[str, int] = {}
        self._joint_samples: dict[str, int] = {}
        self._lock = threading.RLock()
        self._ended = False
        self._begun = False
        self._writer.metadata(
            "tosslab", {"format_version": str(FORMAT_VERSION), "kind": kind, "info": json.dumps(dict(info))}
        )
        self._writer.attachment(
            "session.json", "application/json", json_bytes({"format_version": FORMAT_VERSION, "start": start})
        )
        self._writer.attachment("calibration.json", "application/json", json_bytes(calibration.to_json()))

    def __enter__(self) -> TossWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc: object) -> None:
        if kind is not None and issubclass(kind, KeyboardInterrupt) and self.sha256 is None:
            with contextlib.suppress(WriteFailed):  # Ctrl-C: everything so far is kept, as a whole file
                self.finish("interrupted")
        elif kind is not None:
            self.abandon()
        elif self.sha256 is None:
            self.finish()

    def color(self, image: EncodedImage) -> None:
        self._image(f"/{image.camera}/color", image)

    def mono(self, image: EncodedImage) -> None:
        self._image(f"/{image.camera}/image", image)

    def depth(self, image: DepthImage) -> None:
        if image.raw.dtype != np.uint16 or not 0 < image.unit_m < 1:
            raise BadInput(
                f"{image.camera} depth {image.index}: wanted uint16 with a unit in metres, "
                f"found {image.raw.dtype}, {image.unit_m}"
            )
        topic = f"/{image.camera}/depth"
        height, width = image.raw.shape
        self._same_size(topic, width, height)
        payload = codec.encode_depth(image)
        self._put(topic, payload, image.host_time_ns, image.time_ns, image.index, {"unit_m": repr(image.unit_m)})

    def arm(self, states: ArmStates, host_time_ns: Sequence[int] | None = None, topic: str = arm_codec.TOPIC) -> None:
        """A batch of samples, as the arm's driver delivers them; `sequence` counts on over the batches of the toss.

        `host_time_ns`: when the host received each sample; by default its own time.
        """
        if len(states.time_ns) == 0:
            return
        times_ns = states.time_ns.tolist()
        received_ns = times_ns if host_time_ns is None else list(host_time_ns)
        self._begin(received_ns[0])
        channel = self._channel(topic, JointStates, None)
        first = self._joint_samples.get(topic, 0)
        messages = zip(received_ns, times_ns, arm_codec.encode_arm(states), strict=True)
        for number, (host_ns, time_ns, data) in enumerate(messages, first):
            self._writer.message(channel, host_ns, time_ns, number, data)
        self._joint_samples[topic] = first + len(times_ns)

    def command(self, command: TossCommand) -> None:
        self._put("/toss/command", codec.encode_command(command), command.time_ns, command.time_ns, 0)

    def event(self, event: TossEvent) -> None:
        self._put("/toss/event", codec.encode_event(event), event.time_ns, event.time_ns, 0)

    def health(self, line: HealthLine) -> None:
        self._put("/health", codec.encode_health(line), line.time_ns, line.time_ns, 0)

    def pose(self, topic: str, pose: StampedPose, index: int = 0) -> None:
        """A pose on `topic`, its status and covariance on `<topic>_quality`."""
        self._put(topic, codec.encode_pose(pose), pose.time_ns, pose.time_ns, index)
        self._put(f"{topic}_quality", codec.encode_pose_quality(pose), pose.time_ns, pose.time_ns, index)

    def mask(self, position: int, mask: Bool[Array, "h w"]) -> None:
        """A given mask of the object in the colour frame at `position` of this toss (0 is the first)."""
        self._writer.attachment(f"masks/{position:06d}.png", "image/png", codec.encode_mask(mask))

    def dropped(self, topic: str, count: int = 1) -> None:
        """Count messages that arrived and could not be kept."""
        self._dropped[topic] = self._dropped.get(topic, 0) + count

    def streams(self) -> dict[str, dict[str, int]]:
        """Received, written and dropped by topic, for the stop document. `written`: in chunks that the disk took."""
        accepted, kept = self._writer.counts, self._writer.kept if self._ended else self._writer.counts
        return {
            topic: {
                "received": accepted.get(topic, 0) + self._dropped.get(topic, 0),
                "written": kept.get(topic, 0),
                "dropped": self._dropped.get(topic, 0) + accepted.get(topic, 0) - kept.get(topic, 0),
            }
            for topic in sorted({*accepted, *self._dropped})
        }

    @property
    def bytes_written(self) -> int:
        """What the disk has taken so far."""
        return self._writer.bytes_written

    def abandon(self) -> None:
        """Leave the file without its end: `toss-session recover` reads it. Never raises."""
        self._ended = True
        self._writer.abandon()

    def finish(self, status: str = "complete") -> str:
        """Write counts and index, close, return the file's sha256. Raises WriteFailed and keeps what the disk took."""
        if self.sha256 is not None:
            return self.sha256
        try:
            self._begin(0)
            self._writer.metadata("tosslab.stop", {"status": status, "streams": json.dumps(self.streams())})
            self.sha256 = self._writer.finish()
        except WriteFailed:
            self.abandon()
            raise
        self._ended = True
        return self.sha256

    def _image(self, topic: str, image: EncodedImage) -> None:
        self._same_size(topic, image.width, image.height)
        size = {"width": str(image.width), "height": str(image.height)}
        self._put(topic, codec.encode_image(image), image.host_time_ns, image.time_ns, image.index, size)

    def _same_size(self, topic: str, width: int, height: int) -> None:
        first = self._sizes.setdefault(topic, (width, height))
        if first != (width, height):
            raise BadInput(
                f"{topic}: an image of {width}x{height} after images of {first[0]}x{first[1]}; one size per toss"
            )

    def _put(
        self,
        topic: str,
        payload: codec.Payload,
        host_ns: int,
        time_ns: int,
        index: int,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        self._begin(host_ns)
        channel = self._channel(topic, payload.schema, metadata)
        self._writer.message(channel, host_ns, time_ns, index, payload.data, compress=payload.compress)

    def _channel(self, topic: str, schema: Any, metadata: Mapping[str, str] | None) -> int:
        with self._lock:
            if topic not in self._channels:
                if schema not in self._schemas:
                    name = schema.DESCRIPTOR.full_name
                    self._schemas[schema] = self._writer.schema(name, "protobuf", codec.schema_descriptor(schema))
                made = self._writer.channel(topic, "protobuf", self._schemas[schema], metadata)
                self._channels[topic] = (made, schema)
            number, first = self._channels[topic]
        if first is not schema:
            raise BadInput(
                f"{topic}: {schema.DESCRIPTOR.full_name} after {first.DESCRIPTOR.full_name}; one encoding per toss"
            )
        return number

    def _begin(self, time_ns: int) -> None:
        """Camera models and static transforms go first, at the time of the first message."""
        with self._lock:
            if not self._begun:
                self._begun = True
                self._send_calibration(time_ns)

    def _send_calibration(self, time_ns: int) -> None:
        transforms = list(self._calibration.transforms)
        for name, camera in self._calibration.cameras.items():
            topic = (
                f"/{name[: -len('_depth')]}/depth_calibration" if name.endswith("_depth") else f"/{name}/calibration"
            )
            self._send(topic, CameraCalibration, codec.encode_calibration(camera, time_ns), time_ns)
        if "d455" in self._calibration.cameras and "d455_depth" not in self._calibration.cameras:
            transforms.append(Transform.identity("d455", "d455_depth"))
        if transforms:
            payload = codec.encode_transforms(tuple(transforms), time_ns)
            self._send("/tf", payload.schema, payload, time_ns)

    def _send(self, topic: str, schema: Any, payload: codec.Payload, time_ns: int) -> None:
        self._writer.message(self._channel(topic, schema, None), time_ns, time_ns, 0, payload.data)
