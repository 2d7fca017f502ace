"""What set-up compiles is all that there is to compile."""

import ast
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def decorated(tree):
    """Functions that numba compiles."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list):
            yield node


@pytest.fixture
def tool(monkeypatch):
    """As a module that processes of its own can import."""
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("compile_kernels")


def test_a_kernel_that_does_not_compile_ends_set_up_with_a_sentence(tool, capfd):
    with pytest.raises(SystemExit, match="could not be compiled"):
        list(tool.side_by_side(["processing.motion.se3_kernels", "processing.no_such_kernels"], jobs=2))
    assert "no_such_kernels" in capfd.readouterr().err


@pytest.mark.slow
def test_what_was_compiled_ahead_is_found_by_the_first_call(tmp_path):
    """By a process of its own: numba keeps what it compiled by the types of a call."""
    ahead = "import compile_kernels as c; c.compiled('processing.motion.se3_kernels')"
    call = (
        "import numpy as np, processing.motion.se3_kernels as k; k.inverse(np.eye(4));"
        "print(sum(k.inverse.stats.cache_hits.values()), sum(k.inverse.stats.cache_misses.values()))"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": f"{ROOT / 'tools'}:{ROOT}"}
    for code in (ahead, call):
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1", "0"]


def test_a_module_waits_for_those_whose_kernels_it_calls(tool):
    modules = {module for module, _ in tool.KERNELS}
    called = {}
    for module in modules:
        kernels = [f for f in vars(importlib.import_module(module)).values() if hasattr(f, "py_func")]
        foreign = {f.py_func.__module__ for f in kernels if f.targetoptions.get("inline") != "always"}  # these: no code
        named = {v.__name__ for v in vars(importlib.import_module(module)).values() if inspect.ismodule(v)}
        if found := (foreign | named & modules) - {module}:
            called[module] = found
    assert called == tool.CALLS


def test_every_kernel_is_compiled_ahead_or_called_by_one_that_is(tool):
    kernels, called = set(), set()
    for path in (p for package in ("processing", "recordings") for p in (ROOT / package).rglob("*.py")):
        if "njit" not in (text := path.read_text()):
            continue
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for function in decorated(ast.parse(text)):
            kernels.add((module, function.name))
            calls = (n.func for n in ast.walk(function) if isinstance(n, ast.Call))
            called |= {f.id if isinstance(f, ast.Name) else getattr(f, "attr", "") for f in calls}
    assert len(kernels) > 40
    listed = set(tool.KERNELS)
    assert listed <= kernels
    assert not [f"{m}.{n}" for m, n in kernels - listed if n not in called]
