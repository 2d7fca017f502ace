"""The object found again where following lost it, or took another thing for it, by what it looks like elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
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
    found: float = 0.5
    """The object is taken for found with this share of the usual support."""
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
    """The masks of a toss, those that are doubted replaced where the object is found beside them: a stretch of them is
    followed from the frames before it, then from those after, and what is believed of it is decided once, for all of
    its frames. `usual_px`: the object's area in the frames around each; `fixed` ones are never doubted."""
    found = list(judged)
    free = [i for i in range(len(found)) if not fixed[i]]
    usual = float(np.median([judged[i].support for i in free if judged[i].support > 0] or [0.0]))
    odd = {i for i in free if _alike(judged[i], usual_px[i]) < s.cut}
    doubted = odd | {i for i in free if judged[i].support < s.doubted * usual}
    for order in (range(len(found)), range(len(found) - 1, -1, -1)):
        for known, stretch in _stretches(order, set(doubted)):
            path = _followed(found, known, stretch, s.found * usual, odds_in, draw, s)
            new, old = (sum(j[i].support * _alike(j[i], usual_px[i]) for i in path) for j in (path, found))
            if new >= old:
                doubted -= path.keys()
                found = [path.get(i, j) for i, j in enumerate(found)]
    return found


def _alike(seen: Judged, usual_px: float) -> float:
    """How alike (0..1) a mask's area is to what is usual."""
    ratio = float(seen.mask.sum()) / max(usual_px, 1.0)
    return min(ratio, 1 / ratio) if ratio > 0 else 0.0


def _stretches(order: Sequence[int], doubted: set[int]) -> Iterator[tuple[list[int], list[int]]]:
    """Doubted frames in a row, and the last two before them that are not doubted."""
    known: list[int] = []
    stretch: list[int] = []
    for i in (*order, None):
        if i in doubted:
            stretch.append(i)
            continue
        if stretch and known:
            yield known[-2:], stretch
        stretch = []
        known += [] if i is None else [i]


def _followed(
    found: Sequence[Judged], known: Sequence[int], stretch: Sequence[int], least: float, odds_in: Odds, draw: Draw,
    s: AgainSettings,
) -> dict[int, Judged]:  # fmt: skip
    """The object followed through a stretch, where it is found: as the mask was that it is found in."""
    path = {i: found[i] for i in known}
    for i in stretch:
        steps = abs(i - [*path][-1])
        if steps > s.most_missed + 1:
            break
        seen = _placed(path, i, steps, odds_in, draw, s)
        if seen is not None and seen.support >= least:
            path[i] = seen if overlap(seen.mask, found[i].mask) < s.other else found[i]
    return {i: seen for i, seen in path.items() if i not in known}


def _placed(
    path: Mapping[int, Judged], i: int, steps: int, odds_in: Odds, draw: Draw, s: AgainSettings
) -> Judged | None:
    """Where the last mask lies best on what looks like the object, drawn there."""
    *before, last = path
    mask = path[last].mask
    reach = int(s.reach * np.sqrt(float(mask.sum()))) * steps + 4
    velocity = np.zeros(2) if not before else _way(path, before[-1], last)
    at = window_around(shifted(mask, velocity * steps) | mask, reach)
    if at is None:
        return None
    score = np.zeros(mask.shape, np.float32)
    score[at] = 1 / (1 + np.exp(-odds_in(i, at)))
    return draw(i, shifted(mask, best_shift(score, mask, velocity, steps, reach)))


def _way(path: Mapping[int, Judged], before: int, last: int) -> Float[Array, "2"]:
    """How far (x, y, px) the object went a frame between two of them."""
    a, b = (np.array(np.nonzero(path[i].mask)).mean(1)[::-1] for i in (before, last))
    return np.asarray((b - a) / abs(last - before))
