"""The keyframes: which views serve as the model, and which of them a new view is compared with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array


@dataclass(frozen=True)
class KeyframeConfig:
    """When a view becomes a keyframe and how many keyframes are used at once."""

    apart_deg: float = 8.0
    """A view becomes one when no keyframe is within this rotation of it."""
    nearer: float = 0.85
    """... or when it is this much nearer than the keyframes around."""
    used: int = 4
    """Views that a new one is compared with."""
    co_visible_deg: float = 65.0
    """Views from directions farther apart share too little surface."""


def view_directions(poses: Float[Array, "n 4 4"], center_m: Float[Array, "3"]) -> Float[Array, "n 3"]:
    """Unit vectors from the body's center of mass to the camera, object frame."""
    center = poses[:, :3, :3] @ center_m + poses[:, :3, 3]
    direction = -np.einsum("nji,nj->ni", poses[:, :3, :3], center)
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def rotations_deg(poses: Float[Array, "n 4 4"], pose: Float[Array, "4 4"]) -> Float[Array, " n"]:
    """Rotation angle between each pose and one, degrees."""
    cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def extended(
    keyframes: tuple[int, ...],
    poses: Float[Array, "n 4 4"],
    views: Sequence[int],
    config: KeyframeConfig,
) -> tuple[int, ...]:
    """The keyframes and, one after the other, those of the views that show what none before them shows."""
    for i in views:
        if i not in keyframes and _is_new(poses, i, keyframes, config):
            keyframes = (*keyframes, i)
    return keyframes


def _is_new(
    poses: Float[Array, "n 4 4"],
    view: int,
    keyframes: tuple[int, ...],
    config: KeyframeConfig,
) -> bool:
    """Whether `view` shows what no keyframe shows: another side, or the same from much nearer."""
    keys = np.array(keyframes)
    near = rotations_deg(poses[keys], poses[view]) < config.apart_deg
    if not near.any():
        return True
    depth = poses[keys][near][:, :3, 3][:, 2].min()
    return bool(poses[view, 2, 3] < config.nearer * depth)


class Sides:
    """The keyframes and the last view, by the directions that they look from: which of them a view is compared with."""

    def __init__(
        self, poses: Float[Array, "n 4 4"], keyframes: tuple[int, ...], last: int, center_m: Float[Array, "3"]
    ) -> None:
        self._views = np.array(sorted({*keyframes, last}))
        self._poses, self._last, self._center_m = poses[self._views], last, center_m
        self._directions = view_directions(self._poses, center_m)

    def references(self, pose: Float[Array, "4 4"], config: KeyframeConfig) -> Int[Array, " m"]:
        """Views to compare a view at `pose` with: the last one and those that look from the nearest directions."""
        here = view_directions(pose[None], self._center_m)[0]
        angle = np.degrees(np.arccos(np.clip(self._directions @ here, -1, 1)))
        order = np.argsort(angle + 0.05 * rotations_deg(self._poses, pose))
        order = order[angle[order] < config.co_visible_deg][: config.used]
        chosen, last = self._views[order], self._last
        if last not in chosen and angle[self._views == last][0] < config.co_visible_deg:
            chosen = np.concatenate([chosen[: config.used - 1], [last]])
        return np.asarray(chosen, dtype=np.int64)
