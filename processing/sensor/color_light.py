"""What light does to an object's differences of colour, so that what is painted on it counts: a pale body's pattern is
weaker than the tint of a lamp or of the table beside it, which stays with the room and would hold the rotation back.

To second order of the surface's normal (Ramamoorthi and Hanrahan, "An efficient representation for irradiance
environment maps", SIGGRAPH 2001) the room's light is one function for all frames of a toss, while the paint moves
through it and averages out. That function is estimated and taken out; what is left is the paint, whose contrast tells
by how much its colours are to be raised, because the scales of alignment are absolute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array

from processing.sensor import view_layout as lay

ORDERS = 8
"""Functions of the normal: three of first and five of second order."""
USUAL_CONTRAST = 0.12
"""Root mean square of the differences of colour about their means (in the units of the views' appearance) for which
the scales of alignment were set: that of cube_dev's box."""
MOST_GAIN = 4.0
"""Colours are raised at most so many times: a camera's noise (.003 to .03 in these units) stays below the scales."""
LIGHT_SIGMA = 0.04
"""Standard deviation of the light's coefficients before anything is seen: lamps and tables are nearly white."""


@dataclass(frozen=True, eq=False)
class ColorLight:
    """The room's light on the two differences of colour (`coefficients`, of `_basis` about its mean `usual`), and the
    gain of what is left."""

    coefficients: Float[Array, "8 2"]
    usual: Float[Array, "8"]
    gain: float

    @staticmethod
    def unknown(gain: float = 1.0) -> ColorLight:
        """Nothing is taken out."""
        return ColorLight(np.zeros((ORDERS, lay.APPEARANCE - 1)), np.zeros(ORDERS), gain)

    @staticmethod
    def of(samples: Sequence[Float32[Array, "_ c"]]) -> ColorLight:
        """The light on the samples of some views (`view_layout`), each of another pose. A view is one measurement of
        it, off by its paint: its samples show few patches, and the next view shows most of them again."""
        seen = [view[_colors(view, lay.SSHARP, 1)[:, 0] < 0.5 * lay.NO_APPEARANCE] for view in samples]
        seen = [own for own in seen if len(own)]
        if not seen:
            return ColorLight.unknown()
        colors = [_colors(view, lay.SSHARP, 1).astype(float) for view in seen]
        basis = [_basis(view[:, lay.SNX : lay.SNZ + 1].astype(float)) for view in seen]
        usual = np.mean([b.mean(0) for b in basis], axis=0)
        middle = np.mean([c.mean(0) for c in colors], axis=0)
        paint = float(np.mean([(c - middle).var(0).mean() for c in colors]))
        if paint <= 0:
            return ColorLight.unknown()
        precision = np.eye(ORDERS) / LIGHT_SIGMA**2
        pull = np.zeros((ORDERS, lay.APPEARANCE - 1))
        for b, c in zip(basis, colors, strict=True):
            precision += (b - usual).T @ (b - usual) / len(b) / paint
            pull += (b - usual).T @ (c - middle) / len(b) / paint
        coefficients = np.linalg.solve(precision, pull)
        left = [(c - (b - usual) @ coefficients).var(0) for b, c in zip(basis, colors, strict=True)]
        contrast = float(np.sqrt(np.median(left, axis=0).mean()))
        return ColorLight(coefficients, usual, float(np.clip(USUAL_CONTRAST / max(contrast, 1e-9), 1.0, MOST_GAIN)))

    def paint(self, values: Float32[Array, "n c"], normal: int, sharp: int) -> None:
        """Takes the light out of pixels or samples and raises what is left, in place. `normal`, `sharp`: their first
        columns of the normal and of the sharp appearance."""
        if self.gain == 1.0 and not self.coefficients.any():
            return
        light = (_basis(values[:, normal : normal + 3]) - self.usual) @ self.coefficients
        for level in (0, 1):
            colors = _colors(values, sharp, level)
            own = colors[:, 0] < 0.5 * lay.NO_APPEARANCE
            colors[own] = self.gain * (colors[own] - light[own])


def raised(values: Float32[Array, "n c"], sharp: int, gain: float) -> Float32[Array, "n c"]:
    """Pixels or samples (`sharp`: first column of the sharp appearance) with their differences of colour times a
    gain."""
    if gain == 1.0:
        return values
    out = values.copy()
    for level in (0, 1):
        colors = _colors(out, sharp, level)
        colors[colors < 0.5 * lay.NO_APPEARANCE] *= np.float32(gain)
    return out


def _colors(values: Float32[Array, "n c"], sharp: int, level: int) -> Float32[Array, "n 2"]:
    """View of the two differences of colour, sharp (level 0) or smooth (1)."""
    first = sharp + level * lay.APPEARANCE
    return values[:, first + 1 : first + lay.APPEARANCE]


def _basis(normals: Float[Array, "n 3"]) -> Float[Array, "n 8"]:
    x, y, z = normals.T
    return np.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], axis=1)
