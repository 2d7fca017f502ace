"""The views of tosses in the flat arrays that the kernels read.

Any view can so serve as the model for any other: the growing model is the set of views at their poses. Nothing is
averaged away, nothing limits the object's size, and a corrected pose corrects the model.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.sensor.color_light import ColorLight, raised
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop, ViewConfig, make_view

STILL_OUTLINE, STILL_PX, STILL_BRIGHTNESS = 0.96, 0.3, 0.03
"""Overlap of outlines, shift of their center and change of brightness of an object that stands still."""


def _on_common_ground(one: Crop, two: Crop) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Mask and brightness of two crops over the pixels that both cover."""
    left, top = np.maximum(one.corner, two.corner)
    ends = [np.add(c.corner, c.mask.shape[::-1]) for c in (one, two)]
    right, bottom = np.minimum(*ends)
    out = []
    for c in (one, two):
        area = np.s_[top - c.corner[1] : bottom - c.corner[1], left - c.corner[0] : right - c.corner[0]]
        out.append((c.mask[area], c.color[area].mean(-1)))
    return out[0], out[1]


class ViewStore:
    """The views of one or several tosses in the flat arrays that the kernels read."""

    def __init__(self, rectified: Rectification, crops: list[Crop | None], config: ViewConfig) -> None:
        sizes = [0 if c is None else int(c.mask.size) for c in crops]
        self.rectified, self.crops, self.config = rectified, crops, config
        self.light = [ColorLight.unknown()] * len(crops)
        self.maps = np.zeros((sum(sizes), lay.CHANNELS), dtype=np.float32)
        self.samples = np.zeros((config.samples * len(crops), lay.SAMPLE), dtype=np.float32)
        self.table: Int64[Array, "n 7"] = np.zeros((len(crops), 7), dtype=np.int64)
        self.center_m = np.full((len(crops), 3), np.nan)
        self.motion: list[Float[Array, "4 4"] | None] = [None] * len(crops)
        for i, offset in enumerate(np.cumsum([0, *sizes[:-1]]) if sizes else []):
            self.table[i, lay.OFFSET], self.table[i, lay.FIRST] = offset, i * config.samples

    def __len__(self) -> int:
        return len(self.crops)

    @property
    def color_gain(self) -> float:
        """By how much all its differences of colour are raised."""
        return self.light[0].gain if self.light else 1.0

    def usable(self, i: int) -> bool:
        return bool(self.table[i, lay.COUNT] > 0)

    def fill(self, i: int, motion: Float[Array, "4 4"] | None = None) -> bool:
        """Make view i (again), with the object's motion from depth's to colour's exposure. False: nothing to see."""
        crop = self.crops[i]
        view = None if crop is None else make_view(crop, self.rectified, self.config, motion)
        self.table[i, lay.COUNT] = 0
        if view is None or crop is None:
            return False
        h, w = crop.mask.shape
        offset, first, n = int(self.table[i, lay.OFFSET]), int(self.table[i, lay.FIRST]), len(view.samples)
        self.maps[offset : offset + h * w] = view.pixels.reshape(-1, lay.CHANNELS)
        self.samples[first : first + n] = view.samples
        self.table[i, [lay.U0, lay.V0, lay.WIDTH, lay.HEIGHT, lay.COUNT]] = [*view.corner, w, h, n]
        self._paint(i)
        self.center_m[i] = view.center_m
        self.motion[i] = motion
        return True

    def take_light_out(self, frames: int) -> None:
        """Estimates the room's light on the object from the first `frames` views, all of them filled, and takes it out
        of their colours; views after them, drawn ones, get the same gain."""
        runs = self.still_runs(np.array([i < frames and self.usable(i) for i in range(len(self))]))
        light = ColorLight.of([self._samples(run[len(run) // 2]) for run in runs])
        for i in range(len(self)):
            self.light[i] = light if i < frames else ColorLight.unknown(light.gain)
            if self.usable(i):
                self._paint(i)

    def _samples(self, i: int) -> Float32[Array, "s c"]:
        first = int(self.table[i, lay.FIRST])
        return self.samples[first : first + int(self.table[i, lay.COUNT])]

    def _paint(self, i: int) -> None:
        offset, size = int(self.table[i, lay.OFFSET]), int(np.prod(self.table[i, [lay.WIDTH, lay.HEIGHT]]))
        self.light[i].paint(self.maps[offset : offset + size], lay.NX, lay.SHARP)
        self.light[i].paint(self._samples(i), lay.SNX, lay.SSHARP)

    def stands_still(self, i: int, j: int) -> bool:
        """Whether the object has not moved between two frames, as far as its outline and brightness show."""
        one, two = self.crops[i], self.crops[j]
        if one is None or two is None or max(np.abs(np.subtract(one.corner, two.corner))) > 3:
            return False
        a, b = _on_common_ground(one, two)
        both, either = int((a[0] & b[0]).sum()), int((a[0] | b[0]).sum())
        if both < STILL_OUTLINE * either:
            return False
        move_px = np.abs(np.mean(np.nonzero(a[0]), axis=1) - np.mean(np.nonzero(b[0]), axis=1)).max()
        change = np.median(np.abs(a[1] - b[1])[a[0] & b[0]])
        return bool(move_px < STILL_PX and change < STILL_BRIGHTNESS)

    def still_runs(self, use: Bool[Array, " n"]) -> list[list[int]]:
        """The used frames, those between which the object stands still together."""
        runs: list[list[int]] = []
        for i in np.flatnonzero(use).tolist():
            if runs and runs[-1][-1] == i - 1 and self.stands_still(i - 1, i):
                runs[-1].append(i)
            else:
                runs.append([i])
        return runs

    def only(self, views: Int64[Array, " m"]) -> ViewStore:
        """The same store with some of its views alone (pixels copied)."""
        out = ViewStore(self.rectified, [self.crops[int(i)] for i in views], self.config)
        for new, i in enumerate(views):
            crop, row = out.crops[new], self.table[i]
            size = 0 if crop is None else crop.mask.size
            offset, first, n = int(out.table[new, lay.OFFSET]), int(out.table[new, lay.FIRST]), int(row[lay.COUNT])
            out.maps[offset : offset + size] = self.maps[row[lay.OFFSET] : row[lay.OFFSET] + size]
            out.samples[first : first + n] = self.samples[row[lay.FIRST] : row[lay.FIRST] + n]
            out.table[new, lay.U0 : lay.HEIGHT + 1], out.table[new, lay.COUNT] = row[lay.U0 : lay.HEIGHT + 1], n
            out.center_m[new], out.motion[new] = self.center_m[i], self.motion[int(i)]
            out.light[new] = self.light[int(i)]
        return out

    @staticmethod
    def joined(stores: list[ViewStore]) -> ViewStore:
        """All views of several stores in one, in order, with the first one's gain of colours; they must have one
        camera."""
        out = ViewStore.__new__(ViewStore)
        out.rectified, out.config = stores[0].rectified, stores[0].config
        out.crops = [c for s in stores for c in s.crops]
        out.motion = [m for s in stores for m in s.motion]
        gains = [stores[0].color_gain / s.color_gain for s in stores]
        out.light = [replace(light, gain=gain * light.gain) for s, gain in zip(stores, gains) for light in s.light]
        out.maps = np.concatenate([raised(s.maps, lay.SHARP, gain) for s, gain in zip(stores, gains)])
        out.samples = np.concatenate([raised(s.samples, lay.SSHARP, gain) for s, gain in zip(stores, gains)])
        out.center_m = np.concatenate([s.center_m for s in stores])
        tables, pixels, samples = [], 0, 0
        for s in stores:
            table = s.table.copy()
            table[:, lay.OFFSET] += pixels
            table[:, lay.FIRST] += samples
            pixels, samples = pixels + len(s.maps), samples + len(s.samples)
            tables.append(table)
        out.table = np.concatenate(tables)
        return out
