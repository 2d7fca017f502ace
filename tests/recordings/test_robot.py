"""The Panda's kinematics and meshes: against a recorded tool pose, against differences, against bad files."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.robot.arm import PANDA_TOOL, panda, panda_urdf, read_urdf
from recordings.robot.collada import read_collada

READY = np.array([0.1, -0.4, 0.2, -2.1, 0.3, 2.0, 0.7])


def test_the_panda_has_seven_joints_and_their_limits():
    joints = panda().arm_joints
    assert [j.name for j in joints] == [f"panda_joint{k}" for k in range(1, 8)]
    assert joints[3].upper == pytest.approx(-0.0698)
    assert joints[0].fastest == pytest.approx(2.175)


def test_the_tool_is_where_lab_dev_says(data):
    folder, truth = data("lab_dev"), data("lab_dev_truth")
    first = np.loadtxt(folder / "toss_00" / "arm.csv", delimiter=",", skiprows=1, max_rows=1)
    world_from_base = np.array(json.loads((folder / "session.json").read_text())["T_world_base"])
    tool = panda().links(first[1:8], first[15])[PANDA_TOOL]
    recorded = np.load(truth / "toss_00" / "poses_camera_object.npz")["T_world_tcp"][0]
    # the recorded angles have 2e-5 rad of noise
    np.testing.assert_allclose(world_from_base @ tool.matrix, recorded, atol=2e-4)


def test_the_fingers_part_by_their_width():
    links = panda().links(READY, 0.05)
    gap = links["panda_leftfinger"].translation_m - links["panda_rightfinger"].translation_m
    assert np.linalg.norm(gap) == pytest.approx(0.05)


def test_the_jacobian_is_the_derivative():
    robot, h = panda(), 1e-6
    at = robot.links(READY)[PANDA_TOOL]
    jacobian = robot.jacobian(READY, PANDA_TOOL, at.translation_m)
    for k in range(7):
        moved = robot.links(READY + h * np.eye(7)[k])[PANDA_TOOL]
        np.testing.assert_allclose((moved.translation_m - at.translation_m) / h, jacobian[:3, k], atol=1e-5)
        turn = (moved.rotation @ at.rotation.T - np.eye(3)) / h
        np.testing.assert_allclose([turn[2, 1], turn[0, 2], turn[1, 0]], jacobian[3:, k], atol=1e-5)


def test_joints_behind_a_link_do_not_move_it():
    robot = panda()
    elbow = robot.links(READY)["panda_link4"].translation_m
    np.testing.assert_array_equal(robot.jacobian(READY, "panda_link4", elbow)[:, 4:], 0)


def test_the_wrong_number_of_angles_is_refused():
    with pytest.raises(BadInput, match="6 joint angles for 7 joints"):
        panda().links(READY[:6])


def test_every_visual_mesh_is_read_in_metres_with_colours():
    sizes = {m.link: read_collada(m.path) for m in panda().meshes}
    assert len(sizes) == 11
    for mesh in sizes.values():
        assert 0.01 < np.ptp(mesh.vertices_m, axis=0).max() < 0.5
        assert mesh.faces.max() < len(mesh.vertices_m)
        assert mesh.face_rgb.shape == (len(mesh.faces), 3)
    # the fingers lie before the hand, the right one turned by half a turn
    turn = next(m for m in panda().meshes if m.link == "panda_rightfinger").link_from_mesh.rotation
    np.testing.assert_allclose(turn, np.diag([-1, -1, 1]), atol=1e-12)


def test_a_file_that_is_no_urdf_is_refused(tmp_path):
    (tmp_path / "broken.urdf").write_text("<robot><link")
    with pytest.raises(BadInput, match="cannot be read as a URDF"):
        read_urdf(tmp_path / "broken.urdf")


def test_two_bases_are_refused(tmp_path):
    (tmp_path / "two.urdf").write_text('<robot name="r"><link name="a"/><link name="b"/></robot>')
    with pytest.raises(BadInput, match=re.escape("found 2 links without a parent (a, b); wanted one base")):
        read_urdf(tmp_path / "two.urdf")


def test_a_missing_mesh_is_named(tmp_path):
    text = panda_urdf().read_text().replace("link3.dae", "nowhere.dae")
    (tmp_path / "panda.urdf").write_text(text)
    with pytest.raises(BadInput, match=r"mesh package://.*link0\.dae is in none of the folders"):
        read_urdf(tmp_path / "panda.urdf")


def test_a_file_that_is_no_collada_is_refused(tmp_path):
    (tmp_path / "x.dae").write_text("no xml")
    with pytest.raises(BadInput, match="cannot be read as Collada"):
        read_collada(tmp_path / "x.dae")


def test_collada_with_y_up_is_refused(tmp_path):
    (tmp_path / "y.dae").write_text("<COLLADA><asset><up_axis>Y_UP</up_axis></asset></COLLADA>")
    with pytest.raises(BadInput, match="Y_UP is not supported; wanted Z_UP"):
        read_collada(tmp_path / "y.dae")
