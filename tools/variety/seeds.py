"""The two splits of sessions, fixed once and for all, and the ledger of cases that moved from one to the other.

A session's seed is a hash of its split, its number and how often its place was filled anew. `choose`: settings may be
chosen on it. `judge`: looked at only at the end of an issue; a failing judge case that was looked into becomes a
`choose` case, and its place in `judge` is filled by a fresh one.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from recordings.errors import BadInput

Split = Literal["choose", "judge"]
SPLITS: tuple[Split, ...] = ("choose", "judge")
LEDGER = Path(__file__).with_name("ledger.json")


@dataclass(frozen=True)
class Case:
    """One session to be. `name` is unique over both splits and all times; `number` fixes its family of objects."""

    split: Split
    number: int
    filled: int
    """How often the place was filled anew before (judge only)."""

    @property
    def name(self) -> str:
        return f"{self.split}-{self.number:03d}" + (f"-{self.filled}" if self.filled else "")

    @property
    def seed(self) -> int:
        told = f"tosslab variety {self.split} {self.number} {self.filled}"
        return int.from_bytes(hashlib.sha256(told.encode()).digest()[:8], "big")


@dataclass(frozen=True)
class Move:
    """A judge case that was looked into, and why."""

    number: int
    filled: int
    date: str
    why: str


def read_ledger(path: Path = LEDGER) -> tuple[Move, ...]:
    """All moves so far, in order. Raises BadInput where the file is none."""
    try:
        stored = json.loads(path.read_text())["moves"]
        return tuple(Move(int(m["number"]), int(m["filled"]), str(m["date"]), str(m["why"])) for m in stored)
    except (OSError, ValueError, KeyError, TypeError) as wrong:
        raise BadInput(f"{path}: cannot be read as the ledger of moves ({wrong}); restore it from git") from wrong


def cases(split: Split, count: int, moves: Sequence[Move]) -> tuple[Case, ...]:
    """The first `count` cases of a split; those that moved stand behind the others of `choose`, and add to them."""
    if split == "judge":
        return tuple(Case("judge", k, sum(m.number == k for m in moves)) for k in range(count))
    own = tuple(Case("choose", k, 0) for k in range(count))
    return own + tuple(Case("judge", m.number, m.filled) for m in moves)


def move(name: str, date: str, why: str, path: Path = LEDGER) -> Case:
    """Record that a judge case was looked into; returns the fresh case in its place. Raises BadInput."""
    moves = read_ledger(path)
    number = int(name[6:9]) if name.startswith("judge-") and name[6:9].isdigit() else -1
    here = Case("judge", number, sum(m.number == number for m in moves))
    if number < 0 or here.name != name:
        raise BadInput(f"{name} is no case of the judge split now; wanted for example judge-007 (see {path.name})")
    if not why.strip():
        raise BadInput(f"{name}: wanted the reason of the move: --why TEXT")
    told = [asdict(m) for m in (*moves, Move(number, here.filled, date, why))]
    path.write_text(json.dumps({"moves": told}, indent=1) + "\n")
    return Case("judge", number, here.filled + 1)
