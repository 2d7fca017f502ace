"""Appearance likelihood ratio of two trajectory hypotheses, as a log likelihood ratio of the same pixels.

A hypothesis's mean cost counts only what its poses bring together: one in which a face is always another, new one has
nothing to compare. Here every sample of a view is predicted under both hypotheses from the views whose place relative
to it they dispute: by those that see it there, or, where none does, by the colours of the whole object. A small label
that falls where a label was seen is then worth much, and plain paint on plain paint nothing. Only differences of colour
are used, which light and shadow leave alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from numpy import ndarray as Array

from processing.motion import se3_kernels as se3
from processing.sensor import noise
from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.beam import Scene
from processing.track.schedule import USUAL_DISTANCE_M
from recordings.constants import MAD_TO_SIGMA_SHORT

FIRST_APPEARANCE = lay.SMOOTH + 1
APPEARANCE = lay.APPEARANCE - 1
SAMPLE_APPEARANCE = lay.SSHARP + lay.APPEARANCE + 1
"""The smooth differences of colour among the channels of a pixel and the columns of a sample."""


@dataclass(frozen=True)
class AppearanceRatioConfig:
    """What counts as disputed, as seen and as equal."""

    disputed_deg: float = 15.0
    """Two views whose relative turn differs by more between two hypotheses are disputed."""
    agreed_deg: float = 5.0
    """... and by less, agreed."""
    most_views: int = 8
    """Disputed views that predict another, spread over time."""
    on_surface_m: float = 0.01
    """A sample this near to what a view sees (at 0.8 m) is seen by it."""
    far_steps: int = 5
    least_sigma: float = 0.05
    wider: float = 1.3
    """Appearances match within so many times the usual difference of agreed views that far apart in time."""
    outlier: float = 0.1
    gain: float = noise.APPEARANCE_GAIN
    most: float = 10.0
    """The log likelihood ratio of a view counts no more than this (nats)."""
    dead: float = 2.0
    """A mean log likelihood ratio below this is chance (nats)."""


def log_likelihood_ratio(
    scene: Scene,
    one: Float[Array, "n 4 4"],
    other: Float[Array, "n 4 4"],
    use: Bool[Array, " n"],
    config: AppearanceRatioConfig,
) -> float:
    """Log likelihood ratio (nats) of the appearance under hypothesis `one` against `other`; positive speaks for
    `one`."""
    use = use & np.isfinite(one[:, 0, 0]) & np.isfinite(other[:, 0, 0])
    views = np.array([run[len(run) // 2] for run in scene.store.still_runs(use)], dtype=np.int64)
    apart = turns_apart_deg(one[views], other[views])
    disputed = apart > config.disputed_deg
    if not disputed.any():
        return 0.0
    sigma = _usual_difference(scene.store, one, views, apart, config)
    usual = _Usual.of(np.concatenate([_appearance(scene.store, int(i)) for i in views]), sigma)
    ratios = []
    for a in np.flatnonzero(disputed.any(1)):
        others = views[_evenly_chosen(np.flatnonzero(disputed[a]), config.most_views)]
        ratio = [_predicted(scene.store, poses, int(views[a]), others, sigma, usual, config) for poses in (one, other)]
        ratios.append(np.clip(config.gain * (ratio[0] - ratio[1]), -config.most, config.most))
    mean = float(np.mean(ratios))
    return float(np.sign(mean) * max(abs(mean) - config.dead, 0.0))


@dataclass(frozen=True, eq=False)
class _Usual:
    """Log density of the appearances among all that the object shows, on a grid of cells of `sigma`."""

    median: Float[Array, "2"]
    sigma: Float[Array, "2"]
    log_density: Float[Array, "c c"]

    @staticmethod
    def of(appearance: Float[Array, "p 2"], sigma: Float[Array, "2"], cells: int = 61) -> _Usual:
        median, shares = np.median(appearance, axis=0), np.zeros((cells, cells))
        at = _cells(appearance, median, sigma, cells)
        np.add.at(shares, (at[:, 0], at[:, 1]), 1.0 / len(at))
        dense = 0.97 * cv2.GaussianBlur(shares, (0, 0), float(np.sqrt(2.0))) + 0.03 / shares.size
        return _Usual(median, sigma, np.log(dense / np.prod(sigma)))

    def at(self, appearance: Float[Array, "p 2"]) -> Float[Array, " p"]:
        at = _cells(appearance, self.median, self.sigma, len(self.log_density))
        return np.asarray(self.log_density[at[:, 0], at[:, 1]])


def _cells(appearance: Float[Array, "p 2"], median: Float[Array, "2"], sigma: Float[Array, "2"], cells: int) -> Array:
    return np.clip(np.round((appearance - median) / sigma) + cells // 2, 0, cells - 1).astype(int)


def turns_apart_deg(one: Float[Array, "v 4 4"], other: Float[Array, "v 4 4"]) -> Float[Array, "v v"]:
    """How much two hypotheses differ about the rotation between any two views (degrees)."""
    both = np.swapaxes(one[:, :3, :3], 1, 2) @ other[:, :3, :3]
    cosine = (np.einsum("aij,bij->ab", both, both) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _evenly_chosen(places: Int[Array, " p"], most: int) -> Int[Array, " q"]:
    return places[np.unique(np.linspace(0, len(places) - 1, most).round().astype(int))]


def _appearance(store: ViewStore, view: int) -> Float[Array, "s 2"]:
    first, count = int(store.table[view, lay.FIRST]), int(store.table[view, lay.COUNT])
    return np.asarray(
        store.samples[first : first + count, SAMPLE_APPEARANCE : SAMPLE_APPEARANCE + APPEARANCE], dtype=np.float64
    )


def _usual_difference(
    store: ViewStore, poses: Float[Array, "n 4 4"], views: Int[Array, " v"], apart: Float[Array, "v v"],
    config: AppearanceRatioConfig,
) -> Float[Array, "2"]:  # fmt: skip
    """Standard deviation of a sample's appearance, from views far apart in time about which the hypotheses agree."""
    steps = np.abs(np.subtract.outer(np.arange(len(views)), np.arange(len(views))))
    gaps = [np.zeros((0, APPEARANCE))]
    for a in range(len(views)):
        far = np.flatnonzero((apart[a] < config.agreed_deg) & (steps[a] >= config.far_steps))
        for b in _evenly_chosen(far, config.most_views) if len(far) else far:
            seen = _seen(store, poses, int(views[a]), int(views[b]), config)
            gaps.append((seen - _appearance(store, int(views[a])))[np.isfinite(seen[:, 0])])
    every = np.abs(np.concatenate(gaps))
    usual = MAD_TO_SIGMA_SHORT / np.sqrt(2) * np.median(every, axis=0) if len(every) else np.zeros(APPEARANCE)
    return np.asarray(np.maximum(config.wider * usual, config.least_sigma))


