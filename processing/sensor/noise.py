"""The model of depth noise: how large it is, and how many neighbouring pixels count as one measurement.

Active stereo errs by a share of a pixel of disparity, so depth errs with the square of the distance (Intel, "Best Known
Methods for Tuning RealSense D400 Depth Cameras", 2019), and whole patches err together. The numbers below were set one
by one for the estimators that use them and differ; they stand together so that one model can replace them.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32
from numpy import ndarray as Array

FIELD_SIGMA_M, FIELD_SIGMA_AT_M = 0.0015, 0.8
"""The field's pose refinement: standard deviation of depth (m) at a distance (m), growing with its square."""
ICP_LEAST_SIGMA_M = 0.0008
"""Shape to depth of one frame: residuals are weighed with no smaller standard deviation than this (m)."""
JOINT_LEAST_SIGMA_M = 0.0005
"""The same in the joint objective, where all frames of all tosses speak."""

BASELINE_PIXELS_PER_MEASUREMENT = 9.0
"""Frame-to-model baseline: so many depth pixels count as one in the covariance."""
ICP_POINTS_PER_MEASUREMENT = 300.0
"""Shape to depth of one frame: so many points weigh as one."""
JOINT_POINTS_PER_MEASUREMENT = 100.0
"""Joint objective: so many points of a frame weigh as one."""
JOINT_CONTACTS_PER_MEASUREMENT = 12.0
"""Joint objective: points that touch the plane in neighbouring frames, or while the object lies there, measure its
height once."""
FIELD_INDEPENDENT_SHARE = 0.1
"""The field's pose refinement: this share of the pixels counts as independent."""
PAIRS_PER_MEASUREMENT = 8.0
"""Joint refinement of a toss's views: a view's pairs share its noise; together they count as one, so many times
over."""
STEADY_PAIRS_PER_MEASUREMENT = 200.0
"""The same where motion is trusted more than appearance (the refinement that carries a steady spin on)."""
ROUND_PAIRS_PER_MEASUREMENT = 100.0
"""The same for a body of revolution, whose profile holds the poses."""
APPEARANCE_GAIN = 0.125
"""Appearance likelihood ratios of neighbouring samples err together: so much of their sum counts."""
AZIMUTH_APPEARANCE_GAIN, AZIMUTH_SHAPE_GAIN = 0.125, 0.25
"""The same of neighbouring cells of an unwrapped round body."""
TRACK_COVARIANCE_SCALE = 3.0
"""Covariances of the joint refinement times this: its residuals share more noise than it knows (shading, the depth
camera's fixed pattern). From the normalised errors on simulated variety."""
ROBOT_SIGMA_SCALE = 6.0
"""The robot's place: standard deviations are larger than independent residuals would make them, by this factor."""


def stereo_sigma_m(depth_m: Float32[Array, "*n"]) -> Float32[Array, "*n"]:
    """Standard deviation (m) of active stereo depth (m): 0.08 px of disparity are 2.3 mm at 1 m."""
    return np.float32(0.0025) * depth_m * depth_m
