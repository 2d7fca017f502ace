"""Intel RealSense D455 (and its D400 relatives) through pyrealsense2: colour and raw depth, each with its own stamps.

Depth stays in its own camera's frame, with the factory's extrinsics beside it: the vendor's align smears edges onto the
background and cannot be undone (`align = true` asks for it all the same). No filter is applied.
Stamps are the sensor timestamps of the frames' metadata: 32-bit microseconds of the device's clock at mid-exposure. The
SDK's "global time" is switched off: it follows the host's wall clock, and with it every step of NTP.
`file` plays a recording (.db3 or .bag) through the same pipeline, in its own time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import numpy as np

from acquisition.devices import DeviceLost, DeviceRefused, Health, Image, RgbdCapture, Stamp
from acquisition.drivers import realsense_parts as parts
from acquisition.drivers.lifecycle import OpenedByContext
from acquisition.drivers.realsense_setup import (
    D455Settings,
    cannot_do,
    find_serial,
    rolling_shutter,
    set_option,
    set_up,
)
from recordings.errors import BadInput, DeviceNotFound
from recordings.geometry import CameraModel, Transform
from recordings.importers.common import Warnings
from recordings.importers.realsense import camera_model, color_from_depth

COLOR_FRAME, DEPTH_FRAME = "d455", "d455_depth"
QUEUE = 32
LAST_FRAMES_MS = 300


class D455Camera(OpenedByContext):
    """The camera with this serial (None: the only one there), or the recording `file`."""

    def __init__(
        self,
        name: str = "d455",
        serial: str | None = None,
        file: Path | None = None,
        settings: D455Settings | None = None,
        playback: Literal["real_time", "fast"] = "real_time",
    ) -> None:
        self.name = name
        self._serial, self._file, self._playback = serial, file, playback
        self._settings = settings or D455Settings()
        self._rs: Any = None
        self._profile: Any = None
        self._lock = threading.RLock()
        self._running = False
        self._reset()

    def _reset(self) -> None:
        self._pipeline: Any = None
        self._queue: Any = None
        self._align: Any = None
        self._lost: str | None = None
        self._warnings = Warnings()
        self._counters: dict[str, parts.FrameCounter] = {}
        self._about: dict[str, Any] = {}
        self._domains: dict[str, str] = {}
        self._unit_m = 0.001

    # --- life --------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Find the device, check that it can do what is asked, set it up."""
        self.close()
        self._reset()
        self._rs = parts.sdk()
        self._context = self._rs.context()
        serial = (
            find_serial(self._rs, self._context, self.name, self._serial) if self._file is None else self._check_file()
        )
        self._pipeline = self._rs.pipeline(self._context)
        try:
            self._profile = self._config(serial).resolve(self._rs.pipeline_wrapper(self._pipeline))
        except RuntimeError as error:
            if self._file is not None:
                raise BadInput(f"{self._file} cannot be played by the RealSense SDK ({error}); is it whole?") from error
            reason = cannot_do(self._rs, self._context, self.name, serial, self._settings, error)
            raise DeviceRefused(reason) from error
        device = self._profile.get_device()
        self._check_serial(device)
        self._describe_device(device)
        if self._file is None:
            set_up(self._rs, device, self._settings)
            self._about["options"] = parts.options(device.query_sensors())
            self._about["advanced"] = parts.advanced_settings(self._rs, device)
            self._context.set_devices_changed_callback(self._on_devices)

    def start(self) -> None:
        with self._lock:
            if self._running:
                return
            if self._pipeline is None:
                raise DeviceRefused(f"{self.name} is not open; call open() first")
            self._counters, self._lost = {}, None
            fast = self._file is not None and self._playback == "fast"
            self._queue = None if fast else self._rs.frame_queue(QUEUE, True)
            config = self._config(str(self._about["serial"]))
            if self._file is not None:  # before it starts, or the first frames go their own pace
                resolved = config.resolve(self._rs.pipeline_wrapper(self._pipeline))
                resolved.get_device().as_playback().set_real_time(not fast)
            self._profile = self._start(config) if fast else self._start(config, self._queue)
            self._align = self._rs.align(self._rs.stream.color) if self._settings.align else None
            self._running = True

    def stop(self) -> None:
        with self._lock:
            running, self._running = self._running, False
        if running:
            stopping = threading.Thread(target=self._stop_pipeline, daemon=True)
            stopping.start()
            stopping.join(1.8)  # a device that was pulled out may keep the SDK waiting

    def close(self) -> None:
        self.stop()
        with self._lock:
            self._pipeline = self._queue = self._profile = None

    def read(self, timeout_s: float) -> RgbdCapture | None:
        """The next pair. A capture without metadata is refused unless `allow_system_time`."""
        frames = self._next(timeout_s)
        return None if frames is None else self._capture(frames)

    def set_emitter(self, on: bool) -> None:
        set_option(self._sensor("depth"), self._rs.option.emitter_enabled, 1.0 if on else 0.0, "the emitter")

    # --- what it is --------------------------------------------------------------------------------------------

    def describe(self) -> dict[str, Any]:
        settings = asdict(self._settings)
        if self._settings.preset_json is not None:
            settings["preset_json"] = self._settings.preset_json.name
        return {
            "kind": "rgbd",
            "driver": f"pyrealsense2 {self._rs.__version__ if hasattr(self._rs, '__version__') else ''}".strip(),
            **self._about,
            "time_domains": dict(self._domains),
            "settings": settings,
            "warnings": list(self._warnings.all()),
        }

    def cameras(self) -> Mapping[str, CameraModel]:
        models = {"color": camera_model(self._stream("color"), COLOR_FRAME, self._warnings)}
        if self._settings.align:
            return models | {"depth": models["color"]}
        models["depth"] = camera_model(self._stream("depth"), DEPTH_FRAME, self._warnings)
        for index in (1, 2) if self._settings.infrared else ():
            models[f"infrared{index}"] = camera_model(
                self._stream(f"infrared{index}"), f"d455_ir{index}", self._warnings
            )
        return models

    def color_from_depth(self) -> Transform:
        if self._settings.align:
            return Transform.identity(COLOR_FRAME, COLOR_FRAME)
        return color_from_depth(self._stream("depth"), self._stream("color"), COLOR_FRAME, DEPTH_FRAME)

    def health(self) -> Health:
        received = {name: counter.received for name, counter in self._counters.items()}
        dropped = {name: counter.dropped for name, counter in self._counters.items() if counter.dropped}
        if self._lost is not None:
            return Health("error", self._lost, received, dropped)
        lost = sum(dropped.values())
        return Health("warning" if lost else "ok", f"{lost} images lost" if lost else "", received, dropped)

    # --- finding and setting up --------------------------------------------------------------------------------

    def _check_file(self) -> str:
        assert self._file is not None
        if not self._file.is_file():
            raise DeviceNotFound(f"{self.name}: no recording at {self._file}; wanted a .db3 or .bag file")
        return ""

    def _config(self, serial: str) -> Any:
        config, rs, wanted = self._rs.config(), self._rs, self._settings
        if self._file is not None:
            rs.config.enable_device_from_file(config, str(self._file), repeat_playback=False)
            return config
        config.enable_device(serial)
        config.enable_stream(rs.stream.depth, wanted.width, wanted.height, rs.format.z16, wanted.rate_hz)
        color = (wanted.color_width, wanted.color_height)
        config.enable_stream(rs.stream.color, *color, rs.format.rgb8, wanted.rate_hz)
        for index in (1, 2) if wanted.infrared else ():
            config.enable_stream(rs.stream.infrared, index, wanted.width, wanted.height, rs.format.y8, wanted.rate_hz)
        return config

    def _check_serial(self, device: Any) -> None:
        serial = device.get_info(self._rs.camera_info.serial_number)
        if self._serial is not None and serial != self._serial:
            name = device.get_info(self._rs.camera_info.name)
            raise DeviceNotFound(
                f"{self.name}: {self._file} was recorded by {name} serial {serial}; wanted serial {self._serial}"
            )

    def _describe_device(self, device: Any) -> None:
        info = self._rs.camera_info
        keys = {"model": info.name, "serial": info.serial_number, "firmware": info.firmware_version}
        self._about = {key: device.get_info(value) if device.supports(value) else "" for key, value in keys.items()}
        self._about["rate_hz"] = self._stream("color").fps()
        self._unit_m = float(f"{device.first_depth_sensor().get_depth_scale():.7g}")
        self._about["depth_unit_m"] = self._unit_m
        self._about["options"] = parts.options(device.query_sensors())
        warning = rolling_shutter(self._about["model"])
        if warning is not None:
            self._warnings.add(warning)
        if self._file is not None:
            self._about["file"] = self._file.name

    def _sensor(self, kind: str) -> Any:
        if self._profile is None:
            raise DeviceRefused(f"{self.name} is not open; call open() first")
        device = self._profile.get_device()
        return device.first_depth_sensor() if kind == "depth" else device.first_color_sensor()

    def _stream(self, name: str) -> Any:
        if self._profile is None:
            raise DeviceRefused(f"{self.name} is not open; call open() first")
        stream = self._rs.stream
        index = int(name[-1]) if name.startswith("infrared") else -1
        kind = stream.infrared if index > 0 else getattr(stream, name)
        try:
            return self._profile.get_stream(kind, index).as_video_stream_profile()
        except RuntimeError as error:
            raise DeviceRefused(f"{self.name} has no {name} stream: {error}") from error

    # --- streaming ---------------------------------------------------------------------------------------------

    def _start(self, *arguments: Any) -> Any:
        try:
            return self._pipeline.start(*arguments)
        except RuntimeError as error:
            hint = (
                "install the udev rules of librealsense, replug it and check your groups"
                if "ermission" in str(error) or "power state" in str(error)
                else "does another program hold it?"
            )
            raise DeviceRefused(f"{self.name} does not start ({error}); {hint}") from error

    def _has_ended(self) -> bool:
        """Whether the recording that is played has come to its end."""
        if self._file is None:
            return False
        status = self._profile.get_device().as_playback().current_status()
        return bool(status == self._rs.playback_status.stopped)

    def _stop_pipeline(self) -> None:
        try:
            self._pipeline.stop()
        except RuntimeError as error:
            self._lost = self._lost or f"{self.name} did not stop: {error}; replug it"

    def _on_devices(self, changes: Any) -> None:
        if self._profile is not None and changes.was_removed(self._profile.get_device()):
            self._lost = (
                f"{self.name} ({self._about['model']} serial {self._about['serial']}) was unplugged; replug, reopen"
            )

    def _next(self, timeout_s: float) -> Any:
        """The next frameset, or None. Raises DeviceLost when none will come."""
        with self._lock:
            running, queue, pipeline = self._running, self._queue, self._pipeline
        if not running:
            raise DeviceRefused(f"{self.name} is not streaming; call start() first")
        wait = pipeline.try_wait_for_frames if queue is None else queue.try_wait_for_frame
        end = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, end - time.monotonic())
            ended = self._has_ended()  # asked first: what was played until then is still on its way
            came, frame = wait(LAST_FRAMES_MS if ended else max(1, round(1000 * min(left_s, 0.1))))
            if came:
                return frame.as_frameset()
            if ended:
                self._lost = f"{self.name}: the recording {self._file} has ended"
            if self._lost is not None:
                raise DeviceLost(self._lost)
            if left_s == 0.0:
                return None

    def _capture(self, frames: Any) -> RgbdCapture:
        host_ns = time.monotonic_ns()
        infrared = []
        for index in (1, 2) if self._settings.infrared else ():
            frame = frames.get_infrared_frame(index)
            if frame:
                infrared.append(self._image(f"infrared{index}", frame, frame, host_ns))
        depth, color = frames.get_depth_frame(), frames.get_color_frame()
        shown = depth
        if self._align is not None and depth and color:
            shown = self._align.process(frames).get_depth_frame()
        return RgbdCapture(
            color=self._image("color", color, color, host_ns) if color else None,
            depth=self._image("depth", depth, shown, host_ns) if depth else None,
            unit_m=self._unit_m,
            aligned=self._align is not None,
            infrared=tuple(infrared),
        )

    def _image(self, stream: str, frame: Any, shown: Any, host_ns: int) -> Image:
        """`frame` carries the stamps, `shown` the pixels (the same one, unless it was aligned)."""
        values = parts.metadata(self._rs, frame)
        self._domains[stream] = str(frame.get_frame_timestamp_domain()).removeprefix("timestamp_domain.")
        exposure = parts.exposure_s(stream, values)
        counter = self._counters.setdefault(stream, parts.FrameCounter())
        return Image(
            stream=stream,
            number=counter.unwrapped(int(frame.get_frame_number())),
            stamp=self._stamp(stream, frame, values, exposure),
            host_ns=host_ns,
            pixels=np.asanyarray(shown.get_data()).copy(),
            exposure_s=exposure,
            gain=float(values.get("gain_level", float("nan"))),
        )

    def _stamp(self, stream: str, frame: Any, values: Mapping[str, int], exposure_s: float) -> Stamp:
        stamped = parts.hardware_stamp(f"{self.name}/hardware", values, exposure_s)
        if stamped is not None:
            if stamped[1]:
                self._warnings.add(f"{stream}: {stamped[1]}")
            return stamped[0]
        period_ms = 1e3 / max(1, self._about["rate_hz"])
        if not self._settings.allow_system_time:
            raise DeviceRefused(
                f"{self.name}: {stream} images carry no metadata, so their stamps ({self._domains[stream]}) tell the "
                f"arrival at the host, up to {period_ms:.0f} ms off; install librealsense's kernel patch or its libuvc "
                "backend, or set allow_system_time = true to record all the same"
            )
        self._warnings.add(
            f"{stream}: stamped by the host's clock on arrival; capture times are off by up to {period_ms:.0f} ms, "
            "and by every step of the wall clock"
        )
        return Stamp("host/wall", round(frame.get_timestamp() * 1e6), instant="arrival")
