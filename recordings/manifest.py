"""The sha256 manifest of a session, renewed for files that a later command has every right to change."""

from __future__ import annotations

from pathlib import Path

from recordings.bounded.documents import as_dict, read_document
from recordings.errors import BadInput
from recordings.whole_file import file_sha256, write_json


def renew(folder: Path, *names: str) -> None:
    """Sign the named files of a session anew (calibration.json after `toss-calibrate`). Raises BadInput.

    Nothing happens to a session that has no stop document yet: it is signed when it stops.
    """
    document = read_document(folder / "session.json")
    stop = as_dict(document.get("stop"))
    if not stop:
        return
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise BadInput(f"{folder} has no {', '.join(missing)}; nothing was signed")
    signed = {**as_dict(stop.get("sha256")), **{name: file_sha256(folder / name) for name in names}}
    write_json(folder / "session.json", {**document, "stop": {**stop, "sha256": signed}})
