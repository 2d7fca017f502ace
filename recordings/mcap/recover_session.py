"""A damaged session to a new folder: whole files are copied, damaged ones recovered, the documents renewed."""

from __future__ import annotations

import shutil
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from recordings.bounded.documents import FORMAT_VERSION, as_dict, json_object, mapping, read_document
from recordings.errors import BadInput, TosslabError, WriteFailed
from recordings.mcap.file import McapFile
from recordings.mcap.recover import STOP, Recovered, recover_file
from recordings.mcap.structure import check_structure
from recordings.progress import Progress, Silent
from recordings.tracks import RigCalibration
from recordings.whole_file import file_sha256, write_bytes, write_json

LEFT_BEHIND = ("results",)


def recover(source: Path, out: Path, progress: Progress | None = None) -> list[Recovered]:
    """A file or a session folder to a new one. Raises BadInput when `out` exists or `source` is neither."""
    if not source.exists():
        raise BadInput(f"{source} does not exist; wanted a session folder or an .mcap file")
    if not source.is_dir():
        return [recover_file(source, out)]
    return _recover_folder(source, out, progress or Silent())


def _recover_folder(source: Path, out: Path, progress: Progress) -> list[Recovered]:
    if out.exists() or out.is_symlink():
        raise BadInput(f"{out} exists already; nothing was written. Choose another name or remove it")
    if out.resolve().is_relative_to(source.resolve()):
        raise BadInput(f"{out} lies inside {source}, which must stay as it is; choose a folder beside it")
    recordings = sorted(source.glob("*.mcap"))
    if not recordings:
        raise BadInput(f"{source} holds no .mcap file: there is nothing to recover")
    try:
        out.mkdir(parents=True)
        _copy_others(source, out)
        reports = []
        for i, path in enumerate(recordings):
            progress.step(i, len(recordings), path.name)
            reports.append(_copied_or_recovered(path, out / path.name))
        progress.step(len(recordings), len(recordings))
        _renew_documents(source, out, reports)
    except OSError as refused:
        raise WriteFailed(f"{out}: {refused.strerror} ({refused.filename}); {source} is as it was") from refused
    return reports


def _copy_others(source: Path, out: Path) -> None:
    for path in sorted(source.iterdir()):
        if path.is_dir() and path.name not in LEFT_BEHIND:
            shutil.copytree(path, out / path.name)
        elif path.is_file() and path.suffix not in (".mcap", ".partial"):
            shutil.copyfile(path, out / path.name)


def _copied_or_recovered(source: Path, out: Path) -> Recovered:
    """A whole file is copied byte for byte; a file of which nothing can be saved is reported, not written."""
    try:
        if not check_structure(source).damaged:
            shutil.copyfile(source, out)
            return Recovered(source.name, out.name, _counts(out), {}, {}, 0, (), sha256=file_sha256(out))
        return recover_file(source, out)
    except BadInput as nothing:
        return Recovered(source.name, "", {}, {}, {}, source.stat().st_size, (str(nothing),))


def _counts(path: Path) -> dict[str, int]:
    with McapFile(path) as file:
        return {topic: len(file.topic_index(topic)) for topic in file.channels}


def _renew_documents(source: Path, out: Path, reports: list[Recovered]) -> None:
    _mend_calibration(out, reports)
    document = _document(source, reports, out)
    stop = as_dict(document.get("stop"))
    _add_known_losses(reports, as_dict(stop.get("streams")))
    damaged = [r for r in reports if not r.whole or not r.out]
    sha256 = {r.out: r.sha256 for r in reports if r.out}
    sha256["calibration.json"] = file_sha256(out / "calibration.json")
    streams, tosses = as_dict(stop.get("streams")), as_dict(stop.get("tosses"))
    for report in reports:
        name = Path(report.source).stem
        if report.out:
            streams[name], tosses[name] = _stop_of(out / report.out)
    stop.update(
        recovered_unix_ns=time.time_ns(),
        status="recovered",
        reason="; ".join(f"{r.source}: {_in_words(r)}" for r in damaged) or "nothing was damaged",
        streams=streams,
        tosses=tosses,
        sha256=sha256,
        recovered={r.source: r.to_json() for r in damaged},
    )
    write_json(out / "session.json", {"format_version": FORMAT_VERSION, "start": document.get("start"), "stop": stop})


def _add_known_losses(reports: list[Recovered], streams: Mapping[str, Any]) -> None:
    """What the stop document counted as written and is not there any more: it outlives the file's own end."""
    for i, report in enumerate(reports):
        counted = as_dict(streams.get(Path(report.source).stem))
        lost = {topic: n for topic, counts in counted.items() if (n := _count(counts) - report.kept.get(topic, 0)) > 0}
        reports[i] = replace(report, lost={**report.lost, **lost})


def _count(counts: object) -> int:
    written = as_dict(counts).get("written", 0)
    return written if isinstance(written, int) else 0


def _in_words(report: Recovered) -> str:
    if not report.out:
        return "nothing could be saved"
    return f"{sum(report.kept.values())} messages kept, {sum(report.lost.values())} known to be lost"


def _document(source: Path, reports: list[Recovered], out: Path) -> Mapping[str, Any]:
    """session.json, or where it cannot be read the start document that every file carries."""
    try:
        document = read_document(source / "session.json")
        mapping(document.get("start"), "start")
        return document
    except BadInput:
        for report in reports:
            data = _attached(out / report.out, "session.json") if report.out else None
            if data is not None:
                return {"start": as_dict(json_object(data).get("start"))}
    return {"start": {}}


def _mend_calibration(out: Path, reports: list[Recovered]) -> None:
    path = out / "calibration.json"
    try:
        RigCalibration.read(path)
        return
    except TosslabError:
        pass
    for report in reports:
        data = _attached(out / report.out, "calibration.json") if report.out else None
        if data is not None:
            path.unlink(missing_ok=True)
            write_bytes(path, data)
            return
    path.unlink(missing_ok=True)
    write_json(path, RigCalibration(cameras={}).to_json())


def _attached(path: Path, name: str) -> bytes | None:
    with McapFile(path) as file:
        return file.attachment(name)


def _stop_of(path: Path) -> tuple[Any, Any]:
    """Counts by topic and the toss's own information."""
    with McapFile(path) as file:
        stop, own = file.metadata(STOP), file.metadata("tosslab")
    return json_object(stop[-1].get("streams", "")) if stop else {}, json_object(own[0].get("info", "")) if own else {}
