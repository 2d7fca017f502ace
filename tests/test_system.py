"""A bare machine: which of the system's libraries are needed, how set-up brings them, what is said without them."""

import ctypes.util
import importlib.util
import json
import shutil
import subprocess
import sys
import tomllib
from contextlib import nullcontext
from importlib import metadata
from pathlib import Path

import pytest

from recordings import version
from recordings.console import BAD_INPUT, Outcome, command_parser, run_command
from recordings.system_libraries import advice, load_unpacked

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
NO_LIBRARY = "libEGL.so.1: cannot open shared object file: No such file or directory"


def tool(name):
    """A module of tools/, which nothing imports otherwise."""
    spec = importlib.util.spec_from_file_location(f"tools_{name}", ROOT / "tools" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def check_system():
    return tool("check_system")


@pytest.fixture
def make_venv(monkeypatch):
    """tools/make_venv.py on a system that keeps pip apart from its Python, as Debian does."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    module = tool("make_venv")
    monkeypatch.setattr(module, "has_pip", lambda: False)
    return module


@pytest.fixture
def bare(check_system, monkeypatch):
    """A machine that has none of the libraries, with apt-get; a list of the commands that were run."""
    ran = []
    monkeypatch.setattr(check_system, "loads", lambda library: False)
    monkeypatch.setattr(check_system.shutil, "which", lambda program: f"/usr/bin/{program}")
    monkeypatch.setattr(check_system, "quietly", lambda command, *_, **__: ran.append(command) is None)
    return ran


def test_the_demo_asks_for_no_camera_s_library_and_for_no_graphics_driver(check_system, bare):
    asked = check_system.missing_packages("demo")
    assert asked
    assert not {"libaravis-0.8-0", "libvulkan1", "mesa-vulkan-drivers", "aravis-tools"} & set(asked)
    assert {"libaravis-0.8-0", "libvulkan1"} <= set(check_system.missing_packages("rig"))


def test_root_installs_what_is_missing_and_is_told(check_system, bare, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(check_system.os, "geteuid", lambda: 0)
    check_system.bring(tmp_path, "demo")
    assert bare[0] == ["apt-get", "update", "-q"]
    assert bare[1][:2] == ["apt-get", "install"]
    assert "libegl1" in bare[1]
    assert "installs the system's packages" in capsys.readouterr().err


def test_a_sudo_that_asks_nothing_installs_too(check_system, bare, monkeypatch, tmp_path):
    monkeypatch.setattr(check_system.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(
        check_system.subprocess, "run", lambda command, **_: subprocess.CompletedProcess(command, 0, "", "")
    )
    check_system.bring(tmp_path, "demo")
    assert all(command[:2] == ["sudo", "-n"] for command in bare)


def test_any_other_user_unpacks_into_the_environment_and_is_given_one_line(
    check_system, bare, monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(check_system, "as_root", lambda: None)
    check_system.bring(tmp_path, "demo")
    assert not any("install" in command for command in bare), "it installed without being root"
    assert sum("download" in command for command in bare) >= len(check_system.missing_packages("demo"))
    last = capsys.readouterr().err.splitlines()[-1]  # here nothing was really downloaded: all is still missing
    assert last.startswith("apt-get update && apt-get install -y --no-install-recommends libegl1")


def test_what_was_unpacked_is_not_missing_any_more(check_system, bare, tmp_path):
    for library in check_system.NEEDED:
        (tmp_path / library).touch()
    assert check_system.missing_packages("demo", tmp_path) == []


def test_set_up_goes_on_where_there_is_no_apt(check_system, bare, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(check_system.shutil, "which", lambda program: None)
    check_system.bring(tmp_path, "demo")
    assert bare == []
    assert "your package manager has what Debian calls libegl1" in capsys.readouterr().err


def test_a_package_s_library_is_kept_once_under_the_name_that_is_asked_for(check_system, tmp_path):
    place = tmp_path / "root" / "usr" / "lib" / "any-triplet"
    place.mkdir(parents=True)
    (place / "libone.so.1.2.3").write_bytes(b"library")
    (place / "libone.so.1").symlink_to("libone.so.1.2.3")
    (place / "libtwo.so.5").write_bytes(b"another")
    check_system.keep(tmp_path / "root", tmp_path / "kept")
    assert {p.name: p.read_bytes() for p in (tmp_path / "kept").iterdir()} == {
        "libone.so.1": b"library",
        "libtwo.so.5": b"another",
    }


def test_a_library_that_a_running_program_has_loaded_is_replaced_and_not_written_into(check_system, tmp_path):
    """Set-up for the tests after set-up for the demo ended in a segmentation fault: Python had the libraries loaded."""
    place, kept = tmp_path / "root" / "usr" / "lib" / "x86_64-linux-gnu", tmp_path / "kept"
    place.mkdir(parents=True)
    (place / "libone.so.1").write_bytes(b"library")
    check_system.keep(tmp_path / "root", kept)
    with (kept / "libone.so.1").open("rb") as loaded:
        (place / "libone.so.1").write_bytes(b"a newer one")
        check_system.keep(tmp_path / "root", kept)
        assert loaded.read() == b"library"
    assert [(p.name, p.read_bytes()) for p in kept.iterdir()] == [("libone.so.1", b"a newer one")]


def test_a_python_without_pip_gets_it_out_of_debian_s_wheel(make_venv, monkeypatch, tmp_path):
    ensurepip = pytest.importorskip("ensurepip", reason="no wheel of pip here to bring: apt-get install python3-venv")
    wheel = next(Path(ensurepip.__file__).parent.glob("_bundled/pip-*.whl"), None) or next(
        Path("/usr/share/python-wheels").glob("pip-*.whl")
    )
    wheels = tmp_path / "unpacked" / "usr" / "share" / "python-wheels"
    wheels.mkdir(parents=True)
    shutil.copy(wheel, wheels)
    asked = []
    monkeypatch.setattr(make_venv, "as_root", lambda: None)
    monkeypatch.setattr(make_venv, "unpacked", lambda names: asked.extend(names) or nullcontext(tmp_path / "unpacked"))
    assert make_venv.make(tmp_path / "venv")
    assert asked == ["python3-pip-whl"]
    said = subprocess.run([tmp_path / "venv" / "bin" / "pip", "--version"], capture_output=True, text=True, check=True)
    assert str(tmp_path / "venv") in said.stdout


def test_where_pip_cannot_be_had_the_line_for_an_administrator_is_given(make_venv, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(make_venv, "as_root", lambda: None)
    monkeypatch.setattr(make_venv, "unpacked", lambda names: nullcontext(tmp_path))
    assert not make_venv.make(tmp_path / "venv")
    version = f"python{sys.version_info.major}.{sys.version_info.minor}"
    assert capsys.readouterr().err.endswith(f"apt-get update && apt-get install -y {version}-venv\n")


def test_root_installs_the_package_that_makes_environments(make_venv, monkeypatch, tmp_path, capsys):
    installed = []
    monkeypatch.setattr(make_venv, "as_root", lambda: [])
    monkeypatch.setattr(make_venv, "install", lambda prefix, packages: installed.extend(packages))
    monkeypatch.setattr(make_venv, "bring_pip", lambda folder: True)
    assert make_venv.make(tmp_path / "venv")
    assert installed == [f"python{sys.version_info.major}.{sys.version_info.minor}-venv"]
    assert "installs the system's package" in capsys.readouterr().err


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="shared objects of Linux")
def test_unpacked_libraries_are_loaded_and_what_is_none_is_named(tmp_path):
    name = ctypes.util.find_library("z")
    found = next((p for p in Path("/").glob(f"usr/lib/*/{name}")), None) or next(Path("/").glob(f"lib/*/{name}"), None)
    if found is None:
        pytest.skip("no zlib of the system here")
    shutil.copy(found.resolve(), tmp_path / "libcopy.so.1")
    (tmp_path / "libbroken.so.1").write_bytes(b"no library")
    assert load_unpacked(tmp_path) == ["libbroken.so.1"]
    assert str(tmp_path / "libcopy.so.1") in Path("/proc/self/maps").read_text()


def test_a_missing_library_is_one_message_with_the_line_to_type(capsys):
    def work(_):
        raise ImportError(NO_LIBRARY)

    parser = command_parser("toss-thing", "A command.")
    parser.set_defaults(work=work)
    assert run_command(parser, []) == BAD_INPUT
    said = capsys.readouterr().err
    assert "libEGL.so.1 is not on this system" in said
    assert "apt-get install -y --no-install-recommends libegl1" in said
    assert "Traceback" not in said
    assert "fault of tosslab" not in said


def test_a_package_that_is_not_there_is_no_matter_of_the_system():
    assert advice(ModuleNotFoundError("No module named 'open3d'")) is None
    assert "has it" in advice(ImportError(NO_LIBRARY.replace("EGL", "Other")))


def test_the_doctor_names_the_library_that_a_camera_s_package_lacks(monkeypatch):
    from acquisition.doctor import realsense
    from acquisition.drivers import realsense_setup
    from recordings.errors import DeviceNotFound

    def connected():
        raise DeviceNotFound("no SDK") from ImportError(NO_LIBRARY.replace("libEGL.so.1", "libusb-1.0.so.0"))

    monkeypatch.setattr(realsense_setup, "connected", connected)
    (row,) = realsense()
    assert "libusb-1.0-0" in row.wanted


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_says_version_commit_and_what_it_runs_on(command):
    module, function = COMMANDS[command].split(":")
    program = f"import sys; sys.argv = ['{command}', '--version', '--json']; from {module} import {function} as m; m()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True)
    said = json.loads(done.stdout)
    assert said["tosslab"] == metadata.version("tosslab")
    assert said["torch"] == metadata.version("torch")
    assert said["numba"] == metadata.version("numba")
    if shutil.which("git") is None:
        assert said["commit"]
        return
    head = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, cwd=ROOT)
    if head.returncode == 0:
        assert head.stdout.startswith(said["commit"].removesuffix("+changes"))


def test_outside_of_git_the_commit_is_that_of_the_wheel_or_unknown(monkeypatch, tmp_path):
    monkeypatch.setattr(version, "PACKAGE", tmp_path / "site" / "recordings")
    monkeypatch.setattr(version, "COMMIT_FILE", tmp_path / "commit.txt")
    assert version.commit() == "unknown"
    (tmp_path / "commit.txt").write_text("0123456789ab\n")
    assert version.commit() == "0123456789ab"


def test_a_version_needs_no_session_and_no_subcommand(capsys):
    parser = command_parser("toss-thing", "A command.")
    parser.add_argument("session")
    parser.set_defaults(work=lambda _: Outcome())
    assert run_command(parser, ["--version"]) == 0
    assert capsys.readouterr().out.startswith("toss-thing 0.")
