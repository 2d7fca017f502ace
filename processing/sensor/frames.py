"""The frames that vision looks at, and in which depth: as the camera reports it, or in true metres.

Masks and the static scene are made from reported depth (`Session.toss(t).rgbd`), which they compare with itself; all
that comes after them takes `metric_frames`. See docs/decisions/two-depths.md.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float32
from numpy import ndarray as Array

from recordings.records import RgbdFrame
from recordings.session import RgbdFrames


def metric_frames(reported: RgbdFrames, scale: float) -> RgbdFrames:
    """The same frames, decoded when asked for, with depth divided by `scale` (reported / true depth, see the stage
    `rig`); the very same frames where it is 1."""
    if scale == 1.0:
        return reported

    def load(i: int) -> RgbdFrame:
        frame = reported[i]
        return replace(frame, depth_m=corrected_depth(frame.depth_m, scale))

    return RgbdFrames(reported.times_ns, load, reported.depth_times_ns, reported.without_depth, reported.unused_depth)


def corrected_depth(depth_m: Float32[Array, "h w"], scale: float) -> Float32[Array, "h w"]:
    """True depth of what a camera with this scale reports; 0 stays 0."""
    return depth_m if scale == 1.0 else (depth_m / np.float32(scale)).astype(np.float32)
