"""Stage `adjust`: the poses of all tosses, adjusted with the surface free that their frames show together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.engine.parts import side_by_side
from processing.features.sift import Sift
from processing.images import Images, track_and_image_keys
from processing.motion.motion_prior import gravity_in_camera
from processing.run import Run
from processing.store import Done
from processing.track.beam import Scene, seconds
from processing.track.flags import fit_of_sure, reflagged
from processing.track.free_surface.adjust import AdjustedToss, PosedToss, adjusted
from processing.track.hypotheses import HypothesisConfig, open_azimuths, with_azimuths_sought
from processing.track.known_shape import center_of
from processing.track.track_toss import views_of
from recordings.geometry import rotation_angle_rad
from recordings.progress import Silent
from recordings.results.folder import read_shape, read_track, write_track

VERSION = 16

AS_WELL = 1.2
"""An unsure frame fits as well as sure ones where it costs no more than so many times what the worst of them does
(docs/decisions/tracked.md)."""


@dataclass(frozen=True)
class AdjustResult:
    """Frames with a pose, and how far they moved (medians)."""

    frames: int
    rotation_deg: float
    translation_m: float


def adjust(
    run: Run, tracks: Mapping[int, Done], first: Mapping[int, Done], shape: Done, images: Mapping[int, Images]
) -> Done[AdjustResult]:
    """The tracks of tosses in the object frame of `shape`. `first`: the same before any adjustment. Which frames were
    sure there decides anew which are, so that what fits as well as they do does not widen from one to the next."""
    inputs = {**track_and_image_keys(tracks, images), "surface": shape.key}
    inputs |= {f"first_{t:02d}": first[t].key for t in tracks}

    def compute(folder: Path) -> AdjustResult:
        body, before = read_shape(shape.folder), {t: read_track(done.folder, t) for t, done in tracks.items()}
        unadjusted = {t: read_track(first[t].folder, t) for t in tracks}
        gravity = gravity_in_camera(None if run.world_from_camera is None else run.world_from_camera.matrix)

        def opened(toss: int) -> PosedToss:
            seen = images[toss].open()
            store, times_ns, _ = views_of(
                seen.frames, seen.masks, run.camera, seen.confidence, run.config.track, run.world_from_camera, Silent(),
                colorless=seen.colorless,
            )  # fmt: skip
            scene = Scene(store, seconds(times_ns), gravity, center_of(body), Sift(), hand=seen.hand)
            poses = before[toss].camera_from_object
            use = np.isfinite(poses[:, 0, 0]) & np.array([store.usable(i) for i in range(len(poses))])
            return PosedToss(scene, *with_azimuths_sought(scene, poses, use, run.config.track.hypotheses))

        tosses = list(side_by_side(opened, list(tracks)))
        config = run.config.track
        all_after = adjusted(tosses, body, config.hypotheses, run.progress("poses with the surface free"))
        turns, shifts = [], []
        limit = AS_WELL * fit_of_sure([*unadjusted.values()], [a.cost for a in all_after]) if len(tosses) > 1 else -1.0
        for toss, t, after in zip(tosses, tracks, all_after, strict=True):
            track = before[t]
            steps = np.linalg.inv(track.camera_from_object[~track.lost]) @ after.poses[~track.lost]
            turns += [float(np.degrees(rotation_angle_rad(step[:3, :3]))) for step in steps]
            shifts += [float(x) for x in np.linalg.norm(steps[:, :3, 3], axis=1)]
            held = after.cost <= limit
            doubt = azimuth_covariance(toss.scene, after, config.hypotheses)
            said = unadjusted[t]
            write_track(folder, reflagged(said, after.poses, after.covariance, after.cost, held, doubt, config.flags))
        return AdjustResult(len(turns), float(np.median(turns or [0.0])), float(np.median(shifts or [0.0])))

    return run.store.run("adjust", VERSION, run.config.track, inputs, AdjustResult, compute)


def azimuth_covariance(scene: Scene, after: AdjustedToss, config: HypothesisConfig) -> Float[Array, "n 6 6"]:
    """What the adjusted views of a body that looks round leave open of its azimuth (twist of the object frame); zero of
    other bodies."""
    use = np.isfinite(after.cost)
    found = open_azimuths(scene, after.poses, use, int(use.argmax()), config) if use.any() else None
    return np.zeros((len(use), 6, 6)) if found is None else found.covariance
