"""What holds for the house as a whole: quick and light --help, pinned packages, laws that no tool knows."""

import ast
import importlib.util
import json
import re
import resource
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
COMMANDS = PROJECT["scripts"]
HEAVY = ("open3d", "torch", "rerun", "mujoco", "numba", "rosbags", "pyrealsense2", "pinocchio", "pydrake", "pybullet",
         "matplotlib", "trimesh", "skimage", "pyarrow", "pupil_apriltags")  # fmt: skip
HELP_CPU_S = 0.5

# Runs a command as its console script would, then says on the last line what it had imported.
ASK = """
import json, sys
sys.argv = {argv!r}
code = None
try:
    from {module} import {function} as main
    code = main()
except SystemExit as leaving:
    code = leaving.code
print()
print(json.dumps([code or 0, sorted({{name.partition(".")[0] for name in sys.modules}})]))
"""


def ask(command, *arguments):
    """Exit code, text, top-level modules imported, CPU seconds of one call in a fresh interpreter."""
    module, function = COMMANDS[command].split(":")
    program = ASK.format(argv=[command, *arguments], module=module, function=function)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    *text, last = done.stdout.splitlines()
    code, modules = json.loads(last)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return code, "\n".join(text), set(modules), cpu_s


@pytest.mark.parametrize("command", COMMANDS)
def test_help_shows_an_example_and_imports_nothing_heavy(command):
    code, text, modules, _ = ask(command, "--help")
    assert code == 0
    assert f"usage: {command}" in text
    assert re.search(rf"^\s*{command} \S", text, re.M), "no copyable example"
    assert modules.isdisjoint(HEAVY), f"--help imports {sorted(modules.intersection(HEAVY))}"


@pytest.mark.parametrize("command", COMMANDS)
def test_help_answers_in_under_half_a_second(command):
    # the quickest of three: what other programs do meanwhile is not ours
    assert min(ask(command, "--help")[3] for _ in range(3)) < HELP_CPU_S


@pytest.mark.parametrize("command", COMMANDS)
def test_an_unknown_argument_is_usage_and_exit_code_2(command):
    assert ask(command, "--no-such-thing")[0] == 2


def test_constraints_pin_names_and_versions_and_nothing_else():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    wrong = [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9A-Za-z.]*", line)]
    assert not wrong
    assert "torch==2.13.0" in lines


def test_every_package_that_the_project_asks_for_is_pinned():
    def plain(name):
        return re.sub(r"[-_.]+", "-", re.match(r"[A-Za-z0-9._-]+", name).group()).lower()

    asked = [*PROJECT["dependencies"], *(n for extra in PROJECT["optional-dependencies"].values() for n in extra)]
    pinned = {plain(line) for line in (ROOT / "constraints.txt").read_text().splitlines()}
    assert {plain(name) for name in asked} <= pinned


def test_every_pin_lies_in_the_range_that_the_project_asks_for():
    asked = [Requirement(n) for n in PROJECT["dependencies"]]
    asked += [Requirement(n) for extra in PROJECT["optional-dependencies"].values() for n in extra]
    pins = (line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines())
    pinned = {canonicalize_name(name): version for name, version in pins}
    wrong = [str(r) for r in asked if not r.specifier.contains(pinned[canonicalize_name(r.name)], prereleases=True)]
    assert not wrong


def test_the_same_pythons_are_named_by_the_project_the_makefile_and_the_readme():
    allowed = SpecifierSet(PROJECT["requires-python"])
    wanted = [f"3.{minor}" for minor in range(8, 20) if f"3.{minor}.1" in allowed]
    made = re.findall(r"python(3\.\d+)", re.search(r"^PYTHON := .*$", (ROOT / "Makefile").read_text(), re.M).group())
    said = re.findall(r"3\.\d+", re.search(r"Python 3[^;:]*", (ROOT / "README.md").read_text()).group())
    assert made == wanted
    assert said == wanted


def test_torch_is_installed_first_in_the_version_that_is_pinned():
    assert "torch==2.13.0" in PROJECT["dependencies"]
    assert re.findall(r"torch==[\d.]+", (ROOT / "Makefile").read_text()) == ["torch==2.13.0"]


@pytest.fixture
def check():
    """tools/check.py, which nothing imports otherwise."""
    spec = importlib.util.spec_from_file_location("tools_check", ROOT / "tools" / "check.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "line", ["DATA = '/" + "work/shared'", "open('/" + "tmp/x')", "see files.python" + "hosted.org"]
)
def test_names_of_machines_are_found(check, line):
    assert len(list(check.hidden_machines("a.py", f"x = 1\n{line}\n"))) == 1


@pytest.mark.parametrize("line", ["results/work/a", "https://example.org/tmp/", "out/" + "tmp/x", "/d455/color"])
def test_other_paths_are_left_alone(check, line):
    assert not list(check.hidden_machines("a.py", line))


def test_long_files_and_long_functions_need_a_reason_of_their_own(check):
    long_file = "x = 1\n" * 401
    assert len(list(check.too_long("a.py", long_file))) == 1
    assert not list(check.too_long("a.py", long_file + "# long because: one table\n"))
    function = "def f():\n    # long because: one loop\n    return 1\n"
    assert len(list(check.too_long("a.py", long_file + function))) == 1  # a function's reason is not its file's
    long_function = "def f():\n" + "    x = 1\n" * 80
    assert len(list(check.too_long("a.py", long_function + "# long because: not in the function\n"))) == 1
    assert not list(check.too_long("a.py", long_function + "    # long because: one compiled loop\n    x = 2\n"))


def test_a_stage_is_found_by_its_call_of_the_store(check):
    call = ast.parse("run.store.run('fuse', VERSION, config, inputs, FuseResult, compute)", mode="eval").body
    assert check.stage_made(call) == "fuse"
    assert check.stage_made(ast.parse("subprocess.run('fuse')", mode="eval").body) is None


def test_no_paragraph_of_the_architecture_is_longer_than_120_words_and_every_file_it_names_is_there():
    text = (ROOT / "ARCHITECTURE.md").read_text()
    prose = re.sub(r"```.*?```", "", text, flags=re.S)
    blocks = re.split(r"\n\s*\n|\n(?=\d+\. |- |\|)", prose)
    long = [(len(b.split()), b[:60]) for b in blocks if len(b.split()) > 120]
    assert not long
    packages = "acquisition|calibration|groundtruth|processing|recordings"
    named = set(re.findall(rf"`((?:{packages}|tools)/[\w/]+\.py)`", text))
    assert len(named) > 30
    assert not [name for name in named if not (ROOT / name).is_file()]


def test_the_pipeline_is_on_one_screen():
    assert len((ROOT / "processing" / "pipeline" / "process.py").read_text().splitlines()) <= 120
