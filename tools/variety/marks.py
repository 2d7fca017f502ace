"""What a processed session is worth: pose scores, wrong frames that were not flagged, covariances, shape, friction."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.evaluate.learned_values import learned_values
from processing.evaluate.score import Value, chamfers, score_variant, true_mesh
from processing.evaluate.truth import Truth, open_truth
from recordings.geometry import rotation_exp, rotation_log
from recordings.results.folder import Results, VariantRecord
from recordings.session import Session
from recordings.tracks import ObjectTrack

WRONG_DEG, WRONG_M = 5.0, 0.02
CHI2_6_95 = 12.592
"""95 % of a chi-squared variable of six degrees of freedom."""
LEAST_VARIANCE = 1e-10
"""A pose that is claimed to be known better than 0.01 mm and 0.01 mrad is where a track defined its object frame."""
TURNED = ("can", "bottle", "bowl")
"""Bodies of revolution about their z; plain ones show no turn about it."""


@dataclass(frozen=True)
class Marks:
    """Of one session and one tracker. `add`, `adds`, `success` in percent; Chamfer in cm; `nees` a mean over six
    degrees of freedom (1: as claimed); `mask_iou` a mean over frames; None where there is nothing to judge."""

    frames: int
    lost: int
    flagged: int
    silent: int
    silent_tosses: int
    add: float
    adds: float
    success: float
    chamfer_cm: float | None
    inside_95: float | None
    nees: float | None
    friction: float | None
    friction_inside: bool | None
    restitution: float | None
    mask_iou: float | None = None


def read_marks(results_path: Path, session_path: Path, truth_path: Path) -> Marks:
    """Marks of the one variant in a results folder."""
    results, session = Results.open(results_path), Session.open(session_path)
    try:
        record = results.find()
        truth = open_truth(truth_path, session, record.calibration)
        assert truth is not None
        found = _marks(results, record, truth, json.loads((truth_path / "spec.json").read_text()))
        tosses = results.tracks(record.name, record.scope)
        overlaps = [
            overlap(results.masks(record.name, record.scope, t), _masks(truth_path / f"toss_{t:02d}")) for t in tosses
        ]
        return replace(found, mask_iou=float(np.mean(np.concatenate(overlaps))) if overlaps else None)
    finally:
        session.close()


def _marks(results: Results, record: VariantRecord, truth: Truth, spec: Mapping[str, Any]) -> Marks:
    scored = score_variant(results, record, truth)
    tracks = results.tracks(record.name, record.scope)
    round_body = spec["family"] in TURNED and spec["surface"] == "plain"
    wrong, tracked, frames, errors, tosses = 0, 0, 0, [], 0
    for track in tracks.values():
        true = truth.camera_from_object(track)
        if true is None:
            continue
        silent = silent_wrong(track, true, round_body)
        wrong, frames = wrong + int(silent.sum()), frames + len(silent)
        tosses += bool(silent.any())
        tracked += sum(s == "tracked" for s in track.status)
        errors.append(normalised_errors(track, true))
    nees = np.concatenate(errors) if errors else np.zeros(0)
    learned = learned_values(results, record)
    friction, inside = learned.get("friction"), None
    if friction is not None and truth.friction is not None and friction.low is not None and friction.high is not None:
        inside = bool(friction.low <= truth.friction <= friction.high)
    value = scored.values
    return Marks(
        frames, sum(int(t.lost.sum()) for t in tracks.values()), frames - tracked, wrong, tosses,
        _of(value, "add_auc") or 0.0, _of(value, "adds_auc") or 0.0, _of(value, "success_5deg_5cm") or 0.0,
        _of(value, "cd_icp"), float((nees < CHI2_6_95).mean()) if len(nees) else None,
        float(nees.mean() / 6) if len(nees) else None, _of(learned, "friction"), inside,
        _of(learned, "restitution"),
    )  # fmt: skip


def overlap(found: Sequence[Bool[Array, "h w"]], true: Sequence[Bool[Array, "h w"]]) -> Float[Array, " n"]:
    """Intersection over union of each frame's mask and its visible true pixels; frames that show none are left out."""
    pairs = [(np.asarray(f, dtype=bool), t) for f, t in zip(found, true) if t.any()]
    return np.array([(f & t).sum() / (f | t).sum() for f, t in pairs], dtype=np.float64)


def _of(values: Mapping[str, Value], name: str) -> float | None:
    return values[name].value if name in values and np.isfinite(values[name].value) else None


def silent_wrong(track: ObjectTrack, true: Float[Array, "n 4 4"], round_body: bool) -> Bool[Array, " n"]:
    """Frames called tracked that are off by more than WRONG_DEG or WRONG_M; a toss is aligned at its first tracked one.
    Of a plain body of revolution only the direction of its axis is judged."""
    out = np.zeros(len(track.status), dtype=bool)
    known = np.array([s == "tracked" for s in track.status]) & np.isfinite(true).all(axis=(1, 2))
    if not known.any():
        return out
    first = int(np.flatnonzero(known)[0])
    shift = np.linalg.inv(track.camera_from_object[first]) @ true[first]
    for k, status in enumerate(track.status):
        if status != "tracked" or not np.isfinite(true[k]).all():
            continue
        found = track.camera_from_object[k] @ shift
        if round_body:
            cosine = float(np.clip(found[:3, 2] @ true[k][:3, 2], -1, 1))
            angle = np.degrees(np.arccos(cosine))
        else:
            angle = np.degrees(np.linalg.norm(rotation_log(_orthonormal(found[:3, :3] @ true[k][:3, :3].T))))
        out[k] = angle > WRONG_DEG or np.linalg.norm(found[:3, 3] - true[k][:3, 3]) > WRONG_M
    return out


