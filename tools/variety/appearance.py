"""Surfaces drawn at random: plain, labelled, patterned, printed, dense; albedo .05 to .9; matt, glossy, lacquered."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray as Array

from acquisition.synthetic.objects.paint import Gloss, PaintedMesh, assemble
from acquisition.synthetic.objects.solids import Solid
from acquisition.synthetic.objects.textures import noise

KINDS = ("plain", "label", "pattern", "printed", "dense")
ALBEDO = (0.05, 0.9)
TEXELS_PER_M, LARGEST_PX = 3000.0, 2000
FONTS = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_TRIPLEX, cv2.FONT_HERSHEY_SCRIPT_COMPLEX)
WORDS = ("NET WT", "FRAGILE", "100 ml", "Torque", "oats", "No. 7", "keep dry", "Lemon", "A-113", "made in", "extra",
         "bolt", "Cocoa", "shake well", "2.4 GHz", "rinse", "recycle", "Nordic", "volt", "tea")  # fmt: skip


@dataclass(frozen=True)
class Finish:
    """How a surface throws light back: Principled BSDF's roughness, coat, metallic; and in infrared the albedo is
    `infrared` times the grey of the colour, drawn towards a half by `infrared_flat` (dyes fade in infrared)."""

    roughness: float = 0.6
    coat: float = 0.0
    metallic: float = 0.0
    infrared: float = 1.0
    infrared_flat: float = 0.3


def draw_finish(rng: np.random.Generator) -> Finish:
    """Matt, satin or glossy; a quarter under a clear coat."""
    roughness = float(rng.choice([rng.uniform(0.5, 0.95), rng.uniform(0.25, 0.5), rng.uniform(0.06, 0.25)]))
    coat = float(rng.uniform(0.4, 1.0)) if rng.random() < 0.25 else 0.0
    return Finish(roughness, coat, 0.0, float(rng.uniform(0.5, 1.3)), float(rng.uniform(0.1, 0.6)))


def paint(solid: Solid, kind: str, rng: np.random.Generator) -> PaintedMesh:
    """Every chart in one manner, one ground colour."""
    area = sum((c.width_m + 0.004) * (c.height_m + 0.004) for c in solid.charts)
    scale = min(TEXELS_PER_M, 0.8 * LARGEST_PX / float(np.sqrt(area)))
    ground = draw_color(rng, float(np.exp(rng.uniform(*np.log(ALBEDO)))))
    pictures = []
    for chart in solid.charts:
        shape = max(2, int(np.ceil(chart.height_m * scale))), max(2, int(np.ceil(chart.width_m * scale)))
        pictures.append(np.clip(PAINTERS[kind](rng, shape, ground), 0.02, 0.92).astype(np.float32))
    return assemble(solid, pictures, scale, Gloss())


def draw_color(rng: np.random.Generator, value: float) -> Float32[Array, "3"]:
    """Of the given largest channel; as often greyish as colourful."""
    hsv = np.array([[[rng.uniform(0, 360), rng.beta(1.0, 1.3), value]]], np.float32)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0]


def plain(rng: np.random.Generator, shape: tuple[int, int], ground: Array) -> Array:
    """One colour, uneven by one or two per cent."""
    uneven = 1 + 0.015 * (noise(rng, *shape, 60.0) - 0.5) + 0.01 * (noise(rng, *shape, 5.0) - 0.5)
    return uneven[..., None] * ground


def label(rng: np.random.Generator, shape: tuple[int, int], ground: Array) -> Array:
    """Plain, with a printed label on two of three charts."""
    picture = np.ascontiguousarray(plain(rng, shape, ground), np.float32)
    if rng.random() < 0.66 and min(shape) > 40:
        h, w = (int(n * rng.uniform(0.35, 0.8)) for n in shape)
        y, x = int(rng.integers(0, shape[0] - h + 1)), int(rng.integers(0, shape[1] - w + 1))
        part = printed(rng, (h, w), draw_color(rng, rng.uniform(0.2, 0.9)))
        picture[y : y + h, x : x + w] = part
    return picture


def pattern(rng: np.random.Generator, shape: tuple[int, int], ground: Array) -> Array:
    """Stripes, checks or dots that repeat: one part of the surface looks like the next."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    turn, pitch = rng.uniform(0, np.pi), rng.uniform(14, 60)
    u, v = x * np.cos(turn) + y * np.sin(turn), y * np.cos(turn) - x * np.sin(turn)
    kind = rng.integers(0, 3)
    if kind == 0:
        on = np.sin(2 * np.pi * u / pitch) > rng.uniform(-0.5, 0.5)
    elif kind == 1:
        on = (np.sin(2 * np.pi * u / pitch) > 0) ^ (np.sin(2 * np.pi * v / pitch) > 0)
    else:
        on = np.hypot((u % pitch) - pitch / 2, (v % pitch) - pitch / 2) < pitch * rng.uniform(0.2, 0.4)
    soft = cv2.GaussianBlur(on.astype(np.float32), (0, 0), 0.7)[..., None]
    return plain(rng, shape, ground) * (1 - soft) + soft * draw_color(rng, float(rng.uniform(0.05, 0.9)))


def printed(rng: np.random.Generator, shape: tuple[int, int], ground: Array) -> Array:
    """A package: fields of colour, lines of text, a few shapes, much of the ground left free."""
    picture = np.ascontiguousarray(plain(rng, shape, ground), np.float32)
    size = min(shape)
    for _ in range(int(rng.integers(1, 4))):
        y, x = int(rng.integers(0, shape[0])), int(rng.integers(0, shape[1]))
        corner = x + int(size * rng.uniform(0.2, 0.9)), y + int(size * rng.uniform(0.1, 0.4))
        cv2.rectangle(picture, (x, y), corner, _paint(rng), -1)
    for _ in range(int(rng.integers(2, 7))):
        write(rng, picture)
    for _ in range(int(rng.integers(0, 4))):
        at = int(rng.integers(0, shape[1])), int(rng.integers(0, shape[0]))
        axes = int(size * rng.uniform(0.03, 0.2)) + 1, int(size * rng.uniform(0.03, 0.2)) + 1
        cv2.ellipse(picture, at, axes, float(rng.uniform(0, 180)), 0, 360, _paint(rng), -1, cv2.LINE_AA)
    return picture


def dense(rng: np.random.Generator, shape: tuple[int, int], ground: Array) -> Array:
    """Photograph-like: every scale, everywhere."""
    picture = np.zeros((*shape, 3), np.float32) + ground
    for cell in (90.0, 35.0, 14.0, 6.0):
        for channel in range(3):
            picture[..., channel] += 0.45 * (noise(rng, *shape, cell) - 0.5)
    return picture


def write(rng: np.random.Generator, picture: Array) -> None:
    """A word somewhere, at any size that fits, in any of four fonts, level or upright."""
    height, width = picture.shape[:2]
    word, font = str(rng.choice(WORDS)), int(rng.choice(FONTS))
    scale = float(rng.uniform(0.02, 0.16)) * min(height, width) / 22
    at = int(rng.integers(-width // 8, max(1, width * 3 // 4))), int(rng.integers(height // 10, height + 1))
    cv2.putText(picture, word, at, font, scale, _paint(rng), max(1, round(1.4 * scale)), cv2.LINE_AA)


def _paint(rng: np.random.Generator) -> tuple[float, ...]:
    return tuple(float(c) for c in draw_color(rng, float(rng.uniform(0.03, 0.95))))


PAINTERS = {"plain": plain, "label": label, "pattern": pattern, "printed": printed, "dense": dense}
