"""report.html: one self-contained page with the table, the shapes, the errors, the rollouts and every toss."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array

from processing.metrics import distance_to_surface_m
from processing.report_curves import error_curves, rollout_curves
from processing.report_shapes import ERROR_FULL_MM, Shown, shape_picture, true_shape
from processing.table import COLUMNS, Row, said
from recordings.geometry import CameraModel
from recordings.results import Results
from recordings.session import Session
from recordings.session_writer import write_bytes
from recordings.tracks import ObjectShape

if TYPE_CHECKING:
    import trimesh

PICTURES = 6
TILE_PX = 360
OUTLINE_RGB = (255, 40, 40)
STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #ccc;padding:.25em .6em;text-align:right}
td:first-child,th:first-child{text-align:left}th{background:#f3f3f3}.warn{background:#fff4d6;padding:.6em 1em}
.paper{color:#888}figure{margin:1em 0}img{max-width:100%}.bar{display:inline-block;height:.8em}"""


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
        _warnings([*said(document["rows"], "warnings"), *_lost(document)]),
        _recorded(document, session),
        "<h2>Scores</h2>",
        _score_table(document),
        _shapes(results, rows, truth),
        _curves(rows, main),
        _rollouts(results, main),
        _phases_table(main),
        *(_figure(results, row, session) for row in rows if row is main),
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
    return f"<h2>The shape</h2>{_picture(_png(shape_picture(shown)), caption)}"


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
    document = json.loads((results.path / stage / "rollout.json").read_text())
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
    head = "".join(f"<th>{n}</th>" for n in ("phase", "frames", *titles.values()))
    body = "".join(
        f"<tr><td>{phase}</td><td>{values[names[0]].n}</td>"
        + "".join(f"<td>{values[n].value:.2f}</td>" for n in names)
        + "</tr>"
        for phase, values in main.score.phases.items()
    )
    return f"<h3>{escape(main.record.label)}, phase by phase</h3><table><tr>{head}</tr>{body}</table>"


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
    head = "".join(f"<th>{escape(title)}</th>" for _, title in COLUMNS)
    body = ""
    for row in document["rows"]:
        cells = "".join(f"<td>{_cell(row, name)}</td>" for name, _ in COLUMNS)
        body += f"<tr><td>{escape(row['variant'])} ({row['scope']})</td>{cells}</tr>"
    return (
        f"<table><tr><th>variant</th>{head}</tr>{body}</table><p>ADD, ADD-S: area under the recall curve, 0 to 0.1 m. "
        "SR: share of frames within 5 degrees and 5 cm. CD: Chamfer distance of the shape. Each toss is aligned at its "
        "first frame. <span class=paper>Grey: the paper's figure for this row, on another data set.</span></p>"
    )


def _cell(row: dict[str, Any], name: str) -> str:
    value, paper = row["values"].get(name), (row["paper"] or {}).get(name)
    number = None if value is None else value["value"]
    text = "–" if number is None else f"{number:.3f}" if value["unit"] == "cm" else f"{number:.2f}"
    return text + ("" if paper is None else f" <span class=paper>{paper:g}</span>")


def _toss_table(row: dict[str, Any]) -> str:
    names = [n for n in ("adds_auc", "add_auc", "success_5deg_5cm") if any(n in t for t in row["per_toss"])]
    titles = {"adds_auc": "ADD-S %", "add_auc": "ADD %", "success_5deg_5cm": "SR %"}
    head = "".join(f"<th>{titles.get(n, n)}</th>" for n in ("toss", "tracked", "interpolated", "lost", *names))
    body = "".join(
        f"<tr><td>{t['toss']}</td>"
        + "".join(f"<td>{t[s]}</td>" for s in ("tracked", "interpolated", "lost"))
        + "".join("<td>–</td>" if t.get(n) is None else f"<td>{t[n]:.1f}</td>" for n in names)
        + "</tr>"
        for t in row["per_toss"]
    )
    return f"<h3>{escape(row['label'])} ({row['scope']})</h3><table><tr>{head}</tr>{body}</table>"


def _figure(results: Results, row: Row, session: Session) -> str:
    picture = outline_picture(results, row, session)
    data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1].tobytes()
    caption = "The estimated shape's outline at its estimated pose, over the images. Frames that are lost show none."
    name = f"{row.record.label} (scope {row.record.scope})"
    return f"<h2>{escape(name)}</h2>{_picture(data, caption, 'jpeg')}"


def outline_picture(results: Results, row: Row, session: Session) -> UInt8[Array, "h w 3"]:
    """Cut-outs of up to PICTURES frames (of three tosses, or of one alone) with the mesh's outline, side by side."""
    tosses = list(row.tracks)
    chosen = [tosses[i] for i in np.unique(np.linspace(0, len(tosses) - 1, min(3, len(tosses))).round().astype(int))]
    tiles = []
    for toss in chosen:
        track, frames = row.tracks[toss], session.toss(toss).rgbd(row.tracks[toss].camera)
        shape = results.shape(row.record.name, row.record.scope, toss)
        camera = row.record.calibration.camera(track.camera)
        for share in np.linspace(0.15, 0.98, PICTURES // len(chosen)):
            position = int(share * (len(frames) - 1))
            image, pose = frames[position].color_rgb.copy(), track.camera_from_object[position]
            seen = silhouette(shape, pose, camera) if np.isfinite(pose).all() else np.zeros(image.shape[:2], dtype=bool)
            tiles.append(_tile(image, seen, f"toss {toss}, frame {position}"))
    columns = min(3, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def _tile(image_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"], title: str) -> UInt8[Array, "th tw 3"]:
    """The part of the image around the mask (all of it for an empty one), with the outline and a title."""
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
    draw_outline(tile, seen)
    cv2.putText(tile, title, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (255, 255, 255), 2)
    return tile.astype(np.uint8)


def draw_outline(image_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> None:
    """Draw a mask's outline into an image."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image_rgb, contours, -1, OUTLINE_RGB, 1)


def silhouette(shape: ObjectShape, camera_from_object: Float[Array, "4 4"], camera: CameraModel) -> Bool[Array, "h w"]:
    """Pixels whose ray, through the lens as it is, meets the shape at this pose."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    points = shape.vertices_m @ camera_from_object[:3, :3].T + camera_from_object[:3, 3]
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(points.astype(np.float32)), tensor(shape.faces.astype(np.uint32)))
    directions = np.nan_to_num(camera.pixel_rays(), nan=0.0).astype(np.float32)
    rays = np.concatenate([np.zeros_like(directions), directions], -1)
    return np.isfinite(scene.cast_rays(tensor(rays))["t_hit"].numpy())
