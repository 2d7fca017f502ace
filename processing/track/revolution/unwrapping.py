"""Cylindrical unwrapping of a round body's views about its axis: what each shows at which height and angle.

Three things are kept per view. The appearance of the surface, after the light on it is taken away: on a round body
shading stays with the room, and would otherwise show that nothing turns. What stands off the round body (a mug's
handle), and from which side it was seen. And where nothing stands off it, because something behind was seen through
that place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.beam import Scene
from processing.track.revolution.axis import Axis
from recordings.constants import LUMA, MAD_TO_SIGMA_SHORT
from recordings.estimation.robust import geman_mcclure_weight


@dataclass(frozen=True)
class UnwrappingConfig:
    """How views are unwrapped."""

    row_m: float = 0.005
    """Height of a row (radius on the ends of the body)."""
    layers_m: tuple[float, ...] = (0.009, 0.015, 0.021)
    """Heights above the round body at which something may stand off it."""
    odd_m: float = 0.006
    """What is farther from the axis than the round body by this stands off it."""
    beyond_m: float = 0.012
    """A place is empty where the surface behind it is farther by this ..."""
    beside_px: float = 4.5
    """... or where the outline passes it by this."""
    facing: float = 0.25
    """The appearance of a surface that turns away from the camera farther than this cosine is not used."""
    lit_every: int = 5
    """Of the pixels, one in so many is used to fit the light."""
    robust: float = 1.5
    """Residuals of the light beyond so many standard deviations belong to the object."""
    shine: float = 0.2
    """A surface whose brightness is beyond the light's by this share, and its colour paler, mirrors a lamp ..."""
    grey: float = 1.2
    """... unless it is paler than this share of the way to grey."""
    table_m: float = 0.006
    """A place that lies deeper in the table is empty, and what is no higher above it may be the table ..."""
    window_px: float = 7.0
    """... by a matcher's window more: depth runs on from the body to the table between them, and past its outline by
    half a window (7 x 7 pixels: Keselman et al. 2017, as in sensor/noise.py)."""


@dataclass(frozen=True, eq=False)
class Unwrapped:
    """`appearance` (v, r, c, 2): two differences of colour without the light, mean per cell; `count` (v, r, c): pixels.
    `odd` (v, q, c): share of cells where something stands off the body, `sides` (v, 3, q, c) the same by the side that
    was seen; `free` (v, q, c): 1 where nothing stands. Rows r: outside by height, both ends by radius; q: layers times
    heights; c: angles about the axis. `standing`: per view the pixels of what stands off the body, as samples. `rings`:
    place along the axis and radius of the round body's circles, its ends' included."""

    appearance: Float[Array, "v r c 2"]
    count: Float[Array, "v r c"]
    odd: Float[Array, "v q c"]
    sides: Float[Array, "v 3 q c"]
    free: Float[Array, "v q c"]
    standing: list[Float32[Array, "_ s"]]
    rings: Float[Array, "h 2"]


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Surface pixels of one view: along the axis (m), distance from it, angle about it, its normal's parts along the
    axis, away from it and around it; cosine to the camera; normal (camera axes), colours, brightness; height above the
    table (infinite where that is not known); all of it as samples in camera axes."""

    along_m: Float[Array, " p"]
    radius_m: Float[Array, " p"]
    angle: Float[Array, " p"]
    normal: Float[Array, "p 3"]
    facing: Float[Array, " p"]
    normal_camera: Float[Array, "p 3"]
    appearance: Float[Array, "p 2"]
    bright: Float[Array, " p"]
    height_m: Float[Array, " p"]
    samples: Float32[Array, "p s"]


def unwrap(
    scene: Scene,
    poses: Float[Array, "n 4 4"],
    views: Int[Array, " v"],
    axis: Axis,
    cells: int,
    config: UnwrappingConfig,
) -> Unwrapped:
    """The views unwrapped about the axis in so many cells of angle."""
    seen = [_pixels(scene, int(i), poses[i], axis) for i in views]
    appearance = _without_light(seen, config)
    along = np.concatenate([p.along_m for p in seen])
    low, high = np.quantile(along, [0.002, 0.998])
    profile = _profile(seen, low, high, config)
    heights, ends = len(profile), int(np.ceil((profile.max() + 0.002) / config.row_m))
    rows, layers = heights + 2 * ends, len(config.layers_m)
    mean, count = np.zeros((len(views), rows, cells, 2)), np.zeros((len(views), rows, cells))
    odd = np.zeros((len(views), 3, layers * heights, cells))
    free = np.zeros((len(views), layers * heights, cells))
    standing = []
    for n, (i, p) in enumerate(zip(views, seen)):
        cell = np.floor((p.angle + np.pi) / (2 * np.pi) * cells).astype(int) % cells
        row = _rows(p, profile, low, high, ends, config)
        left, shines = appearance[n]
        use = (row >= 0) & ~shines
        np.add.at(count[n], (row[use], cell[use]), 1)
        np.add.at(mean[n], (row[use], cell[use]), left[use])
        window_m = float(config.window_px * scene.store.center_m[i][2] / scene.store.rectified.focal[0])
        height, layer, side, off = _off(p, profile, low, window_m, config)
        np.add.at(odd[n], (side[off], layer[off] * heights + height[off], cell[off]), 1)
        free[n] = _free(scene, int(i), poses[i], axis, profile, low, cells, config)
        standing.append(p.samples[off])
    mean /= np.maximum(count, 1)[..., None]
    anyhow = np.minimum(odd.sum(1), 3) / 3
    rings = np.column_stack([np.clip(low + (np.arange(heights) + 0.5) * config.row_m, low, high), profile])
    rings = np.concatenate([[[low, profile[0]]], rings, [[high, profile[-1]]]])
    return Unwrapped(mean, count, anyhow, np.minimum(odd, 3) / 3, free * (anyhow == 0), standing, rings)


def across(axis: Axis) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Two directions that span the plane across the axis."""
    side = np.cross(axis.direction, np.eye(3)[int(np.abs(axis.direction).argmin())])
    side /= np.linalg.norm(side)
    return side, np.cross(axis.direction, side)


