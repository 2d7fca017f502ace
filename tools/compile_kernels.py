"""Compile every numba kernel for this machine ahead of its first use, side by side on all cores.

python tools/compile_kernels.py                     # what `make setup` and `make demo` call; nothing is done twice

numba keeps what it compiled beside the sources, or in the user's own cache where the package cannot be written to, by
version of numba, content of the source and kind of CPU. What is not compiled here, or for other types, is compiled at
its first use.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from multiprocessing.connection import Connection, wait
from typing import Any

TRACK, FLIGHT = "processing.track.kernels", "processing.track.flight_kernels"
DEPTH_ERROR, FREE_SURFACE = "processing.track.depth_error.kernels", "processing.track.free_surface.kernels"
CONSISTENCY, APPEARANCE = "processing.track.registration.consistency_kernels", "processing.track.appearance_ratio"
STEPS, SOLVER = "processing.contact.physics.steps_cpu", "processing.contact.physics.solver_cpu"
SE3, TWIST = "processing.motion.se3_kernels", "processing.motion.twist_terms"
PROFILE = "processing.track.revolution.profile_kernels"
AZIMUTH = "processing.track.revolution.azimuth_kernels"
F8, F4, I8 = "float64", "float32", "int64"
V, M, T, Q = f"{F8}[::1]", f"{F8}[:,::1]", f"{F8}[:,:,::1]", f"{F8}[:,:,:,::1]"
V4, M4, T4, Q4 = f"{F4}[::1]", f"{F4}[:,::1]", f"{F4}[:,:,::1]", f"{F4}[:,:,:,::1]"
VI, MI, VB, MB = f"{I8}[::1]", f"{I8}[:,::1]", "boolean[::1]", "boolean[:,::1]"
MOTION = (V, V, VB, V, V, V, V, F8, V)
ROLL = (T, M, M, M, VI, M, M, M, F8, I8, I8, F8)
KERNELS: dict[tuple[str, str], list[tuple[str, ...]]] = {
    (SE3, "exponential"): [(V,)],
    (SE3, "inverse"): [(M,)],
    (TWIST, "to_object"): [(M, V, M, F8, M, V)],
    (TRACK, "align_view"): [(M, I8, VI, T, M4, M4, MI, V, V, M, V, M)],
    (TRACK, "graph_terms"): [(T, MI, M4, M4, MI, V, V, V, F8, "boolean", T, M, T, T, M)],
    (TRACK, "view_terms"): [(M, I8, VI, T, M4, M4, MI, V, V, V, M, V)],
    (DEPTH_ERROR, "add_pairs"): [(T, MI, F8, VI, VI, I8, M, M, F8, M4, M4, MI, V, V, V, M, V, M)],
    (DEPTH_ERROR, "add_shares"): [(M4, V, V, V, I8, V)],
    (FREE_SURFACE, "surface_terms"): [(T, MI, M4, M4, MI, V, V, F8, F8, T, M, T, T, V)],
    (FREE_SURFACE, "slide"): [(M, M, M4)],
    (FLIGHT, "fit_flights"): [(M, MI, V, V, M4, M4, MI, V, V, M, F8)],
    (PROFILE, "surface_terms"): [(M4, M, M, V, V, VB, VI, V, F8, F8, M, V, M, M, V)],
    (PROFILE, "outline_terms"): [(V4, VI, V, V, M, M, V, V, VB, VI, V, F8, M, V, M, M, V)],
    (PROFILE, "outline_points"): [(M, M, V, V, VB, VI, V, M)],
    (AZIMUTH, "descend"): [(VI, M, MI, *MOTION, I8, I8)],
    (AZIMUTH, "greedy"): [(I8, M, MI, *MOTION)],
    (AZIMUTH, "variances"): [(VI, M, MI, *MOTION)],
    (AZIMUTH, "energy"): [(VI, M, MI, *MOTION)],
    (AZIMUTH, "add_shape_ratio"): [(T, Q, T, MI, F8, F8, I8, M)],
    (CONSISTENCY, "consistency_terms"): [(T, MI, M4, M4, VI, VI, MI, V, V, V, "boolean", T, M, M)],
    (APPEARANCE, "_appearance_at"): [(M4, M, M4, VI, V, V, F8, M)],
    (STEPS, "roll_rows"): [ROLL],
    (SOLVER, "solve_rows"): [(T, M, F8, M, F8, I8, F8, I8)],
    ("processing.field.fuse", "_integrate"): [
        (*[T4] * 6, Q4, I8, V4, F4, F4, M4, M4, M4, T4, MB, MB, "uint8[:,:,:]", MB, F4)
    ],
    ("processing.field.outline", "_add_gaps"): [(T4, V, M, F4, F4, T4, T4)],
    ("processing.sensor.surface_kernel", "fit_surface"): [(M4, MB, V, I8, F8, M4, T4)],
    ("recordings.alignment.kernels", "project"): [(M4, T, V, V, T, M)],
    ("recordings.alignment.kernels", "draw"): [(M4, T, M, M4, V)],
    ("recordings.film.raster_kernels", "fill"): [(T, T, M, T)],
}
"""Kernels that Python calls, the slow ones to compile first, with the types that they are called with; what they call
is compiled with them."""
CALLS = {
    TWIST: {SE3}, TRACK: {SE3, TWIST}, DEPTH_ERROR: {SE3}, FREE_SURFACE: {SE3}, FLIGHT: {TWIST, TRACK},
    CONSISTENCY: {SE3, TWIST, TRACK}, APPEARANCE: {SE3}, STEPS: {SOLVER},
}  # fmt: skip
"""Whose kernels a module's kernels call."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=0, help="processes (default: cores)")
    given = parser.parse_args()
    begun, cpu_s = time.monotonic(), 0.0
    modules = list(dict.fromkeys(module for module, _ in KERNELS))
    for module, seconds in side_by_side(modules, given.jobs or os.cpu_count() or 1):
        cpu_s += seconds
        if seconds > 1:
            print(f"compiled {module} in {seconds:.1f} CPU-s", flush=True)
    print(f"{len(KERNELS)} kernels are there after {time.monotonic() - begun:.0f} s ({cpu_s:.1f} CPU-s)")
    return 0


