"""Procedural pictures in linear light (0..1), all from a seeded generator: surfaces of objects, table, room."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

MARKER_MODULES = 8
"""Side of an AprilTag's black square, in modules (tag36h11: 6 of data and a border of 1)."""
MARKER_PX = 160
WHITE, BLACK = 0.85, 0.03


def noise(rng: np.random.Generator, height: int, width: int, cell: float) -> Float32[Array, "h w"]:
    """Smooth noise in 0..1 with features of about `cell` pixels."""
    small = rng.random((max(2, round(height / cell) + 1), max(2, round(width / cell) + 1)), dtype=np.float32)
    return np.clip(cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC), 0, 1)


def color(rng: np.random.Generator, low: float = 0.05, high: float = 0.8) -> Float32[Array, "3"]:
    """A random colour, saturated more often than grey."""
    hue, saturation, value = rng.random(), rng.uniform(0.3, 0.95), rng.uniform(low, high)
    rgb = cv2.cvtColor(np.array([[[360 * hue, saturation, value]]], dtype=np.float32), cv2.COLOR_HSV2RGB)
    return rgb[0, 0]


def rich(rng: np.random.Generator, height: int, width: int) -> Float32[Array, "h w 3"]:
    """Blotches on several scales, printed shapes and lettering: a loud package."""
    size = min(height, width)
    picture = np.zeros((height, width, 3), np.float32) + color(rng)
    for cell, strength in ((size / 3, 0.5), (size / 8, 0.4), (size / 24, 0.35)):
        for channel in range(3):
            picture[..., channel] += strength * (noise(rng, height, width, max(cell, 2.0)) - 0.5)
    picture = np.ascontiguousarray(np.clip(picture, 0.02, 0.95))
    for _ in range(10):
        _shape(rng, picture)
    for _ in range(4):
        _word(rng, picture)
    return np.clip(picture, 0.02, 0.9)


def few(rng: np.random.Generator, height: int, width: int, base: Float32[Array, "3"]) -> Float32[Array, "h w 3"]:
    """One colour, and on some patches a small label."""
    picture = plain(rng, height, width, base)
    if rng.random() < 0.6:
        w, h = int(width * rng.uniform(0.2, 0.4)), int(height * rng.uniform(0.15, 0.3))
        x, y = int(rng.integers(0, max(1, width - w))), int(rng.integers(0, max(1, height - h)))
        picture[y : y + h, x : x + w] = color(rng, 0.4, 0.9)
        cv2.putText(
            picture, _letters(rng, 3), (x + 2, y + int(0.75 * h)), cv2.FONT_HERSHEY_SIMPLEX, h / 45, (0.05,) * 3, 2
        )
    return picture


def plain(rng: np.random.Generator, height: int, width: int, base: Float32[Array, "3"]) -> Float32[Array, "h w 3"]:
    """One colour with the faint unevenness that real surfaces have (about 3 %)."""
    uneven = 0.97 + 0.04 * noise(rng, height, width, 40.0) + 0.02 * noise(rng, height, width, 6.0)
    return np.clip(uneven[..., None] * base, 0, 1).astype(np.float32)


