"""BundleSDF folders come in with assumed times and go out as they were."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.exporters.export import export
from recordings.importers.bundlesdf import import_bundlesdf
from recordings.session import Session, Toss


def check_round_trip(source: Path, back: Path) -> None:
    for name in ("rgb", "depth"):
        files = sorted(p.name for p in (source / name).iterdir())
        assert files == sorted(p.name for p in (back / name).iterdir())
        for file in files:
            if name == "rgb":
                assert (back / name / file).read_bytes() == (source / name / file).read_bytes()
            else:
                wanted, found = (cv2.imread(str(f / name / file), cv2.IMREAD_UNCHANGED) for f in (source, back))
                np.testing.assert_array_equal(found, wanted)
    np.testing.assert_array_equal(np.loadtxt(back / "cam_K.txt"), np.loadtxt(source / "cam_K.txt"))
    wanted = cv2.imread(str(source / "masks" / "000000.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(cv2.imread(str(back / "masks" / "000000.png"), cv2.IMREAD_UNCHANGED), wanted)


def test_a_folder_comes_back_as_it_was(bundlesdf_folder, tmp_path):
    import_bundlesdf([bundlesdf_folder], tmp_path / "session")
    export("bundlesdf", tmp_path / "session", tmp_path / "back")
    check_round_trip(bundlesdf_folder, tmp_path / "back" / "toss_00")


def test_the_real_frames_of_the_jack_come_back_as_they_were(data, tmp_path):
    report = import_bundlesdf([data("jack_push")], tmp_path / "session")
    assert report.streams["/d455/color"] == 84
    export("bundlesdf", tmp_path / "session", tmp_path / "back")
    check_round_trip(data("jack_push"), tmp_path / "back" / "toss_00")
    assert Session.open(tmp_path / "session").toss(0).masks()[0].sum() == 4982


def test_what_was_exported_comes_in_again_as_the_same_tosses(bundlesdf_folder, tmp_path):
    import_bundlesdf([bundlesdf_folder, bundlesdf_folder], tmp_path / "session", fps=25.0)
    export("bundlesdf", tmp_path / "session", tmp_path / "back")
    import_bundlesdf([tmp_path / "back"], tmp_path / "again", fps=25.0)
    one, two = Session.open(tmp_path / "session"), Session.open(tmp_path / "again")
    assert one.tosses == two.tosses == (0, 1)
    for number in one.tosses:
        np.testing.assert_array_equal(one.toss(number).color().times_ns, two.toss(number).color().times_ns)
        for a, b in zip(one.toss(number).depth(), two.toss(number).depth(), strict=True):
            np.testing.assert_array_equal(a.raw, b.raw)


def test_times_are_made_from_the_rate_and_said_to_be_assumed(bundlesdf_folder, tmp_path):
    import_bundlesdf([bundlesdf_folder], tmp_path / "session", fps=15.0)
    session = Session.open(tmp_path / "session")
    assert session.toss(0).color().times_ns.tolist() == [round(i * 1e9 / 15) for i in range(5)]
    assert "15 frames per second" in session.start["clock"]["assumed"]


def test_a_missing_frame_number_leaves_a_gap_in_time(bundlesdf_folder, tmp_path):
    for name in ("rgb", "depth"):
        (bundlesdf_folder / name / "000002.png").unlink()
    import_bundlesdf([bundlesdf_folder], tmp_path / "session", fps=10.0)
    assert (Session.open(tmp_path / "session").toss(0).color().times_ns / 1e9).tolist() == [0, 0.1, 0.3, 0.4]


def test_names_that_are_time_stamps_are_counted_in_order(bundlesdf_folder, tmp_path):
    for name in ("rgb", "depth", "masks"):
        for i, path in enumerate(sorted((bundlesdf_folder / name).iterdir())):
            path.rename(path.with_name(f"{1581120424100262102 + i * 33_000_000}.png"))
    shutil.rmtree(bundlesdf_folder / "annotated_poses")
    import_bundlesdf([bundlesdf_folder], tmp_path / "session", fps=10.0)
    assert (Session.open(tmp_path / "session").toss(0).color().times_ns / 1e9).tolist() == [0, 0.1, 0.2, 0.3, 0.4]


def test_annotated_poses_become_truth_and_nothing_else(bundlesdf_folder, tmp_path):
    assert import_bundlesdf([bundlesdf_folder], tmp_path / "session").truth
    session = Session.open(tmp_path / "session")
    assert session.toss(0).poses() == ()
    poses = Toss(tmp_path / "session" / "truth" / "toss_00.mcap").poses("/groundtruth/pose")
    assert [p.matrix[2, 3] for p in poses] == pytest.approx([0.50, 0.51, 0.52, 0.53, 0.54])
    assert (poses[0].target, poses[0].source) == ("d455", "object")


def test_depth_in_a_finer_unit_is_warned_of(bundlesdf_folder, tmp_path):
    for path in (bundlesdf_folder / "depth").iterdir():
        cv2.imwrite(str(path), np.full((48, 64), 9000, np.uint16))  # 0.9 m in 0.1 mm
    report = import_bundlesdf([bundlesdf_folder], tmp_path / "session")
    assert any("another one (0.25 mm, 0.1 mm)" in w for w in report.warnings)


def test_a_folder_without_masks_is_taken_and_warned_of(bundlesdf_folder, tmp_path):
    shutil.rmtree(bundlesdf_folder / "masks")
    assert any("no masks" in w for w in import_bundlesdf([bundlesdf_folder], tmp_path / "session").warnings)


SPOILT = {
    "no camera": (lambda p: (p / "cam_K.txt").unlink(), "cam_K.txt is missing"),
    "a camera of words": (lambda p: (p / "cam_K.txt").write_text("fx 0 cx"), "wanted a 3x3 camera matrix"),
    "principal point outside": (
        lambda p: (p / "cam_K.txt").write_text("60 0 320\n0 60 24\n0 0 1"),
        "outside the 64x48",
    ),
    "no rgb": (lambda p: shutil.rmtree(p / "rgb"), "has no rgb/"),
    "a depth image less": (lambda p: (p / "depth" / "000003.png").unlink(), "5 colour and 4 depth images; frame 3"),
    "a size that changes": (
        lambda p: cv2.imwrite(str(p / "rgb" / "000003.png"), np.zeros((24, 32, 3), np.uint8)),
        "32x24, the camera d455 64x48",
    ),
    "depth that is not aligned": (
        lambda p: cv2.imwrite(str(p / "depth" / "000000.png"), np.zeros((60, 80), np.uint16)),
        "depth is not aligned",
    ),
    "a mask of another size": (
        lambda p: cv2.imwrite(str(p / "masks" / "000000.png"), np.zeros((60, 80), np.uint8)),
        "is 80x60",
    ),
    "a pose of three rows": (
        lambda p: (p / "annotated_poses" / "000001.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n"),
        "wanted a 4x4 matrix",
    ),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_folder_is_refused_and_leaves_nothing(bundlesdf_folder, tmp_path, name):
    spoil, message = SPOILT[name]
    spoil(bundlesdf_folder)
    with pytest.raises(BadInput) as refused:
        import_bundlesdf([bundlesdf_folder], tmp_path / "session")
    assert message in str(refused.value)
    assert not (tmp_path / "session").exists()


def test_a_rate_of_nothing_is_refused(bundlesdf_folder, tmp_path):
    with pytest.raises(BadInput, match="--fps 0"):
        import_bundlesdf([bundlesdf_folder], tmp_path / "session", fps=0.0)
