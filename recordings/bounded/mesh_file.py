"""A triangle mesh of a stranger (.obj, .ply, .stl): its geometry alone, of a size that an object's model has."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from recordings.bounded.limits import MOST_MESH_BYTES
from recordings.errors import BadInput

if TYPE_CHECKING:
    import trimesh

SUFFIXES = (".obj", ".ply", ".stl")


def load_mesh(path: Path) -> trimesh.Trimesh:
    """The mesh in the file's own unit, without textures. Raises BadInput where it cannot be read or is no surface."""
    import trimesh

    if path.suffix.lower() not in SUFFIXES:
        raise BadInput(f"{path}: cannot be read as a mesh ('{path.suffix}'); wanted one of {', '.join(SUFFIXES)}")
    try:
        if path.stat().st_size > MOST_MESH_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes; wanted at most {MOST_MESH_BYTES}")
        mesh = trimesh.load(path, force="mesh", process=False, skip_materials=True)
    except Exception as wrong:  # trimesh's loaders raise what they like
        raise BadInput(f"{path}: cannot be read as a mesh ({str(wrong)[:200]})") from wrong
    faces = getattr(mesh, "faces", None)
    if faces is None or len(faces) == 0:
        raise BadInput(f"{path}: holds no triangles; wanted a mesh")
    return mesh
