import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from processing.contact.physics.geometry import CORNERS
from processing.motion.trajectory import rotation_matrices
from processing.pipeline.contact_only import contact_only
from processing.pose_source import PoseSource, find_poses, in_frame_of
from recordings.console import chosen_tosses
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.records import StampedPose
from recordings.results.folder import Results
from recordings.session import Session
from recordings.session_writer import SessionWriter
from recordings.tracks import ObjectShape, RigCalibration

KEYS = {"edges_m", "friction", "rollout", "ground_plane_sensitivity", "seconds", "cpu_seconds", "cpu_seconds_total",
        "transitions", "solver_failures", "untouched_vertices"}  # fmt: skip


@pytest.fixture
def poses_session(simulated_tosses, box_physics, tmp_path):
    """A session of poses only, numbered as an import would: 3, 4, 7, 8, 9."""
    physics = {"mass_kg": box_physics.mass_kg, "inertia_kgm2": box_physics.inertia_kgm2.tolist()}
    start = {"name": "boxes", "object": {"name": "box", "physics": physics}}
    with SessionWriter(tmp_path / "boxes", start, RigCalibration(cameras={})) as writer:
        for number, track in zip((3, 4, 7, 8, 9), simulated_tosses(5, 130)):
            with writer.toss(number) as toss:
                for i, (R, p) in enumerate(zip(track.rotation, track.position_m)):
                    time_ns = 1_000_000_000 + round(1e9 * track.time_s[i])
                    pose = Transform("world", "object", R, p)
                    toss.pose("/track/pose", StampedPose(time_ns, "world", "object", pose.matrix))
        writer.finish("complete")
    return Session.open(tmp_path / "boxes")


def test_a_poses_only_session_is_learned_from_and_all_files_are_written(poses_session, tmp_path):
    document, text = contact_only(
        poses_session, tmp_path / "out", train="3-8", test="9", geometry="box", init_m=0.05, steps=50
    )
    assert set(document) >= KEYS
    json.dumps(document, allow_nan=False)
    np.testing.assert_allclose(document["edges_m"], [0.1, 0.08, 0.06], atol=2e-3)
    assert document["friction"]["low"] <= document["friction"]["value"] <= document["friction"]["high"]
    assert document["friction"]["value"] == pytest.approx(0.25, abs=0.03)
    assert document["train"] == [3, 4, 7, 8]
    rollout = document["rollout"]
    assert (rollout["steps"], rollout["n_tosses"], len(rollout["position_m"]["per_toss"])) == (50, 1, 1)
    assert len(rollout["rotation_rad"]["curve"]) == 50
    assert rollout["dt_s"] == pytest.approx(1 / 148)
    assert "friction" in text
    files = document["files"]
    assert Path(files["plot"]).read_bytes()[:4] == b"\x89PNG"
    for path in files["assets"].values():
        ET.parse(path)
    with np.load(Path(files["folder"]) / "rollouts.npz", allow_pickle=False) as kept:
        assert kept["toss"].tolist() == [9]
        assert kept["toss_09.world_from_object"].shape == (51, 4, 4)
        np.testing.assert_allclose(np.diff(kept["toss_09.time_s"]), 1 / 148)
    results = Results.open(tmp_path / "out")
    assert results.contact("contact-only").friction == pytest.approx(document["friction"]["value"])
    assert results.shape("contact-only").source == "contact"
    again, _ = contact_only(
        poses_session, tmp_path / "out", train="3-8", test="9", geometry="box", init_m=0.05, steps=50
    )
    assert again["files"]["reused"]
    assert again["cpu_seconds"] == document["cpu_seconds"]


@pytest.mark.parametrize("of_vision", [True, False])
def test_own_tracks_that_break_a_law_are_said_to_be_off_and_only_imported_poses_to_be_imported_again(
    poses_session, real_tosses, tmp_path, monkeypatch, of_vision
):
    inverse = [replace(t, rotation=np.swapaxes(t.rotation, 1, 2).copy()) for t in real_tosses(range(3, 10))]
    turned = [replace(t, velocity_world_m_s=None, spin_object_rad_s=None) for t in inverse]
    source = PoseSource("track of variant ours", turned, None, of_vision=of_vision)
    monkeypatch.setattr("processing.pipeline.contact_only.find_poses", lambda *_: source)
    with pytest.raises(BadInput) as refused:
        contact_only(poses_session, tmp_path / "out", train="3-8", test="9", geometry="box", init_m=0.05, steps=20)
    assert ("import the data again" in str(refused.value)) is not of_vision
    assert ("its orientation is off" in str(refused.value)) is of_vision


