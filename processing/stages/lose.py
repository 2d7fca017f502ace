"""Stage `lose`, for a toss in which the object is not seen: every frame is lost, and counted."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from processing.run import CAMERA, Run, toss_keys
from processing.stages.masks.segment import SegmentResult
from processing.stages.track import TrackResult
from processing.store import Done
from recordings.errors import BadInput
from recordings.notices import Notice
from recordings.results.folder import write_track
from recordings.tracks import ObjectTrack

VERSION = 2
SEE = "look at these frames with `toss-view RESULTS`"


def lose(run: Run, toss: int, masks: Done) -> Done[TrackResult]:
    """A track without a pose."""

    def compute(folder: Path) -> TrackResult:
        times_ns = run.session.toss(toss).rgbd(CAMERA).times_ns
        write_track(folder, ObjectTrack.nowhere(toss, CAMERA, times_ns))
        return TrackResult(len(times_ns), 0, len(times_ns))

    inputs = {"masks": masks.key, **toss_keys(run, toss)}
    return run.store.run("lose", VERSION, {}, inputs, TrackResult, compute)


def without_lost(run: Run, masks: Mapping[int, Done[SegmentResult]]) -> Run:
    """The run with those tosses only that show the object; the others are remembered as lost.

    Raises BadInput where no toss is left.
    """
    run = replace(run, warnings=(*run.warnings, *_elsewhere(run, masks)))
    why = {t: reason for t in run.tosses if (reason := _why_lost(masks[t].result)) is not None}
    if not why:
        return run
    if len(why) == len(run.tosses):
        listed = "; ".join(f"toss {t}: {reason}" for t, reason in why.items())
        raise BadInput(f"{run.session.path}: no toss can be tracked ({listed}). Look at the masks with `toss-view`")
    warnings = tuple(
        Notice("masks", "high", f"toss {t}: {reason}: lost, and left out of everything else", SEE)
        for t, reason in why.items()
    )
    kept = tuple(t for t in run.tosses if t not in why)
    return replace(run, tosses=kept, lost=tuple(why), warnings=(*run.warnings, *warnings))


def _elsewhere(run: Run, masks: Mapping[int, Done[SegmentResult]]) -> list[Notice]:
    """Frames that were left out because the object jumps between them and the toss."""
    spans = {t: masks[t].result.elsewhere for t in run.tosses}
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


def _why_lost(result: SegmentResult) -> str | None:
    if result.not_found:
        return "the object was not found in it and no mask was given (nothing moves there as a tossed object does)"
    return None if result.with_depth else "the object's masks hold no depth"
