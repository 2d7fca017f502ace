"""How well a shape at its poses explains the raw images: the residuals by which passes are compared without truth.

A reprojected depth agrees with the poses it was drawn from by making, so only what the camera measured counts: raw
depth inside the first masks, the outline of those masks, and the picture's own colours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray as Array
from scipy.special import stdtrit

from processing.sensor.noise import DARK
from processing.sensor.render import RaycastRenderer
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame
from recordings.results.stage_files import stage_arrays
from recordings.tracks import ObjectShape, ObjectTrack

HIDDEN_M = 0.015
"""What the camera measured this much nearer than the shape stands in front of it."""
FAR_M = 0.02
"""Residuals beyond this are one and the same: not explained."""
SLACK_M = 5e-5
"""A mean depth residual larger by less than this is not called worse: depth cameras err by twenty times as much, and
the poses were fitted to one of the two shapes."""
CHANCE = 0.05
"""Nor is one that chance alone makes this often."""


@dataclass(frozen=True)
class JudgeConfig:
    every: int = 4
    """Every which frame of a toss is looked at."""
    border_px: int = 2
    """Pixels this near the mask's outline mix object and background: no depth or colour residuals from there."""


@dataclass(frozen=True)
class MeanResiduals:
    """Means over the frames looked at (`frames`): absolute depth residual (m), 1 - IoU of the outline, colour residual
    (grey levels of 255, after each frame's own light; NaN without colours). `lost`: frames without a pose."""

    depth_m: float
    mask: float
    color: float
    frames: int
    lost: int

    def to_json(self) -> dict[str, float | int | None]:
        return {k: (v if np.isfinite(v) else None) for k, v in asdict(self).items()}


@dataclass(frozen=True, eq=False)
class Explained:
    """Residuals of single frames by position: rows (toss, position, depth_m, mask, color, chroma)."""

    rows: Float[Array, "n 6"]
    lost: int

    def means(self) -> MeanResiduals:
        if len(self.rows) == 0:
            return MeanResiduals(float("nan"), float("nan"), float("nan"), 0, self.lost)
        with np.errstate(all="ignore"):
            color = self.rows[:, 4][np.isfinite(self.rows[:, 4])]
        depth_m, mask = self.rows[:, 2].mean(), self.rows[:, 3].mean()
        return MeanResiduals(
            float(depth_m), float(mask), float(color.mean()) if len(color) else float("nan"), len(self.rows), self.lost
        )


@dataclass(frozen=True)
class Difference:
    """Mean of the differences of residuals in the same frames (of depth: m; positive: the second is worse), its
    standard error, the frames, and how many independent ones they are worth."""

    mean: float
    error: float
    frames: int
    independent: float

    @property
    def by_chance(self) -> float:
        """What chance alone makes of it at most (one side of a t-test)."""
        return float(stdtrit(max(self.independent - 1, 1.0), 1 - CHANCE)) * self.error if self.frames > 1 else 0.0

    @property
    def worse(self) -> bool:
        """Whether the second explains raw depth worse: by more than SLACK_M, and by more than chance makes it."""
        return self.mean > max(SLACK_M, self.by_chance)

    def __str__(self) -> str:
        return f"{1e3 * self.mean:+.3f} mm, standard error {1e3 * self.error:.3f} mm, {self.frames} frames"


def depth_of(row: Float[Array, "6"]) -> float:
    """Of a frame's residuals that of depth (m)."""
    return float(row[2])


def difference(
    first: Explained, second: Explained, value: Callable[[Float[Array, "6"]], float] = depth_of
) -> Difference:
    """Residuals (a `value` of each frame's row) of two shapes or poses compared frame by frame: what is hard to see in
    a frame (its noise, its outline) is in both, and cancels.

    Neighbouring frames see the same faces: with r their correlation, n of them are worth n (1 - r) / (1 + r).
    """
    a, b = ({(int(r[0]), int(r[1])): value(r) for r in rows} for rows in (first.rows, second.rows))
    both = [place for place in a if place in b and np.isfinite(a[place] + b[place])]
    if not both:
        return Difference(float("nan"), float("nan"), 0, 0.0)
    gaps, toss = np.array([b[p] - a[p] for p in both]), np.array([p[0] for p in both])
    n, off = len(gaps), gaps - gaps.mean()
    if n < 2 or not off.any():
        return Difference(float(gaps.mean()), 0.0, n, float(n))
    alike = float((off[:-1] * off[1:])[toss[:-1] == toss[1:]].sum() / (off**2).sum())
    r = min(max(alike, 0.0), 0.95)
    worth = n * (1 - r) / (1 + r)
    return Difference(float(gaps.mean()), float(gaps.std(ddof=1) / np.sqrt(worth)), n, worth)


ALIKE = 0.1
"""Standard deviation by which the logarithms of residuals differ where nothing does: over a plain box's four ways of
lying (choose-000) .04 of chromaticity, .14 of depth with outline; more frames do not average that out."""
ROWS = "residuals.npz"


def read_rows(folder: Path) -> Float[Array, "n 6"]:
    """Residuals by frame (`Explained.rows`) as the stage `judge` keeps them in its folder."""
    with stage_arrays(folder / ROWS) as stored:
        return np.asarray(stored["rows"])


