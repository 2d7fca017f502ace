"""Reading the pieces that TagSLAM's files are made of: poses, noises, times.

Rotations there are axis-angle vectors. `R` is written as an upper-triangular root information matrix in (rotation,
translation) order.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.bounded.yaml_file import parse_yaml
from recordings.errors import BadInput
from recordings.geometry import rotation_exp


@dataclass(frozen=True, eq=False)
class NoisyPose:
    """A pose (4x4) and the root information (6x6) of what is known about it."""

    pose: Float[Array, "4 4"]
    root_information: Float[Array, "6 6"]


def noisy(entry: Mapping[str, Any], rotation_noise: float, position_noise: float) -> NoisyPose:
    """A pose with its noise: `rotation_noise` and `position_noise` by axis, or `R`, or the two given ones (rad, m)."""
    stated = "rotation_noise" in entry and "position_noise" in entry
    if "R" in entry and not stated:
        # TagSLAM writes R row by row and reads it column by column: what it works with is the transpose
        return NoisyPose(matrix(entry), np.array(entry["R"], dtype=np.float64).reshape(6, 6).T)
    turn = xyz(entry["rotation_noise"]) if "rotation_noise" in entry else np.full(3, rotation_noise)
    shift = xyz(entry["position_noise"]) if "position_noise" in entry else np.full(3, position_noise)
    return NoisyPose(matrix(entry), np.diag(1 / np.concatenate([turn, shift])))


def matrix(entry: Mapping[str, Any]) -> Float[Array, "4 4"]:
    out = np.eye(4)
    out[:3, :3] = rotation_exp(xyz(entry["rotation"]))
    out[:3, 3] = xyz(entry["position"])
    return out


def xyz(entry: Mapping[str, Any]) -> Float[Array, "3"]:
    return np.array([float(entry["x"]), float(entry["y"]), float(entry["z"])])


def time_ns(value: Any) -> int:
    """Seconds since 1970 as text or number to nanoseconds, without losing digits where text was given."""
    text = str(value)
    if "e" in text.lower():
        return int(float(text) * 1e9)
    whole, _, part = text.partition(".")
    return int(whole) * 1_000_000_000 + int((part + "000000000")[:9] or 0)


def rounded_ns(value: Any) -> int:
    """Seconds as TagSLAM reads those of a remap: through a double, which rounds them to a quarter of a microsecond."""
    seconds = float(value)
    return int(seconds // 1) * 1_000_000_000 + round((seconds - seconds // 1) * 1e9)


def load(path: Path) -> dict[str, Any]:
    try:
        data = path.read_bytes()
    except OSError as refused:
        raise BadInput(f"{path} cannot be read: {refused.strerror}; wanted a TagSLAM configuration folder") from refused
    document = parse_yaml(data, str(path), _times_as_text)
    if not isinstance(document, dict):
        raise BadInput(f"{path}: wanted a mapping at the top, found {type(document).__name__}")
    return document


def _times_as_text(text: str) -> str:
    """Nanoseconds since 1970 do not fit into a double: times stay text."""
    return re.sub(r"((?:start_|end_)?time:\s*)(\d+\.\d+)", r'\1"\2"', text)
