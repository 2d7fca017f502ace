"""The frames that tracking and the field look at: as recorded, with the depth camera's scale taken out."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from processing.segment.background.depth_scale import corrected_depth
from processing.sensor.still import whole_session
from processing.stages.masks import static_scene
from processing.stages.rig import CAMERA, Rig, rig_stage
from recordings.records import RgbdFrame
from recordings.session import RgbdFrames

if TYPE_CHECKING:
    from processing.pipeline import Run


def corrected_frames(run: Run, toss: int) -> RgbdFrames:
    """A toss's frames, decoded when asked for, with depth in true metres: reported / scale (see processing.stages.rig).

    Runs the stages `scene` and `rig`, or reads them. Where the scale is not significantly another, depth stays.
    What depends on these frames depends on the stage `rig`; masks carry its key.
    """
    return with_depth_scale(run.session.toss(toss).rgbd(CAMERA), depth_scale(run))


def every_frame(run: Run, toss: int) -> RgbdFrames:
    """The same of every frame that was recorded, where the run works on some of them only (see processing.sensor.still)."""
    return with_depth_scale(whole_session(run.session).toss(toss).rgbd(CAMERA), depth_scale(run))


def depth_scale(run: Run) -> float:
    """Reported / true depth, as used: 1.0 where nothing significant is known."""
    return Rig.read(rig_stage(run, static_scene(run)).folder).depth_scale


def with_depth_scale(frames: RgbdFrames, scale: float) -> RgbdFrames:
    """The same frames with depth divided by `scale`; the very same where it is 1."""
    if scale == 1.0:
        return frames

    def load(i: int) -> RgbdFrame:
        frame = frames[i]
        return replace(frame, depth_m=corrected_depth(frame.depth_m, scale))

    return RgbdFrames(frames.times_ns, load, frames.depth_times_ns, frames.without_depth, frames.unused_depth)
