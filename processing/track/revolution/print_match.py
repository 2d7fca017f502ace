"""How well what is printed on two views of a round body meets, at each azimuth between them: log likelihood ratios.

At the right azimuth two views' appearance correlates, at others it is independent. Of n samples of two Gaussian
variables with correlation r the log likelihood ratio of the two is -n/2 log(1 - r^2) (Anderson, An Introduction to
Multivariate Statistical Analysis, 2003, section 4.2). What stays with the room correlates as well, where normals are
equal (in camera axes): a lamp's mirror image, what is left of shading. Either may be what a pair shows, so that an
azimuth is told only as far as print explains the views better than light does.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array

from processing.track.revolution.unwrapping import Unwrapped
from recordings.constants import MAD_TO_SIGMA_SHORT

PIXELS_A_SAMPLE = 4.0
"""Cameras and JPEG keep one colour for 2 x 2 pixels (4:2:0): so many pixels are one independent sample."""
MOST_SIGMA = 3.0
"""Appearance farther from its neighbourhood's than so many (robust) standard deviations counts as so far."""
MOST_CORRELATION = 0.98
LEAST_SIGMA = 1e-4


def print_costs(unwrapped: Unwrapped, pairs: Int[Array, "m 2"]) -> Float[Array, "m c"]:
    """What each pair of views costs (nats, 0 at its best) at each azimuth of 0..c-1 cells, as the kernels count it.

    The pairs of v views share these views' pixels, so that each counts for v / m of a pair that stands alone."""
    seen, light = _normalised(unwrapped.appearance, unwrapped.count), _normalised(unwrapped.lit, unwrapped.lit_count)
    maps = *np.moveaxis(seen, -1, 0), (seen**2).sum(-1), unwrapped.count > 0
    one, two, power, where = (np.fft.rfft(x, axis=2) for x in maps)
    pixels = unwrapped.count.sum((1, 2)) / np.maximum((unwrapped.count > 0).sum((1, 2)), 1)
    out = np.zeros((len(pairs), unwrapped.count.shape[2]))
    for m, (i, j) in enumerate(pairs):
        both = _shifted(one[i], one[j]) + _shifted(two[i], two[j])
        size = _shifted(power[i], where[j]) * _shifted(where[i], power[j])
        samples = 2 * _shifted(where[i], where[j]) * min(pixels[i], pixels[j]) / PIXELS_A_SAMPLE
        match = _log_ratio(both, size, samples)
        shared = np.minimum(unwrapped.lit_count[i], unwrapped.lit_count[j])
        a, b = light[i][shared > 0], light[j][shared > 0]
        products = np.array([a * b, a * a, b * b]).reshape(3, -1).sum(1, keepdims=True)
        lit = _log_ratio(products[0], products[1] * products[2], 2 * shared.sum(keepdims=True) / PIXELS_A_SAMPLE)
        ratio = np.logaddexp(match, lit)
        out[m] = ratio.max() - ratio
    return out * len(unwrapped.count) / max(len(pairs), 1)


def _normalised(appearance: Float[Array, "*v 2"], count: Float[Array, "*v"]) -> Float[Array, "*v 2"]:
    """In robust standard deviations; 0 where nothing is seen."""
    there = appearance[count > 0]
    sigma = MAD_TO_SIGMA_SHORT * np.median(np.abs(there), axis=0) + LEAST_SIGMA if len(there) else np.ones(2)
    return np.asarray(np.where(count[..., None] > 0, np.clip(appearance / sigma, -MOST_SIGMA, MOST_SIGMA), 0.0))


def _shifted(one: Array, two: Array) -> Float[Array, " c"]:
    """Sum over rows and cells a of one[a] two[a - q], by q, from their spectra."""
    product = np.einsum("rf,rf->f", one, two.conj())
    return np.asarray(np.fft.irfft(product, 2 * (len(product) - 1)))


def _log_ratio(both: Float[Array, " c"], size: Float[Array, " c"], samples: Float[Array, " c"]) -> Float[Array, " c"]:
    """Of correlated to independent samples, from the sum of their products and the product of their powers."""
    r = np.clip(both / np.sqrt(np.maximum(size, 1e-12)), 0.0, MOST_CORRELATION)
    return np.asarray(-0.5 * np.maximum(samples, 0.0) * np.log(1 - r * r))
