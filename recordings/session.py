"""Reading a session: a folder as `toss-record` and `toss-session import` write it, or one toss's file alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Generic, TypeVar, overload

import numpy as np
from jaxtyping import Float32, Int64
from numpy import ndarray as Array

from recordings import sync
from recordings.alignment.align import align_depth
from recordings.bounded.documents import (
    FORMAT_VERSION,
    mapping,
    parse_document,
    parse_json,
    positive_number,
    read_document,
    whole_number,
)
from recordings.errors import BadInput, DamagedFile
from recordings.geometry import CameraModel
from recordings.given_masks import GivenMasks
from recordings.mcap import arm_codec, codec
from recordings.mcap.file import McapFile, Message
from recordings.records import (
    ArmStates,
    DepthImage,
    EncodedImage,
    HealthLine,
    RgbdFrame,
    StampedPose,
    TossCommand,
    TossEvent,
    TossWindow,
    depth_in_metres,
)
from recordings.tracks import RigCalibration

T_co = TypeVar("T_co", covariant=True)
PAIR_WITHIN_PERIODS = 0.75
"""A depth image belongs to a colour image when it is nearer than this share of the frame period."""


class Frames(Sequence, Generic[T_co]):  # not Sequence[T_co]: type checks in tests would decode a frame at every call
    """Frames of one stream, decoded when asked for. `times_ns` are mid-exposure times."""

    def __init__(self, times_ns: Int64[Array, " n"], load: Callable[[int], T_co]) -> None:
        self.times_ns = times_ns
        self._load = load

    def __len__(self) -> int:
        return len(self.times_ns)

    @overload
    def __getitem__(self, position: int) -> T_co: ...
    @overload
    def __getitem__(self, position: slice) -> Sequence[T_co]: ...
    def __getitem__(self, position: int | slice) -> T_co | Sequence[T_co]:
        if isinstance(position, slice):
            chosen = range(len(self))[position]
            return Frames(self.times_ns[position], lambda i: self._load(chosen[i]))
        if not -len(self) <= position < len(self):
            raise IndexError(f"frame {position} of {len(self)}")
        return self._load(position % len(self))

    def __iter__(self) -> Iterator[T_co]:
        return (self._load(i) for i in range(len(self)))

    def nearest(self, time_ns: int) -> int:
        """Position of the frame nearest to a time. Raises BadInput when there is no frame."""
        if len(self) == 0:
            raise BadInput("this stream has no frames")
        return int(np.abs(self.times_ns - time_ns).argmin())


class RgbdFrames(Frames[RgbdFrame]):
    """Colour frames with the depth that belongs to each, aligned to colour.

    `depth_times_ns` equals `times_ns` where a colour image has no depth image (its depth is all 0); those positions are
    in `without_depth`. `unused_depth` counts depth images that belong to no colour image.
    """

    def __init__(
        self,
        times_ns: Int64[Array, " n"],
        load: Callable[[int], RgbdFrame],
        depth_times_ns: Int64[Array, " n"],
        without_depth: tuple[int, ...],
        unused_depth: int,
    ) -> None:
        super().__init__(times_ns, load)
        self.depth_times_ns = depth_times_ns
        self.without_depth = without_depth
        self.unused_depth = unused_depth


@dataclass(frozen=True)
class StreamInfo:
    """One topic of a toss's file. Times are log times (host receive)."""

    topic: str
    schema: str
    count: int
    first_ns: int | None
    last_ns: int | None
    metadata: Mapping[str, str] = field(default_factory=dict)