@pytest.mark.parametrize("of_vision", [True, False])
def test_tracks_that_fall_too_slowly_are_said_to_be_scaled_and_only_imported_poses_to_be_imported_again(
    poses_session, simulated_tosses, tmp_path, monkeypatch, of_vision
):
    slow = [
        replace(t, toss=n, position_m=0.8 * t.position_m) for n, t in zip((3, 4, 7, 8, 9), simulated_tosses(5, 130))
    ]
    source = PoseSource("track of variant ours", slow, None, of_vision=of_vision)
    monkeypatch.setattr("processing.pipeline.contact_only.find_poses", lambda *_: source)
    with pytest.raises(BadInput, match="free fall reads 7.8") as refused:
        contact_only(poses_session, tmp_path / "out", train="3-8", test="9", geometry="box", init_m=0.05, steps=20)
    assert ("import it again" in str(refused.value)) is not of_vision
    assert ("most likely depth is scaled (by 0.8" in str(refused.value)) is of_vision


def test_the_imported_poses_are_the_track(poses_session, tmp_path):
    source = find_poses(poses_session, tmp_path / "out", None, [3, 4])
    assert [t.toss for t in source.tracks] == [3, 4]


@pytest.mark.parametrize(
    "options, words",
    [
        ({"train": "0-2"}, "no such tosses"),
        ({"train": "x"}, "wanted a toss number or a range"),
        ({"train": "9-3"}, "ends before it begins; wanted --train 3-9"),
        ({"test": "3-9"}, "wanted some left to learn from"),
        ({"steps": 0}, "at least 1"),
        ({"init_m": 50.0}, "metres"),
        ({"init_m": 0.0}, "metres"),
        ({"init_m": -0.05}, "metres"),
        ({"poses": "truth"}, "toss-truth"),
    ],
)
def test_bad_arguments_say_what_was_wanted(poses_session, tmp_path, options, words):
    with pytest.raises(BadInput, match=words):
        contact_only(poses_session, tmp_path / "out", **options)


def test_true_poses_of_a_session_with_cameras_come_from_its_truth_folder(tmp_path):
    sample = Session.open(Path(__file__).parents[3] / "recordings" / "samples" / "box_toss")
    source = find_poses(sample, tmp_path, "truth", [0, 1])
    assert [t.toss for t in source.tracks] == [0, 1]
    assert source.name.startswith("truth")
    assert all(np.isfinite(t.position_m).all() and t.position_m[:, 2].min() > -0.02 for t in source.tracks)


