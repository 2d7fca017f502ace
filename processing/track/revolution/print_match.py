"""How well what is printed on two views of a round body meets, at each azimuth between them: log likelihood ratios.

At the right azimuth two views' appearance correlates, at others it is independent. Of two standard Gaussian variables
a and b with correlation r the log likelihood ratio of the two is -log(1 - r^2) / 2 + (2 r a b - r^2 (a^2 + b^2)) /
(2 (1 - r^2)): what a label meets that is no label speaks against an azimuth, however much else agrees. How much print
there is (r) the pairs of a toss tell together. Neighbouring cells err together, so that the sum over cells is too sure
by a factor; how often pairs contradict each other tells it (azimuth.py).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.track.revolution.unwrapping import Unwrapped

CORRELATIONS = (0.0, 0.3, 0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 0.98)
"""Of two views at the right azimuth, tried."""
MOST_SIGMA = 3.0
"""Appearance farther from its row's than so many standard deviations counts as so far."""
LEAST_VARIANCE = 1e-8


@dataclass(frozen=True, eq=False)
class PrintMatch:
    """Of each pair of views at each azimuth of 0..c-1 cells between them, as the kernels count it, and each of two
    components of appearance: sums over the cells that both see of a b and of a^2 + b^2, and their number.

    The pairs of v views share these views' pixels, so that each counts for `share` = v / m of a pair that stands
    alone."""

    products: Float[Array, "2 m c"]
    powers: Float[Array, "2 m c"]
    cells: Float[Array, "m c"]
    share: float

    def costs(self, correlations: Float[Array, "2"]) -> Float[Array, "m c"]:
        """What each pair costs (nats, 0 at its best) if every cell told by itself."""
        ratio = np.sum([self._log_ratio(k, r) for k, r in enumerate(correlations)], axis=0)
        return np.asarray((ratio.max(1, keepdims=True) - ratio) * self.share)

    def best_correlations(self, between: Int[Array, " m"] | None = None) -> Float[Array, "2"]:
        """The likeliest correlation of each component at these azimuths (cells), or a cell beside them; without them,
        at each pair's best."""

        def likelihood(k: int, r: float) -> float:
            ratio = self._log_ratio(k, r)
            if between is not None:
                near = (between[:, None] + (-1, 0, 1)) % ratio.shape[1]
                ratio = np.take_along_axis(ratio, near, axis=1)
            return float(ratio.max(1).sum())

        tried = CORRELATIONS[1:] if between is None else CORRELATIONS
        return np.array([tried[int(np.argmax([likelihood(k, r) for r in tried]))] for k in range(2)])

    def _log_ratio(self, component: int, r: float) -> Float[Array, "m c"]:
        """Of correlated to independent samples."""
        half = -0.5 * self.cells * np.log(1 - r * r)
        unlike = 2 * r * self.products[component] - r * r * self.powers[component]
        return np.asarray(half + unlike / (2 * (1 - r * r)))


def print_match(unwrapped: Unwrapped, pairs: Int[Array, "m 2"]) -> PrintMatch:
    """How what is printed on each pair of views meets."""
    there = unwrapped.count > 0
    where = np.fft.rfft(there, axis=2)
    products, powers = np.zeros((2, 2, len(pairs), there.shape[2]))
    for k, marks in enumerate(np.moveaxis(_marks(unwrapped), -1, 0)):
        seen, power = np.fft.rfft(marks, axis=2), np.fft.rfft(marks**2, axis=2)
        for m, (i, j) in enumerate(pairs):
            products[k, m] = _shifted(seen[i], seen[j])
            powers[k, m] = _shifted(power[i], where[j]) + _shifted(where[i], power[j])
    cells = np.array([_shifted(where[i], where[j]) for i, j in pairs]).reshape(products.shape[1:])
    return PrintMatch(products, powers, cells, len(there) / max(len(pairs), 1))


def _marks(unwrapped: Unwrapped) -> Float[Array, "v r c 2"]:
    """Appearance less its row's median over all views, which no azimuth changes: its two principal components, in
    standard deviations; 0 where nothing is seen."""
    there = unwrapped.count > 0
    out = unwrapped.appearance.copy()
    for row in np.flatnonzero(there.any((0, 2))):
        out[:, row] -= np.median(out[:, row][there[:, row]], axis=0)
    variance, components = np.linalg.eigh(out[there].T @ out[there] / max(int(there.sum()), 1))
    out = out @ components / np.sqrt(variance + LEAST_VARIANCE)
    return np.asarray(np.where(there[..., None], np.clip(out, -MOST_SIGMA, MOST_SIGMA), 0.0))


def _shifted(one: Array, two: Array) -> Float[Array, " c"]:
    """Sum over rows and cells a of one[a] two[a - q], by q, from their spectra."""
    product = np.einsum("rf,rf->f", one, two.conj())
    return np.asarray(np.fft.irfft(product, 2 * (len(product) - 1)))
