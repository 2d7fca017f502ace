"""`toss-truth SESSION`: from the ground-truth cameras' images to the session's truth/ folder and a verdict."""

from __future__ import annotations

import contextlib
import io
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from groundtruth import se3
from groundtruth.d455_tags import D455Refinement, D455RefinementConfig, refine_by_d455
from groundtruth.offset import Fit, object_from_tagged_by_mesh, tagged_frame
from groundtruth.session_detections import (
    assign_roles,
    enlarged,
    find_tags,
    measured_sizes_m,
    shared_times,
    shrink_px,
    triangulated_tags,
)
from groundtruth.session_solve import Solved, solve_session
from groundtruth.tagslam.answer import pose_rows, reprojection
from groundtruth.toss_truth import Status, TossTruth, TrackedLimits, at_color_frames
from groundtruth.verdict import Verdict, judge
from recordings.bounded.documents import json_object
from recordings.bounded.mesh_file import load_mesh
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.progress import Progress, Silent
from recordings.records import StampedPose
from recordings.session import Session
from recordings.session_writer import write_truth
from recordings.sync import clock_offset_ns
from recordings.whole_file import write_json

LATE_S = 0.0007
"""Mono stamps that are off by more are told: 1 ms is 2 mm and 0.7 degrees."""


@dataclass(frozen=True, eq=False)
class TruthConfig:
    """`tag_size_m` None: measured between the cameras. `layout`: tagged_from_tag of the object's tags, where known."""

    family: str = "tag36h11"
    tag_size_m: float | None = None
    ignored: frozenset[int] = frozenset()
    layout: Mapping[int, Float[Array, "4 4"]] | None = None
    layout_sizes_m: Mapping[int, float] | None = None
    sync_s: float = 0.0005
    """Images of different cameras nearer than this are one instant."""
    size_trust: float = 0.015
    """A given tag size may differ from the measured one by this share: corners of small tags lie a little inside."""
    limits: TrackedLimits = field(default_factory=TrackedLimits)
    mono_only: bool = False
    """Leave out what the D455 itself saw of the tags next to impacts."""


@dataclass(frozen=True, eq=False)
class SessionTruth:
    solved: Solved
    tosses: Mapping[int, TossTruth]
    verdict: Verdict
    sizes_m: Mapping[int, float]
    d455_refinement: D455Refinement | None = None


def find_truth(
    session: Session, tosses: Sequence[int], config: TruthConfig | None = None, progress: Progress | None = None
) -> SessionTruth:
    """Detect, solve, smooth, interpolate, judge. Raises BadInput or Undetermined with what to do."""
    config, progress = config or TruthConfig(), progress or Silent()
    calibration = session.calibration
    offset_ns = clock_offset_ns(calibration.residuals, "mono")
    detections = find_tags(session, tosses, config.family, offset_ns, progress)
    for camera in {c for cameras in detections.frames.values() for c in cameras}:
        calibration.camera(camera)
    detections, spread_ns = shared_times(detections, round(config.sync_s * 1e9))
    roles = assign_roles(detections, calibration, config.ignored, config.layout)
    triangulated = triangulated_tags(detections, calibration)
    measured = measured_sizes_m(triangulated, roles.body | roles.still)
    sizes, size_notes = _sizes(config, roles.body | roles.still, roles.body, measured)
    known = {t.tag_id: t.size_m for t in calibration.table_tags if t.tag_id in roles.table}
    known |= {i: s for i, s in sizes.items() if i in _given(config, roles.body)}
    short_px = shrink_px(triangulated, known)
    detections = enlarged(detections, short_px)
    size_notes += (
        [f"tags' edges appear {short_px:.2f} px short; corners moved outwards by that"]
        if abs(short_px) >= 0.005
        else []
    )
    solved = _in_tagged_frame(
        solve_session(detections, roles, sizes, calibration, config.layout, progress=progress), config
    )
    size_notes += [f"time offset of the mono cameras applied: {offset_ns / 1e6:.2f} ms"] if offset_ns else []
    truths = {t: at_color_frames(t, session.toss(t).color().times_ns, solved, config.limits) for t in tosses}
    own, lost = None, 0
    if not config.mono_only:
        refinement = D455RefinementConfig(config.family)
        own, lost = refine_by_d455(session, truths, solved, config.limits, refinement, progress)
    detections = replace(detections, lost_images=detections.lost_images + lost)
    notes = [*size_notes, *_refinement_notes(truths, own)]
    verdict = judge(solved, detections, spread_ns, notes, calibration)
    if own is not None and (late := _late(own, session)):
        verdict = replace(verdict, warnings=(*verdict.warnings, late))
    final = {toss: t.without_guesses() for toss, t in (own.tosses if own is not None else truths).items()}
    return SessionTruth(solved, final, verdict, sizes, own)


