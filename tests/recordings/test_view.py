"""toss-view: what a session, a file and a results folder become in rerun, read back from the .rrd."""

import json
import shutil
import socket
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from rerun.chunk import RrdReader

from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.records import (
    ArmStates,
    DepthImage,
    EncodedImage,
    HealthLine,
    StampedPose,
    TossEvent,
)
from recordings.results import TossRecord, VariantRecord, write_shape, write_track, write_variant
from recordings.robot import panda
from recordings.session_writer import SessionWriter, write_truth
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration, TagPlacement
from recordings.view import Choice, is_foreign, open_scene, save_rrd, screenshot, stream
from recordings.view_layers import TIME, Look
from recordings.view_mesh import outline_px, vertex_normals
from recordings.view_scene import half_way_down_ns, lay_out, moment_ns
from recordings.view_viewer import LOOPBACK, Viewer, ViewerFailed, rerun_program, run_rerun

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


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    return make_session(tmp_path_factory.mktemp("view") / "tiny")


@pytest.fixture(scope="module")
def rrd(session):
    out = session.parent / "tiny.rrd"
    save_rrd(session, out)
    return Rrd(out)


def test_the_file_passes_reruns_own_verification(rrd):
    done = subprocess.run([rerun_program(), "rrd", "verify", rrd.path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_session_clock_is_the_time_line_and_tosses_have_their_own(rrd):
    assert rrd.timelines() == {"time", "toss"}
    times = [(t, toss) for t, toss, _ in rrd.rows("/world/seen_by/d455", "Points3D:positions")]
    wanted = [(s + i * STEP_NS + DEPTH_LATER_NS, n) for n, s in enumerate((0, TOSS_NS)) for i in range(FRAMES)]
    assert times == wanted  # the cloud stands at the depth's own exposure


def test_images_are_kept_byte_for_byte_at_their_own_times(rrd):
    rows = rrd.rows("/world/cameras/d455/image", "EncodedImage:blob")
    assert [t for t, _, _ in rows][:FRAMES] == [i * STEP_NS for i in range(FRAMES)]
    blob = np.array(rows[2][2][0], dtype=np.uint8).tobytes()
    assert blob == frame(2, 0).data


def test_the_cloud_lies_on_the_table_where_the_distorting_lens_says(rrd):
    _, _, points = rrd.rows("/world/seen_by/d455", "Points3D:positions")[0]
    points = np.array(points)
    assert len(points) == (WIDTH - 8) * HEIGHT  # 8 columns have no depth
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-6)
    u, v = np.meshgrid(np.arange(8, WIDTH), np.arange(HEIGHT))
    model = rig().camera("d455")
    back = model.project(rig().transform("d455", "world").points(points))
    np.testing.assert_allclose(back, np.stack([u, v], -1).reshape(-1, 2), atol=0.05)  # 1/2048 m at 60 px per m
    straight = CameraModel("d455", WIDTH, HEIGHT, model.K).project(rig().transform("d455", "world").points(points))
    assert np.abs(straight - back).max() > 0.3  # without the lens it would be elsewhere


def test_the_cloud_has_the_colours_of_its_pixels(rrd):
    _, _, colors = rrd.rows("/world/seen_by/d455", "Points3D:colors")[0]
    rgb = (np.array(colors)[:, None] >> np.array([24, 16, 8])) & 255
    blue = np.abs(rgb - (40, 90, 200)).max(axis=1) < 12
    assert blue.mean() > 0.8


def test_depth_keeps_its_unit(rrd):
    _, _, meter = rrd.rows("/depth/d455", "DepthImage:meter")[0]
    assert meter == pytest.approx([4000.0])


def test_a_large_image_is_thinned_to_the_number_of_points_asked_for(session, tmp_path):
    save_rrd(session, tmp_path / "thin.rrd", look=Look(cloud_points=200))
    _, _, points = Rrd(tmp_path / "thin.rrd").rows("/world/seen_by/d455", "Points3D:positions")[0]
    assert 100 < len(points) <= 200


def test_truth_moves_as_it_was_written_and_is_not_drawn_where_it_was_lost(rrd):
    rows = rrd.rows("/world/object/truth", "Transform3D:translation")
    rows = [(t, value[0]) for t, toss, value in rows if value and toss == 0]
    assert [t for t, _ in rows] == [i * STEP_NS for i in range(FRAMES) if i != LOST]
    for time_ns, place in rows:
        np.testing.assert_allclose(place, falling(time_ns, 0).translation_m, atol=1e-6)
    clears = [t for t, toss, _ in rrd.rows("/world/object/truth", "Clear:is_recursive") if toss == 0]
    assert LOST * STEP_NS in clears
    shapes = [t for t, toss, value in rrd.rows("/world/object/truth/shape", "Mesh3D:vertex_positions") if toss == 0]
    assert shapes == [0, (LOST + 1) * STEP_NS]  # drawn anew where it is found again


def test_the_path_is_broken_where_the_object_was_lost(rrd):
    strips = next(value for _, toss, value in rrd.rows("/world/path/truth", "LineStrips3D:strips") if toss == 0)
    assert [len(strip) for strip in strips] == [LOST, FRAMES - LOST - 1]


def test_the_outline_surrounds_the_object_through_the_lens(rrd):
    camera, lens = rig().transform("d455", "world"), rig().camera("d455")
    _, _, strips = rrd.rows("/world/cameras/d455/image/outline_truth", "LineStrips2D:strips")[1]
    seen = np.vstack([np.array(strip) for strip in strips])
    corners = lens.project((camera @ falling(STEP_NS, 0)).points(CUBE.vertices_m))
    np.testing.assert_allclose(seen.min(axis=0), corners.min(axis=0), atol=0.3)
    np.testing.assert_allclose(seen.max(axis=0), corners.max(axis=0), atol=0.3)
    rows = rrd.rows("/world/cameras/d455/image/outline_truth", "LineStrips2D:strips")
    assert not rows[LOST][2]  # lost: no outline of before stays


def test_table_tags_are_outlined_in_the_world_and_in_the_image(rrd):
    _, _, strips = rrd.rows("/world/table_tags", "LineStrips3D:strips")[0]
    corners = np.array(strips[0])
    assert corners.shape == (5, 3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=0), axis=1), 0.08, atol=1e-6)
    np.testing.assert_allclose(corners[0], [0.06, 0.06, 0], atol=1e-6)  # (-, +) of a tag frame with y to the reader
    _, _, seen = rrd.rows("/world/cameras/d455/image/table_tags", "LineStrips2D:strips")[0]
    wanted = rig().camera("d455").project(rig().transform("d455", "world").points(corners))
    np.testing.assert_allclose(seen[0], wanted, atol=1e-3)


