"""Cross-fitting of the first pass: each toss is tracked again on the shape that the other tosses show.

A shape fused from a toss's own frames repeats the errors of its poses, and so confirms them; the errors of the other
tosses are independent of them (leave-one-out, Stone 1974). What decides between a toss's tracks is how well its frames
agree with their own fusion at the poses: a wrong pose blurs the surface, and the outlines contradict it. Of an object
that is located anew, the others' shape and its colours decide, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.special import ndtri

from processing.images import Images
from processing.refine.image_residuals import ALIKE, FAR_M, Explained, difference
from processing.run import Run, each
from processing.stages.adjust import adjust
from processing.stages.carry import carry
from processing.stages.fuse import fuse_frames
from processing.stages.judge import judge, residuals
from processing.stages.track import TrackResult, track
from processing.store import Done
from recordings.errors import BadInput

TURNS, GAIN = 6, 0.1
"""A further turn is for tosses whose misfit fell by more than this in the last one, and the second for those that the
first left open, too: on shapes that it corrected. (Located anew they are once: of eight sessions with such tosses none
took what a second search found, which cost a tenth to a fifth of all time.)"""
SURE_NATS = 0.5 * float(ndtri(0.95)) ** 2
"""What chance makes of a Gaussian once in twenty times (one side)."""
SPOILED_NATS = SURE_NATS + float(np.log(7.0))
"""What must speak against the adjustment of a toss: of sixteen (generated sessions) it made two worse by a degree."""
FAR_BETTER = 0.5 * float(np.log(2.0) / ALIKE) ** 2
"""Nats of half the residuals: a toss that lies right on a shape fits hardly worse than it does alone."""
ADJUSTMENTS, STILL_DEG = 4, 1.0
"""All poses are adjusted so often at most, and no longer once half of them turn by less than this."""
FOLDS = 3
"""Into so many parts many tosses are split, each tracked on the others' shape; fewer tosses are left out singly."""


def cross_fitted(
    run: Run, images: Mapping[int, Images], tracks: Mapping[int, Done], alone: Mapping[int, Done[TrackResult]]
) -> dict[int, Done]:
    """The tracks of tosses in one object frame, each the best of: what it was, or was `alone` where that surely fits
    better; refined on the others' shape; and, of a toss that tracked alone left a rotation open or lost frames, the
    object located anew on that shape. It goes on while tosses gain by it."""
    best, results = dict(tracks), {t: alone[t].result for t in tracks}
    if len(best) < 2:
        return best
    best = each(run, best, lambda t: unbent(run, t, tracks[t], alone[t], images[t]))
    again = tuple(best)
    misfits = own_misfits(run, best, images)
    for turn in range(TURNS):
        for fold in worst_first({t: misfits[t] for t in again}):
            shape = fused(run, without(best, fold), images)
            if shape is None:  # nothing that the others show is sure
                continue
            found = refitted(run, {t: best[t] for t in fold}, shape, images, results, locate=turn == 0)
            results |= {t: done.result for t, done in found.items() if done.key != best[t].key}
            best |= found
        earlier, misfits = misfits, own_misfits(run, {t: best[t] for t in again}, images)
        left_open = [t for t in again if turn == 0 and is_open(run, results[t])]
        again = tuple(t for t in again if t in left_open or misfits[t] < earlier[t] - GAIN)
        if not again:
            break
    return best


def fused(run: Run, tracks: Mapping[int, Done], images: Mapping[int, Images], draft: bool = False) -> Done | None:
    """The surface that tosses show; None where no frame of theirs has a (sure) pose, or too little depth."""
    try:
        return fuse_frames(run, tracks, images, draft)
    except BadInput:
        return None


def refitted(
    run: Run, tracks: Mapping[int, Done], shape: Done, images: Mapping[int, Images],
    results: Mapping[int, TrackResult], locate: bool,
) -> dict[int, Done]:  # fmt: skip
    """Tosses on the shape of others, open ones located anew there where one may `locate` them; `results`: how sure each
    one's track was."""
    return each(run, tracks, lambda t: chosen(run, tracks[t], results[t], shape, images[t], locate))


