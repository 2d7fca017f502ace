"""`toss-session import realsense`: recordings of RealSense cameras, .bag (up to 2.56) and .db3 (from 2.58 on).

Every frame of every sensor is read as it was recorded: nothing is paired, dropped or aligned on the way. Colour and
depth keep their own stamps; depth stays in the depth camera's frame, with its intrinsics and its place beside colour.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.errors import BadInput, DeviceNotFound
from recordings.geometry import CameraModel, Transform
from recordings.importers import common
from recordings.importers.common import ImportReport, Warnings
from recordings.importers.lens import fit_brown_conrady
from recordings.importers.realsense_file import recorded
from recordings.mcap.toss_writer import TossWriter
from recordings.progress import Progress, Silent
from recordings.records import DepthImage, EncodedImage
from recordings.tracks import RigCalibration

SUFFIXES = (".bag", ".db3")
WAITING = 8
"""Frames that the playback may be ahead of the writer."""
LAST_CALLBACKS_S = 0.25
SILENT_S = 10.0
"""A playback that gives nothing for so long and never ends is broken."""
STAMPS = ("frame_timestamp", "sensor_timestamp", "time_of_arrival")


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame as the playback gives it. `stamp_ms` is on the device's clock, `metadata` its STAMPS."""

    kind: str
    number: int
    stamp_ms: float
    domain: str
    form: str
    pixels: Array
    metadata: Mapping[str, int]

    @property
    def time_ns(self) -> int:
        """Mid-exposure: the device's `sensor_timestamp` where it says one, seen from its `frame_timestamp`."""
        late_us = self.metadata.get("frame_timestamp", 0) - self.metadata.get("sensor_timestamp", 0)
        known = len({"frame_timestamp", "sensor_timestamp"} & set(self.metadata)) == 2 and 0 <= late_us < 1_000_000
        return round(self.stamp_ms * 1e6) - (late_us * 1000 if known else 0)


@dataclass
class _Clock:
    """Stamps of one stream as they come: unwraps a 32-bit microsecond counter, refuses what goes back."""

    where: str
    last_ns: int | None = None
    last_number: int | None = None
    turns: int = 0

    def stamp(self, frame: _Frame, warnings: Warnings) -> int | None:
        """The frame's time, or None for a frame that was given before."""
        if frame.number == self.last_number:
            warnings.add(f"{self.where}: frame {frame.number} was recorded twice; its second copy is left out")
            return None
        time_ns = frame.time_ns + self.turns * common.WRAP_32BIT_US_NS
        if self.last_ns is not None and time_ns < self.last_ns - common.WRAP_32BIT_US_NS // 2:
            self.turns += 1
            time_ns += common.WRAP_32BIT_US_NS
            warnings.add(
                f"{self.where}: the device's 32-bit microsecond counter wrapped at frame {frame.number}: unwrapped"
            )
        if self.last_ns is not None and time_ns <= self.last_ns:
            raise BadInput(
                f"{self.where}: frame {frame.number} is stamped {time_ns / 1e9:.6f} s, not after the frame before it "
                f"({self.last_ns / 1e9:.6f} s); wanted stamps that grow"
            )
        self.last_ns, self.last_number = time_ns, frame.number
        return time_ns


@dataclass
class _Seen:
    """What a toss turned out to hold."""

    domains: set[str] = field(default_factory=set)
    counts: dict[str, int] = field(default_factory=lambda: {"color": 0, "depth": 0})


def import_realsense(sources: Sequence[Path], out: Path, progress: Progress | None = None) -> ImportReport:
    """Make a session at `out`, one toss per recording. Raises BadInput, WriteFailed or DeviceNotFound (no
    pyrealsense2); then nothing is left at `out`."""
    progress, warnings = progress or Silent(), Warnings()
    for source in sources:
        _check_file(source)
    calibration, about = _describe(sources[0], warnings)
    for source in sources[1:]:
        _same_rig(_describe(source, warnings)[0], calibration, source)
    warnings.add(
        "the camera's place in the world is not known: `toss-calibrate table SESSION` or edit calibration.json"
    )
    start = common.new_start(
        out,
        "realsense",
        sources[0],
        "the device's own, moved to mid-exposure where it says sensor_timestamp",
        assumed=False,
        object={"name": "object"},
    )
    start["rig"] = {"cameras": ["d455"], "d455": about}
    with common.new_session(out, start, calibration) as writer:
        for number, source in enumerate(sources):
            progress.step(number, len(sources), source.name)
            with writer.toss(number, {"source": source.name}) as toss:
                _write_toss(toss, source, about["depth_unit_m"], warnings)
    progress.step(len(sources), len(sources))
    return common.report(writer, "realsense", warnings)


def _check_file(source: Path) -> None:
    if source.suffix not in SUFFIXES:
        raise BadInput(f"{source}: wanted a RealSense recording, .bag or .db3 (ROS bags: `toss-session import rosbag`)")
    if not source.is_file():
        raise BadInput(f"{source} does not exist; wanted a RealSense recording, .bag or .db3")
    try:
        with open(source, "rb") as data:
            start = data.read(16)
    except OSError as refused:
        raise BadInput(f"{source} cannot be read: {refused.strerror}") from refused
    wanted = b"#ROSBAG" if source.suffix == ".bag" else b"SQLite format 3\0"
    if not start.startswith(wanted):
        raise BadInput(f"{source} begins with {start[:8]!r}; wanted {wanted!r}, as a {source.suffix} recording does")
    recorded(source)  # what the SDK is given is known to hold images


