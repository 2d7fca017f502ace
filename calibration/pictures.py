"""A picture of each calibration: where in the image points were seen, and what they leave over."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

LONGEST_ARROW_SHARE = 0.04


def residual_picture(
    path: Path,
    title: str,
    sizes: Mapping[str, tuple[int, int]],
    pixels: Mapping[str, Float[Array, "n 2"]],
    residual_px: Mapping[str, Float[Array, "n 2"]],
) -> Path:
    """One panel per camera: every point with its residual as an arrow (drawn longer by the factor said), the cells that
    were covered, and beside it the residuals themselves."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = [n for n in sizes if len(pixels.get(n, ()))]
    figure, axes = plt.subplots(2, max(1, len(names)), figsize=(4.6 * max(1, len(names)), 7.4), squeeze=False)
    for column, name in enumerate(names):
        _panel(axes[0, column], name, sizes[name], pixels[name], residual_px[name])
        _scatter(axes[1, column], residual_px[name])
    figure.suptitle(title)
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    return path


def _panel(axes: Any, name: str, size: tuple[int, int], pixels: Array, residual: Array) -> None:
    width, height = size
    usual = max(float(np.quantile(np.linalg.norm(residual, axis=1), 0.95)), 1e-6)
    factor = LONGEST_ARROW_SHARE * width / usual
    cells = np.zeros((6, 6))
    at = np.floor(pixels / np.array(size) * 6).clip(0, 5).astype(int)
    np.add.at(cells, (at[:, 1], at[:, 0]), 1)
    axes.imshow(cells > 0, extent=(0, width, height, 0), cmap="Greens", alpha=0.25, vmin=0, vmax=2)
    length = np.linalg.norm(residual, axis=1)
    arrows = {"angles": "xy", "scale_units": "xy", "scale": 1 / factor, "cmap": "viridis", "width": 0.004}
    axes.quiver(*pixels.T, *residual.T, length, **arrows)
    axes.set(xlim=(0, width), ylim=(height, 0), title=f"{name}: arrows x {factor:.0f}, {(cells > 0).sum()} of 36 cells")
    axes.set_aspect("equal")


def _scatter(axes: Any, residual: Array) -> None:
    rms = float(np.sqrt((residual**2).mean()))
    reach = max(3 * rms, 1e-3)
    axes.plot(*residual.T, ".", markersize=2, alpha=0.5)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), title=f"rms {rms:.3f} px", xlabel="px", ylabel="px")
    axes.axhline(0, color="grey", linewidth=0.5)
    axes.axvline(0, color="grey", linewidth=0.5)
    axes.set_aspect("equal")
