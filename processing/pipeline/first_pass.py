"""The first pass over all tosses (P, O): one object frame, one shape; do all tosses show that shape there?

A registration can fit what two tosses see in common and still be wrong by a symmetry (a prism's faces look alike); then
their frames fused together explain neither.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from processing.images import Images
from processing.pipeline import notices as say
from processing.pipeline.cross_fit import cross_fitted, fused, joins, located_on, with_free_surface
from processing.pipeline.passes import Pass
from processing.run import Run, each
from processing.stages.field import learn_field
from processing.stages.judge import judge, residuals
from processing.stages.place import place_shape
from processing.stages.register import register
from processing.store import Done
from processing.variants import refuse_baseline
from recordings.errors import BadInput

APART = 1.5
"""An outline that a common shape misses by so many times what the toss's own frames alone do is not explained: a ratio,
because masks that are bad alike miss more either way. Tosses of `judge-021` that belong together: 1.2 and 1.3."""


def first_pass(run: Run, alone: Mapping[int, Done], images: Mapping[int, Images]) -> Pass:
    """P, O: all tosses in one object frame, and one shape. Tosses that the shape of all does not explain are kept
    apart, and the others joined anew: they were refined together with the wrong ones. Kept apart, too, are those that
    do not come into that object frame; only one that shows no shape of its own is lost."""
    refuse_baseline(run.tracker)
    tosses, warnings = run.tosses, list(say.of_tracks(alone))
    alien: tuple[int, ...] = ()
    while True:
        placed = register(run, {t: alone[t] for t in tosses}, images)
        joined = [t for t in tosses if t not in placed.result.not_joined]
        shown = fused(run, dict.fromkeys(joined, placed), images)
        unexplained = kept_apart(run, placed, shown, images, joined) if shown is not None else ()
        if not unexplained:
            break
        alien, tosses = (*alien, *unexplained), tuple(t for t in tosses if t not in unexplained)
    fitted = cross_fitted(run, images, dict.fromkeys(joined, placed), alone)
    found = located(run, images, fitted, {t: alone[t] for t in run.tosses if t not in joined})
    if found:  # the others have not been on a shape with what these show
        fitted = cross_fitted(run, images, {**fitted, **found}, {**alone, **found})
    fitted = with_free_surface(run, fitted, images)
    left = [t for t in placed.result.not_joined if t not in found]
    own = each(run, left, lambda t: own_shape(run, t, alone[t], images))
    lost = [t for t in left if own[t] is None]
    alien = tuple(sorted(t for t in alien if t not in found))
    warnings += [say.kept_apart(alien)] if alien else []
    warnings += say.of_register(placed, found, lost)
    tracks = {**fitted, **dict.fromkeys(lost, placed)}
    tracks = {t: tracks[t] for t in run.tosses if t in tracks}
    shape = learn_field(run, "all tosses", fitted, images)
    shared = len(tracks) == len(run.tosses)
    return Pass(tracks, dict.fromkeys(tracks, shape), shared_frame=shared, warnings=tuple(warnings))


def located(
    run: Run, images: Mapping[int, Images], joined: Mapping[int, Done], missing: Mapping[int, Done]
) -> dict[int, Done]:
    """Of tosses that are not among the `joined` ones (`missing`: their own tracks, which would stay), those whose
    object is found on the shape of these, by tracking it there from the start."""
    if not missing:
        return {}
    shape = fused(run, joined, images)
    if shape is None:  # they are no surer of it
        return {}
    tracks = {t: done for t, done in each(run, missing, lambda t: located_on(run, images[t], shape)).items() if done}

    def explained(toss: int) -> bool:
        return not _unexplained(run, tracks[toss], shape, images, [toss])

    found = each(run, tracks, lambda t: joins(run, images[t], missing[t], tracks[t], lambda: explained(t)))
    return {t: done for t, done in tracks.items() if found[t]}


def own_shape(run: Run, toss: int, alone: Done, images: Mapping[int, Images]) -> Done | None:
    """The shape that one toss shows by its own track; None where that shows too little."""
    try:
        return learn_field(run, f"toss {toss}", {toss: alone}, images)
    except BadInput:
        return None


def start_alone(run: Run, toss: int, first: Pass, alone: Done, images: Mapping[int, Images]) -> Pass | None:
    """Where the cycle begins on one toss: p_i, and O in its object frame. A toss that is not in P, or lost there, does
    not say how O lies in it (it may be another object's): its own shape is taken. None where a lost one has none."""
    if toss in first.tracks:
        placed: Done = place_shape(run, toss, first.tracks[toss], alone, first.shapes[toss])
        if placed.result.frames:
            return Pass({toss: alone}, {toss: placed}, shared_frame=False)
        if own_shape(run, toss, alone, images) is None:
            return None
    own = learn_field(run, f"toss {toss}", {toss: alone}, images)
    return Pass({toss: alone}, {toss: own}, shared_frame=False, warnings=say.not_among_others(toss))


def kept_apart(
    run: Run, together: Done, shape: Done, images: Mapping[int, Images], joined: Sequence[int]
) -> tuple[int, ...]:
    """Tosses that no one shape explains with the others. The outline decides: the share of a toss's mask and the drawn
    shape that is not common to both, against `CycleConfig.apart_mask`; and it must be `APART` times what the toss's own
    frames fused alone leave (a pixel of a small mask is much, a gripper hides some).

    Where the shape of all explains all, there are none. Else tosses are grouped, each added to the one that its own
    frames explain best where the frames fused so far explain every toss among them, what is left likewise; the largest
    group stays (of two as large, the one that starts with the toss that its own frames explain better).
    """
    if not _unexplained(run, together, shape, images, joined):
        return ()
    alone = _left_alone(run, together, images, joined)
    left = sorted(joined, key=lambda t: alone.get(t, np.inf))
    groups: list[list[int]] = []
    while left:
        group = left[:1]
        for toss in left[1:]:
            tried = [*group, toss]
            shown = fused(run, dict.fromkeys(tried, together), images)
            if shown is None or not _unexplained(run, together, shown, images, tried):
                group = tried
        groups.append(group)
        left = [t for t in left if t not in group]
    kept = max(groups, key=len)
    return tuple(t for t in joined if t not in kept)


def _unexplained(
    run: Run, together: Done, shape: Done, images: Mapping[int, Images], tosses: Sequence[int]
) -> list[int]:
    """Tosses whose outline the shape does not explain, although their own frames alone do. (Where none of them is sure,
    they explain nothing, and are no part of the shape.)"""
    limit = run.config.cycle.apart_mask
    left = _left(run, together, dict.fromkeys(tosses, shape), images)
    unexplained = [t for t in tosses if left[t] > limit]
    if not unexplained:
        return []
    alone = _left_alone(run, together, images, unexplained)
    return [t for t in alone if left[t] > APART * alone[t]]


def _left_alone(run: Run, together: Done, images: Mapping[int, Images], tosses: Sequence[int]) -> dict[int, float]:
    """What each toss's own frames, fused alone, leave of its outline (`_left`); none of those that show no shape."""
    found = each(run, tosses, lambda t: fused(run, {t: together}, images))
    own = {t: shape for t, shape in found.items() if shape is not None}
    return _left(run, together, own, images) if own else {}


def _left(run: Run, together: Done, shapes: Mapping[int, Done], images: Mapping[int, Images]) -> dict[int, float]:
    """Share of outline and drawn shape that is not common, median over a toss's frames; 0 where none can be judged."""
    rows = residuals(judge(run, "one shape", dict.fromkeys(shapes, together), shapes, images)).rows
    return {t: float(np.median(rows[rows[:, 0] == t, 3])) if (rows[:, 0] == t).any() else 0.0 for t in shapes}
