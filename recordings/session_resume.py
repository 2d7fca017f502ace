"""Going on with a session that was interrupted: whole tosses stay as they are, a cut one is recovered in its place."""

from __future__ import annotations

from pathlib import Path

from recordings.bounded.documents import as_dict, json_object, read_document
from recordings.errors import BadInput
from recordings.mcap.file import McapFile
from recordings.mcap.recover import STOP, Recovered, recover_file
from recordings.mcap.structure import check_structure
from recordings.session_writer import FinishedFile, SessionWriter
from recordings.tracks import RigCalibration
from recordings.whole_file import file_sha256

CUT = ".cut"
"""Added to the name of a file that was cut off: its bytes stay beside the recovered file."""


def resume_session(folder: Path) -> tuple[SessionWriter, tuple[Recovered, ...]]:
    """A writer that goes on in `folder` with its start document and calibration, and what had to be recovered.

    A cut toss_XX.mcap is kept as toss_XX.mcap.cut and replaced by what could be saved of it; where nothing could, its
    number is free again. Raises BadInput when the folder is no session.
    """
    if not folder.is_dir():
        raise BadInput(f"{folder} is no folder; wanted the session to go on with")
    start = as_dict(read_document(folder / "session.json").get("start"))
    calibration = RigCalibration.read(folder / "calibration.json")
    reports = tuple(r for path in sorted(folder.glob("*.mcap")) if (r := _recovered_in_place(path)) is not None)
    verdicts = as_dict(as_dict(read_document(folder / "session.json").get("stop")).get("tosses"))
    earlier = {path.stem: _finished(path, as_dict(verdicts.get(path.stem))) for path in sorted(folder.glob("*.mcap"))}
    return SessionWriter(folder, start, calibration, earlier), reports


def next_toss(folder: Path) -> int:
    """The number after the highest toss of a session."""
    numbers = [int(p.stem[5:]) for p in folder.glob("toss_*.mcap") if p.stem[5:].isdigit()]
    return max(numbers, default=-1) + 1


def _recovered_in_place(path: Path) -> Recovered | None:
    try:
        if not check_structure(path).damaged:
            return None
    except BadInput:
        pass  # empty, or no MCAP any more: recovering it says so
    cut = path.with_name(path.name + CUT)
    if cut.exists():
        raise BadInput(
            f"{cut} exists already: {path.name} was recovered before and is damaged again; move {cut.name} away"
        )
    path.rename(cut)
    try:
        return recover_file(cut, path)
    except BadInput as nothing:
        return Recovered(path.name, "", {}, {}, {}, cut.stat().st_size, (str(nothing),))


def _finished(path: Path, info: dict[str, object]) -> FinishedFile:
    with McapFile(path) as file:
        stops, own = file.metadata(STOP), file.metadata("tosslab")
    streams = json_object(stops[-1].get("streams", "")) if stops else {}
    stored = json_object(own[0].get("info", "")) if own else {}
    return FinishedFile(file_sha256(path), streams, {**stored, **info})
