"""The robot in the picture: drawn, its place and clock refined, the object before it kept; depth's scale."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

from processing.pipeline.start import start_run
from processing.segment.background.depth_scale import DepthScaleSettings, posterior_scale, table_scale
from processing.segment.background.static_scene import StaticScene, calibrated_table_depth
from processing.segment.robot.fit import (
    RobotFitSettings,
    RobotObservation,
    choose_observations,
    edge_offsets,
    fit_robot,
)
from processing.segment.robot.frames import RobotFrames, RobotSettings, with_robot
from processing.segment.robot.of_session import Rig, RobotOfSession
from processing.segment.robot.render import RobotView
from processing.sensor.frames import corrected_depth, metric_frames
from processing.stages.masks.find import find_object
from processing.stages.masks.segment import segment
from processing.stages.recording.rig import refine_rig
from processing.stages.recording.scene import learn_static_scene
from recordings.geometry import CameraModel, Transform, rotation_exp, rotation_log
from recordings.progress import Silent
from recordings.records import ArmStates, RgbdFrame
from recordings.robot.arm import PANDA_TOOL, ArmPath, panda
from recordings.robot.collada import read_collada
from recordings.session import RgbdFrames, Session
from recordings.tracks import RigCalibration

FRAME_NS = 33_333_333
CAMERA = CameraModel(
    "d455",
    256,
    192,
    np.array([[160.0, 0, 128], [0, 160, 96], [0, 0, 1]]),
    "brown-conrady",
    (-0.055, 0.065, 0.0006, -0.0004, -0.02),
)
TURN = np.stack([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])  # looks at the robot from its front
CAMERA_FROM_BASE = Transform("d455", "base", TURN, np.array([0.0, 0.45, 1.35]))
NAMES = tuple(j.name for j in panda().arm_joints)


def angles(time_s: np.ndarray) -> np.ndarray:
    """An arm that swings with up to 1.5 rad/s."""
    base = np.array([0.0, -0.3, 0.0, -2.1, 0.0, 2.1, 0.785])
    swing = np.array([0.5, 0.3, 0.3, 0.4, 0.2, 0.3, 0.0])
    return base + swing * np.sin(3.0 * np.asarray(time_s)[:, None] + np.arange(7))


def states(offset_s: float = 0.0, width_m: float = 0.05) -> ArmStates:
    times = np.arange(0.0, 1.2, 0.001)
    stamps = np.round((times + offset_s) * 1e9).astype(np.int64)
    return ArmStates(stamps, NAMES, angles(times), np.zeros((len(times), 7)), np.full(len(times), width_m))


@pytest.fixture(scope="module")
def view() -> RobotView:
    return RobotView(panda(), CAMERA)


@pytest.fixture(scope="module")
def wall() -> StaticScene:
    """A textured wall 2 m behind the robot, no table."""
    shape = (CAMERA.height, CAMERA.width)
    rng = np.random.default_rng(0)
    color = np.kron(rng.integers(20, 120, (24, 32, 3)), np.ones((8, 8, 1))).astype(np.float32)
    flat = np.full(shape, 2.5, np.float32)
    return StaticScene(flat, 0 * flat + 1e-3, color, 0 * flat + 2, np.ones(shape, bool), 0 * flat)


def drawn_frame(view: RobotView, wall: StaticScene, i: int, scale: float = 1.0) -> RgbdFrame:
    """What the camera sees of a white robot before the wall; depth in a camera that reports `scale` times too far."""
    time_ns = i * FRAME_NS
    root = CAMERA_FROM_BASE @ Transform.identity("base", "panda_link0")
    links = {name: root @ link for name, link in ArmPath(panda(), states()).links(time_ns).items()}
    depth = view.draw(links).depth_m
    color = np.where((depth > 0)[..., None], np.uint8(220), wall.color_rgb.astype(np.uint8))
    measured = np.where(depth > 0, depth, wall.depth_m) * np.float32(scale)
    return RgbdFrame("d455", i, time_ns, time_ns, color, np.round(measured, 3).astype(np.float32))


def test_a_drawn_link_covers_its_vertices(view: RobotView) -> None:
    """Vertices that face the camera lie on the drawn surface, through the lens's distortion."""
    root = CAMERA_FROM_BASE @ Transform.identity("base", "panda_link0")
    links = {name: root @ link for name, link in panda().links(angles(np.zeros(1))[0]).items()}
    hand = next(m for m in panda().meshes if m.link == "panda_hand")
    others = tuple(p for p in view.parts if p != "panda_hand")
    image = view.draw(links, others)
    points = links["panda_hand"].points(hand.link_from_mesh.points(read_collada(hand.path).vertices_m))
    u, v = np.round(CAMERA.project(points)).astype(int).T
    assert (image.depth_m[v, u] > 0).mean() > 0.85  # the rest lies on the outline
    on = image.depth_m[v, u] > 0
    assert np.quantile((points[on, 2] - image.depth_m[v[on], u[on]]), 0.02) > -0.02  # nothing in front of the surface
    assert np.abs(np.linalg.norm(image.normal[image.depth_m > 0], axis=-1) - 1).max() < 1e-4