def wood(rng: np.random.Generator, height: int, width: int) -> Float32[Array, "h w 3"]:
    """Planks with bent grain."""
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None] * np.ones((1, width), np.float32)
    bend = 0.08 * noise(rng, height, width, width / 5) + 0.015 * noise(rng, height, width, width / 25)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * rng.uniform(28, 40) * (y + bend))
    fibre = cv2.blur(rng.random((height, width), dtype=np.float32), (61, 1))
    fibre = (fibre - fibre.mean()) / fibre.std()
    light, dark = np.array([0.42, 0.22, 0.09], np.float32), np.array([0.2, 0.09, 0.035], np.float32)
    tint = rng.uniform(0.8, 1.3)
    picture = tint * (light * rings[..., None] + dark * (1 - rings[..., None])) * (1 + 0.07 * fibre[..., None])
    planks = 5
    for k in range(1, planks):
        picture[k * height // planks : k * height // planks + 2] *= 0.45
    return np.clip(picture, 0.01, 0.9).astype(np.float32)


def speckled(rng: np.random.Generator, height: int, width: int) -> Float32[Array, "h w 3"]:
    """A laminate with grains of two scales."""
    fine, coarse = noise(rng, height, width, 3.0), noise(rng, height, width, 9.0)
    base = color(rng, 0.25, 0.6) * 0.3 + 0.25
    picture = base * (0.75 + 0.5 * fine[..., None]) + 0.12 * (coarse[..., None] > 0.72)
    return np.clip(picture, 0.02, 0.9).astype(np.float32)


def faint(rng: np.random.Generator, height: int, width: int) -> Float32[Array, "h w 3"]:
    """A nearly plain table top."""
    return plain(rng, height, width, np.full(3, rng.uniform(0.3, 0.6), np.float32)) * (
        0.94 + 0.12 * noise(rng, height, width, 180.0)[..., None]
    )


def marker(tag_id: int) -> Float32[Array, "n n"]:
    """The black square of a tag36h11, upright as pupil-apriltags reports it (OpenCV's is turned by 180 degrees)."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    drawn = cv2.aruco.generateImageMarker(dictionary, tag_id, MARKER_PX, borderBits=1)
    turned = np.ascontiguousarray(drawn[::-1, ::-1])
    return np.where(turned > 127, WHITE, BLACK).astype(np.float32)


def paint_tag(
    picture: Float32[Array, "h w 3"], tag_id: int, center_px: Float[Array, "2"], side_px: float, turned: bool = False
) -> None:
    """Draw a tag and its white border (one module) into a picture, exact to a fraction of a pixel. The tag's x and y
    run along the picture's, or against them where it is `turned`.

    `center_px` and `side_px` (of the black square) are continuous: pixel i covers i..i+1.
    """
    module = MARKER_PX // MARKER_MODULES
    upright = marker(tag_id)
    card = np.pad(upright[::-1, ::-1] if turned else upright, module, constant_values=WHITE)
    scale = side_px / MARKER_PX
    # centre of card pixel i lies at i + 0.5 of the card; the same holds in the picture
    shift = center_px - scale * (len(card) / 2.0) + 0.5 * scale - 0.5
    affine = np.array([[scale, 0.0, shift[0]], [0.0, scale, shift[1]]])
    blurred = card if scale > 0.5 else cv2.GaussianBlur(card, (0, 0), 0.4 / scale)
    height, width = picture.shape[:2]
    drawn = cv2.warpAffine(blurred, affine, (width, height), flags=cv2.INTER_LINEAR, borderValue=-1.0)
    cover = cv2.warpAffine(np.ones_like(card), affine, (width, height), flags=cv2.INTER_LINEAR)[..., None]
    picture[:] = np.where(cover > 0.999, drawn[..., None], picture)


def free_square(inside: Bool[Array, "h w"]) -> tuple[Float[Array, "2"], float]:
    """Centre (continuous pixels) and side of the largest upright square that fits into a region."""
    padded = np.pad(inside.astype(np.uint8), 1)
    reach = cv2.distanceTransform(padded, cv2.DIST_C, 3)[1:-1, 1:-1]
    best = reach.max()
    rows, columns = np.nonzero(reach >= best - 0.5)
    middle = np.argmin(np.hypot(rows - rows.mean(), columns - columns.mean()))
    return np.array([columns[middle] + 0.5, rows[middle] + 0.5]), float(2 * best - 1)


def _shape(rng: np.random.Generator, picture: Float32[Array, "h w 3"]) -> None:
    height, width = picture.shape[:2]
    size = min(height, width)
    at = (int(rng.integers(0, width)), int(rng.integers(0, height)))
    paint = tuple(float(c) for c in color(rng, 0.03, 0.95))
    kind = rng.integers(0, 3)
    if kind == 0:
        cv2.circle(picture, at, int(size * rng.uniform(0.03, 0.14)), paint, -1, cv2.LINE_AA)
    elif kind == 1:
        to = (int(rng.integers(0, width)), int(rng.integers(0, height)))
        cv2.line(picture, at, to, paint, int(1 + size * rng.uniform(0.01, 0.04)), cv2.LINE_AA)
    else:
        corners = np.array(at) + (size * rng.uniform(-0.18, 0.18, (3, 2))).astype(np.int32)
        cv2.fillPoly(picture, [corners.astype(np.int32)], paint, cv2.LINE_AA)


def _word(rng: np.random.Generator, picture: Float32[Array, "h w 3"]) -> None:
    height, width = picture.shape[:2]
    size = min(height, width)
    at = (int(rng.integers(0, max(1, width // 2))), int(rng.integers(height // 5, height)))
    paint = tuple(float(c) for c in (color(rng, 0.02, 0.1) if rng.random() < 0.5 else color(rng, 0.8, 1.0)))
    cv2.putText(picture, _letters(rng, 5), at, cv2.FONT_HERSHEY_DUPLEX, size / 150 * rng.uniform(0.6, 1.2), paint, 2)


def _letters(rng: np.random.Generator, count: int) -> str:
    return "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ0123456789"), count))
