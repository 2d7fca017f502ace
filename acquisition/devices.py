"""What this project asks of a device: four small protocols, and the records that devices hand over.

A driver is any class with these methods; it needs no base class. The life of a device:

    with camera:                 # open() .. close(): found, identified, settings applied
        camera.start()           # frames flow into the driver's own bounded buffer
        frame = camera.read(0.5) # the oldest one not yet read, or None after 0.5 s
        camera.stop()            # within 2 s

The rules that every driver keeps (tests/acquisition/drivers/test_behaviour.py runs on all of them):
- `read(timeout_s)` never waits longer than its timeout. None: nothing came. `DeviceLost`: nothing will come any more.
- No call but `open` waits longer than 2 s. `stop` and `close` may be called at any time, twice, from another thread.
- Frame numbers grow; a gap in them is a loss on the way from the device. What the driver itself threw away is counted
  in `health().dropped`, by stream; a driver that sees the gaps may count them there too: who counts the gaps in the
  numbers does not add the two.
- Stamps are as the device gave them (`Stamp`): no driver maps clocks. `host_ns` is `time.monotonic_ns()` at receipt.
- A device that is not there, or is another one than the rig asks for: `recordings.errors.DeviceNotFound`, naming what
  was found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int64, UInt8, UInt16
from numpy import ndarray as Array

from recordings.errors import TosslabError
from recordings.geometry import CameraModel, Transform


class DeviceLost(TosslabError):
    """The device was there and is gone: unplugged, its power or its network failed. Only a new `open` may help."""


class DeviceRefused(TosslabError):
    """The device is there and does not do what was asked: a rate, a setting, a motion while it stands in reflex."""


Instant = Literal["mid_exposure", "exposure_start", "exposure_end", "arrival"]


@dataclass(frozen=True)
class Stamp:
    """A reading of one clock, as it was given: `ticks` of `tick_ns` each, starting over at `wrap_ticks`.

    `clock` names the counter: two stamps can be compared only within one clock. `instant` says which moment of the
    exposure the stamp marks; "arrival" is no capture time at all. None: the clock never wraps (64 bit).
    """

    clock: str
    ticks: int
    tick_ns: int = 1
    wrap_ticks: int | None = None
    instant: Instant = "mid_exposure"

    @property
    def device_ns(self) -> int:
        """Nanoseconds on the device's clock, not unwrapped."""
        return self.ticks * self.tick_ns


@dataclass(frozen=True, eq=False)
class Image:
    """One image of one stream, raw. `number` is the device's frame number, made 64 bit by the driver.

    `exposure_s` and `gain` are what the device used for this very image; NaN where it does not say.
    """

    stream: str
    number: int
    stamp: Stamp
    host_ns: int
    pixels: UInt8[Array, "h w"] | UInt8[Array, "h w 3"] | UInt16[Array, "h w"]
    exposure_s: float = float("nan")
    gain: float = float("nan")

    @property
    def mid_exposure_ns(self) -> int:
        """Mid-exposure on the device's own clock, not unwrapped; the stamp itself where the exposure is not known."""
        half_ns = 0 if np.isnan(self.exposure_s) else round(self.exposure_s * 5e8)
        shift = {"exposure_start": half_ns, "exposure_end": -half_ns}.get(self.stamp.instant, 0)
        return self.stamp.device_ns + shift


@dataclass(frozen=True, eq=False)
class RgbdCapture:
    """What an RGBD camera saw at about one time. Colour and depth are exposed apart and carry a stamp each.

    `depth` is z16 in units of `unit_m`, in the depth camera's frame (with `aligned` in the colour camera's); a part
    that the device did not deliver in time is None, and counted. `infrared` are mono8 images "infrared1" (left, the
    depth's own frame) and "infrared2", where they were asked for.
    """

    color: Image | None
    depth: Image | None
    unit_m: float
    aligned: bool = False
    infrared: tuple[Image, ...] = ()

    def images(self) -> tuple[Image, ...]:
        return tuple(image for image in (self.color, self.depth, *self.infrared) if image is not None)


ArmMode = Literal["idle", "moving", "guiding", "reflex", "user_stopped", "recovering", "error"]