def test_plots_hold_joints_motion_and_the_health_of_the_streams(rrd):
    times = [t for t, toss, _ in rrd.rows("/arm/angles_rad", "Scalars:scalars") if toss == 0]
    assert len(times) == 165 + 1  # every sample of 1 kHz, and a gap before the next toss
    assert len(rrd.rows("/arm/angles_rad", "Scalars:scalars")[0][2]) == 7
    heights = [v[0] for _, toss, v in rrd.rows("/object/height_m/truth", "Scalars:scalars") if toss == 0]
    np.testing.assert_allclose(heights[:2], [0.3, 0.3 - 1.2 * 0.033], atol=1e-9)
    assert np.isnan(heights[LOST])
    speeds = [v[0] for _, toss, v in rrd.rows("/object/speed_m_s/truth", "Scalars:scalars") if toss == 0]
    assert speeds[1] == pytest.approx(np.hypot(1.2, 0.1))
    spins = [v[0] for _, toss, v in rrd.rows("/object/spin_rad_s/truth", "Scalars:scalars") if toss == 0]
    assert spins[1] == pytest.approx(4.0)
    late = [v[0] for _, _, v in rrd.rows("/frames/d455_depth_after_color_ms", "Scalars:scalars")]
    np.testing.assert_allclose(late, 2 * ([5.0] * FRAMES + [np.nan]))
    gaps = [v[0] for _, _, v in rrd.rows("/frames/d455_gap_ms", "Scalars:scalars")]
    np.testing.assert_allclose(gaps, 2 * ([33.0] * (FRAMES - 1) + [np.nan]))


def test_events_and_health_are_readable_on_the_time_line(rrd):
    events = {v[0]: t for t, _, v in rrd.rows("/events", "TextLog:text")}
    assert events["toss 0: release (command)"] == STEP_NS
    assert events["toss 1: first impact (sound)"] == TOSS_NS + 3 * STEP_NS
    ((_, _, text), _) = rrd.rows("/health", "TextLog:text")
    ((_, _, level), _) = rrd.rows("/health", "TextLog:level")
    assert (text, level) == (["d455: one frame late"], ["WARN"])


