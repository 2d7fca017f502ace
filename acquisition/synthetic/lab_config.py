"""How the simulated lab departs from an ideal one: the settings of a rig's `[simulation]`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class SyntheticConfig:
    """How the simulated lab departs from an ideal one."""

    seed: int = 0
    pictures: Literal["rendered", "pool"] = "rendered"
    """`pool`: a few noisy pictures again and again, for rates that no renderer reaches here."""
    color_size: tuple[int, int] = (424, 240)
    color_focal_px: float = 430.0
    mono_size: tuple[int, int] = (480, 360)
    mono_cameras: int = 3
    fps: float = 30.0
    object: Literal["cube", "box", "prism", "l", "mug"] = "cube"
    surface: Literal["textured", "tagged", "few", "plain", "glossy", "dark"] = "tagged"
    object_size_m: tuple[float, float, float] | None = (0.07, 0.07, 0.07)
    skew_ppm: tuple[float, ...] = (25.0, -14.0, 9.0, -31.0, 6.0)
    """Of the clocks of the RGBD camera, the grey cameras in turn (cyclic), the arm (last)."""
    latency_ms: float = 5.2
    """Smallest time from mid-exposure to receipt."""
    mono_latency_ms: float | None = None
    """The same of the grey cameras, where it is another."""
    latency_jitter_ms: float = 1.0
    """Mean of what comes on top (exponential)."""
    depth_delay_ms: float = 0.0
    dropped_share: float = 0.0
    buffer_frames: int = 16
    """What a camera's driver holds for a slow reader; older frames are thrown away and counted."""
    wrap_after_s: float = 8.0
    """When the RGBD camera's 32-bit microseconds start over (negative: never in a session)."""
    gripper_delay_ms: float = 60.0
    gripper_delay_sigma_ms: float = 6.0
    board_views: int = 48
    """How often the board is shown to one of the cameras, or the arm holds it up."""
    subframes: int = 1