@dataclass(frozen=True, eq=False)
class ArmSamples:
    """A batch of the arm's states, oldest first. NaN where the arm does not report a value.

    `time_ns` is the arm's own clock `clock`; `number` its state counter (a gap is a lost state); `success_rate` the
    share of the last 100 commands that arrived in time, as the arm counts it.
    """

    clock: str
    number: Int64[Array, " n"]
    time_ns: Int64[Array, " n"]
    host_ns: Int64[Array, " n"]
    q_rad: Float[Array, "n j"]
    dq_rad_s: Float[Array, "n j"]
    q_desired_rad: Float[Array, "n j"]
    dq_desired_rad_s: Float[Array, "n j"]
    torque_nm: Float[Array, "n j"]
    success_rate: Float[Array, " n"]
    modes: tuple[ArmMode, ...]


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Where the joints are to be, and how fast, at growing times from 0 on. Drivers sample it at their own rate."""

    time_s: Float[Array, " n"]
    q_rad: Float[Array, "n j"]
    dq_rad_s: Float[Array, "n j"]

    def at(self, time_s: float) -> tuple[Float[Array, " j"], Float[Array, " j"]]:
        """Position and velocity by cubic Hermite interpolation; before the start and after the end: standing there."""
        last = len(self.time_s) - 1
        if time_s <= self.time_s[0] or last == 0:
            return self.q_rad[0], self.dq_rad_s[0]
        if time_s >= self.time_s[last]:
            return self.q_rad[last], np.zeros_like(self.dq_rad_s[last])
        i = int(np.searchsorted(self.time_s, time_s, side="right")) - 1
        h = float(self.time_s[i + 1] - self.time_s[i])
        u = (time_s - float(self.time_s[i])) / h
        q0, q1, m0, m1 = self.q_rad[i], self.q_rad[i + 1], h * self.dq_rad_s[i], h * self.dq_rad_s[i + 1]
        rise = 3 * u**2 - 2 * u**3
        q = q0 + rise * (q1 - q0) + (u - 2 * u**2 + u**3) * m0 + (u**3 - u**2) * m1
        slope = 6 * u * (1 - u) * (q1 - q0) + (1 - 4 * u + 3 * u**2) * m0 + (3 * u**2 - 2 * u) * m1
        return q, slope / h

    def sampled(self, rate_hz: float) -> Float[Array, "m j"]:
        """Positions at every cycle of a control loop, from the start on to just after the end; as `at` gives them."""
        cycles = np.arange(int(np.ceil(self.duration_s * rate_hz)) + 1) / rate_hz
        if len(self.time_s) == 1:
            return np.repeat(self.q_rad, len(cycles), axis=0)
        t = np.clip(cycles, self.time_s[0], self.time_s[-1])
        i = np.clip(np.searchsorted(self.time_s, t, side="right") - 1, 0, len(self.time_s) - 2)
        h = (self.time_s[i + 1] - self.time_s[i])[:, None]
        u = (t - self.time_s[i])[:, None] / h
        rise = 3 * u**2 - 2 * u**3
        turns = (u - 2 * u**2 + u**3) * self.dq_rad_s[i] + (u**3 - u**2) * self.dq_rad_s[i + 1]
        return self.q_rad[i] + rise * (self.q_rad[i + 1] - self.q_rad[i]) + h * turns

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1])


@dataclass(frozen=True)
class Motion:
    """What became of the last trajectory. `ticks`: control cycles run; `missed`: cycles that the client reported late.

    `reason` says in words why an aborted motion ended. Host times are `time.monotonic_ns()`; `started_host_ns` is when
    the arm passes the trajectory's time 0 (what it follows late is in it).
    """

    status: Literal["none", "moving", "done", "aborted"]
    reason: str = ""
    ticks: int = 0
    missed: int = 0
    started_host_ns: int | None = None


@dataclass(frozen=True)
class GripperSample:
    """Distance between the finger pads, at a time of the gripper's (or, named so, the host's) clock."""

    number: int
    clock: str
    time_ns: int
    host_ns: int
    width_m: float
    max_width_m: float
    grasped: bool


@dataclass(frozen=True)
class GripperCommand:
    """One command to the fingers: when it left, when the gripper said done, and whether it did it.

    The fingers begin to move somewhere between the two: neither is the release time.
    """

    kind: Literal["grasp", "move", "homing"]
    width_m: float
    sent_host_ns: int
    acknowledged_host_ns: int | None = None
    succeeded: bool | None = None
    error: str = ""


@dataclass(frozen=True)
class Health:
    """Frames or states since `start`, by stream: handed to the driver, and lost or thrown away before `read`."""

    level: Literal["ok", "warning", "error"] = "ok"
    message: str = ""
    received: Mapping[str, int] = field(default_factory=dict)
    dropped: Mapping[str, int] = field(default_factory=dict)
    absent: bool = False
    """Nothing is to be expected of it in this toss: a recording that does not hold it."""


@runtime_checkable
class Device(Protocol):
    """What all four have in common."""

    name: str
    """The rig's name for it, e.g. "d455", "mono0", "arm"."""

    def open(self) -> None:
        """Find the device, check its serial, apply the settings. Raises DeviceNotFound or DeviceRefused."""

    def start(self) -> None: ...
    def stop(self) -> None: ...
    def close(self) -> None: ...
    def __enter__(self) -> Any:
        """open()"""

    def __exit__(self, *exc: object) -> None:
        """stop() and close()"""

    def describe(self) -> dict[str, Any]:
        """JSON-able, after `open`: at least `kind`, `model`, `serial`, `firmware`, `driver`, `settings`, `warnings`."""

    def health(self) -> Health: ...


