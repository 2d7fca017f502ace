"""The pipeline on one screen: plain calls, each of which reads its stage's folder first. Scores come afterwards.

What the ground truth says is never asked here: see truth.py.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from processing.backends import make_matcher, settings_of
from processing.baselines.frame_to_model import FrameToModel
from processing.config import Config
from processing.segment.background.static_scene import StaticScene
from processing.sensor.frames import corrected_frames
from processing.sensor.still import Kept, in_every_frame, without_waiting
from processing.sensor.table_plane import with_table_from_depth
from processing.stage_notices import of_contact, of_run, of_track
from processing.stages.contact import rollout_stage
from processing.stages.cycle import Pass, alone_start, run_cycle
from processing.stages.lost_tosses import with_lost, without_lost
from processing.stages.masks import object_masks, scene_notes, static_scene
from processing.stages.one_shape import of_one_shape
from processing.stages.vision import CAMERA, field_stage, model_stage, model_track_stage, register_stage, track_stage
from processing.start_pose import StartPose
from processing.store import Counts, Done, Store, locked, plain
from processing.variants import TRACKERS, WITH_MODEL, Variant
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.notices import Notice, in_order
from recordings.progress import Progress
from recordings.results.folder import (
    Scope,
    TossRecord,
    VariantRecord,
    read_masks,
    write_shape,
    write_track,
    write_variant,
)
from recordings.session import RgbdFrames, Session
from recordings.session_writer import file_sha256

if TYPE_CHECKING:
    from processing.features.sift import FeatureMatcher

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
    starts: Mapping[int, StartPose] = field(default_factory=dict)
    warnings: tuple[Notice, ...] = ()
    kept: Mapping[int, Kept] = field(default_factory=dict)
    """Of tosses with long still stretches, the frames that are worked on: see processing.sensor.still."""
    lost: tuple[int, ...] = ()
    """Tosses in which the object is not seen: they show the scene and the robot only."""

    @property
    def recorded(self) -> tuple[int, ...]:
        """All tosses of the run, with those in which the object is not seen."""
        return tuple(sorted((*self.tosses, *self.lost)))

    @property
    def camera(self) -> CameraModel:
        """The camera that everything is tracked in."""
        return self.session.calibration.camera(CAMERA)

    @cached_property
    def matcher(self) -> FeatureMatcher:
        """Who matches features."""
        return make_matcher(self.config.backends, self.device)

    def matcher_settings(self, config: Any) -> dict[str, Any]:
        """The settings of a stage that matches features: its own, and the matcher where it is not the default."""
        return {**plain(config), **settings_of(self.config.backends.matcher, self.config.backends)}

    def frames(self, toss: int) -> RgbdFrames:
        """A toss's frames as vision sees them, depth in true metres."""
        return corrected_frames(self, toss)


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
    physics = json.dumps(session.start.get("object"), sort_keys=True, default=str).encode()
    keys |= {"calibration": _calibration_key(session), "physics": hashlib.sha256(physics).hexdigest()}
    return without_waiting(Run(session, tuple(tosses), Store(results), config, tracker, device, progress, keys))


def _calibration_key(session: Session) -> str:
    return hashlib.sha256(json.dumps(session.calibration.to_json(), sort_keys=True).encode()).hexdigest()


def with_table(run: Run) -> Run:
    """The same run with the table that the depth of the empty scene shows (`--table-from-depth`)."""
    scene = StaticScene.read(static_scene(run).folder)
    calibration, found = with_table_from_depth(run.session.calibration, CAMERA, scene.depth_m)
    session = run.session.with_calibration(calibration)
    seen = f"the table is from depth ({100 * found['share']:.0f} % of it, spread {1e3 * found['spread_m']:.1f} mm)"
    told = Notice("table", "low", seen, "gravity is taken to be its normal")
    return replace(run, session=session, keys={**run.keys, "calibration": _calibration_key(session)},
                   warnings=(*run.warnings, told))  # fmt: skip


def process(run: Run, variant: Variant, scope: Scope) -> VariantRecord:
    """Tracks and shapes of one variant, and the record of where they are."""
    scene = static_scene(run)
    masks = {t: object_masks(run, t, scene) for t in run.tosses}
    run = without_lost(run, masks)
    once = {t: first_pass(run, t, masks[t]) for t in run.tosses}  # p_i
    if variant.first == "one_toss":
        last = _alone(run, once, masks, scope)  # p_i, O_i
    else:
        first = _all_together(run, once, masks)  # P, O
        last = first if variant.refined is None else _refined_rows(run, variant, scope, once, first, masks)
        last = _with_apart(run, last, once, masks)
    record = _record(run, variant, scope, with_lost(run, last, masks), masks)
    with locked(run.store.results / ".variants.lock"):
        write_variant(run.store.results, record)
    return record


