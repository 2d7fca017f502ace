"""A mask drawn anew by what all of a session's masks show of the object: what one frame got wrong, the others know.

Each frame's pixels are judged by a network that learned from other frames (self-training, cross-fitted): an object as
dark as its shadow, or half in the scene's colour, is told apart by what it looked like elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int32
from numpy import ndarray as Array

from processing.segment.background.follow import BackgroundSettings
from processing.segment.background.foreground import (
    Window,
    cut,
    fill_holes,
    grown,
    nearer_than_scene,
    scene_colored,
    smooth,
    window_around,
)
from processing.segment.background.static_scene import StaticScene, leveled
from processing.segment.learned.again import AgainSettings, Judged, support_of
from processing.segment.learned.network import NetworkSettings, PixelNetwork, log_share
from processing.segment.learned.pixels import pixel_features
from recordings.records import RgbdFrame


@dataclass(frozen=True)
class LearnedSettings:
    """How far a mask may change, and by what."""

    network: NetworkSettings = field(default_factory=NetworkSettings)
    again: AgainSettings = field(default_factory=AgainSettings)
    reach: float = 0.6
    """Pixels are judged this far around a mask, in sizes of the object (the root of its area), and ..."""
    reach_px: int = 12
    size_frames: int = 15
    """The object is as large as its masks so many frames before and after, in the median."""
    least_px: int = 60
    """A smaller mask stays as it is."""
    most_odds: float = 4.0
    """The most that a pixel's colours say (log-odds)."""
    mask_odds: float = 0.5
    """What the mask itself says of a pixel, ..."""
    deeper: float = 0.5
    """... more so for every pixel inside of its border, ..."""
    deepest_px: float = 4.0
    beyond: float = 6.0
    """... and outside of it for every size of the object beyond `border_px`."""
    border_px: float = 2.0
    least_piece: float = 0.1
    """A piece smaller than this share of the largest one is a speck (more often of a finger than of the object), ..."""
    least_alike: float = 0.5
    """... unless its log-odds are this share of the largest one's: a corner behind a finger looks like the object."""
    blocks: int = 6
    """So many frames in a row go to the same half: what is learned of one half judges the other."""
    most_frames: int = 240
    """As many frames of a session, spread over it, are learned from at most."""


@dataclass(frozen=True, eq=False)
class Look:
    """The surroundings of a mask in one frame. `others`: pixels of things that are neither object nor scene."""

    at: Window
    mask: Bool[Array, "a b"]
    size_px: float
    color: Float32[Array, "a b 3"]
    features: Float32[Array, "a b f"]
    others: Bool[Array, "a b"]


