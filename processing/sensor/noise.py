"""The model of depth noise: how large it is, and how many neighbouring pixels count as one measurement.

Active stereo errs by a share of a pixel of disparity, so depth errs with the square of the distance (Intel, "Best Known
Methods for Tuning RealSense D400 Depth Cameras", 2019), and whole patches err together. How much, the table of the
session shows (`measured_noise`). The numbers of single estimators below were set one by one and differ; they stand
together so that the measured model can replace them, as it has in the field.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from recordings.constants import MAD_TO_SIGMA

ICP_LEAST_SIGMA_M = 0.0008
"""Shape to depth of one frame: residuals are weighed with no smaller standard deviation than this (m)."""
JOINT_LEAST_SIGMA_M = 0.0005
"""The same in the joint objective, where all frames of all tosses speak."""

DARK = 8.0
"""Grey levels of 255, added to colours before logarithms and ratios: a sensor's noise and black level."""
STEREO_BASELINE_M = 0.095
"""Between the D455's infrared cameras (data sheet). Along a surface that slants too much disparity grows by more than
a pixel a pixel, where no matcher follows (Pollard, Mayhew and Frisby, "PMF: a stereo correspondence algorithm using a
disparity gradient limit", Perception 1985): where baseline/z times the tangent of the slant exceeds 1."""

BASELINE_PIXELS_PER_MEASUREMENT = 9.0
"""Frame-to-model baseline: so many depth pixels count as one in the covariance."""
ICP_POINTS_PER_MEASUREMENT = 300.0
"""Shape to depth of one frame: so many points weigh as one."""
JOINT_POINTS_PER_MEASUREMENT = 100.0
"""Joint objective: so many points of a frame weigh as one."""
JOINT_CONTACTS_PER_MEASUREMENT = 12.0
"""Joint objective: points that touch the plane in neighbouring frames, or while the object lies there, measure its
height once."""
PAIRS_PER_MEASUREMENT = 8.0
"""Joint refinement of a toss's views: a view's pairs share its noise; together they count as one, so many times
over."""
ADJUST_PAIRS_PER_MEASUREMENT = 36.0
"""The same of colours in the adjustment with the surface free, which counts depth and outlines of its own. With 24, 36
and 72, twelve tosses (choose-002, 003, 008, 034, the former judge-004 and 021) are off by 2.7, 2.5 and 2.6 degrees in
the mean, before points slid on the surface."""
STEADY_PAIRS_PER_MEASUREMENT = 200.0
"""The same where motion is trusted more than appearance (the refinement that carries a steady spin on)."""
ROUND_PAIRS_PER_MEASUREMENT = 100.0
"""The same for a body of revolution, whose profile holds the poses."""
APPEARANCE_GAIN = 0.125
"""Appearance likelihood ratios of neighbouring samples err together: so much of their sum counts."""
AZIMUTH_SHAPE_GAIN = 0.25
"""The same of neighbouring cells of an unwrapped round body: what stands off it."""
TRACK_COVARIANCE_SCALE = 6.75
"""Covariances of the joint refinement times this: its residuals share more noise than it knows (shading, the depth
camera's fixed pattern). From the normalised errors on `choose` (22 tosses): with standard deviations 1, 1.5, 2 and 3
times those of a scale of 3, the 95 % ellipsoid holds .69, .76, .79 and .83 of a toss's sure frames; the first step
gains most, what then lies outside are wrong modes."""
ROBOT_SIGMA_SCALE = 6.0
"""The robot's place: standard deviations are larger than independent residuals would make them, by this factor."""


def stereo_sigma_m(depth_m: Float32[Array, "*n"]) -> Float32[Array, "*n"]:
    """Standard deviation (m) of active stereo depth (m): 0.08 px of disparity are 2.3 mm at 1 m."""
    return np.float32(0.0025) * depth_m * depth_m


