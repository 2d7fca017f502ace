"""What a session becomes in rerun, read back from the .rrd."""

import subprocess

import numpy as np
import pytest
from rerun.chunk import RrdReader

from recordings.geometry import CameraModel
from recordings.robot.arm import panda
from recordings.view.viewer import rerun_program


def test_the_file_passes_reruns_own_verification(rrd):
    done = subprocess.run([rerun_program(), "rrd", "verify", rrd.path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_session_clock_is_the_time_line_and_tosses_have_their_own(tiny, rrd):
    assert rrd.timelines() == {"time", "toss"}
    times = [(t, toss) for t, toss, _ in rrd.rows("/world/seen_by/d455", "Points3D:positions")]
    wanted = [
        (s + i * tiny.STEP_NS + tiny.DEPTH_LATER_NS, n)
        for n, s in enumerate((0, tiny.TOSS_NS))
        for i in range(tiny.FRAMES)
    ]
    assert times == wanted  # the cloud stands at the depth's own exposure


def test_images_are_kept_byte_for_byte_at_their_own_times(tiny, rrd):
    rows = rrd.rows("/world/cameras/d455/image", "EncodedImage:blob")
    assert [t for t, _, _ in rows][: tiny.FRAMES] == [i * tiny.STEP_NS for i in range(tiny.FRAMES)]
    blob = np.array(rows[2][2][0], dtype=np.uint8).tobytes()
    assert blob == tiny.frame(2, 0).data


def test_the_cloud_lies_on_the_table_where_the_distorting_lens_says(tiny, rrd):
    _, _, points = rrd.rows("/world/seen_by/d455", "Points3D:positions")[0]
    points = np.array(points)
    assert len(points) == (tiny.WIDTH - 8) * tiny.HEIGHT  # 8 columns have no depth
    np.testing.assert_allclose(points[:, 2], 0.0, atol=1e-6)
    u, v = np.meshgrid(np.arange(8, tiny.WIDTH), np.arange(tiny.HEIGHT))
    model = tiny.rig().camera("d455")
    seen = tiny.rig().transform("d455", "world").points(points)
    back = model.project(seen)
    np.testing.assert_allclose(back, np.stack([u, v], -1).reshape(-1, 2), atol=0.05)  # 1/2048 m at 60 px per m
    straight = CameraModel("d455", tiny.WIDTH, tiny.HEIGHT, model.K).project(
        tiny.rig().transform("d455", "world").points(points)
    )
    assert np.abs(straight - back).max() > 0.3  # without the lens it would be elsewhere


def test_the_cloud_has_the_colours_of_its_pixels(rrd):
    _, _, colors = rrd.rows("/world/seen_by/d455", "Points3D:colors")[0]
    rgb = (np.array(colors)[:, None] >> np.array([24, 16, 8])) & 255
    blue = np.abs(rgb - (40, 90, 200)).max(axis=1) < 12
    assert blue.mean() > 0.8


def test_depth_keeps_its_unit(rrd):
    _, _, meter = rrd.rows("/depth/d455", "DepthImage:meter")[0]
    assert meter == pytest.approx([4000.0])


def test_truth_moves_as_it_was_written_and_is_not_drawn_where_it_was_lost(tiny, rrd):
    rows = rrd.rows("/world/object/truth", "Transform3D:translation")
    rows = [(t, value[0]) for t, toss, value in rows if value and toss == 0]
    assert [t for t, _ in rows] == [i * tiny.STEP_NS for i in range(tiny.FRAMES) if i != tiny.LOST]
    for time_ns, place in rows:
        np.testing.assert_allclose(place, tiny.falling(time_ns, 0).translation_m, atol=1e-6)
    clears = [t for t, toss, _ in rrd.rows("/world/object/truth", "Clear:is_recursive") if toss == 0]
    assert tiny.LOST * tiny.STEP_NS in clears
    shapes = [t for t, toss, value in rrd.rows("/world/object/truth/shape", "Mesh3D:vertex_positions") if toss == 0]
    assert shapes == [0, (tiny.LOST + 1) * tiny.STEP_NS]  # drawn anew where it is found again


def test_the_path_is_broken_where_the_object_was_lost(tiny, rrd):
    strips = next(value for _, toss, value in rrd.rows("/world/path/truth", "LineStrips3D:strips") if toss == 0)
    assert [len(strip) for strip in strips] == [tiny.LOST, tiny.FRAMES - tiny.LOST - 1]


def test_the_outline_surrounds_the_object_through_the_lens(tiny, rrd):
    camera, lens = tiny.rig().transform("d455", "world"), tiny.rig().camera("d455")
    _, _, strips = rrd.rows("/world/cameras/d455/image/outline_truth", "LineStrips2D:strips")[1]
    seen = np.vstack([np.array(strip) for strip in strips])
    corners = lens.project((camera @ tiny.falling(tiny.STEP_NS, 0)).points(tiny.CUBE.vertices_m))
    np.testing.assert_allclose(seen.min(axis=0), corners.min(axis=0), atol=0.3)
    np.testing.assert_allclose(seen.max(axis=0), corners.max(axis=0), atol=0.3)
    rows = rrd.rows("/world/cameras/d455/image/outline_truth", "LineStrips2D:strips")
    assert not rows[tiny.LOST][2]  # lost: no outline of before stays


def test_table_tags_are_outlined_in_the_world_and_in_the_image(tiny, rrd):
    _, _, strips = rrd.rows("/world/table_tags", "LineStrips3D:strips")[0]
    corners = np.array(strips[0])
    assert corners.shape == (5, 3)
    np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=0), axis=1), 0.08, atol=1e-6)
    np.testing.assert_allclose(corners[0], [0.06, 0.06, 0], atol=1e-6)  # (-, +) of a tag frame with y to the reader
    _, _, seen = rrd.rows("/world/cameras/d455/image/table_tags", "LineStrips2D:strips")[0]
    wanted = tiny.rig().camera("d455").project(tiny.rig().transform("d455", "world").points(corners))
    np.testing.assert_allclose(seen[0], wanted, atol=1e-3)


