"""A simulated toss of a tagged cube before three cameras: exact geometry, noisy corners, no images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.tags.detect import TagDetection
from groundtruth.session_detections import Detections, TagSeen
from recordings.geometry import CameraModel, Transform
from recordings.tracks import RigCalibration, TagPlacement

HALF_M, TAG_M, TABLE_TAG_M = 0.05, 0.07, 0.08
CORNERS = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
STEP_S = 1 / 30
FACES = ([0, 0, 0], [90, 0, 0], [-90, 0, 0], [0, 90, 0], [0, -90, 0], [180, 0, 0])


def looking_at(place: np.ndarray, target: np.ndarray) -> Transform:
    z = target - place
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0, 1])
    x /= np.linalg.norm(x)
    return Transform("world", "camera", np.stack([x, np.cross(z, x), z], axis=1), place)


def cube_layout() -> dict[int, np.ndarray]:
    """object_from_tag of six tags a little off the faces' middles (pupil-apriltags' tag frame: z into the print)."""
    random, out = np.random.default_rng(5), {}
    for i, turn in enumerate(FACES):
        R = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        pose = np.eye(4)
        pose[:3, :3] = R
        pose[:3, 3] = R @ [*random.uniform(-0.005, 0.005, 2), -HALF_M]
        out[i] = pose
    return out


def toss_poses(number: int, frames: int) -> tuple[np.ndarray, np.ndarray]:
    """world_from_object at rest in the hand, in flight, and after a bounce; and which frames fly (first flight)."""
    random = np.random.default_rng(100 + number)
    start, velocity = np.array([-0.25, 0.05, 0.3]), np.array([0.8, -0.1, 0.9]) + 0.1 * random.normal(size=3)
    spin, first = random.normal(size=3) * 3, Rotation.from_rotvec(random.normal(size=3)).as_matrix()
    release, poses, flies = 0.15, [], []
    bounce = release + (velocity[2] + np.sqrt(velocity[2] ** 2 + 2 * 9.81 * (start[2] - 0.08))) / 9.81
    for k in range(frames):
        t = k * STEP_S
        a = min(max(t - release, 0.0), bounce - release)
        b = max(t - bounce, 0.0)
        at = start + velocity * a + [0, 0, -0.5 * 9.81 * a * a]
        after = np.array([0.5, 0.4, 0.0]) * velocity + [0, 0, 0.45 * (9.81 * (bounce - release) - velocity[2])]
        at = at + (after * b + [0, 0, -0.5 * 9.81 * b * b] if b > 0 else 0.0)
        pose = np.eye(4)
        R = first @ Rotation.from_rotvec(spin * a).as_matrix()
        pose[:3, :3] = R @ Rotation.from_rotvec(np.array([1.0, -2, 0.5]) * b).as_matrix()
        pose[:3, 3] = at
        poses.append(pose)
        flies.append(release < t < bounce)
    return np.array(poses), np.array(flies)


@dataclass(frozen=True)
class TossLab:
    """Three cameras round a table with two known tags, and what they see of tosses."""

    calibration: RigCalibration
    cameras: dict[str, Transform]
    layout: dict[int, np.ndarray]
    truth: dict[int, np.ndarray]
    flies: dict[int, np.ndarray]
    detections: Detections


def lab(
    tosses: int = 2,
    frames: int = 18,
    noise_px: float = 0.1,
    late_ns: dict[str, int] | None = None,
    bumped: tuple[str, int, Transform] | None = None,
    blind: tuple[str, int] | None = None,
    cameras: tuple[str, ...] = ("mono0", "mono1", "mono2"),
    seed: int = 0,
) -> TossLab:
    """`seed`: of the corners' noise and the tosses. `late_ns`: how much later a camera exposes; `bumped`: a camera
    moved in its own frame from a toss on; `blind`: a camera that misses every so many-th frame."""
    random, layout = np.random.default_rng(seed), cube_layout()
    places = {"mono0": [0.9, -0.6, 0.7], "mono1": [-0.9, -0.6, 0.8], "mono2": [0.0, 0.9, 0.9]}
    looks = {n: looking_at(np.array(places[n]), np.array([0.0, 0.0, 0.15])) for n in cameras}
    K = np.array([[900.0, 0, 640], [0, 900.0, 480], [0, 0, 1]])
    models = {n: CameraModel(n, 1280, 960, K) for n in cameras}
    down = np.diag([1.0, -1.0, -1.0])
    table = tuple(
        TagPlacement(30 + i, TABLE_TAG_M, Transform("world", f"tag_{30 + i}", down, np.array([x, y, 0.0])))
        for i, (x, y) in enumerate(((-0.2, -0.2), (0.25, 0.2)))
    )
    calibration = RigCalibration(models, tuple(replace(looks[n], source=n) for n in cameras), table)
    seen, stamps, truth, flies = [], {}, {}, {}
    for toss in range(tosses):
        start = toss * 10_000_000_000
        truth[toss], flies[toss] = toss_poses(toss + 1000 * seed, frames)
        stamps[toss] = {}
        for n in cameras:
            look = looks[n]
            if bumped is not None and bumped[0] == n and toss >= bumped[1]:
                look = replace(looks[n], source="camera") @ bumped[2]
            late = (late_ns or {}).get(n, 0)
            kept = [k for k in range(frames) if blind is None or blind[0] != n or k % blind[1]]
            stamps[toss][n] = np.array([start + round(k * STEP_S * 1e9) + late for k in kept], dtype=np.int64)
            for k, stamp in zip(kept, stamps[toss][n].tolist()):
                places_of = {i: truth[toss][k] @ T for i, T in layout.items()}
                places_of |= {t.tag_id: t.world_from_tag.matrix for t in table}
                for tag_id, world_from_tag in places_of.items():
                    size = TAG_M if tag_id in layout else TABLE_TAG_M
                    corners = visible(models[n], look, world_from_tag, size)
                    if corners is not None:
                        corners = corners + noise_px * random.normal(size=(4, 2))
                        covariance = np.tile(max(noise_px, 0.05) ** 2 * np.eye(2), (4, 1, 1))
                        seen.append(TagSeen(toss, n, stamp, TagDetection(tag_id, corners, covariance, 80.0, 0)))
    return TossLab(calibration, looks, layout, truth, flies, Detections(tuple(seen), stamps, {}, 0))


def visible(model: CameraModel, look: Transform, world_from_tag: np.ndarray, size_m: float) -> np.ndarray | None:
    """Pixels of a tag's corners; None where the camera sees it from behind, too flat, or not at all."""
    world = size_m * CORNERS @ world_from_tag[:3, :3].T + world_from_tag[:3, 3]
    ray = world.mean(axis=0) - look.translation_m
    if ray @ world_from_tag[:3, 2] < 0.3 * np.linalg.norm(ray):
        return None
    pixels = model.project(look.inverse().points(world))
    return pixels if model.sees(pixels).all() else None


@pytest.fixture(scope="session")
def toss_lab():
    """The builder of simulated tosses."""
    return lab
