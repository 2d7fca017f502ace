"""The table's rows are the paper's, and a name gives the rows that it stands for."""

from __future__ import annotations

import pytest

from processing.variants import BEYOND, DEFAULT, TABLE, find_variant, rows_of
from recordings.errors import BadInput


def test_the_table_has_the_papers_six_rows_with_the_papers_figures() -> None:
    assert [v.name for v in TABLE] == ["bundlesdf-1", "bundlesdf-10", "no-cycle", "no-contact", "no-icp", "ours"]
    assert TABLE[-1].paper == (69.50, 68.40, 49.86, 0.18)
    assert [v.contact for v in TABLE] == [False, False, True, False, True, True]
    assert [v.icp for v in TABLE] == [False, False, False, True, False, True]
    assert [v.refined for v in TABLE] == [None, None, "contact", "cycle", "cycle", "cycle"]


def test_a_name_is_one_row_in_the_scope_asked_for() -> None:
    assert rows_of(DEFAULT, "all") == [(find_variant("ours"), "all")]
    assert rows_of("no-icp", "one") == [(find_variant("no-icp"), "one")]


def test_the_whole_table_has_both_scopes_and_what_lies_beyond_in_one() -> None:
    rows = [(v.name, s) for v, s in rows_of("table", "one")]
    assert rows == [*((v.name, s) for s in ("one", "all") for v in TABLE), ("converged", "all"), ("joint", "all")]


@pytest.mark.parametrize("name", [v.name for v in BEYOND])
def test_what_needs_all_tosses_is_refused_for_one(name: str) -> None:
    with pytest.raises(BadInput, match="over all tosses only"):
        rows_of(name, "one")


def test_an_unknown_name_says_what_there_is() -> None:
    with pytest.raises(BadInput, match="no variant 'bundlesdf'; available: .*bundlesdf-1"):
        find_variant("bundlesdf")