def _pixels(scene: Scene, view: int, pose: Float[Array, "4 4"], axis: Axis) -> _Pixels:
    store, crop = scene.store, scene.store.crops[view]
    offset, u0, v0, w, h = (int(x) for x in store.table[view, : lay.HEIGHT + 1])
    pixels = store.maps[offset : offset + w * h].reshape(h, w, -1)
    v, u = np.nonzero((pixels[..., lay.Z] > 0) & (pixels[..., lay.SHARP] < 0.5 * lay.NO_APPEARANCE))
    here = pixels[v, u].astype(np.float64)
    focal, center = store.rectified.focal, store.rectified.center
    rays = np.stack([(u + u0 - center[0]) / focal[0], (v + v0 - center[1]) / focal[1], np.ones(len(u))], -1)
    p, normal = rays * here[:, lay.Z, None], here[:, lay.NX : lay.NZ + 1]
    own, turned = (p - pose[:3, 3]) @ pose[:3, :3] - axis.point_m, normal @ pose[:3, :3]
    one, two = across(axis)
    x, y = own @ one, own @ two
    radius = np.maximum(np.hypot(x, y), 1e-6)
    nx, ny = turned @ one, turned @ two
    parts = np.stack([turned @ axis.direction, (nx * x + ny * y) / radius, (ny * x - nx * y) / radius], -1)
    facing = -np.sum(p * normal, 1) / np.linalg.norm(p, axis=1)
    assert crop is not None  # a view with pixels has a crop
    bright = np.log(crop.color[v, u].astype(np.float64) @ LUMA + 0.02)
    appearance = here[:, lay.SHARP + 1 : lay.SHARP + 3]
    above = np.full(len(u), np.inf) if crop.height_m is None else crop.height_m[v, u].astype(np.float64)
    samples = np.concatenate([p, here[:, lay.NX : lay.NZ + 1], here[:, lay.SHARP :]], axis=1).astype(np.float32)
    return _Pixels(
        own @ axis.direction, radius, np.arctan2(y, x), parts, facing, normal, appearance, bright, above, samples
    )


def _light(normal: Float[Array, "p 3"], bright: Float[Array, " p"]) -> Float[Array, "p t"]:
    """Spherical harmonics of the normal up to the third order (light that differs in hue from side to side), and
    brightness (colour that depends on how much light there is)."""
    x, y, z = normal.T
    one = np.ones_like(x)
    first = [one, x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1, x * (x * x - 3 * y * y)]
    third = [y * (3 * x * x - y * y), z * (x * x - y * y), x * y * z, x * (5 * z * z - 1), y * (5 * z * z - 1)]
    return np.stack([*first, *third, z * (5 * z * z - 3), bright], -1)


