"""The constant transform between the tagged body's frame and the object's: by name, never by accident."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from recordings.bounded.documents import read_json
from recordings.errors import BadInput
from recordings.geometry import Transform

CORNERS_PUPIL = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0], [0.0, 0.0, 0.0]])
"""Corners and centre of a tag of size 1 in pupil-apriltags' tag frame."""


def tagged_frame(layout: Mapping[int, Float[Array, "4 4"]]) -> Float[Array, "4 4"]:
    """The frame `tagged` of a found layout, in the frame it was found in: axes of the tag of the lowest number, origin
    in the middle of all tags' centres."""
    first = layout[min(layout)]
    out = np.eye(4)
    out[:3, :3] = first[:3, :3]
    out[:3, 3] = np.mean([pose[:3, 3] for pose in layout.values()], axis=0)
    return out


def read_object_from_tagged(path: Path) -> Transform:
    """A JSON file with a 4x4 matrix, bare or as `object_from_tagged` (also {"matrix": …})."""
    try:
        document = read_json(path)
        stored = document.get("object_from_tagged", document) if isinstance(document, dict) else document
        matrix = stored["matrix"] if isinstance(stored, dict) else stored
        return Transform.from_matrix("object", "tagged", np.array(matrix, dtype=np.float64))
    except (OSError, ValueError, KeyError, TypeError) as wrong:
        raise BadInput(f"{path} holds no 4x4 matrix object_from_tagged ({wrong})") from wrong


@dataclass(frozen=True, eq=False)
class Fit:
    """`rms_m`: how far the tags' corners are from the surface. `alike`: how many clearly different placements fit as
    well, the chosen one included (24 on a cube)."""

    object_from_tagged: Transform
    rms_m: float
    alike: int


def object_from_tagged_by_mesh(
    layout: Mapping[int, Float[Array, "4 4"]],
    sizes_m: Mapping[int, float],
    vertices_m: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
) -> Fit:
    """Lay the tags on the object's surface: corners on it, prints facing outwards. Point-to-plane alignment from many
    turns; on a symmetric object several fit alike, and the first is taken (Chamfer does not mind)."""
    corners = np.concatenate([sizes_m[i] * CORNERS_PUPIL @ T[:3, :3].T + T[:3, 3] for i, T in layout.items()])
    outward = np.repeat(np.array([-T[:3, 2] for T in layout.values()]), len(CORNERS_PUPIL), axis=0)
    surface = _Surface(vertices_m, faces)
    center = 0.5 * (vertices_m.min(axis=0) + vertices_m.max(axis=0))
    random = list(Rotation.random(120, random_state=np.random.default_rng(0)).as_matrix())
    rough = [_fitted(surface, corners, outward, start, center, 8) for start in cube_rotations() + random]
    few = sorted(rough, key=lambda f: f[1])[:12]
    fits = [_fitted(surface, corners, outward, pose[:3, :3], center, 25) for pose, _ in few]
    first = min(fits, key=lambda f: f[1])[0]
    fits += [_fitted(surface, corners, outward, S @ first[:3, :3], center, 8) for S in cube_rotations()]
    best = min(rms for _, rms in fits)
    alike: list[Array] = []
    for pose, rms in sorted(fits, key=lambda f: f[1]):
        if rms < 1.2 * best + 1e-4 and all(
            Rotation.from_matrix(pose[:3, :3].T @ other[:3, :3]).magnitude() > np.radians(5) for other in alike
        ):
            alike.append(pose)
    return Fit(Transform.from_matrix("object", "tagged", alike[0]), best, len(alike))


def cube_rotations() -> list[Float[Array, "3 3"]]:
    """The 24 turns that leave a cube as it is."""
    turns = []
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            R = np.zeros((3, 3))
            R[range(3), order] = signs
            if np.linalg.det(R) > 0:
                turns.append(R)
    return turns


class _Surface:
    """Nearest points of a mesh, and the outward normals there."""

    def __init__(self, vertices_m: Float[Array, "v 3"], faces: Int[Array, "f 3"]) -> None:
        import open3d as o3d

        self._scene = o3d.t.geometry.RaycastingScene()
        self._tensor = o3d.core.Tensor
        self._scene.add_triangles(self._tensor(vertices_m.astype(np.float32)), self._tensor(faces.astype(np.uint32)))

    def nearest(self, points_m: Float[Array, "n 3"]) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        found = self._scene.compute_closest_points(self._tensor(points_m.astype(np.float32)))
        return found["points"].numpy().astype(np.float64), found["primitive_normals"].numpy().astype(np.float64)

    def outside(self, points_m: Float[Array, "n 3"], directions: Float[Array, "n 3"]) -> bool:
        """Whether rays from all these points meet the surface an even number of times: any winding of faces will do."""
        rays = self._tensor(np.concatenate([points_m, directions], axis=1).astype(np.float32))
        return not bool((self._scene.count_intersections(rays).numpy() % 2).any())


def _fitted(
    surface: _Surface,
    corners: Float[Array, "n 3"],
    outward: Float[Array, "n 3"],
    start: Float[Array, "3 3"],
    center: Float[Array, "3"],
    turns: int,
) -> tuple[Float[Array, "4 4"], float]:
    pose = np.eye(4)
    pose[:3, :3] = start
    pose[:3, 3] = center - start @ corners.mean(axis=0)
    rms = np.inf
    for turning in [False] * 6 + [True] * turns:  # first into place: the tags' middle need not be the object's
        moved = corners @ pose[:3, :3].T + pose[:3, 3]
        points, normals = surface.nearest(moved)
        turned = outward @ pose[:3, :3].T
        normals = normals * np.where((normals * turned).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        off = ((moved - points) * normals).sum(axis=1)
        tilt = np.cross(turned, normals) * 0.03  # a print askew by a radian counts as 3 cm
        rms = float(np.sqrt((np.linalg.norm(moved - points, axis=1) ** 2).mean() + (tilt**2).sum(axis=1).mean()))
        A = np.concatenate([np.cross(moved, normals), normals], axis=1)
        lean = np.concatenate([0.03 * _lean(turned), np.zeros((3 * len(turned), 3))], axis=1)
        if turning:
            step = np.linalg.lstsq(np.concatenate([A, lean]), np.concatenate([-off, tilt.ravel()]), rcond=None)[0]
        else:
            step = np.concatenate([np.zeros(3), np.linalg.lstsq(normals, -off, rcond=None)[0]])
        step[:3] *= min(1.0, 0.3 / max(float(np.linalg.norm(step[:3])), 1e-9))
        R = Rotation.from_rotvec(step[:3]).as_matrix()
        pose[:3, 3] = R @ pose[:3, 3] + step[3:]
        pose[:3, :3] = R @ pose[:3, :3]
        if turning and np.linalg.norm(step) < 1e-7:
            break
    turned = outward @ pose[:3, :3].T
    centers = slice(len(CORNERS_PUPIL) - 1, None, len(CORNERS_PUPIL))
    above = (corners @ pose[:3, :3].T + pose[:3, 3] + (2 * rms + 0.001) * turned)[centers]
    return pose, rms if surface.outside(above, turned[centers] + 1e-4) else 1.0


def _lean(normals: Float[Array, "n 3"]) -> Float[Array, "m 3"]:
    """Derivative of (turn x normal) along the direction that brings a normal onto its target: rows of I - n n'."""
    return (np.eye(3) - normals[:, :, None] * normals[:, None, :]).reshape(-1, 3)
