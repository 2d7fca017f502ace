"""What a session or one file holds, from its indexes and documents alone: no message stream is read."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray as Array

from recordings import sync
from recordings.bounded.documents import as_dict
from recordings.errors import BadInput, TosslabError
from recordings.mcap.file import McapFile
from recordings.session import Session, Toss
from recordings.tracks import RigCalibration

ONCE = ("/tf",)


@dataclass(frozen=True)
class StreamLine:
    """One topic. `rate_hz` and `gaps` come from receive times; `missing` counts the messages that fit into the gaps."""

    topic: str
    schema: str
    count: int
    rate_hz: float | None
    first_s: float | None
    last_s: float | None
    gaps: int
    missing: int
    dropped: int | None


@dataclass(frozen=True)
class TossLine:
    """One file. Times are seconds on the session clock; `damage` is what keeps it from being read, else empty."""

    name: str
    bytes: int
    duration_s: float | None = None
    streams: tuple[StreamLine, ...] = ()
    events: tuple[tuple[str, float], ...] = ()
    verdict: str = ""
    note: str = ""
    damage: str = ""


@dataclass(frozen=True)
class Info:
    """A session or file in figures. `calibration_age_days` is at the time of recording."""

    path: str
    name: str
    object_name: str
    recorded: str
    status: str
    reason: str
    clock: Mapping[str, Any]
    cameras: tuple[str, ...]
    calibration_age_days: float | None
    duration_s: float
    bytes: int
    tosses: tuple[TossLine, ...]
    start: Mapping[str, Any] = field(default_factory=dict)

    @property
    def damaged(self) -> tuple[TossLine, ...]:
        return tuple(t for t in self.tosses if t.damage)

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    def to_text(self) -> str:
        age = (
            ", age not said"
            if self.calibration_age_days is None
            else f", {_days(self.calibration_age_days)} old when it was recorded"
        )
        lines = [
            f"{self.name}: {len(self.tosses)} files, {self.duration_s:.2f} s, {self.bytes / 1e6:.1f} MB ({self.path})",
            f"  object       {self.object_name or 'not named'}",
            f"  recorded     {self.recorded or 'not said'}, {self.status}{': ' + self.reason if self.reason else ''}",
            f"  clock        {'; '.join(f'{k}: {v}' for k, v in self.clock.items()) or 'not said'}",
            f"  calibration  {', '.join(self.cameras) or 'no cameras'}{age}",
        ]
        return "\n".join([*lines, *(line for toss in self.tosses for line in _toss_lines(toss))])


def inspect(path: Path) -> Info:
    """Figures of a session folder, or of one file of any suffix. A single file that cannot be read raises BadInput."""
    if not path.exists():
        raise BadInput(f"{path} does not exist; wanted a session folder or an .mcap file")
    if path.is_dir():
        return _of_folder(path)
    with McapFile(path) as file:
        if not file.metadata("tosslab"):
            return _of_foreign(path, file)
    session = Session.open(path)
    try:
        return _of_session(session, (_toss_line(session.toss(session.tosses[0]), _counts(session, path.stem)),))
    finally:
        session.close()


def _of_folder(path: Path) -> Info:
    session = Session.open(path)
    files = [*(session.file(t) for t in session.tosses), *sorted(path.glob("calibration.mcap"))]
    lines = []
    for file in files:
        info = as_dict(as_dict(session.stop.get("tosses")).get(file.stem))
        try:
            toss = Toss(file)
            try:
                lines.append(_toss_line(toss, _counts(session, file.stem), str(info.get("verdict", ""))))
            finally:
                toss.close()
        except TosslabError as wrong:
            lines.append(TossLine(file.name, file.stat().st_size, damage=str(wrong)))
    return _of_session(session, tuple(lines))


def _of_session(session: Session, tosses: tuple[TossLine, ...]) -> Info:
    start, stop = session.start, session.stop
    created_ns = start.get("created_unix_ns")
    return Info(
        path=str(session.path),
        name=session.name,
        object_name=str(as_dict(start.get("object")).get("name", "")),
        recorded=_when(created_ns),
        status=str(stop.get("status", "") or "not stopped (cut off, or still recording)"),
        reason=str(stop.get("reason", "") or ""),
        clock=as_dict(start.get("clock")),
        cameras=tuple(session.calibration.cameras),
        calibration_age_days=_age_days(session.calibration, created_ns),
        duration_s=sum(t.duration_s or 0.0 for t in tosses),
        bytes=sum(t.bytes for t in tosses),
        tosses=tosses,
        start=start,
    )


def _of_foreign(path: Path, file: McapFile) -> Info:
    streams = tuple(_stream(file, topic, None) for topic in sorted(file.channels))
    note = "not one of tosslab's: `toss-session import rosbag` takes in recordings of ROS that hold images"
    line = TossLine(path.name, file.size, _span_s(streams), streams, note=note)
    return Info(str(path), path.name, "", "", "whole", "", {}, (), None, line.duration_s or 0.0, file.size, (line,))


def _toss_line(toss: Toss, dropped: Mapping[str, int], verdict: str = "") -> TossLine:
    streams = tuple(_stream(toss.file, topic, dropped) for topic in sorted(toss.file.channels))
    events = toss.events()
    verdicts = [e.text for e in events if e.kind == "verdict"]
    times = tuple((e.kind, e.time_ns / 1e9) for e in events if e.kind not in ("note", "verdict"))
    recovered = toss.file.metadata("tosslab.recovered")
    note = f"recovered from {recovered[-1].get('from', '?')}" if recovered else ""
    return TossLine(
        toss.path.name,
        toss.file.size,
        _span_s(streams),
        streams,
        times,
        verdict or (verdicts[-1] if verdicts else str(toss.info.get("verdict", ""))),
        note,
    )


def _stream(file: McapFile, topic: str, dropped: Mapping[str, int] | None) -> StreamLine:
    times_ns = file.topic_index(topic).log_time_ns
    schema = file.schema(topic)
    period_ns = sync.frame_period_ns(times_ns)
    gaps = sync.gaps(times_ns, period_ns) if period_ns and len(times_ns) > 2 else []
    return StreamLine(
        topic,
        schema.name if schema else "",
        len(times_ns),
        _rate_hz(times_ns),
        float(times_ns[0]) / 1e9 if len(times_ns) else None,
        float(times_ns[-1]) / 1e9 if len(times_ns) else None,
        len(gaps),
        sum(n for _, n in gaps),
        None if dropped is None else dropped.get(topic, 0),
    )


def _rate_hz(times_ns: Int64[Array, " n"]) -> float | None:
    """Messages per second by the median step, so that a pause does not slow a stream down."""
    period_ns = float(np.median(np.diff(times_ns))) if len(times_ns) > 2 else 0.0
    return 1e9 / period_ns if period_ns > 0 else None


def _span_s(streams: tuple[StreamLine, ...]) -> float | None:
    firsts = [s.first_s for s in streams if s.first_s is not None and s.topic not in ONCE]
    lasts = [s.last_s for s in streams if s.last_s is not None and s.topic not in ONCE]
    return max(lasts) - min(firsts) if firsts else None


def _counts(session: Session, name: str) -> dict[str, int]:
    """Dropped messages by topic, from the stop document."""
    streams = as_dict(as_dict(session.stop.get("streams")).get(name))
    return {topic: int(n) for topic, c in streams.items() if isinstance(n := as_dict(c).get("dropped", 0), int)}


def _when(created_ns: object) -> str:
    if not isinstance(created_ns, int):
        return ""
    try:
        return datetime.fromtimestamp(created_ns / 1e9, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    except (ValueError, OverflowError, OSError):
        return ""


def _age_days(calibration: RigCalibration, created_ns: object) -> float | None:
    if calibration.created_unix_s is None:
        return None
    recorded_s = created_ns / 1e9 if isinstance(created_ns, int) else time.time()
    return (recorded_s - calibration.created_unix_s) / 86400


def _days(days: float) -> str:
    return f"{days:.1f} days" if abs(days) >= 1 else f"{days * 24:.1f} hours"


def _toss_lines(toss: TossLine) -> list[str]:
    if toss.damage:
        return [f"{toss.name}  DAMAGED: {toss.damage}"]
    start_s = min((s.first_s for s in toss.streams if s.first_s is not None), default=0.0)
    parts = [toss.name, f"{toss.duration_s or 0:.2f} s", f"{toss.bytes / 1e6:.1f} MB"]
    parts += [f"{kind} at {time_s - start_s:.3f} s" for kind, time_s in toss.events]
    parts += [f"verdict {toss.verdict}"] if toss.verdict else []
    parts += [toss.note] if toss.note else []
    shown = [s for s in toss.streams if s.topic not in ONCE and not s.topic.endswith("calibration")]
    width = max((len(s.topic) for s in shown), default=0)
    return ["  ".join(parts), *(_stream_line(s, width) for s in shown)]


def _stream_line(s: StreamLine, width: int) -> str:
    rate = f"{s.rate_hz:8.2f} Hz" if s.rate_hz else " " * 11
    gaps = f"  {s.gaps} gaps ({s.missing} missing)" if s.gaps else ""
    dropped = f"  {s.dropped} DROPPED" if s.dropped else ""
    return f"  {s.topic:<{width}}  {s.count:>7}  {rate}  {s.schema}{gaps}{dropped}"
