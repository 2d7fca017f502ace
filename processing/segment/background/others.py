"""What stands beside the object and is no scene, a hand or a stick: told apart from it by where both were."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.segment.background.color_model import MEMORY, Likeness, color_shares, shares_log_odds
from processing.segment.background.foreground import (
    ForegroundSettings,
    grown,
    kernel,
    scene_colored,
    smooth,
    window_around,
)
from processing.segment.background.placement import best_shift, shifted
from processing.segment.background.static_scene import StaticScene, most_of_channels
from recordings.records import RgbdFrame

PLACE_PX = 5.0
"""A pixel so much nearer to where the one is expected than to where the other is speaks for it by one nat ..."""
MOST_PLACE = 3.0
"""... and by no more than this: both may have turned."""
OWN_NATS = 1.6
"""A colour that the object shows five times as often as its surroundings is its own, also where it may be a shade of
the scene's: a dark bottle is, of any table."""
DEPTH_EDGE_M = 0.02
"""A step of depth this large between neighbours cuts their pull as a strong edge of colour does."""


@dataclass(frozen=True, eq=False)
class Others:
    """All other things near the object in the last frame, as one: their pixels and how often they show each colour."""

    mask: Bool[Array, "h w"]
    shares: Float[Array, " b"]

    @staticmethod
    def seen(frame: RgbdFrame, mask: Bool[Array, "h w"] | None, before: Others | None) -> Others | None:
        """What is known of them after a frame; None where nothing stands beside the object."""
        if mask is None or not mask.any():
            return None
        shares = color_shares(frame.color_rgb, mask)
        return Others(mask, shares if before is None else MEMORY * before.shares + (1 - MEMORY) * shares)


def things_near(
    frame: RgbdFrame,
    scene: StaticScene,
    solid: Bool[Array, "h w"],
    mask: Bool[Array, "h w"],
    s: ForegroundSettings,
    least_px: int,
) -> Bool[Array, "h w"] | None:
    """What of some pixels is a thing of its own, and not only the rim that a stereo camera adds to what is near: it has
    another colour than the scene that is known there, somewhere it is wider than such a rim, and most of it lies
    farther from the object's mask than a rim does. None where it is smaller than `least_px`."""
    at = window_around(solid, 0)
    if at is None or solid.sum() <= least_px:
        return None
    seen = (solid & scene.known)[at] & ~scene_colored(frame, scene, at, s)
    seen = seen.astype(np.uint8)
    wide = cv2.morphologyEx(seen, cv2.MORPH_OPEN, kernel(max(1, s.band_inside_px // 2))) > 0
    count, labels = cv2.connectedComponents(seen, connectivity=4)
    sizes = np.bincount(labels.ravel(), minlength=count)
    close = np.bincount(labels[grown(mask, s.band_inside_px)[at]], minlength=count)
    apart = np.isin(np.arange(count), labels[wide]) & (close < 0.5 * sizes)
    kept = apart[labels] & (seen > 0)
    if kept.sum() <= least_px:
        return None
    out = np.zeros_like(solid)
    out[at] = kept
    return out


def without_others(
    frame: RgbdFrame,
    scene: StaticScene,
    moved: Bool[Array, "h w"],
    expected: Bool[Array, "h w"],
    way_px: Float[Array, "2"],
    others: Others,
    likeness: Likeness,
    reach_px: int,
    s: ForegroundSettings,
) -> Bool[Array, "h w"]:
    """The moved pixels near the object that are its own.

    `expected` is where the object is expected, `way_px` (x, y) how far it has come since the last frame: the others
    came with it, or stayed where they were. Colours that only one of them showed speak for it; a border between two who
    that look alike stays where it was. What shows the scene's colour is the object's only where that is expected.
    """
    out = np.zeros_like(moved)
    at = window_around(expected | others.mask, reach_px)
    if at is None:
        return out
    odds = shares_log_odds(frame.color_rgb[at], likeness.object_shares, others.shares)
    score = moved[at] / (1 + np.exp(odds))
    theirs = shifted(others.mask[at], best_shift(score.astype(np.float32), others.mask[at], way_px, 1, reach_px))
    place = np.clip((_away(theirs) - _away(expected[at])) / PLACE_PX, -MOST_PLACE, MOST_PLACE)
    odds = np.where(moved[at], s.weight_likeness * odds + place, 0.0).astype(np.float32)
    depth = np.where(frame.depth_m[at] > 0, frame.depth_m[at], np.float32(0)) * np.float32(s.edge_color / DEPTH_EDGE_M)
    belief = smooth(odds, np.dstack([frame.color_rgb[at].astype(np.float32), depth]), s)
    own = expected[at] | ~scene_colored(frame, scene, at, s) | (likeness.log_odds(frame.color_rgb[at]) > OWN_NATS)
    out[at] = moved[at] & (belief > 0) & own
    return out


def expected_pieces(own: Bool[Array, "h w"], expected: Bool[Array, "h w"], least_px: int) -> Bool[Array, "h w"]:
    """What a hand has cut off the object: pieces of what is its own, most of which lie where it is expected."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(own.astype(np.uint8), connectivity=4)
    inside = np.bincount(labels[expected], minlength=count)
    kept = (stats[:, cv2.CC_STAT_AREA] >= least_px) & (inside > 0.5 * stats[:, cv2.CC_STAT_AREA])
    kept[0] = False
    return np.asarray(kept[labels])


def largest_other(
    frame: RgbdFrame, scene: StaticScene, moved: Bool[Array, "h w"], s: ForegroundSettings, least_px: int
) -> int:
    """Size of the largest thing, away from the object, that is not scene: what looks as the scene always looked there
    has not moved, however its depth flickers."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
    order = 1 + np.argsort(-stats[1:count, cv2.CC_STAT_AREA])
    for k in order:
        if stats[k, cv2.CC_STAT_AREA] < least_px:
            break
        left, top, width, height = stats[k, :4]
        at = np.s_[top : top + height, left : left + width]
        thing = labels[at] == k
        apart = most_of_channels(np.abs(frame.color_rgb[at] - scene.color_rgb[at]))[thing]
        if (apart > np.maximum(s.color_step, 4 * scene.color_sigma[at][thing])).mean() > 0.5:
            return int(stats[k, cv2.CC_STAT_AREA])
    return 0


def _away(mask: Bool[Array, "a b"]) -> Float[Array, "a b"]:
    """How far (px) each pixel lies outside of a mask; negative inside. Nothing lies near an empty one."""
    if not mask.any():
        return np.full(mask.shape, 1e3)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(outside - cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 3), dtype=np.float64)
