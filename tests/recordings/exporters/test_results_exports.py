"""Exports of results: trajectories, meshes, masks, BOP, assets."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from recordings.errors import BadInput, WriteFailed
from recordings.exporters.export import EXPORTERS, export
from recordings.results.folder import Results, read_masks
from recordings.session import Session


def test_every_frame_has_its_line_and_its_status(make_results, tmp_path):
    results = make_results()
    export("tum", results, tmp_path / "out")
    track = Results.open(results).tracks()[1]
    rows = [line.split() for line in (tmp_path / "out" / "toss_01.txt").read_text().splitlines()]
    status = (tmp_path / "out" / "toss_01.status.txt").read_text().split()
    assert status == ["tracked", "tracked", "lost", "interpolated", "tracked", "tracked"]
    assert [row[0] for row in rows[:2]] == ["0.000000000", "0.033333333"]
    assert rows[2][1:] == ["nan"] * 7
    for i in (0, 1, 3, 4, 5):
        values = np.array(rows[i], dtype=float)
        np.testing.assert_allclose(values[1:4], track.camera_from_object[i, :3, 3], atol=1e-9)
        turn = Rotation.from_quat(values[4:]).as_matrix()  # x y z w
        np.testing.assert_allclose(turn, track.camera_from_object[i, :3, :3], atol=1e-9)


def test_tum_and_mesh_go_into_one_folder_and_neither_overwrites(make_results, tmp_path):
    results = make_results()
    report = export("tum", results, tmp_path / "out")
    assert report.files == 4
    export("mesh", results, tmp_path / "out")
    assert len(list((tmp_path / "out").iterdir())) == 5
    before = (tmp_path / "out" / "toss_00.txt").read_bytes()
    with pytest.raises(BadInput, match="nothing was overwritten"):
        export("tum", results, tmp_path / "out")
    assert (tmp_path / "out" / "toss_00.txt").read_bytes() == before
    assert len(list((tmp_path / "out").iterdir())) == 5
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_the_session_that_holds_the_results_can_be_given_instead(make_results, tmp_path):
    results = make_results()
    export("tum", results.parent, tmp_path / "out")
    assert (tmp_path / "out" / "toss_00.txt").exists()


def test_the_mesh_is_in_metres_in_the_frame_of_the_poses(make_results, tmp_path):
    export("mesh", make_results(), tmp_path / "out")
    mesh = trimesh.load(tmp_path / "out" / "shape.obj", force="mesh", process=False)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [0.1, 0.1, 0.1]])
    assert mesh.is_watertight


def test_in_scope_one_every_toss_has_its_own_mesh(make_results, tmp_path):
    export("mesh", make_results("one"), tmp_path / "out")
    sizes = [trimesh.load(tmp_path / "out" / f"toss_0{i}" / "shape.obj").bounds[1, 0] for i in range(2)]
    assert sizes == pytest.approx([0.1, 0.2])
    assert not (tmp_path / "out" / "shape.obj").exists()


def test_several_variants_must_be_told_apart(make_results, tmp_path):
    make_results("all")
    results = make_results("one")
    with pytest.raises(BadInput, match="--variant bundlesdf-1 --scope one"):
        export("tum", results, tmp_path / "out")
    export("tum", results, tmp_path / "out", scope="one")


def test_the_masks_of_every_frame_go_out_with_bundlesdf(make_results, tmp_path):
    results = make_results()
    export("bundlesdf", results, tmp_path / "out")
    masks = read_masks(results / "track-allbundlesdf-1", 1)
    for i in range(6):
        png = cv2.imread(str(tmp_path / "out" / "toss_01" / "masks" / f"{i:06d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(png, masks[i] * np.uint8(255))
    K = np.loadtxt(tmp_path / "out" / "toss_01" / "cam_K.txt")
    np.testing.assert_array_equal(K, Results.open(results).find().calibration.camera("d455").K)


def test_bop_gives_poses_in_millimetres_and_nothing_for_a_lost_frame(make_results, tmp_path):
    results = make_results()
    export("bop", results, tmp_path / "out")
    scene = tmp_path / "out" / "test" / "000001"
    poses = json.loads((scene / "scene_gt.json").read_text())
    assert poses["2"] == []
    np.testing.assert_allclose(poses["1"][0]["cam_t_m2c"], [10, -1000 / 3, 1700])
    track = Results.open(results).tracks()[1]
    np.testing.assert_allclose(poses["1"][0]["cam_R_m2c"], track.camera_from_object[1, :3, :3].reshape(-1))
    cameras = json.loads((scene / "scene_camera.json").read_text())
    raw = cv2.imread(str(scene / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED)
    session = Session.open(results.parent)
    depth_m = session.toss(1).rgbd()[0].depth_m
    np.testing.assert_allclose(raw * cameras["0"]["depth_scale"], depth_m * 1000, atol=1e-3)
    model = trimesh.load(tmp_path / "out" / "models" / "obj_000001.ply", process=False)
    np.testing.assert_allclose(model.bounds[1], [100, 100, 100])
    info = json.loads((tmp_path / "out" / "models" / "models_info.json").read_text())
    assert info["1"]["diameter"] == pytest.approx(100 * np.sqrt(2))
    lines = (tmp_path / "out" / "tosslab_cube-test.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 5
    assert len(json.loads((tmp_path / "out" / "test_targets_bop19.json").read_text())) == 2 * 6


@pytest.mark.parametrize("name", ["urdf", "mjcf", "drake-sdf"])
def test_an_asset_without_a_contact_model_is_refused_by_saying_what_to_run(make_results, tmp_path, name):
    with pytest.raises(BadInput, match="no contact model in these results.*--variant ours"):
        export(name, make_results(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_an_asset_is_what_the_contact_stage_wrote(make_results, tmp_path):
    results = make_results()
    path = results / "variants" / "bundlesdf-1.all.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "contact": "contact-12345678"}))
    with pytest.raises(BadInput, match="has no urdf asset"):
        export("urdf", results, tmp_path / "out")
    asset = results / "contact-12345678" / "assets" / "urdf"
    (asset / "meshes").mkdir(parents=True)
    (asset / "object.urdf").write_text("<robot/>")
    (asset / "meshes" / "shape.obj").write_text("v 0 0 0\n")
    export("urdf", results, tmp_path / "out")
    assert (tmp_path / "out" / "object.urdf").read_text() == "<robot/>"
    assert (tmp_path / "out" / "meshes" / "shape.obj").exists()


@pytest.mark.parametrize("name", sorted(set(EXPORTERS) - {"rrd"}))
def test_nothing_to_export_is_said_and_nothing_is_left(tmp_path, name):
    with pytest.raises(BadInput, match="does not exist"):
        export(name, tmp_path / "nowhere", tmp_path / "out")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BadInput):
        export(name, tmp_path / "empty", tmp_path / "out")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty"]


def test_an_unknown_format_names_the_known_ones(tmp_path):
    with pytest.raises(BadInput, match="tum"):
        export("gif", tmp_path, tmp_path / "out")


def test_a_full_disk_is_said_and_leaves_nothing(make_results, tmp_path, full_disk):
    results = make_results()
    full_disk(100)
    with pytest.raises(WriteFailed):
        export("mesh", results, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]


def test_a_file_in_the_way_is_not_touched(make_results, tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(BadInput, match="is a file"):
        export("tum", make_results(), tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"
