"""verify: whole recordings pass, every kind of fault is named with its severity."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as PlainWriter

from recordings.cli_session import main
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.records import StampedPose
from recordings.session import Session
from recordings.session_writer import SessionWriter, renew_manifest, write_truth
from recordings.tracks import RigCalibration
from recordings.verify.verify import Report, verify


def texts(report: Report, severity: str) -> str:
    return "\n".join(f"{f.place}: {f.text}" for f in report.findings if f.severity == severity)


def write_one(tmp_path: Path, rig, fill, calibration: RigCalibration | None = None) -> Path:
    with SessionWriter(tmp_path / "one", {}, calibration or rig.calibration) as session:
        with session.toss(0) as toss:
            fill(toss)
        session.finish()
    return tmp_path / "one"


def test_a_whole_session_and_each_of_its_files_have_no_finding(write_session):
    folder = write_session(tosses=2)
    for path in (folder, folder / "toss_01.mcap"):
        report = verify(path)
        assert report.ok
        assert report.own
        assert report.findings == ()
    assert verify(folder).messages == 2 * verify(folder / "toss_01.mcap").messages
    assert main(["verify", str(folder)]) == 0


def test_json_is_one_object_and_damage_is_exit_code_1(write_session, capsys):
    folder = write_session()
    path = folder / "toss_00.mcap"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert main(["verify", str(folder), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["ok"] is False
    assert {f["severity"] for f in report["findings"]} == {"error"}
    assert any("sha256 differs" in f["text"] for f in report["findings"])


def test_what_is_no_recording_is_exit_code_2_with_one_message(tmp_path, capsys):
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "notes.txt").write_text("hello, this is text")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("empty.mcap", "is empty (0 bytes)"),
        ("notes.txt", "is not an MCAP file: it begins with b'hello, t'"),
        ("folder", "is no session: it holds neither session.json nor an .mcap file"),
        ("none", "does not exist"),
    ):
        assert main(["verify", str(tmp_path / name)]) == 2
        assert message in capsys.readouterr().err


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.97, 0.999])
def test_a_flipped_bit_anywhere_is_damage(write_session, share):
    path = write_session() / "toss_00.mcap"
    data = bytearray(path.read_bytes())
    data[int(share * len(data))] ^= 32
    path.write_bytes(data)
    assert not verify(path).ok


def test_a_cut_file_says_where_and_what_to_type(write_session):
    path = write_session() / "toss_00.mcap"
    path.write_bytes(path.read_bytes()[:30_000])
    assert "the file ends within the record at byte" in texts(verify(path), "error")
    assert "`toss-session recover`" in texts(verify(path), "error")


def test_a_file_exchanged_for_another_whole_one_is_found_by_the_manifest(write_session):
    folder = write_session(tosses=2)
    (folder / "toss_00.mcap").write_bytes((folder / "toss_01.mcap").read_bytes())
    assert verify(folder / "toss_00.mcap").ok
    assert "toss_00.mcap: its sha256 differs from the manifest's" in texts(verify(folder), "error")


def test_missing_extra_and_unsigned_files_are_named(write_session):
    folder = write_session(tosses=3)
    (folder / "toss_01.mcap").rename(folder / "toss_07.mcap")
    report = verify(folder)
    assert "toss_01.mcap: is in the manifest of session.json, but not in the folder" in texts(report, "error")
    assert "toss_07.mcap: not in the manifest" in texts(report, "warning")


def test_a_recording_that_never_stopped_is_a_warning(tmp_path, small_rig):
    session = SessionWriter(tmp_path / "s", {}, small_rig.calibration)
    with session.toss(0) as toss:
        small_rig.write(toss)
    report = verify(tmp_path / "s")
    assert report.ok
    assert "no stop document: the recording was cut off" in texts(report, "warning")


def test_another_status_and_drops_are_warnings(tmp_path, small_rig):
    with SessionWriter(tmp_path / "s", {}, small_rig.calibration) as session:
        with session.toss(0) as toss:
            small_rig.write(toss)
            toss.dropped("/d455/color", 2)
        session.finish("failed", "e-stop")
    report = verify(tmp_path / "s")
    assert report.ok
    assert "status 'failed': e-stop" in texts(report, "warning")
    assert "/d455/color: 2 of 8 messages were dropped" in texts(report, "warning")


def test_counts_that_differ_from_the_stop_document_are_damage(write_session):
    folder = write_session()
    document = json.loads((folder / "session.json").read_text())
    document["stop"]["streams"]["toss_00"]["/d455/color"]["written"] = 9
    (folder / "session.json").write_text(json.dumps(document))
    assert "/d455/color: the stop document counts 9 messages written, 6 are there" in texts(verify(folder), "error")


def test_a_calibration_changed_later_is_a_warning_a_broken_one_damage(write_session):
    folder = write_session()
    path = folder / "calibration.json"
    text = path.read_text()
    path.write_text(text.replace("tag36h11", "tag25h9"))
    assert verify(folder).ok
    assert "calibration.json: was changed after the recording" in texts(verify(folder), "warning")
    data = json.loads(text)
    data["cameras"]["d455"]["K"][0][2] = 999
    path.write_text(json.dumps(data))
    assert "principal point (999, 23.5) lies outside the 64x48 image" in texts(verify(folder), "error")


def shifted(rig, i: int, time_ns: int):
    return replace(rig.color(i), time_ns=time_ns)


@pytest.mark.parametrize(
    "step_ns, words",
    [
        (0, "stamps repeat 1 times, first after message 2"),
        (-20_000_000, "stamps go back 1 times, first after message 2 by 0.02 s"),
        (-(1 << 32) * 1000 + 33_333_333, r"32-bit microsecond clock wrapped"),
    ],
)
def test_stamps_that_repeat_go_back_or_wrap_are_damage(tmp_path, small_rig, step_ns, words):
    def fill(toss) -> None:
        for i in range(6):
            time_ns = 5_000_000_000_000 + i * 33_333_333
            late = time_ns if i < 3 else time_ns - 33_333_333 + step_ns
            toss.color(replace(shifted(small_rig, i, late), host_time_ns=time_ns))
            toss.depth(small_rig.depth(i, time_ns))

    assert words in texts(verify(write_one(tmp_path, small_rig, fill)), "error")


def test_gaps_are_told_by_frame_numbers_and_by_stamps(tmp_path, small_rig):
    def fill(toss) -> None:
        for i in (0, 1, 2, 5, 6, 7, 8):
            toss.color(small_rig.color(i))
        for i in (0, 1, 2, 5, 6, 7, 8):
            toss.depth(replace(small_rig.depth(i), index=[0, 1, 2, 0, 0, 3, 4, 5, 6][i]))

    report = verify(write_one(tmp_path, small_rig, fill))
    assert report.ok
    assert "/d455/color: 2 frame numbers missing at 1 places, first after message 2" in texts(report, "warning")
    assert "/d455/depth: 1 gaps in the stamps, 2 frames of 33.33 ms, first at 0.067 s" in texts(report, "warning")
    assert "/d455/color: 1 gaps" not in texts(report, "warning")


def test_frame_numbers_that_jump_without_a_gap_in_time_are_told(tmp_path, small_rig):
    def fill(toss) -> None:
        for i in range(6):
            toss.color(small_rig.color(i, index=i + 4 * (i > 2)))
            toss.depth(small_rig.depth(i))

    words = texts(verify(write_one(tmp_path, small_rig, fill)), "warning")
    assert "/d455/color: 1 jumps of the frame number without a gap in the stamps" in words


@pytest.mark.parametrize("true_m, stated_m", [(0.00025, 0.001), (0.001, 0.00025), (0.0001, 0.001), (0.001, 0.0001)])
def test_a_wrong_depth_unit_is_damage_where_the_table_is_known(tmp_path, small_rig, true_m, stated_m):
    def fill(toss) -> None:
        for i in range(3):
            toss.color(small_rig.color(i))
            toss.depth(replace(replace(small_rig, unit_m=true_m).depth(i), unit_m=stated_m))

    words = texts(verify(write_one(tmp_path, small_rig, fill)), "error")
    assert f"in a unit of {true_m * 1000:g} mm it would fit" in words


@pytest.mark.parametrize("unit_m", [0.001, 0.00025, 0.0001])
def test_a_right_depth_unit_and_a_real_scale_error_pass(tmp_path, small_rig, unit_m):
    rig = replace(small_rig, unit_m=unit_m, depth_scale=1.02)

    def fill(toss) -> None:
        for i in range(3):
            toss.color(rig.color(i))
            toss.depth(rig.depth(i))

    assert verify(write_one(tmp_path, rig, fill)).findings == ()


def test_an_implausible_depth_is_a_warning_where_the_table_is_not_known(tmp_path, small_rig):
    def fill(toss) -> None:
        toss.color(small_rig.color(0))
        toss.depth(replace(small_rig.depth(0), unit_m=0.01))

    alone = RigCalibration(small_rig.calibration.cameras)
    words = texts(verify(write_one(tmp_path, small_rig, fill, alone)), "warning")
    assert "the median depth is 8 m with the unit 10 mm; in a unit of 1 or 0.25 mm it would be plausible" in words


def test_depth_without_any_return_is_a_warning(tmp_path, small_rig):
    def fill(toss) -> None:
        toss.color(small_rig.color(0))
        toss.depth(replace(small_rig.depth(0), raw=np.zeros((48, 64), np.uint16)))

    assert "every pixel of 1 images is 0" in texts(verify(write_one(tmp_path, small_rig, fill)), "warning")


def test_colour_and_depth_of_different_counts_are_a_warning(tmp_path, small_rig):
    def fill(toss) -> None:
        for i in range(6):
            toss.color(small_rig.color(i))
        for i in range(4):
            toss.depth(small_rig.depth(i))

    words = texts(verify(write_one(tmp_path, small_rig, fill)), "warning")
    assert "6 colour and 4 depth images; 2 colour images have no depth near enough in time" in words


def test_masks_of_another_size_or_place_are_damage(tmp_path, small_rig):
    def fill(toss) -> None:
        small_rig.write(toss)
        toss.mask(1, np.ones((20, 30), bool))
        toss.mask(2, np.zeros((48, 64), bool))
        toss.mask(40, np.ones((48, 64), bool))

    report = verify(write_one(tmp_path, small_rig, fill))
    assert "the mask of frame 1 is 30x20, the image 64x48" in texts(report, "error")
    assert "a mask of colour frame 40, of which there are 6" in texts(report, "error")
    assert "the mask of frame 2 is empty" in texts(report, "warning")


def two_cameras(rig, depth_frame: str, size=(64, 48)) -> RigCalibration:
    K = np.array([[55.0, 0, size[0] / 2], [0, 55.0, size[1] / 2], [0, 0, 1]])
    return RigCalibration({"d455": rig.camera, "d455_depth": CameraModel(depth_frame, *size, K)})


def test_depth_that_cannot_be_aligned_is_damage(tmp_path, small_rig):
    def fill(toss) -> None:
        toss.color(small_rig.color(0))
        toss.depth(small_rig.depth(0))

    folder = write_one(tmp_path, small_rig, fill, two_cameras(small_rig, "d455_depth"))
    assert "no transform between 'd455' and 'd455_depth': it cannot be aligned" in texts(verify(folder), "error")


def test_depth_in_colours_frame_with_other_intrinsics_says_that_it_is_aligned_when_read(tmp_path, small_rig):
    def fill(toss) -> None:
        toss.color(small_rig.color(0))
        toss.depth(small_rig.depth(0))

    folder = write_one(tmp_path, small_rig, fill, two_cameras(small_rig, "d455", (30, 20)))
    report = verify(folder)
    assert "not aligned to colour; it is aligned when read" in texts(report, "info")
    assert "/d455/depth: images of 64x48, intrinsics of 30x20" in texts(report, "error")


def test_depth_of_another_size_without_its_camera_is_damage(tmp_path, small_rig):
    def fill(toss) -> None:
        toss.color(small_rig.color(0))
        toss.depth(replace(small_rig.depth(0), raw=np.ones((24, 32), np.uint16)))

    words = texts(verify(write_one(tmp_path, small_rig, fill)), "error")
    assert "depth is 32x24, colour 64x48, and the calibration has no 'd455_depth' camera" in words


def test_implausible_intrinsics_are_warnings_and_another_image_size_damage(tmp_path, small_rig):
    K = np.array([[5000.0, 0, 3], [0, 60.0, 24], [0, 0, 1]])
    odd = RigCalibration(
        {"d455": CameraModel("d455", 64, 48, K), "mono0": CameraModel("mono0", 80, 48, small_rig.camera.K)}
    )

    def fill(toss) -> None:
        toss.color(small_rig.color(0))
        toss.depth(small_rig.depth(0))
        toss.mono(small_rig.mono(0))

    report = verify(write_one(tmp_path, small_rig, fill, odd))
    assert "principal point (3.0, 24.0) lies far from the middle of 64x48" in texts(report, "warning")
    assert "focal lengths 5000.0, 60.0 px see 1 deg: not plausible" in texts(report, "warning")
    assert "/mono0/image: images of 64x48, intrinsics of 80x48" in texts(report, "error")


def test_truth_is_checked_too(write_session, tmp_path):
    folder = write_session()
    pose = StampedPose(5, "world", "object", np.eye(4))
    write_truth(folder, {0: [pose]}, {"source": "test"})
    assert verify(folder).ok
    assert "truth/toss_00.mcap" in verify(folder).files
    data = bytearray((folder / "truth" / "toss_00.mcap").read_bytes())
    data[-60] ^= 1
    (folder / "truth" / "toss_00.mcap").write_bytes(data)
    assert "truth/toss_00.mcap: " in texts(verify(folder), "error")


def foreign(path: Path, **options: object) -> None:
    with open(path, "wb") as out:
        writer = PlainWriter(out, **options)
        writer.start("ros2", "someone else")
        channel = writer.register_channel("/chatter", "cdr", writer.register_schema("std_msgs/String", "ros2msg", b""))
        for i in range(50):
            writer.add_message(channel, i, b"hello", i, i)
        writer.add_attachment(1, 1, "a.txt", "text/plain", b"note")
        writer.finish()


@pytest.mark.parametrize(
    "options", [{}, {"use_chunking": False}, {"enable_data_crcs": True}, {"use_summary_offsets": False}]
)
def test_files_of_other_writers_are_checked_as_mcap_only(tmp_path, options):
    foreign(tmp_path / "a.bin", **options)
    report = verify(tmp_path / "a.bin")
    assert report.ok
    assert not report.own
    assert "written by ros2 someone else, not by tosslab: only the MCAP structure was checked" in texts(report, "info")
    assert report.messages == 50


def test_damage_in_a_foreign_file_is_found(tmp_path):
    foreign(tmp_path / "a.mcap", chunk_size=100)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[:200] + b"\xff" + data[201:])
    assert not verify(tmp_path / "a.mcap").ok


def test_the_bags_of_ros_2_are_whole(data):
    files = sorted(data("rosbag2_mcap").rglob("*.mcap"))
    assert len(files) == 14
    assert all(verify(f).ok for f in files)


def test_a_spoilt_index_is_found_though_every_message_can_be_read(write_session):
    path = write_session() / "toss_00.mcap"
    data = path.read_bytes()
    (start,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)
    spoilt = bytearray(data)
    spoilt[start + 40] ^= 1
    path.write_bytes(spoilt)
    assert "the index" in texts(verify(path), "error")


def test_the_imported_development_sessions_are_whole(data, tmp_path):
    assert main(["import", "folder", str(data("lab_dev")), str(tmp_path / "lab")]) == 0
    report = verify(tmp_path / "lab")
    assert report.ok
    assert len(report.warnings) == 4  # frames are missing in it on purpose, in colour and depth of both tosses
    assert all("gaps in the stamps" in w.text for w in report.warnings)
    with Session.open(tmp_path / "lab") as session, pytest.raises(BadInput, match="has no toss 5"):
        session.toss(5)


def test_a_calibration_that_a_command_renewed_is_signed_anew(write_session):
    folder = write_session()
    path = folder / "calibration.json"
    path.write_text(path.read_text().replace("tag36h11", "tag25h9"))
    renew_manifest(folder, "calibration.json")
    assert verify(folder).findings == ()
    with pytest.raises(BadInput, match=r"has no truth\.json; nothing was signed"):
        renew_manifest(folder, "truth.json")
