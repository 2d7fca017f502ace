"""Rotations spread evenly: over all orientations, or by given angles about all axes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.geometry import rotation_exp


def directions(count: int) -> Float[Array, "n 3"]:
    """Unit vectors spread evenly over the sphere (Fibonacci's spiral)."""
    n = np.arange(count) + 0.5
    z, phi = 1 - 2 * n / count, np.pi * (1 + 5**0.5) * n
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)


def turn_grid(angles_deg: tuple[float, ...], axes: int) -> Float[Array, "n 3 3"]:
    """Rotations by each angle about axes spread evenly over the sphere."""
    return np.array([rotation_exp(d * np.radians(a)) for a in angles_deg for d in directions(axes)])


def all_turns(count: int) -> Float[Array, "n 3 3"]:
    """Rotations spread over all orientations: directions of the axis, and turns about it."""
    about = max(4, round((count * 1.6) ** (1 / 3)))
    axes = max(4, count // about)
    n = np.arange(axes) + 0.5
    height, around = 1 - 2 * n / axes, np.pi * (1 + 5**0.5) * n
    out = []
    for z, phi in zip(height, around):
        tilt = rotation_exp(np.arccos(z) * np.array([-np.sin(phi), np.cos(phi), 0.0]))
        out += [tilt @ rotation_exp(np.array([0, 0, 2 * np.pi * a / about])) for a in range(about)]
    return np.array(out)


def ball(radius: float, spacing: float) -> Float[Array, "n 3"]:
    """Points of a body-centred cubic lattice within a ball about zero: no place in it is far from one of them."""
    edge = spacing * 2 / np.sqrt(3)
    line = np.arange(-np.ceil(radius / edge), np.ceil(radius / edge) + 1) * edge
    cube = np.stack(np.meshgrid(line, line, line), -1).reshape(-1, 3)
    points = np.concatenate([cube, cube + edge / 2])
    return np.asarray(points[np.linalg.norm(points, axis=1) <= radius])
