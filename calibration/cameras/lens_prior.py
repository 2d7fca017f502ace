"""What is known of Brown's k3 before any view: it bends the image's corner by little.

Fitted freely (cv2.calibrateCamera does), it follows the noise where views do not reach far out, and a corner that none
of them showed is off by pixels; left out, a lens that has one is bent wrongly. So it counts by how well the views tell
it, against how large it is among lenses (an empirical Bayes estimate); where they tell it better than that, views kept
aside decide whether it is held back at all (`lens_fit.py`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from recordings.geometry import COEFFICIENTS, CameraModel, DistortionModel

AT_CORNER = 0.05
"""Standard deviation among lenses of k3 r^6 at the image's corner (r: the tangent of its angle to the axis). It makes
what eleven real sets tell of their k3 likeliest (tools/bench_calibration.py: .053; without any one of them .052 to
.057, but .017 without the one lens that needs k3)."""


def bare(start: CameraModel, kind: DistortionModel) -> CameraModel:
    """This kind of lens with nothing bent."""
    return replace(start, distortion_model=kind, distortion=(0.0,) * COEFFICIENTS[kind])


def with_weighed_k3(start: CameraModel, fitted: CameraModel, std: float) -> CameraModel:
    """`start` with the k3 of the lens fitted freely, as far as this standard deviation of it lets one believe it."""
    k3 = fitted.distortion[-1] * k3_share(fitted, std)
    return replace(start, distortion=(*start.distortion[:-1], k3))


def k3_share(fitted: CameraModel, std: float) -> float:
    """How much of a k3 fitted freely one believes; above a half, views tell it better than what is known of lenses."""
    r = float(np.hypot(fitted.width / fitted.fx, fitted.height / fitted.fy)) / 2
    among_lenses = AT_CORNER / r**6
    return among_lenses**2 / (among_lenses**2 + std**2)


def has_k3(model: CameraModel) -> bool:
    """Whether the last number of this lens is Brown's k3."""
    return model.distortion_model == "brown-conrady"


def still_numbers(model: CameraModel) -> int:
    """Of a lens that was fitted before: Brown's k3, its last number, stays what that lens's own views made it."""
    return int(has_k3(model) and any(model.distortion))