def _sdk() -> Any:
    try:
        import pyrealsense2
    except ImportError as missing:
        raise DeviceNotFound(
            "reading RealSense recordings needs pyrealsense2, which is not installed; run `pip install -e "
            ".[rig-realsense]`"
        ) from missing
    return pyrealsense2


@contextmanager
def _playback(source: Path) -> Iterator[Any]:
    """A recording as a device. Whatever the SDK raises comes out as BadInput."""
    rs = _sdk()
    try:
        device = rs.context().load_device(str(source))
        device.set_real_time(False)
        yield device
    except RuntimeError as wrong:
        raise BadInput(f"{source} cannot be played by the RealSense SDK ({wrong}); is it whole?") from wrong


def _describe(source: Path, warnings: Warnings) -> tuple[RigCalibration, dict[str, Any]]:
    """Cameras, their places and the device's own words, without playing."""
    rs = _sdk()
    with _playback(source) as device:
        profiles = {p.stream_type(): p for s in device.query_sensors() for p in s.get_stream_profiles()}
        color, depth = profiles.get(rs.stream.color), profiles.get(rs.stream.depth)
        if color is None or depth is None:
            there = sorted(str(p.stream_name()) for p in profiles.values())
            raise BadInput(f"{source} has the streams {there}; wanted colour and depth")
        others = sorted(
            {str(p.stream_name()) for t, p in profiles.items() if t not in (rs.stream.color, rs.stream.depth)}
        )
        if others:
            warnings.add(f"streams {', '.join(others)} are left out: a session keeps colour and depth")
        cameras = {
            "d455": camera_model(color, "d455", warnings),
            "d455_depth": camera_model(depth, "d455_depth", warnings),
        }
        units = [s.as_depth_sensor().get_depth_scale() for s in device.query_sensors() if s.is_depth_sensor()]
        about = {"depth_unit_m": float(f"{units[0]:.7g}"), "depth_aligned_to_color": False, "fps": color.fps()}
        for name in ("name", "serial_number", "firmware_version", "product_line"):
            key = getattr(rs.camera_info, name)
            if device.supports(key):
                about[name] = device.get_info(key)
        place = color_from_depth(depth, color, "d455", "d455_depth")
    return RigCalibration(cameras, (place,)), about


def color_from_depth(depth: Any, color: Any, color_frame: str, depth_frame: str) -> Transform:
    """The factory's extrinsics between two stream profiles."""
    place = depth.get_extrinsics_to(color)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(place.rotation).reshape(3, 3).T  # librealsense stores columns
    matrix[:3, 3] = place.translation
    return Transform.from_matrix(color_frame, depth_frame, matrix)


