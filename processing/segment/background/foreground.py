"""One frame against the static scene: which pixels are something else, and where exactly its border runs."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray as Array

from processing.segment.background.static_scene import StaticScene
from processing.sensor.noise import stereo_sigma_m
from recordings.records import RgbdFrame

Window = tuple[slice, slice]


@dataclass(frozen=True)
class ForegroundSettings:
    """Thresholds and weights of a pixel's log-odds; colour values are 0..255."""

    nearer_m: float = 0.008
    """The least distance in front of the scene that counts (more where depth is noisy)."""
    nearer_sigmas: float = 5.0
    """The same in standard deviations of the depth."""
    color_step: float = 20.0
    """The least difference of colour from the scene that counts."""
    color_share: float = 0.4
    """The same as a share of the object's typical difference nearby: a blurred edge lies where it halves."""
    weight_color: float = 2.0
    weight_scene_color: float = 1.5
    contrast: float = 2.0
    """An object that differs from the scene by so many times the least step is distinguished from it by colour in
    full."""
    least_contrast: float = 0.15
    weight_nearer: float = 1.5
    weight_scene_depth: float = 1.5
    middle_sigmas: float = 3.0
    """So many standard deviations before the scene, depth speaks neither for the object nor for the scene."""
    weight_sigma: float = 0.75
    """How fast it turns to either side, per standard deviation."""
    weight_likeness: float = 1.5
    """Weight of the colour histograms, used where the scene's colour is unknown or other things touch the object."""
    darkest_shadow: float = 0.55
    """A shadow on the scene is its own colour times at least this."""
    smoothing: float = 1.2
    """Pull of a neighbouring pixel of the same colour."""
    edge_color: float = 25.0
    """A colour step of this size between neighbours cuts the pull."""
    sweeps: int = 8
    band_inside_px: int = 3
    band_outside_px: int = 3


def kernel(radius_px: int) -> UInt8[Array, "k k"]:
    """A disc for erosion and dilation."""
    size = 2 * radius_px + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)).astype(np.uint8)


def grown(mask: Bool[Array, "h w"], radius_px: int) -> Bool[Array, "h w"]:
    """Dilation by a disc of any size, at the cost of one distance transform around the mask."""
    out = np.zeros_like(mask)
    at = window_around(mask, radius_px + 2)
    if at is not None:
        away = cv2.distanceTransform((~mask[at]).astype(np.uint8), cv2.DIST_L2, 5)
        out[at] = away <= radius_px + 0.25
    return out


def nearer_than_scene(depth_m: Float32[Array, "h w"], scene: StaticScene, s: ForegroundSettings) -> Bool[Array, "h w"]:
    """Pixels with a return clearly in front of the scene; any return counts where the scene is known to give none."""
    sigma = np.maximum(scene.depth_sigma_m, stereo_sigma_m(scene.depth_m))
    least = np.maximum(s.nearer_m, s.nearer_sigmas * sigma)
    empty = (scene.depth_m == 0) & scene.known
    return (depth_m > 0) & (empty | (scene.depth_m - depth_m > least))


