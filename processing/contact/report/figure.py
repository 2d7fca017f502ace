"""The picture of a result: rollout errors against time, the learned shape, friction and how its weight was chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.learn.learn import ContactLearning
from processing.contact.physics.geometry import hull_mesh
from processing.contact.report.rollout_errors import Evaluation, Summary

INK, GREY, BLUE, RED = "#222222", "#9a9a9a", "#2b6ca3", "#c1442e"


def draw_result(
    path: Path, learning: ContactLearning, evaluation: Evaluation, unlearned: tuple[int, ...] = (), title: str = ""
) -> None:
    """Write a PNG: position and rotation errors (every toss thin, those not learned from in red where both kinds are
    there, mean and 95 % interval over tosses), the shape from three sides, the sweep of weights."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 7.2), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 6, height_ratios=(1.25, 1))
    draw_errors(figure.add_subplot(grid[0, :3]), figure.add_subplot(grid[0, 3:]), evaluation, unlearned)
    for column, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
        _outline(figure.add_subplot(grid[1, column]), learning, a, b)
    _sweep(figure.add_subplot(grid[1, 3:5]), learning)
    _friction(figure.add_subplot(grid[1, 5]), learning)
    count = len(evaluation.errors.tosses)
    figure.suptitle(
        (title + ": " if title else "")
        + f"learned from {len(learning.tosses)} tosses, rolled out on {count} "
        + f"(step {evaluation.errors.step_s * 1e3:.2f} ms)",
        x=0.01,
        ha="left",
        fontsize=12,
        color=INK,
    )
    figure.savefig(path)


def draw_errors(left: Any, right: Any, done: Evaluation, unlearned: tuple[int, ...]) -> None:
    """Position (left axes) and rotation errors of rollouts against time; tosses not learned from are marked."""
    time_ms = 1e3 * done.errors.step_s * np.arange(1, done.errors.position_m.shape[1] + 1)
    marked = np.isin(done.errors.tosses, unlearned)
    _errors(left, time_ms, 1e3 * done.errors.position_m, done.position, 1e3, marked, "mm")
    degrees = np.degrees(done.errors.rotation_rad)
    _errors(right, time_ms, degrees, done.rotation, 180 / np.pi, marked, "deg")


def _plain(axes: Any) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.tick_params(labelsize=8, colors=INK)


def _errors(
    axes: Any,
    time_ms: Float[Array, " t"],
    errors: Float[Array, "n t"],
    summary: Summary,
    unit: float,
    marked: Any,
    name: str,
) -> None:
    both = bool(marked.any() and not marked.all())
    for row, special in zip(errors, marked):
        axes.plot(
            time_ms,
            row,
            lw=1.4 if both and special else 0.5,
            color=RED if both and special else GREY,
            alpha=0.55,
            zorder=1,
        )
    axes.fill_between(
        time_ms, unit * summary.curve_low, unit * summary.curve_high, color=BLUE, alpha=0.25, lw=0, zorder=2
    )
    axes.plot(time_ms, unit * summary.curve, color=BLUE, lw=2.2, zorder=3)
    reached = int(np.flatnonzero(summary.count > 0)[-1]) + 1  # steps that some toss lasts for
    late = errors[:, reached - max(reached // 4, 1) : reached]
    top = max(float(np.nanpercentile(late, 97)), float(np.nanmax(unit * summary.curve_high)))
    axes.set(xlim=(0, time_ms[reached - 1]), ylim=(0, 1.05 * top), xlabel="time since the start of the rollout, ms")
    what = "position error, mm" if name == "mm" else "rotation error, deg"
    axes.set_title(
        f"{what}: mean {unit * summary.mean:.1f} ({unit * summary.low:.1f} .. {unit * summary.high:.1f})",
        fontsize=10,
        loc="left",
        color=INK,
    )
    if both:
        axes.text(0.02, 0.93, "red: not learned from", color=RED, fontsize=8, transform=axes.transAxes)
    missing = int((summary.count < summary.count[0]).sum())
    if missing:
        ends = f"{int(summary.count[0])} tosses at first, {int(summary.count[reached - 1])} at the end"
        axes.text(0.02, 0.87, ends, color=INK, fontsize=8, transform=axes.transAxes)
    _plain(axes)


def _outline(axes: Any, learning: ContactLearning, a: int, b: int) -> None:
    points = learning.model.support_vertices_m * 1e3
    for piece in learning.model.pieces:
        vertices, faces = hull_mesh(points[list(piece)])
        for i, j in {tuple(sorted((f[k], f[(k + 1) % 3]))) for f in faces for k in range(3)}:
            axes.plot(vertices[[i, j], a], vertices[[i, j], b], color=BLUE, lw=0.7, alpha=0.5)
    touched = learning.touched
    axes.plot(points[touched, a], points[touched, b], "o", ms=3.5, color=BLUE, label="touched")
    if not touched.all():
        axes.plot(points[~touched, a], points[~touched, b], "o", ms=3.5, mfc="white", color=RED, label="never touched")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"{'xyz'[a]}{'xyz'[b]}, mm", fontsize=9, loc="left", color=INK)
    _plain(axes)


def _sweep(axes: Any, learning: ContactLearning) -> None:
    axes.set_title("held-out rollouts by weight of dissipation", fontsize=9, loc="left", color=INK)
    if learning.sweep is None:
        axes.text(
            0.5, 0.5, f"weight {learning.weights.dissipation:g}, not searched", ha="center", color=INK, fontsize=9
        )
        axes.set_axis_off()
        return
    tried = learning.sweep.candidates
    weight = [c.dissipation for c in tried]
    axes.semilogx(weight, [1e3 * c.error_m.mean() for c in tried], "o-", color=INK, lw=1.2, ms=4)
    chosen = learning.sweep.chosen
    axes.plot(chosen.dissipation, 1e3 * chosen.error_m.mean(), "o", ms=10, mfc="none", color=RED)
    axes.set(xlabel="weight (circle: chosen)", ylabel="position error, mm")
    axes.set_ylim(bottom=0)
    _plain(axes)


def _friction(axes: Any, learning: ContactLearning) -> None:
    f = learning.friction
    axes.errorbar([0], [f.value], yerr=[[f.value - f.low], [f.high - f.value]], fmt="o", color=BLUE, capsize=5)
    axes.set(xlim=(-1, 1), xticks=[], ylim=(0, max(0.4, 1.2 * f.high)))
    axes.set_title(f"friction {f.value:.3f}", fontsize=9, loc="left", color=INK)
    _plain(axes)
