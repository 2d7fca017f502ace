"""What every importer needs: a session that is whole or not there, files read with plain errors, in time order."""

from __future__ import annotations

import heapq
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int64
from numpy import ndarray as Array

from recordings.bounded.documents import parse_json, read_json
from recordings.errors import BadInput
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration

WRAP_32BIT_US_NS = (1 << 32) * 1000
"""A 32-bit microsecond counter starts anew after this (71.6 minutes)."""
TOSS_SPACING_NS = 60_000_000_000
"""Imported tosses whose clocks all start at 0 are laid this far apart on the session clock, or further."""

Write = Callable[[], None]
Timed = tuple[int, Write]
"""A message to come: its time in ns on the session clock, and what writes it."""


@dataclass(frozen=True)
class ImportReport:
    """What an import made: the session, the messages written per topic over all tosses, what a reader should know."""

    session: Path
    layout: str
    tosses: tuple[int, ...]
    streams: Mapping[str, int]
    truth: bool
    warnings: tuple[str, ...]

    def text(self) -> str:
        counts = ", ".join(f"{topic} {n}" for topic, n in self.streams.items())
        lines = [
            f"{self.session}: {len(self.tosses)} tosses from {self.layout}" + (", with truth" if self.truth else "")
        ]
        lines += [f"  {counts}"] + [f"  warning: {w}" for w in self.warnings]
        return "\n".join(lines + [f"next: toss-session verify {self.session}"])


class Warnings:
    """Collects what is odd but no reason to refuse; each sentence once."""

    def __init__(self) -> None:
        self._found: list[str] = []

    def add(self, sentence: str) -> None:
        if sentence not in self._found:
            self._found.append(sentence)

    def all(self) -> tuple[str, ...]:
        return tuple(self._found)


@contextmanager
def new_session(out: Path, start: Mapping[str, Any], calibration: RigCalibration) -> Iterator[SessionWriter]:
    """A session that is finished on a clean exit. After an error nothing is left at `out`; after an interruption what
    is there is kept, with a stop document that says so."""
    was_there = out.exists()
    writer = SessionWriter(out, start, calibration)  # refuses an `out` that is not empty: what we remove below is ours
    try:
        with writer:
            yield writer
            writer.finish()
    except Exception:
        shutil.rmtree(out, ignore_errors=True)
        if was_there:
            out.mkdir(exist_ok=True)
        raise


def report(writer: SessionWriter, layout: str, warnings: Warnings, truth: bool = False) -> ImportReport:
    """The report of a finished session, its counts taken from the stop document."""
    document = read_json(writer.folder / "session.json")["stop"]
    streams: dict[str, int] = {}
    for name, counts in document["streams"].items():
        for topic, n in counts.items() if name.startswith("toss_") else ():
            streams[topic] = streams.get(topic, 0) + int(n["written"])
    numbers = tuple(int(info["toss"]) for name, info in document["tosses"].items() if name.startswith("toss_"))
    return ImportReport(writer.folder, layout, numbers, streams, truth, warnings.all())


def write_in_order(*streams: Iterable[Timed]) -> None:
    """Write several streams, each in time order, as one: the file is read in the order of time."""
    for _, write in heapq.merge(*streams, key=lambda message: message[0]):
        write()


