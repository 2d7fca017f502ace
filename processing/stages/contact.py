"""Stage `contact` (the paper's step 3): friction, support geometry and a corrected mesh from the tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from processing.run import Run
from processing.store import Done
from recordings.errors import BadInput
from recordings.results.folder import read_shape, read_track, write_contact, write_shape
from recordings.tracks import ObjectShape
from recordings.whole_file import write_json

VERSION = 10
NO_PLANE = (
    "the calibration does not say where the table is (no `world`), and contact needs the plane; run `toss-calibrate "
    "table SESSION`, or let it be estimated from depth: --table-from-depth"
)


@dataclass(frozen=True)
class ContactResult:
    """Friction, which class of geometry was taken and why, tosses that were left out and why, the furthest that a
    vertex moved (m); or why nothing was learned."""

    friction: float | None = None
    geometry: str = ""
    geometry_because: str = ""
    left_out: Mapping[str, str] = field(default_factory=dict)
    most_moved_m: float = 0.0
    kept_out: str | None = None


def learn_contact(run: Run, name: str, tracks: Mapping[int, Done], shape: Done) -> Done[ContactResult]:
    """Learned from these tosses with the shape as prior.

    Where nothing can be learned (no plane known, no contact, lost tracks) the result says why, and the stage's shape is
    the prior: vision's result does not need contact.
    """
    inputs = {"shape": shape.key, **{f"track_{t:02d}": d.key for t, d in tracks.items()}}
    inputs |= {"calibration": run.keys["calibration"], "object": run.keys["physics"]}

    def compute(folder: Path) -> ContactResult:
        prior = read_shape(shape.folder)
        try:
            return _learn(run, name, tracks, folder, prior)
        except BadInput as why:
            write_shape(folder, prior)
            return ContactResult(kept_out=str(why))

    return run.store.run("contact", VERSION, run.config.contact, inputs, ContactResult, compute)


def _learn(run: Run, name: str, tracks: Mapping[int, Done], folder: Path, prior: ObjectShape) -> ContactResult:
    from processing.contact.learn.from_tracks import learn_from_tracks
    from processing.contact.physics.inertia import physics_of_session
    from processing.contact.physics.plane import calibrated_plane
    from processing.contact.report.assets import write_assets
    from processing.contact.report.rollouts_file import write_rollouts

    if run.world_from_camera is None:
        raise BadInput(NO_PLANE)
    learned = learn_from_tracks(
        {t: read_track(d.folder, t) for t, d in tracks.items()},
        prior,
        run.world_from_camera,
        calibrated_plane(run.session.calibration),
        physics_of_session(run.session.start),
        run.config.contact,
        run.progress(f"{name}: contact"),
    )
    write_shape(folder, learned.shape)
    write_contact(folder, learned.model)
    write_assets(folder, learned.model, learned.shape)
    write_rollouts(folder, learned.fused, learned.rollouts, learned.plane)
    write_json(folder / "result.json", learned.document)
    return ContactResult(
        friction=learned.model.friction,
        geometry=learned.choice.name,
        geometry_because=learned.choice.reason,
        left_out={str(t): why for t, why in learned.left_out.items()},
        most_moved_m=float(learned.moved_m.max()),
    )
