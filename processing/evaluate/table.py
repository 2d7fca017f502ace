"""table.json and table.md: every number with its unit, how many it is from, what was aligned, and its stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from processing.contact.friction.estimate import RESTITUTION_ASSUMED
from processing.evaluate.learned_values import learned_values
from processing.evaluate.score import TossScore, Value, VariantScore
from processing.track.flags import SURE_DEG, SURE_M
from processing.variants import ROWS, TABLE, WITH_MODEL
from recordings.notices import Notice, in_order, said_of
from recordings.results.folder import Results, VariantRecord
from recordings.tracks import ObjectTrack
from recordings.whole_file import without_nan, write_bytes, write_json

TABLE_FORMAT = 1
COLUMNS = (
    ("adds_auc", "ADD-S %"),
    ("add_auc", "ADD %"),
    ("success_5deg_5cm", "SR %"),
    ("cd", "CD cm"),
    ("cd_icp", "CD icp cm"),
    ("cd_floor", "floor cm"),
    ("median_rotation", "median deg"),
    ("median_translation", "median mm"),
)
CONTACT_COLUMNS = (
    ("friction", "friction"),
    ("restitution", "restitution"),
    ("rollout_track_position", "rollout mm, track"),
    ("rollout_track_rotation", "rollout deg, track"),
    ("rollout_position", "rollout mm, truth"),
    ("rollout_rotation", "rollout deg, truth"),
)
"""What was learned of contact, in a table of its own below the scores; columns that no row fills are left out."""
TossState = Literal["together", "apart", "alone", "lost"]


@dataclass(frozen=True, eq=False)
class Row:
    """One variant with its scores, or without them where there is no truth. `learned`: what contact learning says."""

    record: VariantRecord
    tracks: dict[int, ObjectTrack]
    score: VariantScore | None
    learned: Mapping[str, Value] = field(default_factory=dict)

    def state(self, toss: int) -> TossState:
        """How a toss is among the others: in their object frame, `apart` in its own because no one shape explains both,
        `alone` where the row has no common frame, `lost` from end to end."""
        if self.tracks[toss].lost.all():
            return "lost"
        first = next((v.first for v in (*ROWS, WITH_MODEL) if v.name == self.record.name), "all_tosses")
        if self.record.scope == "one" or first == "one_toss":
            return "alone"
        own = self.record.toss(toss).shape or self.record.shape
        return "together" if own == self.record.shape else "apart"


def collect(results: Results, scores: dict[tuple[str, str], VariantScore]) -> list[Row]:
    """Every variant of the results folder, in the order of the paper's table."""
    order = {v.name: i for i, v in enumerate(TABLE)}
    names = sorted(results.variants(), key=lambda v: (v[1], order.get(v[0], len(order)), v[0]))
    found = []
    for variant in names:
        record = results.find(*variant)
        learned = learned_values(results, record)
        found.append(Row(record, results.tracks(*variant), scores.get(variant), learned))
    return found


def status_counts(track: ObjectTrack) -> dict[str, int]:
    """Frames tracked, interpolated and lost."""
    return {s: track.status.count(s) for s in ("tracked", "interpolated", "lost")}


def table_document(results: Results, rows: Sequence[Row]) -> dict[str, Any]:
    """table.json as plain values."""
    return {"format_version": TABLE_FORMAT, "rows": [_row_document(results, row) for row in rows]}


