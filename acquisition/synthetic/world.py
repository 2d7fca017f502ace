"""The simulated lab as a place in time: when each camera exposes, what it then sees, which toss is going on.

True time is the host's monotonic clock. Cameras expose on one grid of frames, each at its own phase; a toss begins at a
frame of that grid, so that its rendered pictures are exactly those of the frames' instants.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.performance import Performance

SOON_NS = 60_000_000
"""A toss begins at the first frame after this."""


@dataclass(frozen=True)
class Shown:
    """A toss that was played: its first frame on the grid, and the frame after its last one (None: going on)."""

    performance: Performance
    first_frame: int
    ended_frame: int | None = None


class Stage:
    """Which performance is on. `epoch_ns` is the host time of the grid's frame 0."""

    def __init__(self, fps: float, phases_s: dict[str, float]) -> None:
        self.fps = fps
        self.epoch_ns = time.monotonic_ns()
        self._phases_s = phases_s
        self._lock = threading.Lock()
        self._next: Performance | None = None
        self.shown: list[Shown] = []

    def set_up(self, performance: Performance) -> None:
        """The object is back in the hand; the next `begin` plays this."""
        with self._lock:
            now = self.frame_before(time.monotonic_ns()) + 1
            if self.shown and self.shown[-1].ended_frame is None:
                last = self.shown[-1]
                past = [replace(s, performance=s.performance.without_pictures()) for s in self.shown[:-1]]
                self.shown = [*past, Shown(last.performance, last.first_frame, now)]
            self._next = performance

    def begin(self) -> int:
        """Play what was set up; returns the host time of its beginning."""
        with self._lock:
            if self._next is None:
                raise RuntimeError("nothing was set up")
            first = self.frame_before(time.monotonic_ns() + SOON_NS) + 1
            self.shown.append(Shown(self._next, first))
            self._next = None
            return self.grid_ns(first)

    def over(self) -> bool:
        """Whether the last performance has been played to its end."""
        with self._lock:
            if not self.shown:
                return False
            last = self.shown[-1]
            count = max((len(reel.times_s) for reel in last.performance.reels.values()), default=0)
            return self.frame_before(time.monotonic_ns()) > last.first_frame + count

    @property
    def ready(self) -> Performance | None:
        return self._next

    def grid_ns(self, frame: int) -> int:
        return self.epoch_ns + round(frame * 1e9 / self.fps)

    def frame_before(self, host_ns: int) -> int:
        return int((host_ns - self.epoch_ns) * self.fps / 1e9)

    def exposed_ns(self, stream: str, frame: int) -> int:
        """True mid-exposure of a frame of a stream."""
        shown = self.shown_at(frame)
        if shown is not None and 0 <= frame - shown.first_frame < len(shown.performance.reels[stream].times_s):
            reel = shown.performance.reels[stream]
            return self.grid_ns(shown.first_frame) + round(float(reel.times_s[frame - shown.first_frame]) * 1e9)
        return self.grid_ns(frame) + round(self._phases_s[stream] * 1e9)

    def picture(self, stream: str, frame: int) -> Array:
        """What a stream's frame shows. Raises RuntimeError before the first `set_up`."""
        shown = self.shown_at(frame)
        if shown is not None:
            return shown.performance.reels[stream].at(frame - shown.first_frame, frame)
        performance = self._next or (self.shown[-1].performance if self.shown else None)
        if performance is None:
            raise RuntimeError("nothing was set up")
        return performance.reels[stream].at(None, frame)

    def shown_at(self, frame: int) -> Shown | None:
        """The toss that a frame shows, or its rest; None: the hand holds the object."""
        with self._lock:
            for shown in reversed(self.shown):
                if frame >= shown.first_frame:
                    return shown if shown.ended_frame is None or frame < shown.ended_frame else None
        return None

    def playing(self, host_ns: int) -> tuple[Shown, float] | None:
        """The toss going on, or over and at rest, at a host time, and the time on its own clock."""
        shown = self.shown_at(self.frame_before(host_ns))
        return None if shown is None else (shown, (host_ns - self.grid_ns(shown.first_frame)) / 1e9)

    def world_from_object(self, stream: str, frame: int) -> Float[Array, "4 4"] | None:
        """True pose at a frame's exposure; None where the frame shows no toss."""
        shown = self.shown_at(frame)
        if shown is None:
            return None
        time_s = (self.exposed_ns(stream, frame) - self.grid_ns(shown.first_frame)) / 1e9
        return np.array(shown.performance.motion.object.at(time_s).matrix)
