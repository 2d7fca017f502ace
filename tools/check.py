"""Checks all that `make check` promises: style, types, the house's walls, the size of files, no names of machines.

python tools/check.py           # all
python tools/check.py walls     # one of: style format types walls house
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
MOST_LINES = 400
MOST_FUNCTION_LINES = 80
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


def hidden_machines(name: str, text: str) -> Iterator[str]:
    for number, line in enumerate(text.splitlines(), 1):
        for pattern, what in ((MACHINE_PATH, "a path of one machine"), (HOSTS, "a package registry's host")):
            if found := pattern.search(line):
                yield f"{name}:{number}: {what}: {found.group()}"


def too_long(name: str, text: str) -> Iterator[str]:
    lines = text.count("\n")
    if lines > MOST_LINES and REASON not in text:
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
