"""Writing a session: one complete MCAP file per toss, a start and a stop document, sha256 of every file."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from recordings.bounded.documents import FORMAT_VERSION, as_dict, read_document
from recordings.errors import BadInput, WriteFailed
from recordings.mcap.toss_writer import TossWriter
from recordings.records import StampedPose
from recordings.tracks import RigCalibration
from recordings.whole_file import file_sha256, write_bytes, write_json

NO_CALIBRATION = RigCalibration(cameras={})


def toss_name(toss: int) -> str:
    return f"toss_{toss:02d}"


@dataclass(frozen=True)
class FinishedFile:
    """A file of the session that an earlier run finished: what the stop document says of it."""

    sha256: str
    streams: Mapping[str, Any]
    info: Mapping[str, Any]


class SessionWriter:
    """A session folder being written. Leaving the context without `finish` writes a stop document with status `failed`
    or `interrupted`; every finished toss stays whole.

    The folder must not exist, or be empty, unless `earlier` names the files (by stem) that an interrupted run left
    there: see session_resume.resume_session.
    """

    def __init__(
        self,
        folder: Path,
        start: Mapping[str, Any],
        calibration: RigCalibration = NO_CALIBRATION,
        earlier: Mapping[str, FinishedFile] | None = None,
    ) -> None:
        if earlier is None and folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise BadInput(f"{folder} exists already; nothing was written. Choose another name or remove it")
        self.folder = folder
        self._earlier = dict(earlier or {})
        self.start = {"created_unix_ns": time.time_ns(), **start}
        self._calibration = calibration
        self._tosses: dict[str, TossWriter] = {}
        self._info: dict[str, Mapping[str, Any]] = {}
        self._stopped = False
        _make_folder(folder)
        if earlier is None:
            write_json(folder / "calibration.json", calibration.to_json())
        self._write_document(None)

    def __enter__(self) -> SessionWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, *rest: object) -> None:
        if self._stopped:
            return
        self._abandon_open_tosses()
        interrupted = kind is None or issubclass(kind, KeyboardInterrupt)
        try:
            self.finish("interrupted" if interrupted else "failed", str(error) if error else "left without finish")
        except WriteFailed:
            if kind is None:
                raise

    def toss(self, toss: int, info: Mapping[str, Any] | None = None) -> TossWriter:
        """A new toss's file. `info` (JSON values) is kept in it and in session.json, for instance clock offsets."""
        return self._file(toss_name(toss), "toss", {"toss": toss, **(info or {})})

    def add_info(self, toss: int, info: Mapping[str, Any]) -> None:
        """What is known only after a toss, for instance its verdict: kept in session.json."""
        name = toss_name(toss)
        if name not in self._info:
            raise BadInput(f"{name} was not written by this session; it wrote {', '.join(self._info) or 'nothing'}")
        self._info[name] = {**self._info[name], **info}

    def discard(self, toss: int) -> None:
        """Remove a rejected take of this run, whole or not; its number is free again."""
        name = toss_name(toss)
        if name not in self._tosses:
            raise BadInput(f"{name} was not written by this run; nothing was removed")
        self._tosses[name].abandon()
        self._tosses[name].path.unlink(missing_ok=True)
        del self._tosses[name], self._info[name]

    def calibration_views(self) -> TossWriter:
        """calibration.mcap: views of a board, one image of each camera per view, stamped one second apart."""
        return self._file("calibration", "calibration", {})

    def finish(self, status: str = "complete", reason: str = "") -> None:
        """Write the stop document: counts per stream and the sha256 of every finished file.

        A toss that is still open is left as it is, recoverable and without a sha256.
        """
        self._abandon_open_tosses()
        sha256 = {f"{name}.mcap": f.sha256 for name, f in self._earlier.items()}
        sha256 |= {t.path.name: t.sha256 for t in self._tosses.values() if t.sha256 is not None}
        sha256["calibration.json"] = file_sha256(self.folder / "calibration.json")
        self._write_document(
            {
                "stopped_unix_ns": time.time_ns(),
                "status": status,
                "reason": reason,
                "streams": {
                    **{name: dict(f.streams) for name, f in self._earlier.items()},
                    **{name: t.streams() for name, t in self._tosses.items()},
                },
                "tosses": {
                    **{name: dict(f.info) for name, f in self._earlier.items()},
                    **{name: dict(info) for name, info in self._info.items()},
                },
                "sha256": sha256,
            }
        )
        self._stopped = True

    def _abandon_open_tosses(self) -> None:
        for toss in self._tosses.values():
            if toss.sha256 is None:
                toss.abandon()

    def _file(self, name: str, kind: str, info: Mapping[str, Any]) -> TossWriter:
        if name in self._tosses or name in self._earlier:
            raise BadInput(f"{name} was written already in this session; nothing was changed")
        writer = TossWriter(self.folder / f"{name}.mcap", self.start, self._calibration, kind, info)
        self._tosses[name], self._info[name] = writer, info
        return writer

    def _write_document(self, stop: Mapping[str, Any] | None) -> None:
        write_json(self.folder / "session.json", {"format_version": FORMAT_VERSION, "start": self.start, "stop": stop})


def write_truth(
    session: Path,
    poses: Mapping[int, Sequence[StampedPose]],
    info: Mapping[str, Any],
    mesh_obj: bytes | None = None,
) -> Path:
    """Write the session's truth/ folder: a file of `/groundtruth/pose` per toss, truth.json and mesh.obj.

    `poses` are `world_from_object` or `d455_from_object`, as each names itself. The folder must not exist yet.
    """
    folder = session / "truth"
    if folder.exists():
        raise BadInput(f"{folder} exists already; nothing was written. Remove it to write the truth anew")
    _make_folder(folder)
    sha256 = {}
    for toss, track in poses.items():
        with TossWriter(
            folder / f"{toss_name(toss)}.mcap", {"truth": dict(info)}, NO_CALIBRATION, "truth", {"toss": toss}
        ) as w:
            for i, pose in enumerate(track):
                w.pose("/groundtruth/pose", pose, i)
            sha256[w.path.name] = w.finish()
    if mesh_obj is not None:
        write_bytes(folder / "mesh.obj", mesh_obj)
        sha256["mesh.obj"] = file_sha256(folder / "mesh.obj")
    write_json(folder / "truth.json", {"format_version": FORMAT_VERSION, **info, "sha256": sha256})
    return folder


def renew_manifest(folder: Path, *names: str) -> None:
    """Sign the named files of a session anew, which a later command has every right to change (calibration.json after
    `toss-calibrate`). Raises BadInput.

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


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as refused:
        raise WriteFailed(f"{folder} cannot be made: {refused.strerror}") from refused
