"""Which point of the body is followed: one and the same for the truth and every estimate.

Each of them has a body frame of its own, so that their origins are different points of the object; drawn beside each
other, two curves centimetres apart would be seen although the poses agree.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings.view.scene import TRUTH_NAME, Body, Scene, root_poses


def at_same_point(
    scene: Scene, body: Body, toss: int, times_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"]
) -> Float[Array, "n 4 4"]:
    """The body's poses in a frame whose origin is the point that is followed; its axes stay as they are."""
    moved = matrices.copy()
    moved[:, :3, 3] += matrices[:, :3, :3] @ body_point(scene, body, toss, times_ns, matrices)
    return moved


def body_point(
    scene: Scene, body: Body, toss: int, times_ns: Int64[Array, " n"], matrices: Float[Array, "n 4 4"]
) -> Float[Array, "3"]:
    """The centre of the reference's shape, in the frame of `body`: where the reference has it at the body's poses, the
    median over the toss. Without a reference, or where no pose tells, the centre of the body's own shape."""
    reference = _reference(scene, toss)
    if reference is None or reference.name == body.name:
        return _center(body, toss)
    at_ns, poses = root_poses(scene, reference.poses[toss])
    known = np.isfinite(poses).all(axis=(1, 2))
    at_ns, poses = at_ns[known], poses[known]
    if len(at_ns) == 0:
        return _center(body, toss)
    followed = poses[:, :3, :3] @ _center(reference, toss) + poses[:, :3, 3]
    common = np.isfinite(matrices).all(axis=(1, 2)) & (times_ns >= at_ns[0]) & (times_ns <= at_ns[-1])
    if not common.any():
        return _center(body, toss)
    then = np.stack([np.interp(times_ns[common], at_ns, axis) for axis in followed.T], axis=1)
    own = np.einsum("nji,nj->ni", matrices[common, :3, :3], then - matrices[common, :3, 3])
    point: Float[Array, "3"] = np.median(own, axis=0)
    return point


def _reference(scene: Scene, toss: int) -> Body | None:
    """The truth, where it is known; else the estimate that is shown first."""
    there = [b for b in scene.bodies if b.poses.get(toss)]
    truths = [b for b in there if b.name == TRUTH_NAME]
    return next(iter([*truths, *(b for b in there if b.shown), *there]), None)


def _center(body: Body, toss: int) -> Float[Array, "3"]:
    """The centre of the box around the shape, in its axes; the frame's origin where no shape is known."""
    shape = body.shape(toss)
    if shape is None or len(shape.vertices_m) == 0:
        return np.zeros(3)
    return np.asarray(0.5 * (shape.vertices_m.min(axis=0) + shape.vertices_m.max(axis=0)))
