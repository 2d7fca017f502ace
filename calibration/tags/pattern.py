"""Sub-pixel corners of a tag from its whole pattern, not from its outline alone: for calibration, where hundredths of a
pixel count and the board stands still.

The image of a tag with pattern T (0 dark, 1 light) under the homography M = tag_from_image is modelled as

    I(x) = dark + (light - dark) ((T + e |dT|) * G)(M x),

with G a Gaussian as wide in the image as lens, pixel and defocus make it, e by how far light spills over dark edges (in
pixels), dark and light each linear across the tag. All of it is fitted to the pixels by Gauss-Newton. Edges inside the
pattern tell the spill from the tag's size, which its outline cannot, and they are longer than it; and where cells are
hardly two pixels wide, a fit of the outline is drawn inwards or outwards by the cells beside it, this one is not.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array
from scipy import fft

from recordings.constants import MAD_TO_SIGMA
from recordings.estimation.robust import huber_weight

DICTIONARIES = {
    "tag36h11": (cv2.aruco.DICT_APRILTAG_36H11, 8),
    "tag25h9": (cv2.aruco.DICT_APRILTAG_25H9, 7),
    "tag16h5": (cv2.aruco.DICT_APRILTAG_16H5, 6),
}
"""OpenCV's name and the side in cells of the families whose patterns are known (OpenCV has them turned by half)."""
MARGIN = 2
"""Cells of paper drawn round a tag; of them `LOOK` are looked at."""
LOOK = 0.9
TEXELS = (8, 16, 32)
TEXELS_PER_PX = 2.0
MOST_PIXELS = 8000
"""Of a larger tag every second, third, ... is looked at (OpenCV's remap takes no more than 32767 at a time)."""
STEPS = 6
START_VARIANCE_PX2 = 0.35
LEAST_VARIANCE_PX2, LARGEST_VARIANCE_PX2 = 0.05, 9.0
WIDEST_BLUR = 0.8
"""A blur wider than this share of a cell leaves nothing of the pattern."""
SAME_BLUR = 0.1
"""A pattern drawn with a variance this near (relatively) is not drawn anew: its derivative by the blur does."""
LARGEST_SPILL_PX = 1.0
LARGEST_SHIFT_PX = 0.6
"""A corner that moves further from where the outline has it was not found (or a third of a cell)."""
LEAST_CONTRAST = 8.0
WORST_RESIDUAL = 0.15
"""Of the contrast: what does not look like the pattern is hidden or bent."""
SATURATED = 254.5
FLOOR_PX = 0.03
"""No corner is known better than this: what a lens, a print and a JPEG do besides noise."""
HUBER = 3.0


def refine_by_pattern(
    image: Float32[Array, "h w"], corners_px: Float[Array, "n 4 2"], tag_ids: list[int], family: str
) -> tuple[Float[Array, "n 4 2"], Float[Array, "n 4 2 2"], Bool[Array, " n"]]:
    """Corners of n tags (order as TagDetection) with covariances in px^2, and which of them could be fitted; the others
    come back as they were, with NaN covariance. `image` in linear light."""
    out, covariance = corners_px.copy(), np.full((len(corners_px), 4, 2, 2), np.nan)
    fitted = np.zeros(len(corners_px), dtype=bool)
    if family not in DICTIONARIES:
        return out, covariance, fitted
    for k, (corners, tag_id) in enumerate(zip(corners_px, tag_ids)):
        found = _fit(image, corners, tag_id, family)
        if found is not None:
            out[k], covariance[k] = found
            fitted[k] = True
    return out, covariance, fitted


@dataclass(frozen=True, eq=False)
class _Pattern:
    """A tag drawn with `texels` per cell, as spectra: itself and the lengths of its upright and level edges."""

    cells: int
    texels: int
    spectra: tuple[Array, Array, Array]

    @property
    def size(self) -> int:
        return (self.cells + 2 * MARGIN) * self.texels

    @cached_property
    def frequencies(self) -> tuple[Float[Array, "1 f"], Float[Array, "g 1"]]:
        """Radians per cell, across and down."""
        turn = 2 * np.pi * self.texels
        return turn * np.fft.rfftfreq(self.size)[None], turn * np.fft.fftfreq(self.size)[:, None]

    @property
    def corners(self) -> Float[Array, "4 2"]:
        """In cells from the upper left corner, in the order of TagDetection."""
        return float(self.cells) * np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])

    def maps(self, cells_from_px: Float[Array, "2 2"], variance_px2: float) -> list[Float32[Array, "s s"]]:
        """Blurred by a Gaussian of this variance in the image: the pattern, its derivatives across and down (per cell),
        by the variance, and by the spill (per pixel)."""
        across, down = self.frequencies
        S = cells_from_px @ cells_from_px.T
        power = 0.5 * (S[0, 0] * across**2 + 2 * S[0, 1] * across * down + S[1, 1] * down**2)
        blur = np.exp(-power * variance_px2)
        pattern, upright, level = self.spectra
        blurred = pattern * blur
        reach = np.linalg.norm(cells_from_px, axis=1)
        wanted = [blurred, 1j * across * blurred, 1j * down * blurred, -power * blurred]
        wanted.append((reach[0] * upright + reach[1] * level) * blur)
        return [fft.irfft2(s.astype(np.complex64), (self.size, self.size)) for s in wanted]

    def sampled(self, maps: list[Float32[Array, "s s"]], places: Float[Array, "n 2"]) -> Float[Array, "m n"]:
        """The maps at places in cells."""
        at = ((places + MARGIN) * self.texels - 0.5).astype(np.float32)
        u, v = np.ascontiguousarray(at[:, :1]), np.ascontiguousarray(at[:, 1:])
        return np.array([cv2.remap(m, u, v, cv2.INTER_LINEAR).ravel() for m in maps], dtype=np.float64)


