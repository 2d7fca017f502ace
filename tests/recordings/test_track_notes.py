"""How a track came about: written, read back, found from the stages made of it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from recordings.errors import DamagedFile
from recordings.results.folder import Results
from recordings.results.track_notes import Matches, Rejected, find_notes, read_notes, write_notes

REJECTED = Rejected(np.array([1, 1, 2]), np.tile(np.eye(4), (3, 1, 1)), np.array([0.3, 0.4, 0.5]))
MATCHES = Matches(np.array([[1, 0], [2, 0]]), np.arange(12.0).reshape(2, 2, 3), np.array([True, False]))
KEY = "0123456789abcdef"


@pytest.fixture
def stage(tmp_path: Path) -> Path:
    """A track's folder as the tracker leaves it."""
    folder = tmp_path / f"track-{KEY[:8]}"
    folder.mkdir()
    np.savez(folder / "toss_04.fit.npz", cost=np.array([0.1, np.nan]), on_surface=np.ones(2), keyframes=np.array([0]))
    return folder


def test_notes_come_back_as_they_were(stage: Path) -> None:
    write_notes(stage, 4, REJECTED, MATCHES)
    notes = read_notes(stage, 4)
    assert notes is not None
    assert notes.keyframes == (0,)
    np.testing.assert_array_equal(notes.residual, [0.1, np.nan])
    for found, wanted in ((notes.rejected, REJECTED), (notes.matches, MATCHES)):
        for name, value in vars(wanted).items():
            np.testing.assert_array_equal(getattr(found, name), value)


def test_a_tracker_that_keeps_less_has_less_to_show(stage: Path) -> None:
    notes = read_notes(stage, 4)
    assert notes is not None
    assert len(notes.rejected.frame) == len(notes.matches.frames) == 0
    assert read_notes(stage, 5) is None


def test_the_same_notes_give_the_same_bytes(stage: Path) -> None:
    assert (
        write_notes(stage, 4, REJECTED, MATCHES).read_bytes() == write_notes(stage, 4, REJECTED, MATCHES).read_bytes()
    )


def test_a_stage_made_of_a_track_shows_its_notes_but_not_poses_in_another_frame(stage: Path) -> None:
    write_notes(stage, 4, REJECTED, MATCHES)
    made = stage.parent / "register-ffffffff"
    made.mkdir()
    (made / "stage.json").write_text(json.dumps({"inputs": {"track_04": KEY}}))
    results = Results(stage.parent, {})
    notes = find_notes(results, made.name, 4)
    assert notes is not None
    assert len(notes.matches.frames) == 2
    assert len(notes.rejected.frame) == 0
    assert find_notes(results, made.name, 0) is None
    assert find_notes(results, "nowhere", 4) is None


def test_damaged_notes_say_so(stage: Path) -> None:
    (stage / "toss_04.notes.npz").write_bytes(b"PK")
    with pytest.raises(DamagedFile, match=r"notes.npz cannot be read"):
        read_notes(stage, 4)
    np.savez(stage / "toss_04.notes.npz", rejected_frame=np.zeros(0))
    with pytest.raises(DamagedFile, match="lack 'rejected_pose'"):
        read_notes(stage, 4)
