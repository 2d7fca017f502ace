"""The paper's cycle on one screen (its steps 3 to 6): contact learning on the tracks, the shape drawn into the images,
and vision again on those; passes are compared without truth (`passes.py`)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from processing.images import Images
from processing.pipeline import notices as say
from processing.pipeline.passes import Pass, comparison
from processing.refine.image_residuals import Explained, difference
from processing.run import Run, both, each
from processing.stages.contact import learn_contact
from processing.stages.field import learn_field
from processing.stages.held_out import Half, halves_of, why_not_by_contact
from processing.stages.joint import solve_together
from processing.stages.judge import judge, residuals
from processing.stages.register import register
from processing.stages.reproject import drawn_images, reproject
from processing.stages.rollout import roll_out
from processing.stages.track import track
from processing.store import Done
from processing.variants import Variant


def run_cycle(run: Run, variant: Variant, start: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """A row of the table from its first pass on; `images` are the raw ones."""
    images, config = {t: images[t] for t in start.tracks}, run.config.cycle
    if variant.refined == "joint":
        return in_one_objective(run, start, images, name)
    if variant.refined == "contact":
        return with_contact(run, start, images, name) if variant.contact else start
    start = replace(start, halves=halves_of(start.tracks, start.shapes))
    ends_here = variant.refined != "converged"
    refined, second, change = once_more(run, start, images, name, variant.contact, variant.icp, rollouts=ends_here)
    notes = () if "contact_j" in change["before"] else (why_not_by_contact(len(start.tracks)),)
    drawn_off = config.start != "anew" and change["rotation_deg"] > config.far_deg
    if change["worse_share"] > config.much_worse or drawn_off:
        left_out = say.second_pass_not_kept(change, config)
        return replace(
            refined, passes=(change,), notes=(*refined.notes, *notes), warnings=(*refined.warnings, left_out)
        )
    notes = (*second.notes, *notes, *say.second_pass_kept(change, config), *say.departures(config))
    second = replace(second, passes=(change,), notes=notes)
    return until_converged(run, second, images, name) if variant.refined == "converged" else second


def once_more(
    run: Run, start: Pass, images: Mapping[int, Images], name: str, contact: bool, icp: bool, rollouts: bool = False
) -> tuple[Pass, Pass, dict[str, Any]]:
    """One turn of the cycle: the pass with what contact says of it, the pass after that, and what changed from the
    start to there. Contact judges both ends by the same halves of the tosses."""
    refined, halves = both(run, lambda: with_contact(run, start, images, name) if contact else start,
                           lambda: learned_by_halves(run, start, name))  # fmt: skip
    refined, start = replace(refined, halves=halves), replace(start, halves=halves)
    after = second_pass(run, refined, images, name, icp, rollouts and icp and len(start.tracks) > 1)
    return refined, after, comparison(run, start, after, images, name)


def with_contact(run: Run, start: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """Step 3, Õ: contact learning on the tracks with the shape as prior; its shape replaces vision's where it is not
    worse.

    Both are judged at the same poses, frame by frame. Poses laid anew onto depth for each shape would hide a wrong
    size (the faces in view can always be met); on recorded tosses they change the difference by less than 0.001 mm.
    """

    def judged(shape: Done) -> Explained:
        return residuals(judge(run, name, start.tracks, dict.fromkeys(start.tracks, shape), images))

    learned, vision = both(
        run, lambda: learn_contact(run, name, start.tracks, start.shape), lambda: judged(start.shape)
    )
    if learned.result.kept_out:
        return replace(start, warnings=(*start.warnings, say.contact_kept_out(name, learned.result.kept_out)))
    contact, gap = dict.fromkeys(start.tracks, learned), difference(vision, judged(learned))
    if gap.worse:
        return replace(start, contact=contact, warnings=(*start.warnings, say.contact_shape_worse(name, gap)))
    return replace(start, shapes=contact, contact=contact)


def learned_by_halves(run: Run, start: Pass, name: str) -> tuple[Half, ...]:
    """What each half of the tosses says of contact alone. No halves where one of them says nothing: the other would
    judge only one way."""

    def learned(half: Half) -> Half:
        tracks = {t: start.tracks[t] for t in half.learned_from}
        return replace(half, contact=learn_contact(run, f"{name}, {half.name}", tracks, half.shape))

    halves = tuple(each(run, start.halves, learned).values())
    usable = all(h.contact is not None and not h.contact.result.kept_out for h in halves)
    return halves if usable else ()


def second_pass(
    run: Run, refined: Pass, images: Mapping[int, Images], name: str, icp: bool, rollouts: bool = False
) -> Pass:
    """Steps 4 to 6, vision once more: the poses in images with the shape drawn into them, and what these show of the
    shape; of each half's shape too, where contact's was kept. Meanwhile the pass that most likely ends the row is
    rolled out, where `rollouts`: the pipeline asks for that anyway, when no other stage can run beside it."""
    drawn, tracks = tracked_again(run, refined, images, name, icp)
    corrected = any(learned.key == refined.shape.key for learned in refined.contact.values())

    def shown(half: Half | None) -> Done:
        """What the tracks show of a shape that is drawn at the same poses."""
        own = half.contact if half is not None and corrected else None
        shape, of = (refined.shape, name) if half is None or own is None else (own, f"{name}, {half.name}")
        prior = shape if run.config.cycle.start == "shape" else None
        redrawn = {t: drawn_images(run, drawn[t], shape, images[t]) for t in images}
        seen = learn_field(run, f"{of}, second pass", tracks, redrawn, prior)
        if half is None and rollouts and refined.contact:
            roll_out(run, name, tracks, seen)
        return seen

    shapes = each(run, (None, *refined.halves), shown)
    halves = tuple(replace(half, shape=shapes[half]) for half in refined.halves)
    return replace(refined, tracks=tracks, shapes=dict.fromkeys(tracks, shapes[None]), halves=halves)


def tracked_again(
    run: Run, refined: Pass, images: Mapping[int, Images], name: str, icp: bool
) -> tuple[dict[int, Done], dict[int, Done]]:
    """Where the shape is drawn (laid onto raw depth first where `icp`), and the tracks in those images."""
    shape = refined.shape

    def drawn_and_tracked(toss: int) -> tuple[Done, Done]:
        drawn = reproject(run, name, refined.tracks[toss], shape, images[toss], icp)
        return drawn, track(run, drawn_images(run, drawn, shape, images[toss]), shape, drawn, run.config.cycle.start)

    done = each(run, images, drawn_and_tracked)
    drawn, tracks = ({t: d[k] for t, d in done.items()} for k in (0, 1))
    seen = {t: d for t, d in tracks.items() if d.result.frames > d.result.lost}
    if len(seen) >= 2 and run.config.cycle.start != "shape":  # else the shape holds them together
        redrawn = {t: drawn_images(run, drawn[t], shape, images[t]) for t in images}
        tracks |= dict.fromkeys(seen, register(run, seen, redrawn, together=True))
    return drawn, tracks


def until_converged(run: Run, second: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """After the second pass further ones, for as long as they explain the raw images better and change poses or shape;
    the best one is kept."""
    best, passes, most = second, list(second.passes), run.config.cycle.most_passes
    for number in range(3, 3 + most):
        _, after, change = once_more(run, best, images, name, contact=True, icp=True)
        passes.append({"pass": number, **change})
        if change["worse_share"] <= 0:
            best = after
        if change["worse_share"] > 0 or change["same"]:
            return replace(best, passes=tuple(passes), notes=(*best.notes, say.converged(passes[-1])))
    return replace(best, passes=tuple(passes), warnings=(*best.warnings, say.not_converged(most)))


def in_one_objective(run: Run, start: Pass, images: Mapping[int, Images], name: str) -> Pass:
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
    return replace(ended, passes=(comparison(run, begun, ended, images, name),))
