"""Checks all that `make check` promises: style, types, the house's walls, the size of files, no names of machines.

python tools/check.py           # all
python tools/check.py walls     # one of: style format types walls circles stages house
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
MOST_LINES = 400
MOST_FUNCTION_LINES = 80
MOST_FILES = 20
LEAST_DOCUMENTED = 0.95
PACKAGES = ("acquisition", "calibration", "groundtruth", "processing", "recordings")
REASON = "# long because:"
GENERATED = re.compile(r"_pb2\.pyi?$")
# Written in pieces, so that this file does not find itself.
MACHINE_PATH = re.compile("(?<![\\w./~-])/(" + "|".join(("work", "root", "home", "tmp", "opt")) + ")/")
HOSTS = re.compile(
    "|".join(("pypi" + r"\.org", "python" + "hosted", "pytorch" + r"\.org", "npm" + "js", "debian" + r"\.org")), re.I
)


def tool(*command: str) -> Callable[[], Iterator[str]]:
    def run() -> Iterator[str]:
        done = subprocess.run([str(BIN / command[0]), *command[1:]], cwd=ROOT, capture_output=True, text=True)
        if done.returncode:
            yield from (line for line in (done.stdout + done.stderr).splitlines() if line and ": note: " not in line)

    return run


def our_files() -> list[Path]:
    """Tracked files and new ones that git does not ignore."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return sorted(ROOT / name for name in set(listed.split("\0")) if name and (ROOT / name).is_file())


def house() -> Iterator[str]:
    """The laws that no tool knows."""
    for path in our_files():
        name = path.relative_to(ROOT).as_posix()
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            continue  # pictures, recordings
        yield from hidden_machines(name, text)
        if path.suffix == ".py" and not GENERATED.search(name):
            yield from too_long(name, text)
        if name.startswith("tests/") and path.name == "__init__.py":
            yield f"{name}: no __init__.py under tests/ (pytest imports by path)"
    yield from full_folders()
    yield from undocumented()


def modules() -> Iterator[Path]:
    """Python files of the packages."""
    for path in our_files():
        name = path.relative_to(ROOT).as_posix()
        if path.suffix == ".py" and name.split("/")[0] in PACKAGES and not GENERATED.search(name):
            yield path


def full_folders() -> Iterator[str]:
    """Folders of the packages with too many files to be taken in at a glance."""
    count = Counter(path.parent for path in modules() if path.name != "__init__.py")
    for folder, files in sorted(count.items()):
        if files > MOST_FILES:
            yield f"{folder.relative_to(ROOT)}: {files} files, wanted at most {MOST_FILES}; make a folder of some"


def undocumented() -> Iterator[str]:
    """Public functions and classes of processing without a docstring, where they are too many."""
    bare, count = [], 0
    for path in (p for p in modules() if p.relative_to(ROOT).parts[0] == "processing"):
        for node in ast.parse(path.read_text()).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                count += 1
                if ast.get_docstring(node) is None:
                    bare.append(f"{path.relative_to(ROOT)}:{node.lineno}: {node.name} has no docstring")
    if len(bare) > (1 - LEAST_DOCUMENTED) * count:
        yield f"processing: {count - len(bare)} of {count} public names have a docstring, wanted {LEAST_DOCUMENTED:.0%}"
        yield from bare


def circles() -> Iterator[str]:
    """Modules that import each other, at whatever depth; imports for type checking and within functions count."""
    names = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in modules()}
    graph: dict[str, set[str]] = {}
    for name, path in names.items():
        found: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{a.name}" for a in node.names)}
            elif isinstance(node, ast.Import):
                found |= {a.name for a in node.names}
        graph[name] = (found & names.keys()) - {name}
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as circle:
        yield f"an import circle: {' -> '.join(reversed(circle.args[1]))}"


def stages() -> Iterator[str]:
    """A stage is one verb in one file of processing/stages/ (`floor`, which knows the truth, in evaluate/) with one
    VERSION; the file bears its name; and no stage calls another one: the order is the pipeline's."""
    folder, files = ROOT / "processing" / "stages", [p for p in modules() if "processing" in p.parts]
    verbs: dict[str, set[str]] = {}
    for path in files:
        place, tree = path.relative_to(ROOT).as_posix(), ast.parse(path.read_text())
        made = [name for node in ast.walk(tree) if (name := stage_made(node)) is not None]
        if folder not in path.parents and not made:
            continue
        if path.name == "__init__.py":
            continue
        if folder not in path.parents and place != "processing/evaluate/floor.py":
            yield f"{place}: makes the stage {made[0]!r}; stages stand in processing/stages/"
        if made != [path.stem.replace("_", "-")]:
            yield f"{place}: makes the stages {made}, wanted one, of the file's name"
        versions = [t.id for s in tree.body if isinstance(s, ast.Assign) for t in s.targets
                    if isinstance(t, ast.Name) and "VERSION" in t.id]  # fmt: skip
        if versions != ["VERSION"]:
            yield f"{place}: has the versions {versions}, wanted one, VERSION"
        verbs[".".join(path.relative_to(ROOT).with_suffix("").parts)] = {
            n.name for n in tree.body if isinstance(n, ast.FunctionDef) and any(stage_made(x) for x in ast.walk(n))
        }
    for path in (p for p in files if folder in p.parents):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                for name in sorted({a.name for a in node.names} & verbs.get(node.module or "", set())):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}: calls the stage of {node.module}: {name}"


def stage_made(node: ast.AST) -> str | None:
    """The name of the stage that is made by this call of `Store.run`; None for every other node."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "run":
        first = node.args[0] if len(node.args) == 6 else None
        return first.value if isinstance(first, ast.Constant) and isinstance(first.value, str) else None
    return None


def hidden_machines(name: str, text: str) -> Iterator[str]:
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, what in ((MACHINE_PATH, "a path of one machine"), (HOSTS, "a package registry's host")):
            if found := pattern.search(line):
                yield f"{name}:{number}: {what}: {found.group()}"


def too_long(name: str, text: str) -> Iterator[str]:
    lines = text.count("\n")
    if lines > MOST_LINES and not re.search(f"^{REASON}", text, re.M):  # a function's own is indented
        yield f"{name}: {lines} lines, wanted at most {MOST_LINES}; split it, or say why: `{REASON} ...`"
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            size = (node.end_lineno or node.lineno) - node.lineno + 1
            own = text.splitlines()[node.lineno - 1 : node.end_lineno]
            if size > MOST_FUNCTION_LINES and not any(REASON in line for line in own):
                yield f"{name}:{node.lineno}: {node.name} has {size} lines, wanted at most {MOST_FUNCTION_LINES}"


CHECKS: dict[str, Callable[[], Iterator[str]]] = {
    "style": tool("ruff", "check", "--quiet", "--output-format", "concise", "."),
    "format": tool("ruff", "format", "--check", "--quiet", "--output-format", "concise", "."),
    "types": tool("mypy", "--no-error-summary"),
    "walls": tool("lint-imports", "--no-cache", "--no-logo"),
    "circles": circles,
    "stages": stages,
    "house": house,
}


def main() -> int:
    bad = 0
    for name in sys.argv[1:] or CHECKS:
        faults = list(CHECKS[name]())
        print(f"{name}: {'ok' if not faults else 'FAULTS'}", flush=True)
        for fault in faults:
            print(fault)
        bad += bool(faults)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
