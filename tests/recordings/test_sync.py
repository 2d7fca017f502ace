"""Pairing of streams, periods, gaps."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from recordings import sync

TIMES = st.lists(st.integers(0, 10**10), max_size=30, unique=True).map(lambda t: np.array(t, dtype=np.int64))


@given(TIMES, TIMES, st.integers(0, 10**9))
def test_every_other_is_used_once_and_lies_near_enough(times_ns, others_ns, most_ns):
    pairs = sync.pair_nearest(times_ns, others_ns, most_ns)
    used = pairs[pairs != sync.UNPAIRED]
    assert len(pairs) == len(times_ns)
    assert len(set(used.tolist())) == len(used)
    assert (np.abs(times_ns[pairs != sync.UNPAIRED] - others_ns[used]) <= most_ns).all()


@given(TIMES.filter(len), st.integers(-1000, 1000))
def test_a_shift_smaller_than_half_a_step_changes_nothing(times_ns, shift_ns):
    times_ns = np.unique(times_ns // 10_000) * 10_000
    shuffled = np.random.default_rng(0).permutation(len(times_ns))
    pairs = sync.pair_nearest(times_ns, (times_ns + shift_ns)[shuffled], 2000)
    np.testing.assert_array_equal(shuffled[pairs], np.arange(len(times_ns)))


def test_the_nearer_of_two_gets_it_and_the_other_stays_alone():
    pairs = sync.pair_nearest(np.array([0, 10]), np.array([8]), 100)
    np.testing.assert_array_equal(pairs, [sync.UNPAIRED, 0])


def test_a_missing_depth_image_leaves_its_colour_alone_and_the_others_paired():
    color_ns = np.arange(5) * 33_000_000
    depth_ns = np.delete(color_ns, 2) + 5_000_000
    np.testing.assert_array_equal(sync.pair_nearest(color_ns, depth_ns, 20_000_000), [0, 1, sync.UNPAIRED, 2, 3])


def test_gaps_are_counted_in_missing_frames():
    times_ns = np.delete(np.arange(20) * 100, [5, 6, 11])
    assert sync.frame_period_ns(times_ns) == 100
    assert sync.gaps(times_ns, 100) == [(4, 2), (8, 1)]
    assert sync.frame_period_ns(times_ns[:1]) is None
