"""Rig files: what is known, what is refused, and with which words."""

from __future__ import annotations

from pathlib import Path

import pytest

from acquisition.rig import find_rig, read_rig, shipped_rigs
from acquisition.setup import make_device, set_up
from recordings.errors import BadInput

CAMERA = '[devices.d455]\nkind = "rgbd"\ndriver = "d455"\nserial = "1"\n'


def rig_file(folder: Path, text: str) -> Path:
    path = folder / "lab.toml"
    path.write_text('name = "lab"\n' + text)
    return path


@pytest.mark.parametrize("name", ["synthetic", "lab", "ur5e"])
def test_every_shipped_rig_is_read(name: str) -> None:
    rig = read_rig(find_rig(name))
    assert rig.name == name
    assert name in shipped_rigs()
    assert rig.of_kind("rgbd")


@pytest.mark.parametrize("name", ["lab", "ur5e"])
def test_every_device_of_a_shipped_rig_has_a_driver_that_takes_its_settings(name: str) -> None:
    rig = read_rig(find_rig(name))
    for entry in rig.devices:
        assert make_device(entry, rig.source).name == entry.name


@pytest.mark.parametrize(
    "text, says",
    [
        (CAMERA + "exposre = 3\n", "unknown key 'exposre'"),
        (CAMERA + "rate_herz = 30\n", "do you mean 'rate_hz'?"),
        ("recordin = 3\n" + CAMERA, "do you mean 'recording'?"),
        (CAMERA + "[recording]\npre_triger_s = 1.0\n", "do you mean 'pre_trigger_s'?"),
        (CAMERA + "rate_hz = 31\n", "a D455 does 5, 15, 30, 60, 90"),
        (CAMERA + "rate_hz = 90\nsettings = { width = 1280, height = 720 }\n", "only up to 30"),
        (CAMERA + "rate_hz = -1\n", "wanted a positive number"),
        (
            CAMERA + '[devices.b]\nkind = "rgbd"\ndriver = "d455"\nserial = "1"\n',
            "'d455' and 'b' have the same serial 1",
        ),
        (CAMERA + '[devices.a]\nkind = "arm"\ndriver = "franka"\nrate_hz = 500\n', "franka does 1000"),
        (CAMERA + '[devices.a]\nkind = "camra"\ndriver = "d455"\n', "wanted one of rgbd, mono, arm, gripper"),
        (CAMERA + "[toss]\nvelocity_m_s = [1, 2]\n", "wanted 3 values"),
        (CAMERA + "[toss]\nseed = 1\n", "a [toss] needs an arm"),
        (CAMERA + "[recording]\nmono_jpeg_quality = 101\n", "from 1 to 100"),
        ("", "no [devices.NAME]"),
        ("devices = 3\n", "wanted [devices.NAME] tables"),
        ("name = \n", "cannot be read as a rig file"),
    ],
)
def test_a_wrong_rig_file_is_refused_by_name(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(BadInput) as refused:
        read_rig(rig_file(tmp_path, text))
    assert says in str(refused.value)


def test_a_rig_that_is_not_shipped_names_those_that_are() -> None:
    with pytest.raises(BadInput, match=r"do you mean 'synthetic'\?.*lab, synthetic, ur5e"):
        find_rig("syntetic")
    with pytest.raises(BadInput, match="is no file"):
        find_rig("nowhere.toml")


def test_a_wrong_setting_of_a_driver_is_refused_by_name(tmp_path: Path) -> None:
    path = rig_file(tmp_path, CAMERA + "settings = { presett = 'x' }\n")
    with pytest.raises(BadInput, match="do you mean 'preset"):
        set_up(str(path))


def test_a_driver_that_nobody_knows_is_refused(tmp_path: Path) -> None:
    path = rig_file(tmp_path, '[devices.x]\nkind = "mono"\ndriver = "webcam"\n')
    with pytest.raises(BadInput, match="wanted one of d455, genicam"):
        set_up(str(path))


def test_simulated_and_real_devices_do_not_mix(tmp_path: Path) -> None:
    path = rig_file(tmp_path, CAMERA + '[devices.m]\nkind = "mono"\ndriver = "synthetic"\n')
    with pytest.raises(BadInput, match="wanted one or the other"):
        set_up(str(path))
