"""report.html: one self-contained page with the table, the shapes, the errors, the rollouts and every toss."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array

from processing.contact.friction.estimate import RESTITUTION_ASSUMED
from processing.evaluate.metrics import distance_to_surface_m
from processing.evaluate.report_curves import error_curves, rollout_curves
from processing.evaluate.report_loops import SLOWED, toss_loops
from processing.evaluate.report_mesh import turning_shapes
from processing.evaluate.report_shapes import ERROR_FULL_MM, Shown, shape_picture, true_shape
from processing.evaluate.report_worst import Worst, worst_frames
from processing.evaluate.table import COLUMNS, CONTACT_COLUMNS, Row, said, with_interval
from recordings.film.film import STATUS_RGB
from recordings.film.raster import covered_pixels, outlined
from recordings.mcap.codec import decode_image
from recordings.results.folder import Results
from recordings.results.stage_files import stage_document
from recordings.session import Session
from recordings.tracks import ObjectShape
from recordings.whole_file import write_bytes

if TYPE_CHECKING:
    import trimesh

TILE_PX = 360
PHYSICS = (CONTACT_COLUMNS[0], ("friction_error", "friction − truth"), *CONTACT_COLUMNS[1:])
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #ccc;padding:.25em .6em;text-align:right}
td:first-child,th:first-child{text-align:left}th{background:#f3f3f3}.warn{background:#fff4d6;padding:.6em 1em}
.paper{color:#888}figure{margin:1em 0}img{max-width:100%}figcaption,.why{font-size:.85em;color:#555}
.grid{display:grid;grid-template-columns:repeat(auto-fill,minmax(15em,1fr));gap:1em;align-items:start}
.grid figure{margin:0}.grid img{width:100%}.why{margin:.2em 0}.shapes{display:flex;flex-wrap:wrap;gap:1em}
.shapes>*{margin:0;flex:1 1 24em}
canvas{width:100%;height:42em;max-height:90vh;border:1px solid #ddd;cursor:grab;touch-action:none}"""


def write_report(
    results: Results,
    document: dict[str, Any],
    rows: Sequence[Row],
    session: Session,
    truth: trimesh.Trimesh | None = None,
) -> None:
    """Write report.html into the results folder; it loads nothing from anywhere. `truth`: the true mesh, shown too."""
    main = _main_row(rows)
    parts = [
        f"<h1>{escape(session.name)}: {escape(session.object_name)}</h1>",
        _warnings([*_lost(document), *said(_main_first(document), "warnings")]),
        _recorded(document, session),
        "<h2>Scores</h2>",
        _score_table(document),
        _physics(document),
        _shapes(results, rows, truth),
        _loops(results, main, session),
        _worst(results, main, session),
        _curves(rows, main),
        _rollouts(results, main),
        _phases_table(main),
        "<h2>Every toss</h2>",
        *(_toss_table(r) for r in document["rows"]),
        _notes(document),
    ]
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{escape(session.name)}</title>"
        f"<style>{STYLE}</style><body>{''.join(parts)}</body></html>"
    )
    write_bytes(results.path / "report.html", page.encode())


def _main_row(rows: Sequence[Row]) -> Row | None:
    """The row that a reader looks at: `ours` over all tosses, else the last one in that scope."""
    wide = [r for r in rows if r.record.scope == "all"] or list(rows)
    return next((r for r in wide if r.record.name == "ours"), wide[-1] if wide else None)


