"""Which messages of several topics belong together: those of equal stamps, or those nearest to one another.

The approximate rule is that of ROS's message_filters (ApproximateTime): sets do not cross, no message is in two sets,
of the sets that share a pivot (the latest first message of all topics) the shortest in time is taken.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

StampSet = Mapping[str, int]
"""One stamp (ns) per topic."""
AGE_PENALTY = 0.1
"""A later set must be shorter by this share: message_filters' default."""


def exact_sets(stamps: Mapping[str, Sequence[int]]) -> list[StampSet]:
    """Stamps that every topic has."""
    common = set.intersection(*(set(s) for s in stamps.values())) if stamps else set()
    return [dict.fromkeys(stamps, stamp) for stamp in sorted(common)]


def approximate_sets(stamps: Mapping[str, Sequence[int]]) -> list[StampSet]:
    """Sets of nearest stamps, one of each topic, in time order."""
    queues = {topic: sorted(set(s)) for topic, s in stamps.items()}
    first = dict.fromkeys(queues, 0)
    found: list[StampSet] = []
    while all(first[t] < len(queues[t]) for t in queues):
        best = _best_set(queues, first)
        if best is None:
            break
        found.append({t: queues[t][i] for t, i in best.items()})
        first = {t: i + 1 for t, i in best.items()}
    return found


def _best_set(queues: Mapping[str, Sequence[int]], first: Mapping[str, int]) -> Mapping[str, int] | None:
    """Positions of the shortest set that still holds the pivot, advancing the earliest message of a set each time.
    None where the recording ends before that is known: message_filters would still be waiting."""
    here = dict(first)
    best, best_start, best_end = dict(here), *_span(queues, here)
    pivot_topic = max(queues, key=lambda t: queues[t][here[t]])
    pivot = queues[pivot_topic][here[pivot_topic]]
    while (best_end - best_start) > 0:
        earliest = min(queues, key=lambda t: queues[t][here[t]])
        if earliest == pivot_topic:
            return best
        if here[earliest] + 1 >= len(queues[earliest]):
            return None
        here[earliest] += 1
        start, end = _span(queues, here)
        if (end - best_end) * (1 + AGE_PENALTY) < start - best_start:
            best, best_start, best_end = dict(here), start, end
        if (end - best_end) * (1 + AGE_PENALTY) >= pivot - best_start:
            return best  # nothing later can be better
    return best


def _span(queues: Mapping[str, Sequence[int]], here: Mapping[str, int]) -> tuple[int, int]:
    times = [queues[t][i] for t, i in here.items()]
    return min(times), max(times)
