"""What devices give, as frozen records. Times are nanoseconds on the session clock unless the name says otherwise.

`time_ns` is the hardware mid-exposure time; `host_time_ns` is when the host received the message.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, UInt8, UInt16
from numpy import ndarray as Array

ImageEncoding = Literal["jpeg", "png", "rgb8", "mono8"]


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """One colour or mono image as it was recorded, not yet decoded: JPEG and PNG bytes are kept as they came.

    `index` is the device's frame number. `rgb8` and `mono8` are raw rows without padding.
    """

    camera: str
    index: int
    time_ns: int
    host_time_ns: int
    encoding: ImageEncoding
    width: int
    height: int
    data: bytes


@dataclass(frozen=True, eq=False)
class DepthImage:
    """One depth image in the device's own unit, in the depth camera's own optical frame.

    Depth along the optical axis is `raw * unit_m`; 0 means "no return".
    """

    camera: str
    index: int
    time_ns: int
    host_time_ns: int
    unit_m: float
    raw: UInt16[Array, "h w"]


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """One colour image with the depth aligned to it, as the camera saw it.

    `depth_m` is along the optical axis of the colour camera, in metres; 0 means "no return".
    `time_ns` and `depth_time_ns` are the hardware mid-exposure times of the two images: they need not be equal.
    """

    camera: str
    index: int
    time_ns: int
    depth_time_ns: int
    color_rgb: UInt8[Array, "h w 3"]
    depth_m: Float32[Array, "h w"]


@dataclass(frozen=True, eq=False)
class ArmStates:
    """A batch of joint states of the arm, in time order. `finger_width_m` is the distance between the finger pads
    (NaN where the gripper did not report one)."""

    time_ns: Int64[Array, " n"]
    joint_names: tuple[str, ...]
    q_rad: Float[Array, "n j"]
    dq_rad_s: Float[Array, "n j"]
    finger_width_m: Float[Array, " n"]

    def between(self, start_ns: int, end_ns: int) -> ArmStates:
        """The samples with start_ns <= time <= end_ns."""
        return self.part((self.time_ns >= start_ns) & (self.time_ns <= end_ns))

    def part(self, rows: Bool[Array, " n"] | slice) -> ArmStates:
        """Some of the samples."""
        return ArmStates(
            self.time_ns[rows], self.joint_names, self.q_rad[rows], self.dq_rad_s[rows], self.finger_width_m[rows]
        )


@dataclass(frozen=True, eq=False)
class TossCommand:
    """What the arm was asked to do: release pose and velocity of the tool in the world, at a planned time."""

    time_ns: int
    release_time_ns: int
    world_from_tool: Float[Array, "4 4"]
    linear_velocity_world_m_s: Float[Array, "3"]
    angular_velocity_world_rad_s: Float[Array, "3"]


EventKind = Literal["release", "first_impact", "rest", "note", "verdict"]


@dataclass(frozen=True)
class TossEvent:
    """Something that happened in a toss. `sigma_s` is the time's standard deviation, NaN where not known."""

    time_ns: int
    kind: EventKind
    source: str
    text: str = ""
    sigma_s: float = float("nan")


@dataclass(frozen=True)
class TossWindow:
    """The part of a toss that is flight and contact. A time that is not known is None."""

    toss: int
    release_time_ns: int | None
    first_impact_time_ns: int | None
    rest_time_ns: int | None


HealthLevel = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class HealthLine:
    """A line of the rig's health log."""

    time_ns: int
    level: HealthLevel
    name: str
    message: str


@dataclass(frozen=True, eq=False)
class StampedPose:
    """A pose at a time: `matrix` maps points of frame `source` to frame `target`. `status` as in ObjectTrack;
    a lost pose is NaN. `covariance`: 6x6 of (rotation vector in the target frame, rad; translation, m), or None.
    """

    time_ns: int
    target: str
    source: str
    matrix: Float[Array, "4 4"]
    status: Literal["tracked", "interpolated", "lost"] = "tracked"
    covariance: Float[Array, "6 6"] | None = None


def depth_in_metres(image: DepthImage) -> Float32[Array, "h w"]:
    """Depth along the optical axis in metres; 0 stays 0."""
    return image.raw.astype(np.float32) * np.float32(image.unit_m)
