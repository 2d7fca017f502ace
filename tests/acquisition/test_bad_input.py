"""toss-record given what cannot be: exit code 2 and a message that says what was found, before anything is written."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from acquisition.cli import main
from acquisition.doctor import doctor
from acquisition.drivers import usb
from recordings.verify.verify import verify

ROOT = Path(__file__).resolve().parents[2]
POOL = """name = "pool"
robot = "panda"
[devices.d455]
kind = "rgbd"
driver = "synthetic"
[devices.arm]
kind = "arm"
driver = "synthetic"
rate_hz = 200
[devices.gripper]
kind = "gripper"
driver = "synthetic"
rate_hz = 50
[recording]
countdown_s = 0
longest_toss_s = 1.5
longest_gap_s = 10
most_lost_share = 1.0
redo_at_most = 1000
queue_s = 4
[simulation]
pictures = "pool"
color_size = [64, 48]
mono_cameras = 0
"""
D455 = 'name = "lab"\n[devices.d455]\nkind = "rgbd"\ndriver = "d455"\nserial = "1"\n'
MONO = 'name = "lab"\n[devices.mono0]\nkind = "mono"\ndriver = "genicam"\nserial = "NONE-SUCH"\n'
ARM = 'name = "lab"\n[devices.arm]\nkind = "arm"\nrate_hz = {}\ndriver = "{}"\naddress = "127.0.0.99"\n'


@pytest.mark.parametrize(
    "rig, says",
    [
        (POOL.replace("longest_toss_s", "longest_tos_s"), "do you mean 'longest_toss_s'?"),
        (POOL.replace("mono_cameras", "mono_camera"), "do you mean 'mono_cameras'?"),
        (D455 + "rate_hz = 25\n", "a D455 does 5, 15, 30, 60, 90"),
        (D455 + '[devices.b]\nkind = "rgbd"\ndriver = "d455"\nserial = "1"\n', "have the same serial 1"),
        pytest.param(D455, "d455: found no RealSense camera; wanted serial 1", id="no such D455"),
        pytest.param(MONO, "wanted serial NONE-SUCH", id="no such grey camera"),
        pytest.param(ARM.format(1000, "franka"), "127.0.0.99", id="no Panda there"),
        pytest.param(ARM.format(500, "ur"), "127.0.0.99", id="no UR there"),
        (POOL.replace("countdown_s = 0", "reserve_gb = 1e9"), "less than the reserve of 1e+09 GB"),
    ],
)
def test_what_cannot_be_recorded_is_refused_before_anything_is_written(
    rig: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], request: pytest.FixtureRequest
) -> None:
    if "franka" in rig or '"ur"' in rig:
        pytest.importorskip("panda_py" if "franka" in rig else "rtde_control")
    if rig == MONO:
        request.getfixturevalue("needs_aravis")
    path, out = tmp_path / "rig.toml", tmp_path / "out"
    path.write_text(rig)
    assert main(["--rig", str(path), "--yes", str(out)]) == 2
    assert says in capsys.readouterr().err
    assert not out.exists()


def test_a_folder_that_exists_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rig.toml").write_text(POOL)
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("precious")
    assert main(["--rig", str(tmp_path / "rig.toml"), "--yes", str(out)]) == 2
    assert "exists already; nothing was written" in capsys.readouterr().err
    assert [p.name for p in out.iterdir()] == ["mine.txt"]


def plug_in(folder: Path, vendor: str, product: str) -> tuple[Path, Path]:
    """A camera as the kernel shows it: its folder in sysfs, its device file."""
    sysfs, nodes = folder / "sys" / "2-1", folder / "dev" / "002"
    sysfs.mkdir(parents=True)
    nodes.mkdir(parents=True)
    for name, text in (("idVendor", vendor), ("product", product), ("busnum", "2"), ("devnum", "7")):
        (sysfs / name).write_text(text + "\n")
    (nodes / "007").write_text("")
    return sysfs.parent, nodes.parent


def test_a_camera_without_permission_is_named_with_the_rule_that_helps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sysfs, nodes = plug_in(tmp_path, "8086", "Intel(R) RealSense(TM) Depth Camera 455")
    assert usb.forbidden(usb.INTEL, sysfs, nodes) == []
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (found,) = usb.forbidden(usb.INTEL, sysfs, nodes)
    assert "Depth Camera 455 is plugged in, but this user may not open" in str(found)
    assert str(found).endswith("002/007")
    assert 'ATTRS{idVendor}=="8086"' in found.fix
    assert usb.forbidden(usb.GREY_CAMERAS, sysfs, nodes) == []
    monkeypatch.setattr(usb, "forbidden", lambda vendors: [found])
    assert "may not open" in usb.hint(usb.INTEL)
    assert any(row.check == "permission" and row.state == "fail" for row in doctor(tmp_path).rows)


def test_other_devices_of_intel_are_no_cameras(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sysfs, nodes = plug_in(tmp_path, "8086", "Bluetooth")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert usb.forbidden(usb.INTEL, sysfs, nodes) == []


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in range(1, 12))])
def test_ctrl_c_at_any_moment_ends_it_and_keeps_what_there_is(seed: int, tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(POOL)
    out, rng = tmp_path / "out", random.Random(seed)
    command = [sys.executable, "-m", "acquisition.cli", "--rig", str(tmp_path / "rig.toml"), "--tosses", "50", "--yes"]
    process = subprocess.Popen([*command, str(out)], cwd=ROOT, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    process.stderr.readline()  # the first line of the preflight: from there on, anything may be going on
    time.sleep(rng.uniform(0.0, 4.0))
    process.send_signal(signal.SIGINT)
    try:
        _, told = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130, told
    assert "everything so far is kept" in told
    assert not out.exists() or verify(out).ok
