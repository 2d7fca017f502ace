"""Candidates of successive frames joined to tracklets: things that move through a toss, and which is the object.

The object is what flies: its center falls freely, apart from robot and hands, above the table. Where several tosses are
there, its appearance is alike and it is about as large in all of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.segment.detect.candidates import Candidate
from recordings.constants import GRAVITY_M_S2


@dataclass(frozen=True)
class TrackletSettings:
    """How candidates are joined, and what speaks for a tracklet."""

    reach_m: float = 0.06
    """A thing may depart from its predicted place by so much, and by `gate_m_s` times the time passed."""
    gate_m_s: float = 1.5
    first_m_s: float = 3.0
    """A thing seen once has moved no faster than this."""
    longest_gap_s: float = 0.2
    most_change: float = 2.2
    """Ratio of its sizes (metres) in two frames."""
    least_likeness: float = 0.35
    """Overlap of its colours in two frames."""
    least_seen: int = 3
    """A tracklet of fewer frames is noise."""
    flight_s: float = 0.13
    """The least time over which a fall is recognised."""
    flight_sigma_m_s2: float = 2.0
    """How near to gravity the acceleration must be."""
    flight_rms_m: float = 0.012
    """How well a parabola must describe the center's way; what is seen of a turning thing shifts it."""
    flight_bow: float = 0.2
    """The same as a share of the parabola's own bow."""
    flight_m_s: float = 0.4
    """A thing in flight is at least this fast."""
    weight_flight: float = 3.0
    weight_moved: float = 1.0
    weight_free: float = 1.0
    weight_long: float = 0.5
    weight_alike: float = 2.0
    least_score: float = 2.0
    """What speaks less for itself is not taken for the object."""
    sure_fall: float = 0.5
    margin: float = 1.0
    """What does not fall as clearly as this must be distinguished from any other thing by such a difference of scores:
    between things that merely move, nothing decides which is meant."""
    another: float = 0.3
    """Less alike (-1..1) is another thing."""


@dataclass(frozen=True, eq=False)
class Tracklet:
    """One thing through a toss. `fall`: how clearly a stretch of it (`fall_span`: its first and last frame) is a free
    flight, 0..1; `moved_m`: how far it came."""

    seen: tuple[Candidate, ...]
    fall: float = 0.0
    fall_span: tuple[int, int] = (0, 0)
    moved_m: float = 0.0

    @property
    def size_m(self) -> float:
        return float(np.median([c.size_m for c in self.seen]))

    @property
    def free(self) -> float:
        return float(np.mean([c.free for c in self.seen]))

    @property
    def shares(self) -> Float[Array, " n"]:
        """How often each colour is seen on it, over its frames."""
        clear = [c for c in self.seen if c.free > 0.5] or list(self.seen)
        return np.asarray(np.mean([c.shares for c in clear], axis=0))


def likeness(a: Float[Array, " n"], b: Float[Array, " b"]) -> float:
    """Overlap of two colour distributions (Bhattacharyya), 0..1."""
    return float(np.sqrt(a * b).sum())


def join(
    things: Sequence[Sequence[Candidate]], gravity: Float[Array, "3"] | None, s: TrackletSettings, gap_s: float = 1.0
) -> list[Tracklet]:
    """Tracklets through a toss's frames in time order. `gravity`: its direction in the camera frame, where known;
    `gap_s`: the longest time between two frames of a free fall."""
    going: list[list[Candidate]] = []
    ended: list[list[Candidate]] = []
    for here in things:
        if not here:
            continue
        now = here[0].time_s
        ended += [c for c in going if now - c[-1].time_s > s.longest_gap_s]
        going = [c for c in going if now - c[-1].time_s <= s.longest_gap_s]
        pairs = [(_apart(c, thing, s), i, k) for i, c in enumerate(going) for k, thing in enumerate(here)]
        free_tracklets, free_things = set(range(len(going))), set(range(len(here)))
        for cost, i, k in sorted(pairs):
            if cost < 1 and i in free_tracklets and k in free_things:
                going[i].append(here[k])
                free_tracklets.discard(i)
                free_things.discard(k)
        going += [[here[k]] for k in sorted(free_things)]
    return [_judged(c, gravity, s, gap_s) for c in ended + going if len(c) >= s.least_seen]


def _apart(tracklet: Sequence[Candidate], thing: Candidate, s: TrackletSettings) -> float:
    """Cost of a thing as the continuation of a tracklet; 1 or more: none."""
    last = tracklet[-1]
    passed = thing.time_s - last.time_s
    ratio = max(last.size_m, thing.size_m) / max(min(last.size_m, thing.size_m), 1e-6)
    alike = likeness(last.shares, thing.shares)
    if passed <= 0 or ratio > s.most_change or alike < s.least_likeness:
        return 1.0
    expected, gate = last.center_m, s.reach_m + s.first_m_s * passed
    if len(tracklet) > 1 and last.time_s - tracklet[-2].time_s < s.longest_gap_s:
        velocity = (last.center_m - tracklet[-2].center_m) / (last.time_s - tracklet[-2].time_s)
        expected, gate = last.center_m + velocity * passed, s.reach_m + s.gate_m_s * passed
    near = float(np.linalg.norm(thing.center_m - expected)) / gate
    if near >= 1:
        return 1.0
    return near * 0.6 + 0.2 * (1 - alike) + 0.2 * (ratio - 1) / (s.most_change - 1)


def _judged(seen: Sequence[Candidate], gravity: Array | None, s: TrackletSettings, gap_s: float) -> Tracklet:
    places = np.array([c.center_m for c in seen])
    moved = float(np.linalg.norm(places - np.median(places, axis=0), axis=1).max())
    return Tracklet(tuple(seen), *free_fall(seen, gravity, s, gap_s), moved)


