"""The calibration board: AprilTags in rows and columns on a stiff card."""

from __future__ import annotations

import numpy as np

from acquisition.synthetic import textures
from acquisition.synthetic.objects import box
from acquisition.synthetic.paint import Gloss, assemble
from acquisition.synthetic.rays import Body
from recordings.geometry import Transform, rotation_exp
from recordings.tracks import TagPlacement

COLUMNS, ROWS = 5, 4
PITCH_M = 0.065
TAG_M = 0.05078125
FIRST_TAG = 100
THICKNESS_M = 0.006
TEXELS_PER_M = 2600.0
MARGIN_M = 0.005


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


def _direction(angle: float) -> np.ndarray:
    return np.array([np.cos(angle), np.sin(angle), 0.0])
