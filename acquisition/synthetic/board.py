"""The calibration board: AprilTags in rows and columns on a stiff card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.objects import textures
from acquisition.synthetic.objects.paint import Gloss, assemble
from acquisition.synthetic.objects.shapes import box
from acquisition.synthetic.render.rays import Body
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.robot.arm import Robot, panda
from recordings.tracks import TagPlacement

COLUMNS, ROWS = 5, 4
PITCH_M = 0.065
TAG_M = 0.05078125
FIRST_TAG = 100
THICKNESS_M = 0.006
TEXELS_PER_M = 2600.0
MARGIN_M = 0.005
HELD_Q_RAD = np.array([0.0, 0.1, 0.0, -1.9, 0.0, 2.4, 0.8])
"""Joints of a Panda that holds a board up in front of itself."""
HELD_REACH_RAD = np.array([0.25, 0.25, 0.3, 0.3, 0.7, 0.7, 0.8])


def board_tags() -> tuple[TagPlacement, ...]:
    """The tags in the board's frame (centre of the card, z out of the printed side); target frame is `board`."""
    found = []
    for row in range(ROWS):
        for column in range(COLUMNS):
            x = (column - (COLUMNS - 1) / 2) * PITCH_M
            y = ((ROWS - 1) / 2 - row) * PITCH_M
            # z of a tag goes into the paper: y down and x to the board's -x, as it is read from the printed side
            place = Transform("board", "tag", np.diag([-1.0, 1.0, -1.0]), np.array([x, y, THICKNESS_M / 2]))
            found.append(TagPlacement(FIRST_TAG + row * COLUMNS + column, TAG_M, place))
    return tuple(found)


def board_body() -> Body:
    """The card as something that can be rendered."""
    width, height = COLUMNS * PITCH_M + 2 * MARGIN_M, ROWS * PITCH_M + 2 * MARGIN_M
    solid = box(width, height, THICKNESS_M)
    pictures = []
    for chart in solid.charts:
        h, w = (max(2, int(np.ceil(side * TEXELS_PER_M))) for side in (chart.height_m, chart.width_m))
        picture = np.full((h, w, 3), textures.WHITE, np.float32)
        assert chart.object_from_chart is not None
        if chart.object_from_chart.rotation[2, 2] < -0.9:
            chart_from_board = chart.object_from_chart.inverse()
            for tag in board_tags():
                center = chart_from_board.points(tag.world_from_tag.translation_m)[:2] * TEXELS_PER_M
                # the chart's axes run along the board's x and -y, the tag's against both
                textures.paint_tag(picture, tag.tag_id, center, tag.size_m * TEXELS_PER_M, turned=True)
        pictures.append(picture)
    return Body("board", assemble(solid, pictures, TEXELS_PER_M, Gloss(0.02, 10.0)))


def board_pose(rng: np.random.Generator) -> Transform:
    """world_from_board: held over the table, printed side up and tilted in some direction."""
    tilt = np.deg2rad(rng.uniform(5, 50)) * _direction(rng.uniform(0, 2 * np.pi))
    turn = rotation_exp(tilt) @ rotation_exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
    return Transform("world", "board", turn, np.array([*rng.uniform(-0.15, 0.15, 2), rng.uniform(0.15, 0.35)]))


def board_before(camera: CameraModel, world_from_camera: Transform, cell: int, rng: np.random.Generator) -> Transform:
    """world_from_board: before a camera, in the given ninth of its picture, tilted somehow, above the table."""
    row, column = divmod(cell % 9, 3)
    corners = np.array([[x, y, 0.0] for x in (-0.17, 0.17) for y in (-0.14, 0.14)])
    while True:
        shares = (np.array([column, row]) + rng.uniform(0.2, 0.8, 2)) / 3
        ray = world_from_camera.vectors(camera.rays(shares[None] * [camera.width, camera.height]))[0]
        place_m = world_from_camera.translation_m + rng.uniform(0.45, 1.0) * ray / np.linalg.norm(ray)
        upright = _facing(place_m, world_from_camera.translation_m).rotation
        tilt = rotation_exp(np.deg2rad(rng.uniform(0, 45)) * _direction(rng.uniform(0, 2 * np.pi)))
        rolled = rotation_exp(np.array([0.0, 0.0, rng.choice([0.0, np.pi]) + rng.normal(0, 0.2)]))
        pose = Transform("world", "board", upright @ tilt @ rolled, place_m)
        if pose.points(corners)[:, 2].min() > 0.02:
            return pose


def _direction(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])


@dataclass(frozen=True, eq=False)
class HeldBoard:
    """One robot pose of a hand-eye calibration: joint angles, and where the board in the gripper then is."""

    q_rad: Float[Array, " j"]
    world_from_board: Transform


def held_board_poses(
    world_from_base: Transform, world_from_camera: Transform, count: int, rng: np.random.Generator
) -> tuple[Transform, list[HeldBoard]]:
    """tool_from_board, and `count` poses of a Panda that holds the board before a fixed camera: turned by up to half a
    right angle about several axes, always printed side to the camera and in its view."""
    robot = panda()
    camera_m = world_from_camera.translation_m
    first = world_from_base @ _tool(robot, HELD_Q_RAD)
    tool_from_board = first.inverse() @ _facing(first.translation_m, camera_m)
    held: list[HeldBoard] = []
    while len(held) < count:
        q_rad = HELD_Q_RAD + rng.uniform(-1, 1, len(HELD_Q_RAD)) * HELD_REACH_RAD
        board = world_from_base @ _tool(robot, q_rad) @ tool_from_board
        towards = camera_m - board.translation_m
        distance_m = float(np.linalg.norm(towards))
        in_camera = world_from_camera.inverse().points(board.translation_m[None])[0]
        aside = float(np.linalg.norm(in_camera[:2]) / max(in_camera[2], 1e-6))
        if board.rotation[:, 2] @ towards > np.cos(np.deg2rad(50)) * distance_m and aside < 0.45 and distance_m > 0.35:
            held.append(HeldBoard(q_rad, Transform("world", "board", board.rotation, board.translation_m)))
    return tool_from_board, held


def _tool(robot: Robot, q_rad: Float[Array, " j"]) -> Transform:
    found = robot.links(q_rad)["panda_hand_tcp"]
    return Transform("base", "tool", found.rotation, found.translation_m)


def _facing(place_m: Float[Array, "3"], camera_m: Float[Array, "3"]) -> Transform:
    """world_from_board at a place, printed side to the camera, its rows level."""
    z = (camera_m - place_m) / np.linalg.norm(camera_m - place_m)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return Transform("world", "board", np.stack([x, np.cross(z, x), z], 1), place_m + 0.05 * z)
