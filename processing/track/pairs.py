"""Pairs of views compared, in parts that threads may compute side by side (`engine/parts.py`), whatever the shading.

Shading stays with the room while the object turns: followed as if it were paint, it holds the rotation back. To first
order an appearance changes with the surface's normal by one vector a channel: light from one side (Basri and Jacobs,
"Lambertian reflectance and linear subspaces", PAMI 2003), a highlight, a coloured neighbour. What these vectors are
between two views is not known: they are unknowns of the pair, and are eliminated. A pair then says nothing of a turn
that shading alone would explain: on plain paint hardly anything, on print as much as before.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.engine.parts import in_parts
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k

PART = 64
"""Pairs in one part of the work."""
SHADING_SIGMA = 0.3
"""Standard deviation of a vector's components before the pair is seen: appearances of two paints differ by so much."""


def compared(
    store: ViewStore, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"], row: Float[Array, "7"], shaded: bool
) -> tuple[Float[Array, "m 6 6"], Float[Array, "m 6"], Float[Array, "m 3"]]:
    """Normal equations and figures of each pair (`kernels.graph_terms`); where `shaded`, whatever the shading between
    the two is."""
    n = len(pairs)
    crossed, among = k.shading_terms(n if shaded else 0)
    out = blocks, gradients, crossed, among, figures = (
        np.zeros((n, 6, 6)), np.zeros((n, 6)), crossed, among, np.zeros((n, 3))
    )  # fmt: skip

    def compare(some: slice) -> None:
        k.graph_terms(
            poses, pairs[some], store.maps, store.samples, store.table, store.rectified.focal, store.rectified.center,
            row, store.config.turn_share, shaded, *(values[some] for values in out),
        )  # fmt: skip

    in_parts(compare, n, PART)
    if shaded:
        blocks, gradients = eliminated(blocks, gradients, crossed, among)
    return blocks, gradients, figures


DIGITS = 9
"""Of relative poses (m, cosines) that are taken for the same: far below what costs notice."""


class KnownFigures:
    """Figures of pairs of views by how the two lie to each other, each computed once: trajectories that are put
    together of the same parts share most of them."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, int, int, bytes], Float[Array, "3"]] = {}

    def of(
        self, store: ViewStore, poses: Float[Array, "n 4 4"], pairs: Int[Array, "m 2"], row: Float[Array, "7"]
    ) -> Float[Array, "m 3"]:
        """As `compared` gives them."""
        scales = row.tobytes()
        relative = np.round(poses[pairs[:, 1]] @ np.linalg.inv(poses[pairs[:, 0]]), DIGITS) + 0.0  # no -0.0
        keys = [(scales, i, k, lie.tobytes()) for (i, k), lie in zip(pairs.tolist(), relative, strict=True)]
        new = [m for m, key in enumerate(keys) if key not in self._known]
        if new:
            figures = compared(store, poses, pairs[new], row, shaded=False)[2]
            self._known |= {keys[m]: figure for m, figure in zip(new, figures, strict=True)}
        return np.array([self._known[key] for key in keys]).reshape(-1, 3)


def eliminated(
    blocks: Float[Array, "m d d"], gradients: Float[Array, "m d"], crossed: Float[Array, "m d s"],
    among: Float[Array, "m t s"],
) -> tuple[Float[Array, "m d d"], Float[Array, "m d"]]:  # fmt: skip
    """Normal equations of pairs of views (`kernels.graph_terms`) whatever the shading between the two is (Schur
    complement)."""
    own = among[:, :-1] + SHADING_SIGMA**-2.0 * np.eye(crossed.shape[2])
    gain = np.linalg.solve(own, crossed.transpose(0, 2, 1))
    return blocks - crossed @ gain, gradients - np.einsum("msk,ms->mk", gain, among[:, -1])
