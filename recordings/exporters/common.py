"""What every exporter needs: an output that is whole or not there, nothing overwritten, one report."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recordings.errors import BadInput, WriteFailed
from recordings.results.folder import Results
from recordings.session import Session


@dataclass(frozen=True)
class ExportReport:
    """What an export wrote: the format, where, how many files, what a reader should know."""

    format: str
    out: Path
    files: int
    notes: tuple[str, ...] = ()

    def text(self) -> str:
        files = "1 file" if self.files == 1 else f"{self.files} files"
        return "\n".join([f"{self.out}: {files} ({self.format})", *(f"  note: {n}" for n in self.notes)])


@contextmanager
def new_files(out: Path) -> Iterator[Path]:
    """A folder to write into; on a clean exit its files move to `out`, and nothing that is there is overwritten.

    `out` may hold other files already (`export tum` and `export mesh` into one folder). Raises BadInput before anything
    is moved when a file of that name exists, WriteFailed when the disk refuses. After an error `out` is as it was.
    """
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out} is a file; wanted a folder to write into")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))
    except OSError as refused:
        raise WriteFailed(f"{out} cannot be made: {refused.strerror}") from refused
    try:
        yield made
        _move(made, out)
    except OSError as refused:
        raise WriteFailed(f"{out} could not be written: {refused.strerror}; nothing was left there") from refused
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _move(made: Path, out: Path) -> None:
    files = sorted(p.relative_to(made) for p in made.rglob("*") if p.is_file())
    for file in files:
        if (out / file).exists():
            raise BadInput(f"{out / file} exists already; nothing was overwritten. Choose another folder or remove it")
    if not out.exists():
        made.chmod(0o755)  # mkdtemp makes it private
        made.rename(out)
        return
    for file in files:
        (out / file).parent.mkdir(parents=True, exist_ok=True)
        (made / file).rename(out / file)


def new_file(out: Path) -> Path:
    """An output file's path, checked. Raises BadInput when it exists."""
    if out.exists():
        raise BadInput(f"{out} exists already; nothing was overwritten. Choose another name or remove it")
    return out


def write_document(path: Path, document: Any, indent: int = 1) -> None:
    """A JSON file as other programs read it; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document, indent=indent) + "\n")


def count_files(folder: Path) -> int:
    return sum(1 for p in folder.rglob("*") if p.is_file())


def open_results(source: Path) -> Results:
    """The results that an export needs. Raises BadInput when `source` holds none."""
    if not source.exists():
        raise BadInput(f"{source} does not exist; wanted a results folder, or a session with results/ in it")
    return Results.open(source)


def open_recording(source: Path, variant: str | None, scope: str | None) -> Session:
    """The session that an export needs: `source` itself, or the one that these results were made from."""
    if not source.exists():
        raise BadInput(f"{source} does not exist; wanted a session, or a results folder")
    if not Results.is_results(source):
        return Session.open(source)
    path = Results.open(source).session_path(variant, scope)
    if path is None:
        raise BadInput(f"the session that {source} was made from is not there any more; give the session instead")
    return Session.open(path)
