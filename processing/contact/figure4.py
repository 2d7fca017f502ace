"""The paper's Figure 4: learn on all tosses but the last, roll out all of them from their release, show error in time.

Errors are against the estimated tracks, and by a second call with true poses (from the scorer's door) against truth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.evaluate import FIGURE_4_STEPS, Evaluation, evaluate, summarise
from processing.contact.figure import draw_errors
from processing.contact.from_tracks import TrackLearning, TracksConfig, learn_from_tracks
from processing.contact.inertia import Physics
from processing.contact.judge import series_of, usable
from processing.contact.learn import ContactLearning, Plane
from processing.contact.motion import PoseSeries
from processing.contact.rollout import resampled, rollout_errors
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.progress import Progress
from recordings.tracks import ObjectShape, ObjectTrack

STEP_S = 1 / 148


@dataclass(frozen=True, eq=False)
class Figure4:
    """Rollouts of every toss from its release with a model that did not learn from `not_learned`.

    `estimated`: errors against the tracks. `truth`: the same rollouts against true poses, None until asked for.
    """

    learning: ContactLearning
    estimated: Evaluation
    not_learned: tuple[int, ...]
    plane: Plane
    truth: Evaluation | None = None

    def to_json(self) -> dict[str, Any]:
        """The document; steps that no toss reaches are None."""
        document = {
            "steps": FIGURE_4_STEPS,
            "dt_s": self.estimated.errors.step_s,
            "learned_from": list(self.learning.tosses),
            "not_learned_from": list(self.not_learned),
            "friction": self.learning.friction.to_json(),
            "against_track": _part(self.estimated, self.not_learned),
            "against_truth": None if self.truth is None else _part(self.truth, self.not_learned),
        }
        return document


def learn_figure_4(
    tracks: Mapping[int, ObjectTrack],
    shape: ObjectShape,
    world_from_camera: Transform,
    plane: Plane | None = None,
    physics: Physics | None = None,
    config: TracksConfig | None = None,
    progress: Progress | None = None,
    step_s: float = STEP_S,
) -> tuple[Figure4, TrackLearning]:
    """Learn on the estimated tracks of all tosses but the last (DESIGN section 6), and roll all of them out.

    Raises BadInput for fewer than two usable tosses.
    """
    config = config or TracksConfig()
    left_out = usable(list(tracks.values()), config.least_tracked)
    there = [t for t in sorted(tracks) if t not in left_out]
    if len(there) < 2:
        raise BadInput(f"Figure 4 learns on all tosses but the last; {len(there)} can be used, wanted at least 2")
    learned = {t: tracks[t] for t in there[:-1]}
    found = learn_from_tracks(learned, shape, world_from_camera, plane, physics, config, progress)
    return figure_4(found.fused, {t: tracks[t] for t in there}, world_from_camera, plane, step_s), found


def figure_4(
    learning: ContactLearning,
    tracks: Mapping[int, ObjectTrack],
    world_from_camera: Transform,
    plane: Plane | None = None,
    step_s: float = STEP_S,
) -> Figure4:
    """Roll out all tosses with what was learned on some of them; the tracks are resampled to the step."""
    plane = plane or Plane()
    done = evaluate(learning, series_of(tracks, world_from_camera), plane, FIGURE_4_STEPS, step_s, "release")
    return Figure4(learning, done, tuple(t for t in done.errors.tosses if t not in learning.tosses), plane)


def against_truth(figure: Figure4, true_world_from_object: Mapping[int, PoseSeries]) -> Figure4:
    """The same rollouts compared with true poses. Call it with what the scorer's door gives, never before.

    The truth's object frame is another one: each toss's true poses are moved to the estimate's by the constant
    true_from_estimated at the frame it is rolled out from, so the error starts at zero as against the track.
    Times count from the toss's first frame. Tosses without truth are left out and named.
    """
    done, learning = figure.estimated, figure.learning
    level = figure.plane.level_from_world()
    kept, series, left_out = [], [], dict(done.left_out)
    for i, toss in enumerate(done.errors.tosses):
        true = true_world_from_object.get(toss)
        if true is None or len(true) < 2:
            left_out[toss] = "no true poses"
            continue
        moved = true.turned(level, figure.plane.offset_m)
        series.append(met(moved, done.start_time_s[i], done.start.rotation[i], done.start.position_m[i]))
        kept.append(i)
    if not kept:
        raise BadInput("none of the tosses that were rolled out has true poses")
    rolled = replace(done.rolled, rotation=done.rolled.rotation[kept], position_m=done.rolled.position_m[kept])
    errors = rollout_errors(rolled, series, [0] * len(series), done.errors.step_s)
    truth = replace(
        done,
        errors=errors,
        position=summarise(errors.position_m),
        rotation=summarise(errors.rotation_rad),
        left_out=left_out,
        rolled=rolled,
    )
    return replace(figure, truth=truth, learning=learning)


def met(true: PoseSeries, time_s: float, rotation: Float[Array, "3 3"], position_m: Float[Array, "3"]) -> PoseSeries:
    """True poses from the rollout's first frame on, of the body that is rolled out: moved on the object's side."""
    times = np.concatenate([[time_s], true.time_s[true.time_s > time_s + 1e-6]])
    part = resampled(true, np.minimum(times, true.time_s[-1]))
    part = replace(part, time_s=times)
    true_from_body = part.rotation[0].T @ rotation
    offset = part.rotation[0].T @ (position_m - part.position_m[0])
    return PoseSeries(part.toss, times, part.rotation @ true_from_body, part.position_m + part.rotation @ offset)


def _part(done: Evaluation, not_learned: Sequence[int]) -> dict[str, Any]:
    document = done.to_json()
    per_toss = dict(zip(done.errors.tosses, zip(done.position.per_toss, done.rotation.per_toss)))
    document["not_learned"] = {
        str(t): {"position_m": float(per_toss[t][0]), "rotation_rad": float(per_toss[t][1])}
        for t in not_learned
        if t in per_toss
    }
    finite: dict[str, Any] = _none_for_nan(document)
    return finite


def _none_for_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _none_for_nan(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_none_for_nan(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def draw_figure_4(figure: Figure4, image_format: str = "svg") -> bytes:
    """The picture as SVG (text stays text, for a report) or PNG bytes: position and rotation, one row per reference."""
    import io

    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = [("the estimated track", figure.estimated)]
    if figure.truth is not None:
        rows.append(("ground truth", figure.truth))
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "tosslab"}):
        canvas = Figure(figsize=(10, 0.4 + 3.3 * len(rows)), dpi=110, layout="constrained")
        FigureCanvasAgg(canvas)
        axes = canvas.subplots(len(rows), 2, squeeze=False)
        for (name, done), row in zip(rows, axes):
            draw_errors(row[0], row[1], done, figure.not_learned, f"against {name}")
        out = io.BytesIO()
        canvas.savefig(out, format=image_format, metadata={"Date": None} if image_format == "svg" else None)
    return out.getvalue()
