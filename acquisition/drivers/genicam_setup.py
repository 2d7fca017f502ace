"""What is asked of a GenICam camera, and how it is told."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

from acquisition.devices import DeviceRefused, Instant
from acquisition.drivers.aravis import Aravis, AravisError

CHUNKS = ("Timestamp", "ExposureTime", "Gain")
RATE_TOLERANCE = 0.01


@dataclass(frozen=True)
class GenicamSettings:
    """What is asked of the camera. None leaves the camera's own value."""

    width: int | None = None
    height: int | None = None
    offset_x: int = 0
    offset_y: int = 0
    rate_hz: float | None = 30.0
    """Frames per second; without effect while triggered."""
    exposure_s: float | None = 0.001
    gain_db: float | None = None
    trigger: str = "free"
    """"free", "software", or the name of the input line."""
    strobe_line: str | None = None
    """Output line that is high while this camera exposes."""
    chunks: bool = True
    """Ask for the timestamp, exposure and gain of each image inside the image, where the camera can."""
    timestamp_marks: Instant = "exposure_start"
    """Which moment the camera's timestamp means. Models differ; `toss-calibrate time` finds what remains."""
    packet_bytes: int | None = None
    """GigE packet size; None lets Aravis find the largest that gets through."""
    buffers: int = 16


def connected() -> list[str]:
    """The cameras that Aravis sees, in words. Raises DeviceNotFound where it is not installed."""
    return [str(found) for found in Aravis.get().found()]


def apply(aravis: Aravis, camera: int, settings: GenicamSettings, warnings: list[str]) -> dict[str, Any]:
    """Set everything; what the camera granted. Raises AravisError or DeviceRefused."""
    if settings.width is not None and settings.height is not None:
        region = (settings.offset_x, settings.offset_y, settings.width, settings.height)
        aravis.call("arv_camera_set_region", camera, *region)
    aravis.call("arv_camera_set_pixel_format_from_string", camera, "Mono8")
    if settings.exposure_s is not None:
        if aravis.call("arv_camera_is_exposure_auto_available", camera):
            aravis.call("arv_camera_set_exposure_time_auto", camera, 0)
        aravis.call("arv_camera_set_exposure_time", camera, settings.exposure_s * 1e6)
    if settings.gain_db is not None:
        if aravis.call("arv_camera_is_gain_auto_available", camera):
            aravis.call("arv_camera_set_gain_auto", camera, 0)
        aravis.call("arv_camera_set_gain", camera, settings.gain_db)
    granted: dict[str, Any] = {"exposure_s": aravis.call("arv_camera_get_exposure_time", camera) * 1e-6}
    _set_trigger(aravis, camera, settings, granted)
    if aravis.call("arv_camera_is_gv_device", camera):
        _set_packets(aravis, camera, settings, warnings)
    granted["chunks"] = settings.chunks and _set_chunks(aravis, camera, warnings)
    if aravis.call("arv_camera_is_feature_available", camera, "DeviceVersion"):
        granted["firmware"] = aravis.call("arv_camera_get_string", camera, "DeviceVersion")
    return granted


def _set_trigger(aravis: Aravis, camera: int, settings: GenicamSettings, granted: dict[str, Any]) -> None:
    if settings.trigger == "free":
        aravis.call("arv_camera_clear_triggers", camera)
        if settings.rate_hz is not None:
            granted["rate_hz"] = _set_rate(aravis, camera, settings.rate_hz)
    else:
        source = "Software" if settings.trigger == "software" else settings.trigger
        try:
            aravis.call("arv_camera_set_trigger", camera, source)
        except AravisError as error:
            raise DeviceRefused(f"the camera has no trigger source '{source}': {error}") from error
        granted["rate_hz"] = settings.rate_hz
    if settings.strobe_line is not None:
        try:
            for feature, value in (
                ("LineSelector", settings.strobe_line),
                ("LineMode", "Output"),
                ("LineSource", "ExposureActive"),
            ):
                aravis.call("arv_camera_set_string", camera, feature, value)
        except AravisError as error:
            raise DeviceRefused(f"line '{settings.strobe_line}' cannot tell the exposure: {error}") from error


def _set_rate(aravis: Aravis, camera: int, rate_hz: float) -> float:
    low, high = ctypes.c_double(), ctypes.c_double()
    aravis.call("arv_camera_get_frame_rate_bounds", camera, ctypes.byref(low), ctypes.byref(high))
    if rate_hz > high.value > 0:
        raise DeviceRefused(
            f"the camera does at most {high.value:.2f} frames/s at this size and exposure, wanted {rate_hz:g}; "
            "choose a smaller image, a shorter exposure or a lower rate"
        )
    aravis.call("arv_camera_set_frame_rate", camera, rate_hz)
    granted = float(aravis.call("arv_camera_get_frame_rate", camera))
    if abs(granted - rate_hz) > RATE_TOLERANCE * rate_hz:
        raise DeviceRefused(f"the camera does {granted:.2f} frames/s, wanted {rate_hz:g}; take a rate it can do")
    return granted


def _set_packets(aravis: Aravis, camera: int, settings: GenicamSettings, warnings: list[str]) -> None:
    if settings.packet_bytes is not None:
        aravis.call("arv_camera_gv_set_packet_size", camera, settings.packet_bytes)
        return
    size = aravis.call("arv_camera_gv_auto_packet_size", camera)
    if size < 8000:
        warnings.append(f"GigE packets of {size} bytes: set the network's MTU to 9000 to lower the load")


def _set_chunks(aravis: Aravis, camera: int, warnings: list[str]) -> bool:
    """Whether images now carry their timestamp, exposure and gain."""
    if not aravis.call("arv_camera_is_feature_available", camera, "ChunkModeActive"):
        warnings.append("no chunk data: stamps are the transport's, exposures those that were set")
        return False
    try:
        aravis.call("arv_camera_set_chunks", camera, ",".join(CHUNKS))
    except AravisError as error:
        warnings.append(f"chunk data refused ({error}): stamps are the transport's, exposures those that were set")
        return False
    return True