def free_fall(
    seen: Sequence[Candidate], gravity: Float[Array, "3"] | None, s: TrackletSettings, gap_s: float = 1.0
) -> tuple[float, tuple[int, int]]:
    """How clearly a stretch of the tracklet is a free fall: 0 (none) to 1 (twice the least time, or longer); and its
    first and last frame."""
    best, span = 0.0, (0, 0)
    times = np.array([c.time_s for c in seen])
    places = np.array([c.center_m for c in seen])
    whole = np.array([c.free > 0 for c in seen])
    near = np.diff(times, prepend=times[0]) <= gap_s
    for i in range(len(seen) - 3):
        for j in range(i + 4, len(seen) + 1):
            if not whole[i:j].all() or not near[i + 1 : j].all() or times[j - 1] - times[i] > 0.5:
                break
            if times[j - 1] - times[i] >= s.flight_s:
                found = _falls(times[i:j], places[i:j], gravity, s)
                if found > best:
                    best, span = found, (seen[i].position, seen[j - 1].position)
    return best, span


def _falls(times: Float[Array, " n"], places: Float[Array, "n 3"], gravity: Array | None, s: TrackletSettings) -> float:
    t = times - times.mean()
    terms = np.stack([np.ones_like(t), t, 0.5 * t * t], axis=1)
    found, *_ = np.linalg.lstsq(terms, places, rcond=None)
    rms = float(np.sqrt(((terms @ found - places) ** 2).sum() / (len(t) - terms.shape[1])))
    speed = float(np.linalg.norm(found[1] + found[2] * t[:, None], axis=1).max())
    length = float(np.linalg.norm(found[2]))
    wrong = abs(length - GRAVITY_M_S2) if gravity is None else float(np.linalg.norm(found[2] - GRAVITY_M_S2 * gravity))
    bow_m = GRAVITY_M_S2 * (times[-1] - times[0]) ** 2 / 8  # how far the parabola departs from its chord
    if speed < s.flight_m_s or rms > min(s.flight_rms_m, s.flight_bow * bow_m):
        return 0.0
    span = min(1.0, 0.5 * (times[-1] - times[0]) / s.flight_s)
    return float(span * np.exp(-0.5 * (wrong / s.flight_sigma_m_s2) ** 2))


def own_score(tracklet: Tracklet, s: TrackletSettings) -> float:
    """What speaks for a tracklet being the tossed object, by itself."""
    moved = min(1.0, tracklet.moved_m / 0.15)
    lasts = min(1.0, (tracklet.seen[-1].time_s - tracklet.seen[0].time_s) / 0.4)
    free = float(np.mean(sorted((c.free for c in tracklet.seen), reverse=True)[: max(3, len(tracklet.seen) // 2)]))
    return s.weight_flight * tracklet.fall + s.weight_moved * moved + s.weight_free * free + s.weight_long * lasts


@dataclass(frozen=True, eq=False)
class Appearance:
    """The object's appearance: its colours, and the root of its visible area in metres."""

    shares: Float[Array, " n"]
    size_m: float


def alike(tracklet: Tracklet, appearance: Appearance) -> float:
    """Likeness of a tracklet to something known: -1 (another thing) to 1."""
    ratio = abs(np.log(tracklet.size_m / max(appearance.size_m, 1e-6)))
    return float(np.clip(2 * likeness(tracklet.shares, appearance.shares) - 0.7 - max(0.0, ratio - 0.25), -1, 1))


def choose(
    tracklets: Mapping[int, Sequence[Tracklet]], known: Appearance | None, s: TrackletSettings
) -> dict[int, tuple[Tracklet, float]]:
    """Each toss's tracklet that is the object, and its score; tosses in which nothing speaks for itself are left out.

    Every tracklet that may be the object is tried as the reference that the others must be like; the one that explains
    all tosses best is taken.
    """
    own = {(t, i): own_score(c, s) for t, cs in tracklets.items() for i, c in enumerate(cs)}
    if known is not None:
        return _with_reference(tracklets, own, known, None, s)
    best: dict[int, tuple[Tracklet, float]] = {}
    for (t, i), score in sorted(own.items(), key=lambda item: -item[1])[:12]:
        if score < s.least_score:
            break
        tracklet = tracklets[t][i]
        found = _with_reference(tracklets, own, Appearance(tracklet.shares, tracklet.size_m), t, s)
        if sum(v for _, v in found.values()) > sum(v for _, v in best.values()):
            best = found
    return best


def _with_reference(
    tracklets: Mapping[int, Sequence[Tracklet]],
    own: Mapping[tuple[int, int], float],
    appearance: Appearance,
    of_toss: int | None,
    s: TrackletSettings,
) -> dict[int, tuple[Tracklet, float]]:
    """Each toss's best tracklet by its own score and its appearance. `of_toss`: where the appearance is from: it proves
    nothing there."""
    found = {}
    for t, cs in tracklets.items():
        scored = [(own[t, i] + s.weight_alike * alike(c, appearance), i) for i, c in enumerate(cs)]
        if not scored or max(scored)[0] < s.least_score:
            continue
        score, i = max(scored)
        unbiased = [own[t, k] if t == of_toss else v for v, k in scored]
        mine = Appearance(cs[i].shares, cs[i].size_m)
        rival = max((unbiased[k] for k, c in enumerate(cs) if alike(c, mine) < s.another), default=0.0)
        if cs[i].fall >= s.sure_fall or unbiased[i] - rival >= s.margin:
            found[t] = (cs[i], score)
    return found
