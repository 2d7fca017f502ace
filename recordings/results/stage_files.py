"""The files of a stage's folder, read within limits: whatever is wrong with one is a message that says what to do."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from recordings.bounded.documents import read_json
from recordings.bounded.limits import open_npz
from recordings.errors import DamagedFile

AGAIN = "remove its folder and run toss-process again"


@contextmanager
def stage_file(path: Path) -> Iterator[None]:
    """Around whatever reads a file of a stage's folder. Raises DamagedFile for all that its content makes it raise."""
    try:
        yield
    except KeyError as wrong:
        raise DamagedFile(f"{path} lacks {wrong}; {AGAIN}") from wrong
    except (OSError, ValueError, IndexError, TypeError, AttributeError) as wrong:
        raise DamagedFile(f"{path} cannot be read ({wrong}); {AGAIN}") from wrong


@contextmanager
def stage_arrays(path: Path) -> Iterator[Any]:
    """The arrays of an .npz by name; what reads them stands in the `with`. Raises DamagedFile."""
    with stage_file(path), open_npz(path) as stored:
        yield stored


def read_arrays(path: Path) -> dict[str, Any]:
    """Every array of an .npz by name; none where there is no such file. Raises DamagedFile."""
    if not path.exists():
        return {}
    with stage_arrays(path) as stored:
        return {name: stored[name] for name in stored.files}


def stage_document(path: Path) -> Mapping[str, Any]:
    """A JSON object. Raises BadInput where it cannot be opened, DamagedFile where it is none."""
    document = read_json(path, f"; {AGAIN}")
    if not isinstance(document, dict):
        raise DamagedFile(f"{path}: wanted a JSON object, found {type(document).__name__}; {AGAIN}")
    return document
