"""What a TagSLAM configuration may say, and what is said of one that is wrong."""

from __future__ import annotations

import copy
import json

import numpy as np
import pytest

from groundtruth.cli import main
from groundtruth.tagslam.config import read_config
from groundtruth.tagslam.detections import read_recording
from recordings.errors import BadInput

ZERO = {"x": 0, "y": 0, "z": 0}
SMALL = {"x": 1e-4, "y": 1e-4, "z": 1e-4}
POSE = {"position": ZERO, "rotation": ZERO, "position_noise": SMALL, "rotation_noise": SMALL}
CAMERA = {
    "camera_model": "pinhole",
    "intrinsics": [600, 600, 320, 240],
    "distortion_model": "radtan",
    "distortion_coeffs": [0, 0, 0, 0],
    "resolution": [640, 480],
    "rostopic": "/cam0/image",
    "tagtopic": "detector/tags",
    "rig_body": "rig",
}
MAIN = {
    "tagslam_parameters": {"pixel_noise": 1.0, "optimizer_mode": "fast"},
    "body_defaults": {"position_noise": 0.05, "rotation_noise": 0.01},
    "default_body": "lab",
    "bodies": [
        {"lab": {"is_static": True, "type": "simple", "default_tag_size": 0.1, "pose": POSE, "tags": [{"id": 1}]}},
        {"rig": {"is_static": False, "type": "simple", "tags": [{"id": 9, "size": 0.05}]}},
    ],
}
PLANE = {"tags": [1], "distance": 0.0, "noise": 0.01, "direction": [0, 0, 1]}
DISTANCE = {"tag1": 1, "tag2": 2, "corner1": 0, "corner2": 3, "distance": 1.0, "noise": 0.01}


@pytest.fixture
def written(tmp_path):
    """Writes the three files, changed, and gives the folder (YAML reads JSON)."""

    def write(change=None):
        files = {
            "cameras": {"cam0": copy.deepcopy(CAMERA)},
            "camera_poses": {"cam0": {"pose": copy.deepcopy(POSE)}},
            "tagslam": copy.deepcopy(MAIN),
        }
        if change is not None:
            change(files)
        for name, document in files.items():
            (tmp_path / f"{name}.yaml").write_text(json.dumps(document))
        return tmp_path

    return write


def body(files, name):
    return next(b[name] for b in files["tagslam"]["bodies"] if name in b)


def test_a_whole_configuration_is_read(written):
    config = read_config(written())
    assert [b.name for b in config.bodies] == ["lab", "rig"]
    assert config.cameras[0].tag_topic == "/detector/tags"
    assert config.notes == ()


WRONG = [
    (lambda f: f["tagslam"]["bodies"][0]["lab"].pop("is_static"), "body 'lab' lacks 'is_static'"),
    (lambda f: body(f, "rig").update(pose=POSE), "'rig' moves, yet it has a pose"),
    (lambda f: body(f, "rig")["tags"].append({"id": 1, "size": 0.1}), "tag 1 is on two bodies, 'lab' and 'rig'"),
    (lambda f: body(f, "rig")["tags"].append({"id": 5}), "tag 5 has no size"),
    (lambda f: body(f, "lab").update(type="box"), "'lab' has type 'box'; wanted one of simple, board"),
    (lambda f: f["tagslam"].update(default_body="floor"), "no body 'floor'; it has"),
    (lambda f: body(f, "lab").update(default_tag_size=0), "no size|no default_tag_size"),
    (lambda f: f["tagslam"].pop("bodies"), "tagslam.yaml has no bodies"),
    (lambda f: f["tagslam"]["tagslam_parameters"].update(optimizer_mode="quick"), "optimizer_mode 'quick'; wanted"),
    (lambda f: f["tagslam"]["tagslam_parameters"].update(pixel_noise=0), "pixel_noise is 0"),
    (lambda f: f["camera_poses"].clear(), r"no camera on 'rig' \(cam0\) has a pose"),
    (lambda f: f["cameras"].update(left=f["cameras"].pop("cam0")), r"found \['left'\]; wanted cam0"),
    (lambda f: f["cameras"]["cam0"].pop("intrinsics"), "cam0 lacks 'intrinsics'"),
    (lambda f: f["cameras"]["cam0"].update(distortion_model="ds"), "distortion_model 'ds'; wanted"),
    (lambda f: f["cameras"]["cam0"].update(distortion_coeffs=[0] * 9), "9 distortion_coeffs"),
    (lambda f: f["cameras"]["cam0"].update(rig_body="car"), "no body 'car'"),
    (lambda f: f["tagslam"].update(squash=[{"tags": [1]}]), "squash entry names neither a time nor a camera"),
    (lambda f: f["tagslam"].update(plane_measurements=[{"floor": {"tags": [1]}}]), "'floor' lacks distance, noise"),
    (
        lambda f: f["tagslam"].update(plane_measurements=[{"floor": {**PLANE, "direction": [0, 0, 2]}}]),
        "direction of length 2; wanted a unit vector",
    ),
    (
        lambda f: f["tagslam"].update(distance_measurements=[{"d": {**DISTANCE, "corner1": 4}}]),
        "has corner 4; wanted 0, 1, 2 or 3",
    ),
    (
        lambda f: f["tagslam"].update(distance_measurements=[{"d": {**DISTANCE, "tag2": 9}}]),
        "'d' measures tag 9 on 'rig', which moves",
    ),
]


