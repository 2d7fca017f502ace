"""A session written and read again: everything comes back, everything wrong is said."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer as PlainWriter

from recordings.errors import BadInput, DamagedFile, TosslabError, WriteFailed
from recordings.geometry import CameraModel, Transform
from recordings.mcap.codec import decode_image
from recordings.mcap.recover_session import recover
from recordings.mcap.toss_writer import TossWriter
from recordings.records import EncodedImage, TossWindow
from recordings.session import Session
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration
from recordings.verify.inspect import inspect
from recordings.verify.verify import verify


def test_every_record_comes_back_as_it_was_written(write_session, small_rig):
    session = Session.open(write_session())
    toss = session.toss(0)
    for i in range(small_rig.frames):
        color, depth, mono = toss.color()[i], toss.depth()[i], toss.mono("mono0")[i]
        assert color.data == small_rig.color(i).data
        assert (color.index, color.time_ns, color.host_time_ns) == (
            small_rig.color(i).index,
            small_rig.color(i).time_ns,
            small_rig.color(i).host_time_ns,
        )
        np.testing.assert_array_equal(depth.raw, small_rig.depth(i).raw)
        assert (depth.time_ns, depth.unit_m) == (small_rig.depth(i).time_ns, 0.001)
        assert decode_image(mono).tobytes() == small_rig.mono(i).data
    arm = toss.arm_states()
    assert arm.q_rad.shape == (33 * small_rig.frames, 7)
    np.testing.assert_array_equal(arm.q_rad[33:66], small_rig.arm(1).q_rad)
    assert (np.diff(arm.time_ns) > 0).all()
    assert toss.window() == TossWindow(0, small_rig.color(2).time_ns, None, None)
    assert toss.command().angular_velocity_world_rad_s.tolist() == [3, 4, 5]
    assert [e.text for e in toss.events()] == ["", "accept"]
    assert toss.health()[0].name == "d455"
    assert toss.masks()[0].sum() == 180
    np.testing.assert_array_equal(toss.poses()[0].covariance, np.eye(6) * 1e-6)
    assert (session.name, session.object_name, session.tosses) == ("small", "cube", (0,))
    assert session.start["clock"] == {"source": "test"}


def test_frames_carry_the_time_of_both_exposures(write_session, small_rig):
    frames = Session.open(write_session()).toss(0).rgbd()
    assert len(frames) == small_rig.frames
    np.testing.assert_array_equal(frames.depth_times_ns - frames.times_ns, 5_000_000)
    assert frames[2].depth_time_ns - frames[2].time_ns == 5_000_000
    np.testing.assert_allclose(frames[2].depth_m, small_rig.depth(2).raw * np.float32(0.001))
    assert [f.index for f in frames[1:3]] == [101, 102]
    assert frames.nearest(small_rig.color(3).time_ns + 10_000_000) == 3
    assert frames[-1].index == 100 + small_rig.frames - 1
    with pytest.raises(IndexError):
        frames[small_rig.frames]


def test_one_file_opens_like_its_session(write_session):
    folder = write_session(tosses=3)
    alone = Session.open(folder / "toss_02.mcap")
    assert alone.tosses == (2,)
    assert alone.object_name == "cube"
    assert alone.calibration.camera("d455").fx == Session.open(folder).calibration.camera("d455").fx
    assert alone.stop["status"] == "complete"
    assert len(alone.toss(2).rgbd()) == 6
    with pytest.raises(BadInput, match="has no toss 0; it has 2"):
        alone.toss(0)


def test_a_file_of_another_name_and_suffix_opens_too(write_session, tmp_path):
    (tmp_path / "saved.bin").write_bytes((write_session() / "toss_00.mcap").read_bytes())
    assert Session.open(tmp_path / "saved.bin").toss(0).index == 0


def test_the_stop_document_counts_and_signs_every_file(write_session, small_rig):
    folder = write_session(tosses=2)
    session = Session.open(folder)
    counts = session.stop["streams"]["toss_01"]
    frames = small_rig.frames
    assert counts["/d455/color"] == {"received": frames, "written": frames, "dropped": 0}
    assert session.stop["tosses"]["toss_01"] == {"toss": 1, "verdict": "accept"}
    for name, sha256 in session.stop["sha256"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == sha256
    assert set(session.stop["sha256"]) == {"toss_00.mcap", "toss_01.mcap", "calibration.json"}


def test_drops_are_counted_in_the_stop_document(tmp_path, small_rig):
    with SessionWriter(tmp_path / "s", {}, small_rig.calibration) as session:
        with session.toss(0) as toss:
            toss.color(small_rig.color(0))
            toss.dropped("/d455/color", 3)
        session.finish()
    counts = Session.open(tmp_path / "s").stop["streams"]["toss_00"]["/d455/color"]
    assert counts == {"received": 4, "written": 1, "dropped": 3}


def write_and_fail(session: SessionWriter, rig, error: BaseException) -> None:
    with session:
        with session.toss(0) as toss:
            rig.write(toss)
        with session.toss(1) as toss:
            toss.color(rig.color(0))
            raise error


def test_a_failure_keeps_the_finished_tosses_and_says_why(tmp_path, small_rig):
    session = SessionWriter(tmp_path / "s", {}, small_rig.calibration)
    with pytest.raises(ValueError, match="broke"):
        write_and_fail(session, small_rig, ValueError("broke"))
    read = Session.open(tmp_path / "s")
    assert (read.stop["status"], read.stop["reason"]) == ("failed", "broke")
    assert list(read.stop["sha256"]) == ["toss_00.mcap", "calibration.json"]
    assert len(read.toss(0).rgbd()) == small_rig.frames
    with pytest.raises(DamagedFile, match=r"toss_01\.mcap was cut off.*toss-session recover"):
        read.toss(1)


def test_ctrl_c_keeps_everything_so_far_in_whole_files(tmp_path, small_rig):
    session = SessionWriter(tmp_path / "s", {}, small_rig.calibration)
    with pytest.raises(KeyboardInterrupt):
        write_and_fail(session, small_rig, KeyboardInterrupt())
    read = Session.open(tmp_path / "s")
    assert read.stop["status"] == "interrupted"
    assert len(read.toss(1).color()) == 1
    report = verify(tmp_path / "s")
    assert report.ok
    assert any("toss_01.mcap" in w.place and "'interrupted'" in w.text for w in report.warnings)


def test_a_full_disk_ends_the_toss_aloud_and_counts_what_was_lost(tmp_path, small_rig, full_disk):
    session = SessionWriter(tmp_path / "s", {}, small_rig.calibration)
    full_disk(2_500_000)
    with pytest.raises(WriteFailed, match="the disk refused a write"):
        write_until_full(session)
    full_disk(1 << 40)
    session.finish("failed", "disk full")
    counts = Session.open(tmp_path / "s").stop["streams"]["toss_00"]["/mono0/image"]
    assert counts["written"] + counts["dropped"] == counts["received"]
    assert counts["dropped"] > 0


def write_until_full(session: SessionWriter) -> None:
    with session.toss(0) as toss:
        for i in range(60):
            noise = np.random.default_rng(i).integers(0, 256, 300 * 400, dtype=np.uint8).tobytes()
            toss.mono(EncodedImage("mono0", i, i * 10**7, i * 10**7, "mono8", 400, 300, noise))


def test_an_existing_folder_is_refused_and_untouched(tmp_path, small_rig):
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "notes.txt").write_text("mine")
    with pytest.raises(BadInput, match="exists already; nothing was written"):
        SessionWriter(tmp_path / "s", {}, small_rig.calibration)
    assert [p.name for p in (tmp_path / "s").iterdir()] == ["notes.txt"]


def test_one_toss_is_written_once(tmp_path, small_rig):
    with SessionWriter(tmp_path / "s", {}, small_rig.calibration) as session:
        session.toss(0).finish()
        with pytest.raises(BadInput, match="toss_00 was written already"):
            session.toss(0)


def one_toss(tmp_path, calibration) -> TossWriter:
    return SessionWriter(tmp_path / "s", {}, calibration).toss(0)


def test_an_image_size_that_changes_is_refused_when_writing(tmp_path, small_rig):
    toss = one_toss(tmp_path, small_rig.calibration)
    toss.color(small_rig.color(0))
    with pytest.raises(BadInput, match="/d455/color: an image of 99x48 after images of 64x48; one size per toss"):
        toss.color(replace(small_rig.color(1), width=99))
    with pytest.raises(BadInput, match=r"RawImage after foxglove\.CompressedImage; one encoding per toss"):
        toss.color(replace(small_rig.color(1), encoding="rgb8", data=bytes(64 * 48 * 3)))
    toss.abandon()


def test_an_image_of_another_size_than_it_says_is_named_when_read(tmp_path, small_rig):
    toss = one_toss(tmp_path, small_rig.calibration)
    toss.color(replace(small_rig.color(0), width=640, height=480))
    toss.depth(small_rig.depth(0))
    toss.finish()
    frames = Session.open(toss.path).toss(0).rgbd()
    with pytest.raises(DamagedFile, match="64x48 pixels, the calibration says 640x480"):
        frames[0]


@pytest.mark.parametrize("missing, wanted", [("color", "/d455/color"), ("depth", "/d455/depth")])
def test_a_missing_stream_is_named_with_what_there_is(tmp_path, small_rig, missing, wanted):
    toss = one_toss(tmp_path, small_rig.calibration)
    if missing != "color":
        toss.color(small_rig.color(0))
    if missing != "depth":
        toss.depth(small_rig.depth(0))
    toss.finish()
    with pytest.raises(BadInput, match=f"has no images on {wanted}; it has"):
        Session.open(toss.path).toss(0).rgbd()


def test_colour_and_depth_of_different_counts_are_paired_by_time(tmp_path, small_rig):
    toss = one_toss(tmp_path, small_rig.calibration)
    for i in range(5):
        toss.color(small_rig.color(i))
    for i in (0, 1, 3, 4):
        toss.depth(small_rig.depth(i))
    toss.depth(small_rig.depth(9))
    toss.finish()
    frames = Session.open(toss.path).toss(0).rgbd()
    assert frames.without_depth == (2,)
    assert frames.unused_depth == 1
    assert not frames[2].depth_m.any()
    np.testing.assert_allclose(frames[3].depth_m, small_rig.depth(3).raw * np.float32(0.001))


def test_depth_of_its_own_camera_is_aligned_and_without_extrinsics_refused(tmp_path, small_rig):
    lens = CameraModel("d455_depth", 64, 48, small_rig.camera.K)
    cameras = {"d455": small_rig.camera, "d455_depth": lens}
    shift = Transform("d455", "d455_depth", np.eye(3), np.array([0.05, 0, 0]))
    for name, transforms in (("with", (shift,)), ("without", ())):
        with SessionWriter(tmp_path / name, {}, RigCalibration(cameras, transforms)) as session:
            with session.toss(0) as toss:
                toss.color(small_rig.color(0))
                toss.depth(small_rig.depth(0))
            session.finish()
    frame = Session.open(tmp_path / "with").toss(0).rgbd()[0]
    assert (frame.depth_m[10:40, :3] == 0).all()  # 4.6 px to the right: nothing was seen there
    assert np.median(frame.depth_m[10:40, 10:50]) == pytest.approx(0.8, abs=0.002)
    with pytest.raises(BadInput, match="does not connect 'd455' and 'd455_depth'"):
        Session.open(tmp_path / "without").toss(0).rgbd()


def test_depth_of_another_size_without_its_camera_is_refused(tmp_path, small_rig):
    toss = one_toss(tmp_path, small_rig.calibration)
    toss.color(small_rig.color(0))
    toss.depth(replace(small_rig.depth(0), raw=np.ones((24, 32), np.uint16)))
    toss.finish()
    with pytest.raises(BadInput, match="colour is 64x48, depth 32x24 and not aligned"):
        Session.open(toss.path).toss(0).rgbd()[0]


@pytest.mark.parametrize("unit_m", [0.0, -1.0, 5.0, float("nan")])
def test_a_depth_unit_that_is_none_is_refused(tmp_path, small_rig, unit_m):
    toss = one_toss(tmp_path, small_rig.calibration)
    with pytest.raises(BadInput, match="wanted uint16 with a unit in metres"):
        toss.depth(replace(small_rig.depth(0), unit_m=unit_m))
    toss.abandon()


def test_folders_that_are_no_session_are_named(tmp_path):
    with pytest.raises(BadInput, match="does not exist"):
        Session.open(tmp_path / "none")
    with pytest.raises(BadInput, match=r"has no session\.json"):
        Session.open(tmp_path)
    (tmp_path / "toss_00" / "rgb").mkdir(parents=True)
    with pytest.raises(BadInput, match="toss-session import folder"):
        Session.open(tmp_path)


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "no readable JSON"),
        ("[1]", "format_version"),
        ('{"format_version": 99}', "format_version 99; this tosslab reads 1"),
        ('{"format_version": 1, "start": [1]}', "start document is list"),
        ('{"format_version": 1, "stop": "no"}', "stop document is str"),
        ("[" * 100_000, "no readable JSON"),
    ],
)
def test_a_spoilt_session_json_is_named(write_session, text, message):
    folder = write_session()
    (folder / "session.json").write_text(text)
    with pytest.raises(TosslabError, match=message):
        Session.open(folder)


def test_a_foreign_mcap_file_is_named_with_its_topics(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as out:
        writer = PlainWriter(out)
        writer.start("ros2")
        writer.add_message(writer.register_channel("/camera", "cdr", 0), 1, b"", 1)
        writer.finish()
    with pytest.raises(BadInput, match=r"not one of tosslab's: it has the topics \['/camera'\].*import rosbag"):
        Session.open(tmp_path / "a.mcap")


def test_a_later_format_is_refused_by_its_number(write_session):
    path = write_session() / "toss_00.mcap"
    data = path.read_bytes()
    path.write_bytes(data.replace(b"format_version\x01\x00\x00\x001", b"format_version\x01\x00\x00\x002"))
    with pytest.raises(BadInput, match="format_version '2'; this tosslab reads 1"):
        Session.open(path)


def test_session_json_is_written_whole_or_not_at_all(tmp_path, small_rig, monkeypatch):
    session = SessionWriter(tmp_path / "s", {"who": "me"}, small_rig.calibration)
    before = (tmp_path / "s" / "session.json").read_text()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", refuse)
    with pytest.raises(WriteFailed, match=r"session\.json could not be written: No space left"):
        session.finish()
    assert (tmp_path / "s" / "session.json").read_text() == before
    assert json.loads(before)["stop"] is None
    assert not list((tmp_path / "s").glob("*.partial"))


WEIRD = (None, [], {}, "x", -1, 1e400, float("nan"), 10**30, [1, 2], {"a": 1})


def places(document: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield place
    inner = (
        document.items() if isinstance(document, dict) else enumerate(document) if isinstance(document, list) else ()
    )
    for key, value in inner:
        yield from places(value, (*place, key))


def put(document: Any, place: tuple[Any, ...], value: Any) -> Any:
    if not place:
        return value
    inner = put(document[place[0]], place[1:], value)
    if isinstance(document, list):
        return [inner if i == place[0] else v for i, v in enumerate(document)]
    return {**document, place[0]: inner}


@pytest.mark.parametrize("name", ["session.json", "calibration.json"])
def test_strange_values_anywhere_in_the_documents_give_plain_errors(write_session, tmp_path, name):
    folder = write_session()
    document = json.loads((folder / name).read_text())
    rng = np.random.default_rng(4)
    every = list(places(document))
    for i in range(60):
        spoilt = put(document, every[int(rng.integers(len(every)))], WEIRD[int(rng.integers(len(WEIRD)))])
        (folder / name).write_text(json.dumps(spoilt))
        for work in (lambda: inspect(folder).to_text(), lambda: verify(folder).to_text()):
            try:
                work()
            except TosslabError:
                pass
        recover(folder, tmp_path / f"saved_{i}")
        assert verify(tmp_path / f"saved_{i}").ok


def test_a_folder_layout_that_was_not_imported_says_how(tmp_path):
    (tmp_path / "toss_00" / "rgb").mkdir(parents=True)
    (tmp_path / "session.json").write_text('{"object": "cube"}')
    with pytest.raises(BadInput, match="toss-session import folder"):
        Session.open(tmp_path)
