"""The folder layout: what comes in comes out again to the last bit, and what is wrong with it is said plainly."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from recordings.errors import BadInput, TosslabError, WriteFailed
from recordings.exporters.export import export
from recordings.importers.folder import import_folder
from recordings.mcap.codec import decode_image
from recordings.session import Session, Toss


def same_files(a: Path, b: Path, pattern: str) -> int:
    """How many files match; every one must have the same bytes in both folders."""
    names = sorted(p.relative_to(a) for p in a.glob(pattern))
    assert names == sorted(p.relative_to(b) for p in b.glob(pattern))
    for name in names:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    return len(names)


def same_pixels(a: Path, b: Path, pattern: str) -> int:
    names = sorted(p.relative_to(a) for p in a.glob(pattern))
    assert names == sorted(p.relative_to(b) for p in b.glob(pattern))
    for name in names:
        found = cv2.imread(str(b / name), cv2.IMREAD_UNCHANGED)
        wanted = cv2.imread(str(a / name), cv2.IMREAD_UNCHANGED)
        assert found.dtype == wanted.dtype
        np.testing.assert_array_equal(found, wanted)
    return len(names)


def check_round_trip(source: Path, back: Path) -> None:
    """Images byte for byte, depth and masks bit for bit, stamps to the nanosecond, joint states to the last digit."""
    assert same_files(source, back, "toss_*/rgb/*") > 0
    same_files(source, back, "mono/toss_*/*/*.jpg")
    same_files(source, back, "**/timestamps.txt")
    same_pixels(source, back, "toss_*/depth/*.png")
    same_pixels(source, back, "toss_*/mask_first.png")
    same_pixels(source, back, "calibration/*/*.png")
    for name in sorted(p.relative_to(source) for p in source.glob("toss_*/arm.csv")):
        wanted, found = (np.loadtxt(f / name, delimiter=",", skiprows=1) for f in (source, back))
        np.testing.assert_array_equal(found, wanted)
        assert (back / name).read_text().splitlines()[0] == (source / name).read_text().splitlines()[0]
    for name in (
        "session.json",
        "mono/cameras.json",
        *(p.relative_to(source) for p in source.glob("toss_*/toss.json")),
    ):
        if (source / name).exists():
            assert json.loads((back / name).read_text()) == json.loads((source / name).read_text())


def test_the_folder_layout_comes_back_as_it_was(layout, tmp_path):
    report = import_folder(layout.path, tmp_path / "session")
    assert report.tosses == (0, 3)
    assert report.warnings == ()
    export("folder", tmp_path / "session", tmp_path / "back")
    check_round_trip(layout.path, tmp_path / "back")


@pytest.mark.parametrize("name", [pytest.param("cube_dev", marks=pytest.mark.slow), "lab_dev"])
def test_the_shared_recordings_come_back_as_they_were(data: Callable[[str], Path], tmp_path, name):
    import_folder(data(name), tmp_path / "session")
    export("folder", tmp_path / "session", tmp_path / "back")
    check_round_trip(data(name), tmp_path / "back")


def test_depth_times_of_their_own_come_back(layout, tmp_path):
    """Fewer depth than colour images, exposed 5 ms later and, first of all, before the first colour image."""
    (layout.toss / "depth" / "000004.png").unlink()
    (layout.toss / "depth_timestamps.txt").write_text("-0.005\n0.038001\n0.071657123\n0.138321\n")
    import_folder(layout.path, tmp_path / "session")
    frames = Session.open(tmp_path / "session").toss(0).rgbd()
    assert frames.depth_times_ns[2] - frames.times_ns[2] == 5_000_123
    assert frames.without_depth == (4,)
    export("folder", tmp_path / "session", tmp_path / "back")
    text = (tmp_path / "back" / "toss_00" / "depth_timestamps.txt").read_text()
    assert text.split() == ["-0.005000000", "0.038001000", "0.071657123", "0.138321000"]
    assert not (tmp_path / "back" / "toss_03" / "depth_timestamps.txt").exists()
    same_pixels(layout.path, tmp_path / "back", "toss_00/depth/*.png")


def test_the_session_clock_grows_over_tosses_that_each_start_at_zero(layout, tmp_path):
    import_folder(layout.path, tmp_path / "session")
    session = Session.open(tmp_path / "session")
    assert [session.toss(n).info["clock_offset_ns"] for n in (0, 3)] == [0, 180_000_000_000]
    assert "clock_offset_ns" in session.start["clock"]["assumed"]
    spans = [session.toss(n).color().times_ns[[0, -1]] for n in (0, 3)]
    assert spans[0][1] < spans[1][0]


def test_a_toss_longer_than_the_spacing_does_not_overlap_the_next(layout, tmp_path):
    layout.lines("timestamps.txt", lambda lines: [*lines[:-1], "200.0"])
    import_folder(layout.path, tmp_path / "session")
    session = Session.open(tmp_path / "session")
    assert session.toss(0).color().times_ns[-1] < session.toss(3).color().times_ns[0]
    assert session.toss(3).info["clock_offset_ns"] % 60_000_000_000 == 0


def test_everything_of_the_layout_is_in_the_session(layout, tmp_path):
    import_folder(layout.path, tmp_path / "session")
    session = Session.open(tmp_path / "session")
    toss = session.toss(0)
    assert session.object_name == "prism"
    assert session.start["rig"]["arm"] == "franka_panda"
    camera = session.calibration.camera("d455")
    assert (camera.distortion_model, camera.distortion[0]) == ("brown-conrady", -0.05)
    assert session.calibration.transform("world", "base").translation_m[0] == 0.5
    assert session.calibration.table_tags[0].tag_id == 30
    assert session.calibration.camera("mono1").distortion_model == "none"
    assert session.start["board"]["tags"][0]["id"] == 100
    assert toss.window().release_time_ns == 100_000_000
    assert toss.masks()[0].sum() == 100
    arm = toss.arm_states()
    assert arm is not None
    assert arm.joint_names[0] == "panda_joint1"
    assert len(arm.time_ns) == 200
    assert len(toss.mono("mono0")) == 5
    assert decode_image(toss.mono("mono0")[0]).ndim == 2
    views = Toss(tmp_path / "session" / "calibration.mcap")
    assert views.color().times_ns.tolist() == [0, 1_000_000_000]
    assert len(views.mono("mono1")) == len(views.depth()) == 2


def test_messages_lie_in_the_file_in_the_order_of_time(layout, tmp_path):
    from mcap.reader import make_reader

    import_folder(layout.path, tmp_path / "session")
    with open(tmp_path / "session" / "toss_00.mcap", "rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    late = np.maximum.accumulate(times) - times
    assert late.max() <= 50_000_000  # a batch of joint states


def test_truth_goes_into_its_own_folder_at_the_frames_own_times(layout, layout_truth, tmp_path):
    report = import_folder(layout.path, tmp_path / "session", layout_truth)
    assert report.truth
    session = Session.open(tmp_path / "session")
    assert session.truth_folder is not None
    info = json.loads((session.truth_folder / "truth.json").read_text())
    assert info["physics"] == {"mass_kg": 0.37}
    assert info["object_from_tagged"] == np.eye(4).tolist()
    assert info["tosses"]["toss_03"]["phase"][0] == "hold"
    poses = Toss(session.truth_folder / "toss_03.mcap").poses("/groundtruth/pose")
    assert [p.time_ns for p in poses] == session.toss(3).color().times_ns.tolist()
    assert poses[2].matrix[2, 3] == pytest.approx(0.1)
    assert (poses[0].target, poses[0].source) == ("world", "object")
    assert (session.truth_folder / "mesh.obj").read_bytes() == (layout_truth / "mesh.obj").read_bytes()
    assert len(list((session.truth_folder / "toss_00" / "masks").glob("*.png"))) == 5
    said = (tmp_path / "session" / "session.json").read_text()
    assert "0.37" not in said  # physics of the truth stays in the truth


def test_a_session_is_the_same_with_and_without_its_truth(layout, layout_truth, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    import_folder(layout.path, tmp_path / "a" / "session")
    import_folder(layout.path, tmp_path / "b" / "session", layout_truth)
    one, two = (Session.open(tmp_path / n / "session") for n in "ab")
    for number in one.tosses:
        for a, b in zip(one.toss(number).color(), two.toss(number).color(), strict=True):
            assert a.data == b.data
    assert "truth" not in str(two.start)


def _png(path: Path, pixels: np.ndarray) -> None:
    cv2.imwrite(str(path), pixels)


SPOILT = {
    "no session.json": (lambda s: (s.path / "session.json").unlink(), "no session.json"),
    "session.json cut off": (lambda s: (s.path / "session.json").write_text('{"camera"'), "no readable JSON"),
    "empty session.json": (lambda s: (s.path / "session.json").write_text(""), "empty"),
    "no camera": (lambda s: s.edit("session.json", lambda d: d.pop("camera")), "no 'camera'"),
    "no K": (lambda s: s.edit("session.json", lambda d: d["camera"].pop("K")), "wanted K 3x3"),
    "principal point outside": (
        lambda s: s.edit("session.json", lambda d: d["camera"].update(K=[[60, 0, 310], [0, 60, 24], [0, 0, 1]])),
        "outside the 64x48 image",
    ),
    "no depth unit": (lambda s: s.edit("session.json", lambda d: d["camera"].pop("depth_unit_m")), "depth_unit_m None"),
    "depth unit in mm": (
        lambda s: s.edit("session.json", lambda d: d["camera"].update(depth_unit_m=1)),
        "0.001 for mill",
    ),
    "no rotation": (
        lambda s: s.edit(
            "session.json", lambda d: d.update(T_world_camera=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
        ),
        "not a rotation",
    ),
    "not aligned, no extrinsics": (
        lambda s: s.edit("session.json", lambda d: d["camera"].update(depth_aligned_to_color=False)),
        "T_camera_depth",
    ),
    "no tosses": (lambda s: [shutil.rmtree(p) for p in s.path.glob("toss_*")], "has no tosses"),
    "empty rgb": (lambda s: [p.unlink() for p in (s.toss / "rgb").iterdir()], "is empty"),
    "no depth": (lambda s: shutil.rmtree(s.toss / "depth"), "depth is missing"),
    "a depth image less": (
        lambda s: (s.toss / "depth" / "000002.png").unlink(),
        "5 colour and 4 depth images; frame 2",
    ),
    "a time less": (lambda s: s.lines("timestamps.txt", lambda x: x[:-1]), "4 lines for 5 colour images"),
    "a time repeats": (lambda s: s.lines("timestamps.txt", lambda x: [*x[:2], x[1], *x[3:]]), "repeats the time"),
    "a time goes back": (lambda s: s.lines("timestamps.txt", lambda x: [*x[:3], "0.01", x[4]]), "goes back"),
    "a time wraps": (
        lambda s: s.lines("timestamps.txt", lambda x: [str(float(t) + 4294.9) for t in x[:3]] + ["0.008", "0.041"]),
        "32-bit microsecond counter wrapped",
    ),
    "a time is a word": (lambda s: s.lines("timestamps.txt", lambda x: ["nan", *x[1:]]), "timestamps.txt:1"),
    "an image of another size": (
        lambda s: _png(s.toss / "rgb" / "000003.jpg", np.zeros((24, 32, 3), np.uint8)),
        "32x24, the camera d455 64x48",
    ),
    "a grey image": (lambda s: _png(s.toss / "rgb" / "000003.jpg", np.zeros((48, 64), np.uint8)), "8-bit colour"),
    "an empty image": (lambda s: (s.toss / "rgb" / "000003.jpg").write_bytes(b""), "empty"),
    "a folder where an image should be": (
        lambda s: [(s.toss / "rgb" / "000003.jpg").unlink(), (s.toss / "rgb" / "000003.jpg").mkdir()],
        "000003.jpg cannot be read",
    ),
    "no image": (lambda s: (s.toss / "rgb" / "000003.jpg").write_bytes(b"hello, I am text"), "neither JPEG nor PNG"),
    "an image cut off": (
        lambda s: (s.toss / "rgb" / "000003.jpg").write_bytes((s.toss / "rgb" / "000003.jpg").read_bytes()[:-40]),
        "cut off",
    ),
    "depth of another size": (
        lambda s: _png(s.toss / "depth" / "000001.png", np.zeros((24, 32), np.uint16)),
        "is 32x24, its camera 64x48",
    ),
    "depth of 8 bits": (lambda s: _png(s.toss / "depth" / "000001.png", np.zeros((48, 64), np.uint8)), "16-bit grey"),
    "a mask of another size": (lambda s: _png(s.toss / "mask_first.png", np.ones((47, 64), np.uint8)), "is 64x47"),
    "a toss twice": (lambda s: shutil.copytree(s.toss, s.path / "toss_0"), "toss 0 twice"),
    "a frame twice": (lambda s: shutil.copy(s.toss / "rgb/000001.jpg", s.toss / "rgb/1.jpg"), "frame 1 twice"),
    "an image without a number": (
        lambda s: shutil.copy(s.toss / "rgb/000001.jpg", s.toss / "rgb/a.jpg"),
        "frame number",
    ),
    "arm.csv of other columns": (lambda s: (s.toss / "arm.csv").write_text("t,x\n0,1\n"), "its header is t,x"),
    "arm.csv with a short row": (lambda s: s.lines("arm.csv", lambda x: [*x, "0.5,1"]), "has 2 values; wanted 16"),
    "arm.csv that goes back": (lambda s: s.lines("arm.csv", lambda x: [*x, x[1]]), "goes back"),
    "an unknown mono camera": (
        lambda s: (s.path / "mono/toss_00/mono1").rename(s.path / "mono/toss_00/mono7"),
        "not in mono/cameras.json",
    ),
    "a mono image less": (
        lambda s: (s.path / "mono/toss_00/mono1/000002.jpg").unlink(),
        "5 lines for 4 images of mono1",
    ),
    "a release that is no time": (
        lambda s: s.edit("toss_00/toss.json", lambda d: d.update(release_time_s="soon")),
        "'soon'",
    ),
}


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_recording_is_refused_in_one_sentence_and_leaves_nothing(layout, tmp_path, name):
    spoil, message = SPOILT[name]
    spoil(layout)
    with pytest.raises(BadInput) as refused:
        import_folder(layout.path, tmp_path / "session")
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "session").exists()


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_damaged_depth_image_is_refused_at_every_place(layout, tmp_path, damage):
    path = layout.toss / "depth" / "000004.png"
    whole = path.read_bytes()
    for at in range(0, len(whole), 701):
        spoilt = whole[:at] if damage == "cut" else whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :]
        path.write_bytes(spoilt)
        with pytest.raises(BadInput):
            import_folder(layout.path, tmp_path / "session")
    assert not (tmp_path / "session").exists()


def test_an_existing_session_is_not_overwritten(layout, tmp_path):
    import_folder(layout.path, tmp_path / "session")
    before = {p: p.read_bytes() for p in (tmp_path / "session").iterdir()}
    with pytest.raises(BadInput, match="exists already"):
        import_folder(layout.path, tmp_path / "session")
    assert {p: p.read_bytes() for p in (tmp_path / "session").iterdir()} == before


def test_a_session_given_as_a_recording_is_recognised(layout, tmp_path):
    import_folder(layout.path, tmp_path / "session")
    with pytest.raises(BadInput, match="toss-session info"):
        import_folder(tmp_path / "session", tmp_path / "again")


def test_a_full_disk_is_said_and_leaves_nothing(layout, tmp_path, full_disk):
    full_disk(20_000)
    with pytest.raises(WriteFailed):
        import_folder(layout.path, tmp_path / "session")
    assert not (tmp_path / "session").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads everything")
def test_a_file_that_may_not_be_read_is_named(layout, tmp_path):
    (layout.toss / "rgb" / "000002.jpg").chmod(0)
    with pytest.raises(BadInput, match="000002.jpg cannot be read"):
        import_folder(layout.path, tmp_path / "session")


def test_an_interrupted_import_keeps_what_it_has_and_says_so(layout, tmp_path):
    class Impatient:
        def step(self, done: int, total: int, note: str = "") -> None:
            if done > 0:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        import_folder(layout.path, tmp_path / "session", progress=Impatient())
    session = Session.open(tmp_path / "session")
    assert session.stop["status"] == "interrupted"
    assert len(session.toss(0).color()) == 5


def test_the_truth_of_another_recording_is_refused(layout, layout_truth, tmp_path):
    for number in (0, 3):
        path = layout_truth / f"toss_{number:02d}" / "poses_camera_object.npz"
        stored = dict(np.load(path))
        np.savez(path, **{**stored, "t": stored["t"] + 7.0})
    with pytest.raises(BadInput, match="none of its 5 times"):
        import_folder(layout.path, tmp_path / "session", layout_truth)
    assert not (tmp_path / "session").exists()


def test_depth_that_is_not_aligned_is_kept_and_aligned_when_read(layout, tmp_path):
    depth_camera = {"K": [[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]], "width": 64, "height": 48}
    place = np.eye(4)
    place[0, 3] = 0.015

    def unalign(document):
        document["camera"]["depth_aligned_to_color"] = False
        document.update(depth_camera=depth_camera, T_camera_depth=place.tolist())

    layout.edit("session.json", unalign)
    for path in layout.path.glob("toss_*/depth/*.png"):
        _png(path, np.full((48, 64), 700, np.uint16))
    report = import_folder(layout.path, tmp_path / "session")
    assert any("not aligned" in w for w in report.warnings)
    frame = Session.open(tmp_path / "session").toss(0).rgbd()[0]
    assert frame.depth_m[24, 32] == pytest.approx(0.7)
    export("folder", tmp_path / "session", tmp_path / "back")
    document = json.loads((tmp_path / "back" / "session.json").read_text())
    assert document["T_camera_depth"] == place.tolist()
    assert document["camera"]["depth_aligned_to_color"] is False
    same_pixels(layout.path, tmp_path / "back", "toss_*/depth/*.png")


def test_frames_that_are_missing_keep_their_numbers_and_times(layout, tmp_path):
    for name in ("rgb/000002.jpg", "depth/000002.png"):
        (layout.toss / name).unlink()
    layout.lines("timestamps.txt", lambda lines: lines[:2] + lines[3:])
    report = import_folder(layout.path, tmp_path / "session")
    assert any("toss.json says 5 frames" in w for w in report.warnings)
    export("folder", tmp_path / "session", tmp_path / "back")
    check_round_trip(layout.path, tmp_path / "back")


def test_only_errors_of_the_family_leave_the_importer_whatever_is_spoilt(layout, tmp_path):
    """Random bytes changed in any of the small text files."""
    rng = np.random.default_rng(0)
    files = [p for p in layout.path.rglob("*") if p.suffix in (".json", ".txt", ".csv")]
    for _ in range(60):
        path = files[rng.integers(len(files))]
        whole = path.read_bytes()
        at = int(rng.integers(len(whole)))
        path.write_bytes(whole[:at] + bytes([int(rng.integers(256))]) + whole[at + 1 :])
        try:
            import_folder(layout.path, tmp_path / "session")
            shutil.rmtree(tmp_path / "session")
        except TosslabError:
            assert not (tmp_path / "session").exists()
        path.write_bytes(whole)
