"""Curves of the report: pose errors of every toss over time with its phases, and rollouts of the learned model."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from processing.evaluate.score import TossScore
from processing.motion.frame_phases import Phase

PHASE_COLORS: Mapping[Phase, str] = {"held": "#eef3fb", "flight": "#ffffff", "impact": "#fbe3df", "rest": "#eaf5ea"}
ABREAST = 5
"""Tosses side by side."""
LINES = ("#c33c23", "#2c6fb3", "#6f6f6f", "#3d8a3d")


def error_curves(rows: Mapping[str, Sequence[TossScore]]) -> bytes:
    """PNG: per toss, the translation error (upper) and rotation error (lower) of some rows; phases shade the ground."""
    first = next(iter(rows.values()))
    lines = -(-len(first) // ABREAST)
    figure = _figure(min(len(first), ABREAST), 2 * lines)
    axes = figure.subplots(2 * lines, min(len(first), ABREAST), squeeze=False)
    for k, score in enumerate(first):
        upper, column = 2 * (k // ABREAST), k % ABREAST
        for row, name in ((upper, "translation_m"), (upper + 1, "rotation_deg")):
            axis = axes[row][column]
            _shade(axis, score)
            for color, (label, scores) in zip(LINES, rows.items()):
                same = next((s for s in scores if s.toss == score.toss), None)
                if same is not None:
                    values = getattr(same.errors, name) * (1e3 if row == upper else 1.0)
                    axis.plot(same.time_s, np.where(np.isfinite(values), values, np.nan), color=color, lw=1.2,
                              label=label)  # fmt: skip
            axis.tick_params(labelsize=7)
            axis.margins(x=0)
            axis.set_ylim(bottom=0)
        axes[upper][column].set_title(f"toss {score.toss}", fontsize=8)
        axes[upper + 1][column].set_xlabel("s", fontsize=8)
        if column == 0:
            axes[upper][0].set_ylabel("translation, mm", fontsize=8)
            axes[upper + 1][0].set_ylabel("rotation, deg", fontsize=8)
    for empty in range(len(first), lines * ABREAST if lines > 1 else len(first)):
        for row in (2 * (empty // ABREAST), 2 * (empty // ABREAST) + 1):
            axes[row][empty % ABREAST].set_axis_off()
    axes[0][0].legend(fontsize=7, loc="upper left")
    return _png(figure)


def _shade(axis: Any, score: TossScore) -> None:
    """One band for every run of frames in one phase."""
    if not score.phase:
        return
    edges = [0, *(i for i in range(1, len(score.phase)) if score.phase[i] != score.phase[i - 1]), len(score.phase)]
    step = float(np.median(np.diff(score.time_s))) if len(score.time_s) > 1 else 0.03
    for a, b in zip(edges, edges[1:]):
        axis.axvspan(score.time_s[a] - step / 2, score.time_s[b - 1] + step / 2, color=PHASE_COLORS[score.phase[a]],
                     lw=0, zorder=0)  # fmt: skip


def rollout_curves(evaluations: Mapping[str, Mapping[str, Any]], not_learned: Sequence[int]) -> bytes:
    """PNG of the paper's Figure 4: rollout errors over time, mean and 95 % interval over tosses; the means of
    tosses that were not learned on are dashed. `evaluations`: as JSON, by what they are compared with."""
    figure = _figure(4, 2)
    axes = figure.subplots(1, 2)
    for color, (against, document) in zip(LINES, evaluations.items()):
        time_s = np.arange(1, int(document["steps"]) + 1) * float(document["dt_s"])
        for axis, name, scale in ((axes[0], "position_m", 1e3), (axes[1], "rotation_rad", np.degrees(1.0))):
            summary = document[name]
            mean, low, high = (scale * _numbers(summary[k]) for k in ("curve", "curve_low", "curve_high"))
            axis.plot(time_s, mean, color=color, lw=2, label=f"mean against the {against}")
            axis.fill_between(time_s, np.maximum(low, 0), high, color=color, alpha=0.18, lw=0)
            for toss, value in zip(document["tosses"], summary["per_toss"]):
                if toss in not_learned:
                    axis.axhline(
                        scale * value, color=color, lw=1, ls="--", label=f"mean of toss {toss}, not learned on"
                    )
    for axis, title in zip(axes, ("position error, mm", "rotation error, deg")):
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("time since release, s", fontsize=8)
        axis.tick_params(labelsize=8)
        axis.set_ylim(bottom=0)
        axis.margins(x=0)
        axis.grid(alpha=0.25)
    axes[0].legend(fontsize=7)
    return _png(figure)


def _numbers(values: Sequence[Any]) -> Any:
    """JSON's null is a step that no toss reaches."""
    return np.array([np.nan if v is None else v for v in values], dtype=np.float64)


def _figure(columns: int, rows: int) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(max(5.0, 2.5 * columns), 1.9 * rows), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _png(figure: Any) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png")
    return out.getvalue()
