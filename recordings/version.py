"""What is running here: the version of tosslab, its commit, and the packages that its numbers hang on."""

from __future__ import annotations

import platform
import subprocess
from importlib import metadata
from pathlib import Path

PACKAGE = Path(__file__).resolve().parent
COMMIT_FILE = PACKAGE / "commit.txt"
"""Written into the wheel when it is built (tools/build_hook.py); a checkout has git instead."""
UNKNOWN = "unknown"
NOT_INSTALLED = "not installed"


def versions() -> dict[str, str]:
    """By name: tosslab, commit, Python, numba, torch. Reads what is installed, imports none of it."""
    installed = {name: _installed(name) for name in ("numba", "torch")}
    return {"tosslab": _installed("tosslab"), "commit": commit(), "Python": platform.python_version(), **installed}


def commit() -> str:
    """The commit of this checkout, "+changes" where files differ from it; of a wheel, the one it was built from."""
    root = PACKAGE.parent
    if not (root / ".git").exists():
        return COMMIT_FILE.read_text().strip() if COMMIT_FILE.exists() else UNKNOWN
    return git_commit(root)


def git_commit(root: Path) -> str:
    """What git says of the checkout at `root`; "unknown" where there is no git or no commit."""
    try:
        done = [
            subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=True).stdout.strip()
            for words in (("rev-parse", "--short=12", "HEAD"), ("status", "--porcelain", "--untracked-files=no"))
        ]
    except (OSError, subprocess.CalledProcessError):
        return UNKNOWN
    return done[0] + ("+changes" if done[1] else "")


def _installed(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return NOT_INSTALLED
