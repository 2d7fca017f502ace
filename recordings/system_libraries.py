"""Libraries of the system that no wheel brings: which Debian package has each, and those that set-up unpacked; and a
place for compiled kernels where the system offers none.

Standard library only: `tools/check_system.py` reads this before there is a virtual environment, and `recordings` loads
it first of all.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

NEEDED = {
    # open3d links its window's libraries and librealsense: it is not imported without them, though none is ever used
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libudev.so.1": "libudev1",
    "libidn2.so.0": "libidn2-0",
}
DEVELOPERS = {
    "libgomp.so.1": "libgomp1",  # pinocchio: torques of planned tosses
    "libglib-2.0.so.0": "libglib2.0-0",  # drake
}
RIG = {"libaravis-0.8.so.0": "libaravis-0.8-0"}  # GigE and USB3 Vision cameras
PICTURES = {"libvulkan.so.1": "libvulkan1"}  # rerun's viewer
PACKAGES = NEEDED | DEVELOPERS | RIG | PICTURES

MISSING = re.compile(r"(lib[\w.+-]+?\.so[.\d]*): cannot open shared object file")


def unpacked_folder() -> Path:
    """Where set-up puts libraries that it may not install: inside the virtual environment."""
    return Path(sys.prefix) / "lib" / "tosslab"


def load_unpacked(folder: Path) -> list[str]:
    """Load every library in `folder`, so that what asks for one by name finds it loaded; returns those that would not.

    A library that needs another one of them waits for it: rounds go on for as long as one more loads.
    """
    waiting = sorted(folder.glob("*.so*"))
    while waiting:
        still = [path for path in waiting if not _loads(path)]
        if len(still) == len(waiting):
            break
        waiting = still
    return [path.name for path in waiting]


def _loads(path: Path) -> bool:
    try:
        ctypes.CDLL(str(path))
    except OSError:
        return False
    return True


def advice(error: ImportError) -> str | None:
    """What to type where `error` is that of a missing library of the system; None where it is not."""
    found = MISSING.search(str(error))
    if found is None:
        return None
    library = found.group(1)
    wanted = f"{library} is not on this system, and a package that is needed here cannot be loaded without it; "
    if library not in PACKAGES:
        return wanted + "install the system's package that has it"
    return wanted + f"as root, type: {install_line([PACKAGES[library]])}"


def install_line(packages: list[str]) -> str:
    """One line to copy, for Debian and Ubuntu."""
    return f"apt-get update && apt-get install -y --no-install-recommends {' '.join(packages)}"


def place_kernel_cache(package: Path) -> None:
    """numba keeps compiled kernels beside the sources, else in the user's cache. Where neither can be written to, which
    it refuses, names a folder of this process alone (`NUMBA_CACHE_DIR`), which is removed at the end."""
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