def test_plots_hold_joints_motion_and_the_health_of_the_streams(tiny, rrd):
    times = [t for t, toss, _ in rrd.rows("/arm/angles_rad", "Scalars:scalars") if toss == 0]
    assert len(times) == 165 + 1  # every sample of 1 kHz, and a gap before the next toss
    assert len(rrd.rows("/arm/angles_rad", "Scalars:scalars")[0][2]) == 7
    heights = [v[0] for _, toss, v in rrd.rows("/object/height_m/truth", "Scalars:scalars") if toss == 0]
    np.testing.assert_allclose(heights[:2], [0.3, 0.3 - 1.2 * 0.033], atol=1e-9)
    assert np.isnan(heights[tiny.LOST])
    speeds = [v[0] for _, toss, v in rrd.rows("/object/speed_m_s/truth", "Scalars:scalars") if toss == 0]
    assert speeds[1] == pytest.approx(np.hypot(1.2, 0.1))
    spins = [v[0] for _, toss, v in rrd.rows("/object/spin_rad_s/truth", "Scalars:scalars") if toss == 0]
    assert spins[1] == pytest.approx(4.0)
    late = [v[0] for _, _, v in rrd.rows("/frames/d455_depth_after_color_ms", "Scalars:scalars")]
    np.testing.assert_allclose(late, 2 * ([5.0] * tiny.FRAMES + [np.nan]))
    gaps = [v[0] for _, _, v in rrd.rows("/frames/d455_gap_ms", "Scalars:scalars")]
    np.testing.assert_allclose(gaps, 2 * ([33.0] * (tiny.FRAMES - 1) + [np.nan]))


def test_events_and_health_are_readable_on_the_time_line(tiny, rrd):
    events = {v[0]: t for t, _, v in rrd.rows("/events", "TextLog:text")}
    assert events["toss 0: release (command)"] == tiny.STEP_NS
    assert events["toss 1: first impact (sound)"] == tiny.TOSS_NS + 3 * tiny.STEP_NS
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


def test_the_given_mask_is_shown_in_its_frame_only(tiny, rrd):
    entity = "/world/cameras/d455/image/mask"
    assert [t for t, _, v in rrd.rows(entity, "SegmentationImage:buffer") if v] == [0, tiny.TOSS_NS]
    assert [t for t, _, v in rrd.rows(entity, "Clear:is_recursive")] == [tiny.STEP_NS, tiny.TOSS_NS + tiny.STEP_NS]


def test_the_blueprint_names_its_views_and_spans_the_first_toss(tiny, rrd):
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
    end_ns = tiny.FRAMES * tiny.STEP_NS - tiny.STEP_NS + tiny.DEPTH_LATER_NS
    assert str(selections[0]).find(str(end_ns)) > 0
