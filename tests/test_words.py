"""Names in the packages are the field's words; what they replaced does not come back."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("acquisition", "calibration", "groundtruth", "processing", "recordings")
REPLACED = {
    "sighting": "detection",
    "footing": "support plane",
    "badness": "severity, cost",
    "witness": "refinement by the D455's own tags",
    "believed": "calibrated, prior",
    "raypool": "ray dataset",
    "course": "trajectory",
    "lane": "stream queue",
}


def words(name: str) -> set[str]:
    """The words of an identifier in snake or camel case, and the whole of it, in lower case."""
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)
    return {part.lower().removesuffix("s") for part in parts} | {name.lower().removesuffix("s")}


def test_functions_and_classes_are_named_by_the_words_of_the_field():
    found = []
    for path in (p for package in PACKAGES for p in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                found += [(f"{path}:{node.lineno}", node.name, REPLACED[w]) for w in words(node.name) & REPLACED.keys()]
    assert not found
