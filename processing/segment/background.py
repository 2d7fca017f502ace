"""Masks without learned weights: what differs from the static scene, followed through the toss by its motion.

Where other things touch the object (a hand, a stick) or the scene behind it was never seen, the object's own colours,
its depth and its last place decide instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Bool
from numpy import ndarray as Array

from processing.segment.follow import BackgroundSettings, Beside, Found, Memory, follow, remember
from processing.segment.foreground import moved_pixels, refine_border
from processing.segment.likeness import Likeness
from processing.segment.robot_frames import RobotFrames, robot_likeness, with_robot
from processing.segment.segmenter import Example, FrameMask
from processing.segment.static_scene import (
    StaticScene,
    colorless,
    exposure_gain,
    stereo_sigma_m,
    surroundings,
    with_object_removed,
)
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.records import RgbdFrame

OBJECT_LIKE = 0.7
"""Log-odds of the object's colours against the robot's from which a pixel is not certainly the robot."""


class BackgroundSegmenter:
    """Segmenter for a camera that stands still. See `Segmenter`."""

    name = "background"

    def __init__(
        self,
        scene: StaticScene,
        camera: CameraModel | None,
        settings: BackgroundSettings,
        drawn: RobotFrames | None = None,
    ) -> None:
        """`drawn`: the robot in every frame of the toss, where it is known; it says more than its pixels alone."""
        self._scene = scene
        self._camera = camera
        self._settings = settings
        self._drawn = drawn
        self.counts = {"badly_exposed": 0, "others_moving": 0}
        """Frames whose colours say nothing, and frames in which something else of the object's size moves."""

    def masks(
        self,
        frames: Sequence[RgbdFrame],
        given: Mapping[int, Bool[Array, "h w"]],
        example: Example | None,
        robot: Sequence[Bool[Array, "h w"]] | None,
        progress: Progress,
    ) -> Iterator[FrameMask]:
        """Yield a mask for every frame: the first known one, then those after it, then those before it."""
        shape = frames[0].depth_m.shape
        given = {i: _checked(m, i, shape) for i, m in given.items() if i < len(frames)}
        start = min(given) if given else None
        if start is None:
            start, first = self._find(frames, example, robot)
        else:
            first = given[start]
            self._refuse_scene(self._leveled(frames[start])[0], first, start)
        s, scene = self._settings, self._scene_without(self._leveled(frames[start])[0], first)
        yield FrameMask(start, first, 1.0 if start in given else 0.8)
        done = 1
        for order in (range(start + 1, len(frames)), range(start - 1, -1, -1)):
            memory = remember(None, self._leveled(frames[start])[0], Found(first, 1.0))
            for i in order:
                block = None if robot is None else robot[i]
                frame, lit = self._leveled(frames[i])
                found = Found(given[i], 1.0) if i in given else self._followed(frame, i, scene, memory, block, lit)
                memory = remember(memory, frame, found, learn=lit and found.confidence > s.sure)
                self._count(found, lit)
                done += 1
                progress.step(done, len(frames), "masks")
                yield FrameMask(i, found.mask, found.confidence)

    def _leveled(self, frame: RgbdFrame) -> tuple[RgbdFrame, bool]:
        """The frame as bright as the scene, and whether its colours can be believed at all."""
        gain, clipped = exposure_gain(frame, self._scene)
        s = self._settings
        if not (s.darkest < gain < 1 / s.darkest and clipped < s.most_clipped):
            return frame, False
        if abs(gain - 1) < s.least_gain:
            return frame, True
        table = np.clip(np.arange(256) / gain, 0, 255).round().astype(np.uint8)
        return replace(frame, color_rgb=table[frame.color_rgb]), True

    def _count(self, found: Found, lit: bool) -> None:
        self.counts["badly_exposed"] += int(not lit)
        most = self._settings.other_share * max(int(found.mask.sum()), 1)
        self.counts["others_moving"] += int(found.largest_other_px > most)

    def _refuse_scene(self, frame: RgbdFrame, mask: Bool[Array, "h w"], position: int) -> None:
        """A mask that shows the table or the wall, where nothing stands out, is a mistake."""
        moved = moved_pixels(frame, self._scene, self._settings.foreground)
        known = mask & self._scene.known & (frame.depth_m > 0)
        table = self._scene.table_depth_m
        flat = known & (table > 0) & (np.abs(frame.depth_m - table) < np.maximum(0.006, 3 * stereo_sigma_m(table)))
        on_table = flat.sum() > self._settings.table_share * mask.sum()
        if on_table and (moved & mask).sum() < (1 - self._settings.table_share) * mask.sum():
            raise BadInput(
                f"the given mask of frame {position} shows the table: {100 * flat.sum() / mask.sum():.0f} % of it lie "
                "in the table's plane and look like the static scene. Wanted the object's pixels; "
                "`--masks none` finds the object without a given mask"
            )

    def _followed(
        self,
        frame: RgbdFrame,
        i: int,
        scene: StaticScene,
        memory: Memory,
        block: Bool[Array, "h w"] | None,
        lit: bool = True,
    ) -> Found:
        seen = None if self._drawn is None else self._drawn.seen(frame, i)
        if self._drawn is None or seen is None:
            return follow(frame, scene if lit else colorless(scene), memory, block, None, self._settings)
        s = self._drawn.settings
        odds = robot_likeness(frame, seen, memory.likeness, self._drawn.shares, s) * np.float32(lit)
        unknown = ~scene.known & (seen.at_color_m == 0)
        scene = scene if lit else colorless(scene)
        certain = seen.certain & (odds < OBJECT_LIKE)
        certain = certain if block is None else certain | block
        beside = Beside(odds, unknown)
        return follow(frame, with_robot(scene, frame, seen, s), memory, certain, beside, self._settings)

    def _scene_without(self, frame: RgbdFrame, mask: Bool[Array, "h w"]) -> StaticScene:
        moved = moved_pixels(frame, self._scene, self._settings.foreground)
        stands_out = (moved & mask).sum() >= self._settings.part_of_scene * mask.sum()
        unknown = (~self._scene.known & surroundings(mask)).sum()
        # with a robot the scene is learned behind what it holds: what is unknown there lies behind the robot itself
        if stands_out and (self._drawn is not None or unknown <= self._settings.unknown * mask.sum()):
            return self._scene
        return with_object_removed(self._scene, frame, mask, moved, self._camera)

    def _find(
        self, frames: Sequence[RgbdFrame], example: Example | None, robot: Sequence[Bool[Array, "h w"]] | None
    ) -> tuple[int, Bool[Array, "h w"]]:
        """The first frame in which something stands out from the scene, and its mask."""
        known = None if example is None else Likeness.of(example.frame.color_rgb, example.mask)
        for i in range(len(frames)):
            frame, lit = self._leveled(frames[i])
            block = None if robot is None else robot[i]
            scene = self._scene if lit else colorless(self._scene)
            seen = None if self._drawn is None else self._drawn.seen(frame, i)
            if self._drawn is not None and seen is not None:
                scene = with_robot(scene, frame, seen, self._drawn.settings)
                block = seen.certain if block is None else seen.certain | block
            rough = _best_candidate(frame, scene, known if lit else None, block, self._settings)
            if rough is not None:
                return i, refine_border(frame, scene, rough, None, self._settings.foreground)[0]
        raise BadInput(
            "no mask of the object was given, and in no frame does anything stand out from the static scene. "
            "Wanted: a mask of the first frame (mask_first.png in the folder layout, masks/ in BundleSDF's), "
            "or a recording in which the object moves in front of a camera that stands still"
        )