def process_with_model(run: Run, model: Path) -> VariantRecord:
    """Tosses tracked with a shape that was learned before (`--model`); nothing is learned anew."""
    scene, shape = static_scene(run), model_stage(run, model)
    masks = {t: object_masks(run, t, scene) for t in run.tosses}
    run = without_lost(run, masks)
    tracks = {t: model_track_stage(run, t, masks[t], shape) for t in run.tosses}
    last = Pass(tracks, dict.fromkeys(run.tosses, shape), masks, shared_frame=True, warnings=_unfit(tracks),
                notes=(f"shape: {model.name}",))  # fmt: skip
    record = _record(run, WITH_MODEL, "all", with_lost(run, last, masks), masks)
    with locked(run.store.results / ".variants.lock"):
        write_variant(run.store.results, record)
    return record


def _alone(run: Run, once: Mapping[int, Done], masks: Mapping[int, Done], scope: Scope) -> Pass:
    """p_i, O_i: in scope all only the first toss's shape is looked at."""
    notes, warnings = ("each toss has its own object frame",), _unfit(once)
    if run.tracker == FrameToModel.name:
        return Pass(once, once, masks, shared_frame=False, warnings=warnings, notes=notes)
    wanted = run.tosses if scope == "one" else run.tosses[:1]
    shapes = {t: field_stage(run, f"toss {t}", {t: once[t]}, {t: masks[t]}) for t in wanted}
    whose = {t: shapes.get(t, shapes[wanted[0]]) for t in run.tosses}
    return Pass(once, whose, masks, shared_frame=False, warnings=warnings, notes=notes)


def _unfit(once: Mapping[int, Done]) -> tuple[Notice, ...]:
    """Tosses in which no single rigid motion explains what is seen."""
    return tuple(n for t, done in once.items() for n in of_track(t, done))


def _all_together(run: Run, once: Mapping[int, Done], masks: Mapping[int, Done]) -> Pass:
    """P, O: all tosses in one object frame, and one shape."""
    if run.tracker == FrameToModel.name:
        raise BadInput(
            f"--tracker {run.tracker} has no registration between tosses, so bundlesdf-1 is its only row; "
            f"take --tracker {TRACKERS[0]}, or --variant bundlesdf-1"
        )
    together = register_stage(run, dict(once), dict(masks))
    tracks = dict.fromkeys(run.tosses, together)
    left_out = together.counts["not_joined"]
    warnings = [*_unfit(once), *_unplaced(together)]
    joined = [t for t in run.tosses if t not in left_out]
    shape = field_stage(run, "all tosses", dict.fromkeys(joined, together), {t: masks[t] for t in joined})
    _, apart = of_one_shape(run, together, shape, masks, joined)
    if apart:
        there = tuple(t for t in run.tosses if t not in apart)  # joined anew: they were refined together with the wrong
        seen = f"tosses {apart}: their place among the others is wrong, no one shape explains both: kept apart"
        warning = Notice("register", "high", seen, "another object, or one that looks alike from several sides")
        left = _all_together(replace(run, tosses=there), {t: once[t] for t in there}, {t: masks[t] for t in there})
        warnings = [*_unfit({t: once[t] for t in apart}), warning, *left.warnings]
        return replace(left, shared_frame=False, warnings=tuple(warnings))
    return Pass(tracks, dict.fromkeys(run.tosses, shape), {t: masks[t] for t in run.tosses}, shared_frame=True,
                warnings=tuple(warnings))  # fmt: skip


def _unplaced(together: Done) -> list[Notice]:
    """Tosses that are not in the object frame of the others, or not surely."""
    found, left_out, unsure = [], together.counts["not_joined"], together.counts.get("ambiguous")
    if left_out:
        seen = f"tosses {left_out} could not be brought into the object frame of the others: lost"
        found.append(Notice("register", "high", seen, "another object, or none of its sides that the others show"))
    if unsure:
        seen = f"tosses {unsure}: the object looks alike from several sides; their object frame may be turned"
        found.append(Notice("register", "high", seen, "compare their frames in `toss-view RESULTS`", "possible"))
    return found


