"""info: figures from the index alone."""

from __future__ import annotations

import json
import os
from dataclasses import replace

import pytest
from mcap.writer import Writer as PlainWriter

from recordings.cli_session import main
from recordings.errors import BadInput, DamagedFile
from recordings.session_writer import SessionWriter
from recordings.verify.inspect import inspect


def test_streams_rates_events_and_calibration_age_are_told(write_session, small_rig):
    info = inspect(write_session(tosses=2))
    assert (info.name, info.object_name, info.status) == ("small", "cube", "complete")
    assert info.recorded == "2023-11-15T22:13:20Z"
    assert info.calibration_age_days == pytest.approx(1.0, abs=1e-3)
    assert info.cameras == ("d455", "mono0")
    toss = info.tosses[1]
    lines = {s.topic: s for s in toss.streams}
    assert lines["/d455/color"].count == small_rig.frames
    assert lines["/d455/color"].rate_hz == pytest.approx(30, abs=0.01)
    assert lines["/arm/joint_states"].rate_hz == pytest.approx(1000)
    assert lines["/d455/depth"].schema == "tosslab.DepthImage"
    assert toss.verdict == "accept"
    assert toss.events == (("release", pytest.approx(1.066666666)),)
    assert toss.duration_s == pytest.approx(6 / 30, abs=0.02)


def test_gaps_and_drops_are_counted(tmp_path, small_rig):
    with SessionWriter(tmp_path / "s", {}, small_rig.calibration) as session:
        with session.toss(0) as toss:
            for i in (0, 1, 2, 5, 6, 7, 9):
                toss.color(small_rig.color(i))
            toss.dropped("/d455/color", 3)
        session.finish()
    for path in (tmp_path / "s", tmp_path / "s" / "toss_00.mcap"):
        line = next(s for s in inspect(path).tosses[0].streams if s.topic == "/d455/color")
        assert (line.gaps, line.missing, line.dropped) == (2, 3, 3)
        assert "2 gaps (3 missing)  3 DROPPED" in inspect(path).to_text()


def test_a_damaged_toss_does_not_hide_the_others(write_session, capsys):
    folder = write_session(tosses=3)
    (folder / "toss_01.mcap").write_bytes((folder / "toss_01.mcap").read_bytes()[:5000])
    info = inspect(folder)
    assert [bool(t.damage) for t in info.tosses] == [False, True, False]
    assert main(["info", str(folder)]) == 1
    assert "toss_01.mcap  DAMAGED" in capsys.readouterr().out


def test_json_is_one_object_on_stdout(write_session, capsys):
    assert main(["info", str(write_session()), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["tosses"][0]["streams"][0]["topic"] == "/arm/joint_states"
    assert document["clock"] == {"source": "test"}


def test_one_file_of_any_suffix_is_told(write_session, tmp_path):
    (tmp_path / "x.dat").write_bytes((write_session() / "toss_00.mcap").read_bytes())
    assert inspect(tmp_path / "x.dat").tosses[0].verdict == "accept"


def test_a_foreign_file_is_told_with_a_hint(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as out:
        writer = PlainWriter(out)
        writer.start("ros2")
        channel = writer.register_channel("/chatter", "cdr", 0)
        for i in range(5):
            writer.add_message(channel, i * 10**8, b"", i * 10**8)
        writer.finish()
    text = inspect(tmp_path / "a.mcap").to_text()
    assert "/chatter" in text
    assert "10.00 Hz" in text
    assert "toss-session import rosbag" in text


def test_a_recording_that_was_cut_off_says_so(tmp_path, small_rig):
    session = SessionWriter(tmp_path / "s", {}, replace(small_rig).calibration)
    with session.toss(0) as toss:
        small_rig.write(toss)
    assert "not stopped" in inspect(tmp_path / "s").to_text()


@pytest.mark.parametrize("name, message", [("none", "does not exist"), ("empty.mcap", "is empty")])
def test_what_cannot_be_told_is_named(tmp_path, name, message):
    (tmp_path / "empty.mcap").touch()
    with pytest.raises(BadInput, match=message):
        inspect(tmp_path / name)
    assert main(["info", str(tmp_path / name)]) == 2


def test_a_single_cut_file_names_recover(write_session):
    path = write_session() / "toss_00.mcap"
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DamagedFile, match="toss-session recover"):
        inspect(path)


def test_only_the_index_is_read(write_session, tmp_path, small_rig, monkeypatch):
    big = replace(small_rig, width=320, height=240, frames=60)
    folder = write_session("big", rig=big)
    read = []
    real = os.pread

    def counted(file: int, length: int, offset: int) -> bytes:
        data = real(file, length, offset)
        read.append(len(data))
        return data

    monkeypatch.setattr(os, "pread", counted)
    inspect(folder)
    size = (folder / "toss_00.mcap").stat().st_size
    index = 60 * 16 * 36  # sixteen bytes per message; the rest is the chunks that hold the two events
    assert sum(read) < index + 60_000 + 2 * 2**20 < 0.5 * size