def _checked(mask: Bool[Array, "h w"], position: int, shape: tuple[int, ...]) -> Bool[Array, "h w"]:
    if mask.shape != shape:
        raise BadInput(
            f"the given mask of frame {position} is {mask.shape[::-1]}, the image {shape[::-1]}; wanted the same size"
        )
    if not mask.any():
        raise BadInput(f"the given mask of frame {position} is empty; wanted the object's pixels, or no mask at all")
    return mask


def _best_candidate(
    frame: RgbdFrame,
    scene: StaticScene,
    known: Likeness | None,
    block: Bool[Array, "h w"] | None,
    s: BackgroundSettings,
) -> Bool[Array, "h w"] | None:
    """The component most likely to be the object: large, of known colours, in view as a whole, above the table."""
    moved = moved_pixels(frame, scene, s.foreground)
    if block is not None:
        moved &= ~block
    if scene.table_depth_m.any():
        below = (scene.table_depth_m > 0) & (frame.depth_m > scene.table_depth_m + s.foreground.nearer_m)
        moved &= ~below
    count, labels, stats, _ = cv2.connectedComponentsWithStats(moved.astype(np.uint8), connectivity=4)
    best, best_score = None, 0.0
    odds = None if known is None else known.log_odds(frame.color_rgb)
    height, width = moved.shape
    for k in range(1, count):
        left, top, w, h, area = stats[k]
        mask = labels == k
        if area < s.least_px or (frame.depth_m[mask] > 0).mean() < 0.3:
            continue
        cut = left == 0 or top == 0 or left + w == width or top + h == height
        alike = 1.0 if odds is None else float(np.exp(odds[mask].mean()))
        score = float(area) * alike * (0.2 if cut else 1.0)
        if score > best_score:
            best, best_score = mask, score
    return best
