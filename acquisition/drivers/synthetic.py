# long because: five simulated devices share one lab, one way of keeping time and one set of faults
"""The whole lab simulated: devices behind the protocols, with clocks that drift, latencies, lost frames and faults.

    lab = SyntheticLab(SyntheticConfig(seed=3))
    lab.prepare(0)                        # plans and renders toss 0
    with lab.device("d455", "rgbd") as camera: ...

The scene is that of `acquisition.synthetic`; what is true (poses, exposure times) is written beside a session by
`acquisition.synthetic.truth_sidecar`, never into it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from acquisition.arm.toss import TossPlan
from acquisition.devices import (
    ArmMode,
    ArmSamples,
    DeviceLost,
    DeviceRefused,
    GripperCommand,
    GripperSample,
    Health,
    Image,
    JointTrajectory,
    Motion,
    RgbdCapture,
    Stamp,
)
from acquisition.simulators.faults import Faults
from acquisition.synthetic.lab_config import SyntheticConfig
from acquisition.synthetic.random_draws import generator
from acquisition.synthetic.world import Stage
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.progress import Progress

QUIET_NS = 10_000_000
"""How often a camera that says nothing looks whether it may speak again."""
ARM_NOISE = (2e-5, 1.5e-3)
WIDTH_NOISE_M = 2e-5
STREAM_SEEDS = {"d455/color": 1, "d455/depth": 2, "mono0": 3, "mono1": 4, "mono2": 5, "arm": 6, "gripper": 7}
FAULTS: Mapping[str, str] = {
    "unplug": "the device is gone; open fails too while it lasts",
    "silence": "frames stop, no error is reported",
    "frozen": "the same picture again and again, under new numbers",
    "duplicate": "every frame comes twice",
    "swap": "two frames come in the wrong order",
    "gap": "frames are lost on the way: numbers jump",
    "lost_trigger": "the cameras are not triggered: no frame, no number",
    "clock_step": "the device's clock is set by `by_s`",
    "late": "frames arrive `by_s` later",
    "nan": "the arm reports NaN",
    "reflex": "the arm stops in reflex",
    "user_stop": "the emergency stop is pressed",
    "gripper_timeout": "the gripper does not answer",
    "hang": "the driver's read does not return while it lasts",
    "wrong_size": "images of another size",
    "no_depth": "captures without depth",
}


class SyntheticLab:
    """What all simulated devices share: the stage, the faults, the state of arm and fingers."""

    def __init__(self, config: SyntheticConfig) -> None:
        from acquisition.synthetic.show import Show

        self.config = config
        self.show = Show(config)
        self.stage = Stage(config.fps, self.show.phases_s())
        self.arm = _ArmBody(self)
        self._faults: dict[str, Faults] = {}
        self._opened: set[str] = set()

    def show_views(self) -> None:
        """Play the views of the board that were set up, the arm going from one to the next."""
        ready = self.stage.ready
        trajectory = getattr(ready.motion.swing, "trajectory", None) if ready is not None else None
        if trajectory is None:
            raise RuntimeError("no views were set up")
        self.arm.move(trajectory)

    def show_views_again(self) -> None:
        """The same views from the beginning: a busy machine may have missed some."""
        self.stage.set_up(self.stage.shown[-1].performance)
        self.show_views()

    def faults(self, device: str) -> Faults:
        """The faults of a device, to inject some."""
        return self._faults.setdefault(device, Faults(FAULTS))

    def device(
        self, name: str, kind: str, rate_hz: float = 30.0
    ) -> SyntheticRgbd | SyntheticMono | SyntheticArm | SyntheticGripper:
        """A device of this lab under the rig's name for it."""
        if kind == "rgbd":
            return SyntheticRgbd(self, name)
        if kind == "mono":
            number = sum(1 for n in self._opened if n != name)
            self._opened.add(name)
            if number >= self.config.mono_cameras:
                raise BadInput(f"the simulated lab has {self.config.mono_cameras} grey cameras; '{name}' is one more")
            return SyntheticMono(self, name, f"mono{number}", number)
        return SyntheticArm(self, name, rate_hz) if kind == "arm" else SyntheticGripper(self, name, rate_hz)


