"""What toss-view takes, what it refuses, and what it leaves behind."""

import json
import shutil

import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.records import DepthImage, StampedPose
from recordings.session_writer import SessionWriter
from recordings.view import layers
from recordings.view.draw import Choice, is_foreign, open_scene, save_rrd
from recordings.view.scene import half_way_down_ns, lay_out, moment_ns
from recordings.view.viewer import run_rerun


def test_a_large_image_is_thinned_to_the_number_of_points_asked_for(tiny, session, tmp_path, monkeypatch):
    monkeypatch.setattr(layers, "CLOUD_POINTS", 200)
    save_rrd(session, tmp_path / "thin.rrd")
    _, _, points = tiny.Rrd(tmp_path / "thin.rrd").rows("/world/seen_by/d455", "Points3D:positions")[0]
    assert 100 < len(points) <= 200


def test_tosses_whose_clocks_overlap_are_laid_out_one_after_another(tiny, tmp_path):
    session = tiny.make_session(tmp_path / "overlap", starts_ns=(0, 0), arm=False, truth=False)
    save_rrd(session, tmp_path / "o.rrd")
    rows = tiny.Rrd(tmp_path / "o.rrd").rows("/world/seen_by/d455", "Points3D:positions")
    assert max(t for t, toss, _ in rows if toss == 0) < min(t for t, toss, _ in rows if toss == 1)
    _, _, about = tiny.Rrd(tmp_path / "o.rrd").rows("/about", "TextDocument:text")[0]
    assert "shown one after another" in about[0]


def test_a_clock_that_is_one_already_is_left_alone():
    assert lay_out({0: (5, 10), 1: (20, 30)}) == {0: 0, 1: 0}
    assert lay_out({3: (0, 10), 4: (0, 10)}) == {3: 0, 4: 1_000_000_010}


def test_a_session_without_a_world_is_drawn_as_the_camera_sees_it(tiny, tmp_path):
    session = tiny.make_session(tmp_path / "nowhere", tiny.rig(where=False), arm=False, truth=False)
    save_rrd(session, tmp_path / "n.rrd")
    rrd = tiny.Rrd(tmp_path / "n.rrd")
    _, _, points = rrd.rows("/world/seen_by/d455", "Points3D:positions")[0]
    np.testing.assert_allclose(np.array(points)[:, 2], 1.0, atol=1e-6)  # 1 m along the optical axis
    _, _, about = rrd.rows("/about", "TextDocument:text")[0]
    assert "as seen from d455" in about[0]


def test_depth_that_does_not_fit_colour_gives_no_cloud_and_a_line_that_says_so(tiny, tmp_path):
    with SessionWriter(tmp_path / "apart", {"name": "apart", "object": {"name": "block"}}, tiny.rig()) as writer:
        with writer.toss(0) as toss:
            toss.color(tiny.frame(0, 0))
            toss.depth(DepthImage("d455", 0, 0, 0, 0.001, np.full((20, 30), 900, dtype=np.uint16)))
        writer.finish("complete")
    save_rrd(tmp_path / "apart", tmp_path / "a.rrd")
    rrd = tiny.Rrd(tmp_path / "a.rrd")
    assert not rrd.rows("/world/seen_by/d455", "Points3D:positions")
    assert rrd.rows("/depth/d455", "DepthImage:buffer")
    said = [text[0] for _, _, text in rrd.rows("/events", "TextLog:text")]
    assert any("no point cloud" in text and "depth 30x20 and not aligned" in text for text in said)


def test_poses_alone_give_a_box_a_path_and_plots(tiny, tmp_path):
    with SessionWriter(tmp_path / "poses", {"name": "poses", "object": {"name": "cube"}}) as writer:
        with writer.toss(4) as toss:
            for i in range(5):
                matrix = np.eye(4)
                matrix[2, 3] = max(0.3 - 0.1 * i, 0.05)
                toss.pose("/track/pose", StampedPose(i * tiny.STEP_NS, "world", "object", matrix), i)
        writer.finish("complete")
    save_rrd(tmp_path / "poses", tmp_path / "p.rrd")
    rrd = tiny.Rrd(tmp_path / "p.rrd")
    assert len(rrd.rows("/world/object/track", "Transform3D:translation")) == 5
    _, _, half = rrd.rows("/world/object/track/box", "Boxes3D:half_sizes")[0]
    np.testing.assert_allclose(half, [[0.05] * 3], atol=1e-6)  # as high as it rests
    _, _, strips = rrd.rows("/world/path/track", "LineStrips3D:strips")[0]
    assert len(strips[0]) == 5
    heights = [v[0] for _, _, v in rrd.rows("/object/height_m/track", "Scalars:scalars")]
    np.testing.assert_allclose(heights, [0.3, 0.2, 0.1, 0.05, 0.05, np.nan], atol=1e-9)


