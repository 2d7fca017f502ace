"""Reads the triangles and plain colours of a Collada (.dae) file, as robot models ship them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from recordings.bounded.limits import MOST_VERTICES
from recordings.bounded.xml_file import read_xml
from recordings.errors import BadInput

GREY = (0.5, 0.5, 0.5)


@dataclass(frozen=True, eq=False)
class ColoredMesh:
    """Triangles in metres, z up. `face_rgb`: diffuse colour of each face as the file has it (sRGB, 0..1)."""

    vertices_m: Float[Array, "v 3"]
    faces: Int[Array, "f 3"]
    face_rgb: Float[Array, "f 3"]


def read_collada(path: Path) -> ColoredMesh:
    """All geometries of the scene, placed by their nodes' matrices. Raises BadInput for what it does not know."""
    root = read_xml(path, "Collada")
    try:
        return _mesh(root, path)
    except (LookupError, ValueError, RuntimeError) as wrong:
        raise BadInput(f"{path}: cannot be read as Collada ({type(wrong).__name__}: {wrong})") from wrong


def _mesh(root: ET.Element, path: Path) -> ColoredMesh:
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    up = root.findtext("asset/up_axis", "Y_UP")
    if up != "Z_UP":
        raise BadInput(f"{path}: {up} is not supported; wanted Z_UP")
    unit = root.find("asset/unit")
    scale = float(unit.attrib.get("meter", "1")) if unit is not None else 1.0
    parts = list(_placed_parts(root, path))
    if not parts:
        raise BadInput(f"{path}: holds no triangles")
    offsets = np.cumsum([0] + [len(v) for v, _, _ in parts[:-1]])
    return ColoredMesh(
        scale * np.vstack([v for v, _, _ in parts]),
        np.vstack([f + o for (_, f, _), o in zip(parts, offsets)]),
        np.vstack([np.tile(rgb, (len(f), 1)) for _, f, rgb in parts]),
    )


def _placed_parts(root: ET.Element, path: Path) -> Iterator[tuple[Array, Array, Array]]:
    geometries = {g.attrib["id"]: list(_groups(g, path)) for g in root.iter("geometry")}
    color = _colors(root)
    count = 0
    for node in root.iter("node"):
        text = node.findtext("matrix")
        matrix = np.array([float(v) for v in text.split()]).reshape(4, 4) if text else np.eye(4)
        for instance in node.findall("instance_geometry"):
            colors = {
                bound.attrib["symbol"]: color.get(bound.attrib["target"].lstrip("#"), GREY)
                for bound in instance.iter("instance_material")
            }
            for vertices, faces, symbol in geometries[instance.attrib["url"].lstrip("#")]:
                count += len(vertices) + len(faces)
                if count > MOST_VERTICES:
                    raise BadInput(f"{path}: more than {MOST_VERTICES} vertices and faces, its instances written out")
                placed = vertices @ matrix[:3, :3].T + matrix[:3, 3]
                yield placed, faces, np.array(colors.get(symbol, GREY))


def _groups(geometry: ET.Element, path: Path) -> Iterator[tuple[Array, Array, str]]:
    sources = {s.attrib["id"]: s for s in geometry.iter("source")}
    positions = {
        v.attrib["id"]: i.attrib["source"].lstrip("#")
        for v in geometry.iter("vertices")
        for i in v.findall("input")
        if i.attrib["semantic"] == "POSITION"
    }
    for group in [*geometry.iter("triangles"), *geometry.iter("polylist")]:
        inputs = group.findall("input")
        stride = 1 + max(int(i.attrib["offset"]) for i in inputs)
        vertex = next(i for i in inputs if i.attrib["semantic"] == "VERTEX")
        indices = np.array([int(v) for v in (group.findtext("p") or "").split()]).reshape(-1, stride)
        corners = indices[:, int(vertex.attrib["offset"])]
        if group.tag == "polylist" and set((group.findtext("vcount") or "").split()) - {"3"}:
            raise BadInput(f"{path}: has polygons; wanted triangles only")
        array = sources[positions[vertex.attrib["source"].lstrip("#")]].findtext("float_array") or ""
        points = np.array([float(v) for v in array.split()]).reshape(-1, 3)
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(points):
            raise BadInput(f"{path}: a triangle names a vertex that is not there")
        yield points, corners.reshape(-1, 3), group.attrib.get("material", "")


def _colors(root: ET.Element) -> dict[str, tuple[float, ...]]:
    """Diffuse colours by material, where the file says one."""
    effects = {e.attrib["id"]: e.findtext(".//diffuse/color") for e in root.iter("effect")}
    found = {}
    for one in root.iter("material"):
        instance = one.find("instance_effect")
        text = None if instance is None else effects[instance.attrib["url"].lstrip("#")]
        if text:
            found[one.attrib["id"]] = tuple(float(v) for v in text.split()[:3])
    return found
