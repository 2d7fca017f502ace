"""Vision's mesh corrected by what contact learned, each weighted by its uncertainty.

Contact measures the body's support: in every direction in which a point touched the plane, how far the body reaches
there. The mesh's error is a smooth random field u(x) (a Gaussian process; Rasmussen and Williams 2006, eq. 2.23-2.24):

    cov(a.u(x), b.u(y)) = (a.b) [s(x) s(y) exp(-|x-y|^2 / 2 l^2) + h(x) h(y) exp(-|x-y|^2 / 2 L^2)]
                        + scale^2 (a.(x-c)) (b.(y-c))

s: local errors of what a camera saw (edges fattened, noise), l some millimetres; h: what no camera saw, L a good part
of the object; scale: an error of the depth's scale. A contact j reads m_j.u(x_j) = d_j with its own deviation, and all
contacts share the plane's. The three sizes are the most probable ones given the readings (eq. 5.8, with a prior).
Where no contact is near, nothing moves; faces that a camera saw move less than an underside that none did.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array
from scipy.optimize import minimize
from scipy.spatial import cKDTree


@dataclass(frozen=True)
class FusionConfig:
    """What is assumed of vision and of contact before they meet; lengths in metres, standard deviations."""

    seen_m: float = 0.0007
    """Local error of a surface that a camera saw."""
    unseen_m: float = 0.008
    """Error of a surface that none saw (closed by a guess)."""
    scale: float = 0.003
    """Error of the whole shape's size, relative."""
    broad: float = 0.8
    """How far (in natural logarithms) the readings may pull those three."""
    local_m: float = 0.006
    """Reach of a local error."""
    wide: float = 0.3
    """Reach of an error of the unseen, as a share of the object's mean extent."""
    plane_m: float = 0.0005
    """Of the plane's height, common to all readings; a calibration that says its own replaces it."""
    contact_m: float = 0.0005
    """Added to each reading: the model is not the world."""


@dataclass(frozen=True, eq=False)
class Readings:
    """What contact says about the surface: at a point of the prior's support, along an outward direction, the body
    reaches `further_m` more than the prior. Object frame."""

    point_m: Float[Array, "j 3"]
    direction: Float[Array, "j 3"]
    further_m: Float[Array, " j"]
    sigma_m: Float[Array, " j"]

    def __len__(self) -> int:
        return len(self.further_m)


@dataclass(frozen=True)
class Sizes:
    """The deviations that were found most probable."""

    seen_m: float
    unseen_m: float
    scale: float


class Field:
    """The most probable correction of a mesh, as a function of the place."""

    def __init__(
        self, readings: Readings, sizes: Sizes, config: FusionConfig, surface: Surface, plane_m: float
    ) -> None:
        self._readings, self._sizes, self._config, self._surface = readings, sizes, config, surface
        K, noise = _covariances(readings, surface, sizes, config, plane_m)
        self._alpha = np.linalg.solve(K + noise, readings.further_m) if len(readings) else np.zeros(0)

    def at(self, points_m: Float[Array, "v 3"]) -> Float[Array, "v 3"]:
        """The displacement (m) of points on or near the surface."""
        if len(self._readings) == 0:
            return np.zeros_like(points_m)
        r, s = self._readings, self._surface
        near = _nearness(points_m, r.point_m, s, self._sizes, self._config)
        pull = (near * self._alpha) @ r.direction
        reach = ((r.point_m - s.center_m) * r.direction).sum(1) @ self._alpha
        return pull + self._sizes.scale**2 * reach * (points_m - s.center_m)


