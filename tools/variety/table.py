"""The one table of a benchmark run, from its rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Row = Mapping[str, Any]
HEAD = (
    "family", "run", "sessions", "ADD", "ADD-S", "SR", "CD cm", "floor cm", "mask IoU", "silent wrong", "flagged",
    "in 95 %", "NEES/6",
    "friction est. (true)", "in interval", "restitution est. (true)", "CPU s", "worst",
)  # fmt: skip
MOST_NEES = 1000
MOST_LISTED = 3
NOTE = """ADD, ADD-S: AUC to 10 cm, SR: within 5 deg and 5 cm; means of sessions, each toss aligned at its first
frame. CD: after rigid ICP, the one shape; floor: all tosses fused at the true poses within the true masks.
Mask IoU: of each frame's mask and the true visible pixels, in percent.
Silent wrong: frames called tracked that are off by more than 5 deg or 2 cm (of plain bodies of revolution:
their axis), of all frames. Flagged: lost or interpolated. In 95 %, NEES/6: tracked frames with a
covariance, the object frame fitted over the toss (wanted: 95, 1; NEES of the median session).
Of more than three estimates: the median of estimate less truth, and of its size. Sessions that failed are
not in the means: they are named below."""


def table(rows: Sequence[Row], split: str) -> str:
    """Markdown: a line for each family and run, then all, then what failed and why, then the seeds."""
    good = [r for r in rows if not r.get("failed")]
    runs = list(dict.fromkeys(name for r in good for name in r["runs"]))
    lines = ["| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
    for family in [*dict.fromkeys(r["family"] for r in rows), "all"]:
        for run in runs:
            those = [r for r in good if family in ("all", r["family"])]
            if those:
                lines.append("| " + " | ".join(_line(family, run, those)) + " |")
    failed = [f"- {r['case']} ({r['family']}): {r['failed']}" for r in rows if r.get("failed")]
    for r in good:
        failed += [f"- {r['case']} ({r['family']}), {n}: {v['failed']}" for n, v in r["runs"].items() if "failed" in v]
    made = [r["made"]["cpu_s"] for r in good]
    told = f"{len(rows)} sessions of {split}, {len(good)} made"
    told += f" in {np.median(made):.0f} CPU s (median; longest {max(made):.0f})" if made else ""
    commits = sorted({r["commit"] for r in rows})
    seeds = " ".join(f"{r['case']}:{r['seed']}" for r in rows)
    parts = [f"**{told}** (commit {', '.join(commits)})", "\n".join(lines), NOTE]
    parts += [f"Failed or skipped: {len(failed)}\n" + "\n".join(failed) if failed else "Failed or skipped: none"]
    return "\n\n".join([*parts, f"Seeds: {seeds}"])


def _line(family: str, run: str, rows: Sequence[Row]) -> list[str]:
    there = [(r, r["runs"][run]["marks"], r["runs"][run]) for r in rows if "marks" in r["runs"].get(run, {})]
    if not there:
        return [family, run, f"0 of {len(rows)}", *["-"] * (len(HEAD) - 3)]
    m = [marks for _, marks, _ in there]
    frames = sum(x["frames"] for x in m)
    worst = min(there, key=lambda t: t[1]["add"])
    inside = [x["friction_inside"] for x in m if x["friction_inside"] is not None]
    return [
        family, run, f"{len(there)} of {len(rows)}", _mean(m, "add", 1), _mean(m, "adds", 1), _mean(m, "success", 1),
        _mean(m, "chamfer_cm", 2), _mean([r for r, _, _ in there], "floor_cm", 2),
        _mean(m, "mask_iou", 1, 100), f"{sum(x['silent'] for x in m)} of {frames}",
        f"{sum(x['flagged'] for x in m)} of {frames}", _mean(m, "inside_95", 0, 100), _nees(m),
        _learned(there, "friction", "friction_mu"),
        f"{sum(inside)} of {len(inside)}" if inside else "-",
        _learned(there, "restitution", "restitution"), _mean([t for _, _, t in there], "cpu_s", 0),
        f"{worst[0]['case']} ({worst[1]['add']:.1f})",
    ]  # fmt: skip


def _learned(there: Sequence[tuple[Row, Row, Row]], name: str, true: str) -> str:
    """Estimates with the truth in brackets; of many the median of estimate less truth and of its size."""
    known = [(m[name], r["physics"][true]) for r, m, _ in there if m.get(name) is not None]
    if len(known) <= MOST_LISTED:
        return " ".join(f"{found:.2f} ({wanted:.2f})" for found, wanted in known) or "-"
    off = np.array(known) @ [1.0, -1.0]
    return f"{np.median(off):+.2f}, size {np.median(np.abs(off)):.2f} of {len(known)}"


def _nees(rows: Sequence[Row]) -> str:
    """The median session's: one frame that is lost with a narrow covariance would decide a mean."""
    values = [r["nees"] for r in rows if r["nees"] is not None]
    middle = float(np.median(values)) if values else float("nan")
    return "-" if not values else f"{middle:.1f}" if middle < MOST_NEES else f"> {MOST_NEES}"


def _mean(rows: Sequence[Row], name: str, digits: int, factor: float = 1.0) -> str:
    values = [factor * r[name] for r in rows if r.get(name) is not None]
    return f"{np.mean(values):.{digits}f}" if values else "-"
