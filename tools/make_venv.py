"""Makes the virtual environment, also where the system keeps pip apart from its Python (Debian without python3-venv).

Runs before there is any package: only the standard library here.
    python3 tools/make_venv.py .venv    # as root or with sudo that asks nothing, python3-venv is installed; any other
                                        # user's pip is unpacked from Debian's package straight into .venv
"""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
import venv
from pathlib import Path

from check_system import as_root, install, say, unpacked

WHEEL = "python3-pip-whl"
"""Debian's package that holds pip as one wheel."""


def has_pip() -> bool:
    """Whether this Python can put pip into an environment by itself."""
    importlib.invalidate_caches()
    return importlib.util.find_spec("ensurepip") is not None


def make(folder: Path) -> bool:
    """Make the environment; False, with what to type, where no pip can be had for it."""
    package = f"python{sys.version_info.major}.{sys.version_info.minor}-venv"
    if not has_pip() and (prefix := as_root()) is not None:
        say(f"installs the system's package {package}")
        install(prefix, [package])
    venv.EnvBuilder(with_pip=has_pip(), symlinks=True).create(folder)
    if has_pip() or bring_pip(folder):
        return True
    say(f"no pip for {sys.executable}; as root, type:\napt-get update && apt-get install -y {package}")
    return False


def bring_pip(folder: Path) -> bool:
    """Let pip's wheel, which runs as it is, install itself into the environment."""
    say(f"may not install the system's packages: takes pip out of {WHEEL} into {folder}")
    with unpacked([WHEEL]) as root:
        for wheel in root.glob("usr/share/python-wheels/pip-*.whl"):
            python = [str(folder / "bin" / "python"), f"{wheel}/pip"]
            return subprocess.run([*python, "install", "-q", "--no-index", str(wheel)]).returncode == 0
    return False


if __name__ == "__main__":
    sys.exit(0 if make(Path(sys.argv[1])) else 1)
