"""The GenICam driver: the real Aravis against simulated GigE Vision cameras, over the real protocol."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from acquisition.devices import DeviceRefused, Image
from acquisition.drivers import aravis as binding
from acquisition.drivers import genicam
from acquisition.drivers.aravis import Aravis
from acquisition.drivers.genicam import GenicamCamera, GenicamSettings
from acquisition.simulators.gige import FakeGvCamera
from recordings.errors import DeviceNotFound

SETTINGS = GenicamSettings(width=320, height=240, rate_hz=50.0, packet_bytes=1400)
LAB = GenicamSettings(width=1440, height=1080, trigger="software", packet_bytes=8000)
TRIGGERS = 12


@pytest.fixture(scope="module")
def three(aravis: list[str]) -> Iterator[list[str]]:
    """Serials of three cameras, each at its own address."""
    serials = ["GV01", "GV02", "GV03"]
    with ExitStack() as stack:
        for address, serial in zip(aravis, serials):
            stack.enter_context(FakeGvCamera(address, serial))
        yield serials


def test_three_triggered_cameras_give_every_frame_of_every_trigger(three: list[str]) -> None:
    with ExitStack() as stack:
        cameras = [stack.enter_context(GenicamCamera(f"mono{i}", serial=s, settings=LAB)) for i, s in enumerate(three)]
        for camera in cameras:
            camera.start()
        images: list[list[Image]] = [[] for _ in cameras]
        for _ in range(TRIGGERS):
            for camera in cameras:
                camera.trigger()
            for camera, mine in zip(cameras, images):
                image = camera.read(1.0)
                assert image is not None
                mine.append(image)
        assert [camera.read(0.1) for camera in cameras] == [None, None, None]  # none without a trigger
        for camera, mine in zip(cameras, images):
            assert np.diff([image.number for image in mine]).tolist() == [1] * (TRIGGERS - 1)
            assert mine[0].pixels.shape == (1080, 1440)
            assert mine[0].stamp.clock == f"{camera.name}/camera"
            assert not camera.health().dropped


def test_a_free_running_camera_keeps_its_rate_by_its_own_stamps(three: list[str]) -> None:
    bright = replace(SETTINGS, exposure_s=0.01)
    with GenicamCamera(serial=three[0], settings=bright) as camera:
        camera.start()
        images = [camera.read(1.0) for _ in range(20)]
    stamps = np.array([image.stamp.device_ns for image in images if image is not None])
    assert np.median(np.diff(stamps)) * 1e-9 == pytest.approx(1 / 50, rel=0.05)
    assert images[0] is not None
    assert images[0].exposure_s == pytest.approx(0.01)
    assert np.ptp(images[0].pixels) > 100  # the fake's ramp, not zeros


HOLDER = """
import sys, time
from acquisition.drivers.genicam import GenicamCamera, GenicamSettings
with GenicamCamera(serial=sys.argv[1], settings=GenicamSettings(rate_hz=50.0, packet_bytes=1400)) as camera:
    camera.start()
    print("it streams", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
def test_a_camera_of_another_program_is_refused_and_one_whose_program_died_streams(
    three: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, "-c", HOLDER, three[2]]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "it streams\n"
        camera = GenicamCamera(serial=three[2], settings=SETTINGS)
        with monkeypatch.context() as impatient:
            impatient.setattr(genicam, "HEARTBEAT_S", 1.0)
            with pytest.raises(DeviceRefused, match="controlled by another program; close that one first"):
                camera.open()
        other.kill()
    with camera:
        camera.start()
        assert camera.read(5.0) is not None


def test_what_the_camera_cannot_do_is_refused(three: list[str]) -> None:
    for settings, words in (
        (replace(SETTINGS, rate_hz=1e5), "at most 1000.00 frames/s"),
        (replace(SETTINGS, trigger="Line77"), "no trigger source 'Line77'"),
        (replace(SETTINGS, strobe_line="Line2"), "line 'Line2' cannot tell the exposure"),
    ):
        with pytest.raises(DeviceRefused, match=words):
            GenicamCamera(serial=three[0], settings=settings).open()
    with GenicamCamera(serial=three[0], settings=SETTINGS) as camera:
        with pytest.raises(DeviceRefused, match='trigger = "software"'):
            camera.trigger()
        assert any("no chunk data" in warning for warning in camera.describe()["warnings"])


def test_without_a_serial_several_cameras_are_too_many(three: list[str]) -> None:
    with pytest.raises(DeviceNotFound, match=r"GV01.*GV02.*GV03.*name its `serial`"):
        GenicamCamera().open()


def test_incomplete_images_are_counted_and_never_handed_over(aravis: list[str]) -> None:
    # 2 % of 55 packets an image: two images of three miss one; Aravis cannot ask the fake to send again.
    with (
        FakeGvCamera(aravis[3], "GV09", lost_per_mille=20),
        GenicamCamera(serial="GV09", settings=SETTINGS) as camera,
    ):
        camera.start()
        end, whole = time.monotonic() + 1.0, [camera.read(1.0)]
        while time.monotonic() < end:
            whole.append(camera.read(1.0))  # the last one is whole too: its number counts all before it
        health = camera.health()
    lost = sum(health.dropped.values())
    assert health.dropped["mono0:incomplete"] > 5
    assert whole[-1] is not None
    assert len(whole) + lost == pytest.approx(whole[-1].number - 65401 + 1, abs=4)  # the fake counts from 65401


def test_a_missing_aravis_says_what_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(binding, "LIBRARY", "libaravis-nowhere.so")
    with pytest.raises(DeviceNotFound, match="apt-get install -y --no-install-recommends libaravis-0.8-0"):
        Aravis()
