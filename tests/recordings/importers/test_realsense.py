"""RealSense recordings: a .db3 made here with the SDK's recorder, and the real .bag of the shared data."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.importers.lens import fit_brown_conrady
from recordings.importers.realsense import import_realsense
from recordings.mcap.codec import decode_image
from recordings.session import Session

rs = pytest.importorskip("pyrealsense2")
WIDTH, HEIGHT, FPS = 64, 48, 60
REAL_BAG = "librealsense_bag/unit-tests/resources/single_depth_color_640x480.bag"


def lens(f: float, coefficients: list[float]) -> rs.intrinsics:
    found = rs.intrinsics()
    found.width, found.height, found.fx, found.fy, found.ppx, found.ppy = WIDTH, HEIGHT, f, f, 31.5, 23.5
    found.model = rs.distortion.inverse_brown_conrady if any(coefficients) else rs.distortion.brown_conrady
    found.coeffs = coefficients
    return found


def stream(kind: rs.stream, uid: int, size: int, form: rs.format, intrinsics: rs.intrinsics) -> rs.video_stream:
    found = rs.video_stream()
    found.type, found.index, found.uid, found.width, found.height = kind, 0, uid, WIDTH, HEIGHT
    found.fps, found.bpp, found.fmt, found.intrinsics = FPS, size, form, intrinsics
    return found


def color_pixels(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_pixels(i: int) -> np.ndarray:
    return np.random.default_rng(100 + i).integers(300, 3000, (HEIGHT, WIDTH)).astype(np.uint16)


Record = Callable[..., Path]


@pytest.fixture
def record(tmp_path: Path) -> Record:
    """`record(stamps_ms, ...)` makes a .db3 as the SDK's recorder does, from a software device."""

    def make(
        stamps_ms: list[float],
        *,
        name: str = "take.db3",
        unit_m: float = 0.001,
        late_us: int = 0,
        coefficients: tuple[float, ...] = (0.0,) * 5,
    ) -> Path:
        device = rs.software_device()
        sensors = device.add_sensor("Stereo Module"), device.add_sensor("RGB Camera")
        profiles = (
            sensors[0].add_video_stream(stream(rs.stream.depth, 0, 2, rs.format.z16, lens(42.0, [0.0] * 5))),
            sensors[1].add_video_stream(stream(rs.stream.color, 1, 3, rs.format.rgb8, lens(60.0, list(coefficients)))),
        )
        sensors[0].add_read_only_option(rs.option.depth_units, unit_m)
        place = rs.extrinsics()
        place.rotation, place.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-0.059, 0, 0]
        profiles[0].register_extrinsics_to(profiles[1], place)
        recorder = rs.recorder(str(tmp_path / name), device)
        opened = recorder.query_sensors()
        queues = [rs.frame_queue(50) for _ in opened]
        for sensor, queue in zip(opened, queues, strict=True):
            sensor.open(sensor.get_stream_profiles()[0])
            sensor.start(queue)
        for i, stamp_ms in enumerate(stamps_ms):
            for pixels, profile, sensor, offset_ms in (
                (depth_pixels(i), profiles[0], sensors[0], 0.0),
                (color_pixels(i), profiles[1], sensors[1], 0.4),
            ):
                frame = rs.software_video_frame()
                frame.pixels, frame.bpp = pixels, pixels.itemsize * (3 if pixels.ndim == 3 else 1)
                frame.stride, frame.timestamp = WIDTH * frame.bpp, stamp_ms + offset_ms
                frame.domain, frame.frame_number = rs.timestamp_domain.hardware_clock, 7 + i
                frame.profile = profile.as_video_stream_profile()
                stamp_us = int((stamp_ms + offset_ms) * 1000)
                sensor.set_metadata(rs.frame_metadata_value.frame_timestamp, stamp_us)
                sensor.set_metadata(rs.frame_metadata_value.sensor_timestamp, stamp_us - late_us)
                sensor.on_video_frame(frame)
            time.sleep(0.02)
        for sensor in opened:
            sensor.stop()
            sensor.close()
        del recorder
        return tmp_path / name

    return make


def test_every_frame_comes_in_to_the_last_bit_with_its_number_and_stamp(record: Record, tmp_path):
    stamps_ms = [5000 + i * 1000 / FPS for i in range(12)]
    report = import_realsense([record(stamps_ms)], tmp_path / "session")
    assert report.streams["/d455/color"] == report.streams["/d455/depth"] == 12
    session = Session.open(tmp_path / "session")
    toss = session.toss(0)
    for i in range(12):
        np.testing.assert_array_equal(decode_image(toss.color()[i]), color_pixels(i))
        np.testing.assert_array_equal(toss.depth()[i].raw, depth_pixels(i))
    assert [image.index for image in toss.color()] == list(range(7, 19))
    np.testing.assert_allclose(toss.depth().times_ns / 1e6, stamps_ms, atol=1e-6)
    np.testing.assert_allclose((toss.color().times_ns - toss.depth().times_ns) / 1e6, 0.4, atol=1e-6)


def test_depth_stays_in_its_own_camera_with_unit_intrinsics_and_place(record: Record, tmp_path):
    import_realsense([record([5000.0, 5016.0, 5033.0], unit_m=0.0001)], tmp_path / "session")
    session = Session.open(tmp_path / "session")
    assert session.toss(0).depth()[0].unit_m == 0.0001
    assert session.calibration.camera("d455_depth").fx == 42.0
    assert session.calibration.camera("d455").fx == 60.0
    place = session.calibration.transform("d455", "d455_depth")
    np.testing.assert_allclose(place.translation_m, [-0.059, 0, 0], atol=1e-7)
    assert session.toss(0).rgbd()[1].depth_m.shape == (HEIGHT, WIDTH)
    assert session.start["rig"]["d455"]["depth_aligned_to_color"] is False