def test_a_coarser_drawing_is_every_nth_pixel(view: RobotView) -> None:
    root = CAMERA_FROM_BASE @ Transform.identity("base", "panda_link0")
    links = {name: root @ link for name, link in panda().links(angles(np.zeros(1))[0]).items()}
    np.testing.assert_allclose(view.coarser(4).draw(links).depth_m, view.draw(links).depth_m[::4, ::4], atol=1e-6)


def test_place_clock_and_scale_are_found_from_the_pictures(view: RobotView, wall: StaticScene) -> None:
    """5 mm, 0.5 deg, 10 ms and 1 % of error put in; back to 1 mm, 0.1 deg, 1 ms, 0.1 %."""
    axis = np.array([0.6, -0.5, 0.62])
    off = Transform("base", "base", rotation_exp(np.deg2rad(0.5) * axis), np.array([-0.003, 0.003, 0.0025]))
    path = ArmPath(panda(), states(offset_s=0.010))
    observations = [RobotObservation(drawn_frame(view, wall, i, 1.01), path) for i in (3, 8, 13, 18, 23, 28)]
    seen = replace(wall, depth_m=wall.depth_m * np.float32(1.01))
    fit = fit_robot(observations, CAMERA, CAMERA_FROM_BASE @ off, seen, RobotFitSettings(stride=3, margin_px=2))
    assert fit.refused is None
    left = fit.camera_from_base.inverse() @ CAMERA_FROM_BASE
    at = np.array([[0.3, 0.0, 0.5]])
    assert np.linalg.norm(left.points(at) - at) < 1e-3
    assert np.degrees(np.linalg.norm(rotation_log(left.rotation))) < 0.1
    assert fit.delay_s == pytest.approx(0.010, abs=1e-3)
    assert fit.depth_scale == pytest.approx(1.01, abs=1e-3)
    assert fit.depth_after_m < 0.3 * fit.depth_before_m


def test_a_robot_that_is_not_in_view_is_not_refined(wall: StaticScene) -> None:
    away = Transform("d455", "base", TURN, np.array([0.0, 0.45, -3.0]))
    frame = RgbdFrame("d455", 0, FRAME_NS, FRAME_NS, wall.color_rgb.astype(np.uint8), wall.depth_m)
    fit = fit_robot([RobotObservation(frame, ArmPath(panda(), states()))], CAMERA, away, wall, RobotFitSettings())
    assert fit.refused is not None
    assert fit.camera_from_base is away
    assert fit.depth_scale == 1.0


def test_an_edge_is_found_where_it_lies() -> None:
    difference = np.zeros((60, 80), np.float32)
    difference[:, :40] = 100  # the edge lies at x = 39.5
    pixels, outward = np.array([[37.0, 30.0], [39.0, 20.0]]), np.array([[1.0, 0.0], [1.0, 0.0]])
    known = np.ones((60, 80), bool)
    offsets = edge_offsets(difference, known, pixels, outward, 6.0, RobotFitSettings())
    np.testing.assert_allclose(offsets, [2.0, 0.0], atol=0.3)
    assert np.isnan(edge_offsets(difference, ~known, pixels, outward, 6.0, RobotFitSettings())).all()


