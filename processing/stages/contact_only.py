"""Stage `contact-only`: contact learned from poses that are there already, without vision."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from processing.contact.learn.convexity import CLASSES, ClassName
from processing.contact.learn.data_checks import check_frames, duplicate_groups, of_own_tracks, refuse_leaks
from processing.contact.learn.fit import FitConfig
from processing.contact.learn.from_tracks import TracksConfig, learn_from_series
from processing.contact.learn.learn import ContactConfig, ContactLearning, learn_contact
from processing.contact.learn.prepared import no_contact, none_usable
from processing.contact.learn.prior import Prior, prior_from_shape, prior_from_size
from processing.contact.physics.inertia import Physics, physics_of_session, uniform_box_physics, uniform_physics
from processing.contact.physics.plane import Plane, calibrated_plane
from processing.contact.report.assets import write_assets
from processing.contact.report.figure import draw_result
from processing.contact.report.result import result_document, result_text, warnings_of
from processing.contact.report.rollout_errors import Evaluation, evaluate
from processing.contact.report.rollouts_file import write_rollouts
from processing.motion.phases import find_phases
from processing.motion.trajectory import PoseSeries
from processing.pose_source import DEFAULT_STEPS, PoseSource
from processing.store import Store
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.results.folder import VariantRecord, write_contact, write_shape, write_variant
from recordings.results.stage_files import stage_document
from recordings.tracks import ObjectShape
from recordings.whole_file import without_nan, write_json

if TYPE_CHECKING:
    from recordings.session import Session

VERSION = 10
STEP_S = 1 / 148


@dataclass(frozen=True)
class ContactOnlyResult:
    """Lines to read."""

    text: str


def learn_contact_only(
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
    if device == "cuda" and not torch.cuda.is_available():
        raise BadInput(
            "--device cuda: this PyTorch finds no CUDA device; leave --device out (cpu), or install its CUDA build"
        )
    torch.set_num_threads(1)  # the batches are small: more threads only wait for each other, and cost CPU seconds
    tracks = {t.toss: t for t in source.tracks}
    missing = [t for t in (*learned, *tested) if t not in tracks]
    learned, tested = [t for t in learned if t in tracks], [t for t in tested if t in tracks]
    if not learned or not tested:
        raise BadInput(f"no poses of the tosses {missing} in {source.name}")
    marked = tuple(t for t in tested if t not in learned)
    refuse_leaks(learned, marked, duplicate_groups([tracks[t] for t in sorted({*learned, *tested})]))
    calibrated = calibrated_plane(session.calibration)
    given = physics_of_session(session.start)
    train = [tracks[t] for t in learned]
    wanted, steps = steps, min(steps, max(DEFAULT_STEPS, _longest(tracks[t] for t in tested)))
    config = ContactConfig(fit=FitConfig(device=device, friction_start=0.03), rollout_steps=steps)

    def compute(folder: Path) -> ContactOnlyResult:
        with of_own_tracks() if source.of_vision else nullcontext():
            found = _learn(train, geometry, init_m, source, given, calibrated, config, progress)
        learning, plane = found.learning, found.plane
        evaluation = evaluate(learning, [tracks[t] for t in tested], plane, steps, STEP_S, "thrown")
        document = result_document(learning, evaluation)
        more = [*found.warnings, *_warnings(geometry, source, wanted, steps)]
        document |= {
            "session": session.name,
            "poses": source.name,
            "train": list(learned),
            "test": list(tested),
            "not_learned_from": list(marked),
            "without_poses": missing,
            "plane": {"offset_m": plane.offset_m, "normal": plane.normal_world.tolist(), "source": plane.source},
            "warnings": [*(n.text for n in warnings_of(learning)), *more],
            "seconds": time.perf_counter() - began,
            "cpu_seconds_total": time.process_time(),
            **found.extra,
        }
        _write(folder, session, learning, found.shape, evaluation, marked, document, plane)
        return ContactOnlyResult(result_text(learning, evaluation, more))

    settings: dict[str, Any] = {"train": list(learned), "test": list(tested), "geometry": geometry or "from the data"}
    settings |= {"init_m": init_m, "steps": steps, "steps_wanted": wanted, "device": device}
    inputs = {"poses": _digest(tracks, learned, tested), "about": _about(source, given, calibrated)}
    done = Store(out_dir).run("contact-only", VERSION, settings, inputs, ContactOnlyResult, compute)
    document = stage_document(done.folder / "result.json")
    assets = {f: str(done.folder / "assets" / f / f"object{s}") for f, s in ASSET_FILES.items()}
    plot = str(done.folder / "rollout.png")
    files = {"folder": str(done.folder), "plot": plot, "assets": assets, "reused": done.reused}
    _record(out_dir, session, done.name)
    text = f"{done.result.text}\nplot:    {plot}\nassets:  {done.folder / 'assets'}"
    return {**document, "files": files}, text


ASSET_FILES = {"urdf": ".urdf", "mjcf": ".xml", "drake-sdf": ".sdf"}


def _write(
    folder: Path, session: Session, learning: ContactLearning, shape: ObjectShape, evaluation: Evaluation,
    marked: tuple[int, ...], document: Mapping[str, Any], plane: Plane,
) -> None:  # fmt: skip
    write_contact(folder, learning.model)
    write_shape(folder, shape)
    write_assets(folder, learning.model, shape)
    draw_result(folder / "rollout.png", learning, evaluation, marked, session.name)
    write_rollouts(folder, learning, evaluation, plane)
    write_json(folder / "result.json", without_nan(document))  # a step that no toss reaches has no number


def _record(out_dir: Path, session: Session, stage: str) -> None:
    """The variant's record, so that exports find shape, contact model and assets."""
    record = VariantRecord(
        "contact-only", "all", "contact learning on given poses", session.name, session.object_name,
        session.calibration, tosses=(), shape=stage, contact=stage, shared_object_frame=True,
    )  # fmt: skip
    write_variant(out_dir, record)


