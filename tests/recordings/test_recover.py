"""recover: everything in complete chunks comes along, the rest is reported, IN stays as it is."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from mcap.writer import Writer as PlainWriter

from recordings.cli_session import main
from recordings.errors import BadInput, WriteFailed
from recordings.mcap.file import McapFile
from recordings.mcap.recover import missing_numbers, recover_file
from recordings.mcap.recover_session import recover
from recordings.mcap.structure import check_structure
from recordings.mcap.writer import McapWriter
from recordings.session import Session
from recordings.verify.verify import verify


def sequences(path: Path, topic: str = "/a") -> list[int]:
    with McapFile(path) as file:
        return [m.sequence for m in file.messages(topic)]


def many_chunks(path: Path, chunks: int = 8, compress: bool = False) -> list[tuple[int, int]]:
    """A file of one-megabyte chunks of 11 messages each; where each chunk begins and ends."""
    with McapWriter(path) as writer:
        channel = writer.channel("/a", "x", writer.schema("s", "y", b"definition"))
        writer.attachment("first.txt", "text/plain", b"first")
        for i in range(11 * chunks):
            data = np.random.default_rng(i).bytes(100_000)
            writer.message(channel, i * 1000, i * 1000, i, data, compress=compress)
        writer.attachment("last.txt", "text/plain", b"last")
        writer.metadata("about", {"k": "v"})
        writer.finish()
    with McapFile(path) as file:
        return [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length) for c in file.summary.chunk_indexes]


@pytest.fixture
def unhurried(monkeypatch):
    """Chunks are closed by their size alone: closed by their age too, a busy machine would cut them elsewhere."""
    monkeypatch.setattr("recordings.mcap.writer.CHUNK_NS", 3_600 * 10**9)


@pytest.mark.usefixtures("unhurried")
@pytest.mark.parametrize("compress", [False, True])
@pytest.mark.parametrize("damage", ["bit", "hole", "head", "cut out", "inserted"])
def test_damage_in_the_middle_costs_only_the_chunk_it_lies_in(tmp_path, compress, damage):
    chunks = many_chunks(tmp_path / "a.mcap", compress=compress)
    data = (tmp_path / "a.mcap").read_bytes()
    start, end = chunks[3]
    middle = (start + end) // 2
    spoilt = {
        "bit": data[:middle] + bytes([data[middle] ^ 1]) + data[middle + 1 :],
        "hole": data[:middle] + bytes(50_000) + data[middle + 50_000 :],
        "head": data[: start + 1] + bytes([data[start + 1] ^ 0xFF]) + data[start + 2 :],
        "cut out": data[:middle] + data[middle + 12_345 :],
        "inserted": data[:middle] + b"\x06\x01\x00\x00" * 3000 + data[middle:],
    }
    (tmp_path / "b.mcap").write_bytes(spoilt[damage])
    report = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    expected = [i for i in range(88) if not 33 <= i < 44]
    assert sequences(tmp_path / "c.mcap") == expected
    assert report.lost == {"/a": 11}
    assert report.missing_numbers == {"/a": 11}
    assert check_structure(tmp_path / "c.mcap").findings == check_structure(tmp_path / "a.mcap").findings
    with McapFile(tmp_path / "c.mcap") as saved:
        assert saved.attachments() == ["first.txt", "last.txt"]
        assert saved.metadata("about") == [{"k": "v"}]
    assert (tmp_path / "b.mcap").read_bytes() == spoilt[damage]


@pytest.mark.usefixtures("unhurried")
def test_two_damaged_places_and_a_cut_are_all_reported(tmp_path):
    chunks = many_chunks(tmp_path / "a.mcap")
    data = bytearray((tmp_path / "a.mcap").read_bytes()[: chunks[6][1] - 9])
    for k in (1, 4):
        data[chunks[k][0] + 5000] ^= 1
    (tmp_path / "b.mcap").write_bytes(data)
    report = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    kept = [i for k in (0, 2, 3, 5) for i in range(11 * k, 11 * k + 11)]
    assert sequences(tmp_path / "c.mcap") == kept
    assert report.lost == {"/a": 22}
    assert len(report.damage) == 3
    assert "the file ends within the record" in report.damage[-1]
    assert any("at most 1 MiB or 250 ms" in n for n in report.notes)


def test_a_whole_file_comes_out_with_every_byte_of_every_message(write_session, tmp_path):
    path = write_session() / "toss_00.mcap"
    report = recover_file(path, tmp_path / "b.mcap")
    assert report.whole
    with McapFile(path) as before, McapFile(tmp_path / "b.mcap") as after:
        for topic in before.channels:
            assert list(before.messages(topic)) == list(after.messages(topic))
        for name in before.attachments():
            assert before.attachment(name) == after.attachment(name)
    assert verify(tmp_path / "b.mcap").ok


def test_a_recovered_toss_says_so_and_reads_like_any_other(write_session, tmp_path, small_rig):
    path = write_session() / "toss_00.mcap"
    path.write_bytes(path.read_bytes()[:-2000])
    recover_file(path, tmp_path / "toss_00.mcap")
    report = verify(tmp_path / "toss_00.mcap")
    assert report.ok
    assert any("recovered from toss_00.mcap" in w.text for w in report.warnings)
    with Session.open(tmp_path / "toss_00.mcap") as session:
        assert session.stop["status"] == "recovered"
        assert len(session.toss(0).rgbd()) == small_rig.frames
        assert session.calibration.camera("d455").width == 64


def test_our_own_record_is_made_anew_when_just_that_was_lost(write_session, tmp_path):
    folder = write_session(tosses=3)
    data = (folder / "toss_02.mcap").read_bytes()
    at = data.index(b"format_version")
    (folder / "toss_02.mcap").write_bytes(data[: at - 20] + bytes(30) + data[at + 10 :])
    recover_file(folder / "toss_02.mcap", tmp_path / "b.mcap")
    with Session.open(tmp_path / "b.mcap") as session:
        assert session.tosses == (2,)


def test_a_lost_calibration_is_taken_from_the_session_beside(write_session, tmp_path):
    folder = write_session()
    path = folder / "toss_00.mcap"
    path.write_bytes(path.read_bytes().replace(b'"transforms"', b'"transformz"', 1))
    report = recover_file(path, tmp_path / "a.mcap")
    assert any("calibration.json' differs from its CRC" in text for text in report.damage)
    assert any("which lies beside it, was taken" in note for note in report.notes)
    with Session.open(tmp_path / "a.mcap") as session:
        assert session.calibration.camera("d455").width == 64
    (folder / "calibration.json").unlink()
    recover_file(path, tmp_path / "b.mcap")
    with Session.open(tmp_path / "b.mcap") as session:
        assert session.calibration.cameras == {}


def test_two_recordings_in_one_file_are_not_mixed_up(tmp_path):
    for name, topic in (("a.mcap", "/a"), ("b.mcap", "/b")):
        with McapWriter(tmp_path / name) as writer:
            writer.message(writer.channel(topic, "x", 0), 1, 1, 1, topic.encode())
            writer.finish()
    both = (tmp_path / "a.mcap").read_bytes()[:-30] + (tmp_path / "b.mcap").read_bytes()
    (tmp_path / "both.mcap").write_bytes(both)
    report = recover_file(tmp_path / "both.mcap", tmp_path / "c.mcap")
    assert report.kept == {"/a": 1}
    assert not report.whole
    with McapFile(tmp_path / "c.mcap") as saved:
        assert [m.data for m in saved.messages("/a")] == [b"/a"]


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_files_of_other_writers_are_recovered_too(tmp_path, compression, share):
    with open(tmp_path / "a.mcap", "wb") as out:
        writer = PlainWriter(out, compression=compression, chunk_size=2000)
        writer.start("ros2", "someone")
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channel = writer.register_channel("/a", "json", schema, {"k": "v"})
        for i in range(400):
            writer.add_message(channel, i, np.random.default_rng(i).bytes(100), i + 5, i)
        writer.finish()
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[: int(share * len(data))])
    report = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    got = sequences(tmp_path / "c.mcap")
    assert got == list(range(len(got)))
    assert share * 400 - 30 < len(got) < share * 400 + 60
    structure = check_structure(tmp_path / "c.mcap")
    assert not structure.damaged
    assert (structure.profile, structure.library, report.whole) == ("ros2", "someone", False)


def test_a_file_without_chunks_is_recovered_message_by_message(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as out:
        writer = PlainWriter(out, use_chunking=False)
        writer.start()
        channel = writer.register_channel("/a", "x", 0)
        for i in range(200):
            writer.add_message(channel, i, np.random.default_rng(i).bytes(100), i, i)
        writer.finish()
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(data[:9000] + bytes(300) + data[9300:16_000])
    report = recover_file(tmp_path / "b.mcap", tmp_path / "c.mcap")
    assert any("without a CRC" in note for note in report.notes)
    with McapFile(tmp_path / "c.mcap") as saved:
        got = {m.sequence: m.data for m in saved.messages("/a")}
    same = [i for i, data in got.items() if data == np.random.default_rng(i).bytes(100)]
    assert len(same) > 110  # of 121 before the cut; four lay in the hole
    assert len(got) - len(same) <= 1  # one whose head was whole: without a CRC its zeros cannot be told


def test_the_bags_of_ros_2_cut_in_half_are_recovered(data, tmp_path):
    for i, path in enumerate(sorted(data("rosbag2_mcap").rglob("*.mcap"))):
        (tmp_path / "half.mcap").write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
        recover_file(tmp_path / "half.mcap", tmp_path / f"{i}.mcap")
        assert not check_structure(tmp_path / f"{i}.mcap").damaged


@pytest.mark.parametrize(
    "content, message",
    [(b"", "is empty"), (b"not at all an mcap file", "is not an MCAP file"), (b"\x00" * 5000, "is not an MCAP file")],
)
def test_what_holds_nothing_is_named_and_nothing_is_written(tmp_path, content, message):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(BadInput, match=message):
        recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert not (tmp_path / "b.mcap").exists()


def test_an_existing_out_is_refused_and_untouched(write_session, tmp_path):
    folder = write_session()
    (tmp_path / "out").write_bytes(b"precious")
    for source in (folder, folder / "toss_00.mcap"):
        with pytest.raises(BadInput, match="exists already; nothing was written"):
            recover(source, tmp_path / "out")
    with pytest.raises(BadInput, match="exists already"):
        recover(folder / "toss_00.mcap", folder / "toss_00.mcap")
    with pytest.raises(BadInput, match="lies inside"):
        recover(folder, folder / "saved")
    assert (tmp_path / "out").read_bytes() == b"precious"


def test_a_full_disk_leaves_no_half_of_a_file(tmp_path, full_disk):
    many_chunks(tmp_path / "a.mcap")
    full_disk(3_000_000)
    with pytest.raises(WriteFailed, match="the disk refused a write"):
        recover_file(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert not (tmp_path / "b.mcap").exists()


def spoilt_session(write_session) -> Path:
    folder = write_session("spoilt", tosses=3)
    one, two = folder / "toss_01.mcap", folder / "toss_02.mcap"
    one.write_bytes(one.read_bytes()[:12_000])
    two.write_bytes(b"")
    (folder / "truth").mkdir()
    (folder / "truth" / "truth.json").write_text("{}")
    (folder / "results").mkdir()
    (folder / "notes.txt").write_text("mine")
    return folder


def test_a_session_is_recovered_toss_by_toss(write_session, tmp_path, small_rig):
    folder = spoilt_session(write_session)
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    reports = recover(folder, tmp_path / "saved")
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before
    assert (tmp_path / "saved" / "toss_00.mcap").read_bytes() == before[folder / "toss_00.mcap"]
    assert [r.out for r in reports] == ["toss_00.mcap", "toss_01.mcap", ""]
    assert reports[1].lost["/d455/color"] == small_rig.frames - reports[1].kept.get("/d455/color", 0)
    assert sorted(p.name for p in (tmp_path / "saved").iterdir()) == [
        "calibration.json",
        "notes.txt",
        "session.json",
        "toss_00.mcap",
        "toss_01.mcap",
        "truth",
    ]
    session = Session.open(tmp_path / "saved")
    assert session.tosses == (0, 1)
    assert session.stop["status"] == "recovered"
    assert "toss_01.mcap" in session.stop["reason"]
    assert session.stop["tosses"]["toss_00"]["verdict"] == "accept"
    assert verify(tmp_path / "saved").ok


def test_documents_that_are_lost_come_back_from_the_tosses(write_session, tmp_path):
    folder = write_session(tosses=2)
    (folder / "session.json").write_text('{"format_')
    (folder / "calibration.json").unlink()
    recover(folder, tmp_path / "saved")
    session = Session.open(tmp_path / "saved")
    assert session.object_name == "cube"
    assert session.calibration.camera("d455").width == 64
    saved, toss = tmp_path / "saved", tmp_path / "saved" / "toss_01.mcap"
    assert session.stop["sha256"]["toss_01.mcap"] == hashlib.sha256(toss.read_bytes()).hexdigest()
    assert verify(saved).ok


def test_the_command_reports_what_was_lost(write_session, tmp_path, capsys):
    folder = spoilt_session(write_session)
    assert main(["recover", str(folder), str(tmp_path / "saved")]) == 0
    out = capsys.readouterr().out
    assert "toss_00.mcap: whole" in out
    assert "lost 6 of /d455/color" in out or "of /d455/color" in out
    assert "toss_02.mcap: nothing could be saved" in out
    assert main(["recover", str(folder / "toss_01.mcap"), str(tmp_path / "one.mcap"), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)["files"][0]
    assert report["source"] == "toss_01.mcap"
    assert report["skipped_bytes"] > 0
    assert main(["recover", str(folder), str(tmp_path / "saved")]) == 2
    assert "exists already" in capsys.readouterr().err


def test_numbers_that_wrap_or_start_anew_are_no_loss():
    assert missing_numbers([2**32 - 2, 2**32 - 1, 0, 1]) == 0
    assert missing_numbers([5, 6, 9, 10]) == 2
    assert missing_numbers([5000, 5001, 0, 1]) == 0
    assert missing_numbers([]) == 0
