"""toss-view as a user types it."""

import json
import os
import subprocess
import sys

import cv2
import numpy as np
import pytest

from recordings.cli_view import main
from recordings.geometry import CameraModel, Transform
from recordings.records import DepthImage, EncodedImage
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration

WIDTH, HEIGHT = 32, 24


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Two tosses of two frames, seen by a colour camera over the table."""
    folder = tmp_path_factory.mktemp("cli") / "small"
    K = np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]])
    place = Transform("world", "d455", np.diag([1.0, -1, -1]), np.array([0, 0, 1.0]))
    data = cv2.imencode(".png", np.full((HEIGHT, WIDTH, 3), 120, dtype=np.uint8))[1].tobytes()
    with SessionWriter(
        folder, {"name": "small"}, RigCalibration({"d455": CameraModel("d455", WIDTH, HEIGHT, K)}, (place,))
    ) as w:
        for index in range(2):
            with w.toss(index) as toss:
                for i in range(2):
                    time_ns = (10 * index + i) * 100_000_000
                    toss.color(EncodedImage("d455", i, time_ns, time_ns, "png", WIDTH, HEIGHT, data))
                    raw = np.full((HEIGHT, WIDTH), 900, dtype=np.uint16)
                    toss.depth(DepthImage("d455", i, time_ns, time_ns, 0.001, raw))
        w.finish("complete")
    return folder


def test_save_writes_a_file_and_says_so(session, tmp_path, capsys):
    assert main([str(session), "--save", str(tmp_path / "a.rrd")]) == 0
    assert (tmp_path / "a.rrd").stat().st_size > 5_000
    assert str(tmp_path / "a.rrd") in capsys.readouterr().out


def test_json_is_one_object_on_stdout(session, tmp_path, capfd):
    assert main([str(session), "--save", str(tmp_path / "a.rrd"), "--json"]) == 0
    document = json.loads(capfd.readouterr().out)
    assert document["save"] == str(tmp_path / "a.rrd")


def test_one_toss_is_smaller_than_all(session, tmp_path):
    assert main([str(session), "--save", str(tmp_path / "all.rrd")]) == 0
    assert main([str(session), "--toss", "1", "--save", str(tmp_path / "one.rrd")]) == 0
    assert (tmp_path / "one.rrd").stat().st_size < (tmp_path / "all.rrd").stat().st_size


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["NOTHING"], "NOTHING does not exist; wanted a session folder or an .mcap file"),
        (["SESSION", "--save", "x.png"], "--save writes a .rrd file; found x.png, wanted x.rrd"),
        (["SESSION", "--screenshot", "x.jpg"], "--screenshot writes a .png file; found x.jpg, wanted x.png"),
        (["SESSION", "--toss", "7", "--save", "x.rrd"], "has no toss 7; it has 0, 1"),
        (["SESSION", "--variant", "ours", "--save", "x.rrd"], "has no results, so no variant to choose"),
        (["SESSION", "--toss", "two"], "invalid int value: 'two'; see `toss-view --help`"),
        (["NOTMCAP", "--save", "x.rrd"], "notmcap.mcap"),
    ],
)
def test_bad_input_is_exit_code_2_with_what_was_found_and_wanted(
    session, tmp_path, capsys, monkeypatch, arguments, said
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notmcap.mcap").write_bytes(b"something else")
    names = {"SESSION": str(session), "NOTMCAP": "notmcap.mcap"}
    assert main([names.get(a, a) for a in arguments]) == 2
    printed = capsys.readouterr()
    assert said in printed.err
    assert printed.out == ""
    assert [f.name for f in tmp_path.iterdir()] == ["notmcap.mcap"]


def test_without_a_display_the_other_ways_are_named(session, capsys, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert main([str(session)]) == 2
    said = capsys.readouterr().err
    assert "no display" in said
    assert f"toss-view {session} --save out.rrd" in said
    assert f"toss-view {session} --screenshot out.png" in said


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_is_said(session, tmp_path, capsys):
    (tmp_path / "shut").mkdir(mode=0o500)
    assert main([str(session), "--save", str(tmp_path / "shut" / "a.rrd")]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_a_folder_in_the_way_is_said(session, tmp_path, capsys):
    (tmp_path / "file").write_text("no folder")
    assert main([str(session), "--save", str(tmp_path / "file" / "a.rrd")]) == 2
    assert "a.rrd cannot be written" in capsys.readouterr().err


LIMITED = """
import resource, signal, sys
from recordings.cli_view import main
sys.dont_write_bytecode = True  # what Python caches on import is not what is tested
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))
sys.exit(main([{session!r}, "--save", {out!r}]))
"""


@pytest.mark.parametrize("size", [0, 4096, 20_000])
def test_a_full_disk_is_said_and_leaves_nothing(session, tmp_path, size):
    # a limit on a file's size stands for the disk: the write is refused in the middle
    program = LIMITED.format(size=size, session=str(session), out=str(tmp_path / "a.rrd"))
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2, done.stderr
    assert "a.rrd.partial cannot be written: File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
