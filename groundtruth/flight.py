"""What flight says: which poses in a row lie on an arc, and where the centre of mass is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from groundtruth import se3
from groundtruth.factors import Arc
from groundtruth.interpolate import GRAVITY_WORLD_M_S2
from recordings.estimation.robust import geman_mcclure_weight

Order = Mapping[int, tuple[Array, Array]]
"""Per toss: times (ns) and the numbers of the body's poses at them."""


@dataclass(frozen=True)
class FlightConfig:
    fall_m_s2: float = 0.6
    """How far from gravity the acceleration of flight may be; beyond three times this an arc hardly counts."""
    turn_rad_s2: float = 6.0
    center_sigma_m: float = 0.02
    """Of the centre of mass about the centre of the tags."""
    rounds: int = 3
    """Of the arcs' robust weights."""


def center_of_mass(
    poses: Float[Array, "n 4 4"], order: Order, tags_center: Float[Array, "3"], config: FlightConfig
) -> Float[Array, "3"]:
    """c with p + R c falling: second differences of p + R c equal gravity in all triples that are nearly in flight
    (robust linear least squares), and c is near the centre of the tags, as far as flight does not tell."""
    rows, values = [], []
    for times, numbers in order.values():
        for k in range(1, len(numbers) - 1):
            h1, h2 = np.diff(times[k - 1 : k + 2]) / 1e9
            if max(h1, h2) > 0.1:
                continue
            shares = np.array([2 / (h1 * (h1 + h2)), 0.0, 2 / (h2 * (h1 + h2))])
            shares[1] = -shares.sum()
            three = poses[numbers[k - 1 : k + 2]]
            rows.append(np.einsum("i,ijk->jk", shares, three[:, :3, :3]))
            values.append(GRAVITY_WORLD_M_S2 - shares @ three[:, :3, 3])
    center = tags_center
    if not rows:
        return center
    A, b = np.array(rows), np.array(values)
    for _ in range(20):
        left = np.linalg.norm(b - A @ center, axis=1)
        weight = geman_mcclure_weight((left / (2.5 * config.fall_m_s2)) ** 2) / config.fall_m_s2**2
        near = 1 / config.center_sigma_m**2
        information = np.einsum("n,nij,nik->jk", weight, A, A) + near * np.eye(3)
        center = np.linalg.solve(information, np.einsum("n,nij,ni->j", weight, A, b) + near * tags_center)
    return center


def arcs_of(poses: Float[Array, "n 4 4"], order: Order, center: Float[Array, "3"], config: FlightConfig) -> list[Arc]:
    """All triples of poses in a row, weighted by how nearly they are in flight (Geman and McClure)."""
    arcs = []
    for times, numbers in order.values():
        h = np.diff(times) / 1e9
        for k in range(1, len(numbers) - 1):
            if max(h[k - 1], h[k]) > 0.1:
                continue
            three = (int(numbers[k - 1]), int(numbers[k]), int(numbers[k + 1]))
            fall, turn = _off_arc(poses, three, (float(h[k - 1]), float(h[k])), center)
            weight = geman_mcclure_weight((fall / (3 * config.fall_m_s2)) ** 2)
            turn_weight = geman_mcclure_weight((turn / (3 * config.turn_rad_s2)) ** 2)
            both = min(weight, turn_weight)
            if both > 0.02:
                steps = (float(h[k - 1]), float(h[k]))
                arcs.append(
                    Arc(three, steps, center, GRAVITY_WORLD_M_S2, config.fall_m_s2, config.turn_rad_s2, both, both)
                )
    return arcs


def _off_arc(
    poses: Float[Array, "n 4 4"], three: tuple[int, int, int], h: tuple[float, float], center: Float[Array, "3"]
) -> tuple[float, float]:
    """How far a triple's acceleration is from gravity (m/s^2) and its turn from even (rad/s^2)."""
    x = poses[list(three), :3, 3] + poses[list(three), :3, :3] @ center
    R = poses[list(three), :3, :3]
    spins = se3.log(se3.rotations(np.swapaxes(R[:2], -1, -2) @ R[1:]))[:, :3] / np.array(h)[:, None]
    acceleration = 2 * ((x[2] - x[1]) / h[1] - (x[1] - x[0]) / h[0]) / sum(h)
    fall = float(np.linalg.norm(acceleration - GRAVITY_WORLD_M_S2))
    return fall, float(np.linalg.norm(spins[1] - spins[0])) * 2 / sum(h)