def test_sights_are_spread_and_fast_and_known() -> None:
    chosen = choose_observations(
        [20, 20], lambda t, i: float("nan") if t == 1 else float(i), RobotFitSettings(frames=6)
    )
    assert {t for t, _ in chosen} == {0}
    assert {(0, 0), (0, 19), (0, 18), (0, 17)} <= set(chosen)


def test_an_object_before_the_robot_keeps_its_pixels(view: RobotView, wall: StaticScene, tmp_path: Path) -> None:
    frame = drawn_frame(view, wall, 5)
    box = _inside_robot(frame)
    depth = frame.depth_m.copy()
    depth[box] -= 0.05
    frame = replace(frame, depth_m=depth)
    robot = RobotFrames([frame], view, ArmPath(panda(), states()), CAMERA_FROM_BASE)
    seen = robot.seen(frame, 0)
    assert seen is not None
    on_robot = seen.at_color_m[box] > 0
    assert on_robot.sum() > 100
    assert not robot[0][box].any()
    assert seen.certain.sum() > 0.9 * ((seen.at_color_m > 0).sum() - on_robot.sum())
    robot.write(tmp_path)
    stored = cv2.imread(str(tmp_path / "000000.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(stored > 0, seen.certain)
    together = with_robot(wall, frame, seen, RobotSettings())
    nearer = (together.depth_m - frame.depth_m > 0.03)[box]
    assert nearer[on_robot].all()


def _inside_robot(frame: RgbdFrame) -> tuple[slice, slice]:
    """A window of 20 x 20 pixels amid the robot's pixels."""
    v, u = np.nonzero((frame.color_rgb == 220).all(-1))
    k = int(np.argsort(np.abs(v - np.median(v)) + np.abs(u - np.median(u)))[0])
    return slice(int(v[k]) - 10, int(v[k]) + 10), slice(int(u[k]) - 10, int(u[k]) + 10)


def test_colour_and_depth_are_drawn_at_their_own_times(view: RobotView, wall: StaticScene) -> None:
    frame = replace(drawn_frame(view, wall, 5), depth_time_ns=8 * FRAME_NS, depth_m=drawn_frame(view, wall, 8).depth_m)
    seen = RobotFrames([frame], view, ArmPath(panda(), states()), CAMERA_FROM_BASE).seen(frame, 0)
    assert seen is not None
    np.testing.assert_allclose(np.where(seen.depth_m > 0, seen.depth_m, 2.5), frame.depth_m, atol=6e-4)
    white = (frame.color_rgb == 220).all(-1)
    np.testing.assert_array_equal(seen.at_color_m > 0, white)


def test_a_gripper_that_reports_no_width_is_measured(view: RobotView, wall: StaticScene) -> None:
    frame = drawn_frame(view, wall, 5)
    silent = replace(states(), finger_width_m=np.full(1200, np.nan))
    robot = RobotFrames([frame], view, ArmPath(panda(), silent), CAMERA_FROM_BASE)
    assert robot._fitted_width(frame) == pytest.approx(0.05, abs=0.009)


def test_frames_outside_of_the_joint_states_have_no_robot(view: RobotView, wall: StaticScene) -> None:
    frame = replace(drawn_frame(view, wall, 5), time_ns=9_000_000_000, depth_time_ns=9_000_000_000)
    robot = RobotFrames([frame], view, ArmPath(panda(), states()), CAMERA_FROM_BASE)
    assert robot.seen(frame, 0) is None
    assert not robot[0].any()


def test_the_hand_is_known_while_the_fingers_stay_as_they_were(view: RobotView) -> None:
    said = states()
    opened = replace(said, finger_width_m=np.where(said.time_ns < 600_000_000, 0.05, 0.07))
    path = ArmPath(panda(), opened)
    robot = RobotFrames([], view, path, CAMERA_FROM_BASE, delay_s=0.01)
    times_ns = np.array([0, 300_000_000, 589_000_000, 700_000_000, 9_000_000_000])
    hand = robot.hand(times_ns)
    assert np.isfinite(hand[:, 0, 0]).tolist() == [True, True, True, False, False]
    root = CAMERA_FROM_BASE @ Transform.identity("base", path.robot.root)
    np.testing.assert_allclose(hand[1], (root @ path.links(310_000_000)[PANDA_TOOL]).matrix)


def table_scene(tiny_world: Any, factor: float) -> tuple[StaticScene, Transform]:
    table = calibrated_table_depth(tiny_world.calibration, "d455")
    true = tiny_world.world_from_camera
    ones = np.ones(table.shape, bool)
    depth = (table * np.float32(factor)).astype(np.float32)
    return StaticScene(depth, 0 * depth, np.zeros((*depth.shape, 3), np.float32), 0 * depth, ones, table), true


def test_the_table_tells_the_depth_scale(tiny_world: Any) -> None:
    scene, world_from_camera = table_scene(tiny_world, 1.01)
    found = table_scale(scene, tiny_world.camera, world_from_camera, DepthScaleSettings())
    assert found is not None
    assert found.scale == pytest.approx(1.01, abs=3e-4)
    assert found.turned_at_camera == pytest.approx(found.turned_at_table, abs=3e-4)
    sure = DepthScaleSettings(place_m=0.0)
    told = table_scale(scene, tiny_world.camera, world_from_camera, sure)
    assert told is not None
    assert posterior_scale(told.scale, told.sigma, sure) == pytest.approx(1.01, abs=4e-4)


@pytest.mark.parametrize("pivot", ["table", "camera"])
def test_a_tilted_table_is_the_calibrations_error_and_its_scale_counts_less(tiny_world: Any, pivot: str) -> None:
    """A calibration that is turned about a point of the table keeps the distance there; one that is turned about the
    camera keeps the camera's height. The scale is halfway, and as unsure as they are apart."""
    scene, true = table_scene(tiny_world, 1.004)
    turn = rotation_exp(np.array([np.deg2rad(0.3), 0, 0]))
    keeps = np.zeros(3) if pivot == "camera" else middle_of_table(scene, tiny_world, true) - true.translation_m
    at = true.translation_m + keeps - turn @ keeps
    calibrated = Transform("world", "d455", turn @ true.rotation, at)
    found = table_scale(scene, tiny_world.camera, calibrated, DepthScaleSettings())
    assert found is not None
    assert found.tilt_deg == pytest.approx(0.3, abs=0.02)
    right, other = found.turned_at_table, found.turned_at_camera
    right, other = (right, other) if pivot == "table" else (other, right)
    assert right == pytest.approx(1.004, abs=4e-4)
    assert abs(other - 1.004) > 5 * abs(right - 1.004)
    assert found.scale == pytest.approx((right + other) / 2)
    assert abs(found.scale - 1.004) < 1.2 * found.sigma


def middle_of_table(scene: StaticScene, tiny_world: Any, world_from_camera: Transform) -> np.ndarray:
    """Of what the camera sees of it (world)."""
    points = tiny_world.camera.pixel_rays() * scene.table_depth_m[..., None]
    seen = np.median(points[scene.table_depth_m > 0], axis=0)
    middle = world_from_camera.rotation @ seen + world_from_camera.translation_m
    return np.array([middle[0], middle[1], 0.0])


def test_the_scale_is_the_posteriors_mean() -> None:
    settings = DepthScaleSettings(among_cameras=0.01)
    assert posterior_scale(1.02, 0.01, settings) == pytest.approx(1.01)
    assert posterior_scale(0.98, 0.0, settings) == pytest.approx(0.98)
    assert posterior_scale(float("nan"), float("nan"), settings) == 1.0


def test_what_lies_on_the_table_does_not_move_its_scale(tiny_world: Any) -> None:
    scene, world_from_camera = table_scene(tiny_world, 1.01)
    cluttered = scene.depth_m.copy()
    h, w = cluttered.shape
    cluttered[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3] -= 0.015
    found = table_scale(replace(scene, depth_m=cluttered), tiny_world.camera, world_from_camera, DepthScaleSettings())
    assert found is not None
    assert found.scale == pytest.approx(1.01, abs=1e-3)


def test_corrected_depth_is_divided_and_no_return_stays() -> None:
    depth = np.array([[0.0, 1.004]], np.float32)
    np.testing.assert_allclose(corrected_depth(depth, 1.004), [[0, 1]], atol=1e-6)
    frame = RgbdFrame("d455", 0, 0, 0, np.zeros((1, 2, 3), np.uint8), depth)
    times = np.zeros(1, np.int64)
    frames = RgbdFrames(times, lambda i: frame, times, (), 0)
    assert metric_frames(frames, 1.0) is frames
    np.testing.assert_allclose(metric_frames(frames, 1.004)[0].depth_m, [[0, 1]], atol=1e-6)


def test_without_joint_states_the_masks_are_as_before_and_the_counts_say_so(
    record_tiny: Callable[..., Path], tmp_path: Path
) -> None:
    from processing.config import Config

    with Session.open(record_tiny(tosses=(0,))) as session:
        run: Any = start_run(session, (0,), tmp_path / "results", Config(), "multi-hypothesis", lambda _: Silent())
        scene = learn_static_scene(run)
        rig = refine_rig(run, scene)
        masks = segment(run, 0, scene, rig, find_object(run, scene, rig))
    assert rig.result.robot == "no joint states of a Franka Panda in these tosses"
    assert masks.result.robot == rig.result.robot
    assert Rig.read(rig.folder).camera_from_base is None
    assert masks.result.empty == 0


def test_a_recorded_robot_is_drawn_to_the_pixel(data: Callable[[str], Path]) -> None:
    """lab_dev's true robot masks; calibration and clock are exact there."""
    folder, truth = data("lab_dev"), data("lab_dev_truth")
    said = json.loads((folder / "session.json").read_text())
    camera = CameraModel(
        "d455", 640, 480, np.array(said["camera"]["K"]), "brown-conrady", tuple(said["camera"]["distortion"])
    )
    world_from_camera = Transform.from_matrix("world", "d455", np.array(said["T_world_camera"]))
    base = world_from_camera.inverse() @ Transform.from_matrix("world", "base", np.array(said["T_world_base"]))
    rows = np.loadtxt(folder / "toss_00" / "arm.csv", delimiter=",", skiprows=1)
    stamps = np.round(rows[:, 0] * 1e9).astype(np.int64)
    path = ArmPath(panda(), ArmStates(stamps, NAMES, rows[:, 1:8], rows[:, 8:15], rows[:, 15]))
    times = np.loadtxt(folder / "toss_00" / "timestamps.txt")
    view = RobotView(panda(), camera)
    root = base @ Transform.identity("base", "panda_link0")
    for i in (0, 44, 60):
        image = view.draw({n: root @ t for n, t in path.links(int(times[i] * 1e9)).items()})
        robot, thing = (
            cv2.imread(str(truth / "toss_00" / kind / f"{i:06d}.png"), 0) > 0 for kind in ("robot_masks", "masks")
        )
        drawn = (image.depth_m > 0) & ~thing
        assert (drawn & robot).sum() / (drawn | robot).sum() > 0.998


def test_a_missing_base_pose_and_another_arm_are_said() -> None:
    def session(said: ArmStates) -> Session:
        made = Mock(spec=Session)
        made.calibration = RigCalibration({})
        made.toss.return_value.arm_states.return_value = said
        return made

    assert RobotOfSession(session(states())).missing((0,)) == "no base pose in the calibration"
    other = RobotOfSession(session(replace(states(), joint_names=("a",) * 7)))
    assert (
        other.missing((0,))
        == f"no joint states of a Franka Panda in these tosses; the recorded joints are {', '.join('a' * 7)}"
    )