def _predicted(
    store: ViewStore, poses: Float[Array, "n 4 4"], view: int, others: Int[Array, " m"], sigma: Float[Array, "2"],
    usual: _Usual, config: AppearanceRatioConfig,
) -> float:  # fmt: skip
    """Log likelihood of a view's appearance given what the others show at these poses, above that of the object's usual
    appearance."""
    appearance = _appearance(store, view)
    gaps = np.stack([_seen(store, poses, view, int(j), config) for j in others]) - appearance
    density = np.exp(-0.25 * np.sum((gaps / sigma) ** 2, axis=2)) / (4 * np.pi * np.prod(sigma))
    sees = np.isfinite(density)
    count = sees.sum(0)
    log_usual = usual.at(appearance)
    mean = np.where(sees, density, 0.0).sum(0) / np.maximum(count, 1)
    ratio = np.log((1 - config.outlier) * mean * np.exp(-log_usual) + config.outlier)
    return float(ratio[count > 0].sum())


def _seen(
    store: ViewStore, poses: Float[Array, "n 4 4"], view: int, other: int, config: AppearanceRatioConfig
) -> Float[Array, "s 2"]:
    """Appearance of another view where it sees the samples of this one; NaN where it does not."""
    first, count = int(store.table[view, lay.FIRST]), int(store.table[view, lay.COUNT])
    near = config.on_surface_m * np.clip((np.linalg.norm(store.center_m[view]) / USUAL_DISTANCE_M) ** 2, 0.5, 4.0)
    out = np.full((count, APPEARANCE), np.nan)
    _appearance_at(
        store.samples[first : first + count], poses[other] @ se3.inverse(poses[view]), store.maps, store.table[other],
        store.rectified.focal, store.rectified.center, near, out,
    )  # fmt: skip
    return out


