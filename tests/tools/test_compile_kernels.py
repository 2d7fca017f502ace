"""What set-up compiles is all that there is to compile."""

import ast
import importlib.util
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def decorated(tree):
    """Functions that numba compiles."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and any("njit" in ast.unparse(d) for d in node.decorator_list):
            yield node


def test_every_kernel_is_compiled_ahead_or_called_by_one_that_is():
    found = importlib.util.spec_from_file_location("compile_kernels", ROOT / "tools" / "compile_kernels.py")
    tool = importlib.util.module_from_spec(found)
    found.loader.exec_module(tool)
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
