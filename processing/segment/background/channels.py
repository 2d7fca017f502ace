"""Over the channels of a picture: much faster than numpy's reductions over an axis of three."""

from __future__ import annotations

import numpy as np
from numpy import ndarray as Array


def most_of_channels(color: Array) -> Array:
    """The most of the three channels."""
    return np.asarray(np.maximum(np.maximum(color[..., 0], color[..., 1]), color[..., 2]))


def sum_of_channels(values: Array) -> Array:
    """The sum over the few channels."""
    return np.asarray(sum(values[..., k] for k in range(values.shape[-1])))