class _Clock:
    """A device's clock: drifts, starts anywhere, wraps, may be set by a fault."""

    def __init__(self, name: str, epoch_ns: int, skew: float, offset_ns: int, tick_ns: int, wrap: int | None) -> None:
        self.name, self.skew, self.tick_ns, self.wrap = name, skew, tick_ns, wrap
        self._epoch_ns, self._offset_ns = epoch_ns, offset_ns

    def stamp(self, true_ns: int, moved_ns: int = 0) -> Stamp:
        passed = true_ns - self._epoch_ns
        ticks = (self._offset_ns + moved_ns + passed + round(self.skew * passed)) // self.tick_ns
        return Stamp(self.name, ticks % self.wrap if self.wrap else ticks, self.tick_ns, self.wrap)


@dataclass
class _Counts:
    received: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)


class _Device:
    """Life and faults of every simulated device."""

    def __init__(self, lab: SyntheticLab, name: str) -> None:
        self.name = name
        self._lab = lab
        self._faults = lab.faults(name)
        self._stop = threading.Event()
        self._open = self._running = False
        self._counts = _Counts()

    def open(self) -> None:
        if self._faults.active("unplug") is not None:
            raise DeviceLost(f"{self.name} is unplugged (simulated)")
        self._open = True

    def start(self) -> None:
        self._stop.clear()
        self._running = True
        self._counts = _Counts()
        self._begin()

    def _begin(self) -> None:
        """What a device does first when it starts."""

    def stop(self) -> None:
        self._running = False
        self._stop.set()

    def close(self) -> None:
        self.stop()
        self._open = False

    def __enter__(self) -> Any:
        self.open()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def health(self) -> Health:
        received, dropped = dict(self._counts.received), dict(self._counts.dropped)
        if self._faults.active("unplug") is not None:
            return Health("error", f"{self.name} was unplugged (simulated)", received, dropped)
        return Health(received=received, dropped=dropped)

    def _described(self, model: str, rate_hz: float) -> dict[str, Any]:
        return {
            "kind": "synthetic",
            "model": model,
            "serial": f"synthetic-{self.name}",
            "firmware": "",
            "driver": "synthetic",
            "rate_hz": rate_hz,
            "settings": {},
            "warnings": [],
        }

    def _ready(self, timeout_s: float) -> bool:
        """Whether `read` may go on; plays the faults that every device has."""
        if not self._running:
            self._stop.wait(min(timeout_s, 0.02))
            return False
        if self._faults.active("unplug") is not None:
            raise DeviceLost(f"{self.name} was unplugged (simulated)")
        while self._faults.active("hang") is not None and not self._stop.wait(0.01):
            pass
        return True

    def _wait_until(self, due_ns: int, timeout_s: float) -> bool:
        left_s = (due_ns - time.monotonic_ns()) / 1e9
        if left_s > 0:
            self._stop.wait(min(left_s, timeout_s))
        return time.monotonic_ns() >= due_ns and not self._stop.is_set()

    def _dropped(self, stream: str, count: int = 1) -> None:
        self._counts.dropped[stream] = self._counts.dropped.get(stream, 0) + count

    def _received(self, stream: str, count: int = 1) -> None:
        self._counts.received[stream] = self._counts.received.get(stream, 0) + count


class _Camera(_Device):
    """Frames of the stage's grid, each delivered when it would have arrived."""

    def __init__(self, lab: SyntheticLab, name: str, streams: tuple[str, ...], skew_number: int) -> None:
        super().__init__(lab, name)
        self._streams = streams
        config = lab.config
        own_ms = config.mono_latency_ms if streams[0].startswith("mono") else None
        self._latency_ms = config.latency_ms if own_ms is None else own_ms
        self._clock = self._make_clock(config.skew_ppm[skew_number % len(config.skew_ppm)] * 1e-6)
        self._frame = 0
        self._arrived_ns = 0
        self._again: Any = None
        self._held_back: Any = None
        self._moved_ns = 0
        self._stepped = self._missed_triggers = 0

    def _make_clock(self, skew: float) -> _Clock:
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
        stage, config = self._lab.stage, self._lab.config
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
        if self._faults.active("duplicate") is not None:
            self._again = made
        if self._faults.active("swap") is not None:
            self._faults.clear("swap")
            self._held_back = made
            return None
        return made

    def _stored(self) -> Any:
        """What a fault kept for this read."""
        stored, self._again = self._again, None
        return stored


