"""Real boards with a published reference: clones at TOSSLAB_CALIBRATION_SETS/OWNER/REPOSITORY, none in this one."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import pytest

from calibration.cameras.intrinsics import calibrate_intrinsics
from calibration.cameras.lens_support import unsupported
from calibration.cameras.targets import Chessboard, find_target

SETS = Path(os.environ.get("TOSSLAB_CALIBRATION_SETS", Path.home() / ".cache" / "tosslab-calibration"))
PUBLISHED_PX = 518.05
"""Focal length in intrinsics.yml of Barry-Liang/stereoCalibrate: 25 pairs, 640 x 512, one focal length for both."""


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_25_real_stereo_views_give_the_published_focal_length(side):
    pictures = sorted((SETS / "Barry-Liang" / "stereoCalibrate").glob(f"{side}*.jpg"))
    if len(pictures) < 25:
        pytest.skip(f"no clone of Barry-Liang/stereoCalibrate under {SETS}; set TOSSLAB_CALIBRATION_SETS")
    images = [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) for p in pictures]
    views = find_target(Chessboard(9, 6, 0.03), images)
    lens = calibrate_intrinsics("mono0", (640, 512), views)
    assert unsupported(lens.model) is None
    off = abs(lens.model.fx / PUBLISHED_PX - 1)
    assert off < max(0.003, 0.02 * lens.report.uncertainty["focal_percent"])
