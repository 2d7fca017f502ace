# long because: the writers of a toss, of a session and of its truth share their documents
"""Writing a session: one complete MCAP file per toss, a start and a stop document, sha256 of every file."""

from __future__ import annotations

import contextlib
import json
import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from jaxtyping import Bool
from numpy import ndarray as Array

from recordings.bounded.documents import FORMAT_VERSION as FORMAT_VERSION
from recordings.errors import BadInput, WriteFailed
from recordings.geometry import Transform
from recordings.mcap import arm_codec, codec
from recordings.mcap.writer import McapWriter
from recordings.records import ArmStates, DepthImage, EncodedImage, HealthLine, StampedPose, TossCommand, TossEvent
from recordings.tracks import RigCalibration

NO_CALIBRATION = RigCalibration(cameras={})


def toss_name(toss: int) -> str:
    return f"toss_{toss:02d}"


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
            "session.json", "application/json", _json_bytes({"format_version": FORMAT_VERSION, "start": start})
        )
        self._writer.attachment("calibration.json", "application/json", _json_bytes(calibration.to_json()))

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


@dataclass(frozen=True)
class FinishedFile:
    """A file of the session that an earlier run finished: what the stop document says of it."""

    sha256: str
    streams: Mapping[str, Any]
    info: Mapping[str, Any]


class SessionWriter:
    """A session folder being written. Leaving the context without `finish` writes a stop document with status `failed`
    or `interrupted`; every finished toss stays whole.

    The folder must not exist, or be empty, unless `earlier` names the files (by stem) that an interrupted run left
    there: see session_resume.resume_session.
    """

    def __init__(
        self,
        folder: Path,
        start: Mapping[str, Any],
        calibration: RigCalibration = NO_CALIBRATION,
        earlier: Mapping[str, FinishedFile] | None = None,
    ) -> None:
        if earlier is None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise BadInput(f"{folder} exists already; nothing was written. Choose another name or remove it")
        self.folder = folder
        self._earlier = dict(earlier or {})
        self.start = {"created_unix_ns": time.time_ns(), **start}
        self._calibration = calibration
        self._tosses: dict[str, TossWriter] = {}
        self._info: dict[str, Mapping[str, Any]] = {}
        self._stopped = False
        _make_folder(folder)
        if earlier is None:
            write_json(folder / "calibration.json", calibration.to_json())
        self._write_document(None)

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *rest: object) -> None:
        if self._stopped:
            return
        self._abandon_open_tosses()
        interrupted = kind is None or issubclass(kind, KeyboardInterrupt)
        try:
            self.finish("interrupted" if interrupted else "failed", str(error) if error else "left without finish")
        except WriteFailed:
            if kind is None:
                raise

    def toss(self, toss: int, info: Mapping[str, Any] | None = None) -> TossWriter:
        """A new toss's file. `info` (JSON values) is kept in it and in session.json, for instance clock offsets."""
        return self._file(toss_name(toss), "toss", {"toss": toss, **(info or {})})

    def add_info(self, toss: int, info: Mapping[str, Any]) -> None:
        """What is known only after a toss, for instance its verdict: kept in session.json."""
        name = toss_name(toss)
        if name not in self._info:
            raise BadInput(f"{name} was not written by this session; it wrote {', '.join(self._info) or 'nothing'}")
        self._info[name] = {**self._info[name], **info}

    def discard(self, toss: int) -> None:
        """Remove a rejected take of this run, whole or not; its number is free again."""
        name = toss_name(toss)
        if name not in self._tosses:
            raise BadInput(f"{name} was not written by this run; nothing was removed")
        self._tosses[name].abandon()
        self._tosses[name].path.unlink(missing_ok=True)
        del self._tosses[name], self._info[name]

    def calibration_views(self) -> TossWriter:
        """calibration.mcap: views of a board, one image of each camera per view, stamped one second apart."""
        return self._file("calibration", "calibration", {})

    def finish(self, status: str = "complete", reason: str = "") -> None:
        """Write the stop document: counts per stream and the sha256 of every finished file.

        A toss that is still open is left as it is, recoverable and without a sha256.
        """
        self._abandon_open_tosses()
        sha256 = {f"{name}.mcap": f.sha256 for name, f in self._earlier.items()}
        sha256 |= {t.path.name: t.sha256 for t in self._tosses.values() if t.sha256 is not None}
        sha256["calibration.json"] = file_sha256(self.folder / "calibration.json")
        self._write_document(
            {
                "stopped_unix_ns": time.time_ns(),
                "status": status,
                "reason": reason,
                "streams": {
                    **{name: dict(f.streams) for name, f in self._earlier.items()},
                    **{name: t.streams() for name, t in self._tosses.items()},
                },
                "tosses": {
                    **{name: dict(f.info) for name, f in self._earlier.items()},
                    **{name: dict(info) for name, info in self._info.items()},
                },
                "sha256": sha256,
            }
        )
        self._stopped = True

    def _abandon_open_tosses(self) -> None:
        for toss in self._tosses.values():
            if toss.sha256 is None:
                toss.abandon()

    def _file(self, name: str, kind: str, info: Mapping[str, Any]) -> TossWriter:
        if name in self._tosses or name in self._earlier:
            raise BadInput(f"{name} was written already in this session; nothing was changed")
        writer = TossWriter(self.folder / f"{name}.mcap", self.start, self._calibration, kind, info)
        self._tosses[name], self._info[name] = writer, info
        return writer

    def _write_document(self, stop: Mapping[str, Any] | None) -> None:
        write_json(self.folder / "session.json", {"format_version": FORMAT_VERSION, "start": self.start, "stop": stop})


def write_truth(
    session: Path,
    poses: Mapping[int, Sequence[StampedPose]],
    info: Mapping[str, Any],
    mesh_obj: bytes | None = None,
) -> Path:
    """Write the session's truth/ folder: a file of `/groundtruth/pose` per toss, truth.json and mesh.obj.

    `poses` are `world_from_object` or `d455_from_object`, as each names itself. The folder must not exist yet.
    """
    folder = session / "truth"
    if folder.exists():
        raise BadInput(f"{folder} exists already; nothing was written. Remove it to write the truth anew")
    _make_folder(folder)
    sha256 = {}
    for toss, track in poses.items():
        with TossWriter(
            folder / f"{toss_name(toss)}.mcap", {"truth": dict(info)}, NO_CALIBRATION, "truth", {"toss": toss}
        ) as w:
            for i, pose in enumerate(track):
                w.pose("/groundtruth/pose", pose, i)
            sha256[w.path.name] = w.finish()
    if mesh_obj is not None:
        write_bytes(folder / "mesh.obj", mesh_obj)
        sha256["mesh.obj"] = file_sha256(folder / "mesh.obj")
    write_json(folder / "truth.json", {"format_version": FORMAT_VERSION, **info, "sha256": sha256})
    return folder


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Whole or not at all: written beside, synced, renamed."""
    write_bytes(path, _json_bytes(document))


def write_bytes(path: Path, data: bytes) -> None:
    """Whole or not at all: written beside, synced, renamed. Raises WriteFailed."""
    partial = path.with_name(path.name + ".partial")
    try:
        with open(partial, "wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        partial.replace(path)
    except OSError as refused:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise WriteFailed(f"{path} could not be written: {refused.strerror}; nothing was changed there") from refused


def file_sha256(path: Path) -> str:
    import hashlib

    with open(path, "rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()


def _json_bytes(document: Mapping[str, Any]) -> bytes:
    return (json.dumps(document, indent=1) + "\n").encode()


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as refused:
        raise WriteFailed(f"{folder} cannot be made: {refused.strerror}") from refused
