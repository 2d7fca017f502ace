"""`toss-calibrate hand-eye` on rendered views of a board that the robot holds, with its joint states."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from acquisition.synthetic.board import board_tags, held_board_poses
from acquisition.synthetic.config import SceneConfig
from acquisition.synthetic.lab import Lab
from calibration.cli import main
from recordings.geometry import Transform, rotation_exp
from recordings.records import ArmStates, EncodedImage
from recordings.robot.arm import panda
from recordings.session_writer import SessionWriter
from recordings.tracks import RigCalibration

VIEWS = 15


@pytest.fixture(scope="module")
def held_session(tmp_path_factory):
    """A session of fifteen held poses; d455_from_base is true and nobody says it."""
    lab = Lab(replace(SceneConfig(seed=3), still_rays=400_000))
    world_from_base = Transform("world", "base", rotation_exp(np.array([0, 0, -np.pi / 2])), np.array([0.0, 0.6, 0.0]))
    rng = np.random.default_rng(1)
    _, held = held_board_poses(world_from_base, lab.world_from_d455, VIEWS, rng)
    tags = [{"id": t.tag_id, "size_m": t.size_m, "T_board_tag": t.world_from_tag.matrix.tolist()} for t in board_tags()]
    folder = tmp_path_factory.mktemp("held") / "session"
    camera = lab.d455.camera
    names = tuple(j.name for j in panda().arm_joints)
    with SessionWriter(
        folder, {"board": {"family": "tag36h11", "tags": tags}}, RigCalibration({"d455": camera})
    ) as writer:
        with writer.calibration_views() as views:
            for k, pose in enumerate(held):
                when = (k + 1) * 1_000_000_000
                color, _, _ = lab.board_view(k, pose.world_from_board)
                data = cv2.imencode(".png", color[..., ::-1])[1].tobytes()
                q = pose.q_rad + np.radians(0.02) * rng.normal(size=7)
                times = when + np.arange(-20, 21, dtype=np.int64) * 1_000_000
                states = ArmStates(times, names, np.tile(q, (41, 1)), np.zeros((41, 7)), np.zeros(41))
                views.arm(states)
                views.color(EncodedImage("d455", k, when, when, "png", camera.width, camera.height, data))
        writer.finish()
    return folder, lab.world_from_d455.inverse() @ world_from_base


@pytest.mark.slow
def test_the_robots_base_is_found_from_rendered_views(held_session, capsys):
    folder, d455_from_base = held_session
    assert main(["hand-eye", str(folder), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    found = RigCalibration.read(folder / "calibration.json").transform("d455", "base")
    gap = d455_from_base.inverse() @ found
    assert 1e3 * np.linalg.norm(gap.translation_m) < 3.0
    assert np.degrees(np.arccos((np.trace(gap.rotation) - 1) / 2)) < 0.3
    assert said["verdict"] in ("good", "doubtful")
    assert (folder / "calibration" / "hand_eye.png").exists()
