"""Names in the packages are the field's words; what they replaced does not come back."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("acquisition", "calibration", "groundtruth", "processing", "recordings")
REPLACED = {
    "sighting": "detection",
    "evidence": "appearance likelihood ratio, residual",
    "opposed": "free-space and silhouette consistency",
    "contradiction": "free-space and silhouette consistency, inconsistent poses",
    "footing": "support plane",
    "badness": "severity, cost",
    "witness": "refinement by the D455's own tags",
    "believed": "calibrated, prior",
    "raypool": "ray dataset",
    "course": "trajectory",
    "lane": "stream queue, slot",
    "story": "summary, trajectory hypothesis",
    "told": "reported, measured, information",
    "tell": "report",
    "heard": "compared",
    "settled": "selected, without outliers",
    "middle": "center, centroid, median",
    "beside": "neighbour, sidecar, prior",
    "doubt": "uncertainty",
    "price": "cost",
    "grow": "extend (a tree), incremental initialisation",
}
FILE = re.compile(r"\w+\.(json|npz|npy|ply)")
ALLOWED = {
    "MIDDLE_GREY": "a word of photography",
    "beside_px": "a setting, and settings are in the keys of stored stages",
    "beside_m": "a setting",
    "middle_sigmas": "a setting",
}


def words(name: str) -> set[str]:
    """The words of an identifier in snake or camel case, and the whole of it, in lower case."""
    parts = re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)
    return {part.lower().removesuffix("s") for part in parts} | {name.lower().removesuffix("s")}


def names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """What others see of a module: functions, their parameters, classes, their fields, constants, keys of documents."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.lineno, node.name
        if isinstance(node, ast.arg):
            yield node.lineno, node.arg
        if isinstance(node, ast.Dict):
            yield from ((k.lineno, k.value) for k in node.keys if isinstance(k, ast.Constant) and is_word(k.value))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and FILE.fullmatch(node.value):
            yield node.lineno, node.value
        if isinstance(node, ast.Module | ast.ClassDef):
            targets = [t for s in node.body if isinstance(s, ast.Assign | ast.AnnAssign) for t in targets_of(s)]
            yield from ((t.lineno, t.id) for t in targets if isinstance(t, ast.Name))


def is_word(value: object) -> bool:
    return isinstance(value, str) and value.isidentifier()


def targets_of(statement: ast.Assign | ast.AnnAssign) -> list[ast.expr]:
    """The names that it gives a value, one by one."""
    targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
    return [name for t in targets for name in (t.elts if isinstance(t, ast.Tuple) else [t])]


def test_functions_parameters_classes_fields_constants_and_keys_are_named_by_the_words_of_the_field():
    found = []
    for path in (p for package in PACKAGES for p in (ROOT / package).rglob("*.py")):
        for line, name in names(ast.parse(path.read_text())):
            found += [
                (f"{path}:{line}", name, REPLACED[w]) for w in words(name) & REPLACED.keys() if name not in ALLOWED
            ]
    assert not found