class Toss:
    """One toss's file, opened. Raises BadInput or DamagedFile as McapFile does."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = McapFile(path)
        self.calibration = _read_attached_calibration(self.file)
        self.info = _own_metadata(self.file)
        self.index = whole_number(self.info.get("toss", 0), f"{path}: its toss number")

    def __reduce__(self) -> tuple[type[Toss], tuple[Path]]:
        return Toss, (self.path,)  # another process opens it anew

    def __enter__(self) -> Toss:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self.file.close()

    def streams(self) -> dict[str, StreamInfo]:
        """Every topic with its count and its first and last log time."""
        found = {}
        for topic in sorted(self.file.channels):
            times = self.file.topic_index(topic).log_time_ns
            first, last = (int(times[0]), int(times[-1])) if len(times) else (None, None)
            metadata = self.file.channels[topic].metadata
            found[topic] = StreamInfo(topic, self._schema(topic), len(times), first, last, metadata)
        return found

    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that have images here."""
        names = [t.split("/")[1] for t in self.file.channels if t.endswith(("/color", "/image")) and t.count("/") == 2]
        return tuple(sorted(names))

    def color(self, camera: str = "d455") -> Frames[EncodedImage]:
        return self._images(f"/{camera}/color", camera)

    def mono(self, camera: str) -> Frames[EncodedImage]:
        return self._images(f"/{camera}/image", camera)

    def depth(self, camera: str = "d455") -> Frames[DepthImage]:
        topic = f"/{camera}/depth"
        if topic not in self.file.channels:
            return Frames(
                np.zeros(0, dtype=np.int64), lambda i: codec.read_depth(self.file.read(topic, i), camera, "", 0)
            )
        unit_m = positive_number(
            self.file.channels[topic].metadata.get("unit_m", "0.001"), f"{self.path}: {topic} unit_m"
        )
        schema = self._schema(topic)
        times_ns = self.file.publish_times_ns(topic)
        return Frames(times_ns, lambda i: codec.read_depth(self.file.read(topic, i), camera, schema, unit_m))

    def rgbd(self, camera: str = "d455") -> RgbdFrames:
        """Colour frames with their depth, aligned. Raises BadInput where a stream or the way to align is missing."""
        colors, depths = self.color(camera), self.depth(camera)
        if len(colors) == 0:
            raise BadInput(f"{self.path.name} has no images on /{camera}/color; it has {sorted(self.file.channels)}")
        if len(depths) == 0:
            raise BadInput(f"{self.path.name} has no images on /{camera}/depth; it has {sorted(self.file.channels)}")
        period_ns = sync.frame_period_ns(colors.times_ns) or 33_333_333
        pairs = sync.pair_nearest(colors.times_ns, depths.times_ns, int(PAIR_WITHIN_PERIODS * period_ns))
        depth_times_ns = colors.times_ns.copy()
        paired = pairs != sync.UNPAIRED
        depth_times_ns[paired] = depths.times_ns[pairs[paired]]
        aligner = self._aligner(camera)

        def load(i: int) -> RgbdFrame:
            image = colors[i]
            rgb: Array = codec.decode_image(image)
            depth_m: Array = np.zeros(rgb.shape[:2], dtype=np.float32)
            if paired[i]:
                depth_m = aligner(depth_in_metres(depths[int(pairs[i])]))
            if depth_m.shape != rgb.shape[:2]:
                raise BadInput(
                    f"{self.path.name}: colour is {rgb.shape[1]}x{rgb.shape[0]}, depth {depth_m.shape[1]}x"
                    f"{depth_m.shape[0]} and not aligned to it; wanted the depth camera's intrinsics and its place "
                    f"({camera}_depth) in calibration.json"
                )
            return RgbdFrame(camera, image.index, image.time_ns, int(depth_times_ns[i]), rgb, depth_m)

        missing = tuple(int(i) for i in np.flatnonzero(~paired))
        return RgbdFrames(colors.times_ns, load, depth_times_ns, missing, len(depths) - int(paired.sum()))

    def masks(self) -> GivenMasks:
        """Given masks of the object by position of the colour frame in the toss."""
        return GivenMasks(self.file)

    def arm_states(self) -> ArmStates | None:
        messages = [m.data for m in self.file.messages(arm_codec.TOPIC)]
        return arm_codec.read_arm(messages) if messages else None

    def events(self) -> tuple[TossEvent, ...]:
        return tuple(codec.read_event(m) for m in self.file.messages("/toss/event"))

    def command(self) -> TossCommand | None:
        """The last toss command; None where the arm was not told."""
        commands = [codec.read_command(m) for m in self.file.messages("/toss/command")]
        return commands[-1] if commands else None

    def health(self) -> tuple[HealthLine, ...]:
        return tuple(codec.read_health(m) for m in self.file.messages("/health"))

    def window(self) -> TossWindow:
        """Release, first impact and rest as far as events tell them."""
        times = {e.kind: e.time_ns for e in self.events()}
        return TossWindow(self.index, times.get("release"), times.get("first_impact"), times.get("rest"))

    def poses(self, topic: str = "/track/pose") -> tuple[StampedPose, ...]:
        quality: dict[tuple[int, int], Message] = {
            (m.publish_time_ns, m.sequence): m for m in self.file.messages(f"{topic}_quality")
        }
        return tuple(
            codec.read_pose(m, quality.get((m.publish_time_ns, m.sequence))) for m in self.file.messages(topic)
        )

    def _images(self, topic: str, camera: str) -> Frames[EncodedImage]:
        if topic not in self.file.channels:
            return Frames(
                np.zeros(0, dtype=np.int64), lambda i: codec.read_image(self.file.read(topic, i), camera, "", (0, 0))
            )
        metadata, schema = self.file.channels[topic].metadata, self._schema(topic)
        try:
            size = (int(metadata["width"]), int(metadata["height"]))
        except (KeyError, ValueError) as wrong:
            raise DamagedFile(f"{self.path}: {topic} does not say its image size") from wrong
        return Frames(
            self.file.publish_times_ns(topic),
            lambda i: codec.read_image(self.file.read(topic, i), camera, schema, size),
        )

    def _schema(self, topic: str) -> str:
        schema = self.file.schema(topic)
        return schema.name if schema is not None else ""

    def _aligner(self, camera: str) -> Callable[[Float32[Array, "h w"]], Float32[Array, "hc wc"]]:
        depth_camera = self.calibration.cameras.get(f"{camera}_depth")
        if depth_camera is None:
            return lambda depth_m: depth_m
        color_camera: CameraModel = self.calibration.camera(camera)
        color_from_depth = self.calibration.transform(color_camera.frame, depth_camera.frame)
        return lambda depth_m: align_depth(depth_m, depth_camera, color_camera, color_from_depth)


