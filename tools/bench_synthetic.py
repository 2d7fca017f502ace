"""CPU seconds of the synthetic lab, per frame, against what it must keep to so that variety can be made in minutes;
then its parametric depth and the stereo-matched depth of tools/variety beside each other and beside what is published.

python tools/bench_synthetic.py            # --depth: only the second table
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from synthetic.presets import preset
from variety import depth_check

from acquisition.synthetic.config import MonoConfig
from acquisition.synthetic.lab import Lab
from acquisition.synthetic.planner import Motion

REPEATS = 8


@dataclass(frozen=True)
class Row:
    what: str
    cpu_s: float
    limit_s: float


def cpu_s(work: Callable[[int], object], repeats: int = REPEATS) -> float:
    start = time.process_time()
    for k in range(repeats):
        work(k)
    return (time.process_time() - start) / repeats


def instants(motion: Motion) -> list[float]:
    """Evenly over the toss."""
    return [motion.instants.end_s * (k + 0.5) / REPEATS for k in range(REPEATS)]


def frame(lab: Lab, motion: Motion, time_s: float) -> None:
    """One colour image with blur, one depth image, the truth masks."""
    lab.color(motion, time_s, 0)
    lab.depth(lab.g_buffer(motion, time_s), 0, 0)


def rows() -> list[Row]:
    cube = Lab(replace(preset("cube-tagged"), mono=MonoConfig()))
    arm = Lab(preset("arm-prism"))
    found = [
        Row("still picture of the room, 640x480, once a session", cpu_s(lambda _: cube.still, 1), 15.0),
        Row("still pictures of 3 mono cameras, 1440x1080, once a session", cpu_s(lambda _: cube.mono_stills, 1), 60.0),
        Row("planning a toss", cpu_s(cube.plan), 2.0),
        Row("planning a toss of the arm", cpu_s(arm.plan), 5.0),
    ]
    motion, thrown = cube.plan(0), arm.plan(0)
    assert arm.still is not None  # rendered before the clock runs
    times, arm_times = instants(motion), instants(thrown)
    found += [
        Row("RGBD frame 640x480, 4 ms blur", cpu_s(lambda k: frame(cube, motion, times[k])), 0.5),
        Row("RGBD frame 640x480 with the arm in view", cpu_s(lambda k: frame(arm, thrown, arm_times[k])), 0.75),
        Row("mono frame 1440x1080", cpu_s(lambda k: cube.mono(k % 3, motion, times[k], k)), 0.5),
    ]
    return found


def main() -> int:
    if "--depth" not in sys.argv[1:]:
        return max(times(), depths())
    return depths()


def depths() -> int:
    """Both depth models before a flat wall and a block."""
    print("| depth | parametric | stereo-matched | D455, published |\n|---|---|---|---|")
    for row in depth_check.rows():
        print("| " + " | ".join(row) + " |")
    return 0


def times() -> int:
    """CPU seconds; 1 where one is above its limit."""
    table = rows()
    print("| what | CPU s | at most |\n|---|---|---|")
    for row in table:
        print(f"| {row.what} | {row.cpu_s:.2f} | {row.limit_s:g} |")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MiB")
    slow = [row.what for row in table if row.cpu_s > row.limit_s]
    if slow:
        print(f"too slow: {'; '.join(slow)}")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