@no_type_check
@njit(cache=True, nogil=True)
def _appearance_at(samples, pose, maps, row, focal, center, near, out):
    """Writes the smooth differences of colour that a view shows where it sees the samples. pose: 4x4
    other_from_sample_camera."""
    for i in range(samples.shape[0]):
        p = samples[i]
        x = pose[0, 0] * p[lay.PX] + pose[0, 1] * p[lay.PY] + pose[0, 2] * p[lay.PZ] + pose[0, 3]
        y = pose[1, 0] * p[lay.PX] + pose[1, 1] * p[lay.PY] + pose[1, 2] * p[lay.PZ] + pose[1, 3]
        z = pose[2, 0] * p[lay.PX] + pose[2, 1] * p[lay.PY] + pose[2, 2] * p[lay.PZ] + pose[2, 3]
        mx = pose[0, 0] * p[lay.SNX] + pose[0, 1] * p[lay.SNY] + pose[0, 2] * p[lay.SNZ]
        my = pose[1, 0] * p[lay.SNX] + pose[1, 1] * p[lay.SNY] + pose[1, 2] * p[lay.SNZ]
        mz = pose[2, 0] * p[lay.SNX] + pose[2, 1] * p[lay.SNY] + pose[2, 2] * p[lay.SNZ]
        if z < 0.05 or mx * x + my * y + mz * z > -0.25 * np.sqrt(x * x + y * y + z * z):
            continue
        u = focal[0] * x / z + center[0] - row[lay.U0]
        v = focal[1] * y / z + center[1] - row[lay.V0]
        iu, iv = int(np.floor(u + 0.5)), int(np.floor(v + 0.5))
        if iu < 1 or iv < 1 or iu >= row[lay.WIDTH] - 2 or iv >= row[lay.HEIGHT] - 2:
            continue
        at = row[lay.OFFSET] + iv * row[lay.WIDTH] + iu
        zr, nx, ny, nz = maps[at, lay.Z], maps[at, lay.NX], maps[at, lay.NY], maps[at, lay.NZ]
        if maps[at, lay.OUTSIDE] != 0.0 or zr <= 0.0 or nx * mx + ny * my + nz * mz < 0.7:
            continue
        px = (iu + row[lay.U0] - center[0]) / focal[0] * zr
        py = (iv + row[lay.V0] - center[1]) / focal[1] * zr
        if abs(nx * (x - px) + ny * (y - py) + nz * (z - zr)) > near:
            continue
        ju, jv = int(np.floor(u)), int(np.floor(v))
        a, b = u - ju, v - jv
        q = row[lay.OFFSET] + jv * row[lay.WIDTH] + ju
        for c in range(APPEARANCE):
            top = maps[q, FIRST_APPEARANCE + c] * (1 - a) + maps[q + 1, FIRST_APPEARANCE + c] * a
            bottom = (
                maps[q + row[lay.WIDTH], FIRST_APPEARANCE + c] * (1 - a)
                + maps[q + row[lay.WIDTH] + 1, FIRST_APPEARANCE + c] * a
            )
            value = top * (1 - b) + bottom * b
            if value > 0.5 * lay.NO_APPEARANCE or p[SAMPLE_APPEARANCE + c] > 0.5 * lay.NO_APPEARANCE:
                for d in range(APPEARANCE):
                    out[i, d] = np.nan
                break
            out[i, c] = value
