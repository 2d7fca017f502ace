"""The object found again where following lost it, or took another thing for it, by what it looks like elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.foreground import Window, window_around
from processing.segment.background.placement import best_shift, shifted


@dataclass(frozen=True, eq=False)
class Judged:
    """A mask in one frame, how sure its border is (0..1), and which share of its pixels look like the object."""

    mask: Bool[Array, "h w"]
    sure: float
    support: float


@dataclass(frozen=True)
class AgainSettings:
    """When a mask is doubted, and how the object is looked for then."""

    doubted: float = 0.9
    """A mask is doubted whose support is less than this share of what is usual in its toss; so is an empty one, ..."""
    cut: float = 0.6
    """... and one smaller than this share of the object's area in the frames around, or larger by its inverse."""
    found: float = 0.6
    """The object is taken for found with this share of the usual support ..."""
    better: float = 0.05
    """... and so much more than the doubted mask has; so much less will do where the mask before
    was replaced, or this one is far too large."""
    other: float = 0.7
    """Two masks that agree less than this (intersection over union) are of different things."""
    most_missed: int = 2
    """The object is not looked for after more frames in which it was not found."""
    reach: float = 1.2
    """It is looked for so far around where it would be, in its sizes (the root of its area)."""


Odds = Callable[[int, Window], Float32[Array, "a b"]]
"""Of a frame's position and a window: log-odds of the object for each pixel."""
Draw = Callable[[int, Bool[Array, "h w"]], Judged | None]
"""Of a frame's position and a rough mask: the mask drawn."""


def support_of(odds: Float32[Array, "a b"], mask: Bool[Array, "a b"]) -> float:
    """The share of a mask's pixels that look like the object; 0 of an empty one."""
    return float((odds[mask] > 0).mean()) if mask.any() else 0.0


def overlap(one: Bool[Array, "h w"], other: Bool[Array, "h w"]) -> float:
    """Intersection over union."""
    return float((one & other).sum()) / max(float((one | other).sum()), 1.0)


def found_again(
    judged: Sequence[Judged], usual_px: Float[Array, " n"], fixed: Sequence[bool], odds_in: Odds, draw: Draw,
    s: AgainSettings,
) -> list[Judged]:  # fmt: skip
    """The masks of a toss, those that are doubted replaced where the object is found beside them: it is followed from
    the frames before, then from those after. `usual_px`: the object's area in the frames around each; `fixed` ones are
    never doubted."""
    found = list(judged)
    free = [i for i in range(len(found)) if not fixed[i]]
    usual = float(np.median([judged[i].support for i in free if judged[i].support > 0] or [0.0]))
    cut = {i for i in free if judged[i].mask.sum() < s.cut * usual_px[i]}
    large = {i for i in free if s.cut * judged[i].mask.sum() > usual_px[i]}
    doubted = cut | large | {i for i in free if judged[i].support < s.doubted * usual}
    for order in (range(len(found)), range(len(found) - 1, -1, -1)):
        known: list[int] = []
        replaced = -9
        for i in order:
            if i in doubted and known and abs(i - known[-1]) <= s.most_missed + 1:
                seen = _followed(found, known, i, odds_in, draw, s)
                if seen is not None and _better(
                    seen, found[i], usual, known[-1] == replaced or i in large, i in cut, s
                ):
                    doubted.discard(i)  # found where it was, else elsewhere
                    if overlap(seen.mask, found[i].mask) < s.other:
                        found[i], replaced = seen, i
            if i not in doubted:
                known.append(i)
    return found


def _better(new: Judged, old: Judged, usual: float, wrong: bool, cut: bool, s: AgainSettings) -> bool:
    """Whether a place of the object is rather believed than the doubted mask. `wrong`: the mask before was replaced, or
    this one is far too large; `cut`: it is a part only, which looks like the object as its whole does."""
    if cut and old.mask.any() and (new.mask & old.mask).sum() > (1 - s.cut / 2) * old.mask.sum():
        return bool(new.support >= s.doubted * usual and new.mask.sum() > old.mask.sum())
    return new.support >= max(s.found * usual, old.support + (-s.better if wrong else s.better))


def _followed(
    found: Sequence[Judged], known: Sequence[int], i: int, odds_in: Odds, draw: Draw, s: AgainSettings
) -> Judged | None:
    """Where the last mask lies best on what looks like the object, drawn there."""
    last, steps = found[known[-1]].mask, abs(i - known[-1])
    reach = int(s.reach * np.sqrt(float(last.sum()))) * steps + 4
    velocity = np.zeros(2) if len(known) < 2 else _way(found, known[-2], known[-1])
    onward = shifted(last, velocity * steps)
    at = window_around(onward | last, reach)
    if at is None:
        return None
    score = np.zeros(last.shape, np.float32)
    score[at] = 1 / (1 + np.exp(-odds_in(i, at)))
    return draw(i, shifted(last, best_shift(score, last, velocity, steps, reach)))


def _way(found: Sequence[Judged], before: int, last: int) -> Float[Array, "2"]:
    """How far (x, y, px) the object went a frame between two of them."""
    a, b = (np.array(np.nonzero(found[i].mask)).mean(1)[::-1] for i in (before, last))
    return np.asarray((b - a) / abs(last - before))
