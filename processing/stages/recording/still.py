"""Stage `still`: which frames of a toss are worked on."""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processing.run import Run, each
from processing.sensor.still import Kept, ThinnedSession, kept_of, still_stretches
from recordings.results.stage_files import stage_document

VERSION = 2


@dataclass(frozen=True)
class StillResult:
    """Frames of the toss, those that are worked on, and the stretches (first, last) in which nothing moves."""

    frames: int
    kept: int
    stretches: tuple[tuple[int, int], ...]


def without_waiting(run: Run) -> Run:
    """The run with few frames of every still stretch; the very same run where there is none."""
    kept = {t: k for t, k in each(run, run.tosses, lambda t: _kept(run, t)).items() if k is not None}
    if not kept:
        return run
    keys = {f"toss_{t:02d}": hashlib.sha256((run.keys[f"toss_{t:02d}"] + k.digest).encode()).hexdigest()
            for t, k in kept.items()}  # fmt: skip
    return replace(run, session=ThinnedSession(run.session, kept), keys={**run.keys, **keys}, kept=kept)


def _kept(run: Run, toss: int) -> Kept | None:
    """Stage `still` of one toss; None where all its frames are worked on."""
    frames, settings, name = run.session.toss(toss).rgbd(run.camera.frame), run.config.still, f"toss_{toss:02d}"
    if len(frames) < settings.least:
        return None

    def compute(folder: Path) -> StillResult:
        found = still_stretches(frames, settings, run.progress(f"toss {toss}: what moves"))
        kept = kept_of(found, len(frames), settings)
        document = {"positions": kept.positions.tolist(), "like": kept.like.tolist()}
        (folder / "still.json").write_text(json.dumps(document) + "\n")
        return StillResult(len(frames), len(kept.positions), tuple(found))

    done = run.store.run("still", VERSION, settings, {name: run.keys[name]}, StillResult, compute)
    if done.result.kept == done.result.frames:
        return None
    stored = stage_document(done.folder / "still.json")
    return Kept(*(np.array(stored[k], dtype=np.int64) for k in ("positions", "like")))
