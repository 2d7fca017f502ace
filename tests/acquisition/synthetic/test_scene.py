"""Whole tosses: the same config the same bytes, every setting does what it says, the folder layout can be imported."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from synthetic.folder import write_session
from synthetic.presets import PRESETS, SAMPLE, SAMPLE_TOSSES, described, preset
from synthetic.scene import brightness_over_time, simulate

from acquisition.synthetic.config import ErrorConfig
from acquisition.synthetic.lab import Lab
from recordings.errors import BadInput
from recordings.geometry import rotation_angle_rad

SHORT = {
    "camera": {"width": 160, "height": 120, "fps": 10.0, "dropped_share": 0.15},
    "color": {"drift": 0.4, "subframes": 4},
    "depth": {"delay_s": 0.008},
    "mono": {"width": 160, "height": 120, "subframes": 2},
    "errors": {"camera_m": 0.003, "camera_deg": 0.3},
}


@pytest.fixture(scope="module")
def short(altered):
    return replace(altered(**SHORT), still_rays=40_000)


@pytest.fixture(scope="module")
def written(short, tmp_path_factory):
    out = tmp_path_factory.mktemp("synthetic") / "lab"
    truth = write_session(Lab(short), [0, 1], out)
    return out, truth


def test_the_same_config_gives_the_same_bytes_and_another_seed_another_lab(short):
    short = replace(short, mono=None)
    first, second = simulate(short), simulate(short)
    for a, b in zip(first.frames, second.frames, strict=True):
        np.testing.assert_array_equal(a.color_rgb, b.color_rgb)
        np.testing.assert_array_equal(a.depth_raw, b.depth_raw)
    other = simulate(replace(short, seed=short.seed + 1))
    assert (other.frames[0].color_rgb != first.frames[0].color_rgb).mean() > 0.5


def test_depth_is_later_than_colour_by_what_was_set(short):
    config = replace(short, mono=None, depth=replace(short.depth, delay_s=0.016))
    frame = simulate(config).frames[6]
    assert frame.depth_time_s - frame.time_s == pytest.approx(0.016)


def test_brightness_drifts_by_the_share_that_was_set(short):
    brightness = brightness_over_time(short, 0, np.linspace(0, 1.5, 45))
    assert np.abs(brightness - 1).max() == pytest.approx(0.4)
    assert np.abs(np.diff(brightness)).max() < 0.2


def test_calibration_errors_have_the_size_that_was_set(short):
    lab = Lab(short)
    off = lab.world_from_d455.inverse() @ lab.calibrated_world_from_d455
    assert np.linalg.norm(off.translation_m) == pytest.approx(0.003)
    assert np.rad2deg(rotation_angle_rad(off.rotation)) == pytest.approx(0.3)
    tilted = Lab(replace(short, errors=ErrorConfig(plane_m=0.003, plane_deg=0.3)))
    plane = tilted.calibrated_world_from_d455 @ tilted.world_from_d455.inverse()
    assert abs(plane.translation_m[2]) == pytest.approx(0.003)
    assert np.rad2deg(np.arccos(plane.rotation[2, 2])) == pytest.approx(0.3, rel=1e-3)


def test_session_json_has_the_calibrated_pose_and_truth_the_real_one(written, short):
    out, truth = written
    calibrated = np.array(json.loads((out / "session.json").read_text())["T_world_camera"])
    real = np.array(json.loads((truth / "calibration.json").read_text())["T_world_d455"])
    np.testing.assert_allclose(real, Lab(short).world_from_d455.matrix)
    assert 1e-4 < np.abs(calibrated - real).max() < 0.01


def test_truth_agrees_with_itself(written):
    out, truth = written
    calibration = json.loads((truth / "calibration.json").read_text())
    poses = np.load(truth / "toss_00" / "poses_camera_object.npz")
    world_from_d455 = np.array(calibration["T_world_d455"])
    np.testing.assert_allclose(world_from_d455 @ poses["T_camera_object"], poses["T_world_object"], atol=1e-9)
    stamps = np.loadtxt(out / "toss_00" / "timestamps.txt")
    np.testing.assert_allclose(stamps, poses["t"], atol=6e-7)
    assert (np.diff(poses["nominal_frame"]) >= 1).all()
    for k in range(len(stamps)):
        mask = cv2.imread(str(truth / "toss_00" / "masks" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED) > 0
        exact = cv2.imread(str(truth / "toss_00" / "depth_exact_object" / f"{k:06d}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(exact > 0, mask)
    first = cv2.imread(str(out / "toss_00" / "mask_first.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(first, cv2.imread(str(truth / "toss_00/masks/000000.png"), cv2.IMREAD_UNCHANGED))


def test_the_states_are_148_hz_from_release_to_rest_and_consistent(written):
    _, truth = written
    states = np.load(truth / "toss_00" / "states_148hz.npz")
    about = json.loads((truth / "toss_00" / "toss_gt.json").read_text())
    np.testing.assert_allclose(np.diff(states["t"]), 1 / 148)
    assert states["t"][0] == pytest.approx(about["release_time_s"])
    assert states["t"][-1] <= about["rest_time_s"] < states["t"][-1] + 1 / 148
    flying = states["t"] < about["first_contact_time_s"] - 0.02
    np.testing.assert_allclose(np.linalg.norm(states["quaternion_wxyz"], axis=1), 1)
    speed = np.gradient(states["position"][flying], states["t"][flying], axis=0)
    np.testing.assert_allclose(speed[1:-1], states["linear_velocity_world"][flying][1:-1], atol=0.02)


def test_the_folders_hold_what_cube_dev_holds(written, data):
    out, truth = written
    reference, true_reference = data("cube_dev"), data("cube_dev_truth")
    for ours, theirs in ((out, reference), (truth, true_reference)):
        for name in ("toss_00", "."):
            wanted = {p.name for p in (theirs / name).iterdir() if p.is_dir() or p.suffix != ".md"}
            found = {p.name for p in (ours / name).iterdir()}
            assert {w for w in wanted if not w.startswith("toss_")} - found == set()
    for name in ("session.json", "mono/cameras.json"):
        ours, theirs = (json.loads((folder / name).read_text()) for folder in (out, reference))
        assert set(theirs) - set(ours) == set()
    for name in ("calibration.json", "object_tags.json"):
        ours, theirs = (json.loads((folder / name).read_text()) for folder in (truth, true_reference))
        assert set(theirs) - set(ours) == set()
    for name in ("poses_camera_object.npz", "states_148hz.npz", "poses_at_mono_times.npz"):
        ours, theirs = (np.load(folder / "toss_00" / name) for folder in (truth, true_reference))
        assert set(theirs.files) - set(ours.files) == set()


def test_the_folder_imports_as_a_session_with_its_truth(written, tmp_path):
    from recordings.importers.folder import import_folder
    from recordings.session import Session

    out, truth = written
    report = import_folder(out, tmp_path / "session", truth)
    session = Session.open(report.session)
    assert session.tosses == (0, 1)
    frames = session.toss(0).rgbd()
    stamps = np.loadtxt(out / "toss_00" / "timestamps.txt")
    assert len(frames) == len(stamps)
    assert frames[1].depth_time_ns - frames[1].time_ns == pytest.approx(8_000_000, abs=2000)
    assert len(session.toss(0).mono("mono1")) > 0
    assert (tmp_path / "session" / "truth" / "mesh.obj").exists()


def test_an_existing_folder_is_not_overwritten(written, short):
    out, _ = written
    with pytest.raises(BadInput, match="exists; wanted a new folder"):
        write_session(Lab(short), [0], out)


def test_the_true_mesh_is_the_tossed_one_with_its_texture(written, short):
    import trimesh

    _, truth = written
    mesh = trimesh.load(truth / "mesh.obj", process=False)
    np.testing.assert_allclose(mesh.extents, 0.1048, atol=1e-6)
    assert mesh.visual.material.image.size == Lab(short).object.mesh.atlas.shape[1::-1]


@pytest.mark.parametrize("name", ["mug-glossy", "spin-20", "near", "far", "arm-slip-10mm"])
def test_presets_can_be_tossed(name):
    assert Lab(preset(name)).plan(0).instants.end_s > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_can_be_tossed_ten_times(name):
    lab = Lab(preset(name))
    assert len({lab.plan(k).instants.end_s for k in range(10)}) > 1


def test_the_shipped_sample_is_the_sample_scene(sample_path):
    lab = Lab(SAMPLE)
    assert sum(f.stat().st_size for f in sample_path.rglob("*") if f.is_file()) < 12_000_000
    for toss in range(SAMPLE_TOSSES):
        motion = lab.plan(toss)
        assert motion.instants.rest_s - motion.instants.first_impact_s > 0.2
        states = np.load(sample_path / "truth" / f"toss_{toss:02d}" / "states_148hz.npz")
        # contact amplifies rounding from machine to machine, flight does not
        flying = states["t"] < motion.instants.first_impact_s
        planned = [motion.object.at(t).translation_m for t in states["t"][flying]]
        np.testing.assert_allclose(planned, states["position"][flying], atol=1e-5)


def test_an_unknown_preset_is_refused_with_the_list():
    with pytest.raises(BadInput, match="no preset 'teapot'; there are: cube-tagged"):
        preset("teapot")
    assert all(": " in line for line in described())
