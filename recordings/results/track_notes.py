"""How a track came about, beside it in its stage's folder: what a person wants to see when a pose looks wrong.

```
toss_XX.fit.npz     cost, on_surface (n), keyframes (k): written by the default tracker
toss_XX.notes.npz   rejected_frame (r), rejected_pose (r, 4, 4), rejected_cost (r): candidates that were not taken
                    match_frames (m, 2), match_points_m (m, 2, 3), match_agrees (m): feature matches of two frames
```
Both are optional: what is not there is not shown.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from recordings.errors import BadInput, DamagedFile
from recordings.results.folder import Results
from recordings.results.stage_files import read_arrays
from recordings.whole_file import write_bytes

FIT, NOTES = "toss_{:02d}.fit.npz", "toss_{:02d}.notes.npz"


@dataclass(frozen=True, eq=False)
class Rejected:
    """Poses (camera_from_object) that were tried for a frame and not taken, and what each cost."""

    frame: Int[Array, " r"]
    pose: Float[Array, "r 4 4"]
    cost: Float[Array, " r"]

    @staticmethod
    def none() -> Rejected:
        return Rejected(np.zeros(0, dtype=np.int64), np.zeros((0, 4, 4)), np.zeros(0))


@dataclass(frozen=True, eq=False)
class Matches:
    """Feature matches: positions of the two frames, the point in each one's camera frame (m), and whether the final
    poses bring the two points together."""

    frames: Int[Array, "m 2"]
    points_m: Float[Array, "m 2 3"]
    agrees: Bool[Array, " m"]

    @staticmethod
    def none() -> Matches:
        return Matches(np.zeros((0, 2), dtype=np.int64), np.zeros((0, 2, 3)), np.zeros(0, dtype=bool))


@dataclass(frozen=True, eq=False)
class TrackNotes:
    """What is known of how one toss was tracked, by position of the colour frame.

    `residual`: how badly each frame fits those that see the same surface, 0 perfect .. 1 (NaN: not tracked);
    `on_surface`: share of its points on their surface; `keyframes`: the frames that span the object.
    """

    residual: Float[Array, " n"]
    on_surface: Float[Array, " n"]
    keyframes: tuple[int, ...]
    rejected: Rejected = field(default_factory=Rejected.none)
    matches: Matches = field(default_factory=Matches.none)


def write_notes(folder: Path, toss: int, rejected: Rejected, matches: Matches) -> Path:
    """Write `toss_XX.notes.npz`. The same notes give the same bytes."""
    import io

    out = io.BytesIO()
    arrays = {f"rejected_{name}": value for name, value in vars(rejected).items()}
    arrays |= {f"match_{name}": value for name, value in vars(matches).items()}
    np.savez(out, allow_pickle=False, **arrays)
    path = folder / NOTES.format(toss)
    write_bytes(path, out.getvalue())
    return path


def read_notes(folder: Path, toss: int) -> TrackNotes | None:
    """The notes of a toss in a track's folder; None where the tracker kept none. Raises DamagedFile."""
    fit, notes = read_arrays(folder / FIT.format(toss)), read_arrays(folder / NOTES.format(toss))
    if not fit:
        return None
    try:
        rejected = Rejected(*(notes[f"rejected_{n}"] for n in ("frame", "pose", "cost"))) if notes else Rejected.none()
        matches = Matches(*(notes[f"match_{n}"] for n in ("frames", "points_m", "agrees"))) if notes else Matches.none()
        keyframes = tuple(int(i) for i in fit["keyframes"])
        return TrackNotes(fit["cost"], fit["on_surface"], keyframes, rejected, matches)
    except KeyError as wrong:
        raise DamagedFile(f"{folder}: the notes of toss {toss} lack {wrong}; run toss-process again") from wrong


def find_notes(results: Results, stage: str, toss: int) -> TrackNotes | None:
    """Notes of the track in a stage's folder; what is not there (matches, where poses were refined) of the track that
    this stage was made from, which has an object frame of its own: its rejected poses are left out."""
    here, before = read_notes(results.path / stage, toss), _made_from(results, stage, toss)
    found = None if before is None else find_notes(results, before, toss)
    if found is None:
        return here
    if here is None:
        return TrackNotes(found.residual, found.on_surface, found.keyframes, matches=found.matches)
    return here if len(here.matches.frames) else replace(here, matches=found.matches)


def _made_from(results: Results, stage: str, toss: int) -> str | None:
    """The stage folder that holds the track of this toss from which a stage was made."""
    try:
        inputs = results.stage(stage).get("inputs", {})
    except BadInput:
        return None
    key = inputs.get(f"track_{toss:02d}") or inputs.get("before")
    fitting = sorted(results.path.glob(f"*-{str(key)[:8]}")) if key else []
    return fitting[0].name if fitting else None
