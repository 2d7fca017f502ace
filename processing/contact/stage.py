"""Contact learning as a stage of a results folder: run once, read afterwards."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from processing.contact.command import STAGE, VERSION, PoseSource
from processing.contact.data_checks import duplicate_groups, refuse_leaks
from processing.contact.evaluate import Evaluation, evaluate
from processing.contact.export import write_assets
from processing.contact.figure import draw_result
from processing.contact.fit import FitConfig
from processing.contact.inertia import Physics, physics_of_session, uniform_box_physics, uniform_physics
from processing.contact.learn import ContactConfig, ContactLearning, Plane, learn_contact
from processing.contact.motion import PoseSeries
from processing.contact.prior import Prior, prior_from_shape, prior_from_size
from processing.contact.result import result_document, result_text, warnings_of
from processing.contact.segment import find_phases
from processing.stage import Store
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.results import VariantRecord, write_contact, write_shape, write_variant
from recordings.session_writer import write_json

if TYPE_CHECKING:
    from recordings.session import Session

STEP_S = 1 / 148


def run_stage(
    session: Session,
    out_dir: Path,
    source: PoseSource,
    learned: Sequence[int],
    tested: Sequence[int],
    geometry: str | None,
    init_m: float | None,
    steps: int,
    device: str,
    progress: Progress,
    began: float,
) -> tuple[dict[str, Any], str]:
    """Learn and roll out, or read what an equal run made. Returns the document and lines to read."""
    torch.set_num_threads(1)  # the batches are small: more threads only wait for each other, and cost CPU seconds
    tracks = {t.toss: t for t in source.tracks}
    missing = [t for t in (*learned, *tested) if t not in tracks]
    learned, tested = [t for t in learned if t in tracks], [t for t in tested if t in tracks]
    if not learned or not tested:
        raise BadInput(f"no poses of the tosses {missing} in {source.name}")
    marked = tuple(t for t in tested if t not in learned)
    refuse_leaks(learned, marked, duplicate_groups([tracks[t] for t in sorted({*learned, *tested})]))
    plane = session_plane(session)
    given = physics_of_session(session.start)
    prior, physics = make_prior(geometry, init_m, source, given, [tracks[t] for t in learned], plane)
    config = ContactConfig(fit=FitConfig(device=device, friction_start=0.03), rollout_steps=steps)

    def compute(folder: Path) -> Mapping[str, Any]:
        learning = learn_contact([tracks[t] for t in learned], prior, physics, plane, config, progress)
        evaluation = evaluate(learning, [tracks[t] for t in tested], plane, steps, STEP_S)
        document = result_document(learning, evaluation)
        document |= {
            "session": session.name,
            "poses": source.name,
            "train": list(learned),
            "test": list(tested),
            "not_learned_from": list(marked),
            "without_poses": missing,
            "plane": {"offset_m": plane.offset_m, "normal": plane.normal_world.tolist(), "source": plane.source},
            "warnings": warnings_of(learning),
            "seconds": time.perf_counter() - began,
            "cpu_seconds_total": time.process_time(),
        }
        _write(folder, session, learning, evaluation, marked, document)
        return {"text": result_text(learning, evaluation)}

    settings = {
        "train": list(learned),
        "test": list(tested),
        "geometry": prior.geometry.name,
        "init_m": init_m,
        "steps": steps,
        "device": device,
    }
    done = Store(out_dir).run(STAGE, VERSION, settings, {"poses": _digest(tracks, learned, tested)}, compute)
    document = json.loads((done.folder / "result.json").read_text())
    files = {
        "folder": str(done.folder),
        "plot": str(done.folder / "rollout.png"),
        "assets": {f: str(done.folder / "assets" / f / f"object{s}") for f, s in ASSET_FILES.items()},
        "reused": done.reused,
    }
    _record(out_dir, session, done.name)
    text = f"{done.counts['text']}\nplot:    {files['plot']}\nassets:  {done.folder / 'assets'}"
    return {**document, "files": files}, text


ASSET_FILES = {"urdf": ".urdf", "mjcf": ".xml", "drake-sdf": ".sdf"}


def _write(
    folder: Path,
    session: Session,
    learning: ContactLearning,
    evaluation: Evaluation,
    marked: tuple[int, ...],
    document: Mapping[str, Any],
) -> None:
    write_contact(folder, learning.model)
    write_shape(folder, learning.shape)
    write_assets(folder, learning.model, learning.shape)
    draw_result(folder / "rollout.png", learning, evaluation, marked, session.name)
    write_json(folder / "result.json", _finite(document))


def _finite(value: Any) -> Any:
    """JSON has no NaN: None instead (a step that no toss reaches)."""
    if isinstance(value, Mapping):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value


def _record(out_dir: Path, session: Session, stage: str) -> None:
    """The variant's record, so that exports find shape, contact model and assets."""
    write_variant(
        out_dir,
        VariantRecord(
            name="contact-only",
            scope="all",
            label="contact learning on given poses",
            session_name=session.name,
            object_name=session.object_name,
            calibration=session.calibration,
            tosses=(),
            shape=stage,
            contact=stage,
            shared_object_frame=True,
        ),
    )