def test_cuda_is_refused_where_there_is_none(poses_session, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(BadInput, match="finds no CUDA device"):
        contact_only(poses_session, tmp_path / "out", device="cuda")


def test_visions_shape_is_brought_into_the_frame_of_the_truth(simulated_tosses):
    """The tracker's object frame is another one than the truth's: a constant turn and shift on the object's side."""
    turn, shift = rotation_matrices(np.array([[0.3, -0.2, 1.0]]))[0], np.array([0.02, -0.01, 0.03])
    true = simulated_tosses(2)
    tracks = [
        replace(t, rotation=t.rotation @ turn, position_m=t.position_m + t.rotation @ shift).part(slice(0, None, 5))
        for t in true
    ]
    corners = CORNERS * [0.05, 0.04, 0.03]
    seen = ObjectShape("tracker", "field", (corners - shift) @ turn, np.array([[0, 1, 2]]))
    moved = in_frame_of(true, PoseSource("track", tracks, seen))
    np.testing.assert_allclose(moved.vertices_m, corners, atol=1e-9)
    with pytest.raises(BadInput, match="no frame has both"):
        in_frame_of(true, PoseSource("track", [], seen))


def written(tmp_path, tracks, name="others"):
    """A poses-only session of some tracks."""
    with SessionWriter(
        tmp_path / name, {"name": name, "object": {"name": "box"}}, RigCalibration(cameras={})
    ) as writer:
        for track in tracks:
            with writer.toss(track.toss) as toss:
                for i, (R, p) in enumerate(zip(track.rotation, track.position_m)):
                    time_ns = 1_000_000_000 + round(1e9 * track.time_s[i])
                    pose = Transform("world", "object", R, p)
                    toss.pose("/track/pose", StampedPose(time_ns, "world", "object", pose.matrix))
        writer.finish("complete")
    return Session.open(tmp_path / name)


@pytest.mark.parametrize("init_m", [None, 0.08])
def test_tosses_without_contact_are_refused_whatever_the_start(simulated_tosses, tmp_path, init_m):
    session = written(tmp_path, [t.part(slice(0, 10)) for t in simulated_tosses(4)])
    with pytest.raises(BadInput, match="no contact in the data.*wanted tosses that are recorded until"):
        contact_only(session, tmp_path / "out", init_m=init_m)


@pytest.mark.parametrize("init_m", [None, 0.08])
def test_tosses_that_are_all_too_short_are_refused_as_such(simulated_tosses, tmp_path, init_m):
    session = written(tmp_path, [t.part(slice(0, 4)) for t in simulated_tosses(4)])
    with pytest.raises(BadInput, match="no toss can be used: toss 0: 4 frames with a pose; wanted at least 5"):
        contact_only(session, tmp_path / "out", init_m=init_m)


@pytest.mark.parametrize("init_m", [None, 0.08])
def test_a_wrong_step_is_refused_with_the_one_that_fits(simulated_tosses, tmp_path, init_m):
    session = written(tmp_path, [replace(t, time_s=1.2 * t.time_s) for t in simulated_tosses(4)])
    with pytest.raises(BadInput, match=r"free fall reads .* instead of 9.81 \(.*\): either the time step is wrong"):
        contact_only(session, tmp_path / "out", init_m=init_m)


def test_a_duplicate_across_training_and_test_is_refused(simulated_tosses, tmp_path):
    tracks = simulated_tosses(3)
    session = written(tmp_path, [*tracks, replace(tracks[1], toss=7)])
    with pytest.raises(BadInput, match="toss 7 of --test is the same recording as toss 1 of --train"):
        contact_only(session, tmp_path / "out", train="0-2", test="7")


@pytest.mark.slow
def test_more_steps_than_any_toss_has_end_with_the_longest_one_and_it_is_said(poses_session, tmp_path):
    """And a track that was asked for where there is none is said to be the imported poses."""
    document, text = contact_only(
        poses_session, tmp_path / "out", train="3", test="8-9", init_m=0.08, steps=5000, poses="track"
    )
    assert document["rollout"]["steps"] == 129
    assert "no toss lasts that long" in document["warnings"][-1]
    assert "no toss lasts that long" in text
    assert any("no track of vision" in w for w in document["warnings"])
    assert "no track of vision" in text


def test_errors_are_drawn_of_rollouts_that_go_on_after_every_toss(tmp_path):
    from matplotlib.figure import Figure

    from processing.contact.physics.rollout import Rollout, RolloutErrors, Start
    from processing.contact.report.figure import draw_errors
    from processing.contact.report.rollout_errors import Evaluation, summarise

    ended = np.where(np.arange(80) < 40, 0.01, np.nan) * np.ones((3, 1))
    errors = RolloutErrors((0, 1, 2), 1 / 148, ended, ended, 0)
    rolled = Rollout(np.zeros((3, 80, 3, 3)), np.zeros((3, 80, 3)), 0)
    start = Start(np.zeros((3, 3, 3)), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3)))
    done = Evaluation(errors, summarise(ended), summarise(ended), {}, rolled, start, (0.0, 0.0, 0.0))
    left, right = Figure().subplots(1, 2)
    draw_errors(left, right, done, ())
    assert left.get_xlim() == pytest.approx((0, 40 / 0.148))
    assert left.get_ylim()[1] == pytest.approx(10.5)


def test_ranges_take_the_tosses_that_exist():
    assert chosen_tosses("3-8", (3, 4, 7, 9), "--train") == [3, 4, 7]
    assert chosen_tosses("9", (3, 4, 7, 9), "--train") == [9]


def test_a_session_without_poses_is_refused(sample_session, tmp_path):
    with pytest.raises(BadInput, match=r"has no poses.*toss-session import contactnets"):
        contact_only(sample_session, tmp_path / "out")