def test_stamps_are_moved_to_mid_exposure_where_the_device_says_it(record: Record, tmp_path):
    import_realsense([record([5000.0, 5016.0], late_us=3200)], tmp_path / "session")
    times_ns = Session.open(tmp_path / "session").toss(0).depth().times_ns
    np.testing.assert_allclose(times_ns / 1e6, [5000 - 3.2, 5016 - 3.2], atol=1e-6)


def test_a_counter_of_32_bits_that_wraps_is_unwrapped_aloud(record: Record, tmp_path):
    wrap_ms = 2**32 / 1000
    stamps_ms = [wrap_ms - 20, wrap_ms - 3, 14.0, 31.0]
    report = import_realsense([record(stamps_ms)], tmp_path / "session")
    times_ns = Session.open(tmp_path / "session").toss(0).depth().times_ns
    np.testing.assert_allclose(np.diff(times_ns) / 1e6, [17, 17, 17], atol=1e-3)
    assert any("32-bit" in w for w in report.warnings)


@pytest.mark.parametrize("stamps_ms", [[5000.0, 5016.0, 5010.0], [5000.0, 5016.0, 5016.0]])
def test_stamps_that_go_back_or_repeat_are_refused(record: Record, tmp_path, stamps_ms):
    with pytest.raises(BadInput, match="wanted stamps that grow"):
        import_realsense([record(stamps_ms)], tmp_path / "session")
    assert not (tmp_path / "session").exists()


def test_an_inverse_lens_model_is_said_as_brown_conrady(record: Record, tmp_path):
    coefficients = (-0.056, 0.066, 0.0005, -0.0006, -0.021)  # as a D455's colour camera has them
    source = record([5000.0, 5016.0], coefficients=coefficients)
    report = import_realsense([source], tmp_path / "session")
    camera = Session.open(tmp_path / "session").calibration.camera("d455")
    assert camera.distortion_model == "brown-conrady"
    pixels = np.array([[0.0, 0.0], [63.0, 0.0], [31.5, 23.5], [10.0, 40.0]])
    device_lens = lens(60.0, list(coefficients))
    rays = np.array([rs.rs2_deproject_pixel_to_point(device_lens, list(p), 1.0) for p in pixels])
    np.testing.assert_allclose(camera.project(rays), pixels, atol=0.05)
    assert any("fitted by Brown-Conrady" in w for w in report.warnings)


def test_a_lens_without_distortion_is_fitted_by_zeros():
    K = np.array([[60.0, 0, 31.5], [0, 61.0, 23.5], [0, 0, 1]])
    coefficients, off_px = fit_brown_conrady(lambda p: (p - K[:2, 2]) / [60.0, 61.0], K, WIDTH, HEIGHT)
    np.testing.assert_allclose(coefficients, 0, atol=1e-12)
    assert off_px < 1e-9


def test_several_recordings_of_one_camera_are_several_tosses(record: Record, tmp_path):
    files = [record([5000.0 + k, 5016.0 + k], name=f"take_{k}.db3") for k in range(2)]
    assert import_realsense(files, tmp_path / "session").tosses == (0, 1)


def test_the_real_recording_comes_in_whole_and_its_pair_is_not_called_one(data, tmp_path):
    """Colour and depth 170 are 268 ms apart; the other depth frame is 169."""
    import_realsense([data(REAL_BAG)], tmp_path / "session")
    session = Session.open(tmp_path / "session")
    toss = session.toss(0)
    assert [d.index for d in toss.depth()] == [169, 170]
    assert toss.color()[0].index == 162
    assert (toss.depth().times_ns[1] - toss.color().times_ns[0]) / 1e6 == pytest.approx(268.2, abs=6452 / 2 / 1000)
    assert toss.rgbd().without_depth == (0,)
    assert toss.rgbd()[0].depth_m.max() == 0
    assert session.calibration.camera("d455").fx == pytest.approx(613.204, abs=1e-3)
    assert session.calibration.camera("d455_depth").cy == pytest.approx(242.187, abs=1e-3)
    assert toss.depth()[0].unit_m == 0.001


@pytest.mark.parametrize("kept", [0, 5, 13, 100, 300_000, 1_000_000])
def test_a_recording_that_was_cut_off_is_refused(data, tmp_path, kept):
    path = tmp_path / "cut.bag"
    path.write_bytes(data(REAL_BAG).read_bytes()[:kept])
    with pytest.raises(BadInput):
        import_realsense([path], tmp_path / "session")
    assert not (tmp_path / "session").exists()


@pytest.mark.parametrize("name, text", [("a.mcap", "wanted a RealSense recording"), ("a.db3", "does not exist")])
def test_other_files_are_refused(tmp_path, name, text):
    with pytest.raises(BadInput, match=text):
        import_realsense([tmp_path / name], tmp_path / "session")


def test_no_frame_is_lost_when_the_writer_is_slower_than_the_playback(record: Record, tmp_path, monkeypatch):
    from recordings.mcap.toss_writer import TossWriter

    quick = TossWriter.color

    def slow(self, image):
        time.sleep(0.03)
        quick(self, image)

    monkeypatch.setattr(TossWriter, "color", slow)
    report = import_realsense([record([5000.0 + 16 * i for i in range(60)])], tmp_path / "session")
    assert report.streams["/d455/color"] == report.streams["/d455/depth"] == 60
