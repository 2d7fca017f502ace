"""The splits never meet and never change; moves are recorded."""

import json
from itertools import product

import pytest
from variety import seeds
from variety.appearance import KINDS
from variety.shapes import FAMILIES
from variety.spec import draw

from recordings.errors import BadInput


@pytest.fixture
def ledger(tmp_path):
    path = tmp_path / "ledger.json"
    path.write_text('{"moves": []}')
    return path


def test_no_seed_is_in_both_splits_nor_twice_in_one():
    every = [c.seed for split in seeds.SPLITS for c in seeds.cases(split, 5000, ())]
    assert len(set(every)) == len(every)


def test_the_seeds_are_those_of_the_day_the_splits_were_made():
    # golden: sha256 of "tosslab variety SPLIT NUMBER FILLED", first 8 bytes; a change would mix the splits
    assert [c.seed for c in seeds.cases("choose", 2, ())] == [10556350932308443634, 17471118645110674290]
    assert [c.seed for c in seeds.cases("judge", 2, ())] == [12946788644345973731, 12254589879065039099]


def test_a_case_that_was_looked_into_becomes_a_choose_case_and_a_fresh_one_takes_its_place(ledger):
    before = seeds.cases("judge", 10, seeds.read_ledger(ledger))
    fresh = seeds.move("judge-007", "2026-11-22", "lost on steel", ledger)
    moves = seeds.read_ledger(ledger)
    judge, choose = seeds.cases("judge", 10, moves), seeds.cases("choose", 3, moves)
    assert judge[7] == fresh
    assert fresh.name == "judge-007-1"
    assert judge[:7] + judge[8:] == before[:7] + before[8:]
    assert choose[3] == before[7]
    assert choose[3].seed == before[7].seed
    assert not {c.seed for c in judge} & {c.seed for c in choose}


def test_a_moved_case_keeps_its_family(ledger):
    fresh = seeds.move("judge-007", "2026-11-22", "why", ledger)
    assert draw(fresh).family == draw(seeds.Case("judge", 7, 0)).family == FAMILIES[7]


@pytest.mark.parametrize("name", ["choose-007", "judge-7", "judge-007-1", "nonsense"])
def test_only_what_is_in_the_judge_split_now_can_move(ledger, name):
    with pytest.raises(BadInput, match="is no case of the judge split now"):
        seeds.move(name, "2026-11-22", "why", ledger)


def test_a_move_without_a_reason_is_refused_and_nothing_is_written(ledger):
    with pytest.raises(BadInput, match="--why TEXT"):
        seeds.move("judge-007", "2026-11-22", " ", ledger)
    assert json.loads(ledger.read_text()) == {"moves": []}


def test_the_recorded_ledger_can_be_read():
    assert isinstance(seeds.read_ledger(), tuple)


def test_the_same_case_is_the_same_session_and_fewer_tosses_change_nothing_else():
    case = seeds.Case("choose", 4, 0)
    assert draw(case) == draw(case)
    few = draw(case, 1)
    assert few.tosses == draw(case).tosses[:1]
    assert few.camera == draw(case).camera


def test_the_ranges_of_the_issue_are_kept_and_filled():
    specs = [draw(c) for c in seeds.cases("choose", 300, ())]
    assert {(s.family, s.surface) for s in specs} == set(product(FAMILIES, KINDS))
    for values, low, high in (
        ([s.friction for s in specs], 0.05, 0.8),
        ([s.restitution for s in specs], 0.0, 0.7),
        ([s.spin_rad_s for s in specs], 0.0, 25.0),
        ([s.camera.focal_px for s in specs], 380.0, 920.0),
        ([s.wrong.depth_scale for s in specs], 0.98, 1.02),
        ([s.wrong.camera_m for s in specs], 0.0, 0.008),
        ([s.wrong.depth_delay_s for s in specs], 0.0, 0.016),
    ):
        assert low <= min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < max(values) <= high
    assert {len(s.tosses) for s in specs} >= {1, 12}
    assert {s.camera.width for s in specs} == {424, 640, 848, 960, 1280}
    assert {s.engine for s in specs} == {"mujoco", "rigid"}
