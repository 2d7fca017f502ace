"""Where numba keeps compiled kernels: beside the sources, else in the user's cache; where neither can be written to, in
a folder of this process alone, so that a package that nobody may write to works all the same."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from pathlib import Path


def place_kernel_cache(package: Path) -> None:
    """Names a folder (`NUMBA_CACHE_DIR`) where numba would find none and refuse; it is removed at the end."""
    if os.environ.get("NUMBA_CACHE_DIR") or _may_write(package) or _may_write(_users_cache()):
        return
    folder = tempfile.mkdtemp(prefix="tosslab-kernels-")
    os.environ["NUMBA_CACHE_DIR"] = folder  # children use it too
    atexit.register(shutil.rmtree, folder, ignore_errors=True)


def _users_cache() -> Path:
    """numba's own choice is in here."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())


def _may_write(folder: Path) -> bool:
    """Whether files can be made in the folder, which is made where it is not there."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return os.access(folder, os.W_OK | os.X_OK)
