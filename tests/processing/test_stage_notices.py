"""What a stage noticed reaches the table, the report, `--json` and the summary of several sessions."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from processing.cli import config_of, main
from processing.config import CycleConfig
from processing.contact.report.result import left_out_notice
from processing.evaluate.table import summary
from processing.field.learn import LearnConfig
from processing.field.train import FieldConfig
from processing.pipeline import notices
from processing.run import Run
from processing.sensor.noise import PUBLISHED
from processing.stages.masks.segment import SegmentResult
from processing.stages.recording.noise import NoiseResult
from processing.stages.recording.rig import RigResult
from processing.stages.register import RegisterResult
from processing.stages.track import TrackResult
from processing.store import Done
from recordings.importers.folder import import_folder
from recordings.notices import Notice
from recordings.records import ArmStates
from recordings.session import Session

UR5E = tuple(f"{n}_joint" for n in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"))


def done(result: Any, folder: Path = Path("x")) -> Done:
    return Done(folder, "key", result, reused=False)


def rig_of(robot: Any, scale: float = 1.0, sigma: float | None = None) -> Done[RigResult]:
    return done(RigResult(scale, scale, sigma, {}, robot))


def masks_of(others_moving: int = 0, without_depth: int = 0) -> Done[SegmentResult]:
    followed = {"others_moving": others_moving, "badly_exposed": 0}
    return done(SegmentResult(20, 0, without_depth=without_depth, followed=followed))


def test_depth_that_errs_by_far_more_than_the_data_sheet_says_is_told_with_its_size() -> None:
    def of(sigma: float, frames: int = 3) -> list[Notice]:
        return notices.of_noise(done(NoiseResult(frames, sigma, 40.0)))

    assert not of(1.9 * PUBLISHED.sigma_at_1m)
    assert not of(PUBLISHED.sigma_at_1m, frames=0)
    (told,) = of(0.0121)
    assert "12 mm at 1 m (data sheet: 5), in patches of 40 pixels" in told.text


def test_tosses_that_do_not_fit_the_others_are_told_with_the_likeliest_cause_first() -> None:
    left_out = notices.of_register(done(RegisterResult((1,), (), (None,))))[0]
    for notice in (left_out, notices.kept_apart([1])):
        assert "most often" in notice.text
        assert notice.text.index("most often") < notice.text.index("seldom")
        assert notice.text.index("seldom") < notice.text.index("another object")


def still_arm() -> ArmStates:
    """Joint states of an arm that is not known here, over a second."""
    time_ns = np.arange(100, dtype=np.int64) * 10_000_000
    zeros = np.zeros((100, 6))
    return ArmStates(time_ns, UR5E, zeros, zeros, np.full(100, np.nan))


def test_an_arm_that_is_not_known_and_frames_too_dark_are_said_everywhere(
    record_tiny: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    few = LearnConfig(field=FieldConfig(steps=10, rays=256, pose_rounds=0))
    monkeypatch.setattr("processing.cli.config_of", lambda args: replace(config_of(args), shape=few))

    def darkened(frames: list[Any]) -> list[Any]:
        return [*frames[:3], replace(frames[3], color_rgb=np.zeros_like(frames[3].color_rgb)), *frames[4:]]

    session = record_tiny(tosses=(0,), arm=still_arm(), seen_again=darkened)
    assert main([str(session), "--variant", "bundlesdf-1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    [row] = document["rows"]
    told = [Notice.from_json(n) for n in row["warnings"]]
    arm = next(n for n in told if n.stage == "rig")
    assert "the robot is not cut out of the images" in arm.seen
    assert "shoulder_pan_joint" in arm.seen
    dark = next(n for n in told if "so dark or so bright" in n.seen)
    assert "toss 0: 1 of 8 frames" in dark.seen
    table = (session / "results" / "table.md").read_text()
    page = (session / "results" / "report.html").read_text()
    several = summary([{**document, "session": "a"}, {"session": "b", "error": "no file"}])
    for notice in (arm, dark):
        assert table.count(notice.text) == 1
        assert escape(notice.text) in page
        assert several.count(f"- a: {notice.text}") == 1


def test_a_mask_that_was_empty_at_import_is_said_of_its_toss(data: Callable[[str], Path], tmp_path: Path) -> None:
    source = data("cube_dev")
    (tmp_path / "in" / "toss_00" / "rgb").mkdir(parents=True)
    (tmp_path / "in" / "toss_00" / "depth").mkdir()
    (tmp_path / "in" / "session.json").write_text((source / "session.json").read_text())
    times = (source / "toss_00" / "timestamps.txt").read_text().splitlines(keepends=True)[:2]
    (tmp_path / "in" / "toss_00" / "timestamps.txt").write_text("".join(times))
    for kind in ("rgb", "depth"):
        for image in sorted((source / "toss_00" / kind).iterdir())[:2]:
            (tmp_path / "in" / "toss_00" / kind / image.name).write_bytes(image.read_bytes())
    mask = cv2.imread(str(source / "toss_00" / "mask_first.png"), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(tmp_path / "in" / "toss_00" / "mask_first.png"), np.zeros_like(mask))
    import_folder(tmp_path / "in", tmp_path / "session")
    with Session.open(tmp_path / "session") as session:
        [notice] = notices.of_import(Mock(spec=Run, session=session, recorded=(0,)))  # type: ignore[arg-type]
    assert notice.text == "toss 0: mask_first.png is empty, so it was left out"


def test_a_robot_whose_place_was_not_refined_and_a_corrected_depth_scale_are_said(
    record_tiny: Callable[..., Path],
) -> None:
    with Session.open(record_tiny(frames=2, tosses=(0,))) as session:
        run: Any = Mock(spec=Run, session=session, recorded=(0,))
        robot = "place not refined: it is seen in too few frames"
        place, scale = notices.of_rig(run, rig_of(robot, 1.004, 0.0005))
        assert "too few frames" in place.seen
        assert "toss-calibrate hand-eye" in place.do
        assert "0.40 +- 0.05 % too far" in scale.seen
        assert notices.of_rig(run, rig_of({"moved_mm": 1})) == []
        nobody = "no joint states of a Franka Panda in these tosses"
        assert notices.of_rig(run, rig_of(nobody)) == []  # thrown by hand: nothing to say


def test_others_that_move_and_frames_without_depth_are_said_of_their_toss() -> None:
    others, bare = notices.of_masks(3, masks_of(4, 2))
    assert "toss 3: in 4 of 20 frames something else" in others.seen
    assert "toss 3: 2 of 20 frames came without a depth image" in bare.seen
    assert notices.of_masks(3, masks_of()) == []


def test_few_frames_that_no_pose_fits_are_most_likely_noise_and_many_are_most_likely_a_wrong_mask() -> None:
    [few], [many] = (notices.of_track(1, done(TrackResult(35, 0, 0, n))) for n in (9, 25))
    assert "in 9 of 35 frames" in few.seen
    assert few.do.index("noisy depth") < few.do.index("not rigid")
    assert many.do.index("mask") < many.do.index("not rigid")
    assert notices.of_track(1, done(TrackResult(35, 0, 0))) == []


def test_what_contact_says_of_itself_is_read_from_its_result(tmp_path: Path) -> None:
    said = left_out_notice(2, "it jumps at frame 50")
    (tmp_path / "result.json").write_text(json.dumps({"warnings": [said.to_json()]}))
    assert notices.of_contact(done(None, tmp_path)) == [said]
    assert notices.of_contact(done(None, tmp_path / "kept_out")) == []


def test_of_a_second_pass_it_is_said_that_it_was_kept_and_what_that_means() -> None:
    told = {"of": "all tosses", "same": False, "worse_share": 0.007}
    [worse] = notices.second_pass_kept(told, CycleConfig())
    assert worse.startswith("all tosses: the second pass was kept: it explains the raw images as well as the first")
    assert "0.7 % worse" in worse
    better = notices.second_pass_kept({**told, "worse_share": -0.1}, CycleConfig())
    assert "was kept: it explains the raw images better" in better[0]
    assert "only repeats" in notices.second_pass_kept({**told, "same": True}, CycleConfig())[0]