def test_the_arm_stands_where_its_joints_say(rrd):
    joints = rrd.rows("/arm/angles_rad", "Scalars:scalars")[0][2]
    hand = panda().links(np.array(joints), 0.04)["panda_hand"].translation_m + [0.5, 0, 0]
    _, _, place = rrd.rows("/world/arm/panda_hand", "Transform3D:translation")[0]
    np.testing.assert_allclose(place[0], hand, atol=1e-6)
    assert any(name.startswith("/world/arm/panda_hand/mesh") for name in rrd.entities())


def test_a_camera_without_a_place_is_shown_flat(rrd):
    assert "/flat/mono0" in rrd.entities()
    assert "/world/cameras/mono0" not in rrd.entities()
    _, _, about = rrd.rows("/about", "TextDocument:text")[0]
    assert "the place of mono0 is not calibrated" in about[0]


def test_the_given_mask_is_shown_in_its_frame_only(rrd):
    entity = "/world/cameras/d455/image/mask"
    assert [t for t, _, v in rrd.rows(entity, "SegmentationImage:buffer") if v] == [0, TOSS_NS]
    assert [t for t, _, v in rrd.rows(entity, "Clear:is_recursive")] == [STEP_NS, TOSS_NS + STEP_NS]


def test_the_blueprint_names_its_views_and_spans_the_first_toss(rrd):
    views, selections = set(), []
    (entry,) = RrdReader(rrd.path).blueprints()
    for chunk in RrdReader(rrd.path).stream(store=entry).to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name == "ViewBlueprint:display_name":
                views.add(batch.column(name)[0].as_py()[0])
            if name == "TimePanelBlueprint:time_selection":
                selections.append(batch.column(name)[0].as_py()[0])
    assert {
        "The table in 3D",
        "Colour of d455",
        "Depth",
        "mono0",
        "Height (m)",
        "Arm joints (rad)",
        "What you see",
    } <= views
    end_ns = FRAMES * STEP_NS - STEP_NS + DEPTH_LATER_NS
    assert str(selections[0]).find(str(end_ns)) > 0


def test_tosses_whose_clocks_overlap_are_laid_out_one_after_another(tmp_path):
    session = make_session(tmp_path / "overlap", starts_ns=(0, 0), arm=False, truth=False)
    save_rrd(session, tmp_path / "o.rrd")
    rows = Rrd(tmp_path / "o.rrd").rows("/world/seen_by/d455", "Points3D:positions")
    assert max(t for t, toss, _ in rows if toss == 0) < min(t for t, toss, _ in rows if toss == 1)
    _, _, about = Rrd(tmp_path / "o.rrd").rows("/about", "TextDocument:text")[0]
    assert "shown one after another" in about[0]


def test_a_clock_that_is_one_already_is_left_alone():
    assert lay_out({0: (5, 10), 1: (20, 30)}) == {0: 0, 1: 0}
    assert lay_out({3: (0, 10), 4: (0, 10)}) == {3: 0, 4: 1_000_000_010}


def test_a_session_without_a_world_is_drawn_as_the_camera_sees_it(tmp_path):
    session = make_session(tmp_path / "nowhere", rig(where=False), arm=False, truth=False)
    save_rrd(session, tmp_path / "n.rrd")
    rrd = Rrd(tmp_path / "n.rrd")
    _, _, points = rrd.rows("/world/seen_by/d455", "Points3D:positions")[0]
    np.testing.assert_allclose(np.array(points)[:, 2], 1.0, atol=1e-6)  # 1 m along the optical axis
    _, _, about = rrd.rows("/about", "TextDocument:text")[0]
    assert "as seen from d455" in about[0]


def test_poses_alone_give_a_box_a_path_and_plots(tmp_path):
    with SessionWriter(tmp_path / "poses", {"name": "poses", "object": {"name": "cube"}}) as writer:
        with writer.toss(4) as toss:
            for i in range(5):
                matrix = np.eye(4)
                matrix[2, 3] = max(0.3 - 0.1 * i, 0.05)
                toss.pose("/track/pose", StampedPose(i * STEP_NS, "world", "object", matrix), i)
        writer.finish("complete")
    save_rrd(tmp_path / "poses", tmp_path / "p.rrd")
    rrd = Rrd(tmp_path / "p.rrd")
    assert len(rrd.rows("/world/object/track", "Transform3D:translation")) == 5
    _, _, half = rrd.rows("/world/object/track/box", "Boxes3D:half_sizes")[0]
    np.testing.assert_allclose(half, [[0.05] * 3], atol=1e-6)  # as high as it rests
    _, _, strips = rrd.rows("/world/path/track", "LineStrips3D:strips")[0]
    assert len(strips[0]) == 5
    heights = [v[0] for _, _, v in rrd.rows("/object/height_m/track", "Scalars:scalars")]
    np.testing.assert_allclose(heights, [0.3, 0.2, 0.1, 0.05, 0.05, np.nan], atol=1e-9)


