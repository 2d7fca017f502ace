"""Views of the calibration board: what is still missing is said in words, what is recorded calibrates."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from acquisition.cli import main
from acquisition.setup import set_up
from acquisition.views import PER_CAMERA, Coverage, progress_text, tilt_of
from calibration.cameras.targets import TargetView
from calibration.cli import main as calibrate
from recordings.geometry import Transform
from recordings.session import Session, Toss
from recordings.tracks import RigCalibration

RIG = """name = "views"
robot = "panda"
[devices.d455]
kind = "rgbd"
driver = "synthetic"
[devices.mono0]
kind = "mono"
driver = "synthetic"
[devices.arm]
kind = "arm"
driver = "synthetic"
rate_hz = 200
[simulation]
seed = 3
color_size = [424, 240]
mono_size = [480, 360]
mono_cameras = 1
board_views = 3
"""


def view(middle_px: tuple[float, float], tilt: tuple[float, float] = (0.0, 0.0)) -> TargetView:
    """A board of 20 cm seen about `middle_px`, 1 m away, turned about its axes by `tilt`."""
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 4), np.linspace(-0.1, 0.1, 4)), -1).reshape(-1, 2)
    points = np.column_stack([grid, np.zeros(len(grid))])
    depth = 1.0 + np.tan(tilt[0]) * grid[:, 0] + np.tan(tilt[1]) * grid[:, 1]
    pixels = np.array(middle_px) + 400 * grid / depth[:, None]
    return TargetView(np.arange(len(grid)), points, pixels, np.tile(0.01 * np.eye(2), (len(grid), 1, 1)))


def test_a_camera_that_has_seen_nothing_wants_everything() -> None:
    wanted = Coverage().missing()
    assert wanted[0] == f"{PER_CAMERA} more views"
    assert any("top left" in text for text in wanted)
    assert "other tilts than none" in wanted


def test_a_board_that_was_everywhere_and_tilted_is_enough() -> None:
    covered = Coverage()
    for k in range(PER_CAMERA):
        at = (80.0 + 160 * (k % 3), 60.0 + 120 * (k // 3 % 3))
        covered.add(view(at, ((0.0, 0.0), (0.6, 0.0), (0.0, 0.6))[k % 3]), 480, 360)
    assert covered.missing() == []
    assert progress_text(1, 30, {"d455": covered}) == "view 1 of 30: every camera has seen enough"


def test_the_tilt_is_told_from_the_outline() -> None:
    assert tilt_of(view((200.0, 200.0))) == "flat"
    sides = {tilt_of(view((200.0, 200.0), tilt)) for tilt in ((0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6))}
    assert sides == {"right side far", "left side far", "upper side far", "lower side far"}


@pytest.mark.slow
def test_views_of_the_simulated_board_are_recorded_and_what_is_missing_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig, out = tmp_path / "rig.toml", tmp_path / "out"
    rig.write_text(RIG)
    assert main(["--rig", str(rig), "--calibration", "board", "--yes", str(out)]) == 1  # three views are too few
    said = capsys.readouterr()
    assert "d455 wants" in said.err
    assert "more views" in said.out
    with Session.open(out) as session:
        assert session.start["board"]["kind"] == "tags"
    with Toss(out / "calibration.mcap") as views:
        assert 2 <= len(views.color()) <= 3
        assert len(views.mono("mono0")) == len(views.color())


@pytest.mark.slow
def test_the_simulated_arm_s_views_find_its_base(tmp_path: Path) -> None:
    rig, out = tmp_path / "rig.toml", tmp_path / "out"
    rig.write_text(RIG.replace("board_views = 3", "board_views = 8"))
    assert main(["--rig", str(rig), "--calibration", "hand-eye", "--yes", str(out)]) == 1  # fewer than 20
    assert calibrate(["hand-eye", str(out)]) == 0
    lab = set_up(str(rig)).lab
    assert lab is not None
    assert lab.show.lab.arm is not None
    base, d455 = lab.show.lab.arm.world_from_base, lab.show.lab.world_from_d455
    d455_from_base = d455.inverse() @ Transform("world", "base", base.rotation, base.translation_m)
    found = RigCalibration.read(out / "calibration.json").transform("d455", "base")
    np.testing.assert_allclose(found.translation_m, d455_from_base.translation_m, atol=4e-3)
    np.testing.assert_allclose(found.rotation, d455_from_base.rotation, atol=4e-3)
