"""One finished toss through the pipeline's first stages, with light settings: masks and its track."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from processing.backends import matcher_of
from processing.config import Config
from processing.field.learn import TossViews, chosen_views
from processing.field.views import FieldView
from processing.images import TossImages, raw_images
from processing.live.config import LiveConfig, light
from processing.live.so_far import SessionSoFar
from processing.live.verdict import Seen, what_is_seen
from processing.live.watch import FileId
from processing.run import CAMERA, Run
from processing.sensor.still import Kept, ThinnedSession
from processing.stages.find import find_object
from processing.stages.lose import without_lost
from processing.stages.recording.rig import RigResult, refine_rig
from processing.stages.recording.scene import SceneResult, learn_static_scene
from processing.stages.recording.still import without_waiting
from processing.stages.segment import segment
from processing.store import Done, Store
from processing.track.track_toss import TossTrack, track_toss
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.records import TossWindow
from recordings.session import Session

Step = Callable[[str], None]
"""Told before each step; raises what ends the work (the toss was taken away)."""


@dataclass(frozen=True, eq=False)
class Looked:
    """A toss as it was looked at, in its own object frame. `views`: some frames, as the shape so far is fused from
    them; `window`: what its recorder saw of it."""

    toss: int
    file: FileId
    tracked: TossTrack
    seen: Seen
    views: tuple[FieldView, ...]
    window: TossWindow


@dataclass
class Looker:
    """Looks at one toss after the other; what all of them share (scene, rig) is learned from the first one, and again
    from more when there is time."""

    session: Path
    scratch: Path
    config: Config
    live: LiveConfig
    progress: Callable[[str], Progress]
    scene: Done[SceneResult] | None = None
    rig: Done[RigResult] | None = None
    learned_from: tuple[int, ...] = ()
    files: dict[int, FileId] = field(default_factory=dict)

    def look(self, toss: int, file: FileId, step: Step) -> Looked:
        """Raises BadInput where the object is not found in it, or nothing of it can be tracked."""
        self.files[toss] = file
        session = self._open((toss,))
        try:
            run = self._run(session, (toss,))
            step("scene")
            scene, rig = self._shared(run)
            run = thrown_frames(run, toss, self.live)
            step("masks")
            found = find_object(run, scene, rig)
            masks = segment(run, toss, scene, rig, found)
            run = without_lost(run, {toss: masks})
            step("track")
            images = raw_images(run, toss, rig, masks).open()
            tracked = _track(run, toss, images)
            step("what is seen")
            seen = what_is_seen(images.frames, list(images.masks), self.live)
            window = run.session.toss(toss).window()
            return Looked(toss, file, tracked, seen, self._views(run, tracked, images), window)
        finally:
            session.close()

    def learn_scene_again(self, tosses: tuple[int, ...]) -> None:
        """The static scene from more tosses."""
        session = self._open(tosses)
        try:
            self.scene = learn_static_scene(self._run(session, tosses))
            self.learned_from = tosses
        finally:
            session.close()

    def _open(self, tosses: tuple[int, ...]) -> SessionSoFar:
        whole = Session.open(self.session)
        try:
            return SessionSoFar(whole, tosses)
        finally:
            whole.close()

    def _run(self, session: Session, tosses: tuple[int, ...]) -> Run:
        """Keys are those of this process alone: nothing of it outlives the session."""
        keys = {f"toss_{t:02d}": str(self.files[t]) for t in tosses} | {"calibration": "live", "physics": "live"}
        store = Store(self.scratch)
        return Run(session, tosses, store, light(self.config), "live", "cpu", self.progress, keys)

    def _shared(self, run: Run) -> tuple[Done[SceneResult], Done[RigResult]]:
        if self.scene is None or self.rig is None:
            scene = learn_static_scene(run)
            self.rig, self.scene, self.learned_from = refine_rig(run, scene), scene, run.recorded
        return self.scene, self.rig

    def _views(self, run: Run, tracked: TossTrack, images: TossImages) -> tuple[FieldView, ...]:
        seen: TossViews = images.views(tracked.track)
        try:
            return tuple(chosen_views([seen], run.camera, replace(run.config.shape, most_views=self.live.field_views)))
        except BadInput:
            return ()


def thrown_frames(run: Run, toss: int, live: LiveConfig) -> Run:
    """The run with the frames from shortly before the release until the rest, where the recorder has seen both; else
    with few frames of every still stretch, as the pipeline has it."""
    recorded = run.session.toss(toss)
    window, times_ns = recorded.window(), recorded.rgbd(CAMERA).times_ns
    if window.release_time_ns is None or window.rest_time_ns is None:
        return without_waiting(run)
    first = np.searchsorted(times_ns, window.release_time_ns - round(live.before_release_s * 1e9))
    last = np.searchsorted(times_ns, window.rest_time_ns + round(live.after_rest_s * 1e9))
    positions = np.arange(first, min(int(last), len(times_ns)), dtype=np.int64)
    if len(positions) < live.least_thrown:
        return without_waiting(run)
    like = np.clip(np.arange(len(times_ns)) - int(first), 0, len(positions) - 1)
    kept = {toss: Kept(positions, like)}
    return replace(run, session=ThinnedSession(run.session, kept), kept=kept)


def _track(run: Run, toss: int, images: TossImages) -> TossTrack:
    return track_toss(
        images.frames, images.masks, run.camera, run.config.track, run.progress(f"toss {toss}: poses"),
        toss=toss, confidence=images.confidence, object_frame=f"object_toss_{toss:02d}",
        world_from_camera=run.world_from_camera, matcher=matcher_of(run.config.backends, run.device),
        colorless=images.colorless, hand=images.hand,
    )  # fmt: skip


def thinned(tracked: TossTrack, most: int) -> TossTrack:
    """A toss's track with some of its frames only, spread over the tracked ones: what others are compared with."""
    usable = [i for i, s in enumerate(tracked.track.status) if s == "tracked" and tracked.store.usable(i)]
    if len(usable) <= most:
        return tracked
    at = np.array([usable[i] for i in np.unique(np.linspace(0, len(usable) - 1, most).round().astype(int))])
    track = tracked.track
    few = replace(
        track, time_ns=track.time_ns[at], camera_from_object=track.camera_from_object[at],
        status=tuple(track.status[i] for i in at), covariance=track.covariance[at],
    )  # fmt: skip
    none = np.zeros((0, 2), dtype=tracked.pairs.dtype)
    return replace(
        tracked, track=few, cost=tracked.cost[at], on_surface=tracked.on_surface[at], store=tracked.store.only(at),
        held=tracked.held[at], keyframes=tuple(range(len(at))), pairs=none, rejected={},
    )  # fmt: skip