@runtime_checkable
class RgbdCamera(Device, Protocol):
    """Colour and depth. `describe()["rate_hz"]` is the rate asked for and granted."""

    def read(self, timeout_s: float) -> RgbdCapture | None: ...

    def set_emitter(self, on: bool) -> None:
        """The infrared dot projector; while streaming too."""

    def cameras(self) -> Mapping[str, CameraModel]:
        """While it streams, the factory's intrinsics by stream: "color", "depth", "infrared1", "infrared2". Empty for
        the replay of a session that does not have them."""

    def color_from_depth(self) -> Transform:
        """The factory's extrinsics of depth in the colour camera's optical frame (the identity when aligned)."""


@runtime_checkable
class MonoCamera(Device, Protocol):
    """One grey camera."""

    def read(self, timeout_s: float) -> Image | None: ...

    def trigger(self) -> None:
        """Expose now. Raises DeviceRefused unless the camera was set to the software trigger."""


@runtime_checkable
class Arm(Device, Protocol):
    """A robot arm. `start` begins the state stream; a motion runs in the driver's own thread."""

    joint_names: tuple[str, ...]
    rate_hz: float

    def read(self, timeout_s: float) -> ArmSamples | None:
        """All states since the last read, in one batch. An arm in reflex or user stop goes on reporting."""

    def move(self, trajectory: JointTrajectory) -> None:
        """Begin to follow it; returns at once. Raises DeviceRefused when the arm is not ready, does not stand at the
        trajectory's start, or is moving."""

    def may_move(self) -> None:
        """Raises DeviceRefused, saying what to do, where the arm or this computer is not fit for a motion now."""

    def motion(self) -> Motion: ...

    def halt(self) -> None:
        """Stop the motion, if any, within 2 s. No replacement for the emergency stop."""

    def recover(self) -> None:
        """Leave a reflex. Raises DeviceRefused while the user stop is pressed."""


@runtime_checkable
class TakesLoad(Protocol):
    """An arm that is told what its hand holds."""

    def set_load(self, mass_kg: float, centre_flange_m: Float[Array, "3"], radius_m: float) -> None:
        """A full ball of this mass about a point in the flange's frame; mass 0: nothing. Not during a motion."""


@runtime_checkable
class Gripper(Device, Protocol):
    """Two fingers. Commands return at once; `command()` tells what became of the last one."""

    def read(self, timeout_s: float) -> GripperSample | None: ...
    def grasp(self, width_m: float, speed_m_s: float, force_n: float) -> None: ...

    def release(self, width_m: float, speed_m_s: float) -> None:
        """Open the fingers to this width."""

    def command(self) -> GripperCommand | None: ...
