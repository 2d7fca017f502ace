"""A tiny session for the tests of toss-view, and an .rrd read back."""

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.records import (
    ArmStates,
    DepthImage,
    EncodedImage,
    HealthLine,
    StampedPose,
    TossEvent,
)
from recordings.results.folder import TossRecord, VariantRecord, write_shape, write_track, write_variant
from recordings.session_writer import SessionWriter, write_truth
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration, TagPlacement
from recordings.view.draw import save_rrd

FRAMES, STEP_NS, TOSS_NS = 6, 33_000_000, 2_000_000_000
DEPTH_LATER_NS = 5_000_000
WIDTH, HEIGHT = 64, 48
CUBE = ObjectShape(
    "object",
    "known",
    np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05)]),
    np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
              [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]),
)  # fmt: skip
LENS = (-0.25, 0.08, 0.001, -0.002, 0.01)
LOST = 3
DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
"""A camera that looks straight down on the table."""


@dataclass(frozen=True)
class Rrd:
    """An .rrd read back: rows by entity and component, each with its times."""

    path: Path

    def entities(self):
        return {chunk.entity_path for chunk in self.chunks()}

    def chunks(self):
        return RrdReader(self.path).stream().to_chunks()

    def rows(self, entity, component):
        """(time_ns, toss, values) of every row in time order; time and toss are None for static ones."""
        found = []
        for chunk in self.chunks():
            if chunk.entity_path != entity:
                continue
            batch = chunk.to_record_batch()
            if component not in batch.schema.names:
                continue
            for i in range(chunk.num_rows):
                if chunk.is_static:
                    time_ns = toss = None
                else:
                    time_ns, toss = batch.column("time")[i].value, batch.column("toss")[i].as_py()
                found.append((time_ns, toss, batch.column(component)[i].as_py()))
        return sorted(found, key=lambda row: row[0] or 0)

    def timelines(self):
        return {name for chunk in self.chunks() for name in chunk.timeline_names}


def rig(where=True, arm=True, mono=True):
    """A colour camera 1 m above the table that looks down through a distorting lens, a mono camera, an arm's base."""
    K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    cameras = {"d455": CameraModel("d455", WIDTH, HEIGHT, K, "brown-conrady", LENS)}
    if mono:
        cameras["mono0"] = CameraModel("mono0", WIDTH, HEIGHT, K)
    transforms = [Transform("world", "d455", DOWN, np.array([0, 0, 1.0]))] if where else []
    if where and arm:
        transforms.append(Transform("world", "base", np.eye(3), np.array([0.5, 0, 0])))
    tag = TagPlacement(7, 0.08, Transform("world", "tag_7", DOWN, np.array([0.1, 0.1, 0])))
    return RigCalibration(cameras, tuple(transforms), (tag,) if where else ())


def falling(time_ns, start_ns):
    """`world_from_object` of a body that falls from 0.3 m and turns."""
    t = (time_ns - start_ns) / 1e9
    return Transform("world", "object", rotation_exp(np.array([0, 0, 4 * t])), np.array([0.1 * t, 0, 0.3 - 1.2 * t]))


def frame(index, time_ns, camera="d455"):
    rgb = np.full((HEIGHT, WIDTH, 3), (40, 90, 200), dtype=np.uint8)
    rgb[10:20, 4 * index : 4 * index + 10] = (250, 30, 30)
    image = rgb[..., ::-1] if camera == "d455" else rgb[..., 0]
    data = cv2.imencode(".jpg", image)[1].tobytes()
    return EncodedImage(camera, index, time_ns, time_ns, "jpeg", WIDTH, HEIGHT, data)


