"""What a pixel's colour says near the object's border: its density on the object against its density on the scene.

The scene's colour is known at each pixel, up to the shade in which it lies; the object's is what its inside shows
nearby or, at times, anywhere. Both are normal densities, measured in this frame inside of the object and around it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.segment.background.channels import sum_of_channels

Sum = Callable[[Array], Array]
Image = Float32[Array, "a b"]
ANY_COLOR = 256.0**-3
"""The density of a colour of which nothing is known."""


@dataclass(frozen=True)
class ColorSettings:
    """Shares and deviations of colours, which are 0..255."""

    noise: float = 4.0
    """Standard deviation of a pixel's colour beside what the static scene says of its own."""
    mixed: float = 0.15
    """The same as a share of the difference between object and scene: pixels at a border are mixtures of both."""
    unlike_nearby: float = 0.3
    """Share of the object's pixels that show any of its colours, not those nearby."""
    darker: float = 0.2
    """Share of the scene's pixels that lie in a shadow which is darker than the scene nearby, of any darkness."""
    strange: float = 0.02
    """Share of the object's pixels that have any colour at all: a side that was never seen ..."""
    strange_scene: float = 0.002
    """... and of the scene's, of which each pixel is known."""
    shade: float = 0.05
    """Standard deviation of the scene's shade (1: as it was without the object) before pixels show it."""
    before_px: float = 10.0
    """So many pixels is worth what is taken for granted before pixels show it."""
    kinds: tuple[float, ...] = (-3.0, -1.0, 1.0, 3.0)
    """Log ratios between which pixels count as of one kind."""
    most: float = 2.0
    """The most that one pixel says."""


@dataclass(frozen=True, eq=False)
class _Shades:
    """Each pixel against the scene's colour there: in which shade of it (1: as it was) it comes nearest, how far off it
    is then (squared), and the scene's colour itself (squared)."""

    shade: Image
    off2: Image
    size2: Image

    @staticmethod
    def of(color: Float32[Array, "a b 3"], scene_rgb: Float32[Array, "a b 3"]) -> _Shades:
        size2 = np.maximum(sum_of_channels(scene_rgb**2), 1.0)
        shade = sum_of_channels(color * scene_rgb) / size2
        return _Shades(shade, sum_of_channels((color - shade[..., None] * scene_rgb) ** 2), size2)


@dataclass(frozen=True, eq=False)
class _SceneColors:
    """Where the scene lies in the colours around the object: its shade, and variances across and along it."""

    shades: _Shades
    shade: Image
    across: Image
    along: Image


def color_log_ratio(
    color: Float32[Array, "a b 3"],
    scene_rgb: Float32[Array, "a b 3"],
    scene_sigma: Image,
    core: Bool[Array, "a b"],
    ring: Bool[Array, "a b"],
    around_px: int,
    s: ColorSettings,
) -> Image:
    """log p(colour | object) / p(colour | scene) of each pixel, within +-`most`; 0 where `core`, the object's inside,
    is hardly anything. `ring`: pixels that show the scene. "Nearby" is a square of `around_px`."""
    if core.sum() < s.before_px:
        return np.zeros(core.shape, np.float32)

    def nearby(values: Array) -> Array:
        return np.asarray(cv2.boxFilter(values.astype(np.float32), -1, (around_px, around_px), normalize=False))

    scene = _scene_nearby(_Shades.of(color, scene_rgb), scene_sigma, ring, nearby, s)
    ratio = _log_ratio(color, scene_rgb, scene, core, nearby, s)
    return _as_seen(ratio, core, ring, nearby, s)


