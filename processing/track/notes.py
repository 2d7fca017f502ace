"""What a person wants to see of a track that seems wrong: rejected poses, and feature matches with the final poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.features.sift import FeatureMatcher
from processing.motion import se3_kernels as se3
from processing.track.track_toss import TossTrack
from recordings.results.track_notes import Matches, Rejected


@dataclass(frozen=True)
class NotesConfig:
    """How much is kept for the viewer."""

    most_rejected: int = 6
    """Of a frame, the cheapest."""
    most_matches: int = 60
    """Of a frame, the most distinct."""
    agrees_m: float = 0.006
    """Matched points this near under the final poses agree."""


def notes_of(
    tracked: TossTrack, matcher: FeatureMatcher, config: NotesConfig | None = None
) -> tuple[Rejected, Matches]:
    """Rejected poses of every frame, and the matches of those whose features the tracker looked at."""
    config = config or NotesConfig()
    return rejected_poses(tracked, config), matches_with_keyframes(tracked, matcher, config)


def rejected_poses(tracked: TossTrack, config: NotesConfig) -> Rejected:
    """The cheapest of the candidates that were not taken, frame by frame."""
    kept = [
        (i, candidate)
        for i in sorted(tracked.rejected)
        for candidate in sorted(tracked.rejected[i], key=lambda c: c.cost)[: config.most_rejected]
    ]
    if not kept:
        return Rejected.none()
    frame = np.array([i for i, _ in kept], dtype=np.int64)
    return Rejected(frame, np.array([c.pose for _, c in kept]), np.array([c.cost for _, c in kept], dtype=np.float64))


def matches_with_keyframes(tracked: TossTrack, matcher: FeatureMatcher, config: NotesConfig) -> Matches:
    """Matches of every tracked frame with the keyframe before it (the first one: with the next), where the features of
    both are there, and which of them the final poses bring together."""
    poses, known, frames, points = tracked.track.camera_from_object, tracked.features, [], []
    for i in np.flatnonzero(np.isfinite(poses[:, 0, 0])).tolist():
        j = _keyframe_for(i, tracked.keyframes)
        if j is None or not np.isfinite(poses[j]).all() or i not in known or j not in known:
            continue
        one, other = known[i], known[j]
        pairs = matcher.match(one, other)[: config.most_matches]
        frames.append(np.tile([i, j], (len(pairs), 1)))
        points.append(np.stack([one.points_m[pairs[:, 0]], other.points_m[pairs[:, 1]]], 1))
    if not frames:
        return Matches.none()
    both, points_m = np.concatenate(frames), np.concatenate(points)
    return Matches(both, points_m, _gap_m(poses, both, points_m) < config.agrees_m)


def _keyframe_for(i: int, keyframes: tuple[int, ...]) -> int | None:
    before = [j for j in keyframes if j < i]
    after = [j for j in keyframes if j > i]
    return max(before) if before else min(after, default=None)


def _gap_m(
    poses: Float[Array, "n 4 4"], frames: Int[Array, "m 2"], points_m: Float[Array, "m 2 3"]
) -> Float[Array, " m"]:
    """Distance between matched points in the object frame."""
    to_object = {int(i): se3.inverse(poses[i]) for i in np.unique(frames)}
    placed = np.zeros_like(points_m)
    for side in (0, 1):
        turn = np.array([to_object[int(i)] for i in frames[:, side]]).reshape(-1, 4, 4)
        placed[:, side] = np.einsum("mij,mj->mi", turn[:, :3, :3], points_m[:, side]) + turn[:, :3, 3]
    return np.asarray(np.linalg.norm(placed[:, 0] - placed[:, 1], axis=1))
