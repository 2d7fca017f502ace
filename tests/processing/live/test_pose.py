"""The live pose: a known shape followed frame by frame, found again after a loss, and told on a loopback socket."""

from __future__ import annotations

import json
import socket
from pathlib import Path

import numpy as np
import pytest
import trimesh

from processing.live.pose.front import LivePose, PoseFront
from processing.live.pose.serve import TOPIC, PoseFile, PoseServer, pose_line
from processing.segment.background.static_scene import SceneSettings, StaticScene, calibrated_table_depth, learn_scene
from recordings.records import RgbdFrame
from recordings.session import Toss
from recordings.tracks import ObjectShape, RigCalibration

BOX_M = np.array([0.10, 0.08, 0.06])
FRAMES = 16


@pytest.fixture(scope="module")
def shape() -> ObjectShape:
    """The box, finely divided, without colours."""
    mesh = trimesh.creation.box(BOX_M).subdivide_to_size(0.008)
    seen = np.ones(len(mesh.vertices), dtype=bool)
    return ObjectShape("object", "test", np.array(mesh.vertices), np.array(mesh.faces), None, seen)


@pytest.fixture(scope="module")
def flight(tiny_world) -> tuple[list[RgbdFrame], list[np.ndarray], StaticScene]:  # type: ignore[no-untyped-def]
    poses = tiny_world.poses(FRAMES)
    frames = [tiny_world.see(pose, i)[0] for i, pose in enumerate(poses)]
    table = calibrated_table_depth(tiny_world.calibration, "d455")
    background = learn_scene([*frames, *(tiny_world.see(None, i)[0] for i in range(8))], table, SceneSettings())
    camera_from_world = tiny_world.world_from_camera.inverse()
    return frames, [(camera_from_world @ p).matrix for p in poses], background


def off_mm(pose: LivePose, true: np.ndarray) -> float:
    assert pose.camera_from_object is not None
    return 1e3 * float(np.linalg.norm(pose.camera_from_object[:3, 3] - true[:3, 3]))


def test_a_thrown_box_is_followed_and_found_again_after_it_was_hidden(tiny_world, shape, flight) -> None:  # type: ignore[no-untyped-def]
    frames, true, background = flight
    front = PoseFront(tiny_world.camera, shape, background, tiny_world.world_from_camera)
    empty = tiny_world.see(None, 0)[0]
    poses = [front.see(frame) for frame in frames[:8]]
    assert [p.status == "lost" for p in poses] == [False] * 8
    assert max(off_mm(p, t) for p, t in zip(poses, true)) < 5.0
    variances = np.array([np.linalg.eigvalsh(p.covariance) for p in poses])
    assert (variances > 0).all()
    hidden = [
        front.see(RgbdFrame("d455", 90 + i, (8 + i) * 33_333_333, 0, empty.color_rgb, empty.depth_m)) for i in (0, 1)
    ]
    assert [p.status for p in hidden] == ["lost", "lost"]
    assert not front.tracking
    again = front.see(frames[12])
    assert again.status != "lost"
    assert off_mm(again, true[12]) < 8.0


def test_what_features_said_of_a_frame_is_forgotten_with_it(tiny_world, shape, flight) -> None:  # type: ignore[no-untyped-def]
    """Frames take each other's places in the store: motions of the one before would be those of another picture."""
    frames, _, background = flight
    front = PoseFront(tiny_world.camera, shape, background, tiny_world.world_from_camera)
    front.see(frames[0])
    now, taken = front._slot, front._slot + 1
    stale = {(now, taken): [], (taken, now): []}
    front._scene.matched.update({**stale, (now, now): []})
    front._scene.features[taken] = front._scene.described(now)
    front.see(frames[1])
    assert all(front._scene.matched.get(pair) is not kept for pair, kept in stale.items())
    assert (now, now) in front._scene.matched
    assert front._scene.features.get(taken) is not front._scene.features[now]


def test_a_pose_comes_back_from_its_line_and_its_file(tiny_world, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    pose = np.eye(4)
    pose[:3, 3] = (0.1, 0.2, 0.7)
    seen = LivePose(4, 123_000_000, pose, 1e-4 * np.eye(6), "tracked", 0.03)
    lost = LivePose(5, 156_000_000, None, np.full((6, 6), np.nan), "lost", float("nan"))
    said = json.loads(pose_line(seen, "d455", 12.3456))
    assert said["position_m"] == [0.1, 0.2, 0.7]
    assert said["latency_ms"] == 12.35
    assert json.loads(pose_line(lost, "d455", 1.0))["position_m"] is None
    with PoseFile(tmp_path / "pose.mcap", RigCalibration({"d455": tiny_world.camera}), "d455") as file:
        file.write(seen)
        file.write(lost)
    with Toss(tmp_path / "pose.mcap") as opened:
        (found,) = opened.poses(TOPIC)
        assert opened.streams()[TOPIC].schema == "foxglove.PoseInFrame"
    assert (found.time_ns, found.target, found.source, found.status) == (123_000_000, "d455", "object", "tracked")
    np.testing.assert_allclose(found.matrix, pose)
    np.testing.assert_allclose(found.covariance, 1e-4 * np.eye(6))


def test_clients_read_lines_and_one_that_does_not_is_let_go(tmp_path: Path) -> None:
    with PoseServer(tmp_path / "pose.json") as server:
        about = json.loads((tmp_path / "pose.json").read_text())
        assert about["host"] == "127.0.0.1"
        assert server.send("nobody listens") == 0
        with (
            socket.create_connection((about["host"], about["port"])) as reads,
            socket.create_connection((about["host"], about["port"])),
            reads.makefile("r") as lines,
        ):
            assert server.send("first") == 2
            assert lines.readline() == "first\n"
            for _ in range(200):
                kept = server.send("x" * 50_000)
                lines.readline()
            assert kept == 1
    assert not (tmp_path / "pose.json").exists()
