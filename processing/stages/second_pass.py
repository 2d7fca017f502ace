"""The second pass's stages (the paper's steps 4 to 6): the shape laid onto raw depth and drawn, and vision on that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from processing.field.learn import TossViews, learn_shape, pose_at
from processing.refine.icp import IcpConfig, align_frames, count_verdicts
from processing.refine.image_residuals import JudgeConfig
from processing.refine.redrawn_frames import RedrawConfig, SecondFrames
from processing.sensor.render import RendererName, make_renderer
from processing.stages.vision import CAMERA
from processing.store import Counts, Done, plain
from processing.track.registration.register import register_tosses
from processing.track.track_file import read_toss_track, write_toss_track
from processing.track.track_toss import track_toss
from recordings.geometry import Transform
from recordings.results.folder import (
    RobotMasks,
    read_hand,
    read_masks,
    read_shape,
    read_track,
    write_masks,
    write_shape,
    write_track,
)
from recordings.tracks import ObjectShape, ObjectTrack

if TYPE_CHECKING:
    from processing.pipeline import Run


Start = Literal["anew", "poses", "shape"]


@dataclass(frozen=True)
class CycleConfig:
    """The cycle's settings. Passes are compared by the mean over depth, outline, colour and contact of how much larger
    their residuals are, as a share."""

    icp: IcpConfig = field(default_factory=IcpConfig)
    redraw: RedrawConfig = field(default_factory=RedrawConfig)
    judge: JudgeConfig = field(default_factory=JudgeConfig)
    renderer: RendererName = "raycast"
    start: Start = "shape"
    """`anew` (the paper): the second pass is given the first pose only. `poses`: the poses at which the shape was drawn
    are refined, only lost frames are sought. `shape`: the same, and the shape's own surface and colours take part;
    where no frame looks, it stays."""
    apart_mask: float = 0.12
    """A toss whose outline the common shape misses by more (1 - IoU, median over frames) is not of that shape."""
    much_worse: float = 0.02
    """A second pass whose residuals on the raw images are larger by more than this is kept out, and said to be."""
    most_passes: int = 3
    """After the second one, where passes go on until they converge."""
    same_rotation_deg: float = 0.05
    same_translation_m: float = 0.0001
    same_shape_m: float = 0.0001
    """Passes end when poses and shape change by less than these (medians over frames, mean over the surface)."""


def align_stage(
    run: Run, name: str, tracks: Mapping[int, Done], shape: Done, masks: Mapping[int, Done], icp: bool
) -> Done:
    """Stage `reproject`: the poses at which the shape is drawn for the second pass, and the masks M' (M'') there.

    With `icp` the shape is first laid onto the raw depth of every frame; a rejected frame keeps its pose, and is
    counted. Depth is compared at its own exposure time, the pose is corrected at both.
    """
    inputs = {"shape": shape.key, **input_keys(tracks, masks)}
    config = {"icp": vars(run.config.cycle.icp) if icp else None, "redraw": vars(run.config.cycle.redraw),
              "renderer": run.config.cycle.renderer}  # fmt: skip

    def compute(folder: Path) -> Counts:
        body, progress = read_shape(shape.folder), run.progress(f"{name}: reprojection")
        total: dict[str, int] = {}
        for done, toss in enumerate(tracks):
            progress.step(done, len(tracks), f"toss {toss}")
            track = read_track(tracks[toss].folder, toss)
            if icp:
                track, counts, details = _laid_on_depth(run, toss, track, body, masks[toss])
                total = {k: total.get(k, 0) + counts.get(k, 0) for k in (*total, *counts)}
                np.savez(folder / f"toss_{toss:02d}.icp.npz", **details)
            write_track(folder, track)
            second = second_frames(run, toss, track, body, masks[toss])
            write_masks(folder, toss, second.masks, read_masks(masks[toss].folder, toss).confidence)
        return {"icp": total}

    return run.store.run("reproject", 3, config, inputs, compute)


def _laid_on_depth(
    run: Run, toss: int, track: ObjectTrack, body: ObjectShape, masks: Done
) -> tuple[ObjectTrack, dict[str, int], dict[str, Any]]:
    frames, seen = run.frames(toss), read_masks(masks.folder, toss)
    times_ns = frames.depth_times_ns
    at_depth = np.stack([pose_at(track, i, int(times_ns[i])) for i in range(len(track.status))])
    depths = _Depths(frames)
    found = align_frames(body, depths, seen, run.camera, at_depth, run.config.cycle.icp, track.covariance)
    poses = track.camera_from_object.copy()
    for i, alignment in enumerate(found):
        if alignment.verdict == "aligned":
            poses[i] = poses[i] @ np.linalg.inv(at_depth[i]) @ alignment.camera_from_object
    details = {
        "verdict": np.array([a.verdict for a in found]),
        "fitness": np.array([a.fitness for a in found]),
        "rmse_m": np.array([a.rmse_m for a in found]),
        "held": np.array([a.held for a in found]),
    }
    return replace(track, camera_from_object=poses), count_verdicts(found), details


class _Depths(Sequence[Any]):
    """Depth images alone, read one by one."""

    def __init__(self, frames: Sequence[Any]) -> None:
        self._frames = frames

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, position: Any) -> Any:
        return self._frames[position].depth_m


def second_frames(run: Run, toss: int, track: ObjectTrack, body: ObjectShape, masks: Done) -> SecondFrames:
    """(RGB, D'', M'') of one toss, drawn when asked for."""
    frames = run.frames(toss)
    renderer = make_renderer(run.config.cycle.renderer, body, run.camera)
    raw = read_masks(masks.folder, toss)
    return SecondFrames(frames, frames.times_ns, raw, track.camera_from_object, renderer, run.config.cycle.redraw)


def second_tracks(run: Run, name: str, drawn: Done, shape: Done, masks: Mapping[int, Done]) -> dict[int, Done]:
    """Poses from (RGB, D'', M''): every toss anew from its first pose, then all of them refined together."""
    tracks = {t: _second_track(run, t, drawn, shape, masks[t]) for t in masks}
    seen = {t: d for t, d in tracks.items() if d.counts["frames"] > d.counts["lost"]}
    if len(seen) < 2 or run.config.cycle.start == "shape":  # the shape holds them together
        return tracks
    inputs = {"drawn": drawn.key, "shape": shape.key, **{f"track_{t:02d}": d.key for t, d in tracks.items()}}

    def compute(folder: Path) -> Counts:
        body = read_shape(shape.folder)
        tosses = []
        for toss, done in seen.items():
            frames = second_frames(run, toss, read_track(drawn.folder, toss), body, masks[toss])
            sure = read_masks(masks[toss].folder, toss).confidence
            tosses.append(read_toss_track(done.folder, toss, frames, frames.masks, run.camera, sure,
                                          run.config.track, run.session.calibration.find("world", CAMERA)))  # fmt: skip
        progress = run.progress(f"{name}: all tosses together again")
        together = register_tosses(tosses, run.config.register, progress, run.matcher, together=True)
        for track in together.tracks:
            write_track(folder, track)
        return {"fit": [round(float(f), 4) for f in together.fit]}

    config = {"register": run.matcher_settings(run.config.register), "together": True}
    return {**tracks, **dict.fromkeys(seen, run.store.run("register", 4, config, inputs, compute))}


def _second_track(run: Run, toss: int, drawn: Done, shape: Done, masks: Done) -> Done:
    inputs = {"drawn": drawn.key, "shape": shape.key, "masks": masks.key, "toss": str(toss)}

    def compute(folder: Path) -> Counts:
        before = read_track(drawn.folder, toss)
        body = read_shape(shape.folder)
        frames = second_frames(run, toss, before, body, masks)
        known = np.flatnonzero(np.isfinite(before.camera_from_object[:, 0, 0]))
        if len(known) == 0:
            write_track(folder, before)
            return {"frames": len(before.status), "lost": len(before.status)}
        given: dict[str, Any] = {"poses": before.camera_from_object}
        if run.config.cycle.start == "anew":
            start = Transform.from_matrix(CAMERA, before.object_frame, before.camera_from_object[known[0]])
            given = {"start": start, "start_frame": int(known[0])}
        if run.config.cycle.start == "shape":
            given["model"] = body
        tracked = track_toss(
            frames,
            frames.masks,
            run.camera,
            run.config.track,
            run.progress(f"toss {toss}: poses, second pass"),
            toss=toss,
            object_frame=before.object_frame,
            confidence=read_masks(masks.folder, toss).confidence,
            world_from_camera=run.session.calibration.find("world", CAMERA),
            matcher=run.matcher,
            colorless=frames.colorless,
            hand=read_hand(masks.folder, toss),
            **given,
        )
        write_toss_track(folder, tracked)
        return {"frames": len(frames), "lost": int(tracked.track.lost.sum())}

    config = {"track": run.matcher_settings(run.config.track), "start": run.config.cycle.start}
    return run.store.run("track", 8, config, inputs, compute)


def second_field(
    run: Run, name: str, tracks: Mapping[int, Done], drawn: Done, shape: Done, masks: Mapping[int, Done]
) -> Done:
    """The shape that (RGB, D'', M'') show at the second pass's poses."""
    inputs = {"for": name, "drawn": drawn.key, "shape": shape.key, **input_keys(tracks, masks)}

    def compute(folder: Path) -> Counts:
        views, body = [], read_shape(shape.folder)
        for toss, track in tracks.items():
            frames = second_frames(run, toss, read_track(drawn.folder, toss), body, masks[toss])
            own, robot = read_track(track.folder, toss), RobotMasks.of(masks[toss].folder, toss)
            views.append(TossViews(frames, frames.depth_times_ns, frames.masks, own, frames.colorless, robot))
        progress = run.progress(f"{name}: shape, second pass")
        believed = body if run.config.cycle.start == "shape" else None
        learned, used = learn_shape(views, run.camera, run.config.shape, run.device, progress, believed)
        write_shape(folder, learned)
        return {"views": used, "vertices": len(learned.vertices_m)}

    config = {"shape": plain(run.config.shape), "start": run.config.cycle.start}
    return run.store.run("field", 6, config, inputs, compute)


def input_keys(tracks: Mapping[int, Done], masks: Mapping[int, Done]) -> dict[str, str]:
    found: dict[str, str] = {}
    for toss in tracks:
        found |= {f"track_{toss:02d}": tracks[toss].key, f"masks_{toss:02d}": masks[toss].key}
    return found