def test_contactnets_poses_are_shown_with_their_tosses_apart(data, tmp_path):
    contactnets = pytest.importorskip("recordings.importers.contactnets", reason="no import contactnets yet")
    source = data("contactnets") / "tosses_processed"
    few = tmp_path / "few" / "tosses_processed"
    few.mkdir(parents=True)
    for file in sorted(source.glob("*.pt"))[:3]:
        shutil.copy(file, few)
    shutil.copytree(source.parent / "params_processed", few.parent / "params_processed")
    contactnets.import_contactnets(few.parent, tmp_path / "session")
    save_rrd(tmp_path / "session", tmp_path / "c.rrd")
    rrd = Rrd(tmp_path / "c.rrd")
    rows = rrd.rows("/world/object/track", "Transform3D:translation")
    tosses = [toss for _, toss, v in rows if v]
    assert len(set(tosses)) == 3
    assert tosses == sorted(tosses)
    _, _, half = rrd.rows("/world/object/track/box", "Boxes3D:half_sizes")[0]
    assert half[0][0] == pytest.approx(0.0512, abs=0.002)  # the cube of 104.8 mm rests 51.2 mm high (data/README.md)


def test_one_toss_s_file_alone_is_shown(session, tmp_path):
    save_rrd(session / "toss_01.mcap", tmp_path / "one.rrd")
    rows = Rrd(tmp_path / "one.rrd").rows("/world/seen_by/d455", "Points3D:positions")
    assert {toss for _, toss, _ in rows} == {1}


def test_a_chosen_toss_is_the_only_one(session, tmp_path):
    save_rrd(session, tmp_path / "t.rrd", Choice(toss=1))
    assert {toss for _, toss, _ in Rrd(tmp_path / "t.rrd").rows("/world/seen_by/d455", "Points3D:positions")} == {1}
    with pytest.raises(BadInput, match=r"no toss 5; it has 0, 1"):
        open_scene(session, Choice(toss=5))


def test_results_lie_over_the_recording_they_came_from(session, tmp_path):
    copy = shutil.copytree(session, tmp_path / "tiny")
    make_results(copy / "results", copy)
    save_rrd(copy / "results", tmp_path / "r.rrd")
    rrd = Rrd(tmp_path / "r.rrd")
    assert {"/world/object/truth/shape", "/world/object/ours_all/shape", "/world/seen_by/d455"} <= rrd.entities()
    truth = [v[0] for _, _, v in rrd.rows("/world/object/truth", "Transform3D:translation") if v]
    ours = [v[0] for _, _, v in rrd.rows("/world/object/ours_all", "Transform3D:translation") if v]
    np.testing.assert_allclose(ours, truth, atol=1e-6)
    colors = [rrd.rows(f"/world/object/{n}/shape", "Mesh3D:albedo_factor")[0][2] for n in ("truth", "ours_all")]
    assert colors[0] != colors[1]
    assert open_scene(copy).bodies[1].label == "label of ours, scope all"  # a session shows its results too


def test_of_several_variants_the_likeliest_is_seen_and_one_can_be_chosen(session, tmp_path):
    results = make_results(tmp_path / "results", session, ("bundlesdf-1", "ours"), session_path="")
    assert [(b.name, b.shown) for b in open_scene(results).bodies] == [("ours_all", True), ("bundlesdf-1_all", False)]
    chosen = open_scene(results, Choice(variant="bundlesdf-1")).bodies
    assert [(b.name, b.shown) for b in chosen] == [("bundlesdf-1_all", True)]
    with pytest.raises(BadInput, match="wanted one of: --variant bundlesdf-1 --scope all, --variant ours --scope all"):
        open_scene(results, Choice(variant="theirs"))


