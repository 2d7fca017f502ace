"""What a command of `toss-calibrate` did: its document, its words, whether calibration.json stayed as it was."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calibration.report import Report

TOOL = "panda_hand_tcp"
"""The link that hand-eye calibration refers to."""


@dataclass(frozen=True)
class Done:
    """What a command did. `refused`: calibration.json stayed as it was."""

    document: Mapping[str, Any]
    text: str
    refused: bool


def done(reports: Sequence[Report], written: Path | None, pictures: Sequence[Path], asked: bool) -> Done:
    """`asked`: somebody wanted it written (no --dry-run)."""
    refused = any(r.verdict == "refused" for r in reports)
    if written is not None:
        last = f"written: {written}"
    else:
        last = "refused: calibration.json stays as it was" if refused and asked else "nothing was written"
    document = {
        "calibrations": [{"kind": r.kind, **r.to_json()} for r in reports],
        "verdict": "refused" if refused else "doubtful" if any(r.verdict != "good" for r in reports) else "good",
        "written": None if written is None else str(written),
        "pictures": [str(p) for p in pictures],
    }
    lines = [r.text() for r in reports] + [f"picture: {p}" for p in pictures] + [last]
    return Done(document, "\n".join(lines), refused)