def _without_light(
    seen: list[_Pixels], config: UnwrappingConfig
) -> list[tuple[Float[Array, "p 2"], Bool[Array, " p"]]]:
    """Colours less what the light does to them, fitted robustly over all views (camera and room stand still), and where
    a lamp is mirrored."""
    some = [np.flatnonzero(p.facing > config.facing)[:: config.lit_every] for p in seen]
    normal = np.concatenate([p.normal_camera[g] for p, g in zip(seen, some)])
    bright = np.concatenate([p.bright[g] for p, g in zip(seen, some)])
    terms = _light(normal, bright - bright.mean())
    stiff = 2e-5 * len(terms) * np.diag([0.0] + [1.0] * (terms.shape[1] - 1))
    out = [np.column_stack([p.appearance, p.bright - bright.mean()]) for p in seen]
    terms_of = [_light(p.normal_camera, p.bright - bright.mean()) for p in seen]
    for c in range(3):
        wanted = np.concatenate([o[g, c] for o, g in zip(out, some)])
        if c == 2:  # brightness is not explained by itself
            terms = terms[:, :-1]
            stiff = stiff[:-1, :-1]
        weight = np.ones(len(terms))
        for _ in range(8):
            weighed = terms * weight[:, None]
            of_light = np.linalg.solve(weighed.T @ terms + stiff, weighed.T @ wanted)
            left = wanted - terms @ of_light
            scale = config.robust * MAD_TO_SIGMA_SHORT * np.median(np.abs(left)) + 1e-6
            weight = geman_mcclure_weight((left / scale) ** 2)
        for o, t in zip(out, terms_of):
            o[:, c] -= t[:, : terms.shape[1]] @ of_light
    usual = np.median(np.concatenate([p.appearance[g] for p, g in zip(seen, some)]), axis=0)
    return [(o[:, :2], _shines(o, usual, config)) for o in out]


def _shines(left: Float[Array, "p 3"], usual: Float[Array, "2"], config: UnwrappingConfig) -> Bool[Array, " p"]:
    """Where a lamp is mirrored: brighter than the light makes it, and its colour on the way to the lamp's (grey), but
    not beyond it: a label may be of the opposite colour."""
    size = np.linalg.norm(left[:, :2], axis=1) * np.linalg.norm(usual) + 1e-9
    paler = -(left[:, :2] @ usual)
    on_the_way = (paler > 0.9 * size) & (paler < config.grey * (usual @ usual))
    return np.asarray((left[:, 2] > config.shine) & on_the_way)


def _profile(seen: list[_Pixels], low: float, high: float, config: UnwrappingConfig) -> Float[Array, " h"]:
    """Radius of the round body at each height: the median of what faces away from the axis."""
    heights = int(np.ceil((high - low) / config.row_m)) + 1
    outside = [(p.normal[:, 1] > 0.8) & (np.abs(p.normal[:, 0]) < 0.5) for p in seen]
    along = np.concatenate([p.along_m[o] for p, o in zip(seen, outside)])
    radius = np.concatenate([p.radius_m[o] for p, o in zip(seen, outside)])
    row = np.floor((along - low) / config.row_m).astype(int)
    out = np.array([np.median(radius[row == r]) if (row == r).sum() > 30 else np.nan for r in range(heights)])
    known = np.isfinite(out)
    if not known.any():
        return np.full(heights, float(np.median(radius)) if len(radius) else 0.0)
    return np.interp(np.arange(heights), np.flatnonzero(known), out[known])


def _rows(
    p: _Pixels, profile: Float[Array, " h"], low: float, high: float, ends: int, config: UnwrappingConfig
) -> Int[Array, " p"]:
    """Row of each pixel of the round body's outside and ends; -1 elsewhere: hollows are lit by themselves."""
    height = np.floor((p.along_m - low) / config.row_m).astype(int)
    radius = profile[np.clip(height, 0, len(profile) - 1)]
    inside = (height >= 0) & (height < len(profile)) & (p.facing > config.facing) & (p.radius_m < radius + config.odd_m)
    out = np.full(len(height), -1)
    wall = inside & (np.abs(p.normal[:, 0]) < 0.6) & (p.normal[:, 1] > 0.4) & (p.radius_m > radius - 0.006)
    out[wall] = height[wall]
    ring = np.minimum((p.radius_m / config.row_m).astype(int), ends - 1)
    for n, (sign, at_end) in enumerate(((1, p.along_m > high - 0.008), (-1, p.along_m < low + 0.008))):
        flat = inside & at_end & (sign * p.normal[:, 0] > 0.8) & (p.radius_m < radius + 0.003)
        out[flat] = len(profile) + n * ends + ring[flat]
    return out


