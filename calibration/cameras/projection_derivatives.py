"""How a projected point moves with its camera, its body and its lens: the derivatives that bundle.py needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from recordings.geometry import CameraModel


def lens_numbers(model: CameraModel) -> Float[Array, " k"]:
    """fx fy cx cy and the distortion."""
    return np.array([model.fx, model.fy, model.cx, model.cy, *model.distortion])


def with_lens(model: CameraModel, numbers: Float[Array, " k"]) -> CameraModel:
    """The same camera with other numbers (see `lens_numbers`)."""
    K = np.array([[numbers[0], model.K[0, 1], numbers[2]], [0.0, numbers[1], numbers[3]], [0.0, 0.0, 1.0]])
    return replace(model, K=K, distortion=tuple(numbers[4:].tolist()))


def projected(
    models: Sequence[CameraModel], camera: Int[Array, " n"], points_m: Float[Array, "n 3"]
) -> Float[Array, "n 2"]:
    """Pixels of points that are each in the frame of their own camera."""
    out = np.empty((len(points_m), 2))
    for number, model in enumerate(models):
        mine = camera == number
        out[mine] = model.project(points_m[mine])
    return out


def by_motion(points_m: Float[Array, "n 3"]) -> Float[Array, "n 3 6"]:
    """d (exp([w, t]^) x) / d (w, t) = [-[x]_x, 1]."""
    x, y, z = points_m.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    return np.stack(
        [
            np.stack([zero, z, -y, one, zero, zero], -1),
            np.stack([-z, zero, x, zero, one, zero], -1),
            np.stack([y, -x, zero, zero, zero, one], -1),
        ],
        1,
    )


def by_point(
    models: Sequence[CameraModel], camera: Int[Array, " n"], points_m: Float[Array, "n 3"]
) -> Float[Array, "n 2 3"]:
    """Of each pixel by its point in the camera's frame."""
    step = 1e-5
    columns = []
    for axis in range(3):
        ahead = np.eye(3)[axis] * step
        up, down = (projected(models, camera, points_m + sign * ahead) for sign in (1, -1))
        columns.append((up - down) / (2 * step))
    return np.stack(columns, -1)


def by_lens(
    models: Sequence[CameraModel],
    free: Bool[Array, " c"],
    camera: Int[Array, " n"],
    points_m: Float[Array, "n 3"],
) -> Float[Array, "n 2 k"]:
    """Of each pixel by its camera's lens numbers (zero for cameras that are not free)."""
    most = max(len(lens_numbers(m)) for m in models)
    out = np.zeros((len(points_m), 2, most))
    for number in np.flatnonzero(free).tolist():
        mine = camera == number
        numbers = lens_numbers(models[number])
        for k in range(len(numbers)):
            step = 1e-3 if k < 4 else 1e-6
            ahead = np.eye(len(numbers))[k] * step
            up, down = (with_lens(models[number], numbers + s * ahead).project(points_m[mine]) for s in (1, -1))
            out[mine, :, k] = (up - down) / (2 * step)
    return out
