"""Cameras on USB that the kernel sees and this user may not open: their own libraries show them as absent."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

INTEL = {"8086": "intel"}
GREY_CAMERAS = {"1e10": "flir", "2ba2": "allied", "2676": "basler", "199e": "imaging", "04b4": "imperx"}
"""Vendors of USB3 Vision cameras by their USB number."""
SYSFS, NODES = Path("/sys/bus/usb/devices"), Path("/dev/bus/usb")


@dataclass(frozen=True)
class Forbidden:
    """A camera that is plugged in, and its device file that this user may not write."""

    name: str
    vendor: str
    node: Path

    def __str__(self) -> str:
        return f"{self.name} is plugged in, but this user may not open {self.node}"

    @property
    def fix(self) -> str:
        """The rule that lets everybody open this vendor's devices."""
        rule = f'SUBSYSTEM=="usb", ATTRS{{idVendor}}=="{self.vendor}", MODE="0666"'
        return (
            f"echo '{rule}' | sudo tee /etc/udev/rules.d/60-toss-record-{self.vendor}.rules && "
            "sudo udevadm control --reload-rules && sudo udevadm trigger, then plug it in anew"
        )


def forbidden(vendors: Mapping[str, str], sysfs: Path = SYSFS, nodes: Path = NODES) -> list[Forbidden]:
    """The plugged-in cameras of these vendors that cannot be opened. Intel makes more than cameras: only RealSense."""
    found = []
    for place in sorted(sysfs.glob("*")):
        vendor, product = _text(place / "idVendor"), _text(place / "product")
        if vendor not in vendors or (vendor in INTEL and "realsense" not in product.lower()):
            continue
        try:
            node = nodes / f"{int(_text(place / 'busnum')):03d}" / f"{int(_text(place / 'devnum')):03d}"
        except ValueError:
            continue  # an interface of a device, not a device
        if not os.access(node, os.R_OK | os.W_OK):
            found.append(Forbidden(product or f"a camera of vendor {vendor}", vendor, node))
    return found


def hint(vendors: Mapping[str, str]) -> str:
    """What to add to "not found": empty where permissions are not the reason."""
    return "".join(f"; {camera}: {camera.fix}" for camera in forbidden(vendors))


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""
