"""What is written into a results folder comes back from it, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recordings.errors import BadInput, DamagedFile
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.results.folder import (
    Results,
    TossRecord,
    VariantRecord,
    read_contact,
    read_hand,
    read_masks,
    read_shape,
    read_track,
    write_contact,
    write_hand,
    write_masks,
    write_shape,
    write_track,
    write_variant,
)
from recordings.results.shape_file import obj_text
from recordings.tracks import ContactModel, ObjectShape, ObjectTrack, RigCalibration

CAMERA = CameraModel("d455", 8, 6, np.array([[5.0, 0, 3.5], [0, 5.0, 2.5], [0, 0, 1]]))
CALIBRATION = RigCalibration({"d455": CAMERA}, (Transform.identity("world", "d455"),))


@pytest.fixture
def track() -> ObjectTrack:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[0, :3, :3] = rotation_exp(np.array([0.3, -2.0, 1e-7]))
    poses[1, :3, 3] = [0.1, -0.2, 0.9]
    poses[2] = np.nan
    covariance = np.full((3, 6, 6), np.nan)
    covariance[0] = np.diag(np.arange(1, 7) * 1e-6)
    status = ("tracked", "interpolated", "lost")
    return ObjectTrack(4, "d455", "object", np.array([5, 33_000_005, 66_000_001]), poses, status, covariance)


@pytest.fixture
def shape() -> ObjectShape:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 1 / 30]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    rgb = np.arange(12, dtype=np.uint8).reshape(4, 3)
    return ObjectShape("object", "a tetrahedron", vertices, faces, rgb, np.array([True, True, False, True]))


def record(name: str = "bundlesdf-1", scope: str = "all") -> VariantRecord:
    tosses = (TossRecord(4, "track-aaaa", "track-aaaa", "segment-bbbb"),)
    return VariantRecord(name, scope, "a label", "s", "cube", CALIBRATION, tosses, "track-aaaa")  # type: ignore[arg-type]


def test_a_track_comes_back_to_the_last_bit_and_writes_the_same_bytes_twice(track: ObjectTrack, tmp_path: Path) -> None:
    first = write_track(tmp_path, track).read_bytes()
    back = read_track(tmp_path, 4)
    np.testing.assert_array_equal(back.camera_from_object, track.camera_from_object)
    np.testing.assert_array_equal(back.covariance, track.covariance)
    assert back.status == track.status
    assert back.time_ns.tolist() == track.time_ns.tolist()
    assert write_track(tmp_path, back).read_bytes() == first


def test_a_shape_comes_back_to_the_last_bit(shape: ObjectShape, tmp_path: Path) -> None:
    write_shape(tmp_path, shape)
    back = read_shape(tmp_path)
    for name in ("vertices_m", "faces", "vertex_rgb", "observed"):
        np.testing.assert_array_equal(getattr(back, name), getattr(shape, name))
    assert (back.object_frame, back.source) == ("object", "a tetrahedron")
    write_shape(tmp_path, replace(shape, vertex_rgb=None, observed=None), "bare")
    assert read_shape(tmp_path, "bare").vertex_rgb is None


def test_other_programs_read_the_ply_and_the_obj(shape: ObjectShape, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    (tmp_path / "shape.obj").write_text(obj_text(shape))
    for file in (write_shape(tmp_path, shape), tmp_path / "shape.obj"):
        mesh = trimesh.load(file, process=False)
        np.testing.assert_allclose(mesh.vertices, shape.vertices_m, atol=1e-9)
        np.testing.assert_array_equal(mesh.faces, shape.faces)
        np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], shape.vertex_rgb)


def test_masks_come_back_with_their_confidence(tmp_path: Path) -> None:
    masks = [np.random.default_rng(i).random((6, 8)) > 0.5 for i in range(3)]
    write_masks(tmp_path, 4, masks, np.array([1.0, 0.5, 0.0]))
    back = read_masks(tmp_path, 4)
    assert len(back) == 3
    for a, b in zip(back, masks):
        np.testing.assert_array_equal(a, b)
    assert back.confidence.tolist() == [1.0, 0.5, 0.0]


def test_the_robots_hand_comes_back(tmp_path: Path) -> None:
    hand = np.random.default_rng(0).normal(size=(3, 4, 4))
    hand[1] = np.nan
    write_hand(tmp_path, 4, hand)
    np.testing.assert_array_equal(read_hand(tmp_path, 4), hand)
    assert read_hand(tmp_path, 5) is None
    (tmp_path / "toss_05.hand.npy").write_bytes((tmp_path / "toss_04.hand.npy").read_bytes()[:200])
    with pytest.raises(BadInput, match="no poses of the hand"):
        read_hand(tmp_path, 5)


def test_a_contact_model_comes_back(tmp_path: Path) -> None:
    model = ContactModel(
        "object",
        np.eye(3),
        ((0, 1, 2),),
        0.18,
        0.1,
        0.2,
        0.37,
        np.eye(3) * 8e-4,
        np.zeros(3),
        "given",
        np.eye(3)[2],
        0.001,
    )
    write_contact(tmp_path, model)
    back = read_contact(tmp_path)
    assert (back.friction, back.pieces, back.physics_source) == (0.18, ((0, 1, 2),), "given")
    np.testing.assert_array_equal(back.inertia_kgm2, model.inertia_kgm2)


def test_a_results_folder_gives_what_was_written(track: ObjectTrack, shape: ObjectShape, tmp_path: Path) -> None:
    for stage in ("track-aaaa", "segment-bbbb"):
        (tmp_path / stage).mkdir()
    write_track(tmp_path / "track-aaaa", track)
    write_shape(tmp_path / "track-aaaa", shape)
    write_masks(tmp_path / "segment-bbbb", 4, [np.ones((6, 8), dtype=bool)] * 3, np.ones(3))
    write_variant(tmp_path, record())
    results = Results.open(tmp_path)
    assert results.variants() == (("bundlesdf-1", "all"),)
    assert results.tracks()[4].status == track.status
    assert len(results.shape().faces) == 4
    assert len(results.shape(toss=4).faces) == 4
    assert len(results.masks(toss=4)) == 3
    assert results.contact() is None
    assert results.find().calibration.camera("d455").width == 8


def test_an_ambiguous_variant_is_refused_by_naming_what_is_there(tmp_path: Path) -> None:
    write_variant(tmp_path, record())
    write_variant(tmp_path, record("ours"))
    with pytest.raises(BadInput, match="--variant ours --scope all"):
        Results.open(tmp_path).find()
    assert Results.open(tmp_path).find("ours").name == "ours"
    with pytest.raises(BadInput, match="fits 0 results"):
        Results.open(tmp_path).find("joint")


def test_an_empty_folder_says_what_to_type(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="toss-process SESSION"):
        Results.open(tmp_path)


def test_a_damaged_stage_is_named(track: ObjectTrack, shape: ObjectShape, tmp_path: Path) -> None:
    write_track(tmp_path, track).write_bytes(b"PK")
    with pytest.raises(DamagedFile, match=r"toss_04\.track\.npz"):
        read_track(tmp_path, 4)
    ply = write_shape(tmp_path, shape)
    ply.write_bytes(ply.read_bytes()[:-5])
    with pytest.raises(DamagedFile, match=r"shape\.ply"):
        read_shape(tmp_path)
