"""Scores of a variant against the truth, from the files in the results folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.evaluate.metrics import (
    FLIPPED_DEG,
    POINTS,
    SURFACE_POINTS,
    Chamfer,
    FrameErrors,
    align_first,
    auc_percent,
    biggest_component,
    chamfer,
    frame_errors,
    icp_align,
    rollout_errors,
    surface_points,
    volume_error_percent,
)
from processing.evaluate.truth import Truth
from processing.motion.frame_phases import PHASES, Phase, frame_phases
from recordings.bounded.mesh_file import load_mesh
from recordings.results.folder import Results, VariantRecord, read_contact
from recordings.results.stage_files import stage_arrays, stage_document
from recordings.tracks import ObjectShape, ObjectTrack

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class Value:
    """One number of the table: with its unit, how many it is from, what was aligned to what, and its 95 % interval
    where it has one."""

    value: float
    unit: str
    n: int
    aligned: str
    low: float | None = None
    high: float | None = None

    def to_json(self) -> dict[str, Any]:
        """As plain values; a number without an interval has no bounds."""
        return {k: v for k, v in asdict(self).items() if v is not None}


AT_FIRST_FRAME = "each toss at its own first frame (not at all where that is lost)"


@dataclass(frozen=True, eq=False)
class TossScore:
    """Scores of one toss, aligned at its first frame: `errors`, `phase` and `time_s` (since the first frame) of every
    frame that has a true pose. `phase` is empty where the world is not known; `shift` is
    estimated_object_from_true_object, None where the first frame is lost: the poses are then scored as they are."""

    toss: int
    errors: FrameErrors
    lost: int
    time_s: Float[Array, " n"]
    phase: tuple[Phase, ...]
    shift: Float[Array, "4 4"] | None = None


@dataclass(frozen=True, eq=False)
class VariantScore:
    """Values by name, per-toss scores, and what could not be scored and why."""

    values: dict[str, Value]
    tosses: tuple[TossScore, ...]
    warnings: tuple[str, ...] = field(default=())
    phases: dict[str, dict[str, Value]] = field(default_factory=dict)
    true_from_shape: Float[Array, "4 4"] | None = None
    """Scope all: the alignment that `cd_icp` is measured in."""
    rollout: dict[str, Any] | None = None
    """Rollouts against the truth, as JSON."""

    def with_more(self, values: Mapping[str, Value], warnings: tuple[str, ...]) -> VariantScore:
        """The same with further values and warnings."""
        return replace(self, values={**self.values, **values}, warnings=(*self.warnings, *warnings))


def score_variant(results: Results, record: VariantRecord, truth: Truth) -> VariantScore:
    """All scores of one variant that the truth allows. Every frame with a true pose counts, those of tosses that are
    lost from end to end too."""
    mesh = true_mesh(truth)
    if mesh is None:
        return VariantScore({}, (), (f"{truth.folder} has no mesh.obj: ADD and Chamfer cannot be scored",))
    tracks = results.tracks(record.name, record.scope)
    tosses, warnings = toss_scores(record, tracks, truth, mesh)
    if not tosses:
        return VariantScore({}, (), tuple(warnings))
    values = pose_values(FrameErrors.pooled([t.errors for t in tosses]), AT_FIRST_FRAME)
    frames, lost = sum(len(t.lost) for t in tracks.values()), sum(int(t.lost.sum()) for t in tracks.values())
    values["lost_frames"] = Value(float(lost), "frames", frames, "nothing")
    if record.shared_object_frame:
        values |= _with_one_alignment(tracks, truth, surface_points(mesh, POINTS), tosses[0].shift)
    of_shape, placed = shape_values(results, record, {t.toss: t.shift for t in tosses}, mesh)
    values |= {**of_shape, **friction_error(results, record, truth)}
    rollout = rollout_scores(results, record, truth, tracks)
    if rollout is not None:
        values |= rollout_values(rollout, "rollout", "truth, met at the release")
    return VariantScore(values, tuple(tosses), tuple(warnings), phase_values(tosses), placed, rollout)


def toss_scores(
    record: VariantRecord, tracks: Mapping[int, ObjectTrack], truth: Truth, mesh: trimesh.Trimesh
) -> tuple[list[TossScore], list[str]]:
    """The errors of every toss that has true poses, and what a reader must know of them."""
    points, tosses, warnings = surface_points(mesh, POINTS), [], []
    for toss, track in tracks.items():
        true = truth.camera_from_object(track)
        if true is None or not np.isfinite(true[:, 0, 0]).any():
            warnings.append(f"toss {toss}: the truth has no pose of its frames; not scored")
            continue
        shift = align_first(track.camera_from_object, true)
        if shift is None and not track.lost.all():
            warnings.append(f"toss {toss}: its first frame is lost, so its poses are scored without being aligned")
        errors = frame_errors(_aligned(track, shift), true, points)
        known = np.isfinite(true[:, 0, 0])
        phase = tuple(p for p, k in zip(_phases(record, track, true, mesh), known) if k)
        time_s = 1e-9 * (track.time_ns[known] - track.time_ns[0])
        tosses.append(TossScore(toss, errors, int(track.lost.sum()), time_s, phase, shift))
    return tosses, warnings


def _aligned(track: ObjectTrack, shift: Float[Array, "4 4"] | None) -> Float[Array, "n 4 4"]:
    """camera_from_true_object; without a shift the poses as they are, as the independent scorer has it."""
    return track.camera_from_object if shift is None else track.camera_from_object @ shift


def _phases(
    record: VariantRecord, track: ObjectTrack, true: Float[Array, "n 4 4"], mesh: trimesh.Trimesh
) -> list[Phase]:
    """By the true motion in the world; nothing where the calibration does not know the world."""
    world = record.calibration.find("world", track.camera)
    if world is None:
        return []
    return frame_phases(track.time_ns, world.matrix @ true, np.asarray(mesh.center_mass))


def phase_values(tosses: list[TossScore]) -> dict[str, dict[str, Value]]:
    """Pose scores of each phase's frames, aligned as all frames are."""
    if not any(t.phase for t in tosses):
        return {}
    every = FrameErrors.pooled([t.errors for t in tosses])
    labels = np.array([p for t in tosses for p in (t.phase or ["held"] * len(t.errors.add_m))])
    return {p: pose_values(every.only(labels == p), AT_FIRST_FRAME) for p in PHASES if (labels == p).any()}


