"""The paper's cycle on one screen (its steps 3 to 6): contact learning on the tracks, the shape drawn into the images,
and vision again on those; passes are compared without truth (`passes.py`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from processing import stage_notices as say
from processing.images import Images
from processing.passes import Pass, comparison
from processing.refine.image_residuals import difference
from processing.run import Run
from processing.stages.contact import learn_contact
from processing.stages.field import learn_field
from processing.stages.held_out import halves_of, judge_by_contact, losses_of, why_no_halves
from processing.stages.joint import solve_together
from processing.stages.judge import judge, residuals
from processing.stages.register import register
from processing.stages.reproject import drawn_images, reproject
from processing.stages.track import track
from processing.store import Done
from processing.variants import Variant

Losses = tuple[Mapping[int, float], Mapping[int, float]]


def run_cycle(run: Run, variant: Variant, start: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """A row of the table from its first pass on; `images` are the raw ones."""
    images, config = {t: images[t] for t in start.tracks}, run.config.cycle
    if variant.refined == "joint":
        return _joint(run, start, images, name)
    refined = with_contact(run, start, images, name) if variant.contact else start
    if variant.refined == "contact":
        return refined
    start = replace(start, halves=halves_of(start.tracks, start.shapes))
    ended, losses = judged_pass(run, start, refined, images, name, variant.icp)
    told = compared(run, start, ended, images, name, losses)
    refined, ended = (replace(x, notes=(*x.notes, *why_no_halves(start.tracks, losses[0]))) for x in (refined, ended))
    if told["worse_share"] > config.much_worse:
        return replace(refined, passes=(told,), warnings=(*refined.warnings, say.second_pass_not_kept(told)))
    notes = (*ended.notes, *say.second_pass_kept(told, config), *say.departures(config))
    ended = replace(ended, passes=(told,), notes=notes)
    return _until_converged(run, ended, images, name) if variant.refined == "converged" else ended


def with_contact(run: Run, start: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """Õ: contact learning on the tracks with the shape as prior; its shape replaces vision's where it is not worse.

    Both are judged at the same poses, frame by frame. Poses laid anew onto depth for each shape would hide a wrong
    size (the faces in view can always be met); on recorded tosses they change the difference by less than 0.001 mm.
    """
    learned = learn_contact(run, name, start.tracks, start.shape)
    if learned.result.kept_out:
        return replace(start, warnings=(*start.warnings, say.contact_kept_out(name, learned.result.kept_out)))
    vision, corrected = (
        residuals(judge(run, name, start.tracks, dict.fromkeys(start.tracks, s), images))
        for s in (start.shape, learned)
    )
    contact, gap = dict.fromkeys(start.tracks, learned), difference(vision, corrected)
    if gap.worse:
        return replace(start, contact=contact, warnings=(*start.warnings, say.contact_shape_worse(name, gap)))
    return replace(start, shapes=contact, contact=contact)


def second_pass(run: Run, refined: Pass, images: Mapping[int, Images], name: str, icp: bool) -> Pass:
    """The shape drawn at its poses (laid onto raw depth first where `icp`), and vision once more on that."""
    shape, mode = refined.shape, run.config.cycle.start
    drawn = reproject(run, name, refined.tracks, shape, images, icp)
    redrawn = {t: drawn_images(run, drawn, shape, images[t]) for t in images}
    tracks: dict[int, Done] = {t: track(run, redrawn[t], shape, before=drawn) for t in images}
    seen = {t: d for t, d in tracks.items() if d.result.frames > d.result.lost}
    if len(seen) >= 2 and mode != "shape":  # else the shape holds them together
        tracks = {**tracks, **dict.fromkeys(seen, register(run, seen, redrawn, together=True))}
    shown = learn_field(run, f"{name}, second pass", tracks, redrawn, shape if mode == "shape" else None)
    return replace(refined, tracks=tracks, shapes=dict.fromkeys(tracks, shown))


def judged_pass(
    run: Run, before: Pass, refined: Pass, images: Mapping[int, Images], name: str, icp: bool
) -> tuple[Pass, Losses]:
    """The second pass, and the contact losses per toss (J) before and after it, each toss judged by the half that did
    not learn from it: what contact corrects of the half's shape goes through the second pass as the row's does."""
    after = second_pass(run, refined, images, name, icp)
    halves = [replace(h, contact=learn_contact(run, f"{name}, {h.name}", {t: before.tracks[t] for t in h.learned_from},
                                               h.shape)) for h in before.halves]  # fmt: skip
    if any(h.contact is None or h.contact.result.kept_out for h in halves):  # one alone would not judge both ways
        halves = []
    drawn = reproject(run, name, refined.tracks, refined.shape, images, icp)
    ended = []
    for half in halves:
        shape = after.shape
        if refined.shape.key != before.shape.key and half.contact is not None:  # contact's shape was not kept out
            redrawn = {t: drawn_images(run, drawn, half.contact, images[t]) for t in images}
            believed = half.contact if run.config.cycle.start == "shape" else None
            shape = learn_field(run, f"{name}, {half.name}, second pass", after.tracks, redrawn, believed)
        ended.append(replace(half, shape=shape))
    losses = tuple(losses_of([judge_by_contact(run, name, x.tracks, h) for h in of])
                   for x, of in ((before, halves), (after, ended)))  # fmt: skip
    return replace(after, halves=tuple(ended)), (losses[0], losses[1])


def compared(
    run: Run, before: Pass, after: Pass, images: Mapping[int, Images], name: str, losses: Losses
) -> dict[str, Any]:
    """See `passes.comparison`; on the raw images."""
    first, second = (judge(run, name, x.tracks, x.shapes, images) for x in (before, after))
    return comparison(before, after, (first, second), losses, name, run.config.cycle)


def _until_converged(run: Run, second: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """After the second pass further ones, for as long as they explain the raw images better and change poses or shape;
    the best one is kept."""
    best, passes, most = second, list(second.passes), run.config.cycle.most_passes
    for number in range(3, 3 + most):
        after, losses = judged_pass(run, best, with_contact(run, best, images, name), images, name, icp=True)
        told = {"pass": number, **compared(run, best, after, images, name, losses)}
        passes.append(told)
        if told["worse_share"] <= 0:
            best = after
        if told["worse_share"] > 0 or told["same"]:
            return replace(best, passes=tuple(passes), notes=(*best.notes, say.converged(told)))
    return replace(best, passes=tuple(passes), warnings=(*best.warnings, say.not_converged(most)))


def _joint(run: Run, start: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """One pass of the cycle, then all terms in one objective; friction by contact learning at its poses and shape.
    Contact is among the terms, of all tosses: no toss is left that it could be judged by."""
    begun = second_pass(run, with_contact(run, start, images, name), images, name, icp=True)
    solved = solve_together(run, begun.tracks, begun.shape, images)
    tracks = dict.fromkeys(begun.tracks, solved)
    learned = learn_contact(run, name, tracks, solved)
    kept_out = learned.result.kept_out
    warnings = (*start.warnings, *say.joint(name, kept_out, solved.result.kept_out))
    ended = replace(begun, tracks=tracks, shapes=tracks, contact={} if kept_out else dict.fromkeys(tracks, learned),
                    warnings=warnings)  # fmt: skip
    return replace(ended, passes=(compared(run, begun, ended, images, name, ({}, {})),))