def _row_document(results: Results, row: Row) -> dict[str, Any]:
    record, score = row.record, row.score
    stages = sorted({s for t in record.tosses for s in (t.track, t.shape, t.masks) if s} | {record.shape or ""} - {""})
    paper = next((v.paper for v in TABLE if v.name == record.name), None) if record.scope == "one" else None
    values = {**row.learned, **(score.values if score else {})}
    return {
        "variant": record.name,
        "scope": record.scope,
        "label": record.label,
        "session": record.session_name,
        "tosses": [t.toss for t in record.tosses],
        "values": {name: value.to_json() for name, value in values.items()},
        "per_toss": [
            {"toss": toss, "state": row.state(toss), **status_counts(track), **_toss_values(score, toss)}
            for toss, track in row.tracks.items()
        ],
        "warnings": [n.to_json() for n in in_order((*record.warnings, *_of_score(score)))],
        "notes": list(record.notes),
        "stages": {s: results.stage(s).get("key", "") for s in stages},
        "paper": None if paper is None else dict(zip(("adds_auc", "add_auc", "success_5deg_5cm", "cd"), paper)),
    }


def _toss_values(score: VariantScore | None, toss: int) -> dict[str, float]:
    from processing.evaluate.score import pose_values

    found: list[TossScore] = [t for t in (score.tosses if score else ()) if t.toss == toss]
    return {n: v.value for t in found for n, v in pose_values(t.errors, "own first frame").items()}


def markdown(document: dict[str, Any]) -> str:
    """table.md: one block per scope; the paper's figures (of one toss at a time, another data set) beside ours."""
    rows = document["rows"]
    lines = [f"# {rows[0]['session'] if rows else 'results'}", ""]
    for scope in sorted({r["scope"] for r in rows}):
        own = [r for r in rows if r["scope"] == scope]
        lines += [f"## scope {scope}", "", *_block(own), "", *_contact_block(own)]
    lines += _legend(rows)
    lines += [f"- {line}" for kind in ("warnings", "notes") for line in said(rows, kind)]
    return "\n".join(lines) + "\n"


