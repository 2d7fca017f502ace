"""Following a sampled joint path, and braking along it. Used in the arms' own processes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

BLEND_S = 0.3
BRAKE_S = 0.7


def along(path: Float[Array, "n j"], place: float) -> Float[Array, " j"]:
    """The path at a fractional sample, by Catmull-Rom interpolation; beyond its end: the end."""
    last = len(path) - 1
    i = min(int(place), last)
    u = min(place, float(last)) - i
    p0, p1, p2, p3 = (path[min(max(i + k, 0), last)] for k in (-1, 0, 1, 2))
    m1, m2 = (p2 - p0) / 2, (p3 - p1) / 2
    return (2 * u**3 - 3 * u**2 + 1) * p1 + (u**3 - 2 * u**2 + u) * m1 + (3 * u**2 - 2 * u**3) * p2 + (u**3 - u**2) * m2


def from_here(path: Float[Array, "n j"], here: Float[Array, " j"], rate_hz: float) -> Float[Array, "n j"]:
    """The path begun at `here` instead of its first sample; the difference fades out within BLEND_S."""
    left = 1 - np.asarray(rise(np.arange(len(path)) / (rate_hz * BLEND_S)))
    return path + left[:, None] * (here - path[0])


def rise(share: Float[Array, " *n"] | float) -> Float[Array, " *n"] | float:
    """The minimum-jerk step from 0 to 1, over shares 0 to 1."""
    u = np.clip(share, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u**2)


class Brake:
    """Goes on along the path, ever slower: its speed is scaled by a smooth step from 1 to 0 within BRAKE_S."""

    def __init__(self, place: float, rate_hz: float) -> None:
        self.place = place
        self._since_s = 0.0
        self._tick_s = 1 / rate_hz

    def advance(self, ticks: int) -> None:
        for _ in range(max(1, ticks)):
            self.place += 1 - float(rise(self._since_s / BRAKE_S))
            self._since_s += self._tick_s

    @property
    def standing(self) -> bool:
        return self._since_s > BRAKE_S + 5 * self._tick_s
