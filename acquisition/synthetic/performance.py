"""One toss, rendered ahead for devices that stream it in real time: what every camera sees at each of its instants."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.lab import Lab
from acquisition.synthetic.planner import Motion
from acquisition.synthetic.random_draws import TIMES, generator
from recordings.progress import Progress, Silent

See = Callable[[float, int], Array]
"""The picture at a time of the toss; the number seeds its noise."""
VARIANTS = 3
"""Pictures of the lab at rest, alike but for the sensors' noise."""


@dataclass(frozen=True, eq=False)
class Reel:
    """One stream's pictures of a toss. `times_s` are the true mid-exposure times on the toss's clock; `before` and
    `after` show the lab at rest."""

    times_s: Float[Array, " n"]
    pictures: list[Array]
    before: list[Array]
    after: list[Array]

    def at(self, frame: int | None, number: int) -> Array:
        """Picture of a frame of the toss; None: before it; beyond the end: after it. `number` is the device's own
        count, so that no picture of the lab at rest comes twice in a row."""
        if frame is None or frame < 0:
            return self.before[number % len(self.before)]
        return self.pictures[frame] if frame < len(self.pictures) else self.after[number % len(self.after)]


@dataclass(frozen=True, eq=False)
class Performance:
    """A toss and what the cameras see of it. Streams: "d455/color", "d455/depth", "mono0", ..."""

    motion: Motion
    reels: dict[str, Reel]

    def without_pictures(self) -> Performance:
        """What is to be remembered of a toss that nobody will look at again: its motion and its times."""
        return Performance(self.motion, {name: Reel(reel.times_s, [], [], []) for name, reel in self.reels.items()})


def perform(lab: Lab, motion: Motion, fps: float, progress: Progress | None = None) -> Performance:
    """Render a toss for all cameras on a grid of `fps`; the colour camera's frames have the config's jitter."""
    count = int(motion.instants.end_s * fps) + 1
    jitter = lab.config.camera.time_jitter_s * generator(lab.config.seed, TIMES, motion.toss).standard_normal(count)
    color_s = np.arange(count) / fps + np.clip(jitter, -3e-3, 3e-3)
    streams: dict[str, tuple[Float[Array, " n"], See]] = {
        "d455/color": (color_s, lambda t, k: lab.color(motion, t, k)),
        "d455/depth": (
            color_s + lab.config.depth.delay_s,
            lambda t, k: lab.depth(lab.g_buffer(motion, t), motion.toss, k),
        ),
    }
    for number, view in enumerate(lab.mono_views):
        times_s = np.arange(count) / fps + lab.mono_config.trigger_delay_s
        streams[view.camera.frame] = (times_s, partial(_mono, lab, motion, number))
    steps = _Steps(progress or Silent(), len(streams) * (count + 2 * VARIANTS))
    reels = {
        name: _reel(times_s, motion.instants.end_s, steps.counted(name, see))
        for name, (times_s, see) in streams.items()
    }
    return Performance(motion, reels)


def _reel(times_s: Float[Array, " n"], end_s: float, see: See) -> Reel:
    count = len(times_s)
    return Reel(
        times_s,
        [see(float(t), k) for k, t in enumerate(times_s)],
        [see(0.0, count + k) for k in range(VARIANTS)],
        [see(end_s, count + VARIANTS + k) for k in range(VARIANTS)],
    )


def _mono(lab: Lab, motion: Motion, number: int, time_s: float, index: int) -> Array:
    return lab.mono(number, motion, time_s, index)


class _Steps:
    """Counts pictures over all streams."""

    def __init__(self, progress: Progress, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def counted(self, name: str, see: See) -> See:
        def one(time_s: float, index: int) -> Array:
            picture = see(time_s, index)
            self._done += 1
            self._progress.step(self._done, self._total, name)
            return picture

        return one