def _main_first(document: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows in the order that a reader cares: `ours` over all tosses, what is over all tosses, the others."""
    return sorted(document["rows"], key=lambda r: (r["scope"] != "all", r["variant"] != "ours"))


def _physics(document: dict[str, Any]) -> str:
    """What was learned of contact, with its 95 % intervals where they are known."""
    titles = [(n, t) for n, t in PHYSICS if any(n in r["values"] for r in document["rows"])]
    rows = [r for r in document["rows"] if any(n in r["values"] for n, _ in titles)]
    if not rows:
        return ""
    cells = ([_row_name(r), *(with_interval(r["values"].get(name)) for name, _ in titles)] for r in rows)
    table = _table(["variant", *(title for _, title in titles)], cells)
    assumed = f" Of restitution's, {RESTITUTION_ASSUMED}." if any(n == "restitution" for n, _ in titles) else ""
    return (
        f"<h2>What was learned of contact</h2>{table}<p>Friction against the table and restitution; rollouts: the mean "
        "error of the learned model, simulated from the release on. In "
        f"brackets: 95 % intervals.{assumed}</p>"
    )


def _shapes(results: Results, rows: Sequence[Row], truth: trimesh.Trimesh | None) -> str:
    """The paper's Figure 1: the shape at each step, beside the true one."""
    shown = []
    for row in (r for r in rows if r.record.scope == "all" and r.record.shape is not None):
        toss, track = next(iter(row.tracks.items()))
        known = np.flatnonzero(np.isfinite(track.camera_from_object[:, 0, 0]))
        if len(known) == 0:
            continue
        shape = results.shape(row.record.name, "all", toss)
        error = None if truth is None else _distance_to(truth, shape, row)
        shown.append(Shown(row.record.name, shape, track.camera_from_object[known[0]], error))
    if not shown:
        return ""
    pose = _true_pose(rows, shown)
    if truth is not None and pose is not None:
        shown.append(Shown("truth", true_shape(truth), pose))
    errors = f" Lower row: distance to the truth, white 0 to red {ERROR_FULL_MM:g} mm." if truth is not None else ""
    caption = (
        "The shape at each step. Upper row: from the camera's side. Below: from the other side; blue was seen by no "
        f"camera.{errors}"
    )
    picture = shape_picture(shown)
    still = f"<div style='flex:0 1 {picture.shape[1]}px'>{_picture(_png(picture), caption)}</div>"
    return f"<h2>The shape</h2><div class=shapes>{turning_shapes(shown)}{still}</div>"


def _true_pose(rows: Sequence[Row], shown: Sequence[Shown]) -> Float[Array, "4 4"] | None:
    """camera_from_true_object of the frame that the shapes are shown at."""
    for row in rows:
        if row.record.name == shown[-1].title and row.score is not None and row.score.tosses:
            first = row.score.tosses[0]
            return None if first.shift is None else shown[-1].camera_from_object @ first.shift
    return None


def _distance_to(truth: trimesh.Trimesh, shape: ObjectShape, row: Row) -> Float[Array, " v"] | None:
    """Distance of each vertex to the true surface, after the alignment that Chamfer is measured in."""
    if row.score is None or row.score.true_from_shape is None:
        return None
    at = row.score.true_from_shape
    return distance_to_surface_m(truth, shape.vertices_m @ at[:3, :3].T + at[:3, 3])


def _curves(rows: Sequence[Row], main: Row | None) -> str:
    """Errors over time of the main row, beside vision alone."""
    wanted = [r for r in rows if r.record.scope == "all" and r.record.name in ("bundlesdf-10", "ours", "joint")]
    wanted = wanted or ([main] if main is not None else [])
    scored = {r.record.name: r.score.tosses for r in wanted if r.score is not None and r.score.tosses}
    if not scored:
        return ""
    caption = (
        "Error of every frame, each toss aligned at its first frame. Ground: blue held, white flight, red impact (two "
        "frames around), green rest. A gap is a lost frame."
    )
    return f"<h2>Errors over time</h2>{_picture(error_curves(scored), caption)}"


def _rollouts(results: Results, main: Row | None) -> str:
    """The paper's Figure 4, where the main row learned contact."""
    stage = None if main is None else main.record.extra.get("rollout")
    if main is None or not stage:
        return ""
    document = stage_document(results.path / stage / "rollout.json")
    compared = {"estimated track": document["against_track"]}
    if main.score is not None and main.score.rollout is not None:
        compared["truth"] = main.score.rollout
    caption = (
        f"The learned model, rolled out from every toss's release in steps of {1e3 * document['dt_s']:.2f} "
        f"ms. Learned on the tosses {document['learned_from']}; dashed: not learned on. Bands: 95 % intervals."
    )
    curves = rollout_curves(compared, document["not_learned_from"])
    return f"<h2>Rollouts of the learned contact model</h2>{_picture(curves, caption)}"


def _phases_table(main: Row | None) -> str:
    if main is None or main.score is None or not main.score.phases:
        return ""
    titles = {"adds_auc": "ADD-S %", "add_auc": "ADD %", "success_5deg_5cm": "SR %", "median_rotation": "median deg",
              "p90_rotation": "90 % deg", "median_translation": "median mm", "p90_translation": "90 % mm"}  # fmt: skip
    names = list(titles)
    cells = (
        [phase, str(values[names[0]].n), *(f"{values[n].value:.2f}" for n in names)]
        for phase, values in main.score.phases.items()
    )
    table = _table(["phase", "frames", *titles.values()], cells)
    return f"<h3>{escape(main.record.label)}, phase by phase</h3>{table}"


def _notes(document: dict[str, Any]) -> str:
    lines = "".join(f"<li>{escape(line)}</li>" for line in said(document["rows"], "notes"))
    return f"<h2>Notes</h2><ul>{lines}</ul>"


def _picture(data: bytes, caption: str, kind: str = "png") -> str:
    coded = base64.b64encode(data).decode()
    return (
        f"<figure><img alt='{escape(caption[:40])}' src='data:image/{kind};base64,{coded}'>"
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _png(image_rgb: UInt8[Array, "h w 3"]) -> bytes:
    return cv2.imencode(".png", image_rgb[..., ::-1])[1].tobytes()


def _lost(document: dict[str, Any]) -> list[str]:
    return [
        f"{r['variant']} ({r['scope']}), toss {t['toss']}: {t['lost']} frames are lost"
        for r in document["rows"]
        for t in r["per_toss"]
        if t["lost"]
    ]


def _warnings(lines: Sequence[str]) -> str:
    return f"<div class=warn>{'<br>'.join(escape(line) for line in lines)}</div>" if lines else ""


def _recorded(document: dict[str, Any], session: Session) -> str:
    """What was recorded, in a sentence."""
    if not document["rows"]:
        return ""
    tosses = document["rows"][0]["per_toss"]
    frames = sum(t["tracked"] + t["interpolated"] + t["lost"] for t in tosses)
    camera = session.calibration.cameras.get("d455")
    size = "" if camera is None else f" of {camera.width}x{camera.height} pixels"
    created = session.start.get("created") or session.start.get("wall_time") or ""
    when = f", recorded {escape(str(created))}" if created else ""
    return (
        f"<p>A robot tossed an object ({escape(session.object_name)}) onto a table: {len(tosses)} tosses, {frames} "
        f"colour and depth frames{size}{when}. From these frames alone come the object's shape, its pose in every "
        "frame and how it slides and bounces; where a ground truth is known, it is used for the scores only.</p>"
    )


def _score_table(document: dict[str, Any]) -> str:
    cells = ([_row_name(row), *(_cell(row, name) for name, _ in COLUMNS)] for row in document["rows"])
    table = _table(["variant", *(escape(title) for _, title in COLUMNS)], cells)
    grey = "Grey: the paper's figure for this row, on another data set."
    legend = f" <span class=paper>{grey}</span>" if any(row["paper"] for row in document["rows"]) else ""
    return (
        f"{table}<p>ADD, ADD-S: area under the recall curve, 0 to 0.1 m. "
        "SR: share of frames within 5 degrees and 5 cm. CD: Chamfer distance of the shape. Each toss is aligned at its "
        f"first frame.{legend}</p>"
    )


def _cell(row: dict[str, Any], name: str) -> str:
    value, paper = row["values"].get(name), (row["paper"] or {}).get(name)
    number = None if value is None else value["value"]
    text = "–" if number is None else f"{number:.3f}" if value["unit"] == "cm" else f"{number:.2f}"
    return text + ("" if paper is None else f" <span class=paper>{paper:g}</span>")


def _toss_table(row: dict[str, Any]) -> str:
    names = [n for n in ("adds_auc", "add_auc", "success_5deg_5cm") if any(n in t for t in row["per_toss"])]
    titles = {"adds_auc": "ADD-S %", "add_auc": "ADD %", "success_5deg_5cm": "SR %"}
    counts = ("toss", "tracked", "interpolated", "lost")
    cells = (
        [*(str(t[s]) for s in counts), *("–" if t.get(n) is None else f"{t[n]:.1f}" for n in names)]
        for t in row["per_toss"]
    )
    table = _table([*counts, *(titles.get(n, n) for n in names)], cells)
    return f"<h3>{escape(row['label'])} ({row['scope']})</h3>{table}"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts that are HTML already."""
    top = "".join(f"<th>{text}</th>" for text in head)
    body = "".join(f"<tr>{''.join(f'<td>{text}</td>' for text in row)}</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def _row_name(row: dict[str, Any]) -> str:
    return f"{escape(row['variant'])} ({row['scope']})"


def _loops(results: Results, row: Row | None, session: Session) -> str:
    """The flight of every toss, moving."""
    if row is None:
        return ""
    figures = "".join(
        f"<figure><img alt='toss {loop.toss}' src='data:image/webp;base64,{base64.b64encode(loop.webp).decode()}'>"
        f"<figcaption>toss {loop.toss}, {SLOWED} times slower</figcaption></figure>"
        for loop in toss_loops(results, row, session)
    )
    if not figures:
        return ""
    legend = ", ".join(f"<b style='color:rgb{STATUS_RGB[s]}'>{s}</b>" for s in STATUS_RGB)
    text = f"The outline of the estimated shape at its estimated pose, by status: {legend} (no outline, red edge)."
    return f"<h2>Every toss, as seen</h2><p>{escape(row.record.label)}. {text}</p><div class=grid>{figures}</div>"


def _worst(results: Results, row: Row | None, session: Session) -> str:
    """The worst frames with what is unusual in them."""
    found = [] if row is None else worst_frames(results, row)
    if row is None or not found:
        return ""
    figures = "".join(
        f"<div>{_picture(_jpeg(worst_tile(results, row, session, w)), _title(w), 'jpeg')}"
        f"<p class=why>{escape('; '.join(w.reasons))}</p></div>"
        for w in found
    )
    return f"<h2>The worst frames, and why</h2><div class=grid>{figures}</div>"


def _title(worst: Worst) -> str:
    return f"toss {worst.toss}, frame {worst.position}: {worst.what}"


def worst_tile(results: Results, row: Row, session: Session, worst: Worst) -> UInt8[Array, "h w 3"]:
    """The cut-out of a frame with the outline in its status's colour; all of the image where it is lost."""
    track = row.tracks[worst.toss]
    image = decode_image(session.toss(worst.toss).color(track.camera)[worst.position])
    pose, mask = track.pose(worst.position), np.zeros(image.shape[:2], dtype=bool)
    if pose is not None:
        shape = results.shape(row.record.name, row.record.scope, worst.toss)
        mask = covered_pixels(shape, pose, row.record.calibration.camera(track.camera))
    return _tile(image, mask, STATUS_RGB[track.status[worst.position]])


def _tile(
    image_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"], color: tuple[int, int, int]
) -> UInt8[Array, "th tw 3"]:
    """The part of the image around the mask (the middle square for an empty one), with the outline."""
    height, width = mask.shape
    rows, columns = np.nonzero(mask)
    half = height // 2
    center = (height // 2, width // 2)
    if len(rows):
        half = int(np.clip(1.3 * max(np.ptp(rows), np.ptp(columns)) / 2 + 8, 20, height // 2))
        center = (int(np.ptp(rows) / 2 + rows.min()), int(np.ptp(columns) / 2 + columns.min()))
    top = int(np.clip(center[0] - half, 0, height - 2 * half))
    left = int(np.clip(center[1] - half, 0, max(0, width - 2 * half)))
    cut = (slice(top, top + 2 * half), slice(left, left + 2 * half))
    tile = cv2.resize(image_rgb[cut], (TILE_PX, TILE_PX), interpolation=cv2.INTER_LINEAR)
    seen = cv2.resize(mask[cut].astype(np.uint8), (TILE_PX, TILE_PX), interpolation=cv2.INTER_NEAREST) > 0
    return outlined(tile.astype(np.uint8), seen, color, 2)


def _jpeg(image_rgb: UInt8[Array, "h w 3"]) -> bytes:
    return cv2.imencode(".jpg", image_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
