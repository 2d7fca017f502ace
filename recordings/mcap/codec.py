"""Records to MCAP messages and back: Foxglove's protobuf schemas where one exists, tosslab's own where none does.

The topics are listed in ARCHITECTURE.md. `compress` of a topic says whether its chunk gains from zstd.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar, cast, get_args

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import DecodeError
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from recordings.bounded import limits
from recordings.errors import BadInput, DamagedFile
from recordings.geometry import CameraModel, DistortionModel, Transform, quaternion_from_rotation
from recordings.mcap.depth_codec import DEPTH_CODEC
from recordings.mcap.depth_codec import pack_depth as pack_depth
from recordings.mcap.depth_codec import unpack_depth as unpack_depth
from recordings.mcap.file import Message
from recordings.records import (
    DepthImage,
    EncodedImage,
    HealthLine,
    ImageEncoding,
    StampedPose,
    TossCommand,
    TossEvent,
)
from recordings.schemas import tosslab_pb2 as own
from recordings.tracks import Status

_LEVELS = {"info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}
_FOXGLOVE_MODELS: dict[DistortionModel, str] = {
    "none": "plumb_bob",
    "brown-conrady": "plumb_bob",
    "rational": "rational_polynomial",
    "fisheye": "kannala_brandt",
}
_NANOS = 1_000_000_000
T = TypeVar("T")


@dataclass(frozen=True)
class Payload:
    """A message ready for a channel: the protobuf class names the schema."""

    schema: Any
    data: bytes
    compress: bool = False


def schema_descriptor(message_class: Any) -> bytes:
    """The serialized FileDescriptorSet of a protobuf message and everything it imports (MCAP's protobuf schema)."""
    files: dict[str, FileDescriptor] = {}

    def collect(file: FileDescriptor) -> None:
        for needed in file.dependencies:
            collect(needed)
        files.setdefault(file.name, file)

    collect(message_class.DESCRIPTOR.file)
    out = FileDescriptorSet()
    for file in files.values():
        file.CopyToProto(out.file.add())
    return out.SerializeToString()


def encode_image(image: EncodedImage) -> Payload:
    """A colour or mono image: JPEG and PNG bytes as they are, raw pixels as RawImage."""
    if image.encoding in ("jpeg", "png"):
        message = CompressedImage(frame_id=image.camera, format=image.encoding, data=image.data)
        _stamp(message.timestamp, image.time_ns)
        return Payload(CompressedImage, message.SerializeToString())
    channels = 3 if image.encoding == "rgb8" else 1
    if len(image.data) != image.width * image.height * channels:
        raise BadInput(
            f"{image.camera} image {image.index}: {len(image.data)} bytes are not "
            f"{image.width}x{image.height} {image.encoding}"
        )
    raw = RawImage(
        frame_id=image.camera,
        width=image.width,
        height=image.height,
        encoding=image.encoding,
        step=image.width * channels,
        data=image.data,
    )
    _stamp(raw.timestamp, image.time_ns)
    return Payload(RawImage, raw.SerializeToString(), compress=True)


def read_image(message: Message, camera: str, schema: str, size: tuple[int, int]) -> EncodedImage:
    """`size` (width, height) is what the calibration says: compressed images do not carry it in the message."""
    if schema == "foxglove.CompressedImage":
        box = _parse(CompressedImage, message)
        if box.format not in ("jpeg", "png"):
            raise BadInput(f"{message.topic}: images in '{box.format}'; wanted jpeg or png")
        encoding = cast(ImageEncoding, box.format)
        width, height = size
    elif schema == "foxglove.RawImage":
        box = _parse(RawImage, message)
        if box.encoding not in ("rgb8", "mono8"):
            raise BadInput(f"{message.topic}: raw images in '{box.encoding}'; wanted rgb8 or mono8")
        encoding, width, height = cast(ImageEncoding, box.encoding), box.width, box.height
    else:
        raise BadInput(f"{message.topic}: schema {schema}; wanted foxglove.CompressedImage or foxglove.RawImage")
    return EncodedImage(
        camera, message.sequence, _time_ns(box.timestamp), message.log_time_ns, encoding, width, height, box.data
    )


def decode_image(image: EncodedImage) -> UInt8[Array, "h w *c"]:
    """Pixels, RGB (h w 3) or grey (h w). Raises DamagedFile when the bytes are no such image or of another size."""
    name = f"{image.camera} image {image.index}"
    if image.encoding in ("rgb8", "mono8"):
        shape = (image.height, image.width, 3) if image.encoding == "rgb8" else (image.height, image.width)
        if len(image.data) != int(np.prod(shape)):
            raise DamagedFile(f"{name}: {len(image.data)} bytes are not {image.width}x{image.height} {image.encoding}")
        return np.frombuffer(image.data, dtype=np.uint8).reshape(shape)
    found = limits.image_size(image.data)
    if found is not None and found != (image.width, image.height):
        raise DamagedFile(f"{name}: {found[0]}x{found[1]} pixels, the calibration says {image.width}x{image.height}")
    pixels = decode_pixels(image.data, name)
    if pixels is None or pixels.dtype != np.uint8 or pixels.shape[:2] != (image.height, image.width):
        raise DamagedFile(f"{name}: its {len(image.data)} bytes are no 8-bit {image.encoding} image")
    return cv2.cvtColor(pixels[..., :3], cv2.COLOR_BGR2RGB) if pixels.ndim == 3 else pixels


def encode_depth(image: DepthImage) -> Payload:
    """A depth image without loss, in the device's unit."""
    height, width = image.raw.shape
    message = own.DepthImage(
        frame_id=f"{image.camera}_depth",
        width=width,
        height=height,
        unit_m=image.unit_m,
        codec=DEPTH_CODEC,
        data=pack_depth(image.raw),
    )
    _stamp(message.timestamp, image.time_ns)
    return Payload(own.DepthImage, message.SerializeToString())


def read_depth(message: Message, camera: str, schema: str, unit_m: float) -> DepthImage:
    """`unit_m` serves foxglove.RawImage 16UC1, which does not carry one."""
    if schema == "tosslab.DepthImage":
        box = _parse(own.DepthImage, message)
        if box.codec != DEPTH_CODEC:
            raise BadInput(f"{message.topic}: depth codec '{box.codec}'; this tosslab reads '{DEPTH_CODEC}'")
        raw = unpack_depth(box.data, box.height, box.width)
        unit_m = box.unit_m
        if not 0 < unit_m < 1:
            raise DamagedFile(f"{message.topic}: a depth unit of {unit_m} m")
    elif schema == "foxglove.RawImage":
        box = _parse(RawImage, message)
        if box.encoding != "16UC1" or len(box.data) != 2 * box.width * box.height:
            raise DamagedFile(f"{message.topic}: not a whole 16UC1 image ({box.encoding}, {len(box.data)} bytes)")
        raw = np.frombuffer(box.data, dtype="<u2").reshape(box.height, box.width)
    else:
        raise BadInput(f"{message.topic}: schema {schema}; wanted tosslab.DepthImage or foxglove.RawImage")
    return DepthImage(camera, message.sequence, _time_ns(box.timestamp), message.log_time_ns, unit_m, raw)


def encode_calibration(camera: CameraModel, time_ns: int) -> Payload:
    P = np.zeros((3, 4))
    P[:, :3] = camera.K
    message = CameraCalibration(
        frame_id=camera.frame,
        width=camera.width,
        height=camera.height,
        distortion_model=_FOXGLOVE_MODELS[camera.distortion_model],
        D=camera.distortion or (0.0,) * 5,
        K=camera.K.reshape(-1).tolist(),
        R=np.eye(3).reshape(-1).tolist(),
        P=P.reshape(-1).tolist(),
    )
    _stamp(message.timestamp, time_ns)
    return Payload(CameraCalibration, message.SerializeToString())


def encode_transforms(transforms: tuple[Transform, ...], time_ns: int) -> Payload:
    """Static transforms: parent is the target, child the source (`parent_from_child`)."""
    message = FrameTransforms()
    for t in transforms:
        one = message.transforms.add(parent_frame_id=t.target, child_frame_id=t.source)
        _stamp(one.timestamp, time_ns)
        _set_xyz(one.translation, t.translation_m)
        _set_quaternion(one.rotation, t.rotation)
    return Payload(FrameTransforms, message.SerializeToString())


def encode_pose(pose: StampedPose) -> Payload:
    message = PoseInFrame(frame_id=pose.target)
    _stamp(message.timestamp, pose.time_ns)
    if pose.status == "lost":
        _set_xyz(message.pose.position, np.full(3, np.nan))
        message.pose.orientation.w = np.nan
    else:
        _set_xyz(message.pose.position, pose.matrix[:3, 3])
        _set_quaternion(message.pose.orientation, pose.matrix[:3, :3])
    return Payload(PoseInFrame, message.SerializeToString())


def encode_pose_quality(pose: StampedPose) -> Payload:
    covariance = [] if pose.covariance is None else pose.covariance.reshape(-1).tolist()
    message = own.PoseQuality(source_frame=pose.source, status=pose.status, covariance=covariance)
    _stamp(message.timestamp, pose.time_ns)
    return Payload(own.PoseQuality, message.SerializeToString())


def read_pose(message: Message, quality: Message | None) -> StampedPose:
    box = _parse(PoseInFrame, message)
    stored = _parse(own.PoseQuality, quality) if quality is not None else None
    matrix = np.full((4, 4), np.nan)
    p, q = box.pose.position, box.pose.orientation
    if np.isfinite([p.x, p.y, p.z, q.w]).all():
        matrix = Transform.from_quaternion(
            box.frame_id, "object", np.array([q.w, q.x, q.y, q.z]), np.array([p.x, p.y, p.z])
        ).matrix
    status = stored.status if stored is not None else "tracked"
    if status not in get_args(Status):
        raise DamagedFile(f"{message.topic}: status '{status}'; wanted tracked, interpolated or lost")
    covariance = (
        np.array(stored.covariance).reshape(6, 6) if stored is not None and len(stored.covariance) == 36 else None
    )
    source = stored.source_frame if stored is not None else "object"
    return StampedPose(_time_ns(box.timestamp), box.frame_id, source, matrix, cast(Status, status), covariance)


def encode_command(command: TossCommand) -> Payload:
    message = own.TossCommand(
        world_from_tool=command.world_from_tool.reshape(-1).tolist(),
        linear_velocity_world_m_s=command.linear_velocity_world_m_s.tolist(),
        angular_velocity_world_rad_s=command.angular_velocity_world_rad_s.tolist(),
    )
    _stamp(message.timestamp, command.time_ns)
    _stamp(message.release_time, command.release_time_ns)
    return Payload(own.TossCommand, message.SerializeToString())


def read_command(message: Message) -> TossCommand:
    box = _parse(own.TossCommand, message)
    return _damaged_if_malformed(
        message,
        lambda: TossCommand(
            _time_ns(box.timestamp),
            _time_ns(box.release_time),
            _numbers(box.world_from_tool, 16).reshape(4, 4),
            _numbers(box.linear_velocity_world_m_s, 3),
            _numbers(box.angular_velocity_world_rad_s, 3),
        ),
    )


def encode_event(event: TossEvent) -> Payload:
    message = own.TossEvent(kind=event.kind, source=event.source, text=event.text, sigma_s=event.sigma_s)
    _stamp(message.timestamp, event.time_ns)
    return Payload(own.TossEvent, message.SerializeToString())


def read_event(message: Message) -> TossEvent:
    box = _parse(own.TossEvent, message)
    return TossEvent(_time_ns(box.timestamp), box.kind, box.source, box.text, box.sigma_s)


def encode_health(line: HealthLine) -> Payload:
    message = Log(level=_LEVELS[line.level], name=line.name, message=line.message)
    _stamp(message.timestamp, line.time_ns)
    return Payload(Log, message.SerializeToString())


def read_health(message: Message) -> HealthLine:
    box = _parse(Log, message)
    level = next((name for name, number in _LEVELS.items() if number == box.level), "info")
    return HealthLine(_time_ns(box.timestamp), level, box.name, box.message)  # type: ignore[arg-type]


def encode_mask(mask: Array) -> bytes:
    """A mask (h w, bool) as PNG, 0 and 255."""
    ok, png = cv2.imencode(".png", mask.astype(np.uint8) * 255)
    if not ok:
        raise BadInput(f"a mask of shape {mask.shape} cannot be written as PNG")
    return png.tobytes()


def decode_mask(data: bytes, name: str) -> Array:
    """A mask (h w, bool) from PNG: any value above 0 in any channel is inside."""
    pixels = decode_pixels(data, name)
    if pixels is None:
        raise DamagedFile(f"{name}: no readable PNG")
    return np.asarray(pixels.any(axis=-1) if pixels.ndim == 3 else pixels > 0)


def decode_pixels(data: bytes, name: str) -> Array | None:
    """A PNG's or JPEG's pixels in OpenCV's order; None where it is neither, or broken.

    Raises DamagedFile when its header declares more pixels than any camera here has: nothing was decoded then.
    """
    size = limits.image_size(data)
    if size is None:
        return None
    if size[0] * size[1] > limits.MOST_PIXELS:
        raise DamagedFile(
            f"{name}: its header declares {size[0]}x{size[1]} pixels; wanted at most {limits.MOST_PIXELS} in all"
        )
    try:
        return cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None


def _parse(kind: Callable[[], T], message: Message) -> T:
    box = kind()
    try:
        box.ParseFromString(message.data)  # type: ignore[attr-defined]
    except (DecodeError, UnicodeDecodeError) as wrong:
        raise DamagedFile(f"{message.topic}: a message is no {box.DESCRIPTOR.full_name} ({wrong})") from wrong  # type: ignore[attr-defined]
    return box


def _damaged_if_malformed(message: Message, build: Callable[[], T]) -> T:
    try:
        return build()
    except ValueError as wrong:
        raise DamagedFile(f"{message.topic}: {wrong}") from wrong


def _numbers(values: Any, count: int) -> Float[Array, " n"]:
    if len(values) != count:
        raise ValueError(f"{len(values)} numbers where {count} were wanted")
    return np.array(values, dtype=np.float64)


def _stamp(timestamp: Any, time_ns: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(int(time_ns), _NANOS)


def _time_ns(timestamp: Any) -> int:
    time_ns = int(timestamp.seconds) * _NANOS + int(timestamp.nanos)
    if not -(1 << 63) <= time_ns < 1 << 63:
        raise DamagedFile(f"a message is stamped {timestamp.seconds} s, which is no time; wanted 64-bit nanoseconds")
    return time_ns


def _set_xyz(vector: Any, values: Float[Array, "3"]) -> None:
    vector.x, vector.y, vector.z = (float(v) for v in values)


def _set_quaternion(quaternion: Any, rotation: Float[Array, "3 3"]) -> None:
    w, x, y, z = (float(v) for v in quaternion_from_rotation(rotation))
    quaternion.w, quaternion.x, quaternion.y, quaternion.z = w, x, y, z
