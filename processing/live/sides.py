"""Which sides of the object were seen and touched so far, and how much another throw would add, by the covariances of
what is there.

A side is a direction in the object frame. A frame tells the surface there with the camera's depth noise over the cosine
at which it faces the camera; frames of one toss err together, so that a toss counts as one frame of its best view and a
tenth of all. What nobody saw is the hull's guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from processing.motion.rotation_grid import directions
from processing.sensor.noise import stereo_sigma_m
from recordings.geometry import Transform, skew
from recordings.tracks import ObjectTrack

DIRECTIONS = 192
FACES = 0.35
"""Cosine to the camera at which a side is still measured."""
GUESS = 0.12
"""Standard deviation of an unseen side, as a share of the object's mean extent: its hull closes it."""
TOGETHER = 0.1
"""Weight of further frames of a toss beside its best one: they err together."""
TOUCHED_COS = 0.9
NAMES = ("lies on the table", "is up", "faces the camera", "is turned away from the camera", "is left", "is right")
"""Sides of the object as it lies now, seen from the camera."""


@dataclass(frozen=True, eq=False)
class TossSides:
    """Information (1/variance, 1/m^2) that one toss gives on the surface in each direction: in the object frame, and
    (`pattern`) in camera axes by how the object lay when the toss began; which directions touched the table."""

    information: Float[Array, " d"]
    pattern: Float[Array, " d"]
    touched: Bool[Array, " d"]


def sides_of(
    track: ObjectTrack, center_m: Float[Array, "3"], world_from_camera: Transform | None, impact: int | None
) -> TossSides:
    """Of one toss whose track is in the shared object frame."""
    around, kept = directions(DIRECTIONS), [i for i, s in enumerate(track.status) if s == "tracked"]
    best, total = np.zeros(DIRECTIONS), np.zeros(DIRECTIONS)
    touched = np.zeros(DIRECTIONS, dtype=bool)
    for i in kept:
        pose = track.camera_from_object[i]
        at = pose[:3, :3] @ center_m + pose[:3, 3]
        facing = around @ (-(pose[:3, :3].T @ at) / np.linalg.norm(at))
        sigma = float(stereo_sigma_m(np.array([at[2]], dtype=np.float32))[0])
        information = np.where(facing > FACES, (facing / sigma) ** 2, 0.0)
        best, total = np.maximum(best, information), total + information
        if world_from_camera is not None and impact is not None and i >= impact:
            down = pose[:3, :3].T @ (world_from_camera.rotation.T @ np.array([0.0, 0.0, -1.0]))
            touched |= around @ down > TOUCHED_COS
    information = best + TOGETHER * (total - best)
    return TossSides(
        information, _turned(information, track.camera_from_object[kept[0], :3, :3]) if kept else information, touched
    )


def _turned(information: Float[Array, " d"], new_from_old: Float[Array, "3 3"]) -> Float[Array, " d"]:
    """A map over directions in other axes."""
    around = directions(DIRECTIONS)
    return information[np.argmax(around @ new_from_old @ around.T, axis=1)]


def surface_sigma_m(information: Float[Array, " d"], extent_m: float) -> float:
    """Root mean square standard deviation of the surface over all directions."""
    return float(np.sqrt(np.mean(1.0 / (1.0 / (GUESS * extent_m) ** 2 + information))))


@dataclass(frozen=True)
class Start:
    """A side to begin the next toss with towards the camera (its name as the object lies now), and what the surface's
    standard deviation would be after one more such toss."""

    side: str
    sigma_m: float
    unseen: bool
    untouched: bool


def next_starts(
    tosses: Sequence[TossSides], camera_from_object: Float[Array, "4 4"], center_m: Float[Array, "3"],
    world_from_camera: Transform | None, extent_m: float,
) -> list[Start]:  # fmt: skip
    """The six sides of the object as it lies now (its last pose), best start first. A toss is expected to show what
    those so far have shown, turned with the side that it begins with."""
    information, touched = sum(t.information for t in tosses), np.any([t.touched for t in tosses], axis=0)
    pattern, around = np.mean([t.pattern for t in tosses], axis=0), directions(DIRECTIONS)
    rotation, at = camera_from_object[:3, :3], camera_from_object[:3, :3] @ center_m + camera_from_object[:3, 3]
    to_camera = -at / np.linalg.norm(at)
    found = []
    for name, axis in zip(NAMES, _axes(to_camera, world_from_camera)):
        turn = _shortest(axis, to_camera) @ rotation  # camera_from_object at that start
        sigma = surface_sigma_m(information + _turned(pattern, turn.T), extent_m)
        near = around @ (rotation.T @ axis) > TOUCHED_COS
        guess = 1.0 / (GUESS * extent_m) ** 2
        found.append(
            Start(name, sigma, bool(np.median(np.asarray(information)[near]) < guess), not bool(touched[near].any()))
        )
    return sorted(found, key=lambda s: s.sigma_m)


def _axes(to_camera: Float[Array, "3"], world_from_camera: Transform | None) -> list[Float[Array, "3"]]:
    """Unit vectors (camera axes) of NAMES."""
    up = (
        np.array([0.0, -1.0, 0.0])
        if world_from_camera is None
        else world_from_camera.rotation.T @ np.array([0, 0, 1.0])
    )
    near = to_camera - up * (to_camera @ up)
    near = near / max(float(np.linalg.norm(near)), 1e-9)
    right = np.cross(near, up)
    right = right if right[0] > 0 else -right
    return [-up, up, near, -near, -right, right]


def _shortest(source: Float[Array, "3"], target: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation that turns one unit vector to another by the shortest way."""
    axis, cosine = np.cross(source, target), float(source @ target)
    if cosine < -0.999999:
        other = np.array([1.0, 0.0, 0.0]) if abs(source[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
        axis = np.cross(source, other)
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    K = skew(axis)
    return np.asarray(np.eye(3) + K + K @ K / (1 + cosine))
