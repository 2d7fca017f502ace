"""`pip install .` into an empty environment: what the wheel holds, and that it works away from the checkout."""

import json
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = set(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"])


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def elsewhere(wheel, tmp_path_factory):
    """A folder with the wheel's content in `site`; `run(program)` runs it there, the checkout nowhere on the path."""
    folder = tmp_path_factory.mktemp("elsewhere")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    environment = {**os.environ, "PYTHONPATH": str(folder / "site")}

    def run(program):
        done = subprocess.run(
            [sys.executable, "-c", program], cwd=folder, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def git(*words):
    """What git says of the checkout."""
    if shutil.which("git") is None:
        pytest.skip("no git here to say what belongs to the checkout: apt-get install git")
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        pytest.skip("no git checkout: what belongs to it is not known")
    return done.stdout


def test_the_wheel_holds_the_packages_and_neither_tests_nor_tools(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    folders = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert folders == PACKAGES
    assert not [n for n in names if "bench" in n or "test" in Path(n).name]


def test_the_wheel_brings_what_is_no_python(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    tracked = git("ls-files", "-z", *PACKAGES)
    assert {n for n in tracked.split("\0") if n and (ROOT / n).exists()} <= names


def test_heavy_simulators_are_asked_for_by_the_extra_sim_alone():
    extras = PROJECT["project"]["optional-dependencies"]
    heavy = ("drake", "pybullet")
    assert {"rig-realsense", "rig-genicam", "rig-franka", "rig-ur", "sim", "learned", "dev"} == set(extras)
    assert sorted(n.split(">")[0] for n in extras["sim"]) == sorted(heavy)
    elsewhere = [n for e, names in extras.items() if e != "sim" for n in names] + PROJECT["project"]["dependencies"]
    assert not [n for n in elsewhere if n.startswith(heavy)]


@pytest.mark.parametrize("command", PROJECT["project"]["scripts"])
def test_every_command_answers_from_the_wheel_in_another_folder(elsewhere, command):
    module, function = PROJECT["project"]["scripts"][command].split(":")
    program = f"""import json, sys, recordings
sys.argv = ["{command}", "--help"]
from {module} import {function} as main
assert main() == 0
print(recordings.__file__)"""
    said = elsewhere(program)
    assert f"usage: {command}" in said
    assert said.splitlines()[-1].endswith("site/recordings/__init__.py"), "that was the checkout"


def test_the_wheel_knows_its_commit(elsewhere):
    said = json.loads(elsewhere("import json; from recordings.version import versions; print(json.dumps(versions()))"))
    assert git("rev-parse", "HEAD").startswith(said["commit"].removesuffix("+changes"))


def test_the_shipped_sample_is_found_and_whole_in_the_wheel(elsewhere):
    program = """from processing.cli import _sample_path
from recordings.cli_session import main
print(_sample_path())
raise SystemExit(main(["verify", str(_sample_path())]))"""
    assert "site/recordings/samples/box_toss" in elsewhere(program).splitlines()[0]