def _off(
    p: _Pixels, profile: Float[Array, " h"], low: float, window_m: float, config: UnwrappingConfig
) -> tuple[Int[Array, " p"], Int[Array, " p"], Int[Array, " p"], Bool[Array, " p"]]:
    """Height, layer and seen side (0, 1, 2) of each pixel, and whether it stands off the round body."""
    height = np.floor((p.along_m - low) / config.row_m).astype(int)
    known = (height >= 0) & (height < len(profile))
    height = np.clip(height, 0, len(profile) - 1)
    above = p.radius_m - profile[height]
    step = config.layers_m[1] - config.layers_m[0]
    layer = np.clip(np.round((above - config.layers_m[0]) / step).astype(int), 0, len(config.layers_m) - 1)
    off = known & (above > max(config.odd_m, 0.5 * window_m)) & (above < config.layers_m[-1] + 2 * step)
    off &= (p.facing > 0.15) & (p.height_m > config.table_m + window_m)
    side = np.where(p.normal[:, 2] > 0.35, 0, np.where(p.normal[:, 2] < -0.35, 2, 1))
    return height, layer, side, off


def _free(
    scene: Scene, view: int, pose: Float[Array, "4 4"], axis: Axis, profile: Float[Array, " h"], low: float, cells: int,
    config: UnwrappingConfig,
) -> Bool[Array, "q c"]:  # fmt: skip
    """Where the view saw past or through a place above the round body."""
    store = scene.store
    offset, u0, v0, w, h = (int(x) for x in store.table[view, : lay.HEIGHT + 1])
    pixels = store.maps[offset : offset + w * h].reshape(h, w, -1)
    angle = (np.arange(cells) + 0.5) / cells * 2 * np.pi - np.pi
    one, two = across(axis)
    outward = np.cos(angle)[:, None] * one + np.sin(angle)[:, None] * two
    along = axis.point_m + ((np.arange(len(profile)) + 0.5) * config.row_m + low)[:, None] * axis.direction
    radius = np.concatenate([profile + layer for layer in config.layers_m])
    places = np.tile(along, (len(config.layers_m), 1))[:, None] + radius[:, None, None] * outward
    q = places @ pose[:3, :3].T + pose[:3, 3]
    u = np.round(q[..., 0] / q[..., 2] * store.rectified.focal[0] + store.rectified.center[0] - u0).astype(int)
    v = np.round(q[..., 1] / q[..., 2] * store.rectified.focal[1] + store.rectified.center[1] - v0).astype(int)
    shown = (u >= 0) & (v >= 0) & (u < w) & (v < h)
    there = pixels[np.clip(v, 0, h - 1), np.clip(u, 0, w - 1)]
    through = (
        (there[..., lay.OUTSIDE] == 0) & (there[..., lay.Z] > 0) & (there[..., lay.Z] - q[..., 2] > config.beyond_m)
    )
    beside = ~shown | (there[..., lay.OUTSIDE] > config.beside_px)
    return np.asarray(beside | through | (_heights(store, view, q) < -config.table_m))


def _heights(store: ViewStore, view: int, places: Float[Array, "q c 3"]) -> Float[Array, "q c"]:
    """Height above the table of places in camera axes; infinite where the table is not known."""
    plane = table_of(store, view)
    if plane is None:
        return np.full(places.shape[:-1], np.inf)
    return np.asarray(places @ plane[:3] + plane[3])


def table_of(store: ViewStore, view: int) -> Float[Array, "4"] | None:
    """The table's plane (camera axes): height above it is plane[:3] @ p + plane[3]; None where it is not known."""
    crop = store.crops[view]
    if crop is None or crop.height_m is None:
        return None
    v, u = np.nonzero(crop.depth_m > 0)
    some = slice(None, None, max(len(u) // 200, 1))
    u, v = u[some], v[some]
    focal, center = store.rectified.focal, store.rectified.center
    rays = np.stack([(u + crop.corner[0] - center[0]) / focal[0], (v + crop.corner[1] - center[1]) / focal[1]], -1)
    z = crop.depth_m[v, u].astype(np.float64)
    seen = np.column_stack([rays * z[:, None], z, np.ones(len(z))])
    return np.asarray(np.linalg.lstsq(seen, crop.height_m[v, u].astype(np.float64), rcond=None)[0])
