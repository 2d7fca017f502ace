"""Masks without learned weights: what differs from the static scene, followed through the toss by its motion.

Where other things touch the object (a hand, a stick), or not even the table's place is known of the scene behind it,
the object's own colours, its depth and its last place decide instead.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.segment.background.follow import BackgroundSettings, RobotCues, component_in, follow, reach_px
from processing.segment.background.foreground import grown, moved_pixels, refine_border
from processing.segment.background.memory import Found, Memory, remember
from processing.segment.background.others import things_near
from processing.segment.background.static_scene import (
    StaticScene,
    bare_table,
    colorless,
    leveled,
    surroundings,
    with_object_removed,
)
from processing.segment.detect.candidates import Finder
from processing.segment.detect.detection import Detection, FindSettings, appearance_of, detections, tracklets_of
from processing.segment.robot.frames import RobotFrames, robot_likeness, with_robot
from processing.segment.segmenter import Example, FrameMask
from processing.sensor.noise import stereo_sigma_m
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.records import RgbdFrame

NOT_FOUND = (
    "no mask of the object was given, and nothing in these frames moves in front of the static scene as a tossed "
    "object does. Wanted: a mask of the first frame (mask_first.png in the folder layout, masks/ in BundleSDF's; for a "
    "recorded session `toss-session export folder SESSION DIR`, draw DIR/toss_00/mask_first.png, `toss-session import "
    "folder DIR OUT`, then `--masks first-toss`), or a recording in which the object moves in front of a camera that "
    "stands still"
)
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
        detection: Detection | None = None,
        gravity: Float[Array, "3"] | None = None,
        find: FindSettings | None = None,
    ) -> None:
        """`drawn`: the robot in every frame of the toss, where it is known; it holds more than its pixels alone.
        `detection`: where the toss shows the object, used where no mask is given; without it the object is looked for
        in the toss alone. `gravity`: its direction in the camera frame, where that is known."""
        self._scene = scene
        self._camera = camera
        self._settings = replace(settings, foreground=settings.foreground.for_camera(camera))
        self._drawn = drawn
        self._detection, self._gravity, self._find_settings = detection, gravity, find or FindSettings()
        self.counts = {"badly_exposed": 0, "others_moving": 0}
        """Frames whose colours are of no use, and frames in which something else of the object's size moves."""

    def masks(
        self,
        frames: Sequence[RgbdFrame],
        given: Mapping[int, Bool[Array, "h w"]],
        example: Example | None,
        robot: Sequence[Bool[Array, "h w"]] | None,
        progress: Progress,
    ) -> Iterator[FrameMask]:
        """Yield a mask for every frame: the clearest known one, then those after it, then those before it; at last
        those that the object came back in."""
        given = {i: _checked(m, i, frames[0].depth_m.shape) for i, m in given.items() if i < len(frames)}
        detection = None if given else self._detection or self._find(frames, example)
        if detection is None:
            start = min(given)
            seed = Found(given[start], 1.0)
            self._refuse_scene(self._leveled(frames[start])[0], seed.mask, start)
        else:
            start = detection.start
            seed = self._outlined(frames[start], start, detection.masks[start], robot)
        yield FrameMask(start, seed.mask, seed.confidence)
        mine = set(range(len(frames))) if detection is None else detection.belongs_to(start, len(frames))
        empty = {i: FrameMask(i, np.zeros_like(seed.mask), 0.0) for i in range(len(frames)) if i not in mine}
        done = 1
        for i, found, lit in self._both_ways(frames, start, seed, given, robot, mine - {start}):
            self._count(found, lit)
            done += 1
            progress.step(done, len(frames), "masks")
            mask = FrameMask(i, found.mask, found.confidence)
            if found.mask.any() or detection is None:
                yield mask
            else:
                empty[i] = mask
        for i in () if detection is None else detection.again:
            for k, found in self._redetected(frames, i, detection, robot, set(empty)) if detection else ():
                del empty[k]
                yield FrameMask(k, found.mask, found.confidence)
        yield from empty.values()

    def _both_ways(
        self,
        frames: Sequence[RgbdFrame],
        start: int,
        seed: Found,
        given: Mapping[int, Bool[Array, "h w"]],
        robot: Sequence[Bool[Array, "h w"]] | None,
        within: set[int],
    ) -> Iterator[tuple[int, Found, bool]]:
        """Follow the object from a frame on, then from it back, as far as `within` reaches without a gap. Yields the
        position, what was found, and whether the frame is well lit."""
        first, s = self._leveled(frames[start])[0], self._settings
        scene = self._scene_without(first, seed.mask)
        others = self._held(first, scene, seed.mask, None if robot is None else robot[start])
        for order in (range(start + 1, len(frames)), range(start - 1, -1, -1)):
            memory = remember(None, first, replace(seed, others=others))
            if self._detection is not None:
                memory = replace(memory, likeness=memory.likeness.with_shares(self._detection.shares))
            for i in order:
                if i not in within:
                    break
                block = None if robot is None else robot[i]
                frame, lit = self._leveled(frames[i])
                found = Found(given[i], 1.0) if i in given else self._followed(frame, i, scene, memory, block, lit)
                memory = remember(memory, frame, found, learn=lit and found.confidence > s.sure)
                yield i, found, lit

    def _held(
        self, frame: RgbdFrame, scene: StaticScene, mask: Bool[Array, "h w"], robot: Bool[Array, "h w"] | None
    ) -> Bool[Array, "h w"] | None:
        """What is neither scene nor a known robot and stands beside the object, as a hand does."""
        s = self._settings
        if self._drawn is not None:
            return None
        around = grown(mask, reach_px(float(mask.sum()), 1)) & ~mask
        solid = moved_pixels(frame, scene, s.foreground) & around
        solid = solid if robot is None else solid & ~robot
        return things_near(frame, scene, solid, mask, s.foreground, s.least_px)

    def _redetected(
        self,
        frames: Sequence[RgbdFrame],
        start: int,
        detection: Detection,
        robot: Sequence[Bool[Array, "h w"]] | None,
        empty: set[int],
    ) -> Iterator[tuple[int, Found]]:
        """The object where it is seen in frames in which following did not find it."""
        if start not in empty:
            return
        seed = self._outlined(frames[start], start, detection.masks[start], robot)
        if not seed.mask.any():
            return
        empty = empty & detection.belongs_to(start, len(frames))
        yield start, seed
        for i, found, _ in self._both_ways(frames, start, seed, {}, robot, empty - {start}):
            if found.mask.any():
                yield i, found

    def _leveled(self, frame: RgbdFrame) -> tuple[RgbdFrame, bool]:
        """The frame as bright as the scene, and whether its colours are accepted at all."""
        s = self._settings
        return leveled(frame, self._scene, s.darkest, s.most_clipped, s.least_gain)

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
        cues = RobotCues(odds, unknown)
        return follow(frame, with_robot(scene, frame, seen, s), memory, certain, cues, self._settings)

    def _scene_without(self, frame: RgbdFrame, mask: Bool[Array, "h w"]) -> StaticScene:
        moved = moved_pixels(frame, self._scene, self._settings.foreground) | bare_table(self._scene)
        stands_out = (moved & mask).sum() >= self._settings.part_of_scene * mask.sum()
        unknown = (self._scene.unknown & surroundings(mask)).sum()
        # with a robot the scene is learned behind what it holds: what is unknown there lies behind the robot itself
        if stands_out and (self._drawn is not None or unknown <= self._settings.unknown * mask.sum()):
            return self._scene
        return with_object_removed(self._scene, frame, mask, moved, self._camera)

    def _outlined(
        self,
        frame: RgbdFrame,
        position: int,
        rough: Bool[Array, "h w"],
        robot: Sequence[Bool[Array, "h w"]] | None,
    ) -> Found:
        """What was found roughly, with its border drawn; as it is where nothing stands out there."""
        s, (frame, lit) = self._settings, self._leveled(frame)
        scene = self._scene if lit else colorless(self._scene)
        block = None if robot is None else robot[position]
        seen = None if self._drawn is None else self._drawn.seen(frame, position)
        if self._drawn is not None and seen is not None:
            scene = with_robot(scene, frame, seen, self._drawn.settings)
            block = seen.certain if block is None else seen.certain | block
        moved = moved_pixels(frame, scene, s.foreground)
        if block is not None:
            moved &= ~block
        mask, sure = refine_border(frame, scene, component_in(moved, rough), None, s.foreground)
        return Found(mask, sure)

    def _find(self, frames: Sequence[RgbdFrame], example: Example | None) -> Detection:
        """The object in this toss alone."""
        if self._camera is None:
            raise BadInput("no mask of the object was given, and the camera's intrinsics are not known")
        finder = Finder(self._scene, self._camera, self._find_settings.things)
        drawn = None if self._drawn is None else self._drawn.coarser(finder.stride)
        tracklets = tracklets_of(finder, frames, drawn, self._gravity, self._find_settings)
        known = None if example is None else appearance_of(example, self._camera)
        shape = frames[0].depth_m.shape
        found = detections({0: tracklets}, known, shape, finder.stride, self._find_settings)
        if not found:
            raise BadInput(NOT_FOUND)
        self._detection = found[0]
        return found[0]


def _checked(mask: Bool[Array, "h w"], position: int, shape: tuple[int, ...]) -> Bool[Array, "h w"]:
    if mask.shape != shape:
        raise BadInput(
            f"the given mask of frame {position} is {mask.shape[::-1]}, the image {shape[::-1]}; wanted the same size"
        )
    if not mask.any():
        raise BadInput(f"the given mask of frame {position} is empty; wanted the object's pixels, or no mask at all")
    return mask
