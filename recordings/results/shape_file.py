"""An ObjectShape as a binary PLY that every mesh viewer opens, with a JSON beside it for what PLY cannot say."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recordings.errors import BadInput
from recordings.results.stage_files import stage_document, stage_file
from recordings.tracks import ObjectShape
from recordings.whole_file import write_bytes, write_json

VERTEX = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3), ("observed", "u1")])
FACE = np.dtype([("n", "u1"), ("abc", "<i4", 3)])
HEADER = (
    "ply\nformat binary_little_endian 1.0\ncomment tosslab, metres, object frame\n"
    "element vertex {v}\nproperty double x\nproperty double y\nproperty double z\n"
    "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar observed\n"
    "element face {f}\nproperty list uchar int vertex_indices\nend_header\n"
)
NO_COLOUR = 200  # grey, where the shape has no colour


def write_shape(folder: Path, shape: ObjectShape, name: str = "shape") -> Path:
    """Write `<name>.ply` and `<name>.json` into a folder. The same shape gives the same bytes."""
    vertices = np.zeros(len(shape.vertices_m), dtype=VERTEX)
    vertices["xyz"] = shape.vertices_m
    vertices["rgb"] = NO_COLOUR if shape.vertex_rgb is None else shape.vertex_rgb
    vertices["observed"] = 1 if shape.observed is None else shape.observed
    faces = np.zeros(len(shape.faces), dtype=FACE)
    faces["n"], faces["abc"] = 3, shape.faces
    header = HEADER.format(v=len(vertices), f=len(faces)).encode()
    path = folder / f"{name}.ply"
    write_bytes(path, header + vertices.tobytes() + faces.tobytes())
    about = {
        "object_frame": shape.object_frame,
        "source": shape.source,
        "has_colour": shape.vertex_rgb is not None,
        "has_observed": shape.observed is not None,
    }
    write_json(folder / f"{name}.json", about)
    return path


def read_shape(folder: Path, name: str = "shape") -> ObjectShape:
    """Read a shape that `write_shape` wrote. Raises BadInput where there is none, DamagedFile where it is broken."""
    path = folder / f"{name}.ply"
    try:
        data = path.read_bytes()
    except OSError as refused:
        raise BadInput(f"{folder} holds no {name}.ply ({refused.strerror}); run toss-process again") from refused
    about = stage_document(folder / f"{name}.json")
    with stage_file(path):
        end = data.index(b"end_header\n") + len(b"end_header\n")
        counts = [int(line.split()[2]) for line in data[:end].decode().splitlines() if line.startswith("element")]
        vertices = np.frombuffer(data, VERTEX, counts[0], end)
        faces = np.frombuffer(data, FACE, counts[1], end + vertices.nbytes)
        object_frame, source = str(about["object_frame"]), str(about["source"])
    return ObjectShape(
        object_frame=object_frame,
        source=source,
        vertices_m=vertices["xyz"].copy(),
        faces=faces["abc"].astype(np.int64),
        vertex_rgb=vertices["rgb"].copy() if about.get("has_colour") else None,
        observed=vertices["observed"].astype(bool) if about.get("has_observed") else None,
    )


def obj_text(shape: ObjectShape) -> str:
    """The shape as Wavefront OBJ, metres, with vertex colours after the position where it has them."""
    colour = "" if shape.vertex_rgb is None else " %.4f %.4f %.4f"
    rows = shape.vertices_m if shape.vertex_rgb is None else np.hstack([shape.vertices_m, shape.vertex_rgb / 255.0])
    vertices = "\n".join(("v %.9g %.9g %.9g" + colour) % tuple(row) for row in rows)
    return vertices + "\n" + "".join(f"f {a} {b} {c}\n" for a, b, c in shape.faces + 1)
