"""What `toss-view` is going to draw: gathered from a session or a results folder, before anything is drawn."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings.bounded.mesh_file import load_mesh
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.records import StampedPose
from recordings.results.folder import Masks, Results, VariantRecord, read_masks
from recordings.results.track_notes import TrackNotes, find_notes
from recordings.session import Session, Toss
from recordings.tracks import ObjectShape, RigCalibration
from recordings.view.cycle_steps import TossCycle, read_cycle

Color = tuple[int, int, int]
TRUTH: Color = (60, 200, 90)
ESTIMATES: tuple[Color, ...] = ((255, 140, 0), (220, 60, 180), (250, 220, 60), (120, 120, 255))
POSES: Color = (60, 150, 255)
GAP_BETWEEN_TOSSES_NS = 1_000_000_000
"""Tosses whose clocks overlap are laid out one after another, this far apart."""
SHOWN_FIRST = ("ours", "converged", "joint", "no-icp", "no-contact", "no-cycle", "bundlesdf-10", "bundlesdf-1")
TRUTH_NAME = "truth"
POSE_SCHEMA = "foxglove.PoseInFrame"


@dataclass(frozen=True, eq=False)
class Body:
    """One answer to where the object was, and how it looks: truth, an estimate, or the poses of a file.

    `name` is one word for entity paths. `poses[toss]` are in time order on the session clock; a lost one is NaN.
    """

    name: str
    label: str
    color: Color
    poses: Mapping[int, Sequence[StampedPose]]
    shapes: Mapping[int, ObjectShape]
    shown: bool = True
    """Whether it is seen at once; the others wait for a click in the viewer's tree."""
    masks: Mapping[int, Masks] = field(default_factory=dict)
    """Of each toss, where the body was tracked in masks."""
    notes: Mapping[int, TrackNotes] = field(default_factory=dict)
    """How it was tracked, where the tracker kept that."""
    cycle: Mapping[int, TossCycle] = field(default_factory=dict)
    """The passes that led to it, where its results folder still holds them."""

    def shape(self, toss: int) -> ObjectShape | None:
        return self.shapes.get(toss)


@dataclass(frozen=True, eq=False)
class Scene:
    """Everything that is drawn. `root` is the frame it is drawn in: `world`, or the camera where no world is known.

    `shift_ns[toss]` is added to that toss's times, so that tosses do not lie over each other (0 where they do not).
    `notes` say in words what could not be drawn.
    """

    name: str
    session: Session | None
    calibration: RigCalibration
    root: str
    bodies: tuple[Body, ...]
    tosses: tuple[int, ...]
    shift_ns: Mapping[int, int]
    spans_ns: Mapping[int, tuple[int, int]]
    notes: tuple[str, ...]

    def toss(self, toss: int) -> Toss | None:
        """The recorded toss; None where there are results only."""
        return self.session.toss(toss) if self.session is not None and toss in self.session.tosses else None

    def only(self, tosses: tuple[int, ...]) -> Scene:
        return replace(self, tosses=tosses)

    def root_from(self, frame: str) -> Transform | None:
        """`root_from_<frame>`; None where the calibration does not connect the two."""
        return self.calibration.find(self.root, frame)


def session_scene(session: Session, extra: Sequence[Body] = ()) -> Scene:
    """The scene of a session: its own poses, its truth where it has one, and `extra` bodies (results)."""
    if not session.tosses:
        raise BadInput(f"{session.path} holds no toss_XX.mcap, so there is nothing to show; record or import one first")
    bodies = (*_own_bodies(session), *_truth_body(session), *extra)
    return _scene(session.name, session, session.calibration, session.tosses, bodies)


def results_scene(results: Results, variant: str | None = None, scope: str | None = None) -> Scene:
    """The scene of a results folder: with the recording it came from where that is still there, else alone."""
    records = chosen_records(results, variant, scope)
    bodies = result_bodies(results, variant, scope)
    path = results.session_path(records[0].name, records[0].scope)
    if path is None:
        return bodies_scene(f"{records[0].session_name} results", records[0].calibration, bodies)
    scene = session_scene(Session.open(path), bodies)
    tosses = {toss.toss for record in records for toss in record.tosses}
    return scene.only(tuple(toss for toss in scene.tosses if toss in tosses))


def chosen_records(results: Results, variant: str | None, scope: str | None) -> list[VariantRecord]:
    """The variants that fit, the one that a user most likely wants first. Raises BadInput where none fits."""
    fitting = [
        results.find(name, its_scope)
        for name, its_scope in results.variants()
        if variant in (None, name) and scope in (None, its_scope)
    ]
    if not fitting:
        results.find(variant, scope)  # says what there is
    return sorted(fitting, key=lambda r: (SHOWN_FIRST.index(r.name) if r.name in SHOWN_FIRST else 99, r.scope, r.name))