def test_results_alone_need_no_session(session, tmp_path):
    results = make_results(tmp_path / "results", session, session_path="gone")
    save_rrd(results, tmp_path / "r.rrd")
    rrd = Rrd(tmp_path / "r.rrd")
    places = [v[0] for _, toss, v in rrd.rows("/world/object/ours_all", "Transform3D:translation") if v and toss == 0]
    np.testing.assert_allclose(places[0], [0, 0, 0.3], atol=1e-6)
    assert "/world/seen_by/d455" not in rrd.entities()


def test_a_foreign_mcap_goes_through_reruns_own_loader(tmp_path):
    from mcap.writer import Writer

    path = tmp_path / "foreign.mcap"
    with open(path, "wb") as out:
        writer = Writer(out)
        writer.start()
        schema = writer.register_schema("Thing", "jsonschema", json.dumps({"type": "object"}).encode())
        channel = writer.register_channel("/thing", "json", schema)
        writer.add_message(channel, 5, b'{"a": 1}', 5)
        writer.finish()
    assert is_foreign(path)
    save_rrd(path, tmp_path / "f.rrd")
    assert "/thing" in Rrd(tmp_path / "f.rrd").entities()


def test_tosslab_s_own_file_is_not_foreign(session):
    assert not is_foreign(session / "toss_00.mcap")
    assert not is_foreign(session)


def test_what_reruns_program_refuses_is_said_in_one_line(tmp_path):
    with pytest.raises(BadInput, match=r"^`rerun rrd verify .*nothing\.rrd` failed: .+$"):
        run_rerun("rrd", "verify", str(tmp_path / "nothing.rrd"))


def test_an_rrd_is_for_looking_not_for_saving_again(rrd, tmp_path):
    assert is_foreign(rrd.path)
    with pytest.raises(BadInput, match=r"is an \.rrd already"):
        save_rrd(rrd.path, tmp_path / "again.rrd")


def test_an_existing_file_is_never_overwritten(session, tmp_path):
    out = tmp_path / "there.rrd"
    out.write_text("mine")
    with pytest.raises(BadInput, match="exists already; nothing was written"):
        save_rrd(session, out)
    assert out.read_text() == "mine"


def test_what_fails_leaves_nothing_behind(session, tmp_path):
    broken = shutil.copytree(session, tmp_path / "broken")
    data = bytearray((broken / "toss_01.mcap").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 2000] = bytes(2000)
    (broken / "toss_01.mcap").write_bytes(data)
    with pytest.raises(BadInput):
        save_rrd(broken, tmp_path / "out" / "b.rrd")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_path_that_is_nothing_says_what_was_wanted(tmp_path):
    with pytest.raises(BadInput, match=r"does not exist; wanted a session folder or an \.mcap file"):
        open_scene(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput, match=r"no session\.json"):
        open_scene(tmp_path / "empty")
    with SessionWriter(tmp_path / "bare", {"name": "bare"}) as writer:
        writer.finish("complete")
    with pytest.raises(BadInput, match=r"nothing to show"):
        open_scene(tmp_path / "bare")


def test_the_moment_of_the_picture_is_in_flight(session, tmp_path):
    assert moment_ns(open_scene(session), 0) == 2 * STEP_NS  # between release and first impact
    heights = np.array([0.1, 0.4, np.nan, 0.3, 0.2, 0.05, 0.05])
    assert half_way_down_ns(np.arange(7), heights) == 4


PLAIN = CameraModel("c", 640, 480, np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))


def ahead(z_m):
    return Transform("c", "object", np.eye(3), np.array([0, 0, z_m]))


def test_the_outline_of_a_cube_seen_face_on_is_its_front_face():
    (border,) = outline_px(CUBE, PLAIN, ahead(1.0))
    half_px = 500 * 0.05 / 0.95  # the near face covers all others
    np.testing.assert_allclose(np.abs(border - [320, 240]).max(axis=1), half_px, atol=0.25)
    assert len(border) == 5  # four corners, closed


def test_the_outline_is_the_border_of_what_is_covered():
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    shape = ObjectShape("object", "sphere", np.array(sphere.vertices), np.array(sphere.faces))
    (border,) = outline_px(shape, PLAIN, ahead(0.5))
    radius_px = 500 * np.tan(np.arcsin(0.05 / 0.5))
    np.testing.assert_allclose(np.linalg.norm(border - [320, 240], axis=1), radius_px, atol=0.6)