def camera_model(profile: Any, frame: str, warnings: Warnings) -> CameraModel:
    """The factory's intrinsics of a stream profile; a lens model that this project lacks is fitted, and said so."""
    rs = _sdk()
    lens = profile.as_video_stream_profile().get_intrinsics()
    K = np.array([[lens.fx, 0, lens.ppx], [0, lens.fy, lens.ppy], [0, 0, 1]])
    if not any(lens.coeffs):
        return CameraModel(frame, lens.width, lens.height, K)
    if lens.model == rs.distortion.brown_conrady:
        return CameraModel(frame, lens.width, lens.height, K, "brown-conrady", tuple(lens.coeffs))
    if lens.model == rs.distortion.kannala_brandt4:
        return CameraModel(frame, lens.width, lens.height, K, "fisheye", tuple(lens.coeffs[:4]))

    def rays(pixels: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
        return np.array([rs.rs2_deproject_pixel_to_point(lens, list(p), 1.0)[:2] for p in pixels])

    coefficients, off_px = fit_brown_conrady(rays, K, lens.width, lens.height)
    warnings.add(
        f"{frame}: lens model {lens.model} was fitted by Brown-Conrady coefficients, to {off_px:.3f} px at worst"
    )
    return CameraModel(frame, lens.width, lens.height, K, "brown-conrady", coefficients)


def _same_rig(found: RigCalibration, wanted: RigCalibration, source: Path) -> None:
    for name, camera in wanted.cameras.items():
        other = found.camera(name)
        same_size = (other.width, other.height) == (camera.width, camera.height)
        if not same_size or not np.allclose(other.K, camera.K, atol=1e-3):
            raise BadInput(
                f"{source} was recorded with another {name} camera than the first recording; make two sessions"
            )


def _write_toss(toss: TossWriter, source: Path, unit_m: float, warnings: Warnings) -> None:
    clocks = {kind: _Clock(f"{source.name} {kind}") for kind in ("color", "depth")}
    seen = _Seen()
    for frame in _frames(source):
        time_ns = clocks[frame.kind].stamp(frame, warnings)
        if time_ns is None:
            toss.dropped(f"/d455/{frame.kind}")
            continue
        seen.domains.add(frame.domain)
        seen.counts[frame.kind] += 1
        if frame.kind == "depth":
            toss.depth(DepthImage("d455", frame.number, time_ns, time_ns, unit_m, frame.pixels))
        else:
            rgb = _rgb(frame, source)
            size = (rgb.shape[1], rgb.shape[0])
            toss.color(EncodedImage("d455", frame.number, time_ns, time_ns, "rgb8", *size, rgb.tobytes()))
    if seen.counts["color"] == 0:
        raise BadInput(f"{source} holds {seen.counts['depth']} depth and no colour images; is it whole?")
    for kind, wanted in recorded(source).counts.items():
        found = seen.counts[kind] + toss.streams().get(f"/d455/{kind}", {}).get("dropped", 0)
        if found != wanted:
            raise BadInput(
                f"{source}: the RealSense SDK gave {found} of its {wanted} {kind} images; is it whole? Try again"
            )
    for domain in sorted(seen.domains - {"hardware_clock"}):
        warnings.add(f"{source.name}: stamps are of the domain {domain}, not of the device's own clock")


def _frames(source: Path) -> Iterator[_Frame]:
    """Every colour and depth frame of a recording, in the order of the recording, without loss."""
    rs = _sdk()
    waiting: queue.Queue[_Frame] = queue.Queue(WAITING)
    ended, left, started = threading.Event(), threading.Event(), threading.Event()
    first = recorded(source).first_sensor

    def take(frame: Any) -> None:
        started.wait()  # the playback waits with us: it begins with the first sensor, and none may miss a frame
        if not left.is_set():
            waiting.put(_copied(frame))

    with _playback(source) as device:
        device.set_status_changed_callback(lambda s: ended.set() if s == rs.playback_status.stopped else None)
        opened = _open_sensors(device)
        try:
            for number in sorted(opened, key=lambda n: n != first):
                opened[number].start(take)
            started.set()
            yield from _drained(waiting, ended, source)
        finally:
            left.set()
            started.set()
            _empty(waiting)
            for sensor in opened.values():
                if sensor.get_active_streams():
                    sensor.stop()
                    sensor.close()


def _open_sensors(device: Any) -> dict[int, Any]:
    """The sensors that give colour or depth by their number, opened for one stream of each."""
    rs = _sdk()
    opened, wanted = {}, {rs.stream.color, rs.stream.depth}
    for number, sensor in enumerate(device.query_sensors()):
        chosen: dict[Any, Any] = {}
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() in wanted:
                chosen.setdefault(profile.stream_type(), profile)
        if chosen:
            sensor.open(list(chosen.values()))
            opened[number] = sensor
            wanted -= set(chosen)
    return opened


def _drained(waiting: queue.Queue[_Frame], ended: threading.Event, source: Path) -> Iterator[_Frame]:
    """Frames until the playback has ended and the last callbacks have had time to deliver theirs."""
    quiet_s, step_s = 0.0, 0.1
    while True:
        try:
            yield waiting.get(timeout=step_s)
            quiet_s = 0.0
        except queue.Empty:
            quiet_s += step_s
            if ended.is_set() and quiet_s > LAST_CALLBACKS_S:
                return
            if quiet_s > SILENT_S:
                raise BadInput(f"{source}: the playback stopped giving frames before its end; is it whole?") from None


def _empty(waiting: queue.Queue[_Frame]) -> None:
    """Let a callback that waits for room go on."""
    try:
        while True:
            waiting.get_nowait()
    except queue.Empty:
        pass


def _copied(frame: Any) -> _Frame:
    rs = _sdk()
    profile = frame.get_profile()
    values = {}
    for name in STAMPS:
        key = getattr(rs.frame_metadata_value, name)
        if frame.supports_frame_metadata(key):
            values[name] = int(frame.get_frame_metadata(key))
    return _Frame(
        kind="depth" if profile.stream_type() == rs.stream.depth else "color",
        number=int(frame.get_frame_number()),
        stamp_ms=float(frame.get_timestamp()),
        domain=str(frame.get_frame_timestamp_domain()).removeprefix("timestamp_domain."),
        form=str(profile.format()).removeprefix("format."),
        pixels=np.asanyarray(frame.get_data()).copy(),
        metadata=values,
    )


def _rgb(frame: _Frame, source: Path) -> Array:
    """RGB pixels (h w 3, uint8) of the formats that colour sensors record."""
    import cv2

    pixels = frame.pixels
    if frame.form == "rgb8":
        return pixels
    codes = {"bgr8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB}
    if frame.form in codes:
        return cv2.cvtColor(pixels, codes[frame.form])
    if frame.form in ("yuyv", "uyvy"):
        code = cv2.COLOR_YUV2RGB_YUY2 if frame.form == "yuyv" else cv2.COLOR_YUV2RGB_UYVY
        return cv2.cvtColor(pixels.view(np.uint8).reshape(*pixels.shape[:2], 2), code)
    raise BadInput(f"{source}: colour in {frame.form}; wanted rgb8, bgr8, rgba8, bgra8, yuyv or uyvy")