@lru_cache(maxsize=32)
def _pattern(family: str, tag_id: int, texels: int) -> _Pattern | None:
    number, cells = DICTIONARIES[family]
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    if not 0 <= tag_id < len(dictionary.bytesList):
        return None
    bits = np.rot90(cv2.aruco.generateImageMarker(dictionary, tag_id, cells) > 127, 2).astype(np.float64)
    drawn = np.kron(np.pad(bits, MARGIN, constant_values=1.0), np.ones((texels, texels)))
    upright, level = (np.fft.rfft2(_edges(drawn, texels, axis)) for axis in (1, 0))
    return _Pattern(cells, texels, (np.fft.rfft2(drawn), upright, level))


def _edges(drawn: Float[Array, "s s"], texels: int, axis: int) -> Float[Array, "s s"]:
    """Where the pattern changes along an axis, as a density per cell, spread evenly over both sides."""
    steps = np.abs(np.diff(drawn, axis=axis)) * texels / 2
    before, after = ((0, 1), (1, 0))
    widths = [[(0, 0), before], [(0, 0), after]] if axis == 1 else [[before, (0, 0)], [after, (0, 0)]]
    return np.pad(steps, widths[0]) + np.pad(steps, widths[1])


@dataclass(eq=False)
class _State:
    """What is fitted: homography to cells, blur, spill, dark and light (each 1, across, down)."""

    cells_from_px: Float[Array, "3 3"]
    variance_px2: float
    spill_px: float
    light: Float[Array, "6"] | None = None
    maps: list[Float32[Array, "s s"]] = field(default_factory=list)
    drawn_with_px2: float = np.nan


def _fit(
    image: Float32[Array, "h w"], corners_px: Float[Array, "4 2"], tag_id: int, family: str
) -> tuple[Float[Array, "4 2"], Float[Array, "4 2 2"]] | None:
    """Corners and covariances; None where the pattern is not what is seen."""
    cells = DICTIONARIES[family][1]
    cell_px = float(np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=0), axis=1).max()) / cells
    texels = next((t for t in TEXELS if t >= TEXELS_PER_PX * cell_px), TEXELS[-1])
    pattern = _pattern(family, tag_id, texels)
    if pattern is None:
        return None
    start = cv2.getPerspectiveTransform(corners_px.astype(np.float32), pattern.corners.astype(np.float32))
    state = _State(start, START_VARIANCE_PX2, 0.0)
    pixels, values = _around(image, corners_px, state.cells_from_px, cells)
    if len(values) < cells**2:
        return None
    try:
        for step in range(STEPS):
            normal, residual, weight, contrast = _step(pattern, state, pixels, values, robust=step > 1)
        found = _corners(pattern, state)
        covariance = _covariance(pattern, state, normal, residual, weight)
    except np.linalg.LinAlgError:
        return None
    far = max(LARGEST_SHIFT_PX, 0.33 * cell_px)
    fine = (
        np.isfinite(found).all()
        and np.isfinite(covariance).all()
        and np.abs(found - corners_px).max() < far
        and contrast > LEAST_CONTRAST
        and np.sqrt((weight * residual**2).mean()) < WORST_RESIDUAL * contrast
        and np.sqrt(state.variance_px2) < WIDEST_BLUR * cell_px
    )
    return (found, covariance) if fine else None


