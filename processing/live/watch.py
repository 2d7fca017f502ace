"""What changes in the folder of a session that is recorded: tosses that are finished, taken away, recorded anew."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from recordings.bounded.documents import as_dict, read_document
from recordings.errors import TosslabError
from recordings.mcap.writer import MAGIC

LEAST_BYTES = 64


@dataclass(frozen=True)
class FileId:
    """One file as it was found; another one under its name has another."""

    inode: int
    size: int
    changed_ns: int


def finished_tosses(session: Path) -> dict[int, FileId]:
    """Tosses whose files are whole: an MCAP ends with its magic only once it was finished."""
    found = {}
    for path in session.glob("toss_*.mcap"):
        number = path.stem[5:]
        if number.isdigit() and (seen := finished(path)) is not None:
            found[int(number)] = seen
    return dict(sorted(found.items()))


def finished(path: Path) -> FileId | None:
    """A whole file; None where it is still written, or gone."""
    try:
        with open(path, "rb") as file:
            file.seek(0, 2)
            if file.tell() < LEAST_BYTES:
                return None
            file.seek(-len(MAGIC), 2)
            if file.read() != MAGIC:
                return None
        about = path.stat()
    except OSError:
        return None
    return FileId(about.st_ino, about.st_size, about.st_mtime_ns)


def ended(session: Path) -> bool:
    """Whether its recorder has written the stop document."""
    try:
        return bool(as_dict(read_document(session / "session.json").get("stop")).get("status"))
    except (TosslabError, OSError):
        return False
