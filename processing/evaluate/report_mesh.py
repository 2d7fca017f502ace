"""The shapes of the report as something to turn with the mouse: thinned meshes and a script, both inside the page."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.evaluate.report_shapes import UNSEEN_RGB, Shown, colors_of, error_colors, form_colors
from recordings.tracks import ObjectShape

MOST_FACES = 20_000
"""Of one shape in the page: 250 kB of text. A vertex number must fit into 16 bits."""
PAINTS = {"seen": "as seen", "form": "form alone", "error": "distance to the truth"}
SCRIPT = Path(__file__).with_name("report_mesh.js")


def turning_shapes(shown: Sequence[Shown]) -> str:
    """HTML: a canvas, what to choose from, the data and the script. Nothing is loaded from anywhere."""
    size_m = max(float(np.linalg.norm(np.ptp(s.shape.vertices_m, axis=0))) for s in shown)
    data = json.dumps([_document(s, size_m) for s in shown])
    named = "".join(f"<option value={i}>{escape(s.title)}</option>" for i, s in enumerate(shown))
    paints = [p for p in PAINTS if p != "error" or any(s.error_m is not None for s in shown)]
    painted = "".join(f"<option value={p}>{PAINTS[p]}</option>" for p in paints)
    return (
        "<figure class=turning><canvas id=turn></canvas><figcaption>"
        f"<select id=which>{named}</select> <select id=paint>{painted}</select> Drag to turn it, then the wheel makes "
        "it larger. Blue: seen by no camera.</figcaption></figure>"
        f"<script type=application/json id=shapes>{data}</script><script>{SCRIPT.read_text()}</script>"
    )


def thinned(s: Shown, most_faces: int = MOST_FACES) -> Shown:
    """The same with at most so many faces; what is known of a vertex goes to the nearest that is left."""
    import open3d as o3d
    from scipy.spatial import cKDTree

    shape = s.shape
    if len(shape.faces) <= most_faces:
        return s
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(shape.vertices_m), o3d.utility.Vector3iVector(shape.faces.astype(np.int32))
    )
    fewer = mesh.simplify_quadric_decimation(most_faces)
    vertices, faces = np.asarray(fewer.vertices), np.asarray(fewer.triangles).astype(np.int64)
    nearest = cKDTree(shape.vertices_m).query(vertices)[1]
    rgb = None if shape.vertex_rgb is None else shape.vertex_rgb[nearest]
    observed = None if shape.observed is None else shape.observed[nearest]
    error = None if s.error_m is None else s.error_m[nearest]
    return Shown(
        s.title,
        ObjectShape(shape.object_frame, shape.source, vertices, faces, rgb, observed),
        s.camera_from_object,
        error,
    )


def _document(s: Shown, size_m: float) -> dict[str, Any]:
    """One shape as it stands in the page: 16-bit places in a box of two (y up, z to the viewer), faces, colours."""
    small = thinned(s)
    points = small.shape.vertices_m @ small.camera_from_object[:3, :3].T
    points = (points - 0.5 * (points.min(0) + points.max(0))) * [1, -1, -1]
    colors = {"seen": _marked(small), "form": form_colors(small.shape)}
    if small.error_m is not None:
        colors["error"] = error_colors(small)
    return {
        "vertices": _text(np.round(points / (0.55 * size_m) * 32767).astype("<i2")),
        "faces": _text(small.shape.faces.astype("<u2")),
        "colors": {name: _text(np.clip(rgb, 0, 255).astype(np.uint8)) for name, rgb in colors.items()},
    }


def _marked(s: Shown) -> Float[Array, "v 3"]:
    """The vertices' own colours; where no camera saw the surface they are a guess, and blue."""
    rgb = colors_of(s.shape)
    return rgb if s.shape.observed is None else np.where(s.shape.observed[:, None], rgb, UNSEEN_RGB)


def _text(values: Array) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
