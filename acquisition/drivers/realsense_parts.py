"""Parts of the RealSense driver: frame counters and stamps, the SDK's options and modes in words."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

from acquisition.devices import DeviceRefused, Stamp
from recordings.errors import DeviceNotFound

WRAP = 1 << 32
"""Frame numbers and the device's microseconds are 32-bit counters: the clock starts over every 71.6 min."""
COLOR_EXPOSURE_UNIT_S = 1e-4
"""D4xx cameras tell the colour sensor's exposure in this unit, the depth sensor's in microseconds."""
STAMP_TOLERANCE_S = 2e-4


class FrameCounter:
    """One stream's frame numbers: 32-bit ones made to grow, gaps counted."""

    def __init__(self) -> None:
        self.received = 0
        self.dropped = 0
        self._number: int | None = None

    def unwrapped(self, number: int) -> int:
        self.received += 1
        if self._number is None:
            self._number = number
            return number
        step = (number - self._number) % WRAP
        if step >= WRAP // 2:  # out of order: what looked like a gap comes late
            self.dropped = max(0, self.dropped - 1)
            return self._number + step - WRAP
        self.dropped += max(0, step - 1)
        self._number += step
        return self._number


def sdk() -> Any:
    try:
        import pyrealsense2
    except ImportError as missing:
        raise DeviceNotFound(
            f"the D455 driver needs pyrealsense2, which is not installed ({missing}); run `pip install -e "
            ".[rig-realsense]`, or replay a session: `toss-record --rig replay:SESSION`"
        ) from missing
    return pyrealsense2


def metadata(rs: Any, frame: Any) -> dict[str, int]:
    names = ("sensor_timestamp", "frame_timestamp", "actual_exposure", "gain_level")
    keys = {name: getattr(rs.frame_metadata_value, name) for name in names}
    return {name: int(frame.get_frame_metadata(k)) for name, k in keys.items() if frame.supports_frame_metadata(k)}


def options(sensors: Iterable[Any]) -> dict[str, float]:
    """Every option that can be read, as "sensor/option"; what a sensor lists but does not give is left out."""
    values = {}
    for sensor in sensors:
        for option in sensor.get_supported_options():
            try:
                values[f"{_sensor_name(sensor)}/{option.name}"] = float(sensor.get_option(option))
            except RuntimeError:
                continue
    return values


def _sensor_name(sensor: Any) -> str:
    import pyrealsense2

    return str(sensor.get_info(pyrealsense2.camera_info.name))


def modes(sensors: Iterable[Any]) -> str:
    """The sizes and rates of colour and depth, for people to read."""
    found = set()
    for sensor in sensors:
        for profile in sensor.get_stream_profiles():
            if profile.is_video_stream_profile() and profile.stream_name() in ("Color", "Depth"):
                video = profile.as_video_stream_profile()
                found.add((profile.stream_name(), video.width(), video.height(), profile.fps()))
    return ", ".join(f"{name} {width}x{height}@{rate}" for name, width, height, rate in sorted(found))


def advanced_settings(rs: Any, device: Any) -> dict[str, Any] | None:
    """All settings of the depth engine as realsense-viewer saves them; None for a camera without advanced mode."""
    try:
        advanced = rs.rs400_advanced_mode(device)
        return dict(json.loads(advanced.serialize_json())) if advanced.is_enabled() else None
    except RuntimeError:
        return None


def preset_number(depth: Any, option: Any, name: str) -> float:
    """The number of the visual preset of this name."""
    spread = depth.get_option_range(option.visual_preset)
    names = {
        str(depth.get_option_value_description(option.visual_preset, float(i))): float(i)
        for i in range(int(spread.min), int(spread.max) + 1)
    }
    if name not in names:
        raise DeviceRefused(f"no preset '{name}'; this camera has {', '.join(names)}")
    return names[name]


def exposure_s(stream: str, values: Mapping[str, int]) -> float:
    """Exposure of an image from its metadata, NaN where it tells none."""
    unit_s = COLOR_EXPOSURE_UNIT_S if stream == "color" else 1e-6
    return values["actual_exposure"] * unit_s if "actual_exposure" in values else math.nan


def hardware_stamp(clock: str, values: Mapping[str, int], exposure: float) -> tuple[Stamp, str] | None:
    """The stamp of the device's clock, and what is odd about it; None where the frame carries no metadata.

    The sensor timestamp is mid-exposure by definition. Where a firmware tells another offset from the frame timestamp
    than half the exposure (an old D435's colour does), the frame timestamp is taken as the exposure's end.
    """
    sensor_us, end_us = values.get("sensor_timestamp"), values.get("frame_timestamp")
    if sensor_us is None:
        return None
    reported_s = 0.0 if end_us is None else ((end_us - sensor_us) % WRAP) * 1e-6
    if end_us is None or math.isnan(exposure) or abs(reported_s - exposure / 2) <= STAMP_TOLERANCE_S:
        return Stamp(clock, sensor_us % WRAP, 1000, WRAP), ""
    contradiction = (
        f"the sensor timestamp lies {1e3 * reported_s:.3f} ms before the frame's, half the exposure is "
        f"{5e2 * exposure:.3f} ms: mid-exposure is taken from the frame timestamp and the exposure"
    )
    return Stamp(clock, end_us % WRAP, 1000, WRAP, "exposure_end"), contradiction
