"""The paper's cycle on one screen (its steps 3 to 6): contact learning on the tracks, the shape drawn into the images,
and vision again on those; passes are compared without truth (`passes.py`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from processing import stage_notices as say
from processing.images import Images
from processing.passes import Pass, comparison
from processing.refine.image_residuals import Explained, difference
from processing.run import Run, both, each
from processing.stages.contact import learn_contact
from processing.stages.field import learn_field
from processing.stages.held_out import Half, halves_of, judge_by_contact, losses_of, why_no_halves
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
    if variant.refined == "contact":
        return with_contact(run, start, images, name) if variant.contact else start
    start = replace(start, halves=halves_of(start.tracks, start.shapes))
    refined, halves = learned_from(run, start, images, name, variant.contact)
    ended, losses = judged_pass(run, start, refined, halves, images, name, variant.icp)
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


def learned_from(
    run: Run, start: Pass, images: Mapping[int, Images], name: str, contact: bool
) -> tuple[Pass, tuple[Half, ...]]:
    """With contact where wanted; and what each half of the tosses tells of contact alone. No halves where one of them
    tells nothing: the other would judge only one way."""

    def half(k: int) -> Half:
        one = start.halves[k]
        tracks = {t: start.tracks[t] for t in one.learned_from}
        return replace(one, contact=learn_contact(run, f"{name}, {one.name}", tracks, one.shape))

    refined, halves = both(run, lambda: with_contact(run, start, images, name) if contact else start,
                           lambda: each(run, range(len(start.halves)), half))  # fmt: skip
    usable = all(h.contact is not None and not h.contact.result.kept_out for h in halves.values())
    return refined, tuple(halves.values()) if usable else ()


@dataclass(frozen=True, eq=False)
class Again:
    """Vision once more, on a shape drawn at its poses (`drawn`): the tracks in those images."""

    drawn: Mapping[int, Done]
    tracks: Mapping[int, Done]

    def shape(self, run: Run, name: str, shape: Done, images: Mapping[int, Images]) -> Done:
        """What the tracks show of a shape that is drawn at the same poses."""
        believed = shape if run.config.cycle.start == "shape" else None
        redrawn = {t: drawn_images(run, self.drawn[t], shape, images[t]) for t in images}
        return learn_field(run, f"{name}, second pass", self.tracks, redrawn, believed)


def tracked_again(run: Run, refined: Pass, images: Mapping[int, Images], name: str, icp: bool) -> Again:
    """The shape drawn at its poses (laid onto raw depth first where `icp`), and the poses once more in that."""
    shape = refined.shape

    def drawn_and_tracked(toss: int) -> tuple[Done, Done]:
        drawn = reproject(run, name, refined.tracks[toss], shape, images[toss], icp)
        return drawn, track(run, drawn_images(run, drawn, shape, images[toss]), shape, before=drawn)

    done = each(run, images, drawn_and_tracked)
    drawn, tracks = ({t: d[k] for t, d in done.items()} for k in (0, 1))
    seen = {t: d for t, d in tracks.items() if d.result.frames > d.result.lost}
    if len(seen) >= 2 and run.config.cycle.start != "shape":  # else the shape holds them together
        redrawn = {t: drawn_images(run, drawn[t], shape, images[t]) for t in images}
        tracks |= dict.fromkeys(seen, register(run, seen, redrawn, together=True))
    return Again(drawn, tracks)


def second_pass(run: Run, refined: Pass, images: Mapping[int, Images], name: str, icp: bool) -> Pass:
    """Vision once more."""
    again = tracked_again(run, refined, images, name, icp)
    shown = again.shape(run, name, refined.shape, images)
    return replace(refined, tracks=again.tracks, shapes=dict.fromkeys(again.tracks, shown))


def judged_pass(
    run: Run, before: Pass, refined: Pass, halves: Sequence[Half], images: Mapping[int, Images], name: str, icp: bool
) -> tuple[Pass, Losses]:
    """The second pass, and the contact losses per toss (J) before and after it, each toss judged by the half that did
    not learn from it: what contact corrects of the half's shape goes through the second pass as the row's does."""
    again = tracked_again(run, refined, images, name, icp)
    corrected = refined.shape.key != before.shape.key  # else contact's shape was kept out

    def shape(k: int) -> Done:
        half = None if k < 0 else halves[k]
        if half is None or half.contact is None or not corrected:
            return again.shape(run, name, refined.shape, images)
        return again.shape(run, f"{name}, {half.name}", half.contact, images)

    shapes = each(run, range(-1, len(halves)), shape)
    after = replace(refined, tracks=again.tracks, shapes=dict.fromkeys(again.tracks, shapes[-1]),
                    halves=tuple(replace(h, shape=shapes[k]) for k, h in enumerate(halves)))  # fmt: skip
    judging = [(before, h) for h in halves] + [(after, h) for h in after.halves]
    judged = each(run, range(len(judging)), lambda k: judge_by_contact(run, name, judging[k][0].tracks, judging[k][1]))
    losses = [losses_of([judged[k] for k in range(len(judging)) if judging[k][0] is x]) for x in (before, after)]
    return after, (losses[0], losses[1])


def compared(
    run: Run, before: Pass, after: Pass, images: Mapping[int, Images], name: str, losses: Losses
) -> dict[str, Any]:
    """See `passes.comparison`; on the raw images."""
    judged = both(run, *((lambda x=x: judge(run, name, x.tracks, x.shapes, images)) for x in (before, after)))
    return comparison(before, after, judged, losses, name, run.config.cycle)


def _until_converged(run: Run, second: Pass, images: Mapping[int, Images], name: str) -> Pass:
    """After the second pass further ones, for as long as they explain the raw images better and change poses or shape;
    the best one is kept."""
    best, passes, most = second, list(second.passes), run.config.cycle.most_passes
    for number in range(3, 3 + most):
        refined, halves = learned_from(run, best, images, name, contact=True)
        after, losses = judged_pass(run, best, refined, halves, images, name, icp=True)
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
