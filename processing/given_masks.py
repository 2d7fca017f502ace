"""Which of a session's given masks are used: `--masks`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args

GivenMasks = Literal["first", "first-toss", "all", "none"]
DEFAULT_MASKS: GivenMasks = "first"
Mask = TypeVar("Mask")
"""(h, w) bool; numpy is not imported for it, so that `--help` answers at once."""


def add_masks_argument(parser: Any) -> None:
    """`--masks`, for toss-process; its value goes into `Config.given_masks`."""
    parser.add_argument(
        "--masks",
        choices=get_args(GivenMasks),
        default=DEFAULT_MASKS,
        help="given masks to use: each toss's first (default), only the first toss's, all, or none: found by depth",
    )


def chosen_masks(given: Mapping[int, Mask], choice: GivenMasks, first_toss: bool) -> dict[int, Mask]:
    """The given masks of one toss that are used, by position of the frame."""
    if choice == "none" or (choice == "first-toss" and not first_toss):
        return {}
    return dict(given) if choice == "all" else {i: given[i] for i in sorted(given)[:1]}
