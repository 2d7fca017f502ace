"""The table's rows are the paper's; what is not there yet is refused by its name."""

from __future__ import annotations

import pytest

from processing.variants import TABLE, available, default_name, find_variant, needs
from recordings.errors import BadInput


def test_the_table_has_the_papers_six_rows_with_the_papers_figures() -> None:
    assert [v.name for v in TABLE] == ["bundlesdf-1", "bundlesdf-10", "no-cycle", "no-contact", "no-icp", "ours"]
    assert TABLE[-1].paper == (69.50, 68.40, 49.86, 0.18)
    assert [v.contact for v in TABLE] == [False, False, True, False, True, True]
    assert [v.icp for v in TABLE] == [False, False, False, True, False, True]
    assert [v.cycle for v in TABLE] == [False, False, False, True, True, True]


def test_a_row_needs_what_its_flags_say() -> None:
    assert needs(TABLE[0]) == ("first pass on one toss",)
    assert len(needs(TABLE[-1])) == 5


def test_the_default_is_a_row_that_exists() -> None:
    assert default_name() in available()
    assert find_variant(default_name()).name == default_name()


@pytest.mark.parametrize("name", [v.name for v in TABLE if v.name not in available()] + ["joint", "converged", "table"])
def test_a_row_without_its_stages_is_refused_by_name(name: str) -> None:
    with pytest.raises(BadInput, match=f"{name} needs .* not there yet; available: .*bundlesdf-1"):
        find_variant(name)


def test_an_unknown_name_says_what_there_is() -> None:
    with pytest.raises(BadInput, match="no variant 'bundlesdf'; available: .*bundlesdf-1"):
        find_variant("bundlesdf")
