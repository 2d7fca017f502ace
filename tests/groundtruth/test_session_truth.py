"""The truth of a session: simulated tosses with known answers, what may be wrong with a recording, the command."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.tags.detect import TagDetection
from groundtruth.cli import main
from groundtruth.graph import Undetermined
from groundtruth.interpolate import GRAVITY_WORLD_M_S2, classify, interpolate
from groundtruth.offset import object_from_tagged_by_mesh, tagged_frame
from groundtruth.session_detections import (
    TagSeen,
    assign_roles,
    enlarged,
    measured_sizes_m,
    shared_times,
    shrink_px,
    triangulated_tags,
)
from groundtruth.session_solve import solve_session
from groundtruth.session_truth import TruthConfig, _sizes
from groundtruth.verdict import judge
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.records import EncodedImage
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration

NOBODY = frozenset()


def solved(made, calibration=None, sizes=None, within_ns=500_000):
    calibration = calibration or made.calibration
    detections, spread = shared_times(made.detections, within_ns)
    roles = assign_roles(detections, calibration, NOBODY, None)
    answer = solve_session(detections, roles, sizes or dict.fromkeys(roles.body | roles.still, 0.07), calibration)
    return answer, judge(answer, detections, spread, [], calibration)


def errors(track, truth):
    """Millimetres and degrees after the one constant offset between the two body frames."""
    offsets = np.linalg.inv(track) @ truth
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_matrix(offsets[:, :3, :3]).mean().as_matrix()
    offset[:3, 3] = np.median(offsets[:, :3, 3], axis=0)
    moved = track @ offset
    turn = Rotation.from_matrix(moved[:, :3, :3]).inv() * Rotation.from_matrix(truth[:, :3, :3])
    return 1e3 * np.linalg.norm(moved[:, :3, 3] - truth[:, :3, 3], axis=1), np.degrees(turn.magnitude())


@pytest.fixture(scope="module")
def made(toss_lab):
    return toss_lab()


@pytest.fixture(scope="module")
def answer(made):
    return solved(made)


def test_poses_and_layout_of_an_unknown_tagged_body_are_found(made, answer):
    found, verdict = answer
    for toss, track in found.tracks.items():
        millimetres, degrees = errors(track.world_from_tagged, made.truth[toss])
        assert np.sqrt((millimetres**2).mean()) < 0.3
        assert np.sqrt((degrees**2).mean()) < 0.15
    reference = np.linalg.inv(found.layout[0]) @ found.layout[1]
    np.testing.assert_allclose(reference, np.linalg.inv(made.layout[0]) @ made.layout[1], atol=1e-3)
    assert verdict.good
    assert not verdict.warnings


def test_the_stated_uncertainty_is_that_of_the_errors(made, answer):
    found, _ = answer
    sigma = np.sqrt(np.einsum("nii->ni", found.tracks[0].covariance))
    millimetres, _ = errors(found.tracks[0].world_from_tagged, made.truth[0])
    stated = 1e3 * np.sqrt((sigma[:, 3:] ** 2).sum(axis=1).mean())
    assert 0.3 * np.sqrt((millimetres**2).mean()) < stated < 1.0


def test_flight_is_told_from_hand_and_bounce(made, answer):
    found, _ = answer
    inner = made.flies[0].copy()
    inner[1:-1] &= made.flies[0][:-2] & made.flies[0][2:]
    assert found.tracks[0].on_arc[inner].all()
    assert not found.tracks[0].on_arc[:3].any()


def test_the_middle_of_the_cube_is_its_centre_of_mass(made, answer):
    found, _ = answer
    frame = tagged_frame(found.layout)
    center = (np.linalg.inv(frame) @ [*found.center_m, 1.0])[:3]
    assert np.linalg.norm(center) < 0.012


def test_a_camera_without_a_known_place_is_placed_by_the_table_and_the_others(made):
    half = replace(made.calibration, transforms=tuple(t for t in made.calibration.transforms if t.source != "mono2"))
    found, _ = solved(made, half)
    assert np.linalg.norm(found.cameras["mono2"][:3, 3] - made.cameras["mono2"].translation_m) < 0.003


def test_with_no_camera_placed_the_table_tags_place_them_all(made):
    found, _ = solved(made, replace(made.calibration, transforms=()))
    for name, look in made.cameras.items():
        assert np.linalg.norm(found.cameras[name][:3, 3] - look.translation_m) < 0.005


def test_nothing_of_known_place_is_said_with_what_to_do(made):
    lost = replace(made.calibration, transforms=(), table_tags=())
    with pytest.raises(Undetermined, match=r"no camera's place is known.*toss-calibrate cameras"):
        solved(made, lost)


def test_a_camera_that_misses_frames_costs_nothing(toss_lab):
    gappy = toss_lab(tosses=1, blind=("mono1", 3))
    found, verdict = solved(gappy)
    millimetres, degrees = errors(found.tracks[0].world_from_tagged, gappy.truth[0])
    assert millimetres.max() < 1.5
    assert degrees.max() < 1.0
    assert any("mono1 6" in w for w in verdict.warnings)


def test_cameras_that_expose_at_different_times_have_a_pose_each(toss_lab):
    late = toss_lab(tosses=1, late_ns={"mono1": 11_000_000, "mono2": 22_000_000})
    detections, spread = shared_times(late.detections, 500_000)
    assert spread == 0
    assert len({s.time_ns for s in detections.seen}) > 40


def test_stamps_of_one_trigger_that_differ_a_little_are_one_instant_and_it_is_said(toss_lab):
    late = toss_lab(tosses=1, late_ns={"mono1": 300_000})
    found, verdict = solved(late)
    assert len(found.tracks[0].time_ns) == 18
    assert any("differ by up to 0.30 ms" in w for w in verdict.warnings)


def test_images_on_which_the_tag_detector_died_are_counted_in_the_verdict(made):
    assert not any("died" in w for w in solved(made)[1].warnings)
    _, verdict = solved(replace(made, detections=replace(made.detections, lost_images=3)))
    assert any("the tag detector died on 3 images" in w for w in verdict.warnings)


def test_a_bumped_camera_is_named_with_its_toss(toss_lab):
    bump = Transform("camera", "camera", Rotation.from_rotvec([0.0, 0.01, 0]).as_matrix(), np.array([0.006, 0, 0]))
    bumped = toss_lab(tosses=3, frames=12, bumped=("mono1", 2, bump))
    found, verdict = solved(bumped)
    assert any(w.startswith("mono1 stood") and "toss 2" in w and "bumped" in w for w in verdict.warnings)
    assert found.moved[("mono1", 2)][1] > 3 * found.moved[("mono1", 0)][1]


@pytest.mark.parametrize(
    ("camera", "axis", "seed"), [("mono0", 1, 0), ("mono1", 0, 0), ("mono2", 2, 0), ("mono0", 0, 5), ("mono1", 1, 6)]
)
def test_a_bump_of_3_mm_in_the_only_toss_is_named_or_the_stated_deviation_covers_it(toss_lab, camera, axis, seed):
    bump = Transform("camera", "camera", np.eye(3), 0.003 * np.eye(3)[axis])
    made = toss_lab(tosses=1, bumped=(camera, 0, bump), seed=seed)
    found, verdict = solved(made)
    named = any(w.startswith(camera) and "bumped" in w for w in verdict.warnings)
    assert found.displaced == ((camera,) if named else ())
    track = found.tracks[0]
    tag = min(found.layout)
    placed = track.world_from_tagged @ found.layout[tag] @ np.linalg.inv(made.layout[tag])
    off_m = np.sqrt(((placed - made.truth[0])[:, :3, 3] ** 2).sum(axis=1).mean())
    stated_m = np.sqrt(np.einsum("nii->n", track.covariance[:, 3:, 3:]).mean())
    assert off_m < (2 if named else 1) * stated_m
    assert stated_m < 0.002


@pytest.mark.parametrize("seed", [0, 5, 6])
def test_no_camera_of_a_single_toss_is_called_bumped_where_none_was(toss_lab, seed):
    found, verdict = solved(toss_lab(tosses=1, seed=seed))
    assert not found.displaced
    assert not any("bumped" in w for w in verdict.warnings)


def test_a_wrong_tag_size_is_found_and_the_right_one_told(made):
    body = frozenset(range(6))
    measured = measured_sizes_m(triangulated_tags(made.detections, made.calibration), body)
    with pytest.raises(BadInput, match=r"cameras measure 0\.70. times.*--tag-size 0\.0(70|699)"):
        _sizes(TruthConfig(tag_size_m=0.1), body, body, measured)
    sizes, notes = _sizes(TruthConfig(), body, body, measured)
    assert sizes[0] == pytest.approx(0.07, rel=0.005)
    assert "triangulation" in notes[0]


def test_tags_that_appear_small_by_a_constant_are_grown_back(made):
    small = enlarged(made.detections, -0.4)
    triangulated = triangulated_tags(small, made.calibration)
    assert shrink_px(triangulated, {**dict.fromkeys(range(6), 0.07), 30: 0.08, 31: 0.08}) == pytest.approx(
        0.4, abs=0.05
    )


def test_a_table_tag_that_moves_is_on_two_bodies(made):
    ids = [s.tag.tag_id for s in made.detections.seen if s.tag.tag_id < 6]
    often = max(set(ids), key=ids.count)
    moving = tuple(
        replace(s, tag=replace(s.tag, tag_id=30)) if s.tag.tag_id == often else s
        for s in made.detections.seen
        if s.tag.tag_id != 30
    )
    with pytest.raises(BadInput, match=r"tag 30 moves in the images.*two bodies.*--ignore 30"):
        assign_roles(replace(made.detections, seen=moving), made.calibration, NOBODY, None)


def test_an_id_seen_twice_in_one_image_is_on_two_bodies(made):
    with pytest.raises(BadInput, match=r"tag 3 is seen twice.*--ignore 3"):
        assign_roles(replace(made.detections, twice={3: 9}), made.calibration, NOBODY, None)


def test_an_id_on_the_table_and_in_the_layout_is_refused(made):
    with pytest.raises(BadInput, match="tag 31 is on two bodies, the table"):
        assign_roles(made.detections, made.calibration, NOBODY, {31: np.eye(4), 2: np.eye(4)})


def test_tags_of_which_none_moves_are_no_tossed_object(made):
    still = tuple(s for s in made.detections.seen if s.tag.tag_id >= 30)
    with pytest.raises(BadInput, match="no tag moves"):
        assign_roles(replace(made.detections, seen=still), made.calibration, NOBODY, None)


def test_a_tag_seen_once_is_not_taken_for_the_objects(made):
    corners, covariance = np.array([[5.0, 5], [6, 5], [6, 6], [5, 6]]), np.tile(np.eye(2), (4, 1, 1))
    odd = TagSeen(0, "mono0", made.detections.seen[0].time_ns, TagDetection(77, corners, covariance, 9.0, 0))
    roles = assign_roles(made.detections, made.calibration, NOBODY, None)
    assert 77 not in roles.body
    assert (
        77
        not in assign_roles(
            replace(made.detections, seen=(*made.detections.seen, odd)), made.calibration, NOBODY, None
        ).body
    )


def arc(times, spin, center):
    """A body thrown so that `center` falls freely."""
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    for pose, t in zip(poses, times):
        pose[:3, :3] = Rotation.from_rotvec(np.array(spin) * t).as_matrix()
        pose[:3, 3] = np.array([0.5, 0.1, 2.0]) * t + 0.5 * GRAVITY_WORLD_M_S2 * t * t - pose[:3, :3] @ center
    return poses


def test_between_poses_of_a_flight_the_flight_itself_is_found():
    center, times = np.array([0.02, -0.01, 0.03]), np.arange(8) / 30
    poses = arc(times, [3.0, -4, 6], center)
    motion = classify(times, poses, center, np.array([False, *[True] * 6, False]))
    wanted = np.linspace(0.0, times[-1], 37)
    found = interpolate(motion, wanted)
    np.testing.assert_allclose(found.poses, arc(wanted, [3.0, -4, 6], center), atol=1e-6)
    assert found.extra_m.max() == 0.0


def test_an_impact_is_not_smoothed_over():
    times, impact = np.arange(10) / 30, 4.4 / 30
    fall = np.array([0.6, 0.0, -1.5])

    def at(t):
        pose = np.eye(4)
        before, after = min(t, impact), max(t - impact, 0.0)
        pose[:3, 3] = fall * before + 0.5 * GRAVITY_WORLD_M_S2 * before**2
        bounced = (fall + GRAVITY_WORLD_M_S2 * impact) * [0.8, 1, -0.5]
        pose[:3, 3] += bounced * after + 0.5 * GRAVITY_WORLD_M_S2 * after**2
        return pose

    poses = np.array([at(t) for t in times])
    on_arc = np.array([0 < k < 9 and k not in (4, 5) for k in range(10)])
    motion = classify(times, poses, np.zeros(3), on_arc)
    assert motion.kinds[4] == "impact"
    wanted = np.linspace(times[4], times[5], 9)
    found = interpolate(motion, wanted)
    np.testing.assert_allclose(found.poses[:, :3, 3], [at(t)[:3, 3] for t in wanted], atol=1e-3)
    assert found.extra_m.max() > 0.0


def test_a_table_tag_that_lies_elsewhere_makes_the_truth_unfit(toss_lab):
    made = toss_lab(tosses=1, frames=8)
    tag = made.calibration.table_tags[1]
    pose = replace(tag.world_from_tag, translation_m=tag.world_from_tag.translation_m + [0.06, 0.0, 0.0])
    wrong = replace(made.calibration, table_tags=(made.calibration.table_tags[0], replace(tag, world_from_tag=pose)))
    _, verdict = solved(made, wrong)
    assert not verdict.good
    assert any("mm from its place on the table" in f and "--ignore 3" in f for f in verdict.faults)


def test_far_outside_there_is_no_pose():
    times = np.arange(4) / 30
    motion = classify(times, arc(times, [0.0, 0, 0], np.zeros(3)), np.zeros(3), np.array([False, True, True, False]))
    found = interpolate(motion, np.array([-0.5, -0.01, 0.05, 0.5]))
    assert np.isfinite(found.poses).all(axis=(1, 2)).tolist() == [False, True, True, False]


def test_the_tags_are_laid_on_a_known_shape(made):
    box = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * 0.05
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                      [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    tilt = np.eye(4)
    tilt[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    tilt[:3, 3] = [0.01, -0.02, 0.005]
    layout = {i: tilt @ T for i, T in made.layout.items() if i != 5}
    fit = object_from_tagged_by_mesh(layout, dict.fromkeys(layout, 0.07), box, faces)
    assert fit.rms_m < 1e-4
    assert fit.alike == 24


def write_blank(path, value=90, shift=0):
    """A session with grey images that show nothing."""
    camera = CameraModel("mono0", 64, 48, np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]))
    with SessionWriter(path, {"object": {"name": "cube"}}, RigCalibration({"mono0": camera})) as writer:
        with writer.toss(0) as toss:
            for i in range(3):
                image = np.full((48, 64), value, np.uint8).tobytes()
                time_ns = 1_000_000_000 + 33_000_000 * i
                toss.mono(EncodedImage("mono0", i, time_ns, time_ns, "mono8", 64, 48, image))
        writer.finish()
    return path


def test_no_tags_at_all_is_said_with_where_to_look(tmp_path, capsys):
    session = write_blank(tmp_path / "blank")
    assert main([str(session), "--json"]) == 2
    said = json.loads(capsys.readouterr().out)
    assert "no tag of tag36h11 in 3 images of mono0" in said["error"]
    assert "toss-view" in said["error"]
    assert not (session / "truth").exists()


def test_a_session_without_ground_truth_cameras_is_said(sample_path, tmp_path, capsys):
    assert main([str(sample_path), "--toss", "1", "--out", str(tmp_path / "t"), "--json"]) == 2
    assert "no images of ground-truth cameras" in json.loads(capsys.readouterr().out)["error"]


def test_an_earlier_truth_is_not_overwritten(sample_path, capsys):
    assert main([str(sample_path), "--json"]) == 2
    assert "--replace" in json.loads(capsys.readouterr().out)["error"]


def test_a_tagslam_folder_without_files_is_said(tmp_path, capsys):
    assert main(["tagslam", str(tmp_path), "--json"]) == 2
    assert "cameras.yaml cannot be read" in json.loads(capsys.readouterr().out)["error"]
    assert main(["tagslam", str(tmp_path / "none")]) == 2


def test_tagslam_poses_are_written_as_the_contract_says(data, tmp_path, capsys):
    folder, out = data("tagslam_test") / "test_01", tmp_path / "poses.json"
    assert main(["tagslam", str(folder), "--out", str(out), "--json"]) == 0
    summary, written = json.loads(capsys.readouterr().out), json.loads(out.read_text())
    assert summary["poses"] == {"rig": 228}
    with np.load(folder / "reference.npz") as stored:
        name = next(n for n in stored.files if n.startswith("odom|") and n.endswith("stamp_ns"))
        assert [row[0] for row in written["bodies"]["rig"]] == stored[name].tolist()
        wanted = stored[name.replace("stamp_ns", "xyz_qxyzw")]
    rows = np.array([row[1:] for row in written["bodies"]["rig"]])
    np.testing.assert_allclose(rows[:, :3], wanted[:, :3], atol=1e-3)
    assert (np.abs((rows[:, 3:] * wanted[:, 3:]).sum(axis=1)) > 1 - 1e-6).all()
    assert set(written["static"]) == {"perch"}
    assert written["reprojection_px"]["median"] == pytest.approx(0.39, abs=0.01)