@pytest.mark.parametrize(("change", "said"), WRONG)
def test_what_is_wrong_is_named_with_what_was_wanted(written, change, said):
    with pytest.raises(BadInput, match=said):
        read_config(written(change))


def test_entries_that_tagslam_does_not_read_are_noted(written):
    def slip(files):
        body(files, "lab")["is_default_body"] = True
        files["tagslam"]["tagslam_parameters"]["amnesia"] = True
        files["cameras"]["rates"] = {"fps": 30}
        files["tagslam"]["plane_measurements"] = [{"a": PLANE}, {"b": {**PLANE, "distance": 0.7}}]

    config = read_config(written(slip))
    assert not config.amnesia
    assert [p["name"] for p in config.planes] == ["b"]
    said = "\n".join(config.notes)
    for part in (
        "body 'lab' has 'is_default_body'",
        "tagslam_parameters has 'amnesia'",
        "'rates' is no camera",
        "last",
    ):
        assert part in said


def test_stated_noises_count_before_a_root_information_matrix(written):
    def both(files):
        body(files, "lab")["pose"]["R"] = (7 * np.eye(6)).ravel().tolist()

    config = read_config(written(both))
    np.testing.assert_allclose(config.body("lab").pose.root_information, 1e4 * np.eye(6))


def test_fake_odometry_of_one_body_is_that_of_all_that_move(written):
    def fake(files):
        files["tagslam"]["bodies"].append(
            {"cup": {"is_static": False, "fake_odom_rotation_noise": 0.2, "fake_odom_translation_noise": 0.3}}
        )

    config = read_config(written(fake))
    assert config.body("cup").fake_odom_noise == (0.2, 0.3)
    assert config.body("rig").fake_odom_noise == (1.0, 1.0)
    assert config.body("lab").fake_odom_noise is None


def test_the_command_says_it_and_what_is_missing_beside_it(written, capsys):
    assert main(["tagslam", str(written()), "--json"]) == 2
    assert "holds no detections; wanted detections.npz" in json.loads(capsys.readouterr().out)["error"]


def test_a_link_to_another_tests_bag_is_followed_where_that_is_packed(data, written):
    folder = written()
    packed = folder / "other.bag.bz2"
    packed.write_bytes((data("tagslam_test") / "test_01" / "tag_detections.bag.bz2").read_bytes())
    (folder / "tag_detections.bag").symlink_to("other.bag")
    assert sum(map(len, read_recording(folder).frames.values())) == 269


def test_a_damaged_recording_is_named(written):
    folder = written()
    (folder / "detections.npz").write_bytes(b"PK\x03\x04 cut off")
    with pytest.raises(BadInput, match="is not a recording of detections"):
        read_recording(folder)
