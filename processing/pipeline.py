"""The pipeline on one screen: plain calls of stages, each of which is read where it is there and computed where not;
`each` makes its calls side by side. Scores come afterwards; the ground truth is never asked (see evaluate/truth.py)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from processing import stage_notices as say
from processing.baselines.frame_to_model import FrameToModel
from processing.cycle import run_cycle
from processing.images import Images, every_frame, raw_images
from processing.one_shape import kept_apart
from processing.passes import Pass
from processing.record import write_record
from processing.run import Run, each
from processing.stages.baseline import track_to_model
from processing.stages.field import learn_field
from processing.stages.find import find_object
from processing.stages.lose import lose, without_lost
from processing.stages.model import bring_model
from processing.stages.place import place_shape
from processing.stages.register import register
from processing.stages.rig import refine_rig, with_depth_in_time
from processing.stages.rollouts import roll_out
from processing.stages.scene import learn_static_scene, measure_noise
from processing.stages.segment import segment
from processing.stages.track import track
from processing.store import Done
from processing.variants import Variant, refuse_baseline
from recordings.results.folder import Scope, VariantRecord
from recordings.session import RgbdFrames


def process(run: Run, variant: Variant, scope: Scope, model: Path | None = None) -> VariantRecord:
    """Tracks and shapes of one variant, and the record of where they are; with `model`, tosses tracked with a shape
    that was learned before (`--model`), and nothing learned anew."""
    scene = learn_static_scene(run)
    rig = refine_rig(run, scene)
    found = find_object(run, scene, rig)
    run = with_depth_in_time(run, scene, all_masks(run, scene, rig, found))
    masks = all_masks(run, scene, rig, found)  # read again, but where depth's stamps were wrong
    noise = measure_noise(run, scene)
    run = replace(run, noise=noise.result.noise, warnings=(*run.warnings, *say.of_noise(noise)))
    run = without_lost(run, masks)
    images = {t: raw_images(run, t, rig, masks[t]) for t in run.tosses}
    if model is not None:
        last = with_model(run, images, model)
    else:
        follow = track_to_model if run.tracker == FrameToModel.name else track
        alone = each(run, run.tosses, lambda t: follow(run, images[t]))  # p_i
        last = one_by_one(run, alone, images, scope) if variant.first == "one_toss" else (
            together(run, variant, scope, alone, images))  # fmt: skip
    lost = {t: lose(run, t, masks[t]) for t in run.lost}
    return write_record(run, variant, scope, last, lost, scene, rig, masks)


def all_masks(run: Run, scene: Done, rig: Done, found: Done | None) -> dict[int, Done]:
    """The object's masks in every toss."""
    return each(run, run.tosses, lambda t: segment(run, t, scene, rig, found))


def with_model(run: Run, images: Mapping[int, Images], model: Path) -> Pass:
    """Every toss in the learned shape's object frame."""
    shape = bring_model(run, model)
    tracks = each(run, run.tosses, lambda t: track(run, images[t], shape))
    return Pass(tracks, dict.fromkeys(run.tosses, shape), shared_frame=True, warnings=say.of_tracks(tracks),
                notes=(f"shape: {model.name}",))  # fmt: skip


def one_by_one(run: Run, alone: Mapping[int, Done], images: Mapping[int, Images], scope: Scope) -> Pass:
    """p_i, O_i: in scope all only the first toss's shape is looked at."""
    notes, warnings = ("each toss has its own object frame",), say.of_tracks(alone)
    if run.tracker == FrameToModel.name:
        return Pass(alone, alone, shared_frame=False, warnings=warnings, notes=notes)
    wanted = run.tosses if scope == "one" else run.tosses[:1]
    shapes = each(run, wanted, lambda t: learn_field(run, f"toss {t}", {t: alone[t]}, images))
    whose = {t: shapes.get(t, shapes[wanted[0]]) for t in run.tosses}
    return Pass(alone, whose, shared_frame=False, warnings=warnings, notes=notes)


def together(run: Run, variant: Variant, scope: Scope, alone: Mapping[int, Done], images: Mapping[int, Images]) -> Pass:
    """The rows that begin with P and O; then the cycle on all tosses, or in scope one on every toss from p_i and O."""
    first = first_pass(run, alone, images)
    last = first
    if variant.refined is not None and scope == "all":
        last = run_cycle(run, variant, first, images, "all tosses")
        if variant.icp and last.contact:  # the paper's Figure 4
            rolled = roll_out(run, "all tosses", last.tracks, last.shape)
            last = replace(last, rollout=None if rolled.result.kept_out else rolled,
                           warnings=(*last.warnings, *say.no_rollouts(rolled)))  # fmt: skip
    elif variant.refined is not None:
        last = Pass.joined([*each(run, first.tracks, lambda t: run_cycle(
            run, variant, start_alone(run, t, first, alone[t], images), images, f"toss {t}")).values()])  # fmt: skip
    apart = {t: alone[t] for t in run.tosses if t not in last.tracks}  # in their own object frames
    shapes = each(run, apart, lambda t: learn_field(run, f"toss {t}", {t: alone[t]}, images))
    return replace(last, tracks={**last.tracks, **apart}, shapes={**last.shapes, **shapes},
                   shared_frame=last.shared_frame and not apart)  # fmt: skip


def first_pass(run: Run, alone: Mapping[int, Done], images: Mapping[int, Images]) -> Pass:
    """P, O: all tosses in one object frame, and one shape. Tosses that the shape of all does not explain are kept
    apart, and the others joined anew: they were refined together with the wrong ones."""
    refuse_baseline(run.tracker)
    tosses, warnings = run.tosses, list(say.of_tracks(alone))
    while True:
        placed = register(run, {t: alone[t] for t in tosses}, images)
        joined = [t for t in tosses if t not in placed.result.not_joined]
        shape = learn_field(run, "all tosses", dict.fromkeys(joined, placed), images)
        apart = kept_apart(run, placed, shape, images, joined)
        if not apart:
            warnings += say.of_register(placed)
            return Pass(dict.fromkeys(tosses, placed), dict.fromkeys(tosses, shape),
                        shared_frame=tosses == run.tosses, warnings=tuple(warnings))  # fmt: skip
        warnings.append(say.kept_apart(apart))
        tosses = tuple(t for t in tosses if t not in apart)


def start_alone(run: Run, toss: int, first: Pass, alone: Done, images: Mapping[int, Images]) -> Pass:
    """Where the cycle begins on one toss: p_i, and O in its object frame. A toss that is lost in P does not say how O
    lies in it (it may be another object's): its own shape is taken."""
    placed: Done = place_shape(run, toss, first.tracks[toss], alone, first.shapes[toss])
    lost = not placed.result.frames
    shape = learn_field(run, f"toss {toss}", {toss: alone}, images) if lost else placed
    return Pass({toss: alone}, {toss: shape}, shared_frame=False, warnings=say.lost_among_all(toss) if lost else ())


def metric_frames_of(run: Run) -> dict[int, RgbdFrames]:
    """Every frame that was recorded of each toss, depth in true metres: for the scorer."""
    rig = refine_rig(run, learn_static_scene(run))
    return {t: every_frame(run, t, rig) for t in run.tosses}
