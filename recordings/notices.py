"""What a user must know before he uses a result: one record for all stages, stored as JSON, printed by one function."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

Weight = Literal["high", "medium", "low"]
"""`high`: a part of the result is missing, or wrong; `medium`: it is less sure than it looks; `low`: good to know."""
Sure = Literal["certain", "likely", "possible"]


@dataclass(frozen=True)
class Notice:
    """One thing that a stage noticed: what was seen, how sure that is, and what to do about it ("" for nothing)."""

    stage: str
    weight: Weight
    seen: str
    do: str = ""
    sure: Sure = "certain"

    @property
    def text(self) -> str:
        """The notice as a user reads it."""
        sure = "" if self.sure == "certain" else f" ({self.sure})"
        return f"{self.seen}{sure}" + (f"; {self.do}" if self.do else "")

    def to_json(self) -> dict[str, str]:
        return asdict(self)

    @staticmethod
    def from_json(stored: str | Mapping[str, Any]) -> Notice:
        """What `to_json` gave; results of earlier versions hold a sentence instead."""
        return Notice("", "medium", stored) if isinstance(stored, str) else Notice(**stored)


def in_order(notices: Iterable[Notice]) -> tuple[Notice, ...]:
    """By weight, each once."""
    return tuple(sorted(dict.fromkeys(notices), key=lambda n: get_args(Weight).index(n.weight)))


def said_of(whose: Iterable[tuple[str, Notice]], every: str, everyone: int) -> list[str]:
    """Lines to print, by weight: each notice once, after the names it is said of; `every` in the place of `everyone`
    names, where there are several."""
    names: dict[Notice, list[str]] = {}
    for name, notice in whose:
        if name not in names.setdefault(notice, []):
            names[notice].append(name)
    return [f"{every if len(names[n]) == everyone > 1 else ', '.join(names[n])}: {n.text}" for n in in_order(names)]
