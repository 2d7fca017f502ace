"""One frame against the static scene: which pixels are something else, and where exactly its border runs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray as Array

from processing.segment.background.channels import most_of_channels, sum_of_channels
from processing.segment.background.color_ratio import ColorSettings, color_log_ratio
from processing.segment.background.static_scene import StaticScene
from processing.sensor.noise import stereo_sigma_m
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame

Window = tuple[slice, slice]
FATTENED_RAD = 6 / 447
"""Stereo matching over windows gives the pixels beside an edge the nearer side's depth as far as the window's support
reaches: 6 infrared pixels of census and 7x7 aggregation (Keselman et al., "Intel RealSense Stereoscopic Depth Cameras",
CVPR workshops 2017) at the focal length of 848 pixels over 87 degrees (D455's data sheet)."""


@dataclass(frozen=True)
class ForegroundSettings:
    """Thresholds and weights of a pixel's log-odds; colour values are 0..255."""

    nearer_m: float = 0.008
    """The least distance in front of the scene that counts (more where depth is noisy)."""
    nearer_sigmas: float = 5.0
    """The same in standard deviations of the depth."""
    color_step: float = 20.0
    """The least difference of colour from the scene that counts."""
    weight_depth: float = 1.5
    """The most that depth says: less, where beside this object returns that are not its own say the same."""
    middle_sigmas: float = 3.0
    """So many standard deviations before the scene, depth speaks neither for the object nor for the scene."""
    weight_sigma: float = 0.5
    """How fast it turns to either side, as a share of what it says, per standard deviation."""
    weight_likeness: float = 1.5
    """Weight of the histograms of what the object and its surroundings showed in the frames before."""
    lit: float = 1.1
    """What lies in no shadow is at most this much brighter than the scene was. Shadows may be of any darkness."""
    unseen_px: float = 10.0
    """So many pixels that nobody saw, of all kinds alike, temper what depth shows of few."""
    color: ColorSettings = field(default_factory=ColorSettings)
    ring_px: int = 8
    """Width of the ring around the border's band that shows the scene, its shadows included."""
    smoothing: float = 1.2
    """Pull of a neighbouring pixel of the same colour."""
    edge_color: float = 25.0
    """A colour step of this size between neighbours cuts the pull."""
    sweeps: int = 8
    band_inside_px: int = 3
    """The border is drawn anew so far inside of the rough one: as far as the depth camera fattens (`for_camera`) ..."""
    band_outside_px: int = 3
    """... and outside of it."""

    def for_camera(self, camera: CameraModel | None) -> ForegroundSettings:
        """With a band that is as wide as stereo matching fattens what stands in front, in this camera's pixels."""
        if camera is None:
            return self
        return replace(self, band_inside_px=max(self.band_inside_px, round(FATTENED_RAD * camera.fx)))


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
    at = np.flatnonzero(scene.known & (frame.depth_m == 0))  # numbers are taken much faster than a mask's pixels
    apart = np.abs(frame.color_rgb.reshape(-1, 3).take(at, 0) - scene.color_rgb.reshape(-1, 3).take(at, 0))
    nearer.flat[at] |= most_of_channels(apart) > np.maximum(s.color_step, 4 * scene.color_sigma.take(at))
    found = cv2.morphologyEx(nearer.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0


def shadow_distance(color: Float32[Array, "*n 3"], scene: Float32[Array, "*n 3"], lit: float) -> Float32[Array, "*n"]:
    """Distance of a colour from the scene's colour in any shade between black and `lit` times as bright."""
    shade = sum_of_channels(color * scene) / np.maximum(sum_of_channels(scene * scene), 1.0)
    return _length(color - np.clip(shade, 0.0, lit)[..., None] * scene)


def _length(color: Float32[Array, "*n c"]) -> Float32[Array, "*n"]:
    return np.asarray(np.sqrt(sum_of_channels(color**2)), dtype=np.float32)


def scene_colored(frame: RgbdFrame, scene: StaticScene, at: Window, s: ForegroundSettings) -> Bool[Array, "a b"]:
    """Pixels of a window that show the scene's colour, in the light or in a shadow."""
    color, before = frame.color_rgb[at].astype(np.float32), scene.color_rgb[at].astype(np.float32)
    noise = s.color_step + 3 * scene.color_sigma[at]
    return np.asarray(scene.known[at] & (shadow_distance(color, before, s.lit) <= noise))


def pixel_log_odds(
    frame: RgbdFrame,
    scene: StaticScene,
    rough: Bool[Array, "h w"],
    at: Window,
    likeness: Float32[Array, "a b"] | None,
    s: ForegroundSettings,
) -> Float32[Array, "a b"]:
    """Log-odds that a pixel of the window is the object, from its colour and its depth against the scene's.

    A pixel lies before the scene, at it, or gives no return; what each of these is worth, the frame itself tells: how
    often it is seen well inside of the object, and how often around it. `likeness` (log-odds of the object's colours)
    stands in for the scene's colour where that is not known.
    """
    color, depth, part = frame.color_rgb[at].astype(np.float32), frame.depth_m[at], cut(scene, at)
    solid = rough[at].astype(np.uint8)
    core, band = cv2.erode(solid, kernel(s.band_inside_px)) > 0, cv2.dilate(solid, kernel(s.band_outside_px)) > 0
    nearer = nearer_than_scene(depth, part, s)
    noise = s.color_step + 3 * part.color_sigma
    scenic = part.known & ~nearer & (shadow_distance(color, part.color_rgb, s.lit) <= noise)
    ring = (cv2.dilate(band.astype(np.uint8), kernel(s.ring_px)) > 0) & ~band & scenic
    around_px = 4 * s.band_inside_px + 1
    by_color = color_log_ratio(color, part.color_rgb, part.color_sigma, core, ring, around_px, s.color) * part.known
    like_scene = part.known & (_length(color - part.color_rgb) <= noise)
    total = by_color + _depth_votes(depth, nearer, part, core, band & ~core, like_scene, s)
    if likeness is not None:
        total = total + s.weight_likeness * likeness
    return total.astype(np.float32)


def _depth_votes(
    depth_m: Float32[Array, "a b"], nearer: Bool[Array, "a b"], scene: StaticScene, core: Bool[Array, "a b"],
    border: Bool[Array, "a b"], like_scene: Bool[Array, "a b"], s: ForegroundSettings,
) -> Float32[Array, "a b"]:  # fmt: skip
    """What depth says of each pixel; no return says nothing, as dark and grazing sides give none either."""
    at_scene = ~nearer & (depth_m > 0)
    before = _vote(nearer & core, core, _fattened(nearer, core, border, like_scene), like_scene & border, s)
    behind = _vote(at_scene & core, core, float((at_scene & like_scene & border).sum()), like_scene & border, s)
    sigma = np.maximum(scene.depth_sigma_m, 0.7 * stereo_sigma_m(scene.depth_m))
    side = np.clip(s.weight_sigma * ((scene.depth_m - depth_m) / np.maximum(sigma, 1e-4) - s.middle_sigmas), -1, 1)
    graded = np.where(side > 0, max(before, 0.0) * side, -min(behind, 0.0) * side)
    both = (depth_m > 0) & (scene.depth_m > 0)
    return np.where(both, graded, max(before, 0.0) * nearer).astype(np.float32)


def _fattened(
    nearer: Bool[Array, "a b"], core: Bool[Array, "a b"], border: Bool[Array, "a b"], like_scene: Bool[Array, "a b"]
) -> float:
    """How many pixels of the border show the scene's colour and yet the object's depth, which a stereo camera gives to
    what is beside an edge: less those of the object, of which a share looks like the scene everywhere."""
    own = float(like_scene[core].mean()) if core.any() else 1.0
    strange = float((nearer & border & ~like_scene).sum())
    return max(float((nearer & border & like_scene).sum()) - strange * own / max(1 - own, 1e-3), 0.0)


def _vote(
    hits: Bool[Array, "a b"], core: Bool[Array, "a b"], seen: float, around: Bool[Array, "a b"], s: ForegroundSettings
) -> float:
    """Log-odds of the object, of what `hits` of its core and `seen` of the scene's pixels beside it show."""
    own = (float(hits.sum()) + s.unseen_px / 3) / (float(core.sum()) + s.unseen_px)
    other = (seen + s.unseen_px / 3) / (float(around.sum()) + s.unseen_px)
    return float(np.clip(np.log(own / other), -s.weight_depth, s.weight_depth))


def smooth(
    log_odds: Float32[Array, "h w"], color: Float32[Array, "h w c"], s: ForegroundSettings
) -> Float32[Array, "h w"]:
    """Mean field of an Ising model whose neighbours pull less across edges of colour (of all its channels): -1 (scene)
    to 1 (object)."""
    pulls: list[tuple[int, int, Array]] = []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        step = _length(color - np.roll(color, (-dy, -dx), (0, 1)))
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
    at = window_around(rough, s.band_outside_px + s.ring_px + 1)
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


def around(mask: Bool[Array, "h w"], margin_px: int = 0) -> Bool[Array, "h w"]:
    """The pixels of that box."""
    out, at = np.zeros_like(mask), window_around(mask, margin_px)
    if at is not None:
        out[at] = True
    return out


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


def cut(scene: StaticScene, at: Window) -> StaticScene:
    """A window of the static scene."""
    return StaticScene(
        scene.depth_m[at],
        scene.depth_sigma_m[at],
        scene.color_rgb[at],
        scene.color_sigma[at],
        scene.known[at],
        scene.table_depth_m[at],
    )
