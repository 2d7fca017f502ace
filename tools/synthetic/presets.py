"""The variety that vision is tuned and judged on, as data: a name, and what differs from the usual scene."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from acquisition.synthetic.config import (
    ArmConfig,
    CameraConfig,
    ColorConfig,
    ContactConfig,
    DepthConfig,
    ErrorConfig,
    MonoConfig,
    MotionConfig,
    ObjectConfig,
    SceneConfig,
    Shape,
    Surface,
    TableStyle,
)
from recordings.errors import BadInput

USUAL = SceneConfig()


def _object(shape: Shape, surface: Surface, table: TableStyle = "wood", mass_kg: float = 0.3) -> SceneConfig:
    return replace(USUAL, object=ObjectConfig(shape, surface=surface, mass_kg=mass_kg), table=table)


BOX = _object("box", "textured", "speckled")
TOSSED_BY_ARM = replace(
    _object("prism", "textured", mass_kg=0.12),
    arm=ArmConfig(),
    color=ColorConfig(subframes=6),
    camera=CameraConfig(distance_m=0.95, distortion=(-0.055, 0.065, 0.0006, -0.0004, -0.02)),
    motion=MotionConfig(release_height_m=0.3, forward_speed_m_s=0.7, upward_speed_m_s=0.45, spin_rad_s=4.0),
)

TAGGED = _object("cube", "tagged")

PRESETS: dict[str, SceneConfig] = {
    # objects
    "cube-tagged": TAGGED,
    "cube-textured": _object("cube", "textured", "speckled"),
    "cube-few": _object("cube", "few", "plain"),
    "cube-plain": _object("cube", "plain"),
    "box-textured": BOX,
    "box-few": _object("box", "few"),
    "box-plain": _object("box", "plain", "plain"),
    "box-glossy": _object("box", "glossy"),
    "box-dark": _object("box", "dark", "speckled"),
    "prism-textured": _object("prism", "textured"),
    "prism-few": _object("prism", "few", "speckled"),
    "prism-plain": _object("prism", "plain", "wood"),
    "l-textured": _object("l", "textured", "plain"),
    "l-few": _object("l", "few"),
    "l-plain": _object("l", "plain", "speckled"),
    "l-glossy": _object("l", "glossy"),
    "mug-textured": _object("mug", "textured"),
    "mug-few": _object("mug", "few", "plain"),
    "mug-plain": _object("mug", "plain", "wood"),
    "mug-glossy": _object("mug", "glossy", "speckled"),
    "mug-dark": _object("mug", "dark", "plain"),
    # motion
    "spin-2": replace(BOX, motion=MotionConfig(spin_rad_s=2.0)),
    "spin-12": replace(BOX, motion=MotionConfig(spin_rad_s=12.0)),
    "spin-20": replace(BOX, motion=MotionConfig(spin_rad_s=20.0, lead_in_s=0.15)),
    # camera
    "near": replace(BOX, camera=CameraConfig(distance_m=0.5), motion=MotionConfig(release_height_m=0.18)),
    "far": replace(BOX, camera=CameraConfig(distance_m=1.2)),
    "distorted": replace(BOX, camera=CameraConfig(distortion=(-0.055, 0.065, 0.0006, -0.0004, -0.02))),
    "dropped": replace(BOX, camera=CameraConfig(dropped_share=0.05)),
    # light and exposure
    "exposure-1ms": replace(BOX, color=ColorConfig(exposure_s=0.001)),
    "exposure-16ms": replace(BOX, color=ColorConfig(exposure_s=0.016, subframes=16)),
    "drift-40": replace(BOX, color=ColorConfig(drift=0.4)),
    "dim": replace(BOX, color=ColorConfig(gain=0.4, noise=2.0)),
    # depth
    "depth-noise-2x": replace(BOX, depth=DepthConfig(noise=2.0)),
    "depth-high-accuracy": replace(BOX, depth=DepthConfig(preset="high-accuracy")),
    "depth-high-density": replace(BOX, depth=DepthConfig(preset="high-density")),
    "depth-scale": replace(BOX, depth=DepthConfig(scale=1.004)),
    "depth-late-8ms": replace(BOX, depth=DepthConfig(delay_s=0.008)),
    "depth-late-16ms": replace(BOX, depth=DepthConfig(delay_s=0.016)),
    # calibration
    "pose-error": replace(BOX, errors=ErrorConfig(camera_m=0.003, camera_deg=0.3, plane_m=0.003, plane_deg=0.3)),
    # the arm in view
    "arm-prism": TOSSED_BY_ARM,
    "arm-box": replace(TOSSED_BY_ARM, object=ObjectConfig("box", surface="textured", mass_kg=0.2), table="speckled"),
    "arm-l": replace(TOSSED_BY_ARM, object=ObjectConfig("l", surface="few", mass_kg=0.15)),
    "arm-mug": replace(TOSSED_BY_ARM, object=ObjectConfig("mug", surface="textured", mass_kg=0.2), table="plain"),
    "arm-slip-10mm": replace(TOSSED_BY_ARM, arm=ArmConfig(slip_m=0.01)),
    "arm-off": replace(
        TOSSED_BY_ARM, arm=ArmConfig(clock_offset_s=0.01), errors=ErrorConfig(base_m=0.005, base_deg=0.5)
    ),
    # ground truth cameras and board
    "mono": replace(TAGGED, mono=MonoConfig(board_views=12)),
    "no-release-time": replace(BOX, say_release=False),
}


SAMPLE_TOSSES = 4
SAMPLE = replace(
    USUAL,
    seed=11,
    object=ObjectConfig("box", (0.12, 0.1, 0.08), "tagged", mass_kg=0.3),
    contact=ContactConfig(friction=0.2),
    camera=CameraConfig(width=352, height=264, focal_px=480.0, distance_m=0.7, elevation_deg=36.0),
    motion=MotionConfig(
        release_height_m=0.3,
        forward_speed_m_s=0.4,
        upward_speed_m_s=0.6,
        spin_rad_s=6.0,
        hold_s=0.14,
        lead_in_s=0.17,
        rest_s=0.21,
    ),
    mono=MonoConfig(width=480, height=360, distance_m=0.75, tosses=(0,), jpeg_quality=90),
    table="plain",
)
"""The session that the repository ships: small pictures, mono images for its first toss only."""


def preset(name: str, seed: int | None = None) -> SceneConfig:
    """The scene of a preset. Without a seed its place in the list is taken, so that every preset looks different."""
    if name not in PRESETS:
        raise BadInput(f"no preset '{name}'; there are: {', '.join(PRESETS)}")
    return replace(PRESETS[name], seed=seed if seed is not None else 100 + list(PRESETS).index(name))


def described() -> Iterator[str]:
    """One line a preset: what differs from the usual scene."""
    for name, config in PRESETS.items():
        parts = [
            repr(getattr(config, part))
            for part in config.__dataclass_fields__
            if getattr(config, part) != getattr(USUAL, part)
        ]
        yield f"{name}: {'; '.join(parts) or 'the usual scene'}"