def write_toss(toss, start_ns, arm):
    depth = np.full((HEIGHT, WIDTH), 4000, dtype=np.uint16)  # 1 m in quarters of a millimetre
    depth[:, :8] = 0
    for i in range(FRAMES):
        time_ns = start_ns + i * STEP_NS
        toss.color(frame(i, time_ns))
        later_ns = time_ns + DEPTH_LATER_NS
        toss.depth(DepthImage("d455", i, later_ns, later_ns, 0.00025, depth))
        toss.mono(frame(i, time_ns + 1, "mono0"))
    toss.mask(0, np.eye(HEIGHT, WIDTH, dtype=bool))
    toss.event(TossEvent(start_ns + STEP_NS, "release", "command"))
    toss.event(TossEvent(start_ns + 3 * STEP_NS, "first_impact", "sound"))
    toss.health(HealthLine(start_ns, "warning", "d455", "one frame late"))
    if arm:
        times_ns = start_ns + np.arange(0, 5 * STEP_NS, 1_000_000)
        q = (
            np.tile([0.1, -0.5, 0.2, -1.9, 0.0, 1.5, 0.7], (len(times_ns), 1))
            + np.linspace(0, 0.1, len(times_ns))[:, None]
        )
        names = tuple(f"panda_joint{i}" for i in range(1, 8))
        toss.arm(ArmStates(times_ns, names, q, np.zeros_like(q), np.full(len(q), 0.04)))


def make_session(folder, calibration=None, starts_ns=(0, TOSS_NS), arm=True, truth=True):
    calibration = calibration or rig()
    poses = {}
    with SessionWriter(folder, {"name": "tiny", "object": {"name": "block"}}, calibration) as writer:
        for index, start_ns in enumerate(starts_ns):
            with writer.toss(index) as toss:
                write_toss(toss, start_ns, arm)
            poses[index] = [truth_pose(start_ns + i * STEP_NS, start_ns, lost=i == LOST) for i in range(FRAMES)]
        writer.finish("complete")
    if truth:
        write_truth(folder, poses, {"source": "test"}, obj(CUBE))
    return folder


def truth_pose(time_ns, start_ns, lost=False):
    matrix = np.full((4, 4), np.nan) if lost else falling(time_ns, start_ns).matrix
    return StampedPose(time_ns, "world", "object", matrix, "lost" if lost else "tracked")


def obj(shape):
    lines = ["v {} {} {}".format(*v) for v in shape.vertices_m] + ["f {} {} {}".format(*(f + 1)) for f in shape.faces]
    return "\n".join(lines).encode()


def make_results(folder, session, names=("ours", "bundlesdf-1"), session_path="..", scope="all"):
    """Results whose tracks are the truth, seen by the camera, frame LOST lost."""
    camera_from_world = rig().transform("d455", "world")
    stage = folder / "track-00000000"
    stage.mkdir(parents=True)
    write_shape(stage, CUBE)
    for toss in (0, 1):
        times_ns = toss * TOSS_NS + np.arange(FRAMES) * STEP_NS
        poses = np.array([(camera_from_world @ falling(t, toss * TOSS_NS)).matrix for t in times_ns])
        poses[LOST] = np.nan
        status = tuple("lost" if i == LOST else "tracked" for i in range(FRAMES))
        write_track(
            stage, ObjectTrack(toss, "d455", "object", times_ns, poses, status, np.full((FRAMES, 6, 6), np.nan))
        )
    tosses = tuple(TossRecord(toss, stage.name) for toss in (0, 1))
    for name in names:
        record = VariantRecord(
            name, scope, f"label of {name}", session.name, "block", rig(), tosses, stage.name, session_path=session_path
        )
        write_variant(folder, record)
    return folder


@pytest.fixture(scope="session")
def tiny():
    """What the tests of the view are made of: the constants and builders above."""
    return SimpleNamespace(
        FRAMES=FRAMES, STEP_NS=STEP_NS, TOSS_NS=TOSS_NS, DEPTH_LATER_NS=DEPTH_LATER_NS, WIDTH=WIDTH, HEIGHT=HEIGHT,
        LOST=LOST, DOWN=DOWN, CUBE=CUBE, Rrd=Rrd, rig=rig, falling=falling, frame=frame, make_session=make_session,
        make_results=make_results,
    )  # fmt: skip


@pytest.fixture(scope="session")
def session(tiny, tmp_path_factory):
    return tiny.make_session(tmp_path_factory.mktemp("view") / "tiny")


@pytest.fixture(scope="session")
def rrd(tiny, session):
    out = session.parent / "tiny.rrd"
    save_rrd(session, out)
    return tiny.Rrd(out)
