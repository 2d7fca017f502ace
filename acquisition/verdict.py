"""What is decided about a take, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Decision = Literal["accept", "reject", "redo"]


@dataclass(frozen=True)
class Verdict:
    """`reasons` say why a take is not accepted, `warnings` what is worth knowing of one that is."""

    decision: Decision
    reasons: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def text(self) -> str:
        said = "; ".join(self.reasons or self.warnings)
        return f"{self.decision}{': ' + said if said else ''}"