def result_bodies(results: Results, variant: str | None = None, scope: str | None = None) -> list[Body]:
    """One body per variant and scope that fit; the first is shown, the others are hidden until asked for."""
    records = chosen_records(results, variant, scope)
    return [_result_body(results, record, i) for i, record in enumerate(records)]


def _result_body(results: Results, record: VariantRecord, rank: int) -> Body:
    poses, shapes = {}, {}
    for toss, track in results.tracks(record.name, record.scope).items():
        poses[toss] = tuple(
            StampedPose(int(time_ns), track.camera, track.object_frame, matrix, status)
            for time_ns, matrix, status in zip(track.time_ns, track.camera_from_object, track.status)
        )
        if record.toss(toss).shape or record.shape:
            shapes[toss] = results.shape(record.name, record.scope, toss)
    label = f"{record.label or record.name}, scope {record.scope}"
    name, color = entity_name(f"{record.name}_{record.scope}"), ESTIMATES[rank % len(ESTIMATES)]
    if rank > 0:
        return Body(name, label, color, poses, shapes, shown=False)
    masks = {t.toss: read_masks(results.path / t.masks, t.toss) for t in record.tosses if t.masks}
    found = {t.toss: find_notes(results, t.track, t.toss) for t in record.tosses}
    notes = {t: n for t, n in found.items() if n is not None}
    return Body(name, label, color, poses, shapes, True, masks, notes, read_cycle(results, record))


def bodies_scene(name: str, calibration: RigCalibration, bodies: Sequence[Body]) -> Scene:
    """A scene of tracked bodies alone (a results folder whose session is not at hand)."""
    tosses = tuple(sorted({toss for body in bodies for toss in body.poses}))
    if not tosses:
        raise BadInput(f"{name} holds no poses, so there is nothing to show")
    return _scene(name, None, calibration, tosses, bodies)


def _scene(
    name: str,
    session: Session | None,
    calibration: RigCalibration,
    tosses: tuple[int, ...],
    bodies: Sequence[Body],
) -> Scene:
    root = _root(calibration, bodies)
    spans_ns = {toss: _span_ns(session, toss, bodies) for toss in tosses}
    shift_ns = lay_out(spans_ns)
    notes = _missing(calibration, root, bodies)
    if any(shift_ns.values()):
        notes.append("the tosses' clocks overlap: they are shown one after another, times are not the recorded ones")
    return Scene(name, session, calibration, root, tuple(bodies), tosses, shift_ns, spans_ns, tuple(notes))


def lay_out(spans_ns: Mapping[int, tuple[int, int]]) -> dict[int, int]:
    """What to add to each toss's times so that none lies over another: 0 for all where the clock is one already."""
    ordered = [spans_ns[toss] for toss in sorted(spans_ns)]
    if all(before[1] < after[0] for before, after in zip(ordered, ordered[1:])):
        return dict.fromkeys(spans_ns, 0)
    shift, free_ns = {}, None
    for toss in sorted(spans_ns):
        start, end = spans_ns[toss]
        shift[toss] = 0 if free_ns is None else free_ns - start
        free_ns = end + shift[toss] + GAP_BETWEEN_TOSSES_NS
    return shift


def pose_topics(toss: Toss) -> tuple[str, ...]:
    """Topics of a toss that carry poses."""
    return tuple(topic for topic, info in toss.streams().items() if info.schema == POSE_SCHEMA)


def read_mesh(path: Path, object_frame: str, source: str) -> ObjectShape:
    """A mesh file (.obj, .ply, .stl) in metres. Raises BadInput where it cannot be read or has no triangles."""
    mesh = load_mesh(path)
    vertices_m, faces = np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64)
    return ObjectShape(object_frame, source, vertices_m, faces)


def root_poses(scene: Scene, poses: Sequence[StampedPose]) -> tuple[Int64[Array, " n"], Float[Array, "n 4 4"]]:
    """Times and `root_from_object` of the poses whose frame is known; lost ones are NaN."""
    placed = {frame: scene.root_from(frame) for frame in {pose.target for pose in poses}}
    rows = [(pose.time_ns, place.matrix @ pose.matrix) for pose in poses if (place := placed[pose.target]) is not None]
    times_ns = np.array([time_ns for time_ns, _ in rows], dtype=np.int64)
    return times_ns, np.array([matrix for _, matrix in rows], dtype=np.float64).reshape(-1, 4, 4)