def _digest(tracks: Mapping[int, PoseSeries], learned: Sequence[int], tested: Sequence[int]) -> str:
    content = hashlib.sha256()
    for toss in sorted({*learned, *tested}):
        track = tracks[toss]
        for values in (track.time_s, track.rotation, track.position_m):
            content.update(np.ascontiguousarray(values).tobytes())
    return content.hexdigest()


def session_plane(session: Session) -> Plane:
    """The ground plane of a session's calibration; z = 0 of `world` where none is given."""
    given = (session.calibration.residuals or {}).get("ground_plane")
    if isinstance(given, Mapping) and "normal_world" in given and "offset_m" in given:
        return Plane(np.array(given["normal_world"], dtype=np.float64), float(given["offset_m"]), "calibration.json")
    return Plane()


def make_prior(
    geometry: str | None,
    init_m: float | None,
    source: PoseSource,
    given: Physics | None,
    tracks: Sequence[PoseSeries],
    plane: Plane,
) -> tuple[Prior, Physics]:
    """What to start from: the vision shape, a cube of --init, or a cube as high as the object rests."""
    if source.shape is not None and init_m is None:
        physics = given or uniform_physics(source.shape)
        physics = (
            physics
            if given is None
            else replace(physics, center_of_mass_m=uniform_physics(source.shape).center_of_mass_m)
        )
        return prior_from_shape(geometry or "hull", source.shape, physics), physics  # type: ignore[arg-type]
    if geometry == "nonconvex":
        raise BadInput(
            "--geometry nonconvex needs a shape to start from (where contact never reaches, it stands); these "
            "poses come "
            "without one: run vision first (`toss-process SESSION`), or use --geometry hull"
        )
    side = resting_side_m(tracks, plane) if init_m is None else init_m
    physics = given or uniform_box_physics(np.full(3, side))
    prior = prior_from_size(geometry or "box", side, physics.center_of_mass_m)  # type: ignore[arg-type]
    return prior, physics


def resting_side_m(tracks: Sequence[PoseSeries], plane: Plane) -> float:
    """Twice the height at which the object's origin rests. Raises BadInput where no toss comes to rest."""
    heights = []
    for track in tracks:
        level = track.turned(plane.level_from_world(), plane.offset_m)
        rest = find_phases(level, np.eye(3)).rest
        if rest is not None:
            heights.append(float(np.median(level.position_m[rest:, 2])))
    if not heights or np.median(heights) < 0.0025:
        raise BadInput("no toss comes to rest above the plane, so no size to start from; give one: --init SIDE_M")
    return 2 * float(np.median(heights))
