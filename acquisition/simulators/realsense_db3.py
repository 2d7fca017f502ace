"""Recordings of a D455 that was never there: pyrealsense2's software device, recorded by its own recorder.

    write_db3(path, plain_frames(30))
    D455Camera(file=path)                    # the real pipeline plays it

A software device cannot feed a pipeline; its recording can. Recording takes as long as the frames say, because the
playback keeps the pace of the recording.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray as Array

EPOCH_MS = 1.7e12
"""The SDK pairs colour and depth only where their times are of this order."""
WRAP_US = 1 << 32
COLOR_EXPOSURE_UNIT_US = 100
"""D4xx cameras tell the colour sensor's exposure in this unit, the depth sensor's in microseconds."""


@dataclass(frozen=True, eq=False)
class SoftwareFrame:
    """One exposure of colour and depth. Times are the device's own, in microseconds, before they wrap; None: no image.

    Numbers stay below 2^31: the SDK's software frames hold no more, so their wrap cannot be recorded.

    `metadata=False` is a host whose kernel passes none on: stamps are the system's, on arrival.
    """

    color_number: int
    depth_number: int
    color_us: int
    depth_us: int
    color: UInt8[Array, "h w 3"] | None
    depth: UInt16[Array, "h w"] | None
    infrared: tuple[UInt8[Array, "h w"], ...] = ()
    exposure_us: int = 8000
    metadata: bool = True


@dataclass(frozen=True)
class SoftwareD455:
    """What the device says of itself."""

    name: str = "Intel RealSense D455"
    serial: str = "000000000001"
    firmware: str = "5.16.0.1"
    rate_hz: int = 30
    baseline_m: float = 0.059
    color_coefficients: tuple[float, ...] = field(default=(-0.05, 0.06, 0.001, -0.0005, -0.02))


def plain_frames(
    count: int,
    size: tuple[int, int] = (424, 240),
    rate_hz: float = 30.0,
    start_us: int = 1_000_000,
    first_number: int = 1,
    depth_later_us: int = 4000,
    infrared: bool = False,
    metadata: bool = True,
) -> Iterator[SoftwareFrame]:
    """Frames whose content tells their number: red and depth count up, a block marks the place."""
    width, height = size
    for k in range(count):
        color = np.zeros((height, width, 3), dtype=np.uint8)
        color[..., 0] = k
        color[height // 4 : height // 2, width // 4 : width // 2, 1] = 255
        depth = np.full((height, width), 1000 + k, dtype=np.uint16)
        both = (np.full((height, width), k, np.uint8), np.full((height, width), 255 - k, np.uint8))
        at_us = start_us + round(k * 1e6 / rate_hz)
        number = first_number + k
        yield SoftwareFrame(
            number, number, at_us, at_us + depth_later_us, color, depth, both if infrared else (), metadata=metadata
        )


def write_db3(
    path: Path, frames: Sequence[SoftwareFrame] | Iterator[SoftwareFrame], rig: SoftwareD455 | None = None
) -> None:
    """Record the frames as `path` (its name must end in .db3), at the pace of their depth times."""
    frames = list(frames)
    rig = rig or SoftwareD455()
    first = next(frame for frame in frames if frame.color is not None and frame.depth is not None)
    device = _Device(rig, first)
    device.record(path, frames)


class _Device:
    """The software device with its streams, as wide as the first frame."""

    def __init__(self, rig: SoftwareD455, first: SoftwareFrame) -> None:
        import pyrealsense2

        self._rs = pyrealsense2
        self._rig = rig
        self._device = pyrealsense2.software_device()
        info = pyrealsense2.camera_info
        for key, value in (
            (info.name, rig.name),
            (info.serial_number, rig.serial),
            (info.firmware_version, rig.firmware),
            (info.product_line, "D400"),
        ):
            self._device.register_info(key, value)
        stereo, rgb = self._device.add_sensor("Stereo Module"), self._device.add_sensor("RGB Camera")
        assert first.color is not None
        height, width = first.color.shape[:2]
        stream, form = pyrealsense2.stream, pyrealsense2.format
        self._streams: dict[str, tuple[Any, Any, int]] = {}
        self._add("depth", stereo, stream.depth, 0, form.z16, 2, (width, height))
        for i in range(len(first.infrared)):
            self._add(f"infrared{i + 1}", stereo, stream.infrared, i + 1, form.y8, 1, (width, height))
        self._add("color", rgb, stream.color, 0, form.rgb8, 3, (width, height))
        stereo.add_read_only_option(pyrealsense2.option.depth_units, 0.001)
        stereo.add_read_only_option(pyrealsense2.option.stereo_baseline, 95.0)
        place = pyrealsense2.extrinsics()
        place.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        place.translation = [-rig.baseline_m, 0, 0]
        self._streams["depth"][1].register_extrinsics_to(self._streams["color"][1], place)
        self._device.create_matcher(pyrealsense2.matchers.dlr_c)

    def _add(
        self, name: str, sensor: Any, kind: Any, index: int, form: Any, pixel_bytes: int, size: tuple[int, int]
    ) -> None:
        video = self._rs.video_stream()
        video.type, video.index, video.uid = kind, index, len(self._streams)
        video.width, video.height, video.fps, video.bpp, video.fmt = *size, self._rig.rate_hz, pixel_bytes, form
        lens = self._rs.intrinsics()
        lens.width, lens.height = size
        lens.fx = lens.fy = size[0] / 2
        lens.ppx, lens.ppy = (size[0] - 1) / 2, (size[1] - 1) / 2
        lens.model = self._rs.distortion.brown_conrady
        lens.coeffs = list(self._rig.color_coefficients) if name == "color" else [0.0] * 5
        video.intrinsics = lens
        self._streams[name] = (sensor, sensor.add_video_stream(video).as_video_stream_profile(), pixel_bytes)

    def record(self, path: Path, frames: Sequence[SoftwareFrame]) -> None:
        recorder = self._rs.recorder(str(path), self._device)
        sensors = recorder.query_sensors()
        queues = [self._rs.frame_queue(len(frames) * 4) for _ in sensors]
        for sensor, queue in zip(sensors, queues):
            sensor.open(sensor.get_stream_profiles())
            sensor.start(queue)
        began = time.monotonic()
        for frame in frames:
            due = began + (frame.depth_us - frames[0].depth_us) * 1e-6
            time.sleep(max(0.0, due - time.monotonic()))
            self._push(frame)
        for sensor in sensors:
            sensor.stop()
            sensor.close()

    def _push(self, frame: SoftwareFrame) -> None:
        if frame.depth is not None:
            self._send("depth", frame.depth, frame.depth_number, frame.depth_us, frame)
        for i, image in enumerate(frame.infrared):
            self._send(f"infrared{i + 1}", image, frame.depth_number, frame.depth_us, frame)
        if frame.color is not None:
            self._send("color", frame.color, frame.color_number, frame.color_us, frame)

    def _send(self, stream: str, pixels: Array, number: int, at_us: int, frame: SoftwareFrame) -> None:
        sensor, profile, pixel_bytes = self._streams[stream]
        if frame.metadata:
            self._set_metadata(sensor, stream, number, at_us, frame.exposure_us)
        image = self._rs.software_video_frame()
        image.pixels = np.ascontiguousarray(pixels)
        image.stride, image.bpp = pixels.shape[1] * pixel_bytes, pixel_bytes
        image.timestamp = EPOCH_MS + at_us * 1e-3
        domains = self._rs.timestamp_domain
        image.domain = domains.hardware_clock if frame.metadata else domains.system_time
        image.frame_number, image.profile = number, profile
        if stream == "depth":
            image.depth_units = 0.001
        sensor.on_video_frame(image)

    def _set_metadata(self, sensor: Any, stream: str, number: int, at_us: int, exposure_us: int) -> None:
        keys = self._rs.frame_metadata_value
        unit_us = COLOR_EXPOSURE_UNIT_US if stream == "color" else 1
        for key, value in (
            (keys.frame_counter, number),
            (keys.sensor_timestamp, at_us % WRAP_US),
            (keys.frame_timestamp, (at_us + exposure_us // 2) % WRAP_US),
            (keys.actual_exposure, exposure_us // unit_us),
            (keys.gain_level, 16),
        ):
            sensor.set_metadata(key, value)
