"""Masses: solid, hollow, and with ballast off the middle."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from acquisition.synthetic.objects.shapes import MassProperties
from recordings.errors import BadInput


def of_solid(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], mass_kg: float) -> MassProperties:
    """Even density inside a closed surface. Raises BadInput where it encloses nothing."""
    import trimesh

    mesh = trimesh.Trimesh(vertices_m, faces, process=False)
    if not mesh.is_watertight or mesh.volume <= 0:
        raise BadInput(f"a surface of {len(faces)} faces that is not closed, or inside out, has no inside to fill")
    return MassProperties(mass_kg, np.array(mesh.center_mass), np.array(mesh.moment_inertia) * mass_kg / mesh.volume)


def of_shell(vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], mass_kg: float) -> MassProperties:
    """A thin even sheet: a triangle's second moments are those of a third of its mass at the middle of each side."""
    a, b, c = (vertices_m[faces[:, k]] for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    points = np.concatenate([(a + b) / 2, (b + c) / 2, (c + a) / 2])
    return of_points(points, np.tile(area / area.sum() * mass_kg / 3, 3))


def of_points(points_m: Float[Array, "n 3"], masses_kg: Float[Array, " n"]) -> MassProperties:
    """Point masses: I = sum m (|r|^2 1 - r r^T) about their centre."""
    total = float(masses_kg.sum())
    center = masses_kg @ points_m / total
    r = points_m - center
    second = np.einsum("n,ni,nj->ij", masses_kg, r, r)
    return MassProperties(total, center, np.trace(second) * np.eye(3) - second)


def together(parts: list[MassProperties]) -> MassProperties:
    """Several bodies as one, by the parallel axis theorem."""
    total = sum(p.mass_kg for p in parts)
    center = sum((p.mass_kg * p.center_m for p in parts), np.zeros(3)) / total
    inertia = np.zeros((3, 3))
    for p in parts:
        r = p.center_m - center
        inertia += p.inertia_kgm2 + p.mass_kg * (r @ r * np.eye(3) - np.outer(r, r))
    return MassProperties(total, center, inertia)


def draw(
    vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"], manner: str, rng: np.random.Generator
) -> MassProperties:
    """Mass by a random density; `manner` is solid, hollow or off-centre (a fifth to a half of the mass in one lump)."""
    import trimesh

    volume = float(trimesh.Trimesh(vertices_m, faces, process=False).volume)
    mass = float(np.clip(volume * np.exp(rng.uniform(np.log(80.0), np.log(1300.0))), 0.006, 2.5))
    if manner == "hollow":
        return of_shell(vertices_m, faces, 0.5 * mass)
    body = of_solid(vertices_m, faces, mass)
    if manner == "solid":
        return body
    share, reach = rng.uniform(0.2, 0.5), 0.2 * float(np.ptp(vertices_m, axis=0).min())
    towards = rng.standard_normal(3)
    lump = body.center_m + 1.2 * reach * towards / np.linalg.norm(towards)
    ball = MassProperties(share * mass, lump, 0.4 * share * mass * (0.5 * reach) ** 2 * np.eye(3))
    return together([of_solid(vertices_m, faces, (1 - share) * mass), ball])
