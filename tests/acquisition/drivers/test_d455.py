"""The RealSense driver: the real pipeline plays recordings of a software device, and one of a real D435."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from acquisition.devices import DeviceLost, DeviceRefused, RgbdCapture
from acquisition.drivers import realsense_parts as parts
from acquisition.drivers import realsense_setup as setup
from acquisition.drivers.d455 import D455Camera, D455Settings
from acquisition.ready_rig import with_factory_models
from acquisition.simulators.realsense_db3 import SoftwareD455
from recordings.errors import BadInput, DeviceNotFound
from recordings.geometry import Transform
from recordings.tracks import RigCalibration

BAG = "librealsense_bag/unit-tests/resources/single_depth_color_640x480.bag"


def played(camera: D455Camera) -> list[RgbdCapture]:
    """Everything until the recording ends; `camera` stays open."""
    camera.start()
    captures = []
    while True:
        try:
            capture = camera.read(1.0)
        except DeviceLost:
            camera.stop()
            return captures
        if capture is not None:
            captures.append(capture)


def test_colour_and_raw_depth_come_apart_each_with_its_own_stamp(db3: Callable[..., Path]) -> None:
    with D455Camera(file=db3("plain"), playback="fast") as camera:
        captures = played(camera)
        place, models = camera.color_from_depth(), camera.cameras()
    assert len(captures) >= 18  # the SDK's pairing may swallow the first
    for capture in captures:
        assert capture.color is not None
        assert capture.depth is not None
        number = capture.color.number
        assert int(capture.color.pixels[0, 0, 0]) == number - 1  # bit for bit what was recorded
        assert int(capture.depth.pixels[0, 0]) == 999 + number
        assert capture.color.stamp.ticks == pytest.approx(1_000_000 + (number - 1) / 30e-6, abs=1)
        assert capture.depth.stamp.ticks - capture.color.stamp.ticks == 4000
        assert (capture.color.stamp.clock, capture.color.stamp.instant) == ("d455/hardware", "mid_exposure")
        assert capture.color.exposure_s == capture.depth.exposure_s == pytest.approx(0.008)
    assert captures[0].unit_m == 0.001
    assert (place.target, place.source) == ("d455", "d455_depth")
    assert place.translation_m == pytest.approx([-0.059, 0, 0])
    assert models["color"].distortion_model == "brown-conrady"


@pytest.mark.parametrize("align", [False, True])
def test_a_session_gets_the_factorys_lenses_and_where_raw_depth_was_seen_from(
    db3: Callable[..., Path], align: bool
) -> None:
    measured = RigCalibration({}, (Transform("world", "d455", np.eye(3), np.array([0.0, 0.0, 1.0])),))
    with D455Camera(file=db3("plain"), playback="fast", settings=D455Settings(align=align)) as camera:
        camera.start()
        models = camera.cameras()
        made = with_factory_models(measured, [camera])
        assert with_factory_models(made, [camera]).to_json() == made.to_json()  # what is known stays
        smaller = replace(made, cameras={"d455": replace(models["color"], width=320)})
        with pytest.raises(BadInput, match=r"d455 is 320x\d+, the camera sends \d+x\d+; wanted one size"):
            with_factory_models(smaller, [camera])
    np.testing.assert_array_equal(made.cameras["d455"].K, models["color"].K)
    assert made.find("world", "d455") is not None
    assert ("d455_depth" in made.cameras) is not align
    if not align:
        assert made.transform("d455", "d455_depth").translation_m == pytest.approx([-0.059, 0, 0])


def test_the_devices_microseconds_wrap_and_gaps_are_counted(db3: Callable[..., Path]) -> None:
    path = db3("wrap", leave_out=range(12, 14), start_us=(1 << 32) - 300_000)
    with D455Camera(file=path) as camera:
        captures = played(camera)
        health = camera.health()
    ticks = [capture.depth.stamp.ticks for capture in captures if capture.depth is not None]
    assert max(ticks) > 4_290_000_000
    assert min(ticks) < 400_000
    assert captures[-1].depth is not None
    assert captures[-1].depth.stamp.wrap_ticks == 1 << 32
    assert health.dropped == {"color": 2, "depth": 2}


def test_aligned_depth_and_infrared_come_when_asked_for(db3: Callable[..., Path]) -> None:
    path = db3("infrared", count=8, infrared=True)
    with D455Camera(file=path, settings=D455Settings(align=True, infrared=True)) as camera:
        captures = played(camera)
        identity, models = camera.color_from_depth(), camera.cameras()
    capture = captures[-1]
    assert capture.aligned
    assert [image.stream for image in capture.infrared] == ["infrared1", "infrared2"]
    number = capture.infrared[0].number
    assert (int(capture.infrared[0].pixels[5, 5]), int(capture.infrared[1].pixels[5, 5])) == (number - 1, 256 - number)
    assert capture.depth is not None
    assert (capture.depth.pixels == 0).any()  # seen from the colour camera, an edge has no depth
    np.testing.assert_array_equal(identity.translation_m, 0)
    assert models["depth"] is models["color"]


def test_frames_without_metadata_are_refused_unless_the_error_is_accepted(db3: Callable[..., Path]) -> None:
    path = db3("blind", count=8, metadata=False)
    with D455Camera(file=path) as camera:
        camera.start()
        with pytest.raises(DeviceRefused, match=r"33 ms off.*allow_system_time"):
            camera.read(2.0)
    with D455Camera(file=path, settings=D455Settings(allow_system_time=True)) as camera:
        stamps = {i.stamp.instant for c in played(camera) for i in c.images()}
        warnings = " ".join(camera.describe()["warnings"])
    assert stamps == {"arrival"}
    assert "off by up to 33 ms" in warnings


def test_a_real_d435_is_played_and_named_for_its_rolling_shutter(data: Callable[[str], Path]) -> None:
    with D455Camera(file=data(BAG), serial="728612070259", playback="fast") as camera:
        capture = played(camera)[0]
        described = json.loads(json.dumps(camera.describe()))
    assert described["firmware"] == "05.09.14.00"
    assert described["options"]["Stereo Module/laser_power"] == 150
    assert any("rolling shutter (colour)" in warning for warning in described["warnings"])
    assert capture.color is not None
    assert capture.depth is not None
    assert capture.depth.stamp.instant == "mid_exposure"
    assert capture.depth.exposure_s == pytest.approx(0.006452)
    # its firmware's colour stamp is no mid-exposure: 32 us before the frame's end, with 16.6 ms of exposure
    assert capture.color.stamp.instant == "exposure_end"
    assert capture.color.mid_exposure_ns == 360_713_523_000 - 8_300_000
    assert any("mid-exposure is taken from the frame timestamp" in warning for warning in described["warnings"])
    assert (capture.depth.pixels > 0).mean() > 0.3


def test_wrong_files_and_serials_say_what_was_found(db3: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(DeviceNotFound, match=r"recorded by Intel RealSense D455 serial 000000000001; wanted serial 7"):
        D455Camera(file=db3("plain"), serial="7").open()
    with pytest.raises(DeviceNotFound, match="no recording at"):
        D455Camera(file=tmp_path / "nothing.db3").open()
    (tmp_path / "broken.db3").write_bytes(b"not a recording")
    with pytest.raises(BadInput, match="cannot be played"):
        D455Camera(file=tmp_path / "broken.db3").open()
    with (
        D455Camera(file=db3("plain")) as camera,
        pytest.raises(DeviceRefused, match="refuses the emitter"),
    ):
        camera.set_emitter(False)


def test_frame_numbers_wrap_at_32_bit_and_late_ones_are_no_gap() -> None:
    counter = parts.FrameCounter()
    first = (1 << 32) - 2
    assert [counter.unwrapped(n % (1 << 32)) - first for n in range(first, first + 5)] == [0, 1, 2, 3, 4]
    assert counter.unwrapped(1) - first == 3  # it came late
    assert counter.unwrapped(6) - first == 8
    assert (counter.received, counter.dropped) == (7, 3)


class Sensor:
    """A sensor's options, as the SDK hands them out; what was set is kept."""

    def __init__(self, refuses: str = "") -> None:
        self.set: dict[str, float] = {}
        self._refuses = refuses

    def supports(self, option: str) -> bool:
        return True

    def set_option(self, option: str, value: float) -> None:
        if option == self._refuses:
            raise RuntimeError("out of range")
        self.set[option] = value


