"""Sub-pixel corners of a dark square on light ground: its four edges are fitted as lines, also where they are blurred.

Each edge is a blurred step in the image,

    I(d) = dark + (light - dark) Phi((d - a - b s) / width),

with d the distance outwards across the edge, s in [-1, 1] the place along it and Phi the normal distribution. Seven
numbers per edge (a, b, width, and dark and light each linear in s) are fitted to the pixels around it by Gauss-Newton.
A symmetric blur (lens, pixel, motion during an exposure) widens the step and leaves its middle, so the corners belong
to the middle of the exposure. What the fit leaves over gives the covariance of the lines, and they that of the corners.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

ALONG = 28
ACROSS = 13
STEPS = 8
NEAREST_TO_CORNER = 0.1
"""Share of the edge left out at either end: there the neighbouring edge is in the picture."""
SMALLEST_REACH_PX, LARGEST_REACH_PX = 1.5, 7.0
LARGEST_SHIFT = 0.8
"""An edge that moves by more than this share of the reach was not found."""
LEAST_CONTRAST = 4.0
WIDEST_STEP = 0.5
"""A step wider than this share of the reach runs into the pattern's next one: the fit would be drawn to it."""
FLOOR_PX = 0.07
"""No corner is known better than this: what a lens, a print and a JPEG do besides noise."""


def refine_corners(
    image: Float32[Array, "h w"], corners_px: Float[Array, "n 4 2"], cells: int
) -> tuple[Float[Array, "n 4 2"], Float[Array, "n 4 2 2"], Bool[Array, " n"]]:
    """Corners of n squares by fitting their edges, with 2x2 covariances in px^2, and which squares could be fitted.

    `corners_px` in order round the square, OpenCV's pixels; `cells`: the square's side in cells of its pattern (the
    outermost ring of cells is dark, so the fit looks less than one cell inwards). Squares that could not be fitted come
    back as they were, with NaN covariance.
    """
    n = len(corners_px)
    if n == 0:
        return corners_px, np.zeros((0, 4, 2, 2)), np.zeros(0, dtype=bool)
    edges = _Edges.around(corners_px, cells)
    fit, information, fine = _fit(edges, image)
    moved, covariance = _intersect(edges, fit, information)
    fitted = fine.reshape(n, 4).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2, 3))
    out = np.where(fitted[:, None, None], moved, corners_px)
    return out, np.where(fitted[:, None, None, None], covariance, np.nan), fitted


class _Edges:
    """The 4 n edges of n squares: midpoints, unit directions, outward normals, half lengths, reach of the search."""

    def __init__(self, midpoint: Array, along: Array, outward: Array, half: Array, reach: Array) -> None:
        self.midpoint, self.along, self.outward, self.half, self.reach = midpoint, along, outward, half, reach

    @staticmethod
    def around(corners_px: Float[Array, "n 4 2"], cells: int) -> _Edges:
        start, end = corners_px.reshape(-1, 2), np.roll(corners_px, -1, axis=1).reshape(-1, 2)
        midpoint, run = (start + end) / 2, end - start
        half = np.linalg.norm(run, axis=1) / 2
        along = run / (2 * half[:, None])
        outward = np.stack([along[:, 1], -along[:, 0]], -1)
        center = np.repeat(corners_px.mean(axis=1), 4, axis=0)
        outward *= np.sign(np.einsum("ij,ij->i", outward, midpoint - center))[:, None]
        width = np.abs(np.einsum("ij,ij->i", outward, midpoint - center)) * 2
        reach = np.clip(0.7 * width / cells, SMALLEST_REACH_PX, LARGEST_REACH_PX)
        return _Edges(midpoint, along, outward, half, reach)


def _fit(
    edges: _Edges, image: Float32[Array, "h w"]
) -> tuple[Float[Array, "e 7"], Float[Array, "e 7 7"], Bool[Array, " e"]]:
    """Gauss-Newton over all edges at once: (a, b, log width, dark 0, dark 1, light 0, light 1) and its information."""
    s = np.linspace(-1 + 2 * NEAREST_TO_CORNER, 1 - 2 * NEAREST_TO_CORNER, ALONG)
    d = edges.reach[:, None] * np.linspace(-1, 1, ACROSS)
    seen = _sampled(image, edges, s, d)
    fit = _start(seen, edges.reach)
    for _ in range(STEPS):
        residual, jacobian = _model(fit, s, d, seen)
        normal = np.einsum("enk,enl->ekl", jacobian, jacobian)
        damped = normal + 1e-6 * np.einsum("ekk->ek", normal)[:, :, None] * np.eye(7) + 1e-9 * np.eye(7)
        step = np.linalg.solve(damped, -np.einsum("enk,en->ek", jacobian, residual)[..., None])[..., 0]
        step[:, :2] = np.clip(step[:, :2], -1.0, 1.0)
        step[:, 2] = np.clip(step[:, 2], -0.7, 0.7)
        fit = fit + step
        fit[:, 2] = np.clip(fit[:, 2], np.log(0.25), np.log(edges.reach))
    residual, jacobian = _model(fit, s, d, seen)
    # samples closer than a pixel repeat the same noise: count pixels, not samples
    pixels = 2 * edges.half * (1 - 2 * NEAREST_TO_CORNER) * 2 * edges.reach
    variance = np.maximum((residual**2).mean(axis=1), 0.3**2)
    weight = np.minimum(pixels / (ALONG * ACROSS), 1.0) / variance
    information = weight[:, None, None] * np.einsum("enk,enl->ekl", jacobian, jacobian)
    contrast = np.abs(fit[:, 5] - fit[:, 3])
    fine = (
        (np.abs(fit[:, 0]) + np.abs(fit[:, 1]) < LARGEST_SHIFT * edges.reach)
        & (contrast > LEAST_CONTRAST)
        & (np.exp(fit[:, 2]) < WIDEST_STEP * edges.reach)
        & (np.sqrt(variance) < 0.25 * contrast)
    )
    return fit, information, fine


