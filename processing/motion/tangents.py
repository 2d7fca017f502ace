"""The tangent vectors by which poses are corrected, in one place: how they are ordered and what they act on.

Steps are small and taken anew from where they lead, so all but the last take the translation as it is (SO(3) x R^3):

| order | acts on | where |
|---|---|---|
| shift, turn | object axes, pose @ inverse(exp) | `se3_kernels.exponential`: track/ (poses, profile) |
| shift, turn | common frame, exp @ pose | `se3_kernels.exponential`: track/registration/ |
| turn about a centre, shift | object axes, pose @ about | `about`: refine/ (icp, joint) |
| turn, shift | camera axes, about @ pose | `about` with centre 0: baselines/ |
| turn about a centre, shift | camera axes, with a delay and a scale | segment/robot/fit.py (other last bits) |
| turn, shift | points of the object, x -> exp(w) x + t, torch | field/poses.py (gradients go through it) |
| turn alone | R exp(d), positions apart | motion/smoother.py, contact/physics (torch, compiled) |
| turn, translation through the left Jacobian | T exp(xi), GTSAM's order | groundtruth/se3.py (another package) |

A stored covariance of a pose is of (turn, shift) with (exp(w) R, t + d) in camera axes, whoever made it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.geometry import rotation_exp


def about(center_m: Float[Array, "3"], turn: Float[Array, "3"], shift_m: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """A rigid motion: a turn (rotation vector, rad) about a centre, then a shift."""
    out = np.eye(4)
    out[:3, :3] = rotation_exp(turn)
    out[:3, 3] = center_m - out[:3, :3] @ center_m + shift_m
    return out
