"""`toss-session`: quick help with examples, exit codes, one JSON object."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from recordings.cli_session import _parser, main


def every_parser(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in action.choices.values():
                yield from every_parser(child)


def test_every_subcommand_shows_a_copyable_example_of_itself():
    parsers = list(every_parser(_parser()))
    assert len(parsers) >= 1 + 3 + 2 + 5 + 11
    for parser in parsers:
        lines = (parser.epilog or "").splitlines()
        assert lines[0].startswith("example"), parser.prog
        assert lines[1].strip().startswith(parser.prog), parser.prog


def test_every_example_is_understood_by_the_parser():
    for parser in every_parser(_parser()):
        for line in (parser.epilog or "").splitlines()[1:]:
            _parser().parse_args(line.split()[1:])


def test_help_costs_no_heavy_import():
    """Half a second is promised; what costs it are these imports, so their absence is tested, not the clock alone."""
    program = (
        "import sys\nfrom recordings.cli_session import main\nmain(['export', 'tum', '--help'])\n"
        "heavy = 'numpy cv2 torch open3d rerun trimesh scipy rosbags pyrealsense2 pyarrow av'\n"
        "sys.exit(', '.join(set(heavy.split()) & set(sys.modules)) or 0)\n"
    )
    started = time.process_time()
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "toss-session export tum" in done.stdout
    assert time.process_time() - started < 0.5


def test_a_recording_goes_in_is_checked_and_comes_out(write_session, tmp_path, capsys):
    source = write_session(tosses=2)
    assert main(["export", "folder", str(source), str(tmp_path / "out")]) == 0
    assert main(["import", "folder", str(tmp_path / "out"), str(tmp_path / "again")]) == 0
    assert "2 tosses from folder" in capsys.readouterr().out
    assert main(["verify", str(tmp_path / "again")]) == 0
    assert main(["info", str(tmp_path / "again")]) == 0
    assert "cube" in capsys.readouterr().out


def test_json_is_one_object_on_stdout(write_session, tmp_path, capfd):
    source = write_session()
    assert main(["export", "folder", str(source), str(tmp_path / "out"), "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    assert (said["format"], said["out"]) == ("folder", str(tmp_path / "out"))
    assert main(["--json", "import", "folder", str(tmp_path / "out"), str(tmp_path / "again")]) == 0
    said = json.loads(capfd.readouterr().out)
    assert said["tosses"] == [0]
    assert said["streams"]["/d455/color"] == 6


@pytest.mark.parametrize(
    "argv",
    [
        ["import", "folder", "{}/nowhere", "{}/out"],
        ["import", "bundlesdf", "{}/nowhere", "{}/out"],
        ["import", "contactnets", "{}/nowhere", "{}/out"],
        ["import", "realsense", "{}/nowhere.bag", "{}/out"],
        ["import", "rosbag", "{}/nowhere.bag", "{}/out"],
        ["export", "tum", "{}/nowhere", "{}/out"],
        ["export", "gif", "{}", "{}/out"],
        ["import", "folder", "{}"],
        ["import"],
        [],
    ],
)
def test_bad_input_and_bad_usage_exit_2_and_make_nothing(tmp_path, capsys, argv):
    assert main([a.format(tmp_path) for a in argv]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("toss-session")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_exits_2_with_one_message(write_session, tmp_path, capsys, full_disk):
    source = write_session()
    assert main(["export", "folder", str(source), str(tmp_path / "out")]) == 0
    full_disk(2000)
    capsys.readouterr()
    assert main(["import", "folder", str(tmp_path / "out"), str(tmp_path / "again")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "again").exists()


def test_the_command_is_installed(tmp_path):
    command = Path(sys.executable).parent / "toss-session"
    done = subprocess.run([command, "info", tmp_path / "nowhere"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "nowhere" in done.stderr
