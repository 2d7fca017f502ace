"""Depth that errs, as unknowns of the joint refinement: a smooth field of relative errors over each view.

Where neighbouring pixels of a depth image err together, a view's surface is not the object's: it is rounded at edges,
tilted, bent. Pairs of views that take it for the surface trade these errors for turns, a few tenths of a degree a
frame, and never lose them again (errors in variables; Fuller, "Measurement Error Models", 1987). Here each view's depth
has errors of its own: values at the nodes of a grid, as fine as neighbouring pixels err alike, and as large as the
session's noise is (`sensor/noise.py`). Appearance, outlines and the other views' depth tell them; the poses that come
out, and what is known of them, are those whatever the errors are (Schur complement).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy.linalg import cholesky, solve_triangular

from processing.sensor import view_layout as lay
from processing.sensor.noise import DepthNoise
from processing.sensor.view_store import ViewStore
from processing.track.depth_error import kernels
from processing.track.pairs import SHADING_SIGMA

LEAST_SIDE, MOST_SIDE = 3, 6
"""Nodes along a side of a grid: of five tosses of `choose`, eight instead of five a side gain .1 degree in the mean."""
MOST_NODES = 2400
"""Of all views together: more would take longer to solve for than all else."""
LEAST_PX = 4.0
LEAST_SIGMA = 1e-6
"""Of depth that a renderer made, which errs by nothing (m at 1 m)."""
OFFSET_SHARE = 0.01
"""Standard deviation of a view's mean error, as a share of one node's: what all of a view's depth errs by alike is left
to its pose, which it would shift along the ray."""
MOST_STEP, MOST_ERROR = 0.01, 0.06
"""Errors change by no more than this in a step, and grow no larger (relative)."""


class DepthErrors:
    """The errors of some views' depth, beside their poses. What pairs say and what the noise says of the errors are
    divided by `shared`, as all that images say is; pairs that cost more than `sure_cost` count less."""

    def __init__(
        self, store: ViewStore, views: Bool[Array, " v"], noise: DepthNoise, shared: float, sure_cost: float
    ) -> None:
        self._store, self._shared, self._sure_cost = store, shared, sure_cost
        index = np.flatnonzero(views)
        self._grid = np.full(len(views), -1)
        self._grid[index] = np.arange(len(index))
        spans, depth_m = _spans(store, index)
        size = float(np.median(spans[:, 2:])) if len(index) else LEAST_PX
        wanted = int(np.ceil(size / np.sqrt(noise.patch_px))) + 1
        most = min(MOST_SIDE, int(np.sqrt(MOST_NODES / max(len(index), 1))))
        self._side = int(np.clip(wanted, LEAST_SIDE, max(most, LEAST_SIDE)))
        spans[:, 2:] = np.maximum(spans[:, 2:], LEAST_PX) / (self._side - 1)
        self._boxes = spans
        sigma = max(noise.sigma_at_1m, LEAST_SIGMA) * depth_m  # that of depth grows with the square of the distance
        nodes = self._side**2
        mean = _means(store, index, self._boxes, self._side)
        alike = mean[:, :, None] * mean[:, None] / OFFSET_SHARE**2
        self._prior = (np.eye(nodes) + alike) / sigma[:, None, None] ** 2
        self.relative = np.zeros((len(index), nodes))
        """Of depth, at each node."""

    def add(
        self,
        H: Float[Array, "f f 6 6"],
        g: Float[Array, "f 6"],
        poses: Float[Array, "n 4 4"],
        pairs: Int[Array, "m 2"],
        place: Int[Array, " n"],
        row: Float[Array, "7"],
    ) -> Float[Array, "m 3"]:
        """Adds pairs of views to the normal equations of the twists of the object frame per unknown (`place`; -1:
        fixed), whatever the errors are. Returns the pairs' figures at the corrected depth."""
        store, count, nodes = self._store, len(g), self.relative.size
        whole, right = np.zeros((6 * count + nodes,) * 2), np.zeros(6 * count + nodes)
        figures = np.zeros((len(pairs), 3))
        kernels.add_pairs(
            poses, pairs, self._sure_cost, np.where(place >= 0, 6 * place, -1), self._grid, self._side, self._boxes,
            self.relative, SHADING_SIGMA, store.maps, store.samples, store.table, store.rectified.focal,
            store.rectified.center, row, whole, right, figures,
        )  # fmt: skip
        among = whole[6 * count :, 6 * count :]
        for grid, prior in enumerate(self._prior):
            own = slice(grid * len(prior), (grid + 1) * len(prior))
            among[own, own] += prior
        right[6 * count :] += np.einsum("cij,cj->ci", self._prior, self.relative).ravel()
        crossed = whole[6 * count :, : 6 * count]
        sides = np.concatenate([crossed, right[6 * count :, None]], 1)
        # the errors are eliminated by half a solution each side: C' A^-1 C = (L^-1 C)' (L^-1 C), where A = L L'
        self._root = cholesky(among, lower=True, overwrite_a=True)
        self._half = solve_triangular(self._root, sides, lower=True)
        known = self._half[:, :-1].T @ self._half
        poses_only = whole[: 6 * count, : 6 * count] - known[:, :-1]
        H += poses_only.reshape(count, 6, count, 6).transpose(0, 2, 1, 3) / self._shared
        g += (right[: 6 * count] - known[:, -1]).reshape(count, 6) / self._shared
        return figures

    def follow(self, twists: Float[Array, "f 6"]) -> None:
        """The errors that go with a step of the poses since the last `add`."""
        left = self._half[:, -1] + self._half[:, :-1] @ twists.ravel()
        step = -solve_triangular(self._root, left, lower=True, trans="T")
        moved = self.relative + np.clip(step, -MOST_STEP, MOST_STEP).reshape(self.relative.shape)
        self.relative = np.clip(moved, -MOST_ERROR, MOST_ERROR)


def _spans(store: ViewStore, index: Int[Array, " c"]) -> tuple[Float[Array, "c 4"], Float[Array, " c"]]:
    """Where each view's samples lie in the image (first u, v, width, height in pixels), and their median depth (m)."""
    (fx, fy), (cx, cy) = store.rectified.focal, store.rectified.center
    spans, depth_m = np.zeros((len(index), 4)), np.ones(len(index))
    for row, i in enumerate(index):
        first, count = store.table[i, lay.FIRST], store.table[i, lay.COUNT]
        if not count:
            continue
        x, y, z = store.samples[first : first + count, : lay.PZ + 1].astype(np.float64).T
        u, v = fx * x / z + cx, fy * y / z + cy
        spans[row] = u.min(), v.min(), np.ptp(u), np.ptp(v)
        depth_m[row] = np.median(z)
    return spans, depth_m


def _means(store: ViewStore, index: Int[Array, " c"], boxes: Float[Array, "c 4"], side: int) -> Float[Array, "c k"]:
    """What each node of a view's grid adds to the mean error of its samples."""
    out = np.zeros((len(index), side * side))
    focal, center = store.rectified.focal, store.rectified.center
    for row, i in enumerate(index):
        first, count = store.table[i, lay.FIRST], store.table[i, lay.COUNT]
        kernels.add_shares(store.samples[first : first + count], focal, center, boxes[row], side, out[row])
    return out