def half_of(toss: int, position: int, s: LearnedSettings) -> int:
    """Which of two halves a frame belongs to."""
    return (toss + position // s.blocks) % 2


def sizes_px(areas_px: Sequence[int], s: LearnedSettings) -> Float[Array, " n"]:
    """How large the object is in each frame, as the frames around have it: one mask may be cut off, or hold more."""
    own = np.sqrt(np.asarray(areas_px, dtype=np.float64))
    large = own**2 >= s.least_px
    sizes = own.copy()
    for i in range(len(own)):
        around = slice(max(i - s.size_frames, 0), i + s.size_frames + 1)
        seen = own[around][large[around]]
        sizes[i] = float(np.median(seen)) if len(seen) else own[i]
    return sizes


def features_in(
    frame: RgbdFrame, scene: StaticScene, at: Window, background: BackgroundSettings
) -> Float32[Array, "a b f"]:
    """Features of the pixels of a window, in a frame made as bright as the scene."""
    frame, _ = leveled(frame, scene, background.darkest, background.most_clipped, background.least_gain)
    color = frame.color_rgb[at].astype(np.float32)
    return pixel_features(color, frame.depth_m[at], cut(scene, at), background.foreground)


def look(
    frame: RgbdFrame,
    scene: StaticScene,
    mask: Bool[Array, "h w"],
    size_px: float,
    robot: Bool[Array, "h w"] | None,
    background: BackgroundSettings,
    s: LearnedSettings,
) -> Look | None:
    """What there is to judge in a frame; None where the mask is too small, or its colours are of no use."""
    if mask.sum() < s.least_px:
        return None
    frame, lit = leveled(frame, scene, background.darkest, background.most_clipped, background.least_gain)
    at = window_around(mask, int(s.reach * size_px) + s.reach_px)
    if not lit or at is None:
        return None
    color, depth_m, part = frame.color_rgb[at].astype(np.float32), frame.depth_m[at], cut(scene, at)
    features = pixel_features(color, depth_m, part, background.foreground)
    strange = part.known & ~scene_colored(frame, scene, at, background.foreground)
    others = _others(strange | nearer_than_scene(depth_m, part, background.foreground), mask[at])
    if robot is not None:
        others |= robot[at] & ~mask[at]
    return Look(at, mask[at], size_px, color, features, others)


def _others(strange: Bool[Array, "a b"], mask: Bool[Array, "a b"]) -> Bool[Array, "a b"]:
    """What is no scene in any shade, lies beside the mask, and reaches out of the window, as hands and arms do: whoever
    followed the object has seen it and left it out."""
    found = strange & ~grown(mask, 2)
    opened = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, areas, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    edge = np.concatenate([labels[:2].ravel(), labels[-2:].ravel(), labels[:, :2].ravel(), labels[:, -2:].ravel()])
    kept = (np.bincount(edge, minlength=count) >= EDGE_PX) & (areas[:, cv2.CC_STAT_AREA] > SPECK_PX)
    kept[0] = False
    return grown(kept[labels], 1) & ~mask


EDGE_PX, SPECK_PX = 6, 25
"""A thing reaches out of the window where so many of its pixels lie within two of the window's edge; smaller ones are
specks."""


def redrawn(
    seen: Look, network: PixelNetwork, shape: tuple[int, ...], background: BackgroundSettings, s: LearnedSettings,
    rough: bool = False,
) -> Judged:  # fmt: skip
    """The mask anew in an image of that shape, of what is connected with the old one. `rough`: that says where to look,
    and nothing of its pixels."""
    inside = cv2.distanceTransform(seen.mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~seen.mask).astype(np.uint8), cv2.DIST_L2, 5)
    looks = network.log_odds(seen.features)
    if rough:  # as much of the window is the object's
        share = float(seen.mask.sum() + 1) / float((~seen.mask).sum() + 1)
        odds = np.clip(looks + np.log(share), -s.most_odds, s.most_odds)
    else:
        odds = np.clip(looks + log_share(seen.mask, outside, s.network), -s.most_odds, s.most_odds)
        odds = odds + np.where(seen.mask, s.mask_odds + s.deeper * np.minimum(inside, s.deepest_px), -s.mask_odds)
    odds = odds - s.beyond * np.maximum(outside - s.border_px, 0.0) / seen.size_px
    odds = np.where(seen.others, -8.0, odds).astype(np.float32)
    belief = smooth(odds, seen.color, background.foreground)
    kept, labels = _pieces(belief > 0, looks, seen.mask, s)
    part = fill_holes(kept[labels]) & ~seen.others if kept.any() else seen.mask
    border = grown(part, 2) & ~(cv2.erode(part.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)
    mask = np.zeros(shape[:2], dtype=bool)
    mask[seen.at] = part
    sure = float(np.abs(belief[border]).mean()) if kept.any() and border.any() else 0.0
    return Judged(mask, sure, support_of(looks, seen.mask))


def _pieces(
    found: Bool[Array, "a b"], looks: Float32[Array, "a b"], mask: Bool[Array, "a b"], s: LearnedSettings
) -> tuple[Bool[Array, " n"], Int32[Array, "a b"]]:
    """Which pieces of what was found are the object's, and the piece of every pixel (0: none)."""
    count, labels, areas, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8), connectivity=4)
    sizes = areas[:, cv2.CC_STAT_AREA] * (np.bincount(labels[mask], minlength=count) > 0)
    sizes[0] = 0
    alike = np.bincount(labels.ravel(), looks.ravel(), count) / np.maximum(areas[:, cv2.CC_STAT_AREA], 1)
    largest = int(sizes.argmax())
    whole = sizes >= s.least_piece * sizes[largest]
    return (sizes >= SPECK_PX) & (whole | (alike >= s.least_alike * alike[largest])), labels.astype(np.int32)
