"""Going on with an interrupted session."""

from __future__ import annotations

import pytest

from recordings.errors import BadInput
from recordings.session import Session
from recordings.session_resume import next_toss, resume_session
from recordings.session_writer import SessionWriter
from recordings.verify.verify import verify


def cut_off(tmp_path, rig, keep: int):
    """A session whose writer died in its second toss: no stop document, toss_01 cut to `keep` bytes."""
    session = SessionWriter(tmp_path / "s", {"object": {"name": "cube"}}, rig.calibration)
    for toss in range(2):
        with session.toss(toss, {"clock_offset_ns": toss}) as writer:
            rig.write(writer)
    path = tmp_path / "s" / "toss_01.mcap"
    path.write_bytes(path.read_bytes()[:keep])
    return tmp_path / "s"


def test_a_session_goes_on_where_it_was_cut_off(tmp_path, small_rig):
    folder = cut_off(tmp_path, small_rig, 25_000)
    first = (folder / "toss_00.mcap").read_bytes()
    cut = (folder / "toss_01.mcap").read_bytes()
    session, reports = resume_session(folder)
    with session:
        assert next_toss(folder) == 2
        with pytest.raises(BadInput, match="toss_00 was written already"):
            session.toss(0)
        with session.toss(2) as toss:
            small_rig.write(toss)
        session.finish()
    assert [r.out for r in reports] == ["toss_01.mcap"]
    assert (folder / "toss_00.mcap").read_bytes() == first
    assert (folder / "toss_01.mcap.cut").read_bytes() == cut
    read = Session.open(folder)
    assert read.tosses == (0, 1, 2)
    assert read.object_name == "cube"
    assert read.stop["tosses"]["toss_00"] == {"toss": 0, "clock_offset_ns": 0}
    assert set(read.stop["sha256"]) == {"toss_00.mcap", "toss_01.mcap", "toss_02.mcap", "calibration.json"}
    assert verify(folder).ok


def test_a_toss_of_which_nothing_is_left_frees_its_number(tmp_path, small_rig):
    folder = cut_off(tmp_path, small_rig, 0)
    session, reports = resume_session(folder)
    assert [r.out for r in reports] == [""]
    assert next_toss(folder) == 1
    with session, session.toss(1) as toss:
        small_rig.write(toss)
    assert verify(folder).ok


def test_a_finished_session_can_be_extended_and_keeps_its_verdicts(write_session, small_rig):
    folder = write_session(tosses=2)
    session, reports = resume_session(folder)
    with session:
        with session.toss(2) as toss:
            small_rig.write(toss)
        session.add_info(2, {"verdict": "reject"})
        session.finish()
    assert reports == ()
    tosses = Session.open(folder).stop["tosses"]
    assert [tosses[f"toss_0{i}"]["verdict"] for i in range(3)] == ["accept", "accept", "reject"]
    assert verify(folder).findings == ()


def test_a_rejected_take_leaves_nothing_behind(tmp_path, small_rig):
    with SessionWriter(tmp_path / "s", {}, small_rig.calibration) as session:
        for take in range(2):
            with session.toss(0) as toss:
                toss.color(small_rig.color(take))
                toss.depth(small_rig.depth(take))
            if take == 0:
                session.discard(0)
        with pytest.raises(BadInput, match="toss_05 was not written"):
            session.discard(5)
        with pytest.raises(BadInput, match="toss_05 was not written"):
            session.add_info(5, {})
        session.finish()
    read = Session.open(tmp_path / "s")
    assert [f.data for f in read.toss(0).color()] == [small_rig.color(1).data]
    assert verify(tmp_path / "s").ok


def test_what_is_no_session_cannot_be_resumed(tmp_path):
    with pytest.raises(BadInput, match="is no folder"):
        resume_session(tmp_path / "none")
    with pytest.raises(BadInput, match=r"session\.json cannot be read"):
        resume_session(tmp_path)
