"""`toss-record --doctor`: what is installed, found and missing on this machine, with the line that helps."""

from __future__ import annotations

import importlib.util
import os
import resource
from collections.abc import Iterator
from pathlib import Path

from acquisition.disk import free_bytes
from acquisition.drivers import usb
from acquisition.preflight import Preflight, Row
from acquisition.streaming.streams import READS
from recordings.errors import DeviceNotFound
from recordings.system_libraries import advice

USBFS = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
USBFS_MB = 1000
SLOWEST_MB_S = 60.0


def doctor(folder: Path) -> Preflight:
    """All checks; nothing is changed."""
    rows = [*packages(), *realsense(), *genicam(), *system(), *room(folder), *speed(folder)]
    return Preflight(tuple(rows))


def packages() -> Iterator[Row]:
    """The clients of the devices, and what plans and shows."""
    wanted = (
        ("pyrealsense2", "RealSense cameras", "pip install -e .[rig-realsense]"),
        ("panda_py", "Franka Panda", "pip install -e .[rig-franka]"),
        ("rtde_control", "Universal Robots", "pip install -e .[rig-ur]"),
        ("ruckig", "planning tosses", "pip install -e .[rig-franka]"),
        ("pinocchio", "torques of planned tosses", "pip install -e .[rig-franka]"),
        ("pupil_apriltags", "AprilTags", "pip install -e ."),
        ("rerun", "live preview", "pip install -e ."),
    )
    for module, what, fix in wanted:
        there = importlib.util.find_spec(module) is not None
        yield Row("package", module, "ok" if there else "warning", what if there else f"not installed: {what}", fix)


def realsense() -> Iterator[Row]:
    """Cameras that librealsense sees, and whether this user may open them."""
    from acquisition.drivers.realsense_setup import connected

    try:
        found = connected()
    except DeviceNotFound as missing:
        library = advice(missing.__cause__) if isinstance(missing.__cause__, ImportError) else None
        if library:  # a package that is not there at all has been said by `packages`
            yield Row("package", "pyrealsense2", "warning", "cannot be loaded", library)
        return
    for text in found:
        yield Row("camera", "realsense", "ok", text)
    if not found:
        fix = "plug it into USB 3; `lsusb -d 8086:` shows whether the kernel sees it"
        yield Row("camera", "realsense", "warning", "none found", fix)
    for camera in usb.forbidden(usb.INTEL):
        yield Row("permission", "realsense", "fail", str(camera), camera.fix)


def genicam() -> Iterator[Row]:
    """Aravis, and the cameras that it sees."""
    from acquisition.drivers.genicam_setup import connected

    try:
        lines = connected()
    except DeviceNotFound:
        fix = "apt-get install -y --no-install-recommends libaravis-0.8-0"
        yield Row("package", "aravis", "warning", "not installed: PointGrey/FLIR and other GenICam cameras", fix)
        return
    for line in lines:
        yield Row("camera", "genicam", "ok", line)
    for camera in usb.forbidden(usb.GREY_CAMERAS):
        yield Row("permission", "genicam", "fail", str(camera), camera.fix)
    if not lines:
        fix = "camera and computer in one network (GigE), or USB3 with a udev rule for its vendor"
        yield Row("camera", "genicam", "warning", "none found", fix)


def system() -> Iterator[Row]:
    """Settings of the machine that cost frames."""
    if USBFS.exists():
        megabytes = int(USBFS.read_text())
        state = "ok" if megabytes >= USBFS_MB or megabytes == 0 else "warning"
        fix = f"echo {USBFS_MB} | sudo tee {USBFS}"
        yield Row("system", "usbfs memory", state, f"{megabytes} MB", fix)  # type: ignore[arg-type]
    cores = len(os.sched_getaffinity(0))
    yield Row("system", "cores", "ok" if cores >= 2 else "warning", str(cores), "two or more")
    yield priority()
    realtime = "PREEMPT_RT" in os.uname().version or "PREEMPT RT" in os.uname().version
    found = "real-time" if realtime else "not real-time: a Franka's 1 kHz loop may miss cycles"
    yield Row("system", "kernel", "ok" if realtime else "warning", found, "apt-get install -y linux-image-rt-amd64")
    governors = {p.read_text().strip() for p in Path("/sys/devices/system/cpu").glob("cpu*/cpufreq/scaling_governor")}
    if governors and governors != {"performance"}:
        fix = "sudo cpupower frequency-set -g performance"
        yield Row("system", "cpu governor", "warning", ", ".join(sorted(governors)), fix)


def priority() -> Row:
    """Whether the recorder's threads may run before other programs' (streams.go_first)."""
    allowed = resource.getrlimit(resource.RLIMIT_NICE)[0]
    may = os.geteuid() == 0 or allowed == resource.RLIM_INFINITY or 20 - allowed <= READS
    found = "before other programs" if may else "like any other program: frames are lost on a busy machine"
    fix = f'echo "$USER - nice {READS}" | sudo tee /etc/security/limits.d/toss-record.conf, then log in anew'
    return Row("system", "priority", "ok" if may else "warning", found, fix)


def room(folder: Path) -> Iterator[Row]:
    place, free = free_bytes(folder.resolve())
    yield Row("disk", str(place), "ok" if free > 20e9 else "warning", f"{free / 1e9:.1f} GB free", "20 GB or more")


def speed(folder: Path) -> Iterator[Row]:
    """Writes 128 MB and removes them."""
    import time

    probe = free_bytes(folder.resolve())[0] / f".toss-record-speed-{os.getpid()}"
    block = os.urandom(1 << 22)
    try:
        begun = time.monotonic()
        with open(probe, "wb") as file:
            for _ in range(32):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
        rate = 128 * 1.048576 / (time.monotonic() - begun)
        state = "ok" if rate > SLOWEST_MB_S else "warning"
        yield Row("disk", "speed", state, f"{rate:.0f} MB/s", f"{SLOWEST_MB_S:g} MB/s")  # type: ignore[arg-type]
    except OSError as refused:
        yield Row("disk", "speed", "fail", f"cannot write there: {refused.strerror}", "another folder")
    finally:
        probe.unlink(missing_ok=True)
