"""How well the table tells the depth scale, on drawn calibrations without pictures: cameras, places and errors of the
`choose` split, each calibration turned about the camera, and about a point of the table.

    .venv/bin/python tools/bench_depth_scale.py [--n 200] [--picture docs/decisions/depth-scale.png]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array
from variety.scene import camera_model, world_from_camera
from variety.seeds import Case
from variety.spec import Spec, draw

from acquisition.synthetic.random_draws import small_error
from processing.segment.background.depth_scale import DepthScaleSettings, TableScale, posterior_scale, table_scale
from processing.segment.background.static_scene import StaticScene, plane_depth
from recordings.geometry import CameraModel, Transform

PIVOTS = ("camera", "table")
TABLE_HALF_M = (0.45, 0.35)
COARSER = 6
"""Of the camera's pixels so many stand for one each way."""
SWEPT_MM = np.linspace(0.25, 6.0, 24)


@dataclass(frozen=True)
class Drawn:
    """One calibration: the true scale, and what the table says of it."""

    true: float
    seen: TableScale
    height_m: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n", type=int, default=200, help="calibrations of each kind")
    parser.add_argument("--picture", type=Path, help="the sweep of place_m as a picture")
    args = parser.parse_args()
    drawn = {pivot: [d for k in range(args.n) if (d := one(k, pivot)) is not None] for pivot in PIVOTS}
    settings = DepthScaleSettings()
    print(f"{'turned about':14s}{'n':>5s}   rms error of the scale, %: {'none':>6s} {'table':>6s} {'camera':>6s} "
          f"{'halfway':>7s} {'used':>6s}   within its 95 %")  # fmt: skip
    for pivot, cases in drawn.items():
        found = [rms([1.0 - d.true for d in cases]), *(rms([told(d) - d.true for d in cases]) for told in TOLD), rms(
            errors(cases, settings))]  # fmt: skip
        figures = " ".join(f"{100 * x:6.2f}" for x in found)
        print(f"{pivot:14s}{len(cases):5d}   {'':29s}{figures}   {100 * inside(cases, settings):.0f} %")
    curves = {pivot: sweep(cases, settings) for pivot, cases in drawn.items()}
    for place_mm, *likely in zip(SWEPT_MM, *curves.values(), strict=True):
        print(f"place_m {place_mm:5.2f} mm: {' '.join(f'{x:7.3f}' for x in likely)} nats a calibration")
    if args.picture:
        draw_sweep(args.picture, curves, settings)


TOLD = (lambda d: d.seen.turned_at_table, lambda d: d.seen.turned_at_camera, lambda d: d.seen.scale)


def one(number: int, pivot: str) -> Drawn | None:
    """The calibration of a `choose` case; None where it hardly shows the table."""
    spec = draw(Case("choose", number, 0))
    rng = np.random.default_rng([spec.seed, 99])
    place, camera = world_from_camera(spec.camera, float(np.exp(rng.uniform(*np.log([0.04, 0.2]))))), small(spec)
    wrong = spec.wrong
    frame = "d455" if pivot == "camera" else "world"
    error = small_error(frame, wrong.camera_m, wrong.camera_deg, rng)
    believed = place @ error if pivot == "camera" else error @ place
    scene = table_seen(camera, place, wrong.depth_scale)
    focal = replace(camera, K=camera.K * np.array([[1 + wrong.focal_share], [1 + wrong.focal_share], [1]]))
    scene = replace(scene, table_depth_m=table_depth(focal, believed))
    found = table_scale(scene, focal, believed, DepthScaleSettings())
    return None if found is None else Drawn(wrong.depth_scale, found, float(believed.translation_m[2]))


def small(spec: Spec) -> CameraModel:
    """The camera with fewer pixels."""
    whole = camera_model(spec.camera)
    K = whole.K.copy()
    K[:2] /= COARSER
    return replace(whole, width=whole.width // COARSER, height=whole.height // COARSER, K=K)


def table_seen(camera: CameraModel, place: Transform, scale: float) -> StaticScene:
    """A bare table as depth reports it."""
    depth = table_depth(camera, place)
    at = camera.pixel_rays() * depth[..., None] @ place.rotation.T + place.translation_m
    on = (depth > 0) & (np.abs(at[..., 0]) < TABLE_HALF_M[0]) & (np.abs(at[..., 1]) < TABLE_HALF_M[1])
    depth = np.where(on, scale * depth, 0.0).astype(np.float32)
    return StaticScene(depth, 0 * depth, np.zeros((*depth.shape, 3), np.float32), 0 * depth, on, depth)


def table_depth(camera: CameraModel, place: Transform) -> Float32[Array, "h w"]:
    """Of z = 0 of the world."""
    return plane_depth(camera, place.rotation[2], -float(place.translation_m[2]))


def rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def errors(cases: list[Drawn], settings: DepthScaleSettings) -> list[float]:
    """Of the scale that depth is divided by."""
    return [posterior_scale(d.seen.scale, sigma_of(d, settings), settings) - d.true for d in cases]


def sigma_of(case: Drawn, settings: DepthScaleSettings) -> float:
    """The estimate's standard deviation at other settings than it was made with."""
    own = DepthScaleSettings().place_m / case.height_m
    return float(np.sqrt(case.seen.sigma**2 - own**2 + (settings.place_m / case.height_m) ** 2))


def posterior(cases: list[Drawn], settings: DepthScaleSettings) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    sigma = np.array([sigma_of(d, settings) for d in cases])
    return np.array(errors(cases, settings)), sigma * settings.among_cameras / np.hypot(sigma, settings.among_cameras)


def inside(cases: list[Drawn], settings: DepthScaleSettings) -> float:
    off, sigma = posterior(cases, settings)
    return float((np.abs(off) < 1.96 * sigma).mean())


def sweep(cases: list[Drawn], settings: DepthScaleSettings) -> list[float]:
    """Mean log-likelihood of the true scale by `place_m`."""
    likely = []
    for place_mm in SWEPT_MM:
        off, sigma = posterior(cases, replace(settings, place_m=1e-3 * float(place_mm)))
        likely.append(float((-0.5 * (off / sigma) ** 2 - np.log(sigma * np.sqrt(2 * np.pi))).mean()))
    return likely


def draw_sweep(path: Path, curves: dict[str, list[float]], settings: DepthScaleSettings) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    for pivot, likely in curves.items():
        axes.plot(SWEPT_MM, likely, label=f"calibration turned about the {pivot}")
    axes.axvline(1e3 * settings.place_m, color="0.6", linestyle=":")
    axes.set_xlabel("place_m: standard deviation of the camera's distance from the table (mm)")
    axes.set_ylabel("log-likelihood of the true scale\n(nats a calibration)")
    axes.legend(frameon=False)
    FigureCanvasAgg(figure).print_png(str(path))


if __name__ == "__main__":
    main()
