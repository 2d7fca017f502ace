"""Meshes with a texture from a folder of the user's (`--objects DIR`): .obj or .ply/.glb with a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.objects.paint import Gloss, PaintedMesh
from acquisition.synthetic.objects.solids import corner_normals
from recordings.errors import BadInput

SUFFIXES = (".obj", ".ply", ".glb")
EXTENT_M = (0.02, 0.6)
"""Longest side of what may be tossed; above a metre a file is most likely in millimetres."""


def textured_mesh(folder: Path, rng: np.random.Generator) -> PaintedMesh:
    """One of the folder's meshes, drawn. Raises BadInput by name where the folder or the mesh does not fit."""
    files = sorted(p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES) if folder.is_dir() else []
    if not files:
        raise BadInput(f"--objects {folder} holds no mesh; wanted .obj (with .mtl and picture), .ply or .glb files")
    return read_textured(files[int(rng.integers(len(files)))])


def read_textured(path: Path) -> PaintedMesh:
    """A closed mesh in metres with its texture, centred at its bounding box. Raises BadInput by name."""
    import trimesh

    try:
        mesh = trimesh.load(path, force="mesh", process=False)
    except (OSError, ValueError, KeyError, NotImplementedError) as wrong:
        raise BadInput(f"{path}: cannot be read as a mesh ({wrong})") from wrong
    picture, uv = _texture(path, mesh)
    size = np.ptp(mesh.vertices, axis=0)
    if not EXTENT_M[0] <= size.max() <= EXTENT_M[1]:
        hint = "; it seems to be in millimetres: scale it by 0.001" if size.max() > 10 else ""
        raise BadInput(f"{path} is {size.max():g} m long; wanted {EXTENT_M[0]} to {EXTENT_M[1]} m, in metres{hint}")
    faces = np.array(mesh.faces)
    closed = trimesh.Trimesh(mesh.vertices, faces, process=False)
    closed.merge_vertices(merge_tex=True, merge_norm=True)
    if not closed.is_watertight or closed.volume <= 0:
        raise BadInput(f"{path} is not closed (or inside out): mass and inertia need an inside; close its holes")
    corner_uv = uv[faces]
    middle = 0.5 * (closed.bounds[0] + closed.bounds[1])
    vertices, faces = np.array(closed.vertices) - middle, np.array(closed.faces)
    height, width = picture.shape[:2]
    pixels = np.stack([corner_uv[..., 0] * width, (1 - corner_uv[..., 1]) * height], -1) - 0.5
    texels = float(np.sqrt(width * height / max(closed.area, 1e-9)))
    normals = corner_normals(vertices, faces).astype(np.float32)
    return PaintedMesh(vertices, faces, pixels.astype(np.float32), normals, picture, texels, Gloss())


def _texture(path: Path, mesh: object) -> tuple[Float[Array, "h w 3"], Float[Array, "v 2"]]:
    """The picture in linear light, and texture coordinates a vertex."""
    visual = getattr(mesh, "visual", None)
    uv, material = getattr(visual, "uv", None), getattr(visual, "material", None)
    picture = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if uv is None or picture is None:
        raise BadInput(f"{path} has no texture; wanted texture coordinates and a picture (an .mtl with map_Kd)")
    rgb = np.asarray(picture.convert("RGB"), np.float32) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32), np.asarray(uv, np.float64)
