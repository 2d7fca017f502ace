"""Contact learning on poses that are there already, without vision: which tosses are learned from, and which are rolled
out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from processing.pose_source import DEFAULT_STEPS, find_poses
from processing.stages.contact_only import learn_contact_only
from recordings.console import chosen_tosses
from recordings.errors import BadInput
from recordings.progress import Progress, Silent
from recordings.session import Session

MOST_TOSSES_LEARNED = 64
"""Learning from more is possible (--train), but gains nothing."""


def contact_only(
    session: Session,
    out_dir: Path,
    train: str | None = None,
    test: str | None = None,
    geometry: str | None = None,
    init_m: float | None = None,
    poses: str | None = None,
    steps: int = DEFAULT_STEPS,
    device: str = "cpu",
    progress: Progress | None = None,
    truth: Path | None = None,
) -> tuple[dict[str, Any], str]:
    """Learn from the tosses of `train`, roll out those of `test`, write stage, plot and assets into `out_dir`.

    Returns the JSON document and lines to read. Raises BadInput.
    """
    if steps < 1:
        raise BadInput(f"--steps {steps}: wanted at least 1")
    if init_m is not None and not 0.005 <= init_m <= 1.0:
        raise BadInput(f"--init {init_m}: wanted the side of a cube in metres, 0.005 to 1; for example --init 0.05")
    began = time.perf_counter()
    learned, tested = _split(session.tosses, train, test)
    source = find_poses(session, out_dir, poses, sorted({*learned, *tested}), truth)
    return learn_contact_only(
        session, out_dir, source, learned, tested, geometry, init_m, steps, device, progress or Silent(), began
    )


def _split(there: Sequence[int], train: str | None, test: str | None) -> tuple[list[int], list[int]]:
    """Tosses to learn from and to roll out. Without --train: all but the last (of --test, all that are not in it)."""
    if train is not None:
        learned = chosen_tosses(train, there, "--train")
        tested = (
            chosen_tosses(test, there, "--test")
            if test is not None
            else [t for t in there if t not in learned] or learned
        )
        return learned, tested
    if test is not None:
        tested = chosen_tosses(test, there, "--test")
        learned = [t for t in there if t not in tested]
        if not learned:
            raise BadInput(f"--test {test} takes every toss; wanted some left to learn from, or give --train I-J")
        return learned, tested
    return (list(there[:-1]) or list(there))[:MOST_TOSSES_LEARNED], list(there)