def test_a_ring_has_an_outer_and_an_inner_outline():
    ring = trimesh.creation.annulus(r_min=0.03, r_max=0.05, height=0.001)
    shape = ObjectShape("object", "ring", np.array(ring.vertices), np.array(ring.faces))
    borders = outline_px(shape, PLAIN, ahead(0.5))
    sizes = sorted(float(np.ptp(border, axis=0).max()) for border in borders)
    np.testing.assert_allclose(sizes, [2 * 500 * 0.03 / 0.5, 2 * 500 * 0.05 / 0.5], atol=1.0)


def test_what_is_behind_or_beside_the_image_has_no_outline():
    around = outline_px(
        CUBE, PLAIN, ahead(0.0)
    )  # the camera inside the cube: the faces that reach behind it are left out
    assert all(np.isfinite(border).all() for border in around)
    assert outline_px(CUBE, PLAIN, ahead(-1.0)) == []
    assert outline_px(CUBE, PLAIN, Transform("c", "object", np.eye(3), np.array([50.0, 0, 1.0]))) == []


def test_a_triangle_is_outlined_from_both_sides():
    triangle = ObjectShape("o", "t", np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2]]))
    for turn in (np.eye(3), DOWN):
        (border,) = outline_px(triangle, PLAIN, Transform("c", "o", turn, np.array([0, 0, 1.0])))
        assert len(border) == 4


def test_vertex_normals_of_a_centred_cube_point_outwards():
    outwards = (vertex_normals(CUBE.vertices_m, CUBE.faces) * CUBE.vertices_m).sum(axis=1)
    assert np.abs(outwards).min() > 0.04
    assert len(set(np.sign(outwards))) == 1


def test_without_a_graphics_driver_the_message_names_the_packages(monkeypatch):
    monkeypatch.setenv("VK_DRIVER_FILES", "nothing.json")
    monkeypatch.setenv("VK_ICD_FILENAMES", "nothing.json")
    monkeypatch.setenv("WGPU_BACKEND", "vulkan")
    with pytest.raises(ViewerFailed, match=r"apt-get install -y libvulkan1 mesa-vulkan-drivers"), Viewer(headless=True):
        pass


@pytest.fixture(scope="module")
def viewer():
    """A viewer without a window; skipped where there is no graphics driver."""
    try:
        running = Viewer(headless=True, size=(800, 500)).__enter__()
    except ViewerFailed as missing:
        pytest.skip(str(missing))
    yield running
    running.close()


def test_the_viewer_shows_the_streamed_scene_without_complaint(session, viewer):
    scene = open_scene(session)
    stream(scene, viewer)
    viewer.wait_for(TIME, scene.spans_ns[1][1])
    state = viewer.client.get_state()
    assert {"The table in 3D", "Colour of d455", "Depth"} <= {view.name for view in state.views}
    assert not [report for view in state.views for report in view.reports]
    names = {e.entity_path for e in viewer.client.get_recording_schema(paths_only=True).entities}
    assert "/world/object/truth/shape" in names
    assert not [log.message for log in viewer.client.get_logs() if "invalid" in log.message.lower()]


def test_the_viewer_listens_on_the_loopback_address_only(viewer):
    port = int(viewer.url.split(":")[-1].split("/")[0])
    listening = {
        bytes.fromhex(line.split()[1].split(":")[0])[::-1]
        for name in ("/proc/net/tcp", "/proc/net/tcp6")
        for line in Path(name).read_text().splitlines()[1:]
        if line.split()[3] == "0A" and int(line.split()[1].split(":")[1], 16) == port
    }
    assert listening == {socket.inet_aton(LOOPBACK)}


@pytest.mark.usefixtures("viewer")
def test_a_screenshot_shows_the_scene(session, tmp_path):
    screenshot(session, tmp_path / "s.png", size=(800, 500))
    picture = cv2.imread(str(tmp_path / "s.png"))
    assert picture.shape == (500, 800, 3)
    blue = (np.abs(picture.astype(int) - (200, 90, 40)) < 40).all(axis=2)
    space, image = blue[:, :450], blue[30:200, 480:]
    assert space.sum() > 500  # the cloud
    assert image.sum() > 1000  # the colour image
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 200


def test_a_viewer_that_was_closed_leaves_no_process():
    try:
        with Viewer(headless=True) as running:
            process = running._process
    except ViewerFailed as missing:
        pytest.skip(str(missing))
    assert process.poll() is not None
