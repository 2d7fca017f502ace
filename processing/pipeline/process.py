"""The pipeline on one screen: plain calls of stages, each of which is read where it is there and computed where not;
`each` makes its calls side by side. Scores come afterwards; the ground truth is never asked (see evaluate/truth.py)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from processing.baselines.frame_to_model import FrameToModel
from processing.images import Images, every_frame, raw_images
from processing.pipeline import notices as say
from processing.pipeline.cycle import run_cycle
from processing.pipeline.first_pass import first_pass, start_alone
from processing.pipeline.masks import all_masks, masks_anew
from processing.pipeline.passes import Pass
from processing.pipeline.record import write_record
from processing.run import Run, each, with_noise
from processing.stages.field import learn_field
from processing.stages.lose import without_lost
from processing.stages.masks.find import find_object
from processing.stages.model import bring_model
from processing.stages.recording.depth_delay import with_depth_in_time
from processing.stages.recording.noise import measure_noise
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from processing.stages.rollout import roll_out
from processing.stages.track import track
from processing.stages.track_to_model import track_to_model
from processing.store import Done
from processing.variants import Variant
from recordings.results.folder import Scope, VariantRecord
from recordings.session import RgbdFrames


def process(run: Run, variant: Variant, scope: Scope, model: Path | None = None) -> VariantRecord:
    """Tracks and shapes of one variant, and the record of where they are; with `model`, tosses tracked with a shape
    that was learned before (`--model`), and nothing learned anew."""
    scene = learn_static_scene(run)
    rig = refine_rig(run, scene)
    found = find_object(run, scene, rig)
    run = with_depth_in_time(run, scene, all_masks(run, scene, rig, found))
    masks = masks_anew(run, scene, all_masks(run, scene, rig, found))  # followed again where depth's stamps were wrong
    noise = measure_noise(run, scene)
    run = replace(with_noise(run, noise.result.noise), warnings=(*run.warnings, *say.of_noise(noise)))
    run = without_lost(run, masks)
    images = {t: raw_images(run, t, rig, masks[t]) for t in run.tosses}
    alone = tracked_alone(run, images) if model is None else {}
    if model is not None:
        last = with_model(run, images, model)
    elif variant.first == "one_toss":
        last = one_by_one(run, alone, images, scope)
    else:
        last = together(run, variant, scope, alone, images)
    return write_record(run, variant, scope, last, alone, scene, rig, masks, images)


def with_model(run: Run, images: Mapping[int, Images], model: Path) -> Pass:
    """Every toss in the learned shape's object frame."""
    shape = bring_model(run, model)
    tracks = each(run, run.tosses, lambda t: track(run, images[t], shape))
    return Pass(tracks, dict.fromkeys(run.tosses, shape), shared_frame=True, warnings=say.of_tracks(tracks),
                notes=(f"shape: {model.name}",))  # fmt: skip


def tracked_alone(run: Run, images: Mapping[int, Images]) -> dict[int, Done]:
    """p_i: every toss by itself."""
    follow = track_to_model if run.tracker == FrameToModel.name else track
    return each(run, run.tosses, lambda t: follow(run, images[t]))


def one_by_one(run: Run, alone: Mapping[int, Done], images: Mapping[int, Images], scope: Scope) -> Pass:
    """The row p_i, O_i: in scope all only the first toss's shape is looked at."""
    notes, warnings = ("each toss has its own object frame",), say.of_tracks(alone)
    if run.tracker == FrameToModel.name:
        return Pass(alone, alone, shared_frame=False, warnings=warnings, notes=notes)
    wanted = run.tosses if scope == "one" else run.tosses[:1]
    shapes = each(run, wanted, lambda t: learn_field(run, f"toss {t}", {t: alone[t]}, images))
    whose = {t: shapes.get(t, shapes[wanted[0]]) for t in run.tosses}
    return Pass(alone, whose, shared_frame=False, warnings=warnings, notes=notes)


def together(run: Run, variant: Variant, scope: Scope, alone: Mapping[int, Done], images: Mapping[int, Images]) -> Pass:
    """The rows that begin with P and O; then the cycle on all tosses, or in scope one on every toss from p_i and O."""
    first = last = first_pass(run, alone, images)

    def cycle_of(toss: int) -> Pass:
        start = start_alone(run, toss, first, alone[toss], images)
        if start is None:  # it is lost, and stays so
            return Pass({toss: first.tracks[toss]}, {toss: first.shapes[toss]}, shared_frame=False)
        return run_cycle(run, variant, start, images, f"toss {toss}")

    if variant.refined is not None and scope == "all":
        last = with_rollouts(run, variant, run_cycle(run, variant, first, images, "all tosses"))
    elif variant.refined is not None:
        last = Pass.joined([*each(run, run.tosses, cycle_of).values()])
    apart = {t: alone[t] for t in run.tosses if t not in last.tracks}  # in their own object frames
    shapes = each(run, apart, lambda t: learn_field(run, f"toss {t}", {t: alone[t]}, images))
    return replace(last, tracks={**last.tracks, **apart}, shapes={**last.shapes, **shapes},
                   shared_frame=last.shared_frame and not apart)  # fmt: skip


def with_rollouts(run: Run, variant: Variant, last: Pass) -> Pass:
    """The paper's Figure 4, of rows with contact and ICP."""
    if not (variant.icp and last.contact):
        return last
    rolled = roll_out(run, "all tosses", last.tracks, last.shape)
    warnings = (*last.warnings, *say.no_rollouts(rolled))
    return replace(last, rollout=None if rolled.result.kept_out else rolled, warnings=warnings)


def metric_frames_of(run: Run) -> dict[int, RgbdFrames]:
    """Every frame that was recorded of each toss, depth in true metres: for the scorer."""
    rig = refine_rig(run, learn_static_scene(run))
    return {t: every_frame(run, t, rig) for t in run.tosses}
