"""A session of every format_version ever released still opens (made once by tools/make_golden.py)."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from recordings.bounded.documents import FORMAT_VERSION
from recordings.mcap.codec import decode_image
from recordings.records import HealthLine, TossEvent
from recordings.session import Session
from recordings.verify.verify import verify

GOLDEN = Path(__file__).parent / "golden"
VERSIONS = sorted(p.name for p in GOLDEN.iterdir() if p.is_dir())


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def test_the_present_format_has_its_golden_file():
    assert f"format_{FORMAT_VERSION}" in VERSIONS


@pytest.mark.parametrize("version", VERSIONS)
def test_a_golden_session_is_read_as_it_was_written(version):
    expected = json.loads((GOLDEN / version / "expected.json").read_text())
    with Session.open(GOLDEN / version) as session:
        assert (session.name, session.object_name, session.tosses) == ("golden", "cube", (4,))
        toss = session.toss(4)
        assert [sha256(f.data) for f in toss.color()] == expected["jpeg_sha256"]
        assert [sha256(f.raw.astype("<u2").tobytes()) for f in toss.depth()] == expected["depth_sha256"]
        assert [sha256(decode_image(f).tobytes()) for f in toss.mono("mono0")] == expected["mono_sha256"]
        assert [f.index for f in toss.color()] == expected["frame_numbers"]
        assert [f.host_time_ns for f in toss.color()] == expected["host_times_ns"]
        frames = toss.rgbd()
        assert frames.times_ns.tolist() == expected["color_times_ns"]
        assert frames.depth_times_ns.tolist() == expected["depth_times_ns"]
        assert 0.6 < np.median(frames[0].depth_m[frames[0].depth_m > 0]) < 0.8
        arm = toss.arm_states()
        np.testing.assert_allclose(arm.q_rad, expected["q_rad"], atol=0)
        np.testing.assert_allclose(arm.dq_rad_s, -arm.q_rad, atol=0)
        np.testing.assert_allclose(arm.finger_width_m, expected["finger_width_m"], atol=1e-15)
        assert toss.command().linear_velocity_world_m_s.tolist() == expected["linear_velocity_world_m_s"]
        assert toss.events() == (TossEvent(1_033_333_333, "release", "gripper", "opened", 0.001),)
        assert toss.health() == (HealthLine(1_000_000_000, "warning", "d455", "late frame"),)
        assert toss.masks()[0].sum() == expected["mask_pixels"]
        assert toss.poses()[0].status == "interpolated"
        assert toss.poses()[0].matrix[:3, 3].tolist() == [0.1, 0.2, 0.3]
        assert session.calibration.camera("d455").distortion[0] == -0.05
        assert session.calibration.transform("world", "d455_depth").translation_m[0] == 0.015
        assert session.stop["streams"]["toss_04"]["/mono0/image"]["dropped"] == 2


@pytest.mark.parametrize("version", VERSIONS)
def test_a_golden_truth_is_read(version):
    with Session.open(GOLDEN / version / "truth" / "toss_04.mcap") as truth:
        pose = truth.toss(4).poses("/groundtruth/pose")[0]
    assert (pose.target, pose.source, pose.status) == ("world", "object", "tracked")
    np.testing.assert_array_equal(pose.covariance, np.eye(6) * 1e-8)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_golden_session_verifies_with_its_drops_as_the_only_warning(version):
    report = verify(GOLDEN / version)
    assert report.ok
    assert [w.text for w in report.warnings] == ["/mono0/image: 2 of 4 messages were dropped"]
