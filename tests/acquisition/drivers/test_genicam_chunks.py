"""The GenICam driver against our own GigE Vision camera: chunk data, trigger lines, lost triggers."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from acquisition.devices import Image
from acquisition.drivers.genicam import GenicamCamera, GenicamSettings
from acquisition.simulators.gige_camera import GigeCamera

pytestmark = pytest.mark.usefixtures("needs_aravis")
SETTINGS = GenicamSettings(width=320, height=240, rate_hz=50.0, packet_bytes=1400)


def test_chunks_carry_each_images_own_start_of_exposure_time_and_gain(loopback_network: list[str]) -> None:
    settings = replace(SETTINGS, exposure_s=0.002, gain_db=3.0)
    with (
        GigeCamera(loopback_network[0], "SIM1", clock_ns=time.monotonic_ns(), readout_s=10.0),
        GenicamCamera(serial="SIM1", settings=settings) as camera,
    ):
        camera.start()
        images = [image for image in (camera.read(1.0) for _ in range(5)) if image is not None]
        assert camera.describe()["settings"]["chunks"] is True
        assert camera.describe()["warnings"] == []
    assert len(images) == 5
    for image in images:
        assert (image.exposure_s, image.gain) == (pytest.approx(0.002), 3.0)
        assert image.mid_exposure_ns - image.stamp.ticks == 1_000_000
    # This camera's clock is the host's: by the chunk an image began before its receipt, by the leader 10 s after it.
    assert all(image.host_ns - image.stamp.ticks > 0 for image in images)


def test_one_pulse_on_the_line_exposes_three_cameras_and_a_lost_one_leaves_no_number(
    loopback_network: list[str],
) -> None:
    settings = replace(SETTINGS, trigger="Line0", strobe_line="Line2")
    with ExitStack() as stack:
        rigged = [stack.enter_context(GigeCamera(a, f"SIM{i}")) for i, a in enumerate(loopback_network[:3])]
        cameras = [
            stack.enter_context(GenicamCamera(f"mono{i}", serial=f"SIM{i}", settings=settings)) for i in range(3)
        ]
        for camera in cameras:
            camera.start()

        def pulse() -> list[Image | None]:
            for device in rigged:
                device.pulse()
            return [camera.read(0.5) for camera in cameras]

        first = pulse()
        rigged[1].inject("lost_trigger", for_s=0.3)
        second = pulse()
        time.sleep(0.3)
        rigged[2].inject("gap", for_s=0.3)
        third = pulse()
        time.sleep(0.3)
        rigged[0].inject("frozen", for_s=0.3)
        fourth = pulse()
        strobes = [device.snapshot()["strobe_line"] for device in rigged]
        dropped = [camera.health().dropped for camera in cameras]
    numbers = [[None if image is None else image.number for image in row] for row in (first, second, third, fourth)]
    assert numbers == [[1, 1, 1], [2, None, 2], [3, 2, None], [4, 3, 4]]
    assert dropped == [{}, {}, {"mono2:gap": 1}]  # a lost trigger shows only against the other cameras
    assert strobes == [2, 2, 2]
    assert fourth[0] is not None
    assert int(fourth[0].pixels[0, 0]) == 0  # frozen: the ramp no longer moves with the number
    stamps = [image.stamp.device_ns for image in first if image is not None]
    assert np.ptp(stamps) < 50e6
