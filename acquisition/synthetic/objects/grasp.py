"""How a parallel gripper holds each shape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import ObjectConfig
from acquisition.synthetic.objects.solids import Solid
from recordings.errors import BadInput
from recordings.geometry import Transform

WIDEST_M = 0.078
PAD_OVERLAP_M = 0.02
"""How deep the object reaches between the pads."""
X, Y, Z = np.eye(3)


@dataclass(frozen=True, eq=False)
class Grasp:
    """`object_from_tool`: the tool's y is the closing direction, z points from the palm to the fingertips."""

    object_from_tool: Transform
    width_m: float


def grasp(config: ObjectConfig, solid: Solid) -> Grasp:
    """A grasp that the Panda's hand (at most 78 mm) can hold; BadInput where the object is too thick."""
    half = solid.vertices_m.max(axis=0)
    if config.shape == "mug":
        tube_m = float(np.abs(solid.vertices_m[solid.vertices_m[:, 0] > half[0] - 0.006, 1]).max())
        return _grasp(-X, Y, half[0] * X - 0.006 * X, 2 * tube_m)
    if config.shape == "prism":
        return _grasp(X, Y, np.zeros(3), _fitting(2 * half[1], config))
    if config.shape == "l":
        thickness = solid.pieces_m[0][:, 1]
        middle = float(0.5 * (thickness.min() + thickness.max()))
        return _grasp(-X, Z, (half[0] - PAD_OVERLAP_M) * X + middle * Y, _fitting(2 * half[2], config))
    closing = int(half.argmin())
    along = int(half.argmax()) if half.argmax() != closing else (closing + 1) % 3
    axes = np.eye(3)
    return _grasp(
        -axes[along], axes[closing], (half[along] - PAD_OVERLAP_M) * axes[along], _fitting(2 * half[closing], config)
    )


def _fitting(width_m: float, config: ObjectConfig) -> float:
    if width_m > WIDEST_M:
        raise BadInput(
            f"the {config.shape} is {1000 * width_m:.0f} mm thick where the gripper closes; it opens to "
            f"{1000 * WIDEST_M:.0f} mm: set ObjectConfig.size_m smaller, or toss without an arm"
        )
    return float(width_m)


def _grasp(approach: Array, closing: Array, at_m: Float[Array, "3"], width_m: float) -> Grasp:
    axes = np.stack([np.cross(closing, approach), closing, approach], 1)
    return Grasp(Transform("object", "tool", axes, at_m), width_m)