def side_by_side(modules: list[str], jobs: int) -> Iterator[tuple[str, float]]:
    """`compiled` of every module, as they end, so many at a time. Each has a process of its own that was told how to
    hash, and begins when what it calls is there: what else a process compiled, and which of two came first, would show
    in the last digit of what the code computes. They are told through pipes: a Pool's locks need a /dev/shm that can
    be written to."""
    context = multiprocessing.get_context("spawn")
    os.environ["PYTHONHASHSEED"] = "0"
    waiting, busy = list(modules), dict[Connection, str]()
    while waiting or busy:
        left = {*waiting, *busy.values()}
        for module in [m for m in waiting if left.isdisjoint(CALLS.get(m, ()))][: jobs - len(busy)]:
            here, there = context.Pipe(duplex=False)
            context.Process(target=_compile, args=(module, there), daemon=True).start()
            there.close()
            waiting.remove(module)
            busy[here] = module
        for one in wait(list(busy)):
            try:
                done = one.recv()
            except EOFError:
                raise SystemExit("a kernel could not be compiled; what went wrong stands above") from None
            del busy[one]
            one.close()
            yield done


def _compile(module: str, told: Connection) -> None:
    told.send(compiled(module))


def compiled(module: str) -> tuple[str, float]:
    """A module's kernels in one process, as they call each other: its name, and CPU seconds that compiling them (or
    reading what is there) took."""
    imported, begun = import_module(module), time.process_time()
    for (its, name), signatures in KERNELS.items():
        for types in signatures if its == module else ():
            getattr(imported, name).compile(as_called(types))
    return module, time.process_time() - begun


def as_called(types: tuple[str, ...]) -> tuple[Any, ...]:
    """The types as a call of the kernel has them: by these numba finds it on disk, by their spelling it would not."""
    from numba.core.sigutils import normalize_signature

    arguments, _ = normalize_signature(f"({', '.join(types)},)")
    return arguments


def unforeseen() -> list[str]:
    """Kernels that this process had compiled for other types than those above."""
    found = []
    for (module, name), signatures in KERNELS.items():
        foreseen = {as_called(types) for types in signatures}
        used = getattr(import_module(module), name).signatures
        found += [f"{module}.{name}{types}" for types in used if types not in foreseen]
    return found


if __name__ == "__main__":
    sys.exit(main())
