"""Stage `register`: P, the poses of all tosses in one object frame, refined together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from processing.backends import matcher_of
from processing.engine.parts import side_by_side
from processing.images import Images
from processing.run import Run, matcher_settings
from processing.store import Done
from processing.track.registration.register import register_tosses
from processing.track.track_file import read_toss_track
from processing.track.track_toss import TossTrack
from recordings.results.folder import write_track
from recordings.tracks import ObjectTrack

VERSION = 12


@dataclass(frozen=True)
class RegisterResult:
    """Tosses that could not be brought into the object frame, and those that may be turned in it; how badly each fits
    the others (None: not joined)."""

    not_joined: tuple[int, ...]
    ambiguous: tuple[int, ...]
    fit: tuple[float | None, ...]


def register(
    run: Run, tracks: Mapping[int, Done], images: Mapping[int, Images], together: bool = False
) -> Done[RegisterResult]:
    """A toss that cannot be brought into the frame is lost in P, frame by frame, and counted. `together`: the tracks
    are in one object frame already, and are only refined."""
    together = together or bool(run.starts)
    inputs = {f"track_{t:02d}": tracks[t].key for t in tracks}

    def compute(folder: Path) -> RegisterResult:
        def opened(toss: int) -> TossTrack:
            seen = images[toss].open()
            return read_toss_track(tracks[toss].folder, toss, seen.frames, seen.masks, run.camera, seen.confidence,
                                   run.config.track, run.world_from_camera)  # fmt: skip

        tosses = list(side_by_side(opened, list(tracks)))
        matcher = matcher_of(run.config.backends, run.device)
        found = register_tosses(
            tosses, run.config.register, run.progress("one object frame"), matcher, together=together
        )
        for track, joined in zip(found.tracks, found.joined, strict=True):
            # a pose in another object frame is no pose in this one
            kept = track if joined else ObjectTrack.nowhere(track.toss, track.camera, track.time_ns)
            write_track(folder, replace(kept, object_frame="object"))
        return RegisterResult(
            tuple(t for t, joined in zip(tracks, found.joined, strict=True) if not joined),
            tuple(t for t, unsure in zip(tracks, found.ambiguous, strict=True) if unsure),
            tuple(round(float(f), 4) if np.isfinite(f) else None for f in found.fit),
        )

    config = {**matcher_settings(run, run.config.register), "together": together}
    return run.store.run("register", VERSION, config, inputs, RegisterResult, compute)