class Session:
    """A session on disk. Opening reads only the documents; a damaged toss is reported when that toss is asked for."""

    def __init__(
        self, path: Path, document: Mapping[str, Any], calibration: RigCalibration, files: Mapping[int, Path]
    ) -> None:
        self.path = path
        self.calibration = calibration
        self.start: Mapping[str, Any] = mapping(document.get("start"), f"{path}: its start document")
        self.stop: Mapping[str, Any] = mapping(document.get("stop"), f"{path}: its stop document")
        self._files = files
        self._open: dict[int, Toss] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_open": {}}  # another process opens its files anew

    def __enter__(self) -> Session:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @staticmethod
    def open(path: Path) -> Session:
        """Open a session folder, or the file of one toss. Raises BadInput or DamagedFile with what to type next."""
        if not path.exists():
            raise BadInput(f"{path} does not exist; wanted a session folder or an .mcap file")
        return _open_folder(path) if path.is_dir() else _open_file(path)

    def with_calibration(self, calibration: RigCalibration) -> Session:
        """The same session seen with another calibration; nothing on disk changes."""
        other = Session(self.path, {"start": self.start, "stop": self.stop}, calibration, self._files)
        other._open = self._open
        return other

    @property
    def name(self) -> str:
        return str(self.start.get("name") or self.path.resolve().name.removesuffix(".mcap"))

    @property
    def tosses(self) -> tuple[int, ...]:
        return tuple(sorted(self._files))

    @property
    def object_name(self) -> str:
        return str(mapping(self.start.get("object"), f"{self.path}: its object").get("name", "object"))

    @cached_property
    def truth_folder(self) -> Path | None:
        """The session's own truth/, where there is one. Only the scorer may look into it."""
        folder = self.path / "truth"
        return folder if (folder / "truth.json").exists() else None

    def file(self, toss: int) -> Path:
        if toss not in self._files:
            raise BadInput(f"{self.path} has no toss {toss}; it has {', '.join(map(str, self.tosses)) or 'none'}")
        return self._files[toss]

    def toss(self, toss: int) -> Toss:
        if toss not in self._open:
            opened = Toss(self.file(toss))
            if self._open.setdefault(toss, opened) is not opened:  # another thread was faster
                opened.close()
        return self._open[toss]

    def close(self) -> None:
        for toss in self._open.values():
            toss.close()
        self._open.clear()


def _open_folder(path: Path) -> Session:
    files = {}
    for file in sorted(path.glob("toss_*.mcap")):
        if file.stem[5:].isdigit():
            files[int(file.stem[5:])] = file
    document_path = path / "session.json"
    if not files and list(path.glob("toss_*/rgb")):
        raise BadInput(
            f"{path} is a folder layout, not yet a session; bring it in: "
            f"`toss-session import folder {path} NEW_SESSION`"
        )
    if not document_path.exists():
        raise BadInput(f"{path} has no session.json, so it is no session")
    document = read_document(document_path)
    calibration_path = path / "calibration.json"
    if calibration_path.exists():
        calibration = RigCalibration.read(calibration_path)
    else:
        calibration = RigCalibration(cameras={})
        if files:
            with Toss(files[min(files)]) as toss:
                calibration = toss.calibration
    return Session(path, document, calibration, files)


def _open_file(path: Path) -> Session:
    toss = Toss(path)
    attached = toss.file.attachment("session.json")
    document = parse_document(attached, f"{path}: session.json") if attached else {}
    stop = toss.file.metadata("tosslab.stop")
    streams = parse_json(stop[-1].get("streams", "{}"), f"{path}: its counts") if stop else {}
    document = {
        **document,
        "stop": {"status": stop[-1].get("status", "") if stop else "", "streams": {path.stem: streams}},
    }
    session = Session(path, document, toss.calibration, {toss.index: path})
    session._open[toss.index] = toss
    return session


def _own_metadata(file: McapFile) -> Mapping[str, Any]:
    own = file.metadata("tosslab")
    if not own:
        raise BadInput(
            f"{file.path} is an MCAP file, but not one of tosslab's: it has the topics {sorted(file.channels)}. "
            "Recordings of ROS come in by `toss-session import rosbag`"
        )
    version = own[0].get("format_version")
    if version != str(FORMAT_VERSION):
        raise BadInput(f"{file.path}: format_version {version!r}; this tosslab reads {FORMAT_VERSION}")
    info = parse_json(own[0].get("info", "{}"), f"{file.path}: its metadata")
    return info if isinstance(info, dict) else {}


def _read_attached_calibration(file: McapFile) -> RigCalibration:
    attached = file.attachment("calibration.json")
    if attached is None:
        return RigCalibration(cameras={})
    name = f"{file.path}: calibration.json"
    return RigCalibration.from_json(mapping(parse_json(attached, name), name))
