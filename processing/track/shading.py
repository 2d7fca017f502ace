"""Shading stays with the room while the object turns: followed as if it were paint, it holds the rotation back.

To first order an appearance changes with the surface's normal by one vector a channel: light from one side (Basri and
Jacobs, "Lambertian reflectance and linear subspaces", PAMI 2003), a highlight, a coloured neighbour. What these vectors
are between two views is not known: they are unknowns of the pair, and are eliminated. A pair then says nothing of a
turn that shading alone would explain: on plain paint hardly anything, on print as much as before.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

SIGMA = 0.3
"""Standard deviation of a vector's components before the pair is seen: appearances of two paints differ by so much."""


def eliminated(
    blocks: Float[Array, "m 6 6"], gradients: Float[Array, "m 6"], crossed: Float[Array, "m 6 s"],
    among: Float[Array, "m t s"],
) -> tuple[Float[Array, "m 6 6"], Float[Array, "m 6"]]:  # fmt: skip
    """Normal equations of pairs of views (`kernels.graph_terms`) whatever the shading between the two is (Schur
    complement)."""
    own = among[:, :-1] + SIGMA**-2.0 * np.eye(crossed.shape[2])
    gain = np.linalg.solve(own, crossed.transpose(0, 2, 1))
    return blocks - crossed @ gain, gradients - np.einsum("msk,ms->mk", gain, among[:, -1])
