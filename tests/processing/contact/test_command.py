import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from processing.contact.command import chosen, contact_only, find_poses
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.records import StampedPose
from recordings.results import Results
from recordings.session import Session
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration

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
    results = Results.open(tmp_path / "out")
    assert results.contact("contact-only").friction == pytest.approx(document["friction"]["value"])
    assert results.shape("contact-only").source == "contact"
    again, _ = contact_only(
        poses_session, tmp_path / "out", train="3-8", test="9", geometry="box", init_m=0.05, steps=50
    )
    assert again["files"]["reused"]
    assert again["cpu_seconds"] == document["cpu_seconds"]


def test_the_imported_poses_are_the_track(poses_session, tmp_path):
    source = find_poses(poses_session, tmp_path / "out", None, [3, 4])
    assert [t.toss for t in source.tracks] == [3, 4]


@pytest.mark.parametrize(
    "options, words",
    [
        ({"train": "0-2"}, "no such tosses"),
        ({"train": "x"}, "wanted a toss number or a range"),
        ({"test": "3-9"}, "wanted some left to learn from"),
        ({"steps": 0}, "at least 1"),
        ({"init_m": 50.0}, "metres"),
        ({"poses": "truth"}, "toss-truth"),
        ({"geometry": "nonconvex"}, "needs a shape to start from"),
    ],
)
def test_bad_arguments_say_what_was_wanted(poses_session, tmp_path, options, words):
    with pytest.raises(BadInput, match=words):
        contact_only(poses_session, tmp_path / "out", **options)


def test_ranges_take_the_tosses_that_exist():
    assert chosen("3-8", (3, 4, 7, 9), "--train") == [3, 4, 7]
    assert chosen("9", (3, 4, 7, 9), "--train") == [9]


def test_a_session_without_poses_is_refused(sample_session, tmp_path):
    with pytest.raises(BadInput, match=r"has no poses.*toss-session import contactnets"):
        contact_only(sample_session, tmp_path / "out")