class SyntheticRgbd(_Camera):
    """A D455-like camera: 32-bit microseconds, depth exposed apart from colour."""

    def __init__(self, lab: SyntheticLab, name: str) -> None:
        super().__init__(lab, name, ("d455/color", "d455/depth"), 0)

    def _make_clock(self, skew: float) -> _Clock:
        wrap = 1 << 32
        after_s = self._lab.config.wrap_after_s
        start = wrap * 1000 - round(after_s * 1e9) if after_s >= 0 else 10**9
        return _Clock("d455 hardware", self._lab.stage.epoch_ns, skew, start, 1000, wrap)

    def read(self, timeout_s: float) -> RgbdCapture | None:
        stored = self._stored()
        if stored is not None:
            return stored
        frame = self._next(timeout_s)
        if frame is None:
            return None
        host_ns = time.monotonic_ns()
        exposure_s = self._lab.show.color_exposure_s
        color = self._image("d455/color", frame, host_ns, exposure_s)
        depth = self._image("d455/depth", frame, host_ns, exposure_s)
        without = self._faults.active("no_depth") is not None
        made = RgbdCapture(color, None if without else depth, self._lab.show.depth_unit_m, aligned=True)
        if self._held_back is not None:
            made, self._held_back, self._again = made, None, self._held_back
            return made
        return self._delivered(made)

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

    def __init__(self, lab: SyntheticLab, name: str, stream: str, number: int) -> None:
        self._stream, self._number = stream, number
        super().__init__(lab, name, (stream,), 1 + number)

    def _make_clock(self, skew: float) -> _Clock:
        return _Clock(f"{self._stream} hardware", self._lab.stage.epoch_ns, skew, (self._number + 5) * 10**12, 1, None)

    def read(self, timeout_s: float) -> Image | None:
        stored = self._stored()
        if stored is not None:
            return stored
        frame = self._next(timeout_s)
        if frame is None:
            return None
        made = self._image(self._stream, frame, time.monotonic_ns(), self._lab.show.mono_exposure_s)
        made = replace(made, stream="image")
        if self._held_back is not None:
            made, self._held_back, self._again = made, None, self._held_back
            return made
        return self._delivered(made)

    def trigger(self) -> None:
        raise DeviceRefused(f"{self.name} waits for the hardware trigger (simulated)")

    def camera(self) -> CameraModel:
        """True intrinsics, for the rig's calibration."""
        return self._lab.show.cameras()[self._stream]

    def describe(self) -> dict[str, Any]:
        return self._described("simulated grey camera", self._lab.config.fps)


class _ArmBody:
    """Where the simulated arm and its fingers are at a time."""

    def __init__(self, lab: SyntheticLab) -> None:
        self._lab = lab
        self._lock = threading.Lock()
        self._trajectory: JointTrajectory | None = None
        self._started_ns = 0
        self._halted_ns: int | None = None
        self.reason = ""

    def move(self, trajectory: JointTrajectory) -> None:
        with self._lock:
            ready = self._lab.stage.ready
            plays = ready is not None and self._lab.show.is_of(ready, trajectory)
            self._started_ns = self._lab.stage.begin() if plays else time.monotonic_ns()
            self._trajectory, self._halted_ns, self.reason = trajectory, None, ""

    def halt(self, reason: str) -> None:
        with self._lock:
            if self._trajectory is not None and self._halted_ns is None and not self._over():
                self._halted_ns, self.reason = time.monotonic_ns(), reason

    def _over(self) -> bool:
        assert self._trajectory is not None
        return time.monotonic_ns() > self._started_ns + self._trajectory.duration_s * 1e9

    def motion(self) -> Motion:
        with self._lock:
            if self._trajectory is None:
                return Motion("none")
            end_ns = self._started_ns + round(self._trajectory.duration_s * 1e9)
            ticks = round(max(min(time.monotonic_ns(), end_ns) - self._started_ns, 0) / 1e6)
            if self._halted_ns is not None:
                return Motion("aborted", self.reason, ticks, 0, self._started_ns, self._halted_ns)
            if self._over():
                return Motion("done", "", ticks, 0, self._started_ns, end_ns)
            return Motion("moving", "", ticks, 0, self._started_ns)

    def states(self, host_ns: Int64[Array, " n"]) -> tuple[Float[Array, "n j"], Float[Array, "n j"]]:
        """True joint angles and speeds."""
        with self._lock:
            stage, trajectory = self._lab.stage, self._trajectory
            if trajectory is None or (self._halted_ns is None and stage.ready is not None):
                q = np.tile(self._lab.show.start_rad(stage.ready), (len(host_ns), 1))
                return q, np.zeros_like(q)
            last_ns = host_ns if self._halted_ns is None else np.minimum(host_ns, self._halted_ns)
            times_s = (last_ns - self._started_ns) / 1e9
            moving = (times_s <= trajectory.duration_s) & (last_ns == host_ns)
            q, dq = (
                np.stack([np.interp(times_s, trajectory.time_s, column) for column in rows.T], axis=1)
                for rows in (trajectory.q_rad, trajectory.dq_rad_s)
            )
            return q, np.where(moving[:, None], dq, 0.0)

    def width_m(self, host_ns: int) -> float:
        playing = self._lab.stage.playing(host_ns)
        if playing is None:
            return self._lab.show.held_width_m
        shown, time_s = playing
        return self._lab.show.width_m(shown.performance, time_s)


