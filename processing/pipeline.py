"""The pipeline on one screen: plain calls, each of which reads its stage's folder first. Scores come afterwards.

What the ground truth says is never asked here: see truth.py.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from processing.config import Config
from processing.masks import object_masks, static_scene
from processing.stage import Counts, Done, Store, locked
from processing.track.frame_to_model import FrameToModel
from processing.variants import TRACKERS, Variant
from processing.vision import CAMERA, field_stage, register_stage, track_stage
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.results import (
    Scope,
    TossRecord,
    VariantRecord,
    read_masks,
    write_shape,
    write_track,
    write_variant,
)
from recordings.session import Session
from recordings.session_writer import file_sha256

MakeProgress = Callable[[str], Progress]


@dataclass(frozen=True, eq=False)
class Run:
    """One session being processed into one results folder. `tosses` are those that take part in anything."""

    session: Session
    tosses: tuple[int, ...]
    store: Store
    config: Config
    tracker: str
    device: str
    progress: MakeProgress
    keys: Mapping[str, str]


def start_run(
    session: Session,
    tosses: Sequence[int],
    results: Path,
    config: Config,
    tracker: str,
    progress: MakeProgress,
    device: str = "cpu",
) -> Run:
    """Check what the run needs and take the fingerprints of its inputs. Raises BadInput."""
    if not tosses:
        raise BadInput(f"{session.path} has no tosses; wanted a session with toss_00.mcap and so on")
    if CAMERA not in session.calibration.cameras:
        raise BadInput(
            f"{session.path}: the calibration has no intrinsics of {CAMERA}; it has "
            f"{sorted(session.calibration.cameras) or 'no camera'}. Vision needs them"
        )
    keys = {f"toss_{t:02d}": file_sha256(session.file(t)) for t in tosses}
    calibration = json.dumps(session.calibration.to_json(), sort_keys=True).encode()
    keys["calibration"] = hashlib.sha256(calibration).hexdigest()
    return Run(session, tuple(tosses), Store(results), config, tracker, device, progress, keys)


def process(run: Run, variant: Variant, scope: Scope) -> VariantRecord:
    """Tracks and shapes of one variant, and the record of where they are."""
    scene = static_scene(run)
    masks = {t: object_masks(run, t, scene) for t in run.tosses}
    once = {t: first_pass(run, t, masks[t]) for t in run.tosses}  # p_i
    if variant.poses_from == "all_tosses":
        tracks, shapes, notes = _all_together(run, once, masks)  # P, O
    else:
        tracks, shapes, notes = once, _alone(run, once, masks, scope), ["each toss has its own object frame"]
    tosses = [TossRecord(t, tracks[t].name, shapes[t].name, masks[t].name) for t in run.tosses]
    record = VariantRecord(
        name=variant.name,
        scope=scope,
        label=variant.label,
        session_name=run.session.name,
        object_name=run.session.object_name,
        calibration=run.session.calibration,
        tosses=tuple(tosses),
        shape=tosses[0].shape if scope == "all" else None,
        shared_object_frame=variant.poses_from == "all_tosses",
        session_path=os.path.relpath(run.session.path.resolve(), run.store.results.resolve()),
        notes=(f"tracker: {run.tracker}", *notes),
        extra={"tracker": run.tracker},
    )
    with locked(run.store.results / ".variants.lock"):
        write_variant(run.store.results, record)
    return record


def _alone(run: Run, once: Mapping[int, Done], masks: Mapping[int, Done], scope: Scope) -> dict[int, Done]:
    """O_i: in scope all only the first toss's shape is looked at."""
    if run.tracker == FrameToModel.name:
        return dict(once)
    wanted = run.tosses if scope == "one" else run.tosses[:1]
    shapes = {t: field_stage(run, f"toss {t}", {t: once[t]}, {t: masks[t]}) for t in wanted}
    return {t: shapes.get(t, shapes[wanted[0]]) for t in run.tosses}


def _all_together(
    run: Run, once: Mapping[int, Done], masks: Mapping[int, Done]
) -> tuple[dict[int, Done], dict[int, Done], list[str]]:
    """P, O: all tosses in one object frame, and one shape."""
    if run.tracker == FrameToModel.name:
        raise BadInput(
            f"--tracker {run.tracker} has no registration between tosses, so no bundlesdf-10; "
            f"take --tracker {TRACKERS[0]}, or --variant bundlesdf-1"
        )
    together = register_stage(run, dict(once), dict(masks))
    tracks = dict.fromkeys(run.tosses, together)
    left_out = together.counts["not_joined"]
    notes = [f"tosses {left_out} could not be brought into the object frame of the others: lost"] if left_out else []
    joined = [t for t in run.tosses if t not in left_out]
    shape = field_stage(run, "all tosses", dict.fromkeys(joined, together), {t: masks[t] for t in joined})
    return tracks, dict.fromkeys(run.tosses, shape), notes


def first_pass(run: Run, toss: int, masks: Done) -> Done:
    """Stage `track` by the chosen tracker. The baseline's folder holds its shape too."""
    if run.tracker != FrameToModel.name:
        return track_stage(run, toss, masks)
    name = f"toss_{toss:02d}"
    inputs = {"masks": masks.key, name: run.keys[name], "calibration": run.keys["calibration"]}

    def compute(folder: Path) -> Counts:
        frames = run.session.toss(toss).rgbd(CAMERA)
        camera = run.session.calibration.camera(CAMERA)
        tracker = FrameToModel(run.config.frame_to_model)
        tracked = tracker.track(
            toss, frames, read_masks(masks.folder, toss), camera, f"object_{name}", run.progress(f"toss {toss}: poses")
        )
        write_track(folder, tracked.track)
        write_shape(folder, tracked.shape)
        lost = int(tracked.track.lost.sum())
        return {"frames": len(frames), "lost": lost, "vertices": len(tracked.shape.vertices_m)}

    return run.store.run("track", 1, {"tracker": run.tracker, **vars(run.config.frame_to_model)}, inputs, compute)
