"""Stamps against what the simulated lab knows of its exposures: clocks that drift, late cameras, late depth."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from synthetic.stamp_errors import stamp_errors_ms

from calibration.cli import main as toss_calibrate

RECORD = "import sys; from acquisition.cli import main; sys.exit(main(sys.argv[1:]))"
"""In a process of its own, as a user's: with types checked at every call, pictures take more than ten times as long and
the recorder falls behind a thousand states a second."""
RIG = """name = "times"
robot = "panda"
[devices.d455]
kind = "rgbd"
driver = "synthetic"
latency_ms = 5.4
[devices.mono0]
kind = "mono"
driver = "synthetic"
[devices.mono1]
kind = "mono"
driver = "synthetic"
[devices.arm]
kind = "arm"
driver = "synthetic"
rate_hz = 1000
[devices.gripper]
kind = "gripper"
driver = "synthetic"
rate_hz = 50
[recording]
countdown_s = 0
queue_s = 5
longest_gap_s = 5
[simulation]
seed = 31
mono_cameras = 2
color_size = [560, 400]
color_focal_px = 640.0
mono_size = [480, 360]
skew_ppm = [40.0, -35.0, 25.0, -31.0]
latency_ms = 5.4
mono_latency_ms = 16.0
latency_jitter_ms = 2.0
depth_delay_ms = 6.0
buffer_frames = 150
"""


@pytest.mark.slow
def test_after_toss_calibrate_time_every_stamp_lies_within_a_millisecond(tmp_path: Path) -> None:
    rig, out, truth = tmp_path / "rig.toml", tmp_path / "out", tmp_path / "out_truth"
    rig.write_text(RIG)
    subprocess.run([sys.executable, "-c", RECORD, "--rig", str(rig), "--yes", str(out)], check=True)
    before = stamp_errors_ms(out, truth)
    assert set(before) == {"/d455/color", "/d455/depth", "/mono0/image", "/mono1/image"}
    assert before["/mono0/image"].mean() > 14  # their latency, which nothing has told yet
    size_m = json.loads((truth / "object_tags.json").read_text())["tags"][0]["size_m"]
    assert toss_calibrate(["time", str(out), "--tag-size", str(size_m)]) == 0
    for topic, errors in stamp_errors_ms(out, truth).items():
        assert len(errors) > 60
        assert np.abs(errors).max() < 1.0, topic
