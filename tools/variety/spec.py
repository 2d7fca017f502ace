"""What a session is, drawn whole from its seed: object, camera, light, scene, errors of calibration, physics.

The ranges were set beforehand, none of them fitted to a recording. `Spec` is plain data, written beside the truth.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from variety.appearance import KINDS
from variety.seeds import Case
from variety.shapes import FAMILIES, log_uniform

RESOLUTIONS = ((424, 240), (640, 360), (640, 480), (848, 480), (960, 540), (1280, 720))
FOCAL_PX = (380.0, 920.0)
VIEW_DEG = (42.0, 88.0)
"""Horizontal field of view of RealSense colour cameras, crops included."""
TABLES = ("cloth", "wood", "steel", "towel", "mat")
TOSSES = (1, 2, 2, 3, 3, 3, 4, 4, 5, 6, 8, 12)
ARM_SHARE = 0.2
BAD = ("twice", "rolls out", "hand stays")


@dataclass(frozen=True)
class CameraSpec:
    """Colour camera: pinhole in pixels, Brown-Conrady, where it stands, how it exposes."""

    width: int
    height: int
    focal_px: float
    center_off_px: tuple[float, float]
    distortion: tuple[float, ...]
    distance_m: float
    elevation_deg: float
    azimuth_deg: float
    exposure_s: float
    readout_s: float
    """Between the first and the last row; 0: global shutter."""
    gain_drift: float
    white_drift: float
    vignette: float
    blur_px: float
    noise: float
    jpeg: int
    dropped: float


@dataclass(frozen=True)
class DepthSpec:
    """The infrared pair and what is done with its depth."""

    preset: str
    spatial_filter: bool
    exposure_s: float
    projector: float
    ambient: float
    noise: float
    unit_m: float


@dataclass(frozen=True)
class Wrong:
    """What the calibration and the stamps say wrongly (true things differ by this)."""

    camera_m: float
    camera_deg: float
    focal_share: float
    center_px: float
    depth_scale: float
    depth_delay_s: float
    delay_known: bool
    table_wave_m: float
    gravity_deg: float
    hand_eye_m: float
    hand_eye_deg: float
    arm_clock_s: float


@dataclass(frozen=True)
class Spec:
    """A whole session."""

    name: str
    seed: int
    family: str
    surface: str
    mass_manner: str
    friction: float
    restitution: float
    engine: str
    drag_coefficient: float
    spin_rad_s: float
    tosses: tuple[str, ...]
    """Each `good` or one of BAD."""
    table: str
    holder: str
    clutter: int
    person: bool
    occluder: str
    lamps: int
    wall: bool
    say_release: bool
    arm: bool
    """A Panda tosses, where its hand can close on the object (then there is no other holder and no bad toss)."""
    camera: CameraSpec
    depth: DepthSpec
    wrong: Wrong

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def draw(case: Case, tosses: int | None = None) -> Spec:
    """The session of a case; `tosses` bounds their number (the rest of the session stays the same)."""
    rng = np.random.default_rng(case.seed)
    family = FAMILIES[case.number % len(FAMILIES)]
    surface = KINDS[case.number % len(KINDS)]  # their numbers share no divisor: every family has every surface in turn
    kinds = tuple("good" if rng.random() < 0.85 else str(rng.choice(BAD)) for _ in range(int(rng.choice(TOSSES))))
    spec = Spec(
        case.name, case.seed, family, surface, str(rng.choice(["solid", "hollow", "off-centre"])),
        float(rng.uniform(0.05, 0.8)), float(rng.uniform(0.0, 0.7)), ("mujoco", "rigid")[int(rng.integers(2))],
        float(rng.uniform(0.4, 1.2)), float(rng.uniform(0.0, 25.0)), kinds, str(rng.choice(TABLES)),
        str(rng.choice(["none", "none", "hand", "hand", "gripper"])), int(rng.integers(0, 9)),
        bool(rng.random() < 0.12), str(rng.choice(["none"] * 8 + ["standing", "passing"])), int(rng.integers(1, 6)),
        bool(rng.random() < 0.75), bool(rng.random() < 0.7), _arm_tosses(case),
        _camera(rng), _depth(rng), _wrong(rng),
    )  # fmt: skip
    return spec if tosses is None else replace(spec, tosses=spec.tosses[:tosses])


def _arm_tosses(case: Case) -> bool:
    return bool(np.random.default_rng([case.seed, 1]).random() < ARM_SHARE)


def _camera(rng: np.random.Generator) -> CameraSpec:
    while True:
        width, height = RESOLUTIONS[int(rng.integers(len(RESOLUTIONS)))]
        focal = width / 2 / np.tan(np.deg2rad(rng.uniform(*VIEW_DEG)) / 2)
        if FOCAL_PX[0] <= focal <= FOCAL_PX[1]:
            break
    bent = rng.random() < 0.5
    k1 = rng.uniform(-0.12, 0.1)
    distortion = (k1, -0.6 * k1 + rng.uniform(-0.03, 0.03), rng.uniform(-1e-3, 1e-3), rng.uniform(-1e-3, 1e-3), 0.0)
    reach = 0.55 * focal / (0.5 * width)
    return CameraSpec(
        width, height, float(focal), (float(rng.uniform(-0.015, 0.015) * width), float(rng.uniform(-8, 8))),
        tuple(float(k) for k in distortion) if bent else (0.0,) * 5,
        float(np.clip(reach * rng.uniform(0.75, 1.15), 0.5, 1.15)), float(rng.uniform(22.0, 62.0)),
        float(rng.uniform(-180.0, 180.0)), log_uniform(rng, 0.0015, 0.012),
        float(rng.uniform(0.004, 0.016)) if rng.random() < 0.35 else 0.0, float(rng.uniform(0.0, 0.3)),
        float(rng.uniform(0.0, 0.06)), float(rng.uniform(0.0, 0.35)), float(rng.uniform(0.0, 1.0) * width / 900),
        float(rng.uniform(0.5, 2.5)), int(rng.integers(60, 98)), float(rng.choice([0.0, 0.0, 0.02, 0.05])),
    )  # fmt: skip


def _depth(rng: np.random.Generator) -> DepthSpec:
    preset = str(rng.choice(["default", "default", "high-density", "high-accuracy"]))
    return DepthSpec(
        preset, bool(rng.random() < 0.35), log_uniform(rng, 0.0008, 0.006), float(rng.uniform(0.5, 1.5)),
        float(rng.uniform(0.05, 0.8)), float(rng.uniform(0.6, 2.0)), float(rng.choice([0.001, 0.001, 0.00025])),
    )  # fmt: skip


def _wrong(rng: np.random.Generator) -> Wrong:
    return Wrong(
        float(rng.uniform(0, 0.008)), float(rng.uniform(0, 1.0)), float(rng.uniform(-0.005, 0.005)),
        float(rng.uniform(0, 2.0)), float(rng.uniform(0.98, 1.02)), float(rng.uniform(0, 0.016)),
        bool(rng.random() < 0.5), float(rng.uniform(0, 0.001)), float(rng.uniform(0, 0.5)),
        float(rng.uniform(0, 0.01)), float(rng.uniform(0, 1.0)), float(rng.uniform(0, 0.03)),
    )  # fmt: skip