def rollout_scores(
    results: Results, record: VariantRecord, truth: Truth, tracks: dict[int, ObjectTrack]
) -> dict[str, Any] | None:
    """The row's rollouts against the truth, whose poses are moved to the estimate's where the rollout begins.
    None where nothing was rolled out or no world is known."""
    from processing.contact.report.rollout_errors import summarise

    stage, world = record.extra.get("rollout"), record.calibration.find("world", "d455")
    if stage is None or world is None:
        return None
    center = read_contact(results.path / stage).center_of_mass_m
    position, rotation, tosses = [], [], []
    with stage_arrays(results.path / stage / "rollouts.npz") as stored:
        rolled = {name: stored[name] for name in stored.files}
    for toss in (int(t) for t in rolled["toss"]):
        true = truth.camera_from_object(tracks[toss])
        name = f"toss_{toss:02d}"
        if true is None:
            continue
        times_s = 1e-9 * (tracks[toss].time_ns - tracks[toss].time_ns[0])
        errors = rollout_errors(
            rolled[f"{name}.world_from_object"], rolled[f"{name}.time_s"], world.matrix @ true, times_s, center
        )
        if errors is not None:
            position.append(errors[0])
            rotation.append(errors[1])
            tosses.append(toss)
    if not tosses:
        return None
    document = stage_document(results.path / stage / "rollout.json")
    return {
        "steps": len(position[0]), "dt_s": document["dt_s"], "tosses": tosses,
        "position_m": summarise(np.stack(position)).to_json(), "rotation_rad": summarise(np.stack(rotation)).to_json(),
    }  # fmt: skip


