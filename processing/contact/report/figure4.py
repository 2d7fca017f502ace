"""The paper's Figure 4: learn on all tosses but the last, roll out all of them from their release, show error in time.

Errors here are against the estimated tracks; the scorer compares the same rollouts with the truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from processing.contact.learn.from_tracks import TrackLearning, TracksConfig, learn_from_tracks
from processing.contact.learn.learn import ContactLearning
from processing.contact.learn.shape_comparison import series_of, usable
from processing.contact.physics.inertia import Physics
from processing.contact.physics.plane import Plane
from processing.contact.report.rollout_errors import FIGURE_4_STEPS, Evaluation, evaluate
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.progress import Progress
from recordings.tracks import ObjectShape, ObjectTrack
from recordings.whole_file import without_nan

STEP_S = 1 / 148


@dataclass(frozen=True, eq=False)
class Figure4:
    """Rollouts of every toss from its release with a model that did not learn from `not_learned`.

    `estimated`: errors against the tracks; those against the truth are the scorer's (processing/evaluate/score.py).
    """

    learning: ContactLearning
    estimated: Evaluation
    not_learned: tuple[int, ...]
    plane: Plane

    def to_json(self) -> dict[str, Any]:
        """The document; steps that no toss reaches are None."""
        return {
            "steps": FIGURE_4_STEPS,
            "dt_s": self.estimated.errors.step_s,
            "learned_from": list(self.learning.tosses),
            "not_learned_from": list(self.not_learned),
            "friction": self.learning.friction.to_json(),
            "against_track": _part(self.estimated, self.not_learned),
        }


def learn_figure_4(
    tracks: Mapping[int, ObjectTrack],
    shape: ObjectShape,
    world_from_camera: Transform,
    plane: Plane | None = None,
    physics: Physics | None = None,
    config: TracksConfig | None = None,
    progress: Progress | None = None,
) -> tuple[Figure4, TrackLearning]:
    """Learn on the estimated tracks of all tosses but the last, and roll all of them out.

    Raises BadInput for fewer than two usable tosses.
    """
    config = config or TracksConfig()
    left_out = usable(list(tracks.values()), config.least_tracked)
    there = [t for t in sorted(tracks) if t not in left_out]
    if len(there) < 2:
        raise BadInput(f"Figure 4 learns on all tosses but the last; {len(there)} can be used, wanted at least 2")
    learned = {t: tracks[t] for t in there[:-1]}
    found = learn_from_tracks(learned, shape, world_from_camera, plane, physics, config, progress)
    return figure_4(found.fused, {t: tracks[t] for t in there}, world_from_camera, found.plane), found


def figure_4(
    learning: ContactLearning,
    tracks: Mapping[int, ObjectTrack],
    world_from_camera: Transform,
    plane: Plane | None = None,
) -> Figure4:
    """Roll out all tosses with what was learned on some of them; the tracks are resampled to the step."""
    plane = plane or Plane()
    done = evaluate(learning, series_of(tracks, world_from_camera), plane, FIGURE_4_STEPS, STEP_S, "release")
    return Figure4(learning, done, tuple(t for t in done.errors.tosses if t not in learning.tosses), plane)


def _part(done: Evaluation, not_learned: Sequence[int]) -> dict[str, Any]:
    document = done.to_json()
    per_toss = dict(zip(done.errors.tosses, zip(done.position.per_toss, done.rotation.per_toss)))
    document["not_learned"] = {
        str(t): {"position_m": float(per_toss[t][0]), "rotation_rad": float(per_toss[t][1])}
        for t in not_learned
        if t in per_toss
    }
    finite: dict[str, Any] = without_nan(document)
    return finite
