"""A picture of each calibration: where in the image points were seen, and what they leave over."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

LONGEST_ARROW_SHARE = 0.04
MOST_ARROWS = 350
"""More of them hide each other: then every second, third, ... is drawn."""


def residual_picture(
    path: Path,
    title: str,
    sizes: Mapping[str, tuple[int, int]],
    pixels: Mapping[str, Float[Array, "n 2"]],
    residual_px: Mapping[str, Float[Array, "n 2"]],
) -> Path:
    """One panel per camera: points with their residuals as arrows (drawn longer by the factor said, the same in all
    panels), the cells that were covered, and below it all residuals themselves, on one scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = [n for n in sizes if len(pixels.get(n, ()))]
    figure, axes = plt.subplots(2, max(1, len(names)), figsize=(4.6 * max(1, len(names)), 7.4), squeeze=False)
    every = np.concatenate([residual_px[n] for n in names]) if names else np.zeros((1, 2))
    usual = max(float(np.quantile(np.linalg.norm(every, axis=1), 0.95)), 1e-6)
    factor = _rounded(LONGEST_ARROW_SHARE * max((sizes[n][0] for n in names), default=1) / usual)
    reach = max(3.5 * float(np.sqrt((every**2).mean())), 1e-3)
    for column, name in enumerate(names):
        _panel(axes[0, column], name, sizes[name], pixels[name], residual_px[name], factor)
        _scatter(axes[1, column], residual_px[name], reach)
    return _saved(figure, path, f"{title} (green: seen there; arrows: seen minus predicted, {factor:g} times as long)")


def _rounded(value: float) -> float:
    """Down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(k for k in (1, 2, 5) if k * power <= value))


def _panel(axes: Any, name: str, size: tuple[int, int], pixels: Array, residual: Array, factor: float) -> None:
    width, height = size
    cells = np.zeros((6, 6))
    at = np.floor(pixels / np.array(size) * 6).clip(0, 5).astype(int)
    np.add.at(cells, (at[:, 1], at[:, 0]), 1)
    axes.imshow(cells > 0, extent=(0, width, height, 0), cmap="Greens", alpha=0.25, vmin=0, vmax=2)
    some = slice(None, None, max(1, int(np.ceil(len(pixels) / MOST_ARROWS))))
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1 / factor, "color": "#3b528b", "width": 0.003}
    axes.plot(*pixels.T, ".", color="#3b528b", markersize=1, alpha=0.3)
    axes.quiver(*pixels[some].T, *residual[some].T, **arrows)
    covered = f"{len(pixels)} points in {(cells > 0).sum()} of 36 cells"
    axes.set(xlim=(0, width), ylim=(height, 0), title=f"{name}: {covered}", xlabel="px", ylabel="px")
    axes.set_aspect("equal")


def _scatter(axes: Any, residual: Array, reach: float) -> None:
    rms = float(np.sqrt((residual**2).mean()))
    beyond = int((np.abs(residual).max(axis=1) > reach).sum())
    axes.plot(*residual.T, ".", markersize=2, alpha=0.5)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), xlabel="px", ylabel="px")
    axes.set_title(f"residuals: rms {rms:.3f} px" + (f", {beyond} beyond the picture" if beyond else ""))
    axes.axhline(0, color="grey", linewidth=0.5)
    axes.axvline(0, color="grey", linewidth=0.5)
    axes.set_aspect("equal")


def table_picture(
    path: Path,
    title: str,
    points_m: Float[Array, "n 3"],
    height_m: Float[Array, " n"],
    tags_m: Float[Array, "m 2"],
) -> Path:
    """How far depth's points of the table lie above the plane that was found, where on the table (world x, y), and how
    they scatter. `points_m` in the world, `tags_m`: x, y of the corners of the table's tags."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (map_of, scatter) = plt.subplots(1, 2, figsize=(11, 4.6), width_ratios=(1.6, 1))
    reach_mm = max(1.0, 1e3 * float(np.quantile(np.abs(height_m), 0.98))) if len(height_m) else 1.0
    shown = map_of.scatter(*points_m[:, :2].T, c=1e3 * height_m, s=2, cmap="RdBu_r", vmin=-reach_mm, vmax=reach_mm)
    map_of.plot(*tags_m.T, "k+", label="corners of the table's tags")
    figure.colorbar(shown, ax=map_of, label="above the plane, mm")
    map_of.set(title="depth of the table, seen from above", xlabel="world x, m", ylabel="world y, m")
    map_of.set_aspect("equal")
    if len(tags_m):
        map_of.legend(loc="upper right")
    scatter.hist(1e3 * height_m, bins=np.linspace(-reach_mm, reach_mm, 60), color="#3b528b")
    middle = 1e3 * float(np.median(height_m)) if len(height_m) else float("nan")
    scatter.set(title=f"{len(height_m)} points, median {middle:+.2f} mm", xlabel="above the plane, mm")
    scatter.axvline(0, color="black", linewidth=0.8)
    return _saved(figure, path, title)


def offsets_picture(path: Path, title: str, by_stream: Mapping[str, Mapping[str, tuple[float, float]]]) -> Path:
    """Clock offsets of each stream by toss, ms with their standard deviations, and what they pool to (`pooled`)."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, max(1, len(by_stream)), figsize=(5.5 * max(1, len(by_stream)), 4), squeeze=False)
    for panel, (stream, offsets) in zip(axes[0], by_stream.items()):
        tosses = {name: v for name, v in offsets.items() if name != "pooled"}
        values, stds = (np.array([v[k] for v in tosses.values()]) for k in (0, 1))
        panel.errorbar(np.arange(len(tosses)), values, yerr=2 * stds, fmt="o", capsize=4, color="#3b528b")
        if "pooled" in offsets:
            middle, std = offsets["pooled"]
            panel.axhspan(middle - 2 * std, middle + 2 * std, color="#5ec962", alpha=0.35)
            panel.axhline(middle, color="#2b7a2f", label=f"together {middle:+.3f} ms, +-{2 * std:.3f} (2 sigma)")
            panel.legend()
        panel.set_xticks(np.arange(len(tosses)), list(tosses))
        panel.set(title=f"{stream} against the D455", xlabel="toss", ylabel="to be added to its stamps, ms")
        panel.margins(x=0.2)
    return _saved(figure, path, title)


def _saved(figure: Any, path: Path, title: str) -> Path:
    import matplotlib.pyplot as plt

    figure.suptitle(title)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path