def rollout_values(document: Mapping[str, Any], prefix: str, against: str) -> dict[str, Value]:
    """Mean errors of rollouts over steps and tosses, with the 95 % interval over tosses: `<prefix>_position` (mm) and
    `<prefix>_rotation` (deg). A single toss has no interval."""
    n, found = len(document["tosses"]), {}
    for name, unit, scale in (("position", "mm", 1e3), ("rotation", "deg", float(np.degrees(1.0)))):
        summary = document["position_m" if name == "position" else "rotation_rad"]
        low, high = (max(scale * summary["low"], 0.0), scale * summary["high"]) if n > 1 else (None, None)
        found[f"{prefix}_{name}"] = Value(scale * summary["mean"], unit, n, against, low, high)
    return found


def friction_error(results: Results, record: VariantRecord, truth: Truth) -> dict[str, Value]:
    """Learned friction less the true one, where the truth knows it."""
    model = results.contact(record.name, record.scope)
    if model is None or truth.friction is None:
        return {}
    return {"friction_error": Value(model.friction - truth.friction, "", len(record.tosses), "nothing")}


def pose_values(e: FrameErrors, aligned: str, prefix: str = "") -> dict[str, Value]:
    """AUCs, success rate, median and 90 % errors over all frames."""
    n = len(e.add_m)
    figures = {
        "adds_auc": (auc_percent(e.adds_m), "%"),
        "add_auc": (auc_percent(e.add_m), "%"),
        "success_5deg_5cm": (100 * float(e.success.mean()), "%"),
        "success_5deg_2cm": (100 * float(e.within(5.0, 0.02).mean()), "%"),
        "median_rotation": (float(np.median(e.rotation_deg)), "deg"),
        "p90_rotation": (_quantile(e.rotation_deg, 0.9), "deg"),
        "median_translation": (1000 * float(np.median(e.translation_m)), "mm"),
        "p90_translation": (1000 * _quantile(e.translation_m, 0.9), "mm"),
        "flipped_frames": (float((np.isfinite(e.rotation_deg) & (e.rotation_deg > FLIPPED_DEG)).sum()), "frames"),
    }
    return {prefix + name: Value(value, unit, n, aligned) for name, (value, unit) in figures.items()}


def _quantile(values: Float[Array, " n"], share: float) -> float:
    """Lower quantile, so that infinite errors of lost frames never become NaN."""
    return float(np.quantile(values, share, method="lower"))


def _with_one_alignment(
    tracks: Mapping[int, ObjectTrack], truth: Truth, points_m: Float[Array, "p 3"], shift: Float[Array, "4 4"] | None
) -> dict[str, Value]:
    parts = []
    for track in tracks.values():
        true = truth.camera_from_object(track)
        if true is not None:
            parts.append(frame_errors(_aligned(track, shift), true, points_m))
    where = "all tosses at the first toss's first frame (not at all where that is lost)"
    return pose_values(FrameErrors.pooled(parts), where, "global_")


