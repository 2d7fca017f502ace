"""Whether an image supports a lens: a fit may follow the points it saw and yet be no lens at all.

Two things tell. A lens maps what lies farther from its axis farther from the image's centre, as far as points were seen
(and, where all of the image is to be used, up to its corners). And its coefficients are of the size that its image
needs: where numerator and denominator are huge and cancel, the numbers were drawn to the noise.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.geometry import CameraModel

LARGEST_TERM = 3.0
"""k r^(2i) at the farthest pixel. Wide lenses need up to 1, what is drawn to noise reaches 10 to 100."""
STEPS = 400
WIDEST = 6.0
"""Tangent of the angle to the axis up to which the image's corner is looked for: 80 degrees."""


def unsupported(model: CameraModel, pixels: Float[Array, "n 2"] | None = None) -> str | None:
    """Why the image circle does not support this lens; None where it does. The circle reaches to the farthest of these
    pixels, else to the image's corners. (The fisheye's polynomial of the angle is asked for its order only.)"""
    if not any(model.distortion):
        return None
    radius = np.linspace(0.0, WIDEST, STEPS)
    mapped, largest = _radial(model, radius)
    far = _radius(model, _corners(model) if pixels is None else pixels)
    inside = np.flatnonzero(mapped >= far)
    last = int(inside[0]) if len(inside) else STEPS - 1
    grows = np.diff(mapped[: last + 1]) > 0
    if not np.isfinite(mapped[: last + 1]).all() or not grows.all():
        turn = float(mapped[int(np.argmin(grows))]) / _radius(model, _corners(model))
        return (
            f"the {model.distortion_model} lens folds over at {100 * turn:.0f} % of the way to the image's corner: "
            "two directions would fall on one pixel"
        )
    if largest[last] > LARGEST_TERM:
        return (
            f"a coefficient of the {model.distortion_model} lens is worth {largest[last]:.1f} at the image's edge "
            f"(wanted at most {LARGEST_TERM:g}): terms that cancel, drawn to noise"
        )
    return None


def _corners(model: CameraModel) -> Float[Array, "4 2"]:
    return np.array([[x, y] for x in (0.0, model.width - 1.0) for y in (0.0, model.height - 1.0)])


def _radius(model: CameraModel, pixels: Float[Array, "n 2"]) -> float:
    """Distance from the principal point to the farthest of these pixels, on the plane at 1."""
    return float(np.linalg.norm((pixels - [model.cx, model.cy]) / [model.fx, model.fy], axis=1).max())


def _radial(model: CameraModel, radius: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Where a ray at this tangent from the axis falls, and the largest single term of its polynomials there."""
    if model.distortion_model == "fisheye":
        angle = np.arctan(radius)
        terms = np.stack([k * angle ** (2 * i) for i, k in enumerate(model.distortion, 1)])
        return angle * (1 + terms.sum(axis=0)), np.zeros_like(radius)
    k1, k2, _, _, k3, *below = model.distortion
    powers = np.stack([radius**2, radius**4, radius**6])
    above = np.array([k1, k2, k3])[:, None] * powers
    under = np.array([*below, 0.0, 0.0, 0.0][:3])[:, None] * powers
    divisor = 1 + under.sum(axis=0)
    mapped = np.where(divisor > 0, radius * (1 + above.sum(axis=0)) / np.where(divisor > 0, divisor, 1.0), np.nan)
    return mapped, np.abs(np.concatenate([above, under])).max(axis=0)
