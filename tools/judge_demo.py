"""Judges the demo by figures that it must reach: `python tools/judge_demo.py RESULTS`; exit code 1 where one is missed.

The figures belong to the shipped sample, whose truth is known: a change that makes them worse is a fault, not a taste.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROW = ("ours", "all")


@dataclass(frozen=True)
class Figure:
    """A value of table.json and the range that it must lie in; `least` and `most` in its own unit."""

    name: str
    least: float
    most: float


FIGURES = (
    Figure("add_auc", 99.0, 100.0),  # %
    Figure("cd", 0.0, 0.03),  # cm
    Figure("friction_error", -0.05, 0.05),  # learned less true
)


def faults(results: Path) -> Iterator[str]:
    """What these results miss, one sentence each."""
    values = row(results)["values"]
    for figure in FIGURES:
        value = values[figure.name]["value"] if figure.name in values else None
        if value is None or not figure.least <= value <= figure.most:  # NaN is in no range
            yield f"{figure.name}: found {value}, wanted {figure.least:g} to {figure.most:g}"
    yield from contact_faults(results)


def row(results: Path) -> dict[str, Any]:
    """The judged row of table.json. Raises SystemExit where it is not there."""
    rows = json.loads((results / "table.json").read_text())["rows"]
    for found in rows:
        if (found["variant"], found["scope"]) == ROW:
            return dict(found)
    raise SystemExit(f"{results}: no row {' '.join(ROW)}")


def contact_faults(results: Path) -> Iterator[str]:
    """Contact must have been learned, and the shape at the end must come from the one that contact gave."""
    record = json.loads((results / "variants" / f"{'.'.join(ROW)}.json").read_text())
    if record.get("contact") is None:
        yield "contact: none was learned"
        return
    contact, shape = (json.loads((results / record[k] / "stage.json").read_text()) for k in ("contact", "shape"))
    if why := contact["counts"].get("kept_out"):
        yield f"contact: kept out: {why}"
    if contact["key"] not in (shape["key"], shape["inputs"].get("shape")):
        yield "contact: the shape that it gave was kept out"


def main() -> int:
    results = Path(sys.argv[1])
    found = list(faults(results))
    if not found:
        print(f"every figure is reached: {', '.join(f'{f.name} {f.least:g} to {f.most:g}' for f in FIGURES)}")
    for fault in found:
        print(f"fell short: {fault}", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
