"""Stage `joint`: its frames from the tracks, its outside from the calibration, its poses as tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.images import Images, TossImages, track_and_image_keys
from processing.motion.interpolate import pose_at
from processing.refine.joint import FrameData, JointConfig, World, solve_jointly
from processing.run import Run
from processing.store import Done
from processing.track.flags import camera_covariance
from recordings.geometry import skew
from recordings.records import RgbdFrame
from recordings.results.folder import read_shape, read_track, write_shape, write_track
from recordings.tracks import ObjectShape, ObjectTrack
from recordings.whole_file import write_json

VERSION = 5
BORDER_PX = 2
FEWEST_PX = 100


@dataclass(frozen=True)
class JointResult:
    """Frames that took part, whether gravity and the table did; or why there was nothing to solve."""

    frames: int
    world: bool = False
    kept_out: str | None = None


def solve_together(
    run: Run, tracks: Mapping[int, Done], shape: Done, images: Mapping[int, Images]
) -> Done[JointResult]:
    """Poses and shape of all tosses in one objective, from where a pass ended."""
    inputs = {**track_and_image_keys(tracks, images), "shape": shape.key, "calibration": run.keys["calibration"]}

    def compute(folder: Path) -> JointResult:
        body, progress = read_shape(shape.folder), run.progress("joint objective")
        before = {t: read_track(d.folder, t) for t, d in tracks.items()}
        frames: list[FrameData] = []
        for done, (toss, track) in enumerate(before.items()):
            progress.step(done, len(before) + 1, f"toss {toss}")
            frames += frames_of(run, track, images[toss].open(), run.config.joint)
        if not frames:
            write_shape(folder, body)
            for track in before.values():
                write_track(folder, track)
            return JointResult(0, kept_out=f"no tracked frame shows {FEWEST_PX} pixels: nothing to solve jointly")
        poses = np.stack([before[f.toss].camera_from_object[f.position] for f in frames])
        world = outside(run, before, frames, body)
        found = solve_jointly(frames, poses, body, world, run.config.joint)
        write_shape(folder, found.shape)
        for toss, track in before.items():
            mine = [i for i, f in enumerate(frames) if f.toss == toss]
            write_track(folder, _with_poses(track, frames, mine, found.poses, found.information, found.center_m))
        write_json(folder / "costs.json", {"rounds": list(found.costs)})
        return JointResult(len(frames), world is not None)

    return run.store.run("joint", VERSION, run.config.joint, inputs, JointResult, compute)


def frames_of(run: Run, track: ObjectTrack, seen: TossImages, config: JointConfig) -> list[FrameData]:
    """The tracked frames of one toss as the objective sees them."""
    rays = run.camera.pixel_rays()
    out = []
    for i, status in enumerate(track.status):
        mask = np.asarray(seen.masks[i], dtype=bool)
        if status != "tracked" or mask.sum() < FEWEST_PX:
            continue
        pose = track.camera_from_object[i]
        at_depth = np.linalg.inv(pose) @ pose_at(track, i, int(seen.depth_times_ns[i]))
        time_s = 1e-9 * float(track.time_ns[i] - track.time_ns[0])
        points = _points(seen.frames[i], mask, rays, config.depth_points)
        out.append(FrameData(track.toss, i, time_s, points, at_depth, track.covariance[i]))
    return out


def _points(frame: RgbdFrame, mask: Array, rays: Float[Array, "h w 3"], most: int) -> Float[Array, "n 3"]:
    inside = cv2.erode(mask.astype(np.uint8), np.ones((2 * BORDER_PX + 1,) * 2, np.uint8)).astype(bool)
    v, u = np.nonzero(inside & (frame.depth_m > 0))
    chosen = np.linspace(0, len(v) - 1, min(len(v), most)).astype(int)
    v, u = v[chosen], u[chosen]
    return np.asarray(rays[v, u] * frame.depth_m[v, u, None].astype(np.float64))


def outside(run: Run, tracks: Mapping[int, ObjectTrack], frames: list[FrameData], body: ObjectShape) -> World | None:
    """Gravity, plane, and which frames fly or rest; None without a calibrated world."""
    from processing.contact.learn.shape_comparison import series_of
    from processing.contact.physics.inertia import uniform_physics
    from processing.contact.physics.plane import calibrated_plane
    from processing.motion.phases import find_phases

    world = run.world_from_camera
    if world is None:
        return None
    plane, physics = calibrated_plane(run.session.calibration), uniform_physics(body)
    index = {(f.toss, f.position): k for k, f in enumerate(frames)}
    flights, rests, resting, released = [], [], [], []
    for toss, track in tracks.items():
        kept = [i for i, s in enumerate(track.status) if s == "tracked"]
        if len(kept) < 5:
            continue
        series = series_of({toss: track}, world)[0].about(physics.center_of_mass_m)
        phases = find_phases(series, physics.inertia_kgm2)
        own = [index.get((toss, i)) for i in kept]
        for k in range(len(kept)):
            here = own[k]
            if here is None or phases.release is None or k < phases.release:
                continue
            released.append(here)
            if phases.at_rest[k]:
                resting.append(here)
            if k + 1 < len(kept) and own[k + 1] is not None and phases.at_rest[k] and phases.at_rest[k + 1]:
                rests.append((here, own[k + 1]))
            three = own[k : k + 3]
            if len(three) == 3 and None not in three and phases.in_flight[k : k + 3].all():
                flights.append(tuple(three))
    return World(
        world.matrix,
        np.asarray(plane.normal_world, dtype=np.float64),
        float(plane.offset_m),
        physics.center_of_mass_m,
        physics.inertia_kgm2,
        np.array(flights, dtype=np.int64).reshape(-1, 3),
        np.array(rests, dtype=np.int64).reshape(-1, 2),
        np.array(resting, dtype=np.int64),
        np.array(released, dtype=np.int64),
    )


def _with_poses(
    track: ObjectTrack, frames: list[FrameData], mine: list[int], poses: Float[Array, "n 4 4"],
    information: Float[Array, "n 6 6"], center_m: Float[Array, "3"],
) -> ObjectTrack:  # fmt: skip
    """The track with the solved poses, each with the covariance that the objective gives it (shape held)."""
    out, covariance = track.camera_from_object.copy(), track.covariance.copy()
    for i in mine:
        position = frames[i].position
        out[position] = poses[i]
        turn_shift = np.linalg.pinv(information[i], hermitian=True)
        to = np.zeros((6, 6))  # (turn about the centre, shift) to (shift of the origin, turn), object axes
        to[:3, 3:], to[3:, :3], to[:3, :3] = np.eye(3), np.eye(3), skew(center_m)
        covariance[position] = camera_covariance(poses[i], to @ turn_shift @ to.T)
    return replace(track, camera_from_object=out, covariance=covariance)
