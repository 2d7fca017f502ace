"""A sheet of random frames, colour and depth side by side, to be looked at."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput
from variety import session
from variety.camera import ColorCamera
from variety.colour import Painter
from variety.infrared import Pair
from variety.scene import SENSOR, build, generator
from variety.seeds import Case
from variety.spec import Spec, draw
from variety.throws import Thrower, moving_items

TILE_PX = (240, 140)
COLUMNS = 4
"""Of pairs."""
FAR_M = 1.6
KEPT_BITS = np.uint8(0xFC)
"""Of a colour: noise in the lowest bits makes a file large and shows nothing."""


def write_sheet(cases: Sequence[Case], path: Path, count: int, threads: int = 2) -> int:
    """A random frame of the first toss of `count` cases, those that cannot be shown left out and named on stderr;
    returns how many are shown. Pictures wider than two tiles are rendered at half size.
    """
    from PIL import Image

    tiles = []
    for case in cases:
        if len(tiles) == count:
            break
        try:
            tiles.append(tile(case, threads))
            print(f"{case.name}: shown", file=sys.stderr, flush=True)
        except BadInput as wrong:
            print(f"{case.name}: skipped: {wrong}", file=sys.stderr, flush=True)
    blank = np.zeros_like(tiles[0])
    tiles += [blank] * (-len(tiles) % COLUMNS)
    rows = [np.hstack(tiles[k : k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)]
    Image.fromarray(np.vstack(rows) & KEPT_BITS).save(path, optimize=True)
    return len(tiles)


def tile(case: Case, threads: int) -> UInt8[Array, "h w 3"]:
    """A frame at a random time: the picture as the file has it, and depth blue (near) to red (FAR_M), black none."""
    spec = half_size(draw(case, 1))
    scene = build(spec)
    throw = Thrower(spec, scene).throw(0)
    rng = generator(spec, SENSOR, 3)
    time_s = float(rng.uniform(0, throw.instants.end_s))
    with tempfile.TemporaryDirectory() as place:
        painter = Painter(spec, scene, Path(place) / "render", threads)
        shot = session.shot_of(spec, throw, time_s)
        painter.render([shot])
        pair = Pair(scene.world_from_camera, spec.depth, scene.standing, moving_items(scene), generator(spec, SENSOR))
        made = session.Made(spec, scene, painter, pair, session.Sight(scene), Path(place), Path(place))
        camera = ColorCamera(spec.camera, painter.still, np.array([time_s]), rng)
        picture = session.jpeg(camera.develop(painter.picture(shot), 0, rng), spec.camera.jpeg)
        depth = session.depth_at(made, throw, time_s, rng).astype(np.float32) * spec.depth.unit_m
    color = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
    shown = cv2.applyColorMap(np.clip(255 * depth / FAR_M, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    shown[depth == 0] = 0
    return np.hstack([_fitted(color, cv2.INTER_AREA), _fitted(shown, cv2.INTER_NEAREST)])[..., ::-1].copy()


def half_size(spec: Spec) -> Spec:
    """The same session with a colour camera of half the pixels each way, where a tile shows no more of them anyway."""
    if spec.camera.width <= 2 * TILE_PX[0]:
        return spec
    c = spec.camera
    camera = replace(
        c, width=c.width // 2, height=c.height // 2, focal_px=c.focal_px / 2, blur_px=c.blur_px / 2,
        center_off_px=(c.center_off_px[0] / 2, c.center_off_px[1] / 2),
    )  # fmt: skip
    return replace(spec, camera=camera)


def _fitted(picture: UInt8[Array, "h w 3"], how: int) -> UInt8[Array, "u v 3"]:
    """The whole picture inside a tile, a dark rim around it."""
    width, height = TILE_PX
    scale = min((width - 4) / picture.shape[1], (height - 4) / picture.shape[0])
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=how)
    out = np.full((height, width, 3), 20, np.uint8)
    y, x = (height - small.shape[0]) // 2, (width - small.shape[1]) // 2
    out[y : y + small.shape[0], x : x + small.shape[1]] = small
    return out