def _digest(tracks: Mapping[int, PoseSeries], learned: Sequence[int], tested: Sequence[int]) -> str:
    content = hashlib.sha256()
    for toss in sorted({*learned, *tested}):
        track = tracks[toss]
        for values in (track.time_s, track.rotation, track.position_m):
            content.update(np.ascontiguousarray(values).tobytes())
    return content.hexdigest()


def _longest(tracks: Iterable[PoseSeries]) -> int:
    """Steps of STEP_S that the longest toss lasts for."""
    return max(int((t.time_s[-1] - t.time_s[0]) / STEP_S + 0.5) if len(t) else 0 for t in tracks)


def _warnings(geometry: str | None, source: PoseSource, wanted: int, steps: int) -> list[str]:
    found = [] if source.note is None else [source.note]
    if geometry == "nonconvex" and source.shape is None:
        found.append(
            "nonconvex without a shape to start from: a plane only ever touches the convex hull, so what lies between "
            "the touched points is the start's, not measured; run vision first (`toss-process SESSION`) for a shape"
        )
    if wanted != steps:
        found.append(f"--steps {wanted}: no toss lasts that long; rolled out over {steps}, to the end of the longest")
    return found


def _about(source: PoseSource, given: Physics | None, plane: Plane) -> str:
    """Fingerprint of what else decides the result: where the poses come from, the shape, the physics, the plane."""
    content = hashlib.sha256(f"{source.name} {source.note is None}".encode())
    values = [plane.normal_world, np.array([plane.offset_m, plane.std_m or 0.0])]
    if source.shape is not None:
        values += [source.shape.vertices_m, source.shape.faces]
    if given is not None:
        values += [np.array(given.mass_kg), given.inertia_kgm2, given.center_of_mass_m]
    for value in values:
        content.update(np.ascontiguousarray(value).tobytes())
    return content.hexdigest()


@dataclass(frozen=True, eq=False)
class _Learned:
    """What was learned, the shape, the plane that it was learned on, and what else the document says."""

    learning: ContactLearning
    shape: ObjectShape
    plane: Plane
    warnings: Sequence[str]
    extra: Mapping[str, Any]


