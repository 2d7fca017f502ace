"""All settings of the synthetic lab, as data. Every default is a plausible D455 lab; everything is seeded by `seed`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from recordings.constants import GRAVITY_M_S2

Shape = Literal["cube", "box", "prism", "l", "mug", "mesh"]
Surface = Literal["textured", "tagged", "few", "plain", "glossy", "dark"]
DepthPreset = Literal["default", "high-accuracy", "high-density"]
TableStyle = Literal["wood", "speckled", "plain"]


@dataclass(frozen=True)
class ObjectConfig:
    """What is tossed."""

    shape: Shape = "cube"
    size_m: tuple[float, float, float] | None = None
    """Extents; None: the shape's usual ones (see objects.USUAL_SIZE_M). A mesh file is scaled to them when given."""
    surface: Surface = "textured"
    mass_kg: float = 0.37
    mesh_file: Path | None = None
    """For shape `mesh`: an .obj, .ply or .stl file, metres, watertight."""


@dataclass(frozen=True)
class ContactConfig:
    """Contact with the table (MuJoCo's soft contact)."""

    friction: float = 0.25
    torsional_friction_m: float = 0.0005
    time_constant_s: float = 0.004
    damping_ratio: float = 0.6
    step_s: float = 0.0005
    gravity_m_s2: float = GRAVITY_M_S2


@dataclass(frozen=True)
class MotionConfig:
    """One toss: hold, lead-in up to the release velocity, flight and contact, rest."""

    release_height_m: float = 0.28
    """Of the object's centre above the table."""
    forward_speed_m_s: float = 0.5
    upward_speed_m_s: float = 0.7
    spin_rad_s: float = 6.0
    spread: float = 0.2
    """Standard deviation of the speeds from toss to toss, as a share."""
    hold_s: float = 0.28
    lead_in_s: float = 0.2
    rest_s: float = 0.28
    longest_free_s: float = 2.0
    target_m: tuple[float, float] = (0.0, 0.0)
    """Where on the table the toss is meant to land."""
    target_spread_m: float = 0.04


@dataclass(frozen=True)
class CameraConfig:
    """The D455's colour camera and where it stands. Distance is to the aim point above the table's centre."""

    width: int = 640
    height: int = 480
    focal_px: float = 386.0
    """At a width of 640; scaled with the width."""
    principal_offset_px: tuple[float, float] = (2.4, 1.8)
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    fps: float = 30.0
    time_jitter_s: float = 0.0002
    distance_m: float = 0.8
    elevation_deg: float = 33.0
    azimuth_deg: float = -90.0
    aim_height_m: float = 0.08
    dropped_share: float = 0.0


@dataclass(frozen=True)
class ColorConfig:
    """Exposure, noise and compression of the colour image (sRGB response)."""

    exposure_s: float = 0.004
    drift: float = 0.0
    """Largest departure of the exposure's brightness during a toss, as a share (0.4: 40 %)."""
    gain: float = 1.0
    """Brightness against a well exposed image."""
    noise: float = 1.0
    """Factor on the sensor's noise."""
    jpeg_quality: int = 95
    subframes: int = 8


@dataclass(frozen=True)
class DepthConfig:
    """A D455's depth errors. Disparities are of the sensor's own stereo pair, in pixels."""

    preset: DepthPreset = "default"
    noise: float = 1.0
    """Factor on all random disparity errors."""
    stereo_focal_px: float = 385.0
    baseline_m: float = 0.095
    fine_sigma_px: float = 0.08
    coarse_sigma_px: float = 0.03
    fixed_share: float = 0.5
    """Share of the disparity noise's variance that stays the same in every frame."""
    quantum_px: float = 1.0 / 32.0
    scale: float = 1.0
    """Reported depth / true depth."""
    delay_s: float = 0.0
    """Depth is exposed this much later than colour (negative: earlier)."""
    unit_m: float = 0.001
    nearest_m: float = 0.2
    farthest_m: float = 2.2


@dataclass(frozen=True)
class MonoConfig:
    """The three ground-truth cameras: triggered together, grey, linear response."""

    width: int = 1440
    height: int = 1080
    focal_px: float = 1370.0
    """At a width of 1440; scaled with the width."""
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    distance_m: float = 0.95
    exposure_s: float = 0.001
    trigger_delay_s: float = 0.0061
    """Against the nominal colour grid."""
    noise: float = 0.5
    jpeg_quality: int = 95
    subframes: int = 4
    tosses: tuple[int, ...] | None = None
    """Which tosses get mono images; None: all."""
    board_views: int = 0
    """Views of the calibration board, at rest, by all cameras."""


@dataclass(frozen=True)
class ArmConfig:
    """A Franka Panda that holds the object, winds up, tosses and releases."""

    base_m: tuple[float, float] = (0.0, 0.6)
    base_yaw_deg: float = -90.0
    wind_up_s: float = 0.7
    slip_m: float = 0.0
    """How far the object slides between the finger pads before the release."""
    clock_offset_s: float = 0.0
    """arm.csv's stamps minus true time."""
    finger_open_s: float = 0.04


@dataclass(frozen=True)
class LightConfig:
    """A key light with soft shadows, a large fill light, ambient light; strengths are relative."""

    key: float = 1.0
    fill: float = 0.45
    ambient: float = 0.4
    key_position_m: tuple[float, float, float] = (-0.7, -0.5, 1.7)
    key_radius_m: float = 0.08
    fill_position_m: tuple[float, float, float] = (0.9, 0.3, 1.9)
    fill_radius_m: float = 0.3
    key_rgb: tuple[float, float, float] = (1.0, 0.97, 0.92)


@dataclass(frozen=True)
class ErrorConfig:
    """What session.json says wrongly; truth keeps the real values."""

    camera_m: float = 0.0
    camera_deg: float = 0.0
    plane_m: float = 0.0
    plane_deg: float = 0.0
    base_m: float = 0.0
    base_deg: float = 0.0


@dataclass(frozen=True)
class SceneConfig:
    """The whole lab. Two equal configs give equal bytes."""

    seed: int = 0
    object: ObjectConfig = field(default_factory=ObjectConfig)
    contact: ContactConfig = field(default_factory=ContactConfig)
    motion: MotionConfig = field(default_factory=MotionConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    color: ColorConfig = field(default_factory=ColorConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    mono: MonoConfig | None = None
    arm: ArmConfig | None = None
    light: LightConfig = field(default_factory=LightConfig)
    errors: ErrorConfig = field(default_factory=ErrorConfig)
    table: TableStyle = "wood"
    table_tags: bool = True
    still_rays: int = 6_400_000
    """Rays spent on a camera's picture of the room: 4 a pixel at 1440x1080 (at least 1, at most 16)."""
    say_release: bool = True
    """Write release_time_s into toss.json."""