def read_bytes(path: Path) -> bytes:
    """A file's bytes. Raises BadInput when it cannot be read or is empty."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as missing:
        raise BadInput(f"{path} is missing") from missing
    except OSError as refused:
        raise BadInput(f"{path} cannot be read: {refused.strerror}") from refused
    if not data:
        raise BadInput(f"{path} is empty (0 bytes)")
    return data


def read_text(path: Path) -> str:
    try:
        return read_bytes(path).decode()
    except UnicodeDecodeError as wrong:
        raise BadInput(f"{path} is no text file ({wrong})") from wrong


def read_json_object(path: Path) -> dict[str, Any]:
    """A JSON file that holds an object. Raises BadInput."""
    document = parse_json(read_text(path), str(path))
    if not isinstance(document, dict):
        raise BadInput(f"{path}: wanted a JSON object, found {type(document).__name__}")
    return document


def listed(folder: Path, suffixes: Sequence[str]) -> list[Path]:
    """Files of a folder with one of these suffixes, by their number. Raises BadInput for a name that is no number."""
    try:
        files = [p for p in folder.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    except OSError as refused:
        raise BadInput(f"{folder} cannot be read: {refused.strerror}") from refused
    for file in files:
        if not file.stem.isdigit():
            raise BadInput(f"{file}: wanted a frame number as its name, like 000012{file.suffix}")
    numbers = [int(f.stem) for f in files]
    twice = {n for n in numbers if numbers.count(n) > 1} if len(set(numbers)) != len(numbers) else set()
    if twice:
        raise BadInput(f"{folder} holds frame {min(twice)} twice; wanted one image per frame number")
    return sorted(files, key=lambda f: int(f.stem))


def same_frames(folder: Path, color: Sequence[Path], depth: Sequence[Path], wanted: str = "") -> None:
    """Raises BadInput where a frame is not among both colour and depth images; `wanted`: what to do then."""
    alone = sorted({int(p.stem) for p in color} ^ {int(p.stem) for p in depth})
    if alone:
        raise BadInput(
            f"{folder}: {len(color)} colour and {len(depth)} depth images; frame {alone[0]} is only in one of "
            f"rgb/ and depth/{wanted}"
        )


def read_stamps_ns(path: Path) -> Int64[Array, " n"]:
    """timestamps.txt: seconds, one per line, to whole nanoseconds without passing through a float. Strictly growing."""
    times = [
        seconds_to_ns(line, f"{path}:{i}") for i, line in enumerate(read_text(path).splitlines(), 1) if line.strip()
    ]
    return growing(np.array(times, dtype=np.int64), str(path))


def seconds_to_ns(text: str, where: str) -> int:
    """A decimal number of seconds as nanoseconds, exactly. Raises BadInput."""
    try:
        value = Decimal(text.strip()) * 1_000_000_000
        if not value.is_finite() or abs(value) >= 1 << 62:
            raise InvalidOperation
    except InvalidOperation as wrong:
        raise BadInput(f"{where}: '{text.strip()[:40]}' is no time in seconds") from wrong
    return int(value.to_integral_value())


def growing(times_ns: Int64[Array, " n"], where: str) -> Int64[Array, " n"]:
    """The same times. Raises BadInput where one repeats or goes back, and says so when a 32-bit counter wrapped."""
    steps = np.diff(times_ns)
    for i in np.flatnonzero(steps <= 0)[:1]:
        before, after = times_ns[i] / 1e9, times_ns[i + 1] / 1e9
        found = f"{where}: entry {i + 2} ({after:.6f} s) "
        if steps[i] == 0:
            raise BadInput(found + "repeats the time before it; wanted times that grow")
        if -steps[i] > WRAP_32BIT_US_NS // 2:
            raise BadInput(
                found + f"comes after {before:.6f} s: a 32-bit microsecond counter wrapped. "
                f"Add {WRAP_32BIT_US_NS / 1e9:.6f} s to every time from there on"
            )
        raise BadInput(found + f"goes back behind {before:.6f} s; wanted times that grow")
    return times_ns


def clock_offsets_ns(first_and_last_ns: Mapping[int, tuple[int, int]]) -> dict[int, int]:
    """Where toss k's own clock starts on the session clock: k times the spacing, so that tosses never overlap."""
    lead = max(0, -min(first for first, _ in first_and_last_ns.values()))
    longest = max(last for _, last in first_and_last_ns.values()) + lead
    spacing = TOSS_SPACING_NS * (longest // (TOSS_SPACING_NS - 5_000_000_000) + 1)
    lead = -(-lead // 1_000_000_000) * 1_000_000_000
    return {toss: toss * spacing + lead for toss in first_and_last_ns}


def new_start(out: Path, layout: str, source: Path, clock: str, *, assumed: bool = True, **more: Any) -> dict[str, Any]:
    """The start document of an imported session. `clock` says where its times come from; `assumed`: they are made up
    in part, so that nobody takes them for measured."""
    return {
        "name": out.resolve().name,
        "who": f"toss-session import {layout}",
        "clock": {"source": f"import {layout}", "assumed" if assumed else "stamps": clock},
        "import": {"layout": layout, "source": source.resolve().name},
        **more,
    }
