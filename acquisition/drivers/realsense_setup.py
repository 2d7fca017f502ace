"""Finding and setting up a RealSense camera, before it streams."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acquisition.devices import DeviceRefused
from acquisition.drivers import realsense_parts as parts
from acquisition.drivers import usb
from recordings.bounded.documents import read_json
from recordings.errors import BadInput, DeviceNotFound

ROLLING = {"D415": "colour and depth", "D435": "colour", "D405": "colour and depth", "D410": "depth"}
"""Models with a rolling shutter, and what of them has it (realsense-ros#3451; librealsense d400-device)."""


@dataclass(frozen=True)
class D455Settings:
    """What is asked of the camera. None leaves the camera's own value or automatic."""

    width: int = 848
    height: int = 480
    color_width: int = 848
    color_height: int = 480
    rate_hz: int = 30
    align: bool = False
    """Depth resampled into the colour image by the SDK."""
    infrared: bool = False
    """Record both infrared images too, so that depth can be computed anew."""
    preset: str | None = None
    """Name of a visual preset, e.g. "High Accuracy"."""
    preset_json: Path | None = None
    """A file of advanced settings, as realsense-viewer saves them."""
    exposure_s: float | None = None
    """Of colour; None: automatic, at a fixed rate."""
    depth_exposure_s: float | None = None
    gain: float | None = None
    laser_power: float | None = None
    allow_system_time: bool = False
    """Accept stamps of the host's clock on arrival where the frames carry no metadata."""


def find_serial(rs: Any, context: Any, name: str, serial: str | None) -> str:
    """The serial of the one camera that fits. Raises DeviceNotFound, naming what is there."""
    info = rs.camera_info
    found = {device.get_info(info.serial_number): device.get_info(info.name) for device in context.query_devices()}
    seen = "; ".join(f"{model} serial {number}" for number, model in found.items()) or "no RealSense camera"
    if serial is None and len(found) == 1:
        return str(next(iter(found)))
    if serial is None and found:
        raise DeviceNotFound(f"{name}: found {seen}; wanted one: name its `serial` in the rig")
    if serial is None or serial not in found:
        wanted = f"serial {serial}" if serial else "a camera"
        raise DeviceNotFound(
            f"{name}: found {seen}; wanted {wanted}{usb.hint(usb.INTEL)}; check the cable (USB 3) and `serial` in the "
            "rig: `toss-record --doctor` lists what is there"
        )
    return serial


def connected() -> list[str]:
    """The RealSense cameras that the SDK sees, in words. Raises DeviceNotFound where it is not installed."""
    rs = parts.sdk()
    info = rs.camera_info
    return [f"{d.get_info(info.name)} serial {d.get_info(info.serial_number)}" for d in rs.context().query_devices()]


def cannot_do(rs: Any, context: Any, name: str, serial: str, wanted: D455Settings, error: RuntimeError) -> str:
    """Why the SDK resolves no streams for these settings, and what the camera can do."""
    for device in context.query_devices():
        if device.get_info(rs.camera_info.serial_number) == serial:
            return (
                f"{name}: wanted {wanted.width}x{wanted.height} depth and {wanted.color_width}x{wanted.color_height} "
                f"colour at {wanted.rate_hz} Hz, which it cannot do ({error}); it can do "
                f"{parts.modes(device.query_sensors())}"
            )
    return f"{name}: serial {serial} is gone again ({error}); check the cable"


def rolling_shutter(model: str) -> str | None:
    """The warning for a model with a rolling shutter."""
    for name, what in ROLLING.items():
        if name in model:
            return (
                f"{model} has a rolling shutter ({what}): a tossed object is sheared in its images and has no single "
                "exposure time; a D455 (global shutter) is wanted"
            )
    return None


def set_up(rs: Any, device: Any, wanted: D455Settings) -> None:
    """Apply the settings to a live camera. Raises DeviceRefused with the camera's own words."""
    depth, color, option = device.first_depth_sensor(), device.first_color_sensor(), rs.option
    for sensor in (depth, color):
        if sensor.supports(option.global_time_enabled):
            set_option(sensor, option.global_time_enabled, 0.0, "global time")
    if wanted.preset_json is not None:
        _load_json(rs, device, wanted.preset_json)
    if wanted.preset is not None:
        number = parts.preset_number(depth, option, wanted.preset)
        set_option(depth, option.visual_preset, number, "the preset")
    if color.supports(option.auto_exposure_priority):
        set_option(color, option.auto_exposure_priority, 0.0, "the fixed rate")  # else exposure slows the stream
    _expose(color, option, wanted.exposure_s, parts.COLOR_EXPOSURE_UNIT_S)
    _expose(depth, option, wanted.depth_exposure_s, 1e-6)
    if wanted.gain is not None:
        set_option(color, option.gain, wanted.gain, "the gain")
    if wanted.laser_power is not None:
        set_option(depth, option.laser_power, wanted.laser_power, "the laser power")


def set_option(sensor: Any, option: Any, value: float, what: str) -> None:
    try:
        sensor.set_option(option, value)
    except RuntimeError as error:
        raise DeviceRefused(f"the camera refuses {what} = {value:g}: {error}") from error


def _expose(sensor: Any, option: Any, exposure_s: float | None, unit_s: float) -> None:
    set_option(sensor, option.enable_auto_exposure, 1.0 if exposure_s is None else 0.0, "automatic exposure")
    if exposure_s is not None:
        set_option(sensor, option.exposure, float(round(exposure_s / unit_s)), "the exposure")


def _load_json(rs: Any, device: Any, path: Path) -> None:
    try:
        read_json(path)
    except BadInput as error:
        raise BadInput(f"{error}: no file of camera settings; save one with realsense-viewer") from error
    rs.rs400_advanced_mode(device).load_json(path.read_text())
