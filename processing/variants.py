"""The rows of the paper's table as data, and which of their stages exist so far."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from recordings.errors import BadInput

From = Literal["one_toss", "all_tosses"]
TRACKERS = ("multi-hypothesis", "frame-to-model")
"""Names for --tracker, the default first; the second is what users have today, kept as the baseline."""


@dataclass(frozen=True)
class Variant:
    """One row: where its poses and its shape come from, and what is done with them (DESIGN section 6).

    `paper` holds the paper's figures for this row, on its own data: ADD-S, ADD, success rate in percent, Chamfer in cm.
    """

    name: str
    label: str
    poses_from: From
    shape_from: From
    contact: bool = False
    icp: bool = False
    cycle: bool = False
    paper: tuple[float, float, float, float] | None = None


TABLE = (
    Variant("bundlesdf-1", "BundleSDF 1 toss", "one_toss", "one_toss", paper=(65.02, 58.08, 40.17, 34.20)),
    Variant("bundlesdf-10", "BundleSDF 10 tosses", "all_tosses", "all_tosses", paper=(64.89, 32.42, 32.10, 1.75)),
    Variant(
        "no-cycle",
        "ours w/o cyclic pipeline",
        "one_toss",
        "all_tosses",
        contact=True,
        paper=(65.02, 58.08, 40.17, 1.18),
    ),
    Variant(
        "no-contact",
        "ours w/o ContactNets",
        "one_toss",
        "all_tosses",
        icp=True,
        cycle=True,
        paper=(52.60, 48.36, 41.83, 0.96),
    ),
    Variant(
        "no-icp",
        "ours w/o ICP",
        "one_toss",
        "all_tosses",
        contact=True,
        cycle=True,
        paper=(65.43, 60.45, 48.20, 0.74),
    ),
    Variant(
        "ours",
        "ours",
        "one_toss",
        "all_tosses",
        contact=True,
        icp=True,
        cycle=True,
        paper=(69.50, 68.40, 49.86, 0.18),
    ),
)
BEYOND = ("converged", "joint")
"""Variants beyond the paper's table, in scope all."""
CONTACT_ONLY = "contact-only"
"""Contact learning on poses that were recorded or imported, without vision."""
NAMES = (*(v.name for v in TABLE), *BEYOND, CONTACT_ONLY, "table")

EXISTING = frozenset({"first pass on one toss", "first pass on all tosses together"})
"""Stages that the pipeline has so far."""


def needs(variant: Variant) -> tuple[str, ...]:
    """The stages that a row is made of, in order."""
    stages = []
    if "one_toss" in (variant.poses_from, variant.shape_from):
        stages.append("first pass on one toss")
    if "all_tosses" in (variant.poses_from, variant.shape_from):
        stages.append("first pass on all tosses together")
    if variant.contact:
        stages.append("contact learning on the tracked poses")
    if variant.cycle:
        stages.append("reprojection and second pass")
    if variant.icp:
        stages.append("ICP of the reprojected depth")
    return tuple(stages)


def available() -> tuple[str, ...]:
    """Names of the rows whose stages all exist."""
    return tuple(v.name for v in TABLE if EXISTING.issuperset(needs(v)))


def default_name() -> str:
    """`ours` as soon as it exists, until then the best row that does."""
    return available()[-1]


def find_variant(name: str) -> Variant:
    """The row of that name. Raises BadInput where it is unknown or its stages are not there yet."""
    usable = ", ".join(available())
    for variant in TABLE:
        if variant.name == name:
            missing = [stage for stage in needs(variant) if stage not in EXISTING]
            if missing:
                raise BadInput(f"variant {name} needs {' and '.join(missing)}: not there yet; available: {usable}")
            return variant
    if name == "table":
        raise BadInput(f"--variant table needs all rows of the table: not there yet; available: {usable}")
    if name in BEYOND:
        raise BadInput(f"variant {name} needs the cycle of the full pipeline: not there yet; available: {usable}")
    raise BadInput(f"there is no variant '{name}'; available: {usable}")
