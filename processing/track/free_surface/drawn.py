"""The views of all tosses with the depth of one surface in place of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.sensor.view_store import ViewStore
from processing.track.free_surface.surface import FreeSurface


class DrawnViews:
    """All tosses' views in one store; `of_toss`: which of them are each toss's."""

    def __init__(self, stores: Sequence[ViewStore]) -> None:
        self.store = ViewStore.joined(list(stores))
        ends = np.cumsum([0, *(len(s) for s in stores)]).tolist()
        self.of_toss = [slice(a, b) for a, b in zip(ends, ends[1:])]
        self.at = np.full((len(self.store), 4, 4), np.nan)
        """The pose that each was drawn at; NaN where none was."""
        self._crops, self._motion = list(self.store.crops), list(self.store.motion)

    def draw(self, toss: int, surface: FreeSurface, poses: Float[Array, "n 4 4"], use: Bool[Array, " n"]) -> None:
        """Draws the surface into a toss's views at their poses; where that shows too little they keep their own."""
        for a in np.flatnonzero(use):
            i = self.of_toss[toss].start + int(a)
            own = self._crops[i]
            assert own is not None
            (u, v), (h, w) = own.corner, own.mask.shape
            depth_m = np.where(own.mask, surface.depth(poses[a])[v : v + h, u : u + w], np.float32(0))
            self.store.crops[i] = replace(own, depth_m=depth_m, depth_delay_s=0.0)
            self.at[i] = poses[a]
            if not self.store.fill(i):
                self.at[i] = np.nan
                self.store.crops[i] = own
                self.store.fill(i, self._motion[i])