def unbent(run: Run, toss: int, together: Done, alone: Done, images: Images) -> Done:
    """The track of a toss that was refined together with the others; or as the toss alone had it, where its frames fit
    themselves better so, by more than chance."""
    own = carry(run, toss, together, alone) if together.key != alone.key else None
    if own is None or not own.result.frames:
        return together
    stiff, bent = (on_itself(run, done, images) for done in (own, together))
    gap = difference(stiff, bent, misfit_of)
    return own if gap.mean > gap.by_chance and stiff.lost <= bent.lost else together


def with_free_surface(run: Run, tracks: Mapping[int, Done], images: Mapping[int, Images]) -> dict[int, Done]:
    """The tracks after adjustments of all of them with the surface that they show free, for as long as these still turn
    them."""
    found = dict(tracks)
    for _ in range(ADJUSTMENTS):
        found, turned_deg = adjusted_once(run, found, tracks, images)
        if turned_deg < STILL_DEG:
            break
    return found


def adjusted_once(
    run: Run, tracks: Mapping[int, Done], first: Mapping[int, Done], images: Mapping[int, Images]
) -> tuple[dict[int, Done], float]:
    """The tracks after one adjustment, those of tosses that it surely spoiled as they were, and by how many degrees it
    turned them (median; 0 where there is none). `first`: the tracks before any, by which frames are sure."""
    shape = fused(run, tracks, images, draft=True)
    if shape is None:
        return dict(tracks), 0.0
    after = adjust(run, tracks, first, shape, images)

    def stays(toss: int) -> bool:
        was, now = (TrackResiduals(on_itself(run, done, images[toss]), None) for done in (tracks[toss], after))
        return was.surely_better(now, SPOILED_NATS)

    kept = each(run, tracks, stays)
    turned_deg = 0.0 if all(kept.values()) else after.result.rotation_deg
    return {t: done if kept[t] else after for t, done in tracks.items()}, turned_deg


def own_misfits(run: Run, tracks: Mapping[int, Done], images: Mapping[int, Images]) -> dict[int, float]:
    """How badly each toss fits itself."""
    return each(run, tracks, lambda t: misfit(on_itself(run, tracks[t], images[t])))


def worst_first(misfits: Mapping[int, float]) -> list[tuple[int, ...]]:
    """The tosses by how badly they fit themselves, in folds: what fits worst is corrected first, on the shape of what
    fits better, and the next fold on the shape of what was corrected. (All at once would exchange the places of two
    tosses that lie wrongly to each other, and never join them.)"""
    order = sorted(misfits, key=lambda t: -misfits[t])
    return [tuple(int(t) for t in part) for part in np.array_split(order, min(FOLDS, len(order)))]


def chosen(run: Run, before: Done, known: TrackResult, shape: Done, images: Images, locate: bool) -> Done:
    """Of one toss: the track that it had (of which is `known` what it cost) or that refined on a shape, whichever fits
    itself better; or, where it is open and one may `locate` it, the object located anew on that, where its frames speak
    for this by more than chance: what they show together, what the shape shows of them, and what pairs of them have in
    common."""
    ways: dict[str, Callable[[], Done[TrackResult] | None]]
    ways = {"refined": lambda: track(run, images, shape, before=before)}
    ways |= {"anew": lambda: located_on(run, images, shape)} if locate and is_open(run, known) else {}
    tried = {way: done for way, done in each(run, ways, lambda way: ways[way]()).items() if done is not None}
    found: dict[str, Done] = {"before": before, **tried}
    seen = each(run, found, lambda way: on_itself(run, found[way], images))
    best = min((way for way in found if way != "anew"), key=lambda way: misfit(seen[way]))
    if "anew" not in found:
        return found[best]
    on_it = each(run, ("refined", "anew"), lambda way: on_shape(run, found[way], shape, images))
    costs = {"before": known.cost, **{way: done.result.cost for way, done in tried.items()}}
    anew = TrackResiduals(seen["anew"], costs["anew"], on_it["anew"])
    stays = TrackResiduals(seen[best], costs[best], on_it["refined"])  # on the shape it was not before it was refined
    return found["anew" if anew.surely_better(stays) else best]


