"""A small lab that all tests look at: a tagged cube in a 320x240 camera, one mono camera trio of 640x480."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from acquisition.synthetic.config import ArmConfig, CameraConfig, MonoConfig, MotionConfig, ObjectConfig, SceneConfig
from acquisition.synthetic.lab import Lab
from acquisition.synthetic.planner import Motion

SMALL = SceneConfig(
    seed=5,
    object=ObjectConfig("cube", surface="tagged"),
    camera=CameraConfig(width=320, height=240),
    mono=MonoConfig(width=640, height=480, board_views=1),
    still_rays=600_000,
)


@pytest.fixture(scope="session")
def small() -> SceneConfig:
    return SMALL


@pytest.fixture(scope="session")
def lab() -> Lab:
    return Lab(SMALL)


@pytest.fixture(scope="session")
def motion(lab: Lab) -> Motion:
    return lab.plan(0)


@pytest.fixture(scope="session")
def arm_config() -> SceneConfig:
    return replace(
        SMALL,
        object=ObjectConfig("prism", surface="textured", mass_kg=0.12),
        camera=CameraConfig(width=320, height=240, distance_m=0.95, distortion=(-0.055, 0.065, 0.0006, -0.0004, -0.02)),
        motion=MotionConfig(release_height_m=0.3, forward_speed_m_s=0.7, upward_speed_m_s=0.45, spin_rad_s=4.0),
        arm=ArmConfig(slip_m=0.01),
        mono=None,
    )


@pytest.fixture(scope="session")
def arm_lab(arm_config: SceneConfig) -> Lab:
    return Lab(arm_config)


@pytest.fixture(scope="session")
def altered() -> Callable[..., SceneConfig]:
    """`altered(camera={"width": 64})`: the small scene with other values in its parts."""

    def alter(**parts: dict[str, object]) -> SceneConfig:
        changed = {name: replace(getattr(SMALL, name), **values) for name, values in parts.items()}
        return replace(SMALL, **changed)

    return alter
