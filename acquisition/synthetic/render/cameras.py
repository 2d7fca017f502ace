"""Where the cameras stand and what their lenses do."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import CameraConfig, MonoConfig
from recordings.geometry import CameraModel, DistortionModel, Transform, rotation_exp

AIM_M = np.array([0.0, 0.0, 0.08])
MONO_AZIMUTHS_DEG = (62.0, 183.0, -58.0)
"""Of the ground-truth cameras, against the colour camera's."""
MONO_ELEVATIONS_DEG = (48.0, 42.0, 52.0)
MONO_NAMES = ("mono0", "mono1", "mono2")


def look_at(config: CameraConfig) -> Transform:
    """world_from_d455: at a distance, elevation and azimuth from a point above the table's centre, looking at it."""
    azimuth, elevation = np.deg2rad(config.azimuth_deg), np.deg2rad(config.elevation_deg)
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    return aimed("d455", np.array([0.0, 0.0, config.aim_height_m]) + config.distance_m * away, -away)


def aimed(frame: str, position_m: Float[Array, "3"], forward: Float[Array, "3"]) -> Transform:
    """world_from_<frame> of an upright camera at a position that looks along `forward`."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return Transform("world", frame, np.stack([x, np.cross(z, x), z], 1), position_m)


def camera_model(config: CameraConfig) -> CameraModel:
    scale = config.width / 640
    dx, dy = config.principal_offset_px
    K = np.array(
        [
            [config.focal_px * scale, 0.0, (config.width - 1) / 2 + dx * scale],
            [0.0, config.focal_px * scale, (config.height - 1) / 2 + dy * scale],
            [0.0, 0.0, 1.0],
        ]
    )
    return CameraModel("d455", config.width, config.height, K, *lens(config.distortion))


def mono_pose(number: int, d455: CameraConfig, config: MonoConfig, rng: np.random.Generator) -> Transform:
    """world_from_mono<number>: around the table, each a little off its nominal place and turned about its axis."""
    azimuth = np.deg2rad(d455.azimuth_deg + MONO_AZIMUTHS_DEG[number] + rng.uniform(-5, 5))
    elevation = np.deg2rad(MONO_ELEVATIONS_DEG[number] + rng.uniform(-3, 3))
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    distance_m = config.distance_m * rng.uniform(0.95, 1.05)
    upright = aimed(MONO_NAMES[number], AIM_M + distance_m * away, -away)
    roll = rotation_exp(np.array([0.0, 0.0, np.deg2rad(rng.uniform(-4, 4))]))
    return Transform("world", upright.source, upright.rotation @ roll, upright.translation_m)


def mono_model(number: int, config: MonoConfig, rng: np.random.Generator) -> CameraModel:
    """Intrinsics of one ground-truth camera: focal length and principal point scatter as real lenses do."""
    scale = config.width / 1440
    focal = config.focal_px * scale * rng.uniform(0.99, 1.01)
    cx, cy = np.array([config.width - 1, config.height - 1]) / 2 + 8 * scale * rng.uniform(-1, 1, 2)
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return CameraModel(MONO_NAMES[number], config.width, config.height, K, *lens(config.distortion))


def lens(distortion: tuple[float, ...]) -> tuple[DistortionModel, tuple[float, ...]]:
    """Distortion model and coefficients as CameraModel takes them."""
    return ("brown-conrady", distortion) if any(distortion) else ("none", ())