class SyntheticArm(_Device):
    """The Panda of the scene; 1 kHz, its own clock."""

    joint_names = tuple(f"panda_joint{i}" for i in range(1, 8))

    def __init__(self, lab: SyntheticLab, name: str, rate_hz: float) -> None:
        super().__init__(lab, name)
        self.rate_hz = rate_hz
        skew = lab.config.skew_ppm[-1] * 1e-6
        self._clock = _Clock("arm", lab.stage.epoch_ns, skew, 123 * 10**9, 1, None)
        self._number = 0
        self._rng = generator(lab.config.seed, 78)
        self._moved_ns = 0
        self._reflex = False

    def _begin(self) -> None:
        self._number = self._count(time.monotonic_ns())

    def _count(self, host_ns: int) -> int:
        return int((host_ns - self._lab.stage.epoch_ns) * self.rate_hz / 1e9)

    def _mode(self) -> ArmMode:
        if self._faults.active("user_stop") is not None:
            self._lab.arm.halt("user stop")
            return "user_stopped"
        if self._faults.active("reflex") is not None:
            self._faults.clear("reflex")
            self._reflex = True
            self._lab.arm.halt("reflex: collision (simulated)")
        if self._reflex:
            return "reflex"
        return "moving" if self._lab.arm.motion().status == "moving" else "idle"

    def read(self, timeout_s: float) -> ArmSamples | None:
        if not self._ready(timeout_s):
            return None
        due_ns = self._lab.stage.epoch_ns + round((self._number + 10) * 1e9 / self.rate_hz)
        if self._faults.active("silence") is not None:
            self._number = max(self._number, self._count(time.monotonic_ns()))
            self._wait_until(due_ns + 10**9, timeout_s)
            return None
        if not self._wait_until(due_ns, timeout_s):
            return None
        host_ns = time.monotonic_ns()
        last = self._count(host_ns - 200_000)
        numbers = np.arange(self._number + 1, last + 1, dtype=np.int64)
        self._number = last
        self._received("states", len(numbers))
        return self._samples(numbers, host_ns) if len(numbers) else None

    def _samples(self, numbers: Array, host_ns: int) -> ArmSamples:
        step = self._faults.active("clock_step")
        if step is not None:
            self._moved_ns += round(step.number("by_s", 1.0) * 1e9)
            self._faults.clear("clock_step")
        true_ns = [self._lab.stage.epoch_ns + round(n * 1e9 / self.rate_hz) for n in numbers.tolist()]
        q, dq = self._lab.arm.states(np.array(true_ns, dtype=np.int64))
        noise = self._rng.standard_normal((2, *q.shape)) * np.array(ARM_NOISE)[:, None, None]
        if self._faults.active("nan") is not None:
            noise = np.full_like(noise, np.nan)
        mode = self._mode()
        return ArmSamples(
            self._clock.name,
            numbers,
            np.array([self._clock.stamp(t, self._moved_ns).device_ns for t in true_ns], dtype=np.int64),
            np.minimum(np.array(true_ns, dtype=np.int64) + 200_000, host_ns),
            q + noise[0],
            dq + noise[1],
            q,
            dq,
            np.full_like(q, np.nan),
            np.ones(len(numbers)),
            (mode,) * len(numbers),
        )

    def move(self, trajectory: JointTrajectory) -> None:
        if self._mode() in ("reflex", "user_stopped"):
            raise DeviceRefused(f"{self.name} stands in {self._mode()}; release the stop, then recover")
        self._lab.arm.move(trajectory)

    def may_move(self) -> None:
        """A simulated arm hurts nobody."""

    def motion(self) -> Motion:
        return self._lab.arm.motion()

    def halt(self) -> None:
        self._lab.arm.halt("halted")

    def recover(self) -> None:
        if self._faults.active("user_stop") is not None:
            raise DeviceRefused(f"{self.name}: the user stop is pressed; release it, then recover")
        self._reflex = False

    def describe(self) -> dict[str, Any]:
        return {**self._described("simulated Panda", self.rate_hz), "robot": "panda"}