class Names:
    """rs.option, by name."""

    def __getattr__(self, name: str) -> str:
        return name


class Sdk:
    option = Names()


class Camera:
    def __init__(self, refuses: str = "") -> None:
        self.depth, self.color = Sensor(refuses), Sensor(refuses)

    def first_depth_sensor(self) -> Any:
        return self.depth

    def first_color_sensor(self) -> Any:
        return self.color


def test_a_live_camera_gets_its_settings_in_its_own_units() -> None:
    camera = Camera()
    settings = D455Settings(exposure_s=0.004, depth_exposure_s=0.003, gain=32.0, laser_power=150.0)
    setup.set_up(Sdk(), camera, settings)
    assert camera.color.set["exposure"] == 40  # units of 100 us
    assert camera.depth.set["exposure"] == 3000  # us
    assert camera.color.set["enable_auto_exposure"] == camera.depth.set["enable_auto_exposure"] == 0
    assert camera.color.set["auto_exposure_priority"] == 0  # the rate holds
    assert camera.depth.set["global_time_enabled"] == camera.color.set["global_time_enabled"] == 0
    assert (camera.color.set["gain"], camera.depth.set["laser_power"]) == (32, 150)
    with pytest.raises(DeviceRefused, match="the camera refuses the exposure = 40: out of range"):
        setup.set_up(Sdk(), Camera(refuses="exposure"), settings)


def test_a_recording_knows_whose_it_is(db3: Callable[..., Path]) -> None:
    with D455Camera(file=db3("plain")) as camera:
        played(camera)
        described = camera.describe()
    assert described["time_domains"] == {"color": "hardware_clock", "depth": "hardware_clock"}
    assert (described["model"], described["serial"]) == (SoftwareD455().name, SoftwareD455().serial)
    assert described["rate_hz"] == 30
    assert described["warnings"] == []
