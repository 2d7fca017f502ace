"""Contact learning against the figures of its issue: accuracy, CPU seconds, other shapes. Its intervals: see
bench_intervals.py.

python tools/bench_contact.py [CASE...]      # box16 box64 hull16 noise shapes; all by default

Needs the real cube tosses: TOSSLAB_DATA/contactnets/tosses_processed. One thread; CPU seconds, not wall time.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

from processing.contact.learn.data_checks import duplicate_groups
from processing.contact.learn.fit import FRICTION
from processing.contact.learn.from_tracks import learn_from_series
from processing.contact.learn.learn import ContactLearning, learn_contact
from processing.contact.learn.prior import Prior, prior_from_shape, prior_from_size
from processing.contact.physics.inertia import Physics, known_physics, uniform_physics
from processing.contact.physics.plane import Plane
from processing.contact.report.rollout_errors import evaluate
from processing.motion.trajectory import PoseSeries, rotation_matrices
from recordings.tracks import ObjectShape

ROOT = Path(__file__).resolve().parent.parent
TOSSES = Path(os.environ.get("TOSSLAB_DATA", ROOT.parent / "shared" / "data")) / "contactnets" / "tosses_processed"
HALF_M, STEP_S = 0.0524, 1 / 148
CUBE = known_physics(0.37, 0.00081 * np.eye(3))
TEST = range(100, 150)
TWINS = {56: 140}
"""Toss 56 is toss 140 again: it may not be learned from."""


def toss(number: int) -> PoseSeries:
    table = torch.load(TOSSES / f"{number}.pt", weights_only=True)[0].numpy()
    return PoseSeries.from_quaternions(number, STEP_S, table[:, 3:7], table[:, :3] * HALF_M)


def there(numbers: Sequence[int]) -> list[int]:
    return [n for n in numbers if (TOSSES / f"{n}.pt").exists()]


@cache
def repeats() -> frozenset[int]:
    """Tosses that are the recording of a lower number again."""
    groups = duplicate_groups([toss(n) for n in there(range(600))])
    return frozenset(t for group in groups for t in group[1:])


def recorded_once(numbers: Sequence[int]) -> list[int]:
    """Those of the numbers that are there and repeat no recording of a lower number: halves then share none."""
    return [n for n in there(numbers) if n not in repeats()]


def test_tosses() -> list[PoseSeries]:
    return [toss(n) for n in there(TEST)]


def noisy(track: PoseSeries, every: int, position_m: float, rotation_rad: float, seed: int) -> PoseSeries:
    """The track at a lower rate with white noise on its poses."""
    rng, part = np.random.default_rng([seed, track.toss]), track.part(slice(0, None, every))
    turned = part.rotation @ rotation_matrices(rotation_rad * rng.standard_normal((len(part), 3)))
    moved = part.position_m + position_m * rng.standard_normal((len(part), 3))
    return replace(part, rotation=turned, position_m=moved)


def true_cube(learning: ContactLearning, tests: Sequence[PoseSeries]) -> tuple[float, float]:
    """Rollout error of the true cube (mm, deg) on the same tosses: the better of plane 0 and -1.2 mm."""
    found = []
    for offset in (0.0, -0.0012):
        start = prior_from_size("box", 2 * HALF_M)
        model = replace(learning.fitted, geometry=start.geometry)
        parameters = model.start()
        parameters[FRICTION] = 0.18**0.5
        cube = replace(learning, fitted=model, fit=replace(learning.fit, parameters=parameters), frame=start.frame)
        done = evaluate(cube, tests, Plane(offset_m=offset))
        found.append((1e3 * done.position.mean, float(np.degrees(done.rotation.mean))))
    return min(found)


def rolled(learning: ContactLearning, tests: Sequence[PoseSeries]) -> tuple[float, float]:
    done = evaluate(learning, tests)
    return 1e3 * done.position.mean, float(np.degrees(done.rotation.mean))


def line(case: str, text: str) -> None:
    print(f"{case:<22} {text}", flush=True)


def box(count: int) -> None:
    began = time.process_time()
    tests = test_tosses()
    tracks = [toss(n) for n in there([n for n in range(100) if n not in TWINS])[:count]]
    learning = learn_contact(tracks, prior_from_size("box", 0.05), CUBE)
    mm, deg = rolled(learning, tests)
    total = time.process_time() - began
    true_mm, true_deg = true_cube(learning, tests)
    edges = [1e3 * e.value for e in learning.extents]
    f = learning.friction
    line(
        f"box, {count} tosses",
        f"{mm:.2f} mm / {deg:.2f} deg; true cube {true_mm:.2f} / {true_deg:.2f}; ratio {mm / true_mm:.3f} / "
        f"{deg / true_deg:.3f}; "
        f"friction {f.value:.3f} ({f.low:.3f} .. {f.high:.3f}); edges {np.round(edges, 2)} mean {np.mean(edges):.2f}; "
        f"fit {learning.cpu_seconds:.2f} CPU-s, all {total:.1f} + imports; weight {learning.weights.dissipation:g}; "
        f"unsolved {learning.solver_failures}; unexplained {sum(map(len, learning.unexplained.values()))}",
    )


def hull(count: int = 16) -> None:
    """From a sphere, with the plane as calibrated by the data's own resting height (-1.2 mm) and with the plane at
    0."""
    import trimesh

    tests, tracks = test_tosses(), [toss(n) for n in there(range(count))]
    cube = trimesh.creation.box(np.full(3, 2 * HALF_M))
    for offset in (0.0, -0.0012):
        began = time.process_time()
        plane = Plane(offset_m=offset)
        learning = learn_contact(tracks, prior_from_size("hull", 0.05), CUBE, plane)
        total = time.process_time() - began
        done = evaluate(learning, tests, plane)
        line(
            f"hull, {count}, plane {offset * 1e3:.1f} mm",
            f"Chamfer {1e3 * chamfer_m(learning.shape, cube):.2f} mm; friction {learning.friction.value:.3f}; "
            f"{1e3 * done.position.mean:.2f} mm / {np.degrees(done.rotation.mean):.2f} deg; fit "
            f"{learning.cpu_seconds:.1f} CPU-s, "
            f"all {total:.1f}; weight {learning.weights.dissipation:g}; untouched {len(learning.untouched_vertices)}",
        )


def chamfer_m(shape: ObjectShape, truth: object) -> float:
    """Half the sum of the mean distances from each surface to the other (30,000 points each way)."""
    import open3d as o3d
    import trimesh

    def distance(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
        return scene.compute_distance(points.astype(np.float32)).numpy()

    a, b = trimesh.Trimesh(shape.vertices_m, shape.faces), truth
    one, two = (np.asarray(trimesh.sample.sample_surface(m, 30000, seed=0)[0]) for m in (a, b))
    return float(0.5 * (distance(b, one).mean() + distance(a, two).mean()))


def noise() -> None:
    tests = test_tosses()
    for mm_noise, deg_noise in ((1.0, 0.5), (3.0, 1.5)):
        for seed, numbers in enumerate((range(10), range(100, 110), range(200, 210), range(300, 310))):
            picked = there(numbers)
            tracks = [noisy(toss(n), 5, 1e-3 * mm_noise, np.radians(deg_noise), seed) for n in picked]
            began = time.process_time()
            learning = learn_contact(tracks, prior_from_size("box", 0.05), CUBE)
            mm, deg = rolled(learning, [t for t in tests if t.toss not in picked])
            f = learning.friction
            line(
                f"30 Hz, {mm_noise:g} mm {deg_noise:g} deg",
                f"tosses {picked[0]}..{picked[-1]}: {mm:.2f} mm / {deg:.2f} deg; friction {f.value:.3f} ({f.low:.3f} "
                ".. "
                f"{f.high:.3f}); edges {np.round([1e3 * e.value for e in learning.extents], 1)}; all "
                f"{time.process_time() - began:.1f} CPU-s; weight {learning.weights.dissipation:g}",
            )


def simulated(
    mesh_pieces: Sequence[object],
    physics: Physics,
    mu: float,
    count: int,
    seed: int,
    soft_s: float = 0.002,
    damping: float = 1.0,
) -> list[PoseSeries]:
    """Tosses of a body made of convex pieces onto a plane, by MuJoCo, sampled at 148 Hz. Contacts give way for about
    `soft_s`; with a `damping` below 1 they rebound."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = STEP_S / 20
    spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 30
    body = spec.worldbody.add_body(name="object")
    body.add_freejoint()
    body.explicitinertial, body.mass, body.ipos = True, physics.mass_kg, physics.center_of_mass_m
    inertia = physics.inertia_kgm2
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    stiff = {
        "friction": [mu, 1e-5, 1e-6],
        "solref": [soft_s, damping],
        "solimp": [0.95, 0.99, 0.0005, 0.5, 2],
        "condim": 3,
    }
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], **stiff)
    for i, piece in enumerate(mesh_pieces):
        spec.add_mesh(name=f"m{i}", uservert=piece.vertices.ravel(), userface=piece.faces.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{i}", mass=0, **stiff)
    model = spec.compile()
    rng, tracks = np.random.default_rng(seed), []
    for n in range(count):
        data = mujoco.MjData(model)
        q = rng.standard_normal(4)
        data.qpos[:] = [0, 0, 0.25, *(q / np.linalg.norm(q))]
        data.qvel[:] = [*rng.uniform(-1, 1, 2), 0.3, *rng.uniform(-8, 8, 3)]
        rows = []
        for _ in range(120):
            rows.append(data.qpos.copy())
            mujoco.mj_step(model, data, 20)
        table = np.array(rows)
        tracks.append(PoseSeries.from_quaternions(n, STEP_S, table[:, 3:], table[:, :3]))
    return tracks


def any_body(kind: str, rng: np.random.Generator) -> tuple[list[object], object]:
    """Convex pieces and the closed surface of a box, a triangular prism or an L of random size."""
    if kind == "box":
        half = rng.uniform(0.03, 0.07, 3) if rng.random() < 0.6 else np.full(3, rng.uniform(0.035, 0.06))
        return [block(-half, half)], block(-half, half)
    if kind == "prism":
        w, h, length = rng.uniform(0.05, 0.1), rng.uniform(0.05, 0.1), rng.uniform(0.08, 0.16)
        made = prism(np.array([[-w / 2, 0], [w / 2, 0], [0, h]]), length)
        return [made], made
    scale = rng.uniform(0.7, 1.3)
    whole = l_mesh()
    whole.vertices = whole.vertices * scale
    ends = ((0.12, 0.04, 0.05), (0.04, 0.1, 0.05))
    return [block(np.zeros(3), scale * np.array(e)) for e in ends], whole


def held(shape: ObjectShape, physics: Physics, rng: np.random.Generator) -> Prior:
    """A hull 3 % too big and rough by .5 mm, held within 2 mm, as from vision."""
    center = physics.center_of_mass_m
    bigger = 1.03 * (shape.vertices_m - center) + center
    rough = replace(shape, vertices_m=bigger + 5e-4 * rng.standard_normal(bigger.shape), source="vision")
    prior = prior_from_shape("hull", rough, physics)
    return replace(prior, sigma_m=np.full(len(prior.geometry.start()) // 3, 0.002))


def shapes() -> None:
    """Prism, half cylinder (hull) and L-shape (nonconvex) simulated with friction .25, from a prior 6 % too big."""
    angle = np.linspace(0, np.pi, 17)
    half = np.stack([0.04 * np.cos(angle), 0.04 * np.sin(angle)], 1)
    triangle = np.array([[-0.036, 0.0], [0.036, 0.0], [0.0, 0.0716]])
    made = {
        "prism": [prism(triangle, 0.1)],
        "half cylinder": [prism(half, 0.1)],
        "L-shape": [block((0, 0, 0), (0.12, 0.04, 0.05)), block((0, 0.04, 0), (0.04, 0.1, 0.05))],
    }
    for name, pieces in made.items():
        truth = pieces[0] if len(pieces) == 1 else l_mesh()
        shape = ObjectShape("object", "truth", np.asarray(truth.vertices), np.asarray(truth.faces, dtype=np.int64))
        physics = uniform_physics(shape, 0.3)
        tracks = simulated(pieces, physics, 0.25, 24, seed=1)
        rng = np.random.default_rng(0)
        bigger = 1.06 * (shape.vertices_m - physics.center_of_mass_m) + physics.center_of_mass_m
        start = replace(shape, vertices_m=bigger + 5e-4 * rng.standard_normal(shape.vertices_m.shape), source="vision")
        learned = learn_from_series(tracks[:16], start, physics=physics)
        learning = learned.fused
        done = evaluate(learning, tracks[16:])
        hull = chamfer_m(learned.learning.shape, truth)
        line(
            name,
            f"Chamfer {1e3 * chamfer_m(start, truth):.2f} -> {1e3 * chamfer_m(learned.shape, truth):.2f} mm (contact "
            f"alone {1e3 * hull:.2f}); {learned.choice.name}; friction "
            f"{learning.friction.value:.3f} ({learning.friction.low:.3f} .. {learning.friction.high:.3f}), true "
            ".250; rollouts "
            f"{1e3 * done.position.mean:.1f} mm / {np.degrees(done.rotation.mean):.1f} deg on 8 unseen; fit "
            f"{learning.cpu_seconds:.1f} CPU-s; pieces {len(learning.model.pieces)}; weight "
            f"{learning.weights.dissipation:g}; "
            f"untouched {len(learning.untouched_vertices)} of {len(learning.touched)}",
        )


def block(low: Sequence[float], high: Sequence[float]) -> object:
    import trimesh

    return trimesh.creation.box(bounds=np.array([low, high]))


def prism(outline_m: np.ndarray, length_m: float) -> object:
    """A right prism over a convex outline."""
    import trimesh

    ends = [np.column_stack([outline_m, np.full(len(outline_m), z)]) for z in (-length_m / 2, length_m / 2)]
    return trimesh.convex.convex_hull(np.concatenate(ends))


def l_mesh() -> object:
    """The L-shape's closed surface: its outline extruded, triangulated by hand."""
    import trimesh

    outline = np.array([[0, 0], [0.12, 0], [0.12, 0.04], [0.04, 0.04], [0.04, 0.1], [0, 0.1]])
    n = len(outline)
    low, high = (np.column_stack([outline, np.full(n, z)]) for z in (0.0, 0.05))
    caps = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[i, (i + 1) % n, n + i] for i in range(n)] + [[(i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    faces = np.concatenate([caps[:, ::-1], caps + n, np.array(sides)])
    mesh = trimesh.Trimesh(np.concatenate([low, high]), faces, process=True)
    return mesh.subdivide().subdivide()


CASES: dict[str, Callable[[], None]] = {
    "box16": lambda: box(16),
    "box64": lambda: box(64),
    "hull16": hull,
    "noise": noise,
    "shapes": shapes,
}


def run_cases(cases: dict[str, Callable[[], None]], without_data: Sequence[str] = ()) -> int:
    """Run the cases named on the command line, or all; those not `without_data` only where the real tosses are."""
    torch.set_num_threads(1)
    wrong = [c for c in sys.argv[1:] if c not in cases]
    if wrong:
        print(f"no case {wrong}; there are {list(cases)}", file=sys.stderr)
        return 2
    for case in sys.argv[1:] or cases:
        if case not in without_data and not TOSSES.is_dir():
            line(case, f"left out: no {TOSSES}")
            continue
        cases[case]()
    return 0


if __name__ == "__main__":
    sys.exit(run_cases(CASES, without_data=("shapes",)))
