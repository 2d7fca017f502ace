"""The first stages of one toss, for a look at it while its session is still recorded (`processing/live`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from processing.images import TossImages, raw_images
from processing.run import CAMERA, Run
from processing.sensor.still import Kept, ThinnedSession
from processing.stages.lose import without_lost
from processing.stages.masks.find import find_object
from processing.stages.masks.segment import segment
from processing.stages.recording.rig import RigResult, refine_rig
from processing.stages.recording.scene import SceneResult, learn_static_scene
from processing.stages.recording.still import without_waiting
from processing.store import Done

Step = Callable[[str], None]
"""Told before each step; raises what ends the work (the toss was taken away)."""


@dataclass(frozen=True, eq=False)
class Shared:
    """What the tosses of a session have in common."""

    scene: Done[SceneResult]
    rig: Done[RigResult]

    @staticmethod
    def of(run: Run) -> Shared:
        """Learned from the tosses of this run."""
        scene = learn_static_scene(run)
        return Shared(scene, refine_rig(run, scene))

    def with_scene_of(self, run: Run) -> Shared:
        """The static scene learned again, from the tosses of this run."""
        return replace(self, scene=learn_static_scene(run))


def masked(run: Run, toss: int, shared: Shared, step: Step) -> tuple[Run, TossImages]:
    """The toss's images with the object's masks. Raises BadInput where the object is not found in it."""
    step("masks")
    found = find_object(run, shared.scene, shared.rig)
    masks = segment(run, toss, shared.scene, shared.rig, found)
    run = without_lost(run, {toss: masks})
    return run, raw_images(run, toss, shared.rig, masks).open()


def thrown_frames(run: Run, toss: int, before_release_s: float, after_rest_s: float, least: int) -> Run:
    """The run with the frames from shortly before the release until the rest, where the recorder has seen both; else
    with few frames of every still stretch, as the pipeline has it."""
    recorded = run.session.toss(toss)
    window, times_ns = recorded.window(), recorded.rgbd(CAMERA).times_ns
    if window.release_time_ns is None or window.rest_time_ns is None:
        return without_waiting(run)
    first = np.searchsorted(times_ns, window.release_time_ns - round(before_release_s * 1e9))
    last = np.searchsorted(times_ns, window.rest_time_ns + round(after_rest_s * 1e9))
    positions = np.arange(first, min(int(last), len(times_ns)), dtype=np.int64)
    if len(positions) < least:
        return without_waiting(run)
    like = np.clip(np.arange(len(times_ns)) - int(first), 0, len(positions) - 1)
    kept = {toss: Kept(positions, like)}
    return replace(run, session=ThinnedSession(run.session, kept), kept=kept)
