"""Pairs of views compared, in parts that threads may compute side by side (`engine/parts.py`)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.engine.parts import in_parts
from processing.sensor.view_store import ViewStore
from processing.track import kernels as k
from processing.track.shading import eliminated

PART = 64
"""Pairs in one part of the work."""


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
