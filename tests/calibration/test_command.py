"""`toss-calibrate` on cube_dev: what it writes, what it refuses, what it says. Truth: of the recording."""

from __future__ import annotations

import json

import numpy as np
import pytest

from calibration.cameras.poses import angle_deg, inverse_poses
from calibration.cli import main
from calibration.tags.detect import DetectorChild, DetectorDied
from recordings.tracks import RigCalibration
from recordings.verify.verify import verify

TAG_M = "0.06140625"


def calibration_of(session):
    return RigCalibration.read(session / "calibration.json")


def test_cameras_are_placed_to_a_millimetre_and_a_tenth_of_a_degree(cube_copy, cube_truth, capsys):
    assert main(["cameras", str(cube_copy), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["verdict"] == "good"
    found = calibration_of(cube_copy)
    for camera, true in cube_truth.items():
        gap = inverse_poses(true) @ found.transform("d455", camera).matrix
        assert np.linalg.norm(gap[:3, 3]) < 1e-3
        assert angle_deg(gap[:3, :3]) < 0.1
    assert found.residuals["cameras"]["hold_out"]["rms_px"] < 0.3
    assert (cube_copy / "calibration" / "cameras.png").stat().st_size > 10_000
    assert verify(cube_copy).ok
    assert found.created_unix_s is not None


@pytest.mark.slow
def test_a_refused_calibration_leaves_the_file_as_it_was_and_returns_1(cube_copy, capsys):
    document = json.loads((cube_copy / "session.json").read_text())
    for tag in document["start"]["board"]["tags"]:
        tag["size_m"] *= 1.1
        tag["T_board_tag"] = [[*row[:3], 1.1 * row[3]] for row in tag["T_board_tag"][:3]] + [[0, 0, 0, 1]]
    (cube_copy / "session.json").write_text(json.dumps(document))
    calibration = json.loads((cube_copy / "calibration.json").read_text())
    calibration["table_tags"] = []  # nothing else tells the scale but depth
    (cube_copy / "calibration.json").write_text(json.dumps(calibration))
    before = (cube_copy / "calibration.json").read_bytes()
    assert main(["cameras", str(cube_copy)]) == 1
    out = capsys.readouterr().out
    assert "wrong tag size" in out
    assert "0.90" in out or "0.91" in out
    assert (cube_copy / "calibration.json").read_bytes() == before


@pytest.mark.slow
def test_the_table_and_the_clock_offset_of_a_toss(cube_copy, cube_truth, capsys):
    assert main(["cameras", str(cube_copy)]) == 0
    assert main(["table", str(cube_copy), "--tag-size", TAG_M]) == 0
    table = calibration_of(cube_copy).residuals["table"]
    assert abs(table["offset_m"]) < 5e-4
    assert table["normal_world"][2] > np.cos(np.radians(0.1))
    assert main(["time", str(cube_copy)]) == 0  # the tags' size is measured
    offset = calibration_of(cube_copy).residuals["time"]["offsets"]["mono"]
    assert abs(offset["offset_ns"]) < 1e6
    assert offset["std_ns"] < 1e6
    capsys.readouterr()
    assert main(["time", str(cube_copy), "--tag-size", "0.07"]) == 1
    assert "wrong tag size" in capsys.readouterr().out
    assert main(["cameras", str(cube_copy), "--from", "object", "--tag-size", TAG_M]) == 0
    found = calibration_of(cube_copy)
    for camera in ("mono1", "mono2"):
        true = inverse_poses(cube_truth["mono0"]) @ cube_truth[camera]
        gap = inverse_poses(true) @ found.transform("mono0", camera).matrix
        assert np.linalg.norm(gap[:3, 3]) < 1e-3
        assert angle_deg(gap[:3, :3]) < 0.1


def test_table_tags_that_no_camera_sees_are_a_warning_of_the_report(cube_copy, capsys):
    calibration = json.loads((cube_copy / "calibration.json").read_text())
    for k, tag in enumerate(calibration["table_tags"]):
        tag["id"] = 500 + k
    (cube_copy / "calibration.json").write_text(json.dumps(calibration))
    main(["table", str(cube_copy), "--dry-run"])
    assert "no table tags found" in capsys.readouterr().out


@pytest.mark.parametrize("command", [pytest.param(["cameras"], marks=pytest.mark.slow), ["table", "--tag-size", TAG_M]])
def test_images_on_which_the_tag_detector_dies_are_a_warning_of_the_report(command, cube_copy, monkeypatch, capsys):
    for kept in cube_copy.rglob("tags-*.npz"):
        kept.unlink()
    detect, killers = DetectorChild.detect, []

    def dies_on_one(self, picture):
        killers.append(picture.tobytes())
        if picture.tobytes() == killers[0]:
            raise DetectorDied("gone")
        return detect(self, picture)

    monkeypatch.setattr(DetectorChild, "detect", dies_on_one)
    main([command[0], str(cube_copy), *command[1:], "--dry-run", "--json"])
    (said,) = json.loads(capsys.readouterr().out)["calibrations"]
    assert any("the tag detector died on 1 images" in reason for reason in said["reasons"])


def test_what_is_missing_is_named_with_what_to_type(cube_copy, sample_path, capsys):
    assert main(["time", str(cube_copy)]) == 2
    assert "toss-calibrate cameras" in capsys.readouterr().err
    assert main(["hand-eye", str(sample_path)]) == 2
    assert "toss-record --calibration" in capsys.readouterr().err
    assert main([]) == 2
    assert main(["cameras", str(cube_copy / "toss_00.mcap")]) == 2
    assert "wanted a session folder" in capsys.readouterr().err
    assert main(["time", str(cube_copy), "--tag-size", "-1"]) == 2
    assert "wanted metres above 0" in capsys.readouterr().err