def _legend(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What the columns mean, as far as they are there."""
    there = {name for row in rows for name in row["values"]}
    lines = [
        "All frames of these tosses count; a lost one has an infinite error, also in a toss that is lost end to end. "
        f"Unsure (`interpolated`): a pose that its covariance takes to be off by more than {SURE_DEG:g} deg or "
        f"{100 * SURE_M:g} cm (root mean square).",
        "Poses are aligned per toss at its own first frame; a toss whose first frame is lost is not aligned. CD icp: "
        "after a further rigid alignment of the mesh.",
    ]
    if "cd_floor" in there:
        lines.append("floor: each toss's frames fused at the true poses: what one toss can show of the shape at all.")
    if there & {name for name, _ in CONTACT_COLUMNS}:
        lines.append("Friction, restitution and rollouts with 95 % intervals; rollouts: mean error over 99 steps.")
    if "restitution" in there:
        lines.append(f"The interval of restitution: {RESTITUTION_ASSUMED}.")
    if any(row["paper"] for row in rows):
        lines.append("In brackets: the paper's figure for this row, on the paper's own data.")
    return lines


def said(rows: Sequence[dict[str, Any]], kind: Literal["warnings", "notes"]) -> list[str]:
    """What is said of the rows, by weight, each sentence once, with the rows that it is said of before it."""
    whose = [(f"{row['variant']} ({row['scope']})", Notice.from_json(n)) for row in rows for n in row[kind]]
    return said_of(whose, "every row", len(rows))


def _of_score(score: VariantScore | None) -> list[Notice]:
    if score is None:
        return [Notice("score", "low", "no ground truth: nothing could be scored")]
    return [Notice("score", "medium", sentence) for sentence in score.warnings]


def _block(rows: Sequence[dict[str, Any]]) -> list[str]:
    columns = [(name, title) for name, title in COLUMNS if name != "cd_floor" or any(name in r["values"] for r in rows)]
    titles = ["variant", "tosses", "frames", "unsure", "lost", *(title for _, title in columns)]
    lines = ["| " + " | ".join(titles) + " |", "|---|" + "---:|" * (len(titles) - 1)]
    for row in rows:
        frames = sum(t["tracked"] + t["interpolated"] + t["lost"] for t in row["per_toss"])
        unsure, lost = (sum(t[s] for t in row["per_toss"]) for s in ("interpolated", "lost"))
        cells = [row["variant"], _tosses(row), str(frames), str(unsure), str(lost)]
        lines.append("| " + " | ".join([*cells, *(_cell(row, name) for name, _ in columns)]) + " |")
    return lines


def _tosses(row: dict[str, Any]) -> str:
    """How many, and which of them are lost from end to end or kept apart."""
    odd = [
        f"{state}: {', '.join(str(t['toss']) for t in row['per_toss'] if t['state'] == state)}"
        for state in ("lost", "apart")
        if any(t["state"] == state for t in row["per_toss"])
    ]
    return f"{len(row['tosses'])} ({'; '.join(odd)})" if odd else str(len(row["tosses"]))


def _contact_block(rows: Sequence[dict[str, Any]]) -> list[str]:
    """What was learned of contact, of the rows that learned any."""
    columns = [(name, title) for name, title in CONTACT_COLUMNS if any(name in r["values"] for r in rows)]
    if not columns:
        return []
    lines = ["| variant | " + " | ".join(title for _, title in columns) + " |", "|---|" + "---:|" * len(columns)]
    for row in (r for r in rows if any(name in r["values"] for name, _ in columns)):
        cells = (with_interval(row["values"].get(name)) for name, _ in columns)
        lines.append(f"| {row['variant']} | " + " | ".join(cells) + " |")
    return [*lines, ""]


def with_interval(value: Mapping[str, Any] | None) -> str:
    """A value of table.json with its 95 % interval, where it has one: `0.178 [0.121, 0.235]`."""
    if value is None or value["value"] is None:
        return "-"
    form = "{:.3f}" if value["unit"] == "" else "{:.1f}"
    text = form.format(value["value"])
    if value.get("low") is None or value.get("high") is None:
        return text
    return f"{text} [{form.format(value['low'])}, {form.format(value['high'])}]"


def _cell(row: dict[str, Any], name: str) -> str:
    value = row["values"].get(name)
    if value is not None and value["value"] is None:  # an infinite error has no number in JSON
        return "lost"
    text = "-" if value is None else f"{value['value']:.3f}" if value["unit"] == "cm" else f"{value['value']:.2f}"
    paper = (row["paper"] or {}).get(name)
    return text if paper is None else f"{text} ({paper:g})"


def write_table(results: Results, rows: Sequence[Row]) -> dict[str, Any]:
    """Write table.json and table.md into the results folder; returns table.json's content."""
    document = without_nan(table_document(results, rows))  # an infinite error of a lost frame has no number
    write_json(results.path / "table.json", document)
    write_bytes(results.path / "table.md", markdown(document).encode())
    return document


def summary(documents: Sequence[dict[str, Any]]) -> str:
    """A line per session: its best row's scores, or why it failed; then what must be known of each."""
    titles = ["session", "variant", "tosses", "unsure", "lost", *(title for _, title in COLUMNS)]
    lines = ["| " + " | ".join(titles) + " |", "|---|---|" + "---:|" * (len(titles) - 2)]
    failed, whose = [], []
    for document in documents:
        rows = [r for r in document.get("rows", []) if r["scope"] == "all"] or document.get("rows", [])
        if not rows:
            failed.append(f"{document['session']}: {document.get('error', 'no result')}")
            continue
        whose += [(str(document["session"]), Notice.from_json(n)) for r in rows for n in r["warnings"]]
        row = next((r for r in rows if r["variant"] == "ours"), rows[-1])
        cells = [str(document["session"]), row["variant"], str(len(row["tosses"]))]
        cells += [str(sum(t[s] for t in row["per_toss"])) for s in ("interpolated", "lost")]
        cells += [_cell({**row, "paper": None}, name) for name, _ in COLUMNS]
        lines.append("| " + " | ".join(cells) + " |")
    said_below = [*failed, *(f"- {line}" for line in said_of(whose, "every session", len(documents)))]
    return "\n".join([*lines, *([""] if said_below else []), *said_below])
