"""Mass, centre of mass and inertia: known or of uniform density."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.tracks import ObjectShape


@dataclass(frozen=True, eq=False)
class Physics:
    """Mass, centre of mass (object frame) and inertia about it (object axes), and where they come from."""

    mass_kg: float
    center_of_mass_m: Float[Array, "3"]
    inertia_kgm2: Float[Array, "3 3"]
    source: str


def known_physics(
    mass_kg: float,
    inertia_kgm2: Float[Array, "3 3"],
    center_of_mass_m: Float[Array, "3"] | None = None,
    source: str = "session.json: object.physics",
) -> Physics:
    """Physics as given. Raises BadInput for a mass or an inertia that no body has."""
    inertia = np.asarray(inertia_kgm2, dtype=np.float64)
    center = np.zeros(3) if center_of_mass_m is None else np.asarray(center_of_mass_m, dtype=np.float64)
    if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T) or not np.isfinite(inertia).all():
        raise BadInput(f"{source}: the inertia is not a symmetric 3x3 matrix: {inertia.tolist()}")
    moments = np.linalg.eigvalsh(inertia)
    if not mass_kg > 0 or moments[0] <= 0 or moments[0] + moments[1] < moments[2] * (1 - 1e-9):
        raise BadInput(
            f"{source}: mass {mass_kg} kg, principal moments {moments.tolist()} kg m^2: no body has them; wanted a "
            "positive mass, positive moments, and no moment larger than the sum of the other two"
        )
    return Physics(float(mass_kg), center, inertia, source)


def physics_of_session(document: Any) -> Physics | None:
    """`object.physics` of session.json's start document, or None where it is not given."""
    about = document.get("object") if isinstance(document, dict) or hasattr(document, "get") else None
    given = about.get("physics") if isinstance(about, dict) else None
    if not given or "mass_kg" not in given or "inertia_kgm2" not in given:
        return None
    center = given.get("center_of_mass_m")
    return known_physics(
        float(given["mass_kg"]),
        np.array(given["inertia_kgm2"], dtype=np.float64),
        None if center is None else np.array(center, dtype=np.float64),
    )


def uniform_physics(shape: ObjectShape, mass_kg: float = 1.0) -> Physics:
    """A mass spread evenly over a closed mesh (its convex hull where it is not closed)."""
    import trimesh

    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces, process=True)
    what = "the prior shape"
    if not mesh.is_watertight or mesh.volume <= 0:
        mesh, what = mesh.convex_hull, "the convex hull of the prior shape (its mesh is not closed)"
    center = np.array(mesh.center_mass)
    inertia = np.array(mesh.moment_inertia) * (mass_kg / mesh.volume)
    return Physics(mass_kg, center, inertia, f"unit mass, uniform density over {what}")


def uniform_box_physics(edges_m: Float[Array, "3"], mass_kg: float = 1.0) -> Physics:
    """A mass spread evenly over a box about the origin."""
    square = np.asarray(edges_m, dtype=np.float64) ** 2
    inertia = np.diag(mass_kg / 12 * (square.sum() - square))
    return Physics(mass_kg, np.zeros(3), inertia, "unit mass, uniform density over the starting box")
