"""Called by hatchling when a wheel is built: puts the commit into it, so that `--version` can say it."""

from __future__ import annotations

import importlib.util
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface):  # type: ignore[misc]
    """Adds `recordings/commit.txt`; an editable install has its checkout instead."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        if version == "editable":
            return
        root = Path(self.root)
        file = Path(tempfile.mkdtemp()) / "commit.txt"
        file.write_text(version_module(root).commit() + "\n")
        build_data["force_include"][str(file)] = "recordings/commit.txt"


def version_module(root: Path) -> Any:
    """`recordings/version.py` by its path: nothing is installed while a wheel is built."""
    spec = importlib.util.spec_from_file_location("version", root / "recordings" / "version.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