def _log_ratio(
    color: Float32[Array, "a b 3"], scene_rgb: Float32[Array, "a b 3"], scene: _SceneColors, own: Bool[Array, "a b"],
    nearby: Sum, s: ColorSettings,
) -> Image:  # fmt: skip
    mean, spread = color[own].mean(0), np.cov(color[own].T).astype(np.float32)
    local_mean, local_spread = _object_nearby(color - mean, own, spread, nearby, s)
    mixed2 = s.mixed**2 * sum_of_channels((local_mean + mean - scene.shade[..., None] * scene_rgb) ** 2)
    alike, noise2 = np.eye(3, dtype=np.float32), s.noise**2
    like_nearby = _normal(color - mean - local_mean, local_spread + (noise2 + mixed2)[..., None, None] * alike)
    like_any = _normal(color - mean, spread + noise2 * alike)
    on_object = (1 - s.unlike_nearby) * like_nearby + s.unlike_nearby * like_any
    shades, across, along = scene.shades, scene.across + mixed2, scene.along + mixed2
    off = shades.shade - scene.shade
    lit = np.exp(-0.5 * off**2 * shades.size2 / along) / np.sqrt(2 * np.pi * along)
    on_scene = (1 - s.darker) * lit + s.darker * (off < 0) / np.sqrt(shades.size2)
    on_scene *= np.exp(-0.5 * shades.off2 / across) / (2 * np.pi * across)
    ratio = np.log((on_object + s.strange * ANY_COLOR) / (on_scene + s.strange_scene * ANY_COLOR))
    return ratio.astype(np.float32)


def _as_seen(ratio: Image, core: Bool[Array, "a b"], ring: Bool[Array, "a b"], nearby: Sum, s: ColorSettings) -> Image:
    """What such a ratio is worth: how often the object's inside shows one nearby (or anywhere: the border may show any
    of its colours), against the scene nearby; so an object that looks like the scene does not vanish. A ratio that
    hardly any pixel shows speaks for itself."""
    kinds = np.digitize(ratio, s.kinds)
    few = s.before_px / (len(s.kinds) + 1)
    in_core, in_ring = nearby(core) + s.before_px, nearby(ring) + s.before_px
    out = np.zeros(core.shape, np.float32)
    for k in range(len(s.kinds) + 1):
        kind = kinds == k
        anywhere = (float((kind & core).sum()) + few) / (float(core.sum()) + s.before_px)
        inside = np.maximum(anywhere, (nearby(kind & core) + s.before_px * anywhere) / in_core)
        shown = float((kind & core).sum()) + nearby(kind & ring)
        sure = shown / (shown + s.before_px)
        as_often = np.log(inside / ((nearby(kind & ring) + few) / in_ring))
        out[kind] = (sure * as_often + (1 - sure) * ratio)[kind]
    return out.clip(-s.most, s.most)


def _object_nearby(
    color: Float32[Array, "a b 3"], core: Bool[Array, "a b"], spread: Float32[Array, "3 3"], nearby: Sum,
    s: ColorSettings,
) -> tuple[Float32[Array, "a b 3"], Float32[Array, "a b 3 3"]]:  # fmt: skip
    """Mean and covariance of the object's colours around each pixel; `color` is taken from the mean of all of them."""
    inside = color * core[..., None]
    count = nearby(core) + s.before_px
    mean = np.stack([nearby(inside[..., k]) / count for k in range(3)], -1)
    out = np.empty((*core.shape, 3, 3), np.float32)
    for i in range(3):
        for j in range(i, 3):
            second = (nearby(inside[..., i] * inside[..., j]) + s.before_px * spread[i, j]) / count
            out[..., i, j] = out[..., j, i] = second - mean[..., i] * mean[..., j]
    return mean, out


def _scene_nearby(
    shades: _Shades, sigma: Image, ring: Bool[Array, "a b"], nearby: Sum, s: ColorSettings
) -> _SceneColors:
    count, floor = nearby(ring) + s.before_px, s.noise**2 + sigma**2
    mean = (nearby(shades.shade * ring) + s.before_px) / count
    second = (nearby(shades.shade**2 * ring) + s.before_px * (1 + s.shade**2)) / count
    across = (nearby(shades.off2 * ring) / 2 + s.before_px * floor) / count
    return _SceneColors(shades, mean, across, np.maximum(second - mean**2, 0.0) * shades.size2 + floor)


def _normal(off: Float32[Array, "*n 3"], spread: Float32[Array, "*m 3 3"]) -> Float[Array, "*n"]:
    """Density of a normal distribution, by the adjugate of its covariance."""
    (a, b, c), (_, d, e), (_, _, f) = (tuple(spread[..., i, j] for j in range(3)) for i in range(3))
    x, y, z = off[..., 0], off[..., 1], off[..., 2]
    A, B, C, D, E, F = d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b
    volume = np.maximum(a * A + b * B + c * C, 1.0)
    square = (A * x * x + D * y * y + F * z * z + 2 * (B * x * y + C * x * z + E * y * z)) / volume
    return np.exp(-0.5 * square) / np.sqrt((2 * np.pi) ** 3 * volume)