def _late(own: D455Refinement, session: Session) -> str | None:
    """The stamps of the mono cameras, as the D455's view of the same motion has them."""
    if abs(own.offset_s) <= max(LATE_S, 4 * own.offset_std_s):
        return None
    return (
        f"the mono cameras' stamps are off by {1e3 * own.offset_s:.1f} +- {1e3 * own.offset_std_s:.1f} ms against the "
        f"colour camera's, by the tags in its own images: run `toss-calibrate time {session.path}`, then this again "
        "with --replace"
    )


def _refinement_notes(truths: Mapping[int, TossTruth], own: D455Refinement | None) -> list[str]:
    """What the D455's own view of the tags was good for."""
    still_open = sum(int(t.open.sum()) for t in truths.values())
    if own is None:
        return [f"next to impacts {still_open} poses are interpolated between the triggers"] if still_open else []
    return [
        f"next to impacts {own.frames} of {still_open} poses are placed by the tags in the colour images themselves "
        f"(median {own.corner_px:.2f} px at sure poses; the D455 stands {1000 * own.off_m:.2f} mm and "
        f"{np.degrees(own.off_rad):.3f} deg from its place)"
    ]


def _sizes(
    config: TruthConfig, ids: frozenset[int], body: frozenset[int], measured: Mapping[int, tuple[float, int]]
) -> tuple[dict[int, float], list[str]]:
    """Each tag's side, and notes. A given size is checked against what the cameras measure; their ratio is common."""
    given = _given(config, body)
    ratios = np.array([measured[i][0] / given[i] for i in sorted(given) if i in measured])
    pairs = np.array([measured[i][1] for i in sorted(given) if i in measured])
    sizes = {i: m for i, (m, _) in measured.items() if i in ids}
    if len(ratios):
        ratio = _weighted_median(ratios, pairs)
        error = float(np.std(ratios) / np.sqrt(len(ratios))) if len(ratios) > 1 else 0.01
        if abs(ratio - 1) > max(config.size_trust, 3 * error):
            right = 1000 * ratio * float(np.median(list(given.values())))
            raise BadInput(
                f"the tags' size is wrong: the cameras measure {ratio:.3f} times the given one, that is {right:.2f} mm "
                f"({int(pairs.sum())} pairs of views); wanted the side of the black square in metres: "
                f"`--tag-size {right / 1000:.5f}`"
            )
        note = f"tag size: measured / given = {ratio:.4f} +- {error:.4f} ({int(pairs.sum())} pairs of views)"
        return sizes | given, [note]
    sizes |= given
    unknown = sorted(body - set(sizes))
    if unknown and not sizes.keys() & body:
        raise BadInput(
            "the size of the object's tags is not known, and no tag was seen by two cameras of known place at once; "
            "give the side of the black square in metres: `--tag-size 0.05`"
        )
    common = float(np.median([sizes[i] for i in sorted(sizes.keys() & body)]))
    notes = [] if given else [f"tag size measured by triangulation: {1000 * common:.2f} mm"]
    return sizes | dict.fromkeys(unknown, common), notes


def _given(config: TruthConfig, body: frozenset[int]) -> dict[int, float]:
    given = {i: s for i, s in (config.layout_sizes_m or {}).items() if i in body}
    return given | (dict.fromkeys(body - set(given), config.tag_size_m) if config.tag_size_m is not None else {})


def _weighted_median(values: Float[Array, " n"], weights: Int64[Array, " n"]) -> float:
    order = np.argsort(values)
    heaps = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(heaps, 0.5 * heaps[-1])])


def _in_tagged_frame(solved: Solved, config: TruthConfig) -> Solved:
    """The solution with the body's frame moved to `tagged` (a given layout's frame stays)."""
    if config.layout is not None:
        return solved
    old_from_new = tagged_frame(solved.layout)
    new_from_old = np.linalg.inv(old_from_new)
    carry = se3.adjoint(new_from_old[None])[0]
    tracks = {
        toss: replace(
            t, world_from_tagged=t.world_from_tagged @ old_from_new, covariance=carry @ t.covariance @ carry.T
        )
        for toss, t in solved.tracks.items()
    }
    center = new_from_old[:3, :3] @ solved.center_m + new_from_old[:3, 3]
    layout = {i: new_from_old @ pose for i, pose in solved.layout.items()}
    return replace(solved, tracks=tracks, layout=layout, center_m=center)


def fit_mesh(truth: SessionTruth, mesh_path: Path) -> Fit:
    """Where the tags lie on a known shape. Raises BadInput where they fit nowhere."""
    mesh = load_mesh(mesh_path)
    fit = object_from_tagged_by_mesh(
        truth.solved.layout, truth.sizes_m, np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    )
    if fit.rms_m > 0.01:
        size = 1000 * np.ptp(np.asarray(mesh.vertices), axis=0)
        raise BadInput(
            f"{mesh_path} does not fit the tags: they stay {1000 * fit.rms_m:.1f} mm off its surface; it measures "
            f"{size[0]:.0f} x {size[1]:.0f} x {size[2]:.0f} mm. Wanted the tossed object's shape, in metres"
        )
    return fit