def _learn(
    train: Sequence[PoseSeries], geometry: str | None, init_m: float | None, source: PoseSource, given: Physics | None,
    plane: Plane, config: ContactConfig, progress: Progress,
) -> _Learned:  # fmt: skip
    """From vision's shape (corrected where contact knows better) or from a size alone."""
    if source.shape is None or init_m is not None or geometry == "box":
        prior, physics = make_prior(geometry, init_m, source, given, train, plane)
        learning = learn_contact(train, prior, physics, plane, config, progress)
        return _Learned(learning, learning.shape, plane, (), {})
    base = TracksConfig()
    wanted: ClassName | None = geometry if geometry in CLASSES else None
    contact = replace(config, penetration=base.contact.penetration, bootstrap_repeats=base.contact.bootstrap_repeats)
    physics = shape_physics(source.shape, given)
    found = learn_from_series(
        train, source.shape, plane, physics, replace(base, contact=contact, geometry=wanted), progress
    )
    extra = {k: found.document[k] for k in ("geometry_choice", "contact_alone", "fusion", "contact_loss_j")}
    warnings = [found.plane_off.text] if found.plane_off else []
    return _Learned(found.fused, found.shape, found.plane, warnings, extra)


def shape_physics(shape: ObjectShape, given: Physics | None) -> Physics:
    """Physics in the object frame of vision's shape, which is not the frame that an inertia was given in: the mass is
    taken, and the inertia where it is the same about all axes."""
    uniform = uniform_physics(shape)
    if given is None:
        return uniform
    moments = np.linalg.eigvalsh(given.inertia_kgm2)
    scale = given.mass_kg / uniform.mass_kg
    if moments[-1] < 1.02 * moments[0]:
        center = f"{given.source}; centre of mass of uniform density"
        return Physics(given.mass_kg, uniform.center_of_mass_m, given.inertia_kgm2, center)
    why = (
        f"mass of {given.source}, uniform density over the prior shape (the axes of the inertia given are not its axes)"
    )
    return Physics(given.mass_kg, uniform.center_of_mass_m, scale * uniform.inertia_kgm2, why)


def make_prior(
    geometry: str | None,
    init_m: float | None,
    source: PoseSource,
    given: Physics | None,
    tracks: Sequence[PoseSeries],
    plane: Plane,
) -> tuple[Prior, Physics]:
    """What to start from without vision's mesh: its bounding box, a cube of --init, or a cube as high as the object
    rests."""
    if source.shape is not None and init_m is None:
        physics = shape_physics(source.shape, given)
        return prior_from_shape("box", source.shape, physics, trimmed=True), physics
    side = resting_side_m(tracks, plane) if init_m is None else init_m
    physics = given or uniform_box_physics(np.full(3, side))
    prior = prior_from_size(geometry or "box", side, physics.center_of_mass_m)  # type: ignore[arg-type]
    return prior, physics


def resting_side_m(tracks: Sequence[PoseSeries], plane: Plane) -> float:
    """Twice the height at which the object's origin rests. Raises BadInput where no toss comes to rest."""
    heights, transitions, touched, wrong = [], 0, False, dict[int, str]()
    for track in tracks:
        try:
            check_frames(track)
        except BadInput as why:
            wrong[track.toss] = str(why)
            continue
        level = track.turned(plane.level_from_world(), plane.offset_m)
        phases = find_phases(level, np.eye(3))
        transitions, touched = transitions + len(level) - 2, touched or not bool(phases.in_flight.all())
        if phases.rest is not None:
            heights.append(float(np.median(level.position_m[phases.rest :, 2])))
    if len(wrong) == len(tracks):
        raise BadInput(none_usable(wrong))
    if not touched:
        raise no_contact(len(tracks) - len(wrong), transitions)
    if not heights or np.median(heights) < 0.0025:
        raise BadInput("no toss comes to rest above the plane, so no size to start from; give one: --init SIDE_M")
    return 2 * float(np.median(heights))
