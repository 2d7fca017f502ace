"""Tosses in which the object is not seen: lost frame by frame, counted and said, while the others go on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from processing.stage_notices import SEE
from processing.stages.cycle import Pass
from processing.store import Counts, Done
from recordings.errors import BadInput
from recordings.notices import Notice
from recordings.results.folder import write_track
from recordings.tracks import ObjectTrack

if TYPE_CHECKING:
    from processing.pipeline import Run


def without_lost(run: Run, masks: Mapping[int, Done]) -> Run:
    """The run with those tosses only that show the object; the others are remembered as lost.

    Raises BadInput where no toss is left.
    """
    run = replace(run, warnings=(*run.warnings, *_elsewhere(run, masks)))
    why = {t: reason for t in run.tosses if (reason := _why_lost(masks[t].counts)) is not None}
    if not why:
        return run
    if len(why) == len(run.tosses):
        told = "; ".join(f"toss {t}: {reason}" for t, reason in why.items())
        raise BadInput(f"{run.session.path}: no toss can be tracked ({told}). Look at the masks with `toss-view`")
    warnings = tuple(
        Notice("masks", "high", f"toss {t}: {reason}: lost, and left out of everything else", SEE)
        for t, reason in why.items()
    )
    kept = tuple(t for t in run.tosses if t not in why)
    return replace(run, tosses=kept, lost=tuple(why), warnings=(*run.warnings, *warnings))


def _elsewhere(run: Run, masks: Mapping[int, Done]) -> list[Notice]:
    """Frames that were left out because the object jumps between them and the toss."""
    spans = {t: masks[t].counts.get("elsewhere", []) for t in run.tosses}
    return [
        Notice(
            "masks",
            "medium",
            f"toss {t}: in frames {first}-{last} the object is at a place from which no motion leads into the toss "
            "(recorded before it began, or after it): left out",
        )
        for t, found in spans.items()
        for first, last in found
    ]


def _why_lost(counts: Counts) -> str | None:
    if counts.get("not_found"):
        return "the object was not found in it and no mask was given (nothing moves there as a tossed object does)"
    return None if counts.get("with_depth", 1) else "the object's masks hold no depth"


def with_lost(run: Run, last: Pass, masks: Mapping[int, Done]) -> Pass:
    """A pass with the lost tosses in it: all their frames are lost, their shape is that of the first toss."""
    if not run.lost:
        return last
    shape = next(iter(last.shapes.values()))
    return replace(last, tracks={**last.tracks, **{t: _lost_stage(run, t, masks[t]) for t in run.lost}},
                   shapes={**last.shapes, **dict.fromkeys(run.lost, shape)},
                   masks={**last.masks, **{t: masks[t] for t in run.lost}})  # fmt: skip


def _lost_stage(run: Run, toss: int, masks: Done) -> Done:
    """Stage `track` of a toss without the object."""

    def compute(folder: Path) -> Counts:
        times_ns = run.session.toss(toss).rgbd(run.camera.frame).times_ns
        write_track(folder, ObjectTrack.nowhere(toss, run.camera.frame, times_ns))
        return {"frames": len(times_ns), "interpolated": 0, "lost": len(times_ns)}

    return run.store.run(
        "track", 1, {"lost": True}, {"masks": masks.key, f"toss_{toss:02d}": run.keys[f"toss_{toss:02d}"]}, compute
    )