@dataclass(frozen=True)
class DepthNoise:
    """How depth errs: standard deviation at 1 m (m; it grows with the square of the distance), and the number of
    neighbouring pixels that err as one measurement."""

    sigma_at_1m: float
    patch_px: float

    @property
    def coarseness(self) -> float:
        """Variance of a mean over pixels that err alike, in units of fine depth's."""
        variance, fine = (n.sigma_at_1m**2 * n.patch_px for n in (self, FINE))
        return variance / fine

    @property
    def turn_share(self) -> float:
        """Of what depth says of turns, how much counts beside appearance."""
        return float(np.clip(1.0 / max(self.coarseness, 1e-12), LEAST_TURN_SHARE, 1.0))


PUBLISHED = DepthNoise(0.005, 49.0)
"""Where a session shows no table: 2 % at 4 m (D455's data sheet), and matching costs summed over 7x7 pixels (Keselman
et al., "Intel RealSense Stereoscopic Depth Cameras", CVPR workshops 2017)."""
FINE = DepthNoise(0.0026, 50.0)
"""The depth at which the scales of the tracker's schedules were set."""
LEAST_TURN_SHARE = 0.3
"""No less: what looks the same from all sides has little else to say how it turned. Ten rendered sessions of the
variety do not tell .1 from .3."""
LAG_PX = 24
"""What is alike beyond so many pixels is the table's own form, not the camera's noise."""
LEAST_TABLE_PX = 5000
"""A smaller piece of the table does not tell."""
NEAR_TABLE = 0.03
"""Returns within this share of the table's distance are the table, or what lies flat on it: the fit is robust."""


def measured_noise(
    depth_m: Float32[Array, "h w"], table_m: Float32[Array, "h w"], rays: Float[Array, "h w 3"]
) -> DepthNoise | None:
    """From one depth image and the depth at which the table is believed; None where too little of it is seen.

    On a plane 1/z is linear in the ray's coordinates, and stereo errs alike in 1/z everywhere: what is left after the
    best plane (the table may be calibrated wrongly) is noise. Pixels err together as far as residuals correlate.
    """
    seen = (depth_m > 0) & (table_m > 0) & (np.abs(depth_m - table_m) < NEAR_TABLE * table_m)
    if seen.sum() < LEAST_TABLE_PX:
        return None
    inverse = 1.0 / np.where(depth_m > 0, depth_m, 1.0).astype(np.float64)
    on, left, sigma = seen, inverse, 0.0
    for _ in range(4):
        plane = np.linalg.lstsq(rays[on], inverse[on], rcond=None)[0]
        left = inverse - rays @ plane
        sigma = float(MAD_TO_SIGMA * np.median(np.abs(left[on])))
        on = seen & (np.abs(left) <= 4 * sigma)
    return None if on.sum() < LEAST_TABLE_PX else DepthNoise(sigma, _patch_px(np.where(on, left, 0.0), on))


def _patch_px(values: Float[Array, "h w"], on: Bool[Array, "h w"]) -> float:
    """Sum of the autocorrelation over all lags up to where it is first that of far pixels: the area of one independent
    measurement (of a mean over many pixels, the variance is as if there were only one in so many)."""
    h, w = values.shape
    size = (h + LAG_PX, w + LAG_PX)
    product, count = (np.fft.irfft2(np.abs(np.fft.rfft2(a, s=size)) ** 2, s=size) for a in (values, on.astype(float)))
    lag = np.r_[0:LAG_PX, -LAG_PX:0]
    y, x = np.meshgrid(lag, lag, indexing="ij")
    alike = product[y, x] / np.maximum(count[y, x], 1.0)
    ring = np.rint(np.hypot(y, x)).astype(int)
    by_ring = np.array([alike[ring == r].mean() for r in range(LAG_PX)])
    far = float(by_ring[2 * LAG_PX // 3 :].mean())
    end = int(np.argmax(by_ring <= far + 0.02 * (by_ring[0] - far)))
    return max(float((alike[ring < end] - far).sum() / (by_ring[0] - far)), 1.0)
