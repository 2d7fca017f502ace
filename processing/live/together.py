"""The tosses of a session so far, in one object frame: where each lies, the shape that they show, friction, what to
throw next."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.learn.shape_comparison import series_of
from processing.contact.physics.inertia import uniform_physics
from processing.field.fuse import fuse
from processing.field.mesh import grid_mesh
from processing.live.advice import Option, Throw, options
from processing.live.config import LiveConfig
from processing.live.friction import LawSoFar, law_so_far
from processing.live.look import Looked, thinned
from processing.live.sides import TossSides, sides_of
from processing.live.verdict import Instants, instants_of, verdict
from processing.motion.trajectory import differences
from processing.track.registration.register import Placement, place_among
from processing.track.track_toss import TossTrack
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.results.live import TossSoFar
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration

KEPT_FRAMES = 24
"""Of each toss, for the tosses after it to be compared with."""
SHARED = "object"


@dataclass(frozen=True, eq=False)
class Joined:
    """A toss among the others: its whole track in the shared object frame (in its own where it has no place), the
    frames that others are compared with, what it told of the object's sides, and how it was thrown."""

    looked: Looked
    track: ObjectTrack
    compared: TossTrack
    placement: Placement | None
    instants: Instants
    sides: TossSides
    throw: Throw | None

    @property
    def placed(self) -> bool:
        """Whether it shares the object frame."""
        return self.placement is None or self.placement.joined


@dataclass
class Together:
    """What is known so far. Tosses are added one by one; taking one away leaves the others where they are."""

    calibration: RigCalibration
    camera: str
    config: LiveConfig
    tosses: dict[int, Joined] = field(default_factory=dict)
    shape: ObjectShape | None = None
    law: LawSoFar | None = None

    @property
    def world_from_camera(self) -> Transform | None:
        """None where the table is not calibrated."""
        return self.calibration.find("world", self.camera)

    def add(self, looked: Looked) -> Joined:
        """Find the toss's place among the others, and judge it."""
        others = [j for j in self.tosses.values() if j.placed]
        placement = place_among(looked.tracked, [j.compared for j in others], self.config.register) if others else None
        moved = _moved(looked.tracked, np.eye(4) if placement is None else placement.shared_from_own)
        inertia = np.eye(3) * 1e-3 if self.shape is None else uniform_physics(self.shape).inertia_kgm2
        instants = instants_of(moved.track, self.world_from_camera, moved.center_m, inertia, looked.window)
        joined = Joined(
            looked=replace(looked, views=_moved_views(looked, placement)),
            track=moved.track,
            compared=thinned(moved, KEPT_FRAMES),
            placement=placement,
            instants=instants,
            sides=sides_of(moved.track, moved.center_m, self.world_from_camera, instants.impact),
            throw=_throw(moved.track, self.world_from_camera, moved.center_m, instants),
        )
        self.tosses[looked.toss] = joined
        self.fuse()
        return joined

    def remove(self, toss: int) -> None:
        """A toss that was taken away."""
        if self.tosses.pop(toss, None) is not None:
            self.fuse()

    def fuse(self) -> None:
        """The shape so far, from some views of each toss that has its place."""
        views = [v for j in self.tosses.values() if j.placed for v in j.looked.views]
        try:
            self.shape = grid_mesh(fuse(views, self.config.fuse), SHARED, "so far") if views else None
        except BadInput:  # too few depth points: nothing to show yet
            self.shape = None

    def learn_law(self) -> LawSoFar | None:
        """Friction and restitution, where the table is known and enough tosses hit it."""
        world, tracks = self.world_from_camera, {t: j.track for t, j in self.tosses.items() if j.placed}
        if world is not None and self.shape is not None:
            self.law = law_so_far(tracks, self.shape, world, self.calibration)
        return self.law

    def unseen_share(self) -> float | None:
        """Of the shape's vertices; None where there is no shape yet."""
        return None if self.shape is None or self.shape.observed is None else float((~self.shape.observed).mean())

    def next(self) -> list[Option]:
        """What to throw next, best first."""
        placed = {t: j for t, j in self.tosses.items() if j.placed}
        if not placed or self.shape is None:
            return []
        last = placed[max(placed)]
        posed = [i for i, s in enumerate(last.track.status) if s == "tracked"]
        now = last.track.camera_from_object[posed[-1]] if posed else None
        center = 0.5 * (self.shape.vertices_m.min(0) + self.shape.vertices_m.max(0))
        extent = float(np.ptp(self.shape.vertices_m, axis=0).mean())
        throws = {t: j.throw for t, j in placed.items() if j.throw is not None}
        return options(
            [j.sides for j in placed.values()], now, center, extent, self.world_from_camera, self.law, throws
        )

    def report(self, joined: Joined, seconds: float) -> TossSoFar:
        """For the console and the viewer."""
        track, placement = joined.track, joined.placement
        unsure = placement is not None and placement.ambiguous
        judged = self.world_from_camera is not None
        said = verdict(track, joined.looked.seen, joined.instants, judged, unsure, joined.placed, self.config)
        at = joined.instants
        return TossSoFar(
            toss=joined.looked.toss,
            frames=len(track.status),
            seen=joined.looked.seen.frames,
            tracked=track.status.count("tracked"),
            interpolated=track.status.count("interpolated"),
            lost=track.status.count("lost"),
            verdict=said,
            placed=joined.placed,
            ambiguous=unsure,
            cost=None if placement is None or not placement.joined else round(placement.fit, 5),
            phases=(at.release, at.impact, at.rest),
            seconds=round(seconds, 2),
            status=track.status,
            time_ns=tuple(int(t) for t in track.time_ns),
            camera_from_object=tuple(
                None if not np.isfinite(p).all() else p.tolist() for p in track.camera_from_object
            ),
        )


def _moved(tracked: TossTrack, shared_from_own: Float[Array, "4 4"]) -> TossTrack:
    """A toss's track in the object frame that all share."""
    own_from_shared = np.linalg.inv(shared_from_own)
    poses = tracked.track.camera_from_object @ own_from_shared
    track = replace(tracked.track, camera_from_object=poses, object_frame=SHARED)
    center = shared_from_own[:3, :3] @ tracked.center_m + shared_from_own[:3, 3]
    return replace(tracked, track=track, center_m=center)


def _moved_views(looked: Looked, placement: Placement | None) -> tuple:
    if placement is None:
        return looked.views
    back = np.linalg.inv(placement.shared_from_own)
    return tuple(v.posed(v.camera_from_object @ back, v.camera_from_object_at_depth @ back) for v in looked.views)


def _throw(
    track: ObjectTrack, world_from_camera: Transform | None, center_m: Float[Array, "3"], instants: Instants
) -> Throw | None:
    """From its flight; None where none was found."""
    if world_from_camera is None or instants.release is None or instants.impact is None:
        return None
    at = [i for i, s in enumerate(track.status) if s == "tracked"]
    series = series_of({track.toss: track}, world_from_camera)[0].about(center_m)
    first, last = at.index(instants.release), min(at.index(instants.impact), len(at) - 1)
    if last - first < 2:
        return None
    flight = series.part(slice(first, last))
    spin = np.linalg.norm(differences(flight).spin_object_rad_s[1:], axis=1)
    return Throw(float(np.median(spin)), float(flight.position_m[:, 2].max() - series.position_m[last, 2]))
