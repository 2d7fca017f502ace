"""The rows of the paper's table as data, and those beyond it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from recordings.errors import BadInput

if TYPE_CHECKING:
    from recordings.results.folder import Scope

First = Literal["one_toss", "all_tosses"]
Refined = Literal["contact", "cycle", "converged", "joint"]
TRACKERS = ("multi-hypothesis", "frame-to-model")
"""Names for --tracker, the default first; the second is what users have today, kept as the baseline."""


@dataclass(frozen=True)
class Variant:
    """One row: where its poses and its shape come from, and what is done with them.

    `first`: whether the first pass's shape is of one toss or of all together. `refined`: nothing more, contact
    learning alone, one pass of the cycle, passes until nothing changes, or all in one objective. `paper` holds the
    paper's figures for this row, on its own data: ADD-S, ADD, success rate in percent, Chamfer in cm.
    """

    name: str
    label: str
    first: First
    refined: Refined | None = None
    contact: bool = False
    icp: bool = False
    paper: tuple[float, float, float, float] | None = None


TABLE = (
    Variant("bundlesdf-1", "BundleSDF 1 toss", "one_toss", paper=(65.02, 58.08, 40.17, 34.20)),
    Variant("bundlesdf-10", "BundleSDF 10 tosses", "all_tosses", paper=(64.89, 32.42, 32.10, 1.75)),
    Variant("no-cycle", "ours w/o cyclic pipeline", "all_tosses", "contact", True, False, (65.02, 58.08, 40.17, 1.18)),
    Variant("no-contact", "ours w/o ContactNets", "all_tosses", "cycle", False, True, (52.60, 48.36, 41.83, 0.96)),
    Variant("no-icp", "ours w/o ICP", "all_tosses", "cycle", True, False, (65.43, 60.45, 48.20, 0.74)),
    Variant("ours", "ours", "all_tosses", "cycle", True, True, (69.50, 68.40, 49.86, 0.18)),
)
BEYOND = (
    Variant("converged", "ours, passes until converged", "all_tosses", "converged", True, True),
    Variant("joint", "ours, one joint objective", "all_tosses", "joint", True, True),
)
"""Variants beyond the paper's table, in scope all."""
WITH_MODEL = Variant("with-model", "tracked with a shape learned before", "all_tosses")
"""What `--model` makes; it is not asked for by its name."""
ROWS = (*TABLE, *BEYOND)
CONTACT_ONLY = "contact-only"
"""Contact learning on poses that were recorded or imported, without vision."""
WHOLE_TABLE = "table"
SCOPES: tuple[Scope, ...] = ("one", "all")
DEFAULT = "ours"
NAMES = (*(v.name for v in ROWS), CONTACT_ONLY, WHOLE_TABLE)


def find_variant(name: str) -> Variant:
    """The row of that name. Raises BadInput where there is none."""
    for variant in ROWS:
        if variant.name == name:
            return variant
    raise BadInput(f"there is no variant '{name}'; available: {', '.join(NAMES)}")


def refuse_baseline(tracker: str) -> None:
    """Raises BadInput for the baseline, where a row needs all tosses in one object frame."""
    if tracker != TRACKERS[0]:
        raise BadInput(
            f"--tracker {tracker} has no registration between tosses, so bundlesdf-1 is its only row; "
            f"take --tracker {TRACKERS[0]}, or --variant bundlesdf-1"
        )


def rows_of(name: str, scope: Scope) -> list[tuple[Variant, Scope]]:
    """The rows to make for a name: one, or with `table` all of them in both scopes. Raises BadInput."""
    if name == WHOLE_TABLE:
        paper: list[tuple[Variant, Scope]] = [(v, s) for s in SCOPES for v in TABLE]
        return [*paper, *((v, "all") for v in BEYOND)]
    variant = find_variant(name)
    if variant in BEYOND and scope == "one":
        raise BadInput(f"variant {name} exists over all tosses only; run it without --scope one")
    return [(variant, scope)]
