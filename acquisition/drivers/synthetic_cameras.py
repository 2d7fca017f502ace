"""Simulated cameras: frames of the stage's grid, delivered when they would have arrived, lost, late or damaged."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy import ndarray as Array

from acquisition.devices import (
    DeviceLost,
    DeviceRefused,
    Image,
    RgbdCapture,
)
from acquisition.drivers.synthetic_device import DeviceClock, SimulatedDevice
from acquisition.synthetic.lab_state import LabState
from acquisition.synthetic.random_draws import generator
from recordings.geometry import CameraModel, Transform

QUIET_NS = 10_000_000
"""How often a camera that says nothing looks whether it may speak again."""
STREAM_SEEDS = {"d455/color": 1, "d455/depth": 2, "mono0": 3, "mono1": 4, "mono2": 5, "arm": 6, "gripper": 7}


class _Camera(SimulatedDevice):
    """Frames of the stage's grid, each delivered when it would have arrived."""

    def __init__(self, lab: LabState, name: str, streams: tuple[str, ...], skew_number: int) -> None:
        super().__init__(lab, name)
        self._streams = streams
        config = lab.config
        own_ms = config.mono_latency_ms if streams[0].startswith("mono") else None
        self._latency_ms = config.latency_ms if own_ms is None else own_ms
        self._clock = self._make_clock(config.skew_ppm[skew_number % len(config.skew_ppm)] * 1e-6)
        self._frame = 0
        self._again: Any = None
        self._held_back: Any = None
        self._moved_ns = 0
        self._missed_triggers = 0

    def _make_clock(self, skew: float) -> DeviceClock:
        raise NotImplementedError

    def _begin(self) -> None:
        self._frame = self._lab.stage.frame_before(time.monotonic_ns()) + 1

    def _next(self, timeout_s: float) -> int | None:
        """The number of the frame that has arrived; None: none within the timeout."""
        ends_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        if not self._ready(timeout_s):
            return None
        while True:
            quiet = self._faults.active("silence") or self._faults.active("lost_trigger")
            self._skip_lost()
            due_ns = min(self._arrival_ns(self._frame), time.monotonic_ns() + QUIET_NS if quiet else 1 << 62)
            if not self._wait_until(due_ns, max((ends_ns - time.monotonic_ns()) / 1e9, 0.0)):
                return None
            if quiet:
                continue
            self._frame += 1
            if self._faults.active("unplug") is not None:
                raise DeviceLost(f"{self.name} was unplugged (simulated)")
            return self._frame - 1

    def _skip_lost(self) -> None:
        """Frames that were not read in time, were lost on the way, or were never exposed."""
        stage, config, now_ns = self._lab.stage, self._lab.config, time.monotonic_ns()
        for kind in ("silence", "lost_trigger"):  # also where nobody asked while it lasted: this thread may come late
            while (exposed_ns := stage.exposed_ns(self._streams[0], self._frame)) < now_ns:
                if self._faults.active(kind, exposed_ns) is None:
                    break
                self._missed_triggers += kind == "lost_trigger"
                self._frame += 1
        newest = stage.frame_before(time.monotonic_ns() - round(self._latency_ms * 1e6))
        quiet = self._faults.active("lost_trigger") or self._faults.active("silence")
        if quiet and newest > self._frame:
            self._missed_triggers += newest - self._frame if self._faults.active("lost_trigger") else 0
            self._frame = newest
        behind = newest - self._frame - config.buffer_frames
        if behind > 0:
            self._frame += behind
            for stream in self._streams:
                self._dropped(stream.split("/")[-1], behind)
        if self._faults.active("gap") is not None:
            self._frame += 2
            self._faults.clear("gap")
        while config.dropped_share and self._draw(self._frame).random() < config.dropped_share:
            self._frame += 1

    def _draw(self, frame: int) -> np.random.Generator:
        return generator(self._lab.config.seed, 77, STREAM_SEEDS[self._streams[0]], frame & 0x7FFFFFFF)

    def _arrival_ns(self, frame: int) -> int:
        exposed = max(self._lab.stage.exposed_ns(stream, frame) for stream in self._streams)
        late_ms = self._latency_ms + self._draw(frame).exponential(self._lab.config.latency_jitter_ms)
        fault = self._faults.active("late")
        late_ms += 1e3 * fault.number("by_s", 0.05) if fault else 0.0
        return exposed + round(late_ms * 1e6)

    def _image(self, stream: str, frame: int, host_ns: int, exposure_s: float) -> Image:
        step = self._faults.active("clock_step")
        if step is not None:
            self._moved_ns += round(step.number("by_s", 1.0) * 1e9)
            self._faults.clear("clock_step")
        shown = frame if self._faults.active("frozen") is None else 0
        pixels = self._lab.stage.picture(stream, shown) if shown else self._last_pixels(stream)
        self._pixels = {**getattr(self, "_pixels", {}), stream: pixels}
        if self._faults.active("wrong_size") is not None:
            pixels = pixels[::2, ::2]
        stamp = self._clock.stamp(self._lab.stage.exposed_ns(stream, frame), self._moved_ns)
        self._received(stream.split("/")[-1])
        number = frame - self._missed_triggers
        return Image(stream.split("/")[-1], number, stamp, host_ns, pixels, exposure_s, 1.0)

    def _last_pixels(self, stream: str) -> Array:
        pixels: dict[str, Array] = getattr(self, "_pixels", {})
        return pixels[stream] if stream in pixels else self._lab.stage.picture(stream, 1)

    def _delivered(self, made: Any) -> Any:
        """Duplicates and swapped frames are made here."""
        if self._held_back is not None:
            self._held_back, self._again = None, self._held_back
            return made
        if self._faults.active("duplicate") is not None:
            self._again = made
        if self._faults.active("swap") is not None:
            self._faults.clear("swap")
            self._held_back = made
            return None
        return made

    def read(self, timeout_s: float) -> Any:
        """What a fault kept for this read, or what arrives; None: nothing within the timeout."""
        stored, self._again = self._again, None
        if stored is not None:
            return stored
        frame = self._next(timeout_s)
        return None if frame is None else self._delivered(self._made(frame))

    def _made(self, frame: int) -> Any:
        """What the camera hands over of a frame."""
        raise NotImplementedError


