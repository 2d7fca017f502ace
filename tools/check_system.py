"""Are the system's libraries there that pip cannot bring? Prints one line to copy, and exits 1, where they are not.

Runs before the virtual environment exists: only the standard library here.
    python3 tools/check_system.py             # says what is missing and what to type
    python3 tools/check_system.py --rig       # with what only a rig and its drivers' tests need
    python3 tools/check_system.py --packages  # only the names of the missing Debian packages, the rig's too
"""

from __future__ import annotations

import ctypes
import shutil
import sys
from pathlib import Path

# library -> Debian's package
LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",  # pyrealsense2
    "libGL.so.1": "libgl1",  # open3d, at import
    "libEGL.so.1": "libegl1",  # open3d, at import
    "libgomp.so.1": "libgomp1",  # open3d
    "libvulkan.so.1": "libvulkan1",  # rerun's viewer and its screenshots
}
RIG_LIBRARIES = {"libaravis-0.8.so.0": "libaravis-0.8-0"}  # GigE and USB3 Vision cameras
RIG_PROGRAMS = {"arv-fake-gv-camera-0.8": "aravis-tools"}  # the camera that the driver's tests talk to
VULKAN_DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
VULKAN_PACKAGE = "mesa-vulkan-drivers"  # lavapipe: screenshots on machines without a GPU


def loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def missing_packages(rig: bool) -> list[str]:
    libraries = LIBRARIES | RIG_LIBRARIES if rig else LIBRARIES
    missing = [package for library, package in libraries.items() if not loads(library)]
    if rig:
        missing += [package for program, package in RIG_PROGRAMS.items() if shutil.which(program) is None]
    if not any(list(Path(folder).glob("*.json")) for folder in VULKAN_DRIVERS):
        missing.append(VULKAN_PACKAGE)
    return missing


def main() -> int:
    missing = missing_packages(rig="--rig" in sys.argv[1:] or "--packages" in sys.argv[1:])
    if "--packages" in sys.argv[1:]:
        print(*missing)
        return 0
    if not missing:
        return 0
    print(f"system libraries are missing: {' '.join(missing)}; as root, type:", file=sys.stderr)
    print(f"apt-get update && apt-get install -y --no-install-recommends {' '.join(missing)}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
