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
from processing.images import TossImages
from processing.live.config import LiveConfig, light
from processing.live.so_far import SessionSoFar
from processing.live.verdict import Seen, what_is_seen
from processing.live.watch import FileId
from processing.pipeline.one_toss import Shared, Step, masked, thrown_frames
from processing.run import Run
from processing.store import Store
from processing.track.track_toss import TossTrack, track_toss
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.records import TossWindow
from recordings.session import Session


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
    shared: Shared | None = None
    learned_from: tuple[int, ...] = ()
    files: dict[int, FileId] = field(default_factory=dict)

    def look(self, toss: int, file: FileId, step: Step) -> Looked:
        """Raises BadInput where the object is not found in it, or nothing of it can be tracked."""
        self.files[toss] = file
        session = self._open((toss,))
        try:
            run = self._run(session, (toss,))
            step("scene")
            if self.shared is None:
                self.shared, self.learned_from = Shared.of(run), run.recorded
            live = self.live
            run = thrown_frames(run, toss, live.before_release_s, live.after_rest_s, live.least_thrown)
            run, images = masked(run, toss, self.shared, step)
            images = replace(images, masks=list(images.masks))  # each decoded once
            step("track")
            tracked = _track(run, toss, images)
            step("what is seen")
            seen = what_is_seen(images.frames, images.masks, self.live)
            window = run.session.toss(toss).window()
            return Looked(toss, file, tracked, seen, self._views(run, tracked, images), window)
        finally:
            session.close()

    def learn_scene_again(self, tosses: tuple[int, ...]) -> None:
        """The static scene from more tosses."""
        session = self._open(tosses)
        try:
            run = self._run(session, tosses)
            self.shared = Shared.of(run) if self.shared is None else self.shared.with_scene_of(run)
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

    def _views(self, run: Run, tracked: TossTrack, images: TossImages) -> tuple[FieldView, ...]:
        seen: TossViews = images.views(tracked.track)
        try:
            return tuple(chosen_views([seen], run.camera, replace(run.config.shape, most_views=self.live.field_views)))
        except BadInput:
            return ()


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
        held=tracked.held[at], keyframes=tuple(range(len(at))), pairs=none, rejected={}, features={},
    )  # fmt: skip
