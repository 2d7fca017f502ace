"""A notice is stored and read as it is, printed by weight and once, and speaks no word of the program's own."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import processing
from recordings.notices import Notice, in_order, said_of

LOW = Notice("rollout", "low", "no rollouts")
HIGH = Notice("register", "high", "tosses [1] are lost", "look at them", "likely")
INTERNAL = r"\b(story|stories|turn table|joined|key|keys|beam|transitions?|inner problems?|prior|kernel|stage)\b"


def test_a_notice_comes_back_from_json_as_it_was() -> None:
    assert Notice.from_json(HIGH.to_json()) == HIGH


def test_a_sentence_of_an_older_result_is_read_as_a_notice() -> None:
    assert Notice.from_json("toss 2 is lost").text == "toss 2 is lost"


def test_a_notice_says_what_was_seen_how_sure_and_what_to_do() -> None:
    assert HIGH.text == "tosses [1] are lost (likely); look at them"
    assert LOW.text == "no rollouts"


def test_notices_are_ordered_by_weight_and_each_is_there_once() -> None:
    medium = Notice("masks", "medium", "dark")
    assert in_order([LOW, medium, HIGH, LOW, medium]) == (HIGH, medium, LOW)


def test_what_is_said_of_several_is_said_once_with_their_names() -> None:
    said = said_of([("a", LOW), ("a", HIGH), ("b", LOW), ("a", LOW)], "every session", 2)
    assert said == ["a: tosses [1] are lost (likely); look at them", "every session: no rollouts"]


def test_no_notice_holds_an_internal_word() -> None:
    found = [text for path in Path(processing.__file__).parent.rglob("*.py") for text in _sentences(path)]
    assert len(found) > 20
    assert [t for t in found if re.search(INTERNAL, t)] == []


def _sentences(path: Path) -> list[str]:
    """The literal text of every function that makes a notice, docstrings and the notice's stage left out."""
    out = []
    for function in (n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)):
        calls = [c for c in ast.walk(function) if isinstance(c, ast.Call) and getattr(c.func, "id", "") == "Notice"]
        spoken = {"seen", "do"}
        parts = [a for c in calls for a in c.args[2:]]
        parts += [n.value for n in ast.walk(function) if calls and isinstance(n, ast.Assign)
                  and any(getattr(t, "id", "") in spoken for t in n.targets)]  # fmt: skip
        out += [s.value for p in parts for s in ast.walk(p)
                if isinstance(s, ast.Constant) and isinstance(s.value, str) and " " in s.value]  # fmt: skip
    return out