class SyntheticRgbd(_Camera):
    """A D455-like camera: 32-bit microseconds, depth exposed apart from colour."""

    def __init__(self, lab: LabState, name: str) -> None:
        super().__init__(lab, name, ("d455/color", "d455/depth"), 0)

    def _make_clock(self, skew: float) -> DeviceClock:
        wrap = 1 << 32
        after_s = self._lab.config.wrap_after_s
        start = wrap * 1000 - round(after_s * 1e9) if after_s >= 0 else 10**9
        return DeviceClock("d455 hardware", self._lab.stage.epoch_ns, skew, start, 1000, wrap)

    def _made(self, frame: int) -> RgbdCapture:
        host_ns = time.monotonic_ns()
        exposure_s = self._lab.show.color_exposure_s
        color = self._image("d455/color", frame, host_ns, exposure_s)
        depth = self._image("d455/depth", frame, host_ns, exposure_s)
        without = self._faults.active("no_depth") is not None
        return RgbdCapture(color, None if without else depth, self._lab.show.depth_unit_m, aligned=True)

    def set_emitter(self, on: bool) -> None:
        pass  # the simulated pattern is invisible to the colour camera

    def cameras(self) -> Mapping[str, CameraModel]:
        return {"color": self._lab.show.cameras()["d455"], "depth": self._lab.show.cameras()["d455"]}

    def color_from_depth(self) -> Transform:
        return Transform.identity("d455", "d455")

    def describe(self) -> dict[str, Any]:
        return self._described("simulated D455", self._lab.config.fps)


class SyntheticMono(_Camera):
    """A grey camera on the common trigger, with a 64-bit nanosecond clock."""

    def __init__(self, lab: LabState, name: str, stream: str, number: int) -> None:
        self._stream, self._number = stream, number
        super().__init__(lab, name, (stream,), 1 + number)

    def _make_clock(self, skew: float) -> DeviceClock:
        return DeviceClock(
            f"{self._stream} hardware", self._lab.stage.epoch_ns, skew, (self._number + 5) * 10**12, 1, None
        )

    def _made(self, frame: int) -> Image:
        made = self._image(self._stream, frame, time.monotonic_ns(), self._lab.show.mono_exposure_s)
        return replace(made, stream="image")

    def trigger(self) -> None:
        raise DeviceRefused(f"{self.name} waits for the hardware trigger (simulated)")

    def camera(self) -> CameraModel:
        """True intrinsics, for the rig's calibration."""
        return self._lab.show.cameras()[self._stream]

    def describe(self) -> dict[str, Any]:
        return self._described("simulated grey camera", self._lab.config.fps)