def normalised_errors(track: ObjectTrack, true: Float[Array, "n 4 4"]) -> Float[Array, " m"]:
    """e^T C^-1 e of the tracked frames with a covariance: rotation vector and shift in camera axes. The object frame,
    which nobody knows, is the one in which the track is most plausible by its own covariances: a track that is sure of
    its first frame, where it defined its object frame, is judged by how it goes on from there."""
    rows = [
        k for k, s in enumerate(track.status)
        if s == "tracked" and np.isfinite(true[k]).all() and np.isfinite(track.covariance[k]).all()
    ]  # fmt: skip
    if len(rows) < 2:
        return np.zeros(0)
    found, wanted = track.camera_from_object[rows], true[rows]
    weight = np.linalg.inv(track.covariance[rows] + LEAST_VARIANCE * np.eye(6))
    surest = int(np.argmax(np.linalg.slogdet(weight)[1]))
    frame = np.linalg.inv(wanted[surest]) @ found[surest]
    for _ in range(10):
        error, turned = _errors(found, wanted @ frame), (wanted @ frame)[:, :3, :3]
        each = weight / (1 + np.einsum("ni,nij,nj->n", error, weight, error) / 6)[:, None, None]
        J = np.zeros((len(rows), 6, 6))
        J[:, :3, :3] = J[:, 3:, 3:] = turned
        normal = np.einsum("nji,njk,nkl->il", J, each, J)
        step = np.linalg.solve(normal, np.einsum("nji,njk,nk->i", J, each, error))
        move = np.eye(4)
        move[:3, :3], move[:3, 3] = rotation_exp(step[:3]), step[3:]
        frame = frame @ move
    error = _errors(found, wanted @ frame)
    chosen = np.trace(track.covariance[rows], axis1=1, axis2=2) > LEAST_VARIANCE  # not where the frame was defined
    return np.asarray(np.einsum("ni,nij,nj->n", error, weight, error)[chosen])


def _errors(found: Float[Array, "n 4 4"], wanted: Float[Array, "n 4 4"]) -> Float[Array, "n 6"]:
    turns = [rotation_log(_orthonormal(f[:3, :3] @ w[:3, :3].T)) for f, w in zip(found, wanted)]
    return np.concatenate([np.array(turns), found[:, :3, 3] - wanted[:, :3, 3]], axis=1)


def _orthonormal(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """The rotation nearest to any matrix, however far (a mean of rotations that scatter is far)."""
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt


def fusion_floor_cm(session_path: Path, truth_path: Path, place: Path) -> float | None:
    """Chamfer distance of what all tosses show, fused at the true poses within the true masks, with the true depth
    scale and at the true times of depth: no estimate is in it. None where nothing can be fused."""
    from processing.config import Config
    from processing.field.fuse import fuse
    from processing.field.learn import TossViews, chosen_views
    from processing.field.mesh import grid_mesh
    from processing.pipeline.start import start_run
    from processing.sensor.frames import metric_frames
    from recordings.errors import BadInput
    from recordings.progress import Silent

    session = Session.open(session_path)
    try:
        run = start_run(session, session.tosses, place, Config(), "multi-hypothesis", lambda _: Silent())
        truth = open_truth(truth_path, session, session.calibration)
        mesh = None if truth is None else true_mesh(truth)
        if truth is None or mesh is None:
            return None
        sensor = json.loads((truth_path / "sensor_truth.json").read_text())
        late_ns = np.int64(round(1e9 * sensor["depth_delay_s"]))
        tosses = []
        for number in session.tosses:
            frames = metric_frames(session.toss(number).rgbd("d455"), float(sensor["depth_scale"]))
            track = _known(ObjectTrack.nowhere(number, run.camera.frame, frames.times_ns), truth)
            masks = _masks(truth_path / f"toss_{number:02d}")
            tosses.append(TossViews(frames, frames.times_ns + late_ns, masks, track))
        views = chosen_views(tosses, run.camera, run.config.shape)
        return chamfers(grid_mesh(fuse(views, run.config.shape.field.fuse)), np.eye(4), mesh).fitted.cm
    except BadInput:
        return None
    finally:
        session.close()


def _known(track: ObjectTrack, truth: Truth) -> ObjectTrack:
    poses = truth.camera_from_object(track)
    assert poses is not None
    status = tuple("tracked" if np.isfinite(p).all() else "lost" for p in poses)
    return replace(track, camera_from_object=poses, status=status)  # type: ignore[arg-type]


def _masks(folder: Path) -> list[Bool[Array, "h w"]]:
    import cv2

    return [cv2.imread(str(p), cv2.IMREAD_GRAYSCALE) > 0 for p in sorted((folder / "masks").glob("*.png"))]
