"""Parts of one stage: cut alike and in order whatever the threads, and threads only while a core is free for them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest

from processing.engine.parts import allow_threads, in_parts, side_by_side
from recordings.errors import BadInput


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """`threads(n)` for this test alone."""
    yield allow_threads
    allow_threads(1)


def test_parts_are_cut_alike_and_come_in_order_whatever_the_number_of_threads(
    threads: Callable[[int], None],
) -> None:
    def late(part: slice) -> tuple[int, int]:
        time.sleep(0.002 * (20 - part.start))
        return part.start, part.stop

    for count in (1, 3):
        threads(count)
        assert in_parts(late, 20, 8) == [(0, 8), (8, 16), (16, 20)]
        assert in_parts(late, 0, 8) == []


def test_what_fails_in_a_part_fails_as_it_would_alone(threads: Callable[[int], None]) -> None:
    def fails(part: slice) -> None:
        if part.start:
            raise BadInput("no depth here")

    for count in (1, 2):
        threads(count)
        with pytest.raises(BadInput, match="no depth here"):
            in_parts(fails, 3, 1)


def test_parts_take_threads_only_while_they_are_wanted(threads: Callable[..., None]) -> None:
    here, alone = threading.get_ident(), [True]
    threads(2, lambda: alone[0])
    assert here not in side_by_side(lambda _: threading.get_ident(), [1, 2, 3])
    alone[0] = False
    assert set(side_by_side(lambda _: threading.get_ident(), [1, 2, 3])) == {here}


def test_parts_of_a_part_wait_for_no_thread(threads: Callable[[int], None]) -> None:
    """All threads are busy with the outer parts; inner ones that waited for a thread would wait for ever."""
    threads(2)
    found = side_by_side(lambda n: list(side_by_side(lambda m: n * m, [1, 2, 3])), [1, 2, 3, 4])
    assert list(found) == [[n, 2 * n, 3 * n] for n in (1, 2, 3, 4)]