def write_session_truth(
    truth: SessionTruth, out: Path, object_from_tagged: Transform | None, mesh_path: Path | None
) -> dict[str, Any]:
    """truth.json, toss_XX.mcap, mesh.obj and tags/ into the new folder `out`; returns truth.json's document."""
    poses = {toss: _stamped(t) for toss, t in truth.tosses.items()}
    document = truth_document(truth, object_from_tagged)
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".truth-") as scratch:
        folder = write_truth(Path(scratch), poses, document, _obj_bytes(mesh_path) if mesh_path is not None else None)
        _write_layers(folder / "tags", truth)
        folder.rename(out)
    return document


def replace_folder(old: Path) -> None:
    """Remove an earlier truth/ of this command; someone else's is left alone. Raises BadInput."""
    source = {}
    with contextlib.suppress(OSError):
        source = json_object((old / "truth.json").read_bytes())
    if str(source.get("source", "")).startswith("toss-truth"):
        shutil.rmtree(old)
        return
    raise BadInput(f"{old} was not made by toss-truth, so it is not replaced; move it away, or write to `--out FOLDER`")


def _stamped(truth: TossTruth) -> list[StampedPose]:
    return [
        StampedPose(int(t), "world", "tagged", pose, status, cov if status != "lost" else None)
        for t, pose, status, cov in zip(
            truth.time_ns, truth.world_from_tagged, truth.status, truth.covariance, strict=True
        )
    ]


def truth_document(truth: SessionTruth, object_from_tagged: Transform | None) -> dict[str, Any]:
    """What truth.json says: source, accuracy, layout, cameras, residuals, verdict."""
    solved = truth.solved
    sigmas = np.concatenate([np.sqrt(np.einsum("nii->ni", t.covariance)) for t in truth.tosses.values()])
    sigmas = sigmas[np.isfinite(sigmas).all(axis=1)]
    distances = np.concatenate([np.linalg.norm(c.left_px, axis=1) for c in solved.corners])
    return {
        "source": "toss-truth: AprilTags in the ground-truth cameras, one factor graph over all tosses",
        "accuracy": {
            "position_sigma_m": float(np.sqrt((sigmas[:, 3:] ** 2).sum(axis=1).mean())) if len(sigmas) else None,
            "rotation_sigma_rad": float(np.sqrt((sigmas[:, :3] ** 2).sum(axis=1).mean())) if len(sigmas) else None,
            "reprojection_px": reprojection(distances),
        },
        **({"object_from_tagged": object_from_tagged.matrix.tolist()} if object_from_tagged is not None else {}),
        "tags": [
            {"id": i, "size_m": truth.sizes_m[i], "T_tagged_tag": pose.tolist()} for i, pose in solved.layout.items()
        ],
        "cameras": {
            name: {
                "world_from_camera": pose_rows(pose[None])[0],
                "sigma_rad_m": np.sqrt(np.diag(solved.camera_covariance[name])).tolist(),
            }
            for name, pose in solved.cameras.items()
        },
        "center_of_mass_tagged_m": solved.center_m.tolist(),
        "frames": {str(toss): {s: t.status.count(s) for s in get_args(Status)} for toss, t in truth.tosses.items()},
        **({"d455_refinement": truth.d455_refinement.document()} if truth.d455_refinement is not None else {}),
        "verdict": truth.verdict.document(),
    }


def _obj_bytes(path: Path) -> bytes:
    import trimesh

    if path.suffix.lower() == ".obj":
        return path.read_bytes()
    mesh = load_mesh(path)
    return str(trimesh.exchange.obj.export_obj(mesh)).encode()


def _write_layers(folder: Path, truth: SessionTruth) -> None:
    """What toss-view draws: every tag's corners and what is left of them, the track with its covariance, cameras."""
    folder.mkdir()
    solved = truth.solved
    names = sorted(solved.cameras)
    for toss, track in solved.tracks.items():
        mine = [c for c in solved.corners if c.toss == toss]
        buffer = io.BytesIO()
        np.savez(
            buffer,
            camera=np.array([names.index(c.camera) for c in mine], np.int64),
            time_ns=np.array([c.time_ns for c in mine], np.int64),
            tag_id=np.array([c.tag_id for c in mine], np.int64),
            seen_px=np.array([c.seen_px for c in mine], np.float64).reshape(-1, 4, 2),
            left_px=np.array([c.left_px for c in mine], np.float64).reshape(-1, 4, 2),
            track_time_ns=track.time_ns,
            track_world_from_tagged=track.world_from_tagged,
            track_covariance=track.covariance,
        )
        (folder / f"toss_{toss:02d}.npz").write_bytes(buffer.getvalue())
    cameras = {
        name: {"world_from_camera": pose.tolist(), "covariance": solved.camera_covariance[name].tolist()}
        for name, pose in solved.cameras.items()
    }
    write_json(folder / "cameras.json", {"names": names, "cameras": cameras})