def _around(
    image: Float32[Array, "h w"], corners_px: Float[Array, "4 2"], cells_from_px: Float[Array, "3 3"], cells: int
) -> tuple[Float[Array, "n 2"], Float[Array, " n"]]:
    """The pixels on a tag and a little round it."""
    spread = 1 + 2 * (LOOK + 1) / cells
    box = corners_px.mean(axis=0) + spread * (corners_px - corners_px.mean(axis=0))
    low = np.maximum(np.floor(box.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(box.max(axis=0)).astype(int) + 1, image.shape[::-1])
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    places = _moved(cells_from_px, np.stack([x.ravel(), y.ravel()], -1).astype(np.float64))
    inside = ((places > -LOOK) & (places < cells + LOOK)).all(axis=1)
    every = max(1, int(np.ceil(inside.sum() / MOST_PIXELS)))
    u, v = x.ravel()[inside][::every], y.ravel()[inside][::every]
    return np.stack([u, v], -1).astype(np.float64), image[v, u].astype(np.float64)


def _step(
    pattern: _Pattern, state: _State, pixels: Float[Array, "n 2"], values: Float[Array, " n"], robust: bool
) -> tuple[Float[Array, "16 16"], Float[Array, " n"], Float[Array, " n"], float]:
    """One step of Gauss-Newton, in place; the normal matrix, residuals, weights and contrast before it."""
    half = pattern.cells / 2
    places = _moved(state.cells_from_px, pixels)
    if not abs(state.variance_px2 / state.drawn_with_px2 - 1) < SAME_BLUR:
        local = _local(state.cells_from_px, _corners(pattern, state).mean(axis=0))
        state.maps, state.drawn_with_px2 = pattern.maps(local, state.variance_px2), state.variance_px2
    B, across, down, wider, spilled = pattern.sampled(state.maps, places)
    B = B + (state.variance_px2 - state.drawn_with_px2) * wider
    B = B + state.spill_px * spilled
    u, v = ((places - half) / half).T
    ramp = np.stack([np.ones_like(u), u, v], 1)
    light = np.hstack([ramp * (1 - B)[:, None], ramp * B[:, None]])
    if state.light is None:
        state.light = np.linalg.lstsq(light, values, rcond=None)[0]
    contrast = ramp @ (state.light[3:] - state.light[:3])
    residual = light @ state.light - values
    a, d = half * contrast * across, half * contrast * down
    moves = [a * u, a * v, a, d * u, d * v, d, -(a * u * u + d * u * v), -(a * u * v + d * v * v)]
    jacobian = np.hstack([np.stack([*moves, contrast * wider, contrast * spilled], 1), light])
    usual = MAD_TO_SIGMA * float(np.median(np.abs(residual))) + 1e-6
    weight = huber_weight(np.abs(residual), HUBER * usual) if robust else np.ones(len(u))
    weight = np.where((values >= SATURATED) & (residual > 0), 0.0, weight)
    weighted = jacobian * weight[:, None]
    normal = weighted.T @ jacobian
    step = np.linalg.solve(normal + 1e-9 * np.diag(np.diag(normal)), -weighted.T @ residual)
    _move(state, step, half)
    return normal, residual, weight, float(np.abs(contrast.mean()))


def _move(state: _State, step: Float[Array, "16"], half: float) -> None:
    centred = np.array([[1 / half, 0, -1], [0, 1 / half, -1], [0, 0, 1]])
    change = np.eye(3) + np.append(step[:8], 0.0).reshape(3, 3)
    state.cells_from_px = np.linalg.inv(centred) @ change @ centred @ state.cells_from_px
    bounded = float(np.clip(step[8], -0.5 * state.variance_px2, state.variance_px2))
    state.variance_px2 = float(np.clip(state.variance_px2 + bounded, LEAST_VARIANCE_PX2, LARGEST_VARIANCE_PX2))
    state.spill_px = float(np.clip(state.spill_px + step[9], -LARGEST_SPILL_PX, LARGEST_SPILL_PX))
    assert state.light is not None
    state.light = state.light + step[10:]


def _covariance(
    pattern: _Pattern,
    state: _State,
    normal: Float[Array, "16 16"],
    residual: Float[Array, " n"],
    weight: Float[Array, " n"],
) -> Float[Array, "4 2 2"]:
    """Of the corners: a step s of the homography in cells moves a corner c by -d px/d cells (s c)."""
    spread = np.linalg.inv(normal)[:8, :8] * float((weight * residual**2).sum() / max(1.0, weight.sum() - 16))
    half = pattern.cells / 2
    px_from_cells = np.linalg.inv(state.cells_from_px)
    out = np.empty((4, 2, 2))
    for k, corner in enumerate(pattern.corners):
        u, v = (corner - half) / half
        by_step = -half * np.array([[u, v, 1, 0, 0, 0, -u * u, -u * v], [0, 0, 0, u, v, 1, -u * v, -v * v]])
        by_step = _local(px_from_cells, corner) @ by_step
        out[k] = by_step @ spread @ by_step.T + FLOOR_PX**2 * np.eye(2)
    return out


def _corners(pattern: _Pattern, state: _State) -> Float[Array, "4 2"]:
    return _moved(np.linalg.inv(state.cells_from_px), pattern.corners)


def _moved(H: Float[Array, "3 3"], points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    out = points @ H[:, :2].T + H[:, 2]
    return out[:, :2] / out[:, 2:]


def _local(H: Float[Array, "3 3"], point: Float[Array, "2"]) -> Float[Array, "2 2"]:
    """The homography's derivative at a point."""
    x, y, w = H[:, :2] @ point + H[:, 2]
    return (H[:2, :2] - np.outer([x / w, y / w], H[2, :2])) / w