def _with_apart(run: Run, last: Pass, once: Mapping[int, Done], masks: Mapping[int, Done]) -> Pass:
    """Tosses that were kept apart, as the first pass on each alone left them: in their own object frame."""
    apart = [t for t in run.tosses if t not in last.tracks]
    shapes = {t: field_stage(run, f"toss {t}", {t: once[t]}, {t: masks[t]}) for t in apart}
    tracks = {t: once[t] for t in apart}
    if not apart:
        return last
    return replace(last, tracks={**last.tracks, **tracks}, shapes={**last.shapes, **shapes},
                   masks={**last.masks, **{t: masks[t] for t in apart}}, shared_frame=False)  # fmt: skip


def _refined_rows(
    run: Run, variant: Variant, scope: Scope, once: Mapping[int, Done], first: Pass, masks: Mapping[int, Done]
) -> Pass:
    """The cycle on all tosses from P and O, or in scope one on every toss from p_i and O moved into its frame."""
    if scope == "all":
        ended = run_cycle(run, variant, first, "all tosses")
        return _with_rollouts(run, ended) if variant.icp and ended.contact else ended
    parts = []
    for toss in first.tracks:
        alone = alone_start(run, toss, first, once[toss], masks[toss])
        parts.append(run_cycle(run, variant, alone, f"toss {toss}"))
    return Pass.joined(parts)


def _with_rollouts(run: Run, ended: Pass) -> Pass:
    """The paper's Figure 4 on the row's last tracks and shape."""
    done = rollout_stage(run, "all tosses", ended.tracks, next(iter(ended.shapes.values())))
    why = done.counts.get("kept_out")
    if not why:
        return replace(ended, rollout=done)
    return replace(ended, warnings=(*ended.warnings, Notice("rollout", "low", f"no rollouts: {why}")))


def _record(run: Run, variant: Variant, scope: Scope, last: Pass, masks: Mapping[int, Done]) -> VariantRecord:
    tosses = [
        TossRecord(t, in_every_frame(run, t, last.tracks[t]).name, last.shapes[t].name,
                   in_every_frame(run, t, last.masks.get(t, masks[t])).name)
        for t in run.recorded
    ]  # fmt: skip
    contact = {str(t): done.name for t, done in last.contact.items()}
    of_stages = [*of_run(run, static_scene(run), masks), *(n for d in last.contact.values() for n in of_contact(d))]
    return VariantRecord(
        name=variant.name,
        scope=scope,
        label=variant.label,
        session_name=run.session.name,
        object_name=run.session.object_name,
        calibration=run.session.calibration,
        tosses=tuple(tosses),
        shape=tosses[0].shape if scope == "all" else None,
        contact=next(iter(contact.values()), None) if scope == "all" else None,
        shared_object_frame=last.shared_frame,
        session_path=os.path.relpath(run.session.path.resolve(), run.store.results.resolve()),
        warnings=in_order((*run.warnings, *last.warnings, *of_stages)),
        notes=(f"tracker: {run.tracker}", *scene_notes(run), *last.notes),
        extra={
            "tracker": run.tracker,
            "contact_of_toss": contact,
            "passes": list(last.passes),
            **({"rollout": last.rollout.name} if last.rollout is not None else {}),
        },
    )


def first_pass(run: Run, toss: int, masks: Done) -> Done:
    """Stage `track` by the chosen tracker. The baseline's folder holds its shape too."""
    if run.tracker != FrameToModel.name:
        return track_stage(run, toss, masks)
    name = f"toss_{toss:02d}"
    inputs = {"masks": masks.key, name: run.keys[name], "calibration": run.keys["calibration"]}

    def compute(folder: Path) -> Counts:
        frames, camera = run.frames(toss), run.camera
        tracker = FrameToModel(run.config.frame_to_model)
        tracked = tracker.track(
            toss, frames, read_masks(masks.folder, toss), camera, f"object_{name}", run.progress(f"toss {toss}: poses")
        )
        write_track(folder, tracked.track)
        write_shape(folder, tracked.shape)
        lost = int(tracked.track.lost.sum())
        return {"frames": len(frames), "lost": lost, "vertices": len(tracked.shape.vertices_m)}

    return run.store.run("track", 1, {"tracker": run.tracker, **vars(run.config.frame_to_model)}, inputs, compute)
