"""Developers' programs follow the house: nobody type-checks them, and some run only once in an issue."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"
HOUSE = {"acquisition", "calibration", "groundtruth", "processing", "recordings"}


def taken_from_the_house(path: Path) -> Iterator[tuple[str, str]]:
    """(module, name) of every import, also of those inside functions."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in HOUSE:
            yield from ((node.module, alias.name) for alias in node.names)


@pytest.mark.parametrize("path", sorted(TOOLS.rglob("*.py")), ids=lambda p: str(p.relative_to(TOOLS)))
def test_every_name_that_a_tool_takes_from_the_house_is_there(path: Path) -> None:
    for module, name in taken_from_the_house(path):
        if not hasattr(import_module(module), name):
            import_module(f"{module}.{name}")
