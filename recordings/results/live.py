"""What a session's results are so far, while it is recorded: `toss-process --follow` writes it, the console and the
viewer read it. Nothing recorded depends on it.

```
<session>/results/live/lines.jsonl     one JSON object a line, appended: {"toss", "kind", "text", "unix_s"}
<session>/results/live/state.json      a State, replaced whole
<session>/results/live/toss_XX.json    a TossSoFar
<session>/results/live/shape.ply|json  the shape so far, in the object frame of the first toss
```
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from recordings.bounded.documents import read_json, tuples
from recordings.errors import BadInput, TosslabError
from recordings.whole_file import write_json

FOLDER = "live"
Kind = Literal["ready", "verdict", "next", "learned", "behind", "fault", "left out", "done"]
STATES = ("starting", "waiting", "working", "finishing", "done", "stopped")
MOST_LINE_BYTES = 1 << 16


@dataclass(frozen=True)
class Line:
    """A line for the operator's console. `toss` None: about the session."""

    toss: int | None
    kind: str
    text: str
    unix_s: float


@dataclass(frozen=True)
class State:
    """What the follower does: one of STATES, with the toss it works on; how many finished tosses wait for it, and by
    how many seconds it is behind the oldest of them."""

    state: str
    pid: int
    toss: int | None = None
    waiting: int = 0
    behind_s: float = 0.0
    unix_s: float = field(default_factory=time.time)


@dataclass(frozen=True)
class TossSoFar:
    """One toss as it is known while the session goes on.

    `verdict`: what is wrong with it, nothing where it is good; `seen`: frames with a mask; `phases`: first frames of
    flight, impact, rest (None: not found); `cost`: how badly it fits the others (None: it is the first, or has no
    place);
    `camera_from_object` (frames x 4 x 4, None where lost) in the object frame that the tosses share, where it is
    `placed`; `seconds`: from the finished file to this.
    """

    toss: int
    frames: int
    seen: int
    tracked: int
    interpolated: int
    lost: int
    verdict: tuple[str, ...]
    placed: bool
    ambiguous: bool
    cost: float | None
    phases: tuple[int | None, int | None, int | None]
    seconds: float
    status: tuple[str, ...] = ()
    time_ns: tuple[int, ...] = ()
    camera_from_object: tuple[Any, ...] = ()

    @property
    def good(self) -> bool:
        """Whether nothing was found wrong with it."""
        return not self.verdict

    def text(self) -> str:
        """For the console."""
        what = "good" if self.good else "; ".join(self.verdict)
        flagged = f", {self.interpolated} flagged" if self.interpolated else ""
        lost = f", {self.lost} lost" if self.lost else ""
        return f"toss {self.toss}: {what} ({self.tracked} of {self.frames} frames tracked{flagged}{lost})"


def live_folder(session: Path) -> Path:
    """Where a session's results so far are."""
    return session / "results" / FOLDER


class LiveWriter:
    """Writes the results so far; every file whole or not at all, lines appended whole."""

    def __init__(self, session: Path) -> None:
        self.folder = live_folder(session)
        self.folder.mkdir(parents=True, exist_ok=True)

    def say(self, kind: Kind, text: str, toss: int | None = None) -> Line:
        """Append a line for the console."""
        line = Line(toss, kind, text, time.time())
        with open(self.folder / "lines.jsonl", "ab", buffering=0) as out:
            out.write(json.dumps(asdict(line)).encode() + b"\n")
        return line

    def state(self, state: State) -> None:
        """Replace the state."""
        write_json(self.folder / "state.json", asdict(state))

    def toss(self, toss: TossSoFar) -> None:
        """What is known of a toss."""
        write_json(self.folder / f"toss_{toss.toss:02d}.json", asdict(toss))

    def without(self, toss: int) -> None:
        """A toss that was taken away."""
        (self.folder / f"toss_{toss:02d}.json").unlink(missing_ok=True)


class LineReader:
    """Lines that were appended since the last call. Never raises: what is no line is passed over."""

    def __init__(self, session: Path, from_end: bool = False) -> None:
        self._path = live_folder(session) / "lines.jsonl"
        self._at = self._size() if from_end else 0

    def new(self) -> list[Line]:
        """In the order in which they were said."""
        if self._size() <= self._at:
            return []
        try:
            with open(self._path, "rb") as file:
                file.seek(self._at)
                data = file.read(MOST_LINE_BYTES * 64)
        except OSError:
            return []
        whole = data[: data.rfind(b"\n") + 1]
        self._at += len(whole)
        return [line for text in whole.splitlines() if (line := _line(text)) is not None]

    def _size(self) -> int:
        try:
            return self._path.stat().st_size
        except OSError:
            return 0


def _line(text: bytes) -> Line | None:
    try:
        found = json.loads(text[:MOST_LINE_BYTES])
        toss = found["toss"]
        return Line(None if toss is None else int(toss), str(found["kind"]), str(found["text"]), float(found["unix_s"]))
    except (ValueError, KeyError, TypeError, RecursionError):
        return None


def read_state(session: Path) -> State | None:
    """What the follower does; None where there is none, or its file is being replaced or damaged."""
    document = _document(live_folder(session) / "state.json")
    try:
        return None if document is None else State(**document)
    except TypeError:
        return None


def read_tosses(session: Path) -> list[TossSoFar]:
    """The tosses that are known so far, by number; damaged files are left out."""
    found = []
    for path in sorted(live_folder(session).glob("toss_*.json")):
        document = _document(path)
        try:
            if document is not None:
                found.append(TossSoFar(**{k: tuples(v) for k, v in document.items()}))
        except TypeError:
            continue
    return sorted(found, key=lambda t: t.toss)


def newest_lines(session: Path, kinds: Sequence[str]) -> dict[str, Line]:
    """The last line of each kind."""
    return {line.kind: line for line in LineReader(session).new() if line.kind in kinds}


def require_live(session: Path) -> Path:
    """The live folder of a session. Raises BadInput where nothing follows it, or ever did."""
    folder = live_folder(session)
    if not session.is_dir():
        raise BadInput(f"{session} is no session folder; wanted one that is recorded now: toss-record --live {session}")
    if not folder.is_dir():
        raise BadInput(
            f"nothing follows {session}: it has no {folder.relative_to(session)}; record it with `toss-record --live "
            f"{session}`, or run `toss-process --follow {session}`"
        )
    return folder


def _document(path: Path) -> dict[str, Any] | None:
    try:
        found = read_json(path, "")
    except (TosslabError, OSError):
        return None
    return dict(found) if isinstance(found, dict) else None