def joins(
    run: Run, images: Images, alone: Done[TrackResult], anew: Done[TrackResult], explained: Callable[[], bool]
) -> bool:
    """Whether a toss comes to the others by the object located on their shape (`anew`): where its frames surely agree
    better with each other so than by its own track; or where that shape has `explained` them, and they do not fit far
    better (`FAR_BETTER`) by its own."""
    own, there = (TrackResiduals(on_itself(run, done, images), done.result.cost) for done in (alone, anew))
    return there.surely_better(own) or (not own.surely_better(there, FAR_BETTER) and explained())


@dataclass(frozen=True, eq=False)
class TrackResiduals:
    """What speaks for a track: how its frames agree with their own fusion, what their pairs cost (None: unknown), and
    how they agree with the shape of the others (None: it does not lie on that)."""

    own: Explained
    cost: float | None
    on_others: Explained | None = None

    def surely_better(self, other: TrackResiduals, least: float = SURE_NATS) -> bool:
        """Whether all of it together prefers this track by more than `least` nats."""
        judged = [(self.own, other.own)]
        if self.on_others is not None and other.on_others is not None:
            judged.append((self.on_others, other.on_others))
        gaps = [difference(*both, value) for both in judged for value in (misfit_of, chroma_of)]
        nats = [preferred(gap.mean, gap.error) for gap in gaps if gap.frames]
        if self.cost and other.cost:
            nats.append(preferred(float(np.log(other.cost / self.cost)), 0.0))
        return self.own.lost <= other.own.lost and sum(nats) > least


def preferred(gap: float, error: float) -> float:
    """Logarithm of the likelihood ratio that a gap between two residuals' logarithms (with its standard error) speaks
    with for the first (negative: against it), where gaps of `ALIKE` mean nothing."""
    return float(0.5 * np.sign(gap) * gap**2 / (error**2 + ALIKE**2))


def located_on(run: Run, images: Images, shape: Done) -> Done[TrackResult] | None:
    """One toss tracked on a shape from the start; None where the shape fits nothing that its first frame shows."""
    try:
        return track(run, images, shape)
    except BadInput:
        return None


def without(tracks: Mapping[int, Done], fold: Iterable[int]) -> dict[int, Done]:
    """The tracks of the other tosses."""
    return {t: done for t, done in tracks.items() if t not in fold}


def is_open(run: Run, result: TrackResult) -> bool:
    """Whether more frames than an impact blurs have no sure pose."""
    return result.interpolated + result.lost > run.config.track.hypotheses.impacts * result.frames


def on_itself(run: Run, done: Done, images: Images) -> Explained:
    """The residuals of a toss's raw images against their own fusion at a track's poses."""
    toss, own = images.toss, {images.toss: images}
    shape = fused(run, {toss: done}, own, draft=True)
    if shape is None:
        return Explained(np.zeros((0, 6)), 1)
    return residuals(judge(run, f"toss {toss} on itself", {toss: done}, {toss: shape}, own))


def on_shape(run: Run, done: Done, shape: Done, images: Images) -> Explained:
    """The residuals of a toss's raw images against a shape at a track's poses."""
    toss = images.toss
    return residuals(judge(run, f"toss {toss} on the others", {toss: done}, {toss: shape}, {toss: images}))


def misfit(seen: Explained) -> float:
    """How badly frames fit: the mean of their misfits, with that of frames without a pose at its worst."""
    each_frame = [misfit_of(row) for row in seen.rows] + [float(np.log(FAR_M))] * seen.lost
    return float(np.mean(each_frame)) if each_frame else float("inf")


def misfit_of(row: Float[Array, "6"]) -> float:
    """Of a frame: the logarithm of depth's residual (m) times the outline's (1 - IoU). Its colours are left out: a body
    that is thought not to turn keeps the shading that stays with the room."""
    return float(np.log(max(row[2], 1e-6)) + np.log(max(row[3], 1e-6)))


def chroma_of(row: Float[Array, "6"]) -> float:
    """Of a frame: the logarithm of the chromaticity's residual; NaN where too little of it has colours."""
    return float(np.log(max(row[5], 1e-6)))
