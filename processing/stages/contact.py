"""The contact stage (the paper's step 3): friction, support geometry and a corrected mesh from the tracks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from processing.stages.vision import CAMERA
from processing.store import Counts, Done
from recordings.errors import BadInput
from recordings.results.folder import read_shape, read_track, write_contact, write_shape
from recordings.session_writer import write_json
from recordings.tracks import ObjectShape

if TYPE_CHECKING:
    from processing.pipeline import Run


def contact_stage(run: Run, name: str, tracks: Mapping[int, Done], shape: Done) -> Done:
    """Stage `contact`: learned from these tosses with the shape as prior.

    Where nothing can be learned (no plane known, no contact, lost tracks) the stage says why in `kept_out`, and its
    shape is the prior: vision's result does not need contact.
    """
    inputs = {"shape": shape.key, **{f"track_{t:02d}": d.key for t, d in tracks.items()}}
    inputs |= {"calibration": run.keys["calibration"], "object": run.keys["physics"]}

    def compute(folder: Path) -> Counts:
        prior = read_shape(shape.folder)
        try:
            return _learn(run, name, tracks, folder, prior)
        except BadInput as why:
            write_shape(folder, prior)
            return {"kept_out": str(why)}

    return run.store.run("contact", 2, run.config.contact, inputs, compute)


def _learn(run: Run, name: str, tracks: Mapping[int, Done], folder: Path, prior: ObjectShape) -> Counts:
    from processing.contact.learn.from_tracks import learn_from_tracks
    from processing.contact.physics.inertia import physics_of_session
    from processing.contact.report.assets import write_assets
    from processing.contact.stage import session_plane, write_rollouts

    world_from_camera = run.session.calibration.find("world", CAMERA)
    if world_from_camera is None:
        raise BadInput(NO_PLANE)
    plane = session_plane(run.session)
    learned = learn_from_tracks(
        {t: read_track(d.folder, t) for t, d in tracks.items()},
        prior,
        world_from_camera,
        plane,
        physics_of_session(run.session.start),
        run.config.contact,
        run.progress(f"{name}: contact"),
    )
    write_shape(folder, learned.shape)
    write_contact(folder, learned.model)
    write_assets(folder, learned.model, learned.shape)
    write_rollouts(folder, learned.fused, learned.rollouts, plane)
    write_json(folder / "result.json", learned.document)
    return {
        "friction": learned.model.friction,
        "geometry": learned.choice.name,
        "geometry_because": learned.choice.reason,
        "left_out": {str(t): why for t, why in learned.left_out.items()},
        "most_moved_m": float(learned.moved_m.max()),
    }


def rollout_stage(run: Run, name: str, tracks: Mapping[int, Done], shape: Done) -> Done:
    """Stage `rollout`, the paper's Figure 4: learned on all tosses but the last, all rolled out from their release."""
    inputs = {"shape": shape.key, **{f"track_{t:02d}": d.key for t, d in tracks.items()}}
    inputs |= {"calibration": run.keys["calibration"], "object": run.keys["physics"]}

    def compute(folder: Path) -> Counts:
        from processing.contact.physics.inertia import physics_of_session
        from processing.contact.report.figure4 import learn_figure_4
        from processing.contact.stage import session_plane, write_rollouts

        try:
            figure, found = learn_figure_4(
                {t: read_track(d.folder, t) for t, d in tracks.items()},
                read_shape(shape.folder),
                run.session.calibration.transform("world", CAMERA),
                session_plane(run.session),
                physics_of_session(run.session.start),
                run.config.contact,
                run.progress(f"{name}: rollouts"),
            )
        except BadInput as why:
            return {"kept_out": str(why)}
        write_contact(folder, found.model)
        write_rollouts(folder, found.fused, figure.estimated, figure.plane)
        write_json(folder / "rollout.json", figure.to_json())
        return {"tosses": len(figure.estimated.errors.tosses)}

    return run.store.run("rollout", 2, run.config.contact, inputs, compute)


NO_PLANE = (
    "the calibration does not say where the table is (no `world`), and contact needs the plane; run `toss-calibrate "
    "table SESSION`, or let it be estimated from depth: --table-from-depth"
)