def explain(
    shape: ObjectShape,
    track: ObjectTrack,
    frames: Sequence[RgbdFrame],
    masks: Sequence[Bool[Array, "h w"]],
    camera: CameraModel,
    config: JudgeConfig,
) -> Explained:
    """Residuals of a shape at a track's poses in one toss. A frame without a pose counts as lost, not as good."""
    import cv2

    drawer = ShapeDrawer(shape, camera)
    rows, lost = [], 0
    kernel = np.ones((2 * config.border_px + 1,) * 2, np.uint8)
    for i in range(0, len(track.status), config.every):
        pose = track.camera_from_object[i]
        mask = np.asarray(masks[i], dtype=bool)
        if not np.isfinite(pose).all() or not mask.any():
            lost += int(mask.any())
            continue
        frame = frames[i]
        drawn = drawer.draw(pose)
        depth_m, seen = drawn.depth_m, drawn.depth_m > 0
        hidden = seen & ~mask & (frame.depth_m > 0) & (frame.depth_m < depth_m - HIDDEN_M)  # a hand stands before it
        union = float(((seen & ~hidden) | mask).sum())
        inside = cv2.erode(mask.astype(np.uint8), kernel).astype(bool)
        measured = inside & (frame.depth_m > 0)
        gap = np.where(seen, np.abs(frame.depth_m - depth_m), FAR_M)[measured]
        depth = float(np.minimum(gap, FAR_M).mean()) if len(gap) else float("nan")
        if not np.isfinite(depth):
            continue
        both = inside & seen
        colors = _color(frame, drawn, both), _chroma(frame, drawn, both)
        rows.append((track.toss, i, depth, 1 - float((seen & mask).sum()) / union, *colors))
    return Explained(np.array(rows, dtype=np.float64).reshape(-1, 6), lost)


def pooled(parts: Sequence[Explained]) -> Explained:
    """Several tosses as one."""
    return Explained(np.concatenate([p.rows for p in parts]), sum(p.lost for p in parts))


def _color(frame: RgbdFrame, drawn: Drawn, both: Bool[Array, "h w"]) -> float:
    """Median absolute difference of grey, after the light that fits the frame best.

    Faces are lit by where they point to (Lambert, and light from everywhere): grey = albedo * (a + b . n) + c.
    """
    if drawn.rgb is None or both.sum() < LEAST_COLORED:
        return float("nan")
    albedo = drawn.rgb[both].astype(np.float64).mean(-1)
    taken = frame.color_rgb[both].astype(np.float64).mean(-1)
    terms = np.column_stack([albedo, albedo[:, None] * drawn.normal[both], np.ones(len(albedo))])
    light, *_ = np.linalg.lstsq(terms, taken, rcond=LIGHT_RCOND)
    return float(np.median(np.abs(taken - terms @ light)))


def _chroma(frame: RgbdFrame, drawn: Drawn, both: Bool[Array, "h w"]) -> float:
    """Mean absolute difference of chromaticity, which shading leaves as it is, but for the frame's own tint."""
    if drawn.rgb is None or both.sum() < LEAST_COLORED:
        return float("nan")
    albedo, taken = (chromaticity(rgb[both]) for rgb in (drawn.rgb, frame.color_rgb))
    gap = taken - albedo
    return float(np.abs(gap - np.median(gap, axis=0)).mean())


def chromaticity(rgb: UInt8[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Channels over brightness (no unit, 1 is grey); what is darker than `DARK` has less and less of it."""
    values = rgb.astype(np.float64)
    return values / (values.mean(-1, keepdims=True) + DARK)


LEAST_COLORED = 50
"""Pixels without which a frame's light or tint is not solved for."""
LIGHT_RCOND = 1e-3
"""Of the light's terms: with one face in view, what its direction adds cannot be told from what all light adds."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A shape drawn at a pose: depth (m, 0 outside), colours (None for a shape without any), normals (object frame)."""

    depth_m: Float32[Array, "h w"]
    rgb: UInt8[Array, "h w 3"] | None
    normal: Float32[Array, "h w 3"]


class ShapeDrawer:
    """Depth, colours and normals of a shape at a pose, through the lens as it is."""

    def __init__(self, shape: ObjectShape, camera: CameraModel) -> None:
        self._renderer, self._camera = RaycastRenderer(shape, camera), camera
        self._rgb = None if shape.vertex_rgb is None else shape.vertex_rgb.astype(np.float32)
        self._faces = shape.faces
        a, b, c = np.moveaxis(shape.vertices_m[shape.faces], 1, 0)
        across = np.cross(b - a, c - a)
        self._normals = (across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)).astype(np.float32)

    def draw(self, camera_from_object: Float[Array, "4 4"]) -> Drawn:
        """The shape at a pose."""
        hits, size = self._renderer.hits(camera_from_object), (self._camera.height, self._camera.width)
        seen = hits.depth_m > 0
        met = hits.face[seen]
        depth_m, normal = np.zeros(size, dtype=np.float32), np.zeros((*size, 3), dtype=np.float32)
        depth_m[hits.box] = hits.depth_m
        normal[hits.box][seen] = self._normals[met]
        if self._rgb is None:
            return Drawn(depth_m, None, normal)
        rgb = np.zeros((*size, 3), dtype=np.uint8)
        corners = self._rgb[self._faces[met]]
        rgb[hits.box][seen] = np.clip((corners * hits.weight[seen][..., None]).sum(1), 0, 255).astype(np.uint8)
        return Drawn(depth_m, rgb, normal)
