"""Stage `carry`: the track of a toss alone in the object frame of all tosses, as stiff as it was.

Registration bends a toss's poses until its views agree with those of others; where it is wrong by some degrees, that
bends right poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.run import Run
from processing.stages.place import placement
from processing.store import Done
from recordings.geometry import skew
from recordings.results.folder import read_track, write_track
from recordings.tracks import ObjectTrack

VERSION = 1


@dataclass(frozen=True)
class CarryResult:
    """Frames that tell where the toss's own object frame lies in that of all; with none there is no track."""

    toss: int
    frames: int


def carry(run: Run, toss: int, together: Done, alone: Done) -> Done[CarryResult]:
    """The poses of `alone`, moved by the one motion that lays them onto those of `together`."""
    inputs = {"together": together.key, "alone": alone.key, "toss": str(toss)}

    def compute(folder: Path) -> CarryResult:
        own, shared = read_track(alone.folder, toss), read_track(together.folder, toss)
        own_from_shared, found = placement(own, shared)
        if found.frames:
            write_track(folder, carried(own, own_from_shared, shared.object_frame))
        return CarryResult(toss, found.frames)

    return run.store.run("carry", VERSION, {}, inputs, CarryResult, compute)


def carried(track: ObjectTrack, own_from_shared: Float[Array, "4 4"], frame: str) -> ObjectTrack:
    """A track of the same motion in another object frame; covariances are those of that frame's origin."""
    poses, covariance = track.camera_from_object @ own_from_shared, track.covariance.copy()
    for i in np.flatnonzero(~track.lost):
        to = np.eye(6)
        to[3:, :3] = -skew(track.camera_from_object[i, :3, :3] @ own_from_shared[:3, 3])
        covariance[i] = to @ covariance[i] @ to.T
    return replace(track, object_frame=frame, camera_from_object=poses, covariance=covariance)