class Surface:
    """Where the mesh is, how large, and how much of its neighbourhood no camera saw (0..1)."""

    def __init__(self, vertices_m: Float[Array, "v 3"], observed: Bool[Array, " v"] | None, most: int = 4000) -> None:
        kept = np.random.default_rng(0).permutation(len(vertices_m))[:most]
        self.center_m = 0.5 * (vertices_m.min(0) + vertices_m.max(0))
        self.extent_m = float(np.ptp(vertices_m, axis=0).mean())
        self._unseen = np.zeros(len(kept)) if observed is None else (~observed[kept]).astype(np.float64)
        self._tree = cKDTree(vertices_m[kept])

    def unseen(self, points_m: Float[Array, "v 3"]) -> Float[Array, " v"]:
        """The share of unseen surface around points, smooth along the surface."""
        if not self._unseen.any():
            return np.zeros(len(points_m))
        gap, near = self._tree.query(points_m, k=min(24, self._tree.n))
        weight = np.exp(-0.5 * (gap / np.maximum(gap[:, -1:] / 2, 1e-9)) ** 2)
        return np.asarray((weight * self._unseen[near]).sum(1) / weight.sum(1))


def _nearness(
    a_m: Float[Array, "n 3"], b_m: Float[Array, "j 3"], surface: Surface, sizes: Sizes, config: FusionConfig
) -> Float[Array, "n j"]:
    """The two Gaussian parts of the covariance, without directions."""
    square = ((a_m[:, None] - b_m[None]) ** 2).sum(-1)
    wide = np.outer(surface.unseen(a_m), surface.unseen(b_m)) * sizes.unseen_m**2
    wide_m = config.wide * surface.extent_m
    local = sizes.seen_m**2 * np.exp(-0.5 * square / config.local_m**2)
    return np.asarray(local + wide * np.exp(-0.5 * square / wide_m**2))


def _covariances(
    readings: Readings, surface: Surface, sizes: Sizes, config: FusionConfig, plane_m: float
) -> tuple[Float[Array, "j j"], Float[Array, "j j"]]:
    """Of the field along the readings' directions, and of the readings' own errors."""
    along = readings.direction @ readings.direction.T
    reach = ((readings.point_m - surface.center_m) * readings.direction).sum(1)
    K = along * _nearness(readings.point_m, readings.point_m, surface, sizes, config)
    K = K + sizes.scale**2 * np.outer(reach, reach)
    noise = np.diag(readings.sigma_m**2 + config.contact_m**2) + plane_m**2
    return K, noise


def likely_sizes(readings: Readings, surface: Surface, config: FusionConfig, plane_m: float) -> Sizes:
    """Maximum of the marginal likelihood times a log-normal prior about the configured sizes."""
    start = np.array([config.seen_m, config.unseen_m, config.scale])
    if len(readings) < 6:
        return Sizes(*start)

    def cost(move: Float[Array, "3"]) -> float:
        K, noise = _covariances(readings, surface, Sizes(*(start * np.exp(move))), config, plane_m)
        factor = np.linalg.cholesky(K + noise)
        half = np.linalg.solve(factor, readings.further_m)
        return float(0.5 * half @ half + np.log(np.diag(factor)).sum() + 0.5 * (move @ move) / config.broad**2)

    corners = np.concatenate([np.zeros((1, 3)), 0.7 * np.eye(3)])
    options = {"maxfev": 120, "xatol": 0.05, "fatol": 0.05, "initial_simplex": corners}
    found = minimize(cost, np.zeros(3), method="Nelder-Mead", options=options)
    return Sizes(*(float(x) for x in start * np.exp(found.x)))


def thinned(
    point: Int[Array, " j"], direction: Float[Array, "j 3"], weight: Float[Array, " j"], most: int = 240
) -> Int[Array, " k"]:
    """Readings worth keeping: of each point, directions at least 10 degrees apart, the weightiest ones."""
    kept: list[int] = []
    for i in np.argsort(-weight):
        same = [k for k in kept if point[k] == point[i]]
        if not same or float((direction[same] @ direction[i]).max()) < np.cos(np.radians(10)):
            kept.append(int(i))
        if len(kept) == most:
            break
    return np.array(kept, dtype=np.int64)
