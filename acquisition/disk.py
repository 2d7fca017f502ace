"""Room for the next toss: how much a session writes, and whether it fits."""

from __future__ import annotations

import shutil
from pathlib import Path

from acquisition.streaming.recorder import Recorder
from recordings.errors import TosslabError


class DiskFull(TosslabError):
    """The next toss does not fit."""


JPEG_SHARE, LOSSLESS_SHARE, DEPTH_SHARE = 0.25, 0.75, 0.4
ARM_BYTES_S = 400_000


def free_bytes(folder: Path) -> tuple[Path, int]:
    """The nearest folder above that exists, and the bytes that are free there."""
    place = folder
    while not place.exists():
        place = place.parent
    return place, shutil.disk_usage(place).free


def expected_bytes_s(recorder: Recorder) -> float:
    """Bytes per second on the disk, from the pictures that flow."""
    total = 0.0
    lossless = recorder.rig.recording.mono_encoding == "lossless"
    for topic, queue in recorder.queues.items():
        image = recorder.latest.get(topic)
        if image is None:
            total += ARM_BYTES_S if "arm" in topic else 0
            continue
        share = DEPTH_SHARE if topic.endswith("depth") else JPEG_SHARE
        if lossless and topic.endswith("/image"):
            share = LOSSLESS_SHARE
        total += image.pixels.nbytes * share * queue.rate_hz
    return total


def check_disk(folder: Path, bytes_s: float, longest_s: float, reserve_gb: float) -> None:
    """Raises DiskFull unless twice the longest toss and the reserve fit."""
    (place, free), wanted = free_bytes(folder), 2 * bytes_s * longest_s + reserve_gb * 1e9
    if free < wanted:
        raise DiskFull(
            f"{place} has {free / 1e9:.2f} GB free; a toss of {longest_s:g} s at {bytes_s / 1e6:.0f} MB/s and the "
            f"reserve want {wanted / 1e9:.2f} GB. Free some space, choose another folder, or lower "
            "[recording] longest_toss_s or reserve_gb in the rig file"
        )