def test_contactnets_poses_are_shown_with_their_tosses_apart(tiny, data, tmp_path):
    contactnets = pytest.importorskip("recordings.importers.contactnets", reason="no import contactnets yet")
    source = data("contactnets") / "tosses_processed"
    few = tmp_path / "few" / "tosses_processed"
    few.mkdir(parents=True)
    for file in sorted(source.glob("*.pt"))[:3]:
        shutil.copy(file, few)
    shutil.copytree(source.parent / "params_processed", few.parent / "params_processed")
    contactnets.import_contactnets(few.parent, tmp_path / "session")
    save_rrd(tmp_path / "session", tmp_path / "c.rrd")
    rrd = tiny.Rrd(tmp_path / "c.rrd")
    rows = rrd.rows("/world/object/track", "Transform3D:translation")
    tosses = [toss for _, toss, v in rows if v]
    assert len(set(tosses)) == 3
    assert tosses == sorted(tosses)
    _, _, half = rrd.rows("/world/object/track/box", "Boxes3D:half_sizes")[0]
    assert half[0][0] == pytest.approx(0.0512, abs=0.002)  # the cube of 104.8 mm rests 51.2 mm high


def test_one_toss_s_file_alone_is_shown(tiny, session, tmp_path):
    save_rrd(session / "toss_01.mcap", tmp_path / "one.rrd")
    rows = tiny.Rrd(tmp_path / "one.rrd").rows("/world/seen_by/d455", "Points3D:positions")
    assert {toss for _, toss, _ in rows} == {1}


def test_a_chosen_toss_is_the_only_one(tiny, session, tmp_path):
    save_rrd(session, tmp_path / "t.rrd", Choice(toss=1))
    assert {toss for _, toss, _ in tiny.Rrd(tmp_path / "t.rrd").rows("/world/seen_by/d455", "Points3D:positions")} == {
        1
    }
    with pytest.raises(BadInput, match=r"no toss 5; it has 0, 1"):
        open_scene(session, Choice(toss=5))


def test_results_lie_over_the_recording_they_came_from(tiny, session, tmp_path):
    copy = shutil.copytree(session, tmp_path / "tiny")
    tiny.make_results(copy / "results", copy)
    save_rrd(copy / "results", tmp_path / "r.rrd")
    rrd = tiny.Rrd(tmp_path / "r.rrd")
    assert {"/world/object/truth/shape", "/world/object/ours_all/shape", "/world/seen_by/d455"} <= rrd.entities()
    truth = [v[0] for _, _, v in rrd.rows("/world/object/truth", "Transform3D:translation") if v]
    ours = [v[0] for _, _, v in rrd.rows("/world/object/ours_all", "Transform3D:translation") if v]
    np.testing.assert_allclose(ours, truth, atol=1e-6)
    colors = [rrd.rows(f"/world/object/{n}/shape", "Mesh3D:albedo_factor")[0][2] for n in ("truth", "ours_all")]
    assert colors[0] != colors[1]
    assert open_scene(copy).bodies[1].label == "label of ours, scope all"  # a session shows its results too


def test_of_several_variants_the_likeliest_is_seen_and_one_can_be_chosen(tiny, session, tmp_path):
    results = tiny.make_results(tmp_path / "results", session, ("bundlesdf-1", "ours"), session_path="")
    assert [(b.name, b.shown) for b in open_scene(results).bodies] == [("ours_all", True), ("bundlesdf-1_all", False)]
    chosen = open_scene(results, Choice(variant="bundlesdf-1")).bodies
    assert [(b.name, b.shown) for b in chosen] == [("bundlesdf-1_all", True)]
    with pytest.raises(BadInput, match="wanted one of: --variant bundlesdf-1 --scope all, --variant ours --scope all"):
        open_scene(results, Choice(variant="theirs"))


def test_results_alone_need_no_session(tiny, session, tmp_path):
    results = tiny.make_results(tmp_path / "results", session, session_path="gone")
    save_rrd(results, tmp_path / "r.rrd")
    rrd = tiny.Rrd(tmp_path / "r.rrd")
    places = [v[0] for _, toss, v in rrd.rows("/world/object/ours_all", "Transform3D:translation") if v and toss == 0]
    np.testing.assert_allclose(places[0], [0, 0, 0.3], atol=1e-6)
    assert "/world/seen_by/d455" not in rrd.entities()


def test_a_foreign_mcap_goes_through_reruns_own_loader(tiny, tmp_path):
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
    assert "/thing" in tiny.Rrd(tmp_path / "f.rrd").entities()


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


def test_the_moment_of_the_picture_is_in_flight(tiny, session, tmp_path):
    assert moment_ns(open_scene(session), 0) == 2 * tiny.STEP_NS  # between release and first impact
    heights = np.array([0.1, 0.4, np.nan, 0.3, 0.2, 0.05, 0.05])
    assert half_way_down_ns(np.arange(7), heights) == 4