def moved_pixels(frame: RgbdFrame, scene: StaticScene, s: ForegroundSettings) -> Bool[Array, "h w"]:
    """Pixels that are not the scene: nearer, or of another colour where there is no depth. Specks are removed."""
    nearer = nearer_than_scene(frame.depth_m, scene, s)
    color_only = scene.known & (frame.depth_m == 0)
    apart = np.abs(frame.color_rgb[color_only] - scene.color_rgb[color_only])
    difference = np.maximum(np.maximum(apart[:, 0], apart[:, 1]), apart[:, 2])  # much faster than .max(-1)
    nearer[color_only] |= difference > np.maximum(s.color_step, 4 * scene.color_sigma[color_only])
    found = cv2.morphologyEx(nearer.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0


def shadow_distance(
    color: Float32[Array, "h w 3"], scene: Float32[Array, "h w 3"], darkest: float
) -> Float32[Array, "h w"]:
    """Distance of a colour from the scene's colour in any shade between `darkest` and 1.1 times as bright."""
    shade = (color * scene).sum(-1) / np.maximum((scene * scene).sum(-1), 1.0)
    shade = np.clip(shade, darkest, 1.1)
    return np.linalg.norm(color - shade[..., None] * scene, axis=-1).astype(np.float32)


def pixel_log_odds(
    frame: RgbdFrame,
    scene: StaticScene,
    rough: Bool[Array, "h w"],
    at: Window,
    likeness: Float32[Array, "a b"] | None,
    s: ForegroundSettings,
) -> Float32[Array, "a b"]:
    """Log-odds that a pixel of the window is the object, from its colour and its depth against the scene's.

    A pixel at the scene's depth may lie in the object's shadow, so only another hue speaks for the object there.
    `likeness` (log-odds of the object's colours) stands in for the scene's colour where that is not known.
    """
    color, depth = frame.color_rgb[at].astype(np.float32), frame.depth_m[at]
    scene_color, scene_depth = scene.color_rgb[at], scene.depth_m[at]
    nearer = nearer_than_scene(depth, _cut(scene, at), s)
    at_scene = (depth > 0) & (scene_depth > 0) & ~nearer
    plain = np.linalg.norm(color - scene_color, axis=-1)
    on_table = at_scene & (np.abs(scene_depth - depth) < np.maximum(0.006, 3 * stereo_sigma_m(scene_depth)))
    differs = np.where(on_table, shadow_distance(color, scene_color, s.darkest_shadow), plain)
    inside = cv2.erode(rough[at].astype(np.uint8), kernel(s.band_inside_px)).astype(np.float32)
    typical = cv2.blur(plain * inside, (9, 9)) / np.maximum(cv2.blur(inside, (9, 9)), 1e-3)
    least = np.maximum(s.color_step + 3 * scene.color_sigma[at], s.color_share * typical)
    sure = np.clip(np.abs(differs - least) / (0.3 * least), 0.2, 1.0)
    # where the object looks like the scene behind it, a colour like the scene's speaks for neither
    contrast = np.clip(typical / (s.contrast * (s.color_step + 3 * scene.color_sigma[at])), s.least_contrast, 1.0)
    against = s.weight_scene_color * np.where(inside.any(), contrast, 1.0)
    by_color = np.where(differs > least, s.weight_color, -against) * sure * scene.known[at]
    sigma = np.maximum(scene.depth_sigma_m[at], 0.7 * stereo_sigma_m(scene_depth))
    step = (scene_depth - depth) / np.maximum(sigma, 1e-4) - s.middle_sigmas
    graded = np.clip(s.weight_sigma * step, -s.weight_scene_depth, s.weight_nearer)
    by_depth = np.where((depth > 0) & (scene_depth > 0), graded, s.weight_nearer * nearer)
    total = by_color + by_depth
    if likeness is not None:
        total = total + s.weight_likeness * likeness
    return total.astype(np.float32)


def smooth(
    log_odds: Float32[Array, "h w"], color: Float32[Array, "h w 3"], s: ForegroundSettings
) -> Float32[Array, "h w"]:
    """Mean field of an Ising model whose neighbours pull less across colour edges: -1 (scene) to 1 (object)."""
    pulls = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        step = np.linalg.norm(color - np.roll(color, (-dy, -dx), (0, 1)), axis=-1)
        pull = np.exp(-((step / s.edge_color) ** 2) / 2) / (1.0 if dy * dx == 0 else 1.4) + 0.1
        pulls.append((dy, dx, pull.astype(np.float32)))
    belief = np.tanh(log_odds / 2)
    for _ in range(s.sweeps):
        around = np.zeros_like(belief)
        for dy, dx, pull in pulls:
            around += pull * np.roll(belief, (-dy, -dx), (0, 1)) + np.roll(pull * belief, (dy, dx), (0, 1))
        belief = np.tanh((log_odds + s.smoothing * around) / 2)
    return belief.astype(np.float32)


def refine_border(
    frame: RgbdFrame,
    scene: StaticScene,
    rough: Bool[Array, "h w"],
    likeness: Float32[Array, "h w"] | None,
    s: ForegroundSettings,
    pieces_px: int | None = None,
) -> tuple[Bool[Array, "h w"], float]:
    """The mask with its border drawn anew within a band around it, and how sure the band's pixels are (0..1).

    It is one piece, or all pieces of at least `pieces_px` pixels.
    """
    rough = fill_holes(rough)
    at = window_around(rough, s.band_outside_px + 9)
    if at is None:
        return rough, 0.0
    part = rough[at].astype(np.uint8)
    odds = pixel_log_odds(frame, scene, rough, at, None if likeness is None else likeness[at], s)
    odds[cv2.erode(part, kernel(s.band_inside_px)) > 0] = 8.0
    odds[cv2.dilate(part, kernel(s.band_outside_px)) == 0] = -8.0
    belief = smooth(odds, frame.color_rgb[at].astype(np.float32), s)
    band = np.abs(odds) < 8.0
    out = np.zeros_like(rough)
    kept = largest_component(belief > 0) if pieces_px is None else without_specks(belief > 0, pieces_px)
    out[at] = fill_holes(kept)
    return out, float(np.abs(belief[band]).mean()) if band.any() else 0.0


def window_around(mask: Bool[Array, "h w"], margin_px: int) -> Window | None:
    """The mask's bounding box with a margin, inside the image; None for an empty mask."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if len(rows) == 0:
        return None
    top, left = max(rows[0] - margin_px, 0), max(columns[0] - margin_px, 0)
    return slice(int(top), int(rows[-1]) + margin_px + 1), slice(int(left), int(columns[-1]) + margin_px + 1)


def largest_component(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """The largest 4-connected component; empty stays empty."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return labels == 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else mask.copy()


def without_specks(mask: Bool[Array, "h w"], least_px: int) -> Bool[Array, "h w"]:
    """All 4-connected components of at least so many pixels, and the largest one in any case."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= least_px
    keep[0] = False
    return np.asarray(keep[labels]) if keep.any() else largest_component(mask)


def fill_holes(mask: Bool[Array, "h w"], largest_share: float = 0.05) -> Bool[Array, "h w"]:
    """Fill holes smaller than a share of the mask: a larger one is a real hole (a mug's handle)."""
    at = window_around(mask, 1)
    if at is None:
        return mask.copy()
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~mask[at]).astype(np.uint8), connectivity=4)
    small = stats[:, cv2.CC_STAT_AREA] <= largest_share * mask.sum()
    small[0] = False
    for edge in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        small[edge] = False
    out = mask.copy()
    out[at] |= small[labels]
    return out


def _cut(scene: StaticScene, at: Window) -> StaticScene:
    return StaticScene(
        scene.depth_m[at],
        scene.depth_sigma_m[at],
        scene.color_rgb[at],
        scene.color_sigma[at],
        scene.known[at],
        scene.table_depth_m[at],
    )