def _sampled(
    image: Float32[Array, "h w"], edges: _Edges, s: Float[Array, " a"], d: Float[Array, "e c"]
) -> Float[Array, "e a c"]:
    places = (
        edges.midpoint[:, None, None]
        + (edges.half[:, None] * s)[:, :, None, None] * edges.along[:, None, None]
        + d[:, None, :, None] * edges.outward[:, None, None]
    ).astype(np.float32)
    flat = places.reshape(len(d), -1, 2)
    out = cv2.remap(
        image,
        np.ascontiguousarray(flat[..., 0]),
        np.ascontiguousarray(flat[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return out.reshape(len(d), len(s), d.shape[1]).astype(np.float64)


def _start(seen: Float[Array, "e a c"], reach: Float[Array, " e"]) -> Float[Array, "e 7"]:
    fit = np.zeros((len(seen), 7))
    fit[:, 2] = np.log(0.3 * reach)
    fit[:, 3] = seen[:, :, :2].mean(axis=(1, 2))
    fit[:, 5] = seen[:, :, -2:].mean(axis=(1, 2))
    return fit


def _model(
    fit: Float[Array, "e 7"], s: Float[Array, " a"], d: Float[Array, "e c"], seen: Float[Array, "e a c"]
) -> tuple[Float[Array, "e n"], Float[Array, "e n 7"]]:
    """Residual (model - seen) and its derivatives by the seven numbers, at every sample."""
    from scipy.special import ndtr

    a, b, log_width, dark0, dark1, light0, light1 = (fit[:, k, None, None] for k in range(7))
    along = s[None, :, None]
    width = np.exp(log_width)
    u = (d[:, None, :] - a - b * along) / width
    share = ndtr(u)
    dark, light = dark0 + dark1 * along, light0 + light1 * along
    slope = (light - dark) * np.exp(-0.5 * u * u) / np.sqrt(2 * np.pi)
    parts = [-slope / width, -slope / width * along, -slope * u, 1 - share, (1 - share) * along, share, share * along]
    jacobian = np.stack([np.broadcast_to(p, seen.shape) for p in parts], -1)
    residual = dark + (light - dark) * share - seen
    return residual.reshape(len(seen), -1), jacobian.reshape(len(seen), -1, 7)


def _intersect(
    edges: _Edges, fit: Float[Array, "e 7"], information: Float[Array, "e 7 7"]
) -> tuple[Float[Array, "n 4 2"], Float[Array, "n 4 2 2"]]:
    """Corner k is where edges k - 1 and k meet: n . x = n . m + a + b (t . (x - m)) / half for both, m: midpoint."""
    covariance = np.linalg.pinv(information, hermitian=True)[:, :2, :2]
    n = len(fit) // 4
    slope = fit[:, 1] / edges.half
    normal = edges.outward - slope[:, None] * edges.along
    offset = np.einsum("ij,ij->i", normal, edges.midpoint) + fit[:, 0]
    k = np.arange(4 * n).reshape(n, 4)
    before = np.roll(k, 1, axis=1)
    matrix = np.stack([normal[before], normal[k]], axis=-2)
    with np.errstate(all="ignore"):
        flat = np.abs(np.linalg.det(matrix)) < 0.05
    matrix = np.where(flat[..., None, None], np.eye(2), matrix)
    right = np.stack([offset[before], offset[k]], -1)
    corners = np.linalg.solve(matrix, right[..., None])[..., 0]
    inverse = np.linalg.inv(matrix)
    variances = np.stack([_variance_at(-1.0, covariance, k), _variance_at(1.0, covariance, before)], 0)
    spread = np.zeros((n, 4, 2, 2))
    spread[..., 0, 0], spread[..., 1, 1] = variances[1], variances[0]
    out = inverse @ spread @ np.swapaxes(inverse, -1, -2) + FLOOR_PX**2 * np.eye(2)
    out[flat] = np.nan
    return corners, out


def _variance_at(s: float, covariance: Float[Array, "e 2 2"], edges: Array) -> Float[Array, "n 4"]:
    """Variance of an edge's offset a + b s."""
    chosen = covariance[edges]
    return chosen[..., 0, 0] + 2 * s * chosen[..., 0, 1] + s * s * chosen[..., 1, 1]
