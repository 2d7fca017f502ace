"""Are the system's libraries there that pip cannot bring? Prints one line to copy, and exits 1, where they are not.

Runs before the virtual environment exists: only the standard library here.
    python3 tools/check_system.py             # says what is missing and what to type
    python3 tools/check_system.py --packages  # only the names of the missing Debian packages
"""

from __future__ import annotations

import ctypes
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
VULKAN_DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
VULKAN_PACKAGE = "mesa-vulkan-drivers"  # lavapipe: screenshots on machines without a GPU


def loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def missing_packages() -> list[str]:
    missing = [package for library, package in LIBRARIES.items() if not loads(library)]
    if not any(list(Path(folder).glob("*.json")) for folder in VULKAN_DRIVERS):
        missing.append(VULKAN_PACKAGE)
    return missing


def main() -> int:
    missing = missing_packages()
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