def moment_ns(scene: Scene, toss: int) -> int:
    """A telling moment of a toss on its own clock: the middle of its flight as far as events or poses tell it."""
    start, end = scene.spans_ns[toss]
    recorded = scene.toss(toss)
    window = recorded.window() if recorded is not None else None
    if window is not None and window.release_time_ns is not None:
        release = window.release_time_ns
        until = window.first_impact_time_ns or min(release + 300_000_000, end)
        return (release + until) // 2
    if window is not None and window.first_impact_time_ns is not None:
        return window.first_impact_time_ns
    for body in scene.bodies:
        times_ns, matrices = root_poses(scene, body.poses.get(toss, ()))
        if scene.root == "world" and np.isfinite(matrices).any():
            return half_way_down_ns(times_ns, matrices[:, 2, 3])
    return (start + end) // 2


def half_way_down_ns(times_ns: Int64[Array, " n"], heights_m: Float[Array, " n"]) -> int:
    """When a falling body is first half way between its highest and its last height. NaN heights are passed over."""
    known = np.flatnonzero(np.isfinite(heights_m))
    times_ns, heights_m = times_ns[known], heights_m[known]
    top = int(heights_m.argmax())
    below = heights_m[top:] <= (heights_m[top] + heights_m[-1]) / 2
    return int(times_ns[top + int(below.argmax())])


def entity_name(text: str) -> str:
    """A word fit for an entity path."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", text.strip("/")) or "unnamed"


def _own_bodies(session: Session) -> list[Body]:
    """The poses that the tosses' files carry themselves, one body per topic."""
    found: dict[str, dict[int, Sequence[StampedPose]]] = {}
    for index in session.tosses:
        toss = session.toss(index)
        for topic in pose_topics(toss):
            found.setdefault(topic, {})[index] = toss.poses(topic)
    return [
        Body(
            entity_name(topic.removesuffix("/pose")),
            f"poses of {topic}",
            TRUTH if "groundtruth" in topic else POSES,
            poses,
            {},
        )
        for topic, poses in sorted(found.items())
    ]


def _truth_body(session: Session) -> list[Body]:
    folder = session.truth_folder
    if folder is None:
        return []
    poses: dict[int, Sequence[StampedPose]] = {}
    for index in session.tosses:
        file = folder / f"toss_{index:02d}.mcap"
        if file.exists():
            toss = Toss(file)
            poses[index] = toss.poses("/groundtruth/pose")
            toss.close()
    mesh = folder / "mesh.obj"
    shapes = {}
    if mesh.exists():
        shape = read_mesh(mesh, "object", "truth")
        shapes = dict.fromkeys(poses, shape)
    return [Body(TRUTH_NAME, TRUTH_NAME, TRUTH, poses, shapes)]


def _root(calibration: RigCalibration, bodies: Sequence[Body]) -> str:
    """`world` where anything is placed in it, else the frame of the colour camera, else what the poses are in."""
    frames = {frame for t in calibration.transforms for frame in (t.target, t.source)}
    targets = sorted({pose.target for body in bodies for poses in body.poses.values() for pose in poses})
    if "world" in frames or "world" in targets:
        return "world"
    if "d455" in calibration.cameras:
        return calibration.cameras["d455"].frame
    cameras = sorted(camera.frame for camera in calibration.cameras.values())
    return next(iter((*targets, *cameras)), "world")


def _missing(calibration: RigCalibration, root: str, bodies: Sequence[Body]) -> list[str]:
    notes = []
    if root != "world":
        notes.append(f"no pose of a camera in the world is known: everything is drawn as seen from {root}")
    lost = sorted(name for name, c in calibration.cameras.items() if calibration.find(root, c.frame) is None)
    if lost:
        notes.append(f"the place of {', '.join(lost)} is not calibrated: its images are shown flat only")
    for body in bodies:
        targets = {pose.target for poses in body.poses.values() for pose in poses}
        for target in sorted(t for t in targets if calibration.find(root, t) is None):
            notes.append(f"{body.label}: poses in '{target}' are not drawn, it is not connected to '{root}'")
    return notes


def _span_ns(session: Session | None, toss: int, bodies: Sequence[Body]) -> tuple[int, int]:
    """First and last time of anything that belongs to a toss."""
    ends = [p.time_ns for body in bodies for poses in [body.poses.get(toss, ())] for p in (*poses[:1], *poses[-1:])]
    if session is not None and toss in session.tosses:
        for info in session.toss(toss).streams().values():
            ends += [t for t in (info.first_ns, info.last_ns) if t is not None]
        frames = session.toss(toss).color()
        ends += [int(t) for t in (*frames.times_ns[:1], *frames.times_ns[-1:])]
    return (min(ends), max(ends)) if ends else (0, 0)
