"""What a follower writes while a session is recorded, and how little the readers trust it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.live_frames import SLOTS, FrameBoardReader, FrameBoardWriter, LiveFrame
from recordings.results.live import (
    LineReader,
    LiveWriter,
    State,
    TossSoFar,
    live_folder,
    read_state,
    read_tosses,
    require_live,
)


def toss_so_far(number: int, **other: object) -> TossSoFar:
    plain = {"frames": 3, "seen": 3, "tracked": 2, "interpolated": 1, "lost": 0, "verdict": (), "placed": True}
    plain |= {"ambiguous": False, "cost": None, "phases": (None, None, None), "seconds": 1.5}
    return TossSoFar(number, **{**plain, **other})


def test_lines_are_read_once_and_in_order(tmp_path: Path) -> None:
    writer, reader = LiveWriter(tmp_path), LineReader(tmp_path)
    writer.say("ready", "one")
    writer.say("verdict", "two", 4)
    assert [(line.kind, line.text, line.toss) for line in reader.new()] == [
        ("ready", "one", None),
        ("verdict", "two", 4),
    ]
    assert reader.new() == []
    writer.say("next", "three")
    assert [line.text for line in reader.new()] == ["three"]


def test_a_line_that_is_still_written_is_read_when_it_is_whole_and_nonsense_is_passed_over(tmp_path: Path) -> None:
    writer, reader = LiveWriter(tmp_path), LineReader(tmp_path)
    with open(writer.folder / "lines.jsonl", "ab", buffering=0) as out:
        out.write(b'nonsense\n{"toss": null, "kind": "next", ')
        assert reader.new() == []
        out.write(b'"text": "whole", "unix_s": 1.0}\n[1]\n')
    assert [line.text for line in reader.new()] == ["whole"]


def test_a_reader_that_begins_at_the_end_says_nothing_of_an_earlier_run(tmp_path: Path) -> None:
    LiveWriter(tmp_path).say("verdict", "of yesterday")
    reader = LineReader(tmp_path, from_end=True)
    LiveWriter(tmp_path).say("verdict", "of today")
    assert [line.text for line in reader.new()] == ["of today"]


def test_tosses_and_state_come_back_as_they_were_and_damaged_ones_are_left_out(tmp_path: Path) -> None:
    writer = LiveWriter(tmp_path)
    posed = toss_so_far(1, status=("tracked", "lost"), time_ns=(1, 2), camera_from_object=(np.eye(4).tolist(), None))
    writer.toss(posed)
    writer.toss(toss_so_far(2, verdict=("blurred in 9 frames",)))
    (writer.folder / "toss_03.json").write_text('{"toss": 3}')
    (writer.folder / "toss_04.json").write_text("{")
    writer.state(State("working", 7, 1, 2, 3.5, 1.0))
    found = read_tosses(tmp_path)
    assert [t.toss for t in found] == [1, 2]
    np.testing.assert_array_equal(found[0].camera_from_object[0], np.eye(4))
    assert found[0].camera_from_object[1] is None
    assert found[0].good
    assert not found[1].good
    assert "blurred in 9 frames" in found[1].text()
    assert read_state(tmp_path) == State("working", 7, 1, 2, 3.5, 1.0)
    writer.without(2)
    assert [t.toss for t in read_tosses(tmp_path)] == [1]


def test_a_session_that_nobody_follows_says_what_to_type(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="toss-process --follow"):
        require_live(tmp_path)
    LiveWriter(tmp_path)
    assert require_live(tmp_path) == live_folder(tmp_path)


def frame(value: int, width: int = 12) -> LiveFrame:
    color = np.full((8, width, 3), value, dtype=np.uint8)
    depth = np.full((6, width), 100 * value, dtype=np.uint16)
    return LiveFrame(0, 10 * value, 10 * value + 1, 20 * value, color, depth, 0.001)


def test_a_frame_comes_back_as_it_was_put_and_each_is_given_once(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    with FrameBoardWriter(path) as board:
        reader = FrameBoardReader(path)
        assert reader.newest() is None
        board.put(frame(3))
        found = reader.newest()
        assert found is not None
        np.testing.assert_array_equal(found.color_rgb, frame(3).color_rgb)
        np.testing.assert_array_equal(found.depth_raw, frame(3).depth_raw)
        assert (found.time_ns, found.depth_time_ns, found.host_ns, found.unit_m) == (30, 31, 60, 0.001)
        assert reader.newest() is None
    assert not path.exists()


def test_a_reader_takes_the_newest_frame_and_counts_those_it_missed(tmp_path: Path) -> None:
    with FrameBoardWriter(tmp_path / "frames") as board:
        reader = FrameBoardReader(tmp_path / "frames")
        board.put(frame(1))
        assert reader.newest() is not None
        for value in range(2, 2 + 3 * SLOTS):
            board.put(frame(value))
        found = reader.newest()
        assert found is not None
        assert int(found.color_rgb[0, 0, 0]) == 1 + 3 * SLOTS
        assert reader.missed == 3 * SLOTS - 1


def test_a_larger_frame_and_a_file_that_is_no_board_are_refused(tmp_path: Path) -> None:
    with FrameBoardWriter(tmp_path / "frames") as board:
        board.put(frame(1))
        with pytest.raises(BadInput, match="one size a session"):
            board.put(frame(2, width=200))
    (tmp_path / "other").write_bytes(b"x" * 100)
    with pytest.raises(BadInput, match="--live pose"):
        FrameBoardReader(tmp_path / "other").newest()
