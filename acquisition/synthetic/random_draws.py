"""What is drawn at random, each purpose from its own seeded numbers: releases, frame times, brightness, errors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import SceneConfig
from acquisition.synthetic.motion import Release
from recordings.geometry import Transform, rotation_exp


def generator(*key: int) -> np.random.Generator:
    """The random numbers of one purpose: the same key, the same numbers."""
    return np.random.default_rng(np.random.SeedSequence(key))


ROOM, OBJECT, TOSS, FIXED_PATTERN, STILL, COLOR, DEPTH, MONO, TIMES, ERRORS, MONO_PLACES, ARM_NOISE, BOARD = range(13)


def draw_release(config: SceneConfig, radius_m: float, rng: np.random.Generator) -> Release:
    """A random release state that should end near the target."""
    motion = config.motion
    vary = 1 + motion.spread * np.clip(rng.standard_normal(3), -2, 2)
    forward, upward, spin = np.maximum(vary, 0.1) * [
        motion.forward_speed_m_s,
        motion.upward_speed_m_s,
        motion.spin_rad_s,
    ]
    heading = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    gravity = config.contact.gravity_m_s2
    fall_m = max(motion.release_height_m - 0.6 * radius_m, 0.0)
    flight_s = (upward + np.sqrt(upward**2 + 2 * gravity * fall_m)) / gravity
    slide_m = 0.5 * forward**2 / (2 * gravity * max(config.contact.friction, 0.05))
    target = np.array([*motion.target_m, 0.0]) + np.append(rng.normal(0, motion.target_spread_m, 2), 0.0)
    start = target - direction * (forward * flight_s + slide_m) + [0.0, 0.0, motion.release_height_m]
    axis = rng.standard_normal(3)
    rotation = rotation_exp(rng.uniform(0, np.pi) * _unit(rng.standard_normal(3)))
    return Release(
        Transform("world", "object", rotation, start),
        forward * direction + [0.0, 0.0, upward],
        spin * _unit(axis),
    )


def small_error(frame: str, length_m: float, angle_deg: float, rng: np.random.Generator) -> Transform:
    """A shift and a turn of exactly these sizes in random directions."""
    shift, axis = _unit(rng.standard_normal(3)), _unit(rng.standard_normal(3))
    return Transform(frame, frame, rotation_exp(np.deg2rad(angle_deg) * axis), length_m * shift)


def exposure_times(time_s: float, exposure_s: float, count: int) -> list[float]:
    """Middles of `count` equal parts of the exposure."""
    return [time_s + exposure_s * ((k + 0.5) / count - 0.5) for k in range(count)]


def _unit(vector: Float[Array, "3"]) -> Float[Array, "3"]:
    return vector / np.linalg.norm(vector)