class SyntheticGripper(_Device):
    """The Panda's hand: opens some time after it is told to."""

    def __init__(self, lab: SyntheticLab, name: str, rate_hz: float) -> None:
        super().__init__(lab, name)
        self.rate_hz = rate_hz
        self._number = 0
        self._command: GripperCommand | None = None
        self._rng = generator(lab.config.seed, 79)

    def _begin(self) -> None:
        self._number = self._count(time.monotonic_ns())

    def _count(self, host_ns: int) -> int:
        return int((host_ns - self._lab.stage.epoch_ns) * self.rate_hz / 1e9)

    def read(self, timeout_s: float) -> GripperSample | None:
        if not self._ready(timeout_s):
            return None
        if not self._wait_until(self._lab.stage.epoch_ns + round((self._number + 1) * 1e9 / self.rate_hz), timeout_s):
            return None
        host_ns = time.monotonic_ns()
        self._number = self._count(host_ns)
        self._settle(host_ns)
        self._received("width")
        width = self._lab.arm.width_m(host_ns) + float(self._rng.normal(0, WIDTH_NOISE_M))
        return GripperSample(self._number, "host", host_ns, host_ns, width, 0.08, width < 0.075)

    def grasp(self, width_m: float, speed_m_s: float, force_n: float) -> None:
        self._command = GripperCommand("grasp", width_m, time.monotonic_ns())

    def release(self, width_m: float, speed_m_s: float) -> None:
        self._command = GripperCommand("move", width_m, time.monotonic_ns())

    def _settle(self, host_ns: int) -> None:
        """A command is acknowledged when the fingers have arrived."""
        command = self._command
        if command is None or command.acknowledged_host_ns is not None or command.error:
            return
        if self._faults.active("gripper_timeout") is not None:
            if host_ns - command.sent_host_ns > 1.5e9:
                self._command = replace(command, succeeded=False, error="no answer within 1.5 s (simulated)")
        elif host_ns - command.sent_host_ns > 0.25e9:
            self._command = replace(command, acknowledged_host_ns=host_ns, succeeded=True)

    def command(self) -> GripperCommand | None:
        self._settle(time.monotonic_ns())
        return self._command

    def describe(self) -> dict[str, Any]:
        return {**self._described("simulated Franka Hand", self.rate_hz)}


class SyntheticThrower:
    """Tosses of the simulated lab: planned by its own planner, rendered before they are played."""

    def __init__(self, lab: SyntheticLab) -> None:
        self._lab = lab
        self._ready: tuple[int, TossPlan] | None = None

    def prepare(self, toss: int, attempt: int, progress: Progress) -> TossPlan:
        number = toss + 1000 * attempt
        if self._ready is None or self._ready[0] != number or self._lab.stage.ready is None:
            plan = self._lab.show.plan(number)
            self._lab.stage.set_up(self._lab.show.perform(number, plan, progress))
            self._ready = number, plan
        return self._ready[1]

    def over(self) -> bool:
        return False

    def learn(self, delay_s: float) -> None:
        pass

    def get_ready(self) -> dict[str, Any]:
        return {}
