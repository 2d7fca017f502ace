"""Joint states at 1 kHz: foxglove.JointStates, whose bytes are the same from sample to sample but for the numbers."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from google.protobuf.message import DecodeError
from google.protobuf.timestamp_pb2 import Timestamp
from jaxtyping import Float, Int64, UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput, DamagedFile
from recordings.records import ArmStates

FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
TOPIC = "/arm/joint_states"
_NANOS = 1_000_000_000
_MARK = -1.2345678901234567e-89  # no joint is ever there: finds where a number's eight bytes lie


def encode_arm(states: ArmStates) -> Iterator[bytes]:
    """Every sample as a message; the finger width becomes the URDF's two finger joints, half of it each."""
    has_fingers = np.isfinite(states.finger_width_m)
    templates = {bool(f): _Template(states.joint_names, bool(f)) for f in np.unique(has_fingers)}
    halves = np.repeat(states.finger_width_m[:, None] / 2, 2, axis=1)
    moving = np.stack([states.q_rad, states.dq_rad_s], axis=-1).reshape(len(states.time_ns), -1)
    bodies = {f: t.fill(np.hstack([moving, halves]) if f else moving) for f, t in templates.items()}
    for i, time_ns in enumerate(states.time_ns.tolist()):
        yield _timestamp(time_ns) + bodies[bool(has_fingers[i])][i].tobytes()


def read_arm(messages: Sequence[bytes]) -> ArmStates:
    """All samples of a toss, in their order. Raises BadInput when the joints change within it."""
    heads = [_split_timestamp(data) for data in messages]
    bodies = [body for _, body in heads]
    if bodies and all(time_ns is not None for time_ns, _ in heads):
        fast = _read_alike(bodies)
        if fast is not None:
            names, q, dq, width_m = fast
            return ArmStates(_times([t for t, _ in heads]), names, q, dq, width_m)
    return _read_each(messages)


class _Template:
    """One serialized sample of these joints, and where its numbers lie."""

    def __init__(self, names: tuple[str, ...], fingers: bool) -> None:
        message = JointStates()
        for name in names:
            message.joints.add(name=name, position=_MARK, velocity=_MARK)
        for name in FINGERS if fingers else ():
            message.joints.add(name=name, position=_MARK)
        self.bytes = np.frombuffer(message.SerializeToString(), dtype=np.uint8)
        self.places = np.array(_places(self.bytes.tobytes(), np.float64(_MARK).tobytes()), dtype=np.int64)

    @property
    def cells(self) -> Array:
        return (self.places[:, None] + np.arange(8)).reshape(-1)

    def fill(self, numbers: Float[Array, "n k"]) -> UInt8[Array, "n size"]:
        rows = np.tile(self.bytes, (len(numbers), 1))
        rows[:, self.cells] = np.ascontiguousarray(numbers, dtype="<f8").view(np.uint8).reshape(len(numbers), -1)
        return rows

    def numbers(self, rows: UInt8[Array, "n size"]) -> Float[Array, "n k"] | None:
        """The inverse of `fill`; None where a row differs in more than its numbers."""
        fixed = np.ones(rows.shape[1], dtype=bool)
        fixed[self.cells] = False
        if (rows[:, fixed] != self.bytes[fixed]).any():
            return None
        return np.ascontiguousarray(rows[:, self.cells]).view("<f8")


def _places(data: bytes, mark: bytes) -> list[int]:
    found, at = [], data.find(mark)
    while at >= 0:
        found.append(at)
        at = data.find(mark, at + len(mark))
    return found


def _read_alike(bodies: list[bytes]) -> tuple[tuple[str, ...], Array, Array, Array] | None:
    """Names, positions, velocities and widths when every sample is laid out as encode_arm does it."""
    first = _parse(bodies[0])
    names = tuple(j.name for j in first.joints if j.name not in FINGERS)
    template = _Template(names, len(names) != len(first.joints))
    if any(len(body) != len(template.bytes) for body in bodies):
        return None
    numbers = template.numbers(np.frombuffer(b"".join(bodies), dtype=np.uint8).reshape(len(bodies), -1))
    if numbers is None:
        return None
    pairs = numbers[:, : 2 * len(names)].reshape(len(bodies), len(names), 2)
    has_fingers = numbers.shape[1] > 2 * len(names)
    width_m = numbers[:, -2:].sum(axis=1) if has_fingers else np.full(len(bodies), np.nan)
    return names, pairs[..., 0].copy(), pairs[..., 1].copy(), width_m


def _read_each(messages: Sequence[bytes]) -> ArmStates:
    boxes = [_parse(data) for data in messages]
    names = tuple(j.name for j in boxes[0].joints if j.name not in FINGERS)
    q = np.empty((len(boxes), len(names)))
    dq = np.empty_like(q)
    width_m = np.full(len(boxes), np.nan)
    for i, box in enumerate(boxes):
        arm = [j for j in box.joints if j.name not in FINGERS]
        if tuple(j.name for j in arm) != names:
            raise BadInput(f"{TOPIC}: sample {i} has joints {[j.name for j in arm]}, the first has {list(names)}")
        q[i], dq[i] = [j.position for j in arm], [j.velocity for j in arm]
        fingers = [j.position for j in box.joints if j.name in FINGERS]
        if fingers:
            width_m[i] = sum(fingers)
    return ArmStates(_times([b.timestamp.seconds * _NANOS + b.timestamp.nanos for b in boxes]), names, q, dq, width_m)


def _times(times_ns: Sequence[int | None]) -> Int64[Array, " n"]:
    try:
        return np.array(times_ns, dtype=np.int64)
    except OverflowError as wrong:
        raise DamagedFile(f"{TOPIC}: a sample's time is beyond 64-bit nanoseconds") from wrong


def _parse(data: bytes) -> JointStates:
    box = JointStates()
    try:
        box.ParseFromString(data)
    except (DecodeError, UnicodeDecodeError) as wrong:
        raise DamagedFile(f"{TOPIC}: a message is no foxglove.JointStates ({wrong})") from wrong
    return box


def _timestamp(time_ns: int) -> bytes:
    """Field 1, a google.protobuf.Timestamp, in protobuf's bytes (zero fields are left out, as protobuf does)."""
    seconds, nanos = divmod(time_ns, _NANOS)
    inner = (b"\x08" + _varint(seconds) if seconds else b"") + (b"\x10" + _varint(nanos) if nanos else b"")
    return b"\x0a" + bytes((len(inner),)) + inner


def _varint(value: int) -> bytes:
    value &= (1 << 64) - 1
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _split_timestamp(data: bytes) -> tuple[int | None, bytes]:
    """Time and rest of a message that begins as _timestamp writes it; None where it does not."""
    if len(data) < 2 or data[0] != 0x0A or data[1] > 22 or 2 + data[1] > len(data):
        return None, b""
    end = 2 + data[1]
    try:
        stamp = Timestamp.FromString(data[2:end])
    except DecodeError:
        return None, b""
    return stamp.seconds * _NANOS + stamp.nanos, data[end:]
