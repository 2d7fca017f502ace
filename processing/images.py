"""What vision works on in each toss: as it was recorded, or with the learned shape drawn into it (D'', M'').

The second pass is the first one on other images: stages that track, register and learn the field know no difference.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int64
from numpy import ndarray as Array

from processing.field.learn import TossViews
from processing.run import CAMERA, Run, toss_keys
from processing.segment.robot.of_session import Rig
from processing.sensor.frames import metric_frames
from processing.sensor.still import whole_session
from processing.store import Done
from recordings.records import RgbdFrame
from recordings.results.folder import RobotMasks, read_hand, read_masks
from recordings.session import RgbdFrames
from recordings.tracks import ObjectTrack


@dataclass(frozen=True, eq=False)
class TossImages:
    """The images of one toss. `frames`: colour and depth in true metres; `masks`, `confidence` (0..1): the object's
    pixels in each; `hand`: camera_from_hand while a robot may hold the object (NaN where not); `robot`: what may stand
    before the object; `colorless`: pixels of the masks whose colour is not the object's."""

    frames: Sequence[RgbdFrame]
    depth_times_ns: Int64[Array, " n"]
    masks: Sequence[Bool[Array, "h w"]]
    confidence: Float[Array, " n"]
    hand: Float[Array, "n 4 4"] | None
    robot: RobotMasks | None
    colorless: Sequence[Bool[Array, "h w"]] | None = None

    def views(self, track: ObjectTrack) -> TossViews:
        """The toss as the field sees it."""
        return TossViews(self.frames, self.depth_times_ns, self.masks, track, self.colorless, self.robot)


@dataclass(frozen=True, eq=False)
class Images:
    """The images of one toss, opened when a stage needs them; `inputs`: keys of what they are made from."""

    toss: int
    inputs: Mapping[str, str]
    open: Callable[[], TossImages]


def raw_images(run: Run, toss: int, rig: Done, masks: Done) -> Images:
    """A toss as it was recorded, with depth in true metres and the stage `segment`'s masks."""

    def opened() -> TossImages:
        frames = toss_frames(run, toss, rig)
        seen = read_masks(masks.folder, toss)
        hand, robot = read_hand(masks.folder, toss), RobotMasks.of(masks.folder, toss)
        return TossImages(frames, frames.depth_times_ns, seen, seen.confidence, hand, robot)

    return Images(toss, {"masks": masks.key, **toss_keys(run, toss)}, opened)


def toss_frames(run: Run, toss: int, rig: Done) -> RgbdFrames:
    """A toss's frames, decoded when asked for, with the depth camera's scale taken out."""
    return metric_frames(run.session.toss(toss).rgbd(CAMERA), Rig.read(rig.folder).depth_scale)


def every_frame(run: Run, toss: int, rig: Done) -> RgbdFrames:
    """The same of every frame that was recorded, where the run works on some of them only (`sensor/still.py`)."""
    whole = whole_session(run.session).toss(toss).rgbd(CAMERA)
    return metric_frames(whole, Rig.read(rig.folder).depth_scale)


def track_and_image_keys(tracks: Mapping[int, Done], images: Mapping[int, Images]) -> dict[str, str]:
    """`track_XX` and what that toss's images are made from: its own (`masks_XX`, `drawn_XX`), and what all share
    (`shape`)."""
    found: dict[str, str] = {}
    for toss, done in tracks.items():
        found[f"track_{toss:02d}"] = done.key
        for name, key in images[toss].inputs.items():
            found[f"{name}_{toss:02d}" if name in ("masks", "drawn") else name] = key
    return found
