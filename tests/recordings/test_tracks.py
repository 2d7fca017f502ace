"""Tracks never carry a silent pose; a rig's calibration is found by frame names and comes back from JSON."""

import json

import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.tracks import ObjectTrack, RigCalibration, TagPlacement

NAN_POSE = np.full((4, 4), np.nan)


def pose(x_m=0.0):
    return Transform("d455", "object", rotation_exp(np.array([0.1, 0.2, 0.3])), np.array([x_m, 0, 0.5])).matrix


def track(poses, status):
    n = len(poses)
    return ObjectTrack(
        toss=3,
        camera="d455",
        object_frame="object",
        time_ns=np.arange(n, dtype=np.int64) * 33_000_000,
        camera_from_object=np.array(poses).reshape(n, 4, 4),
        status=status,
        covariance=np.full((n, 6, 6), np.nan),
    )


# --- ObjectTrack


def test_a_lost_frame_has_no_pose():
    mixed = track([pose(), NAN_POSE, pose(0.1)], ("tracked", "lost", "interpolated"))
    assert mixed.lost.tolist() == [False, True, False]
    assert mixed.pose(1) is None
    found = mixed.pose(2)
    assert (found.target, found.source) == ("d455", "object")
    np.testing.assert_allclose(found.matrix, pose(0.1), atol=1e-12)


@pytest.mark.parametrize(
    ("poses", "status"),
    [
        ([pose()], ("lost",)),  # a pose under a lost frame
        ([NAN_POSE], ("tracked",)),
        ([NAN_POSE], ("interpolated",)),
        ([np.where(np.eye(4) > 0, np.nan, pose())], ("tracked",)),  # partly NaN
        ([pose(), pose()], ("tracked",)),  # a status is missing
    ],
)
def test_status_and_poses_that_disagree_are_refused(poses, status):
    with pytest.raises(BadInput, match="toss 3: status and poses disagree"):
        track(poses, status)


def test_a_track_without_frames_is_a_track():
    assert track([], ()).lost.shape == (0,)


# --- RigCalibration


@pytest.fixture
def rig():
    K = np.array([[386.3, 0, 322.4], [0, 386.9, 241.8], [0, 0, 1]])
    turned = rotation_exp(np.array([-2.0, 0.1, 0.05]))
    return RigCalibration(
        cameras={
            "d455": CameraModel("d455", 640, 480, K, "brown-conrady", (-0.055, 0.065, 0.0006, -0.0004, -0.02)),
            "mono0": CameraModel("mono0", 720, 540, K, "fisheye", (0.1, 0.0, 0.01, 0.0)),
            "d455_depth": CameraModel("d455_depth", 640, 480, K),
        },
        transforms=(
            Transform("world", "d455", turned, np.array([0, -0.691, 0.466])),
            Transform("d455", "d455_depth", np.eye(3), np.array([-0.059, 0, 0])),
            Transform("world", "base", np.eye(3), np.array([-0.6, 0, 0])),
            Transform("lonely", "island", np.eye(3), np.zeros(3)),
        ),
        table_tags=(TagPlacement(30, 0.08, Transform("world", "tag_30", np.eye(3), np.array([-0.4, 0.38, 0.0004]))),),
        created_unix_s=1_790_000_000.25,
        residuals={"d455": {"rms_px": 0.21}},
    )


def test_a_stored_transform_is_found_as_it_is_and_backwards(rig):
    world_from_d455 = rig.transform("world", "d455")
    np.testing.assert_allclose(world_from_d455.matrix, rig.transforms[0].matrix, atol=1e-15)
    there_and_back = world_from_d455 @ rig.transform("d455", "world")
    np.testing.assert_allclose(there_and_back.matrix, np.eye(4), atol=1e-14)


def test_transforms_are_chained_over_the_stored_ones(rig):
    base_from_depth = rig.transform("base", "d455_depth")
    assert (base_from_depth.target, base_from_depth.source) == ("base", "d455_depth")
    by_hand = rig.transforms[2].inverse() @ rig.transforms[0] @ rig.transforms[1]
    np.testing.assert_allclose(base_from_depth.matrix, by_hand.matrix, atol=1e-14)


def test_a_frame_to_itself_is_the_identity(rig):
    np.testing.assert_array_equal(rig.transform("d455", "d455").matrix, np.eye(4))


def test_frames_that_nothing_connects_are_none_or_an_error_that_says_what_is_known(rig):
    assert rig.find("world", "island") is None
    with pytest.raises(BadInput, match=r"does not connect 'world' and 'island'.*world_from_d455"):
        rig.transform("world", "island")


def test_an_unknown_camera_is_refused_with_the_known_ones(rig):
    with pytest.raises(BadInput, match=r"no camera 'mono7'.*d455.*mono0"):
        rig.camera("mono7")


def test_json_brings_everything_back_to_the_last_bit(rig, tmp_path):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(rig.to_json()))
    again = RigCalibration.read(path)
    assert json.loads(json.dumps(again.to_json())) == json.loads(json.dumps(rig.to_json()))
    assert again.cameras["mono0"].distortion == (0.1, 0.0, 0.01, 0.0)
    assert again.created_unix_s == 1_790_000_000.25
    assert again.table_tags[0].tag_id == 30
    np.testing.assert_allclose(again.transform("world", "d455").matrix, rig.transforms[0].matrix, atol=1e-15)


def test_a_calibration_of_another_version_is_refused(rig):
    with pytest.raises(BadInput, match="format_version 99; this tosslab reads 1"):
        RigCalibration.from_json(rig.to_json() | {"format_version": 99})


@pytest.mark.parametrize(
    "harm",
    [
        lambda d: d.pop("cameras"),
        lambda d: d["cameras"]["d455"].pop("K"),
        lambda d: d["cameras"]["d455"].update(K=[[1, 2], [3, 4]]),
        lambda d: d["cameras"]["d455"].update(distortion_model="ftheta"),
        lambda d: d["cameras"]["d455"].update(K="none"),
        lambda d: d.update(transforms=[{"target": "a"}]),
        lambda d: d["transforms"][0].update(matrix=[[1]]),
        lambda d: d["transforms"][0].update(matrix=np.diag([2.0, 1, 1, 1]).tolist()),
        lambda d: d.update(table_tags=7),
    ],
)
def test_a_damaged_calibration_is_bad_input_and_nothing_else(rig, harm):
    damaged = json.loads(json.dumps(rig.to_json()))
    harm(damaged)
    with pytest.raises(BadInput):
        RigCalibration.from_json(damaged)


@pytest.mark.parametrize("text", [b"", b"{", b"[1, 2]", b"\xff\xfe\x00", b"null"])
def test_a_file_that_is_no_calibration_is_bad_input_that_names_it(tmp_path, text):
    path = tmp_path / "calibration.json"
    path.write_bytes(text)
    with pytest.raises(BadInput, match="calibration"):
        RigCalibration.read(path)


def test_a_missing_calibration_is_bad_input_that_names_it(tmp_path):
    with pytest.raises(BadInput, match="nowhere.json"):
        RigCalibration.read(tmp_path / "nowhere.json")
