"""The contact stage (the paper's step 3): friction, support geometry and a corrected mesh from the tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from scipy.optimize import minimize_scalar

from processing.stage import Counts, Done
from processing.vision import CAMERA
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.results import read_contact, read_shape, read_track, write_contact, write_shape
from recordings.session_writer import write_json
from recordings.tracks import ContactModel, ObjectShape, ObjectTrack

if TYPE_CHECKING:
    from processing.contact.judge import TossLoss
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

    return run.store.run("contact", 1, run.config.contact, inputs, compute)


def _learn(run: Run, name: str, tracks: Mapping[int, Done], folder: Path, prior: ObjectShape) -> Counts:
    from processing.contact.export import write_assets
    from processing.contact.from_tracks import learn_from_tracks
    from processing.contact.inertia import physics_of_session
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
        from processing.contact.figure4 import learn_figure_4
        from processing.contact.inertia import physics_of_session
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

    return run.store.run("rollout", 1, run.config.contact, inputs, compute)


LEAST_HELD_OUT = 4
"""Tosses from which on half of them are kept for judging: learned from fewer than two, friction is hardly known."""


def held_out_model(run: Run, name: str, tracks: Mapping[int, Done], shapes: Mapping[int, Done]) -> Done | None:
    """Contact learned from every other toss, to judge the rest by; None where tosses are too few, do not share a shape,
    or show no contact."""
    if len(tracks) < LEAST_HELD_OUT or len({s.key for s in shapes.values()}) > 1:
        return None
    half = {t: tracks[t] for t in sorted(tracks)[::2]}
    learned = contact_stage(run, f"{name}, every other one", half, next(iter(shapes.values())))
    return None if learned.counts.get("kept_out") else learned


def held_out_losses(
    run: Run, name: str, tracks: Mapping[int, Done], shapes: Mapping[int, Done], learned: Done | None
) -> dict[int, float]:
    """Contact loss (J) of each toss that `held_out_model` left out, of a shape at given poses; empty without a model or
    where none of them can be used.

    At the height of the plane that suits shape and poses best: size and height are not identifiable together, and a
    shape that grew would else be charged for a plane that lies too high.
    """
    if learned is None:
        return {}
    rest = {t: tracks[t] for t in sorted(tracks)[1::2]}
    done = held_out_stage(run, name, rest, next(iter(shapes.values())), learned)
    return {int(t): float(x) for t, x in done.counts.get("loss_j", {}).items()}


def held_out_stage(run: Run, name: str, tracks: Mapping[int, Done], shape: Done, learned: Done) -> Done:
    """Stage `held-out`: the contact loss per toss, with friction and inertia learned from others."""
    inputs = {"shape": shape.key, "learned": learned.key, **{f"track_{t:02d}": d.key for t, d in tracks.items()}}
    inputs |= {"calibration": run.keys["calibration"]}

    def compute(folder: Path) -> Counts:
        run.progress(f"{name}: contact loss of tosses not learned from").step(0, 1, "")
        poses = {t: read_track(d.folder, t) for t, d in tracks.items()}
        world_from_camera = run.session.calibration.transform("world", CAMERA)
        try:
            raised_m, losses = _at_best_height(
                poses, read_shape(shape.folder), read_contact(learned.folder), world_from_camera
            )
        except BadInput as why:
            return {"kept_out": str(why)}
        write_json(folder / "losses.json", {str(t): asdict(x) for t, x in losses.items()})
        return {"loss_j": {str(t): x.loss_j for t, x in losses.items()}, "raised_m": raised_m}

    return run.store.run("held-out", 2, {}, inputs, compute)


HEIGHTS_M = (-0.004, 0.004)
"""How far the plane may lie from where calibration has it."""


def _at_best_height(
    poses: Mapping[int, ObjectTrack], shape: ObjectShape, model: ContactModel, world_from_camera: Transform
) -> tuple[float, dict[int, TossLoss]]:
    """How far (m) the plane is raised where the mean loss is least, and the losses there."""
    from processing.contact.judge import contact_loss_of, mean_loss_j
    from processing.contact.plane import Plane

    def losses(raised_m: float) -> dict[int, TossLoss]:
        plane = Plane(model.plane_normal_world, model.plane_offset_m + float(raised_m), "the contact model")
        return contact_loss_of(poses, shape, model, world_from_camera, plane)

    options = {"xatol": 2e-4}
    best = minimize_scalar(lambda x: mean_loss_j(losses(x)), bounds=HEIGHTS_M, method="bounded", options=options)
    return float(best.x), losses(best.x)


NO_PLANE = (
    "the calibration does not say where the table is (no `world`), and contact needs the plane; run `toss-calibrate "
    "table SESSION`, or let it be estimated from depth: --table-from-depth"
)