def shape_values(
    results: Results, record: VariantRecord, shifts: Mapping[int, Float[Array, "4 4"] | None], truth: trimesh.Trimesh
) -> tuple[dict[str, Value], Float[Array, "4 4"] | None]:
    """Chamfer distances: of the variant's one shape, or the mean over the tosses' own (scope one). Also where the
    variant's one shape lies after the alignment by ICP."""
    if record.scope == "all":
        first = _first_in_frame_of(results, record, shifts)
        placing = None if first is None else shifts[first]
        pairs = [(results.shape(record.name, "all"), np.eye(4) if placing is None else placing)]
        where = "not aligned: no first frame is known" if first is None else f"first frame of toss {first}"
    else:
        own = _with_own_shape(results, record)
        pairs = [
            (results.shape(record.name, "one", t), np.eye(4) if shift is None else shift)
            for t, shift in shifts.items()
            if t in own
        ]
        where = "each toss's first frame (not at all where that is lost), mean over tosses with a shape"
    scored = [chamfers(shape, shift, truth) for shape, shift in pairs if len(shape.faces)]
    if not scored:
        return {}, None
    placed, fitted, cleaned = ([s.placed for s in scored], [s.fitted for s in scored], [s.cleaned for s in scored])
    n = len(scored)
    volumes = [v for shape, _ in pairs if (v := volume_error_percent(_mesh(shape), truth)) is not None]
    volume = {"volume_error": Value(_mean(volumes), "%", len(volumes), "nothing")} if volumes else {}
    values = {
        **volume,
        "cd_icp_cleaned": Value(_mean([c.cm for c in cleaned]), "cm", n, f"{where}, then rigid ICP; biggest part"),
        "cd": Value(_mean([c.cm for c in placed]), "cm", n, where),
        "cd_icp": Value(_mean([c.cm for c in fitted]), "cm", n, f"{where}, then rigid ICP"),
        "cd_icp_estimate_to_truth": Value(_mean([100 * c.estimate_to_truth_m for c in fitted]), "cm", n, "rigid ICP"),
        "cd_icp_truth_to_estimate": Value(_mean([100 * c.truth_to_estimate_m for c in fitted]), "cm", n, "rigid ICP"),
        "f_score_5mm": Value(100 * _mean([c.f_score_5mm for c in fitted]), "%", n, "rigid ICP"),
    }
    return values, scored[0].true_from_shape if record.scope == "all" else None


def _first_in_frame_of(
    results: Results, record: VariantRecord, shifts: Mapping[int, Float[Array, "4 4"] | None]
) -> int | None:
    """The first toss that is aligned and whose track is in the shape's object frame."""
    frame = results.shape(record.name, record.scope).object_frame
    tracks = results.tracks(record.name, record.scope)
    return next((t for t in sorted(shifts) if shifts[t] is not None and tracks[t].object_frame == frame), None)


def _with_own_shape(results: Results, record: VariantRecord) -> list[int]:
    """Tosses with a shape of their own: one that is lost from end to end has another's in its place."""
    return [t for t, track in results.tracks(record.name, record.scope).items() if not track.lost.all()]


@dataclass(frozen=True, eq=False)
class Chamfers:
    """Chamfer after the alignment of the poses, after a further rigid ICP (`true_from_shape`), and there of the biggest
    part alone."""

    placed: Chamfer
    fitted: Chamfer
    cleaned: Chamfer
    true_from_shape: Float[Array, "4 4"]


def chamfers(shape: ObjectShape, shift: Float[Array, "4 4"], truth: trimesh.Trimesh) -> Chamfers:
    """Distances of a shape to the true mesh; `shift` is estimated_object_from_true_object."""
    mesh, start = _mesh(shape), np.linalg.inv(shift)
    mesh.apply_transform(start)
    placed = chamfer(mesh, truth)
    closer = icp_align(surface_points(mesh, SURFACE_POINTS), surface_points(truth, SURFACE_POINTS))
    mesh.apply_transform(closer)
    fitted, biggest = chamfer(mesh, truth), biggest_component(mesh)
    return Chamfers(placed, fitted, fitted if biggest is mesh else chamfer(biggest, truth), closer @ start)


def _mesh(shape: ObjectShape) -> trimesh.Trimesh:
    import trimesh

    return trimesh.Trimesh(shape.vertices_m, shape.faces, process=False)


def _mean(values: list[float]) -> float:
    return float(np.mean(values))


def true_mesh(truth: Truth) -> trimesh.Trimesh | None:
    """The true surface, where the truth has one. Raises BadInput where it cannot be read."""
    return None if truth.mesh_path is None else load_mesh(truth.mesh_path)
