"""Where the body's center of mass is: a first guess by what one view shows, then from its free flight."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray as Array

from processing.sensor import view_layout as lay
from processing.sensor.view_store import ViewStore
from processing.track.beam import Scene
from processing.track.joint_refinement import Motion, motion_residual


def first_center_m(store: ViewStore, view: int, pose: Float[Array, "4 4"] | None) -> Float[Array, "3"]:
    """A first guess, object frame: behind the center of the cloud that a view shows by a third of its width. `pose`:
    the view's camera_from_object; None: parallel to the camera, at the cloud's center."""
    first, count = int(store.table[view, lay.FIRST]), int(store.table[view, lay.COUNT])
    points = store.samples[first : first + count, :3].astype(np.float64)
    center_m = points.mean(0)
    width = float(np.ptp(points[:, :2], axis=0).mean())
    behind = np.asarray(center_m / np.linalg.norm(center_m) * width * 0.3)
    if pose is None:
        return behind
    return np.asarray(pose[:3, :3].T @ (center_m + behind - pose[:3, 3]))


def center_of_mass(poses: Float[Array, "n 4 4"], use: Bool[Array, " n"], scene: Scene) -> Float[Array, "3"]:
    """From the longest run of views whose motion is that of free flight."""
    index = np.flatnonzero(use)
    motion = Motion(
        scene.times_s, np.zeros(len(poses), dtype=np.int64), scene.gravity_camera_m_s2, scene.center_m, ~use
    )
    three = np.stack([index[:-2], index[1:-1], index[2:]], axis=1)
    times_s, gravity = scene.times_s[three], scene.gravity_camera_m_s2
    residual, _ = motion_residual(poses[three], times_s, motion)
    centers = poses[three][..., :3, :3] @ scene.center_m + poses[three][..., :3, 3]
    speeds = np.diff(centers, axis=1) / np.diff(times_s, axis=1)[:, :, None]
    span_s = times_s[:, 2] - times_s[:, 0]
    falls = (speeds[:, 1] - speeds[:, 0]) @ gravity / (0.5 * span_s) > 0.6 * float(gravity @ gravity)
    free = (falls & (np.linalg.norm(residual[:, :3], axis=1) < 3.0)).tolist()
    run = _longest_run(free)
    flying = index[run.start : run.stop + 2] if run.stop > run.start else index[:0]
    return flight_center(poses, scene.times_s, scene.gravity_camera_m_s2, flying, scene.center_m)


def flight_center(
    poses: Float[Array, "n 4 4"], times_s: Float[Array, " n"], gravity_camera_m_s2: Float[Array, "3"],
    flying: Int[Array, " m"], guess_m: Float[Array, "3"], sigma_m: float = 0.03,
) -> Float[Array, "3"]:  # fmt: skip
    """Centre of mass (object frame) from views in free flight: R_i c + t_i = p + v t + g t^2 / 2, least squares for
    c, p, v, held to `guess_m` with `sigma_m`. The guess where there are too few views."""
    if len(flying) < 5:
        return guess_m
    t = times_s[flying] - times_s[flying[0]]
    m = len(flying)
    A = np.zeros((3 * m + 3, 9))
    b = np.zeros(3 * m + 3)
    for n, i in enumerate(flying):
        A[3 * n : 3 * n + 3, :3] = poses[i, :3, :3]
        A[3 * n : 3 * n + 3, 3:6] = -np.eye(3)
        A[3 * n : 3 * n + 3, 6:] = -t[n] * np.eye(3)
        b[3 * n : 3 * n + 3] = 0.5 * gravity_camera_m_s2 * t[n] ** 2 - poses[i, :3, 3]
    fit_m = 0.002
    A[-3:, :3], b[-3:] = fit_m / sigma_m * np.eye(3), fit_m / sigma_m * guess_m
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0][:3])


def _longest_run(flags: list[bool]) -> range:
    best, start = range(0), 0
    for i, flag in enumerate([*flags, False]):
        if not flag:
            if i - start > len(best):
                best = range(start, i)
            start = i + 1
    return best
