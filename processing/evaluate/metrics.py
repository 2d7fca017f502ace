"""How good a track and a shape are against the truth, with the definitions that BundleSDF's benchmark uses.

ADD, ADD-S: area under the recall curve between 0 and 0.1 m, exact, in percent of all frames; a lost frame counts
as an infinite error. ADD-S runs from each true point to the nearest estimated one. Success: within 5 deg and 5 cm.
Chamfer: half the sum of the mean distances of 30,000 surface samples of either mesh to the other's surface.
Alignment of an estimate (whose object frame is arbitrary) happens before, in `align_first` (frame 0; where that is
lost the estimate is taken as it is) and `icp_align`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from recordings.geometry import rigid_fit, rotation_angle_rad

if TYPE_CHECKING:
    import trimesh

ADD_LIMIT_M = 0.1
POINTS = 2_000
SURFACE_POINTS = 30_000
FEW, LAST_STEPS = 3000, 8
"""Points that `icp_align` takes its first steps with, and steps that it then takes with all."""
FLIPPED_DEG = 45.0


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """Errors of every frame that has a true pose; infinite where the estimate is lost."""

    add_m: Float[Array, " n"]
    adds_m: Float[Array, " n"]
    rotation_deg: Float[Array, " n"]
    translation_m: Float[Array, " n"]

    @property
    def success(self) -> Float[Array, " n"]:
        """1 where a frame is within 5 degrees and 5 cm."""
        return self.within(5.0, 0.05)

    def within(self, rotation_deg: float, translation_m: float) -> Float[Array, " n"]:
        """1 where both errors are below the limits."""
        return ((self.rotation_deg < rotation_deg) & (self.translation_m < translation_m)).astype(np.float64)

    def only(self, chosen: Bool[Array, " n"]) -> FrameErrors:
        """The errors of some frames."""
        return FrameErrors(*(getattr(self, n)[chosen] for n in FIELDS))

    @staticmethod
    def pooled(parts: list[FrameErrors]) -> FrameErrors:
        """The frames of several tosses as one set."""
        return FrameErrors(*(np.concatenate([getattr(p, n) for p in parts]) for n in FIELDS))


FIELDS = ("add_m", "adds_m", "rotation_deg", "translation_m")


def align_first(estimate: Float[Array, "n 4 4"], truth: Float[Array, "n 4 4"]) -> Float[Array, "4 4"] | None:
    """estimated_object_from_true_object that makes the first frame with a true pose equal; None where the estimate has
    lost just that frame: no later one may stand in for it, else a late start would be forgiven."""
    known = np.flatnonzero(np.isfinite(truth).all(axis=(1, 2)))
    if len(known) == 0 or not np.isfinite(estimate[known[0]]).all():
        return None
    return np.linalg.inv(estimate[known[0]]) @ truth[known[0]]


def frame_errors(
    aligned: Float[Array, "n 4 4"], truth: Float[Array, "n 4 4"], points_m: Float[Array, "p 3"]
) -> FrameErrors:
    """Errors of aligned estimates in the frames that have a true pose."""
    from scipy.spatial import cKDTree

    rows = []
    for e, t in zip(aligned, truth):
        if not np.isfinite(t).all():
            continue
        if not np.isfinite(e).all():
            rows.append((np.inf,) * 4)
            continue
        estimated, true = points_m @ e[:3, :3].T + e[:3, 3], points_m @ t[:3, :3].T + t[:3, 3]
        add = float(np.linalg.norm(estimated - true, axis=1).mean())
        adds = float(cKDTree(estimated).query(true)[0].mean())
        angle = float(np.degrees(rotation_angle_rad(e[:3, :3] @ t[:3, :3].T)))
        rows.append((add, adds, angle, float(np.linalg.norm(e[:3, 3] - t[:3, 3]))))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return FrameErrors(*table.T)


def auc_percent(errors_m: Float[Array, " n"], limit_m: float = ADD_LIMIT_M) -> float:
    """Area under the recall curve of the errors between 0 and the limit, in percent; infinite ones never count.

    The exact sum over the sorted errors, without bins. As in YCB-Video's tools, the recall between two errors is the
    later one's: for n frames this is above the left-hand sum by at most 100 / n points.
    """
    if len(errors_m) == 0:
        return float("nan")
    ordered = np.sort(np.nan_to_num(errors_m, nan=np.inf, posinf=np.inf))
    recall = np.arange(1, len(ordered) + 1) / len(ordered)
    inside = ordered < limit_m
    if not inside.any():
        return 0.0
    at = np.concatenate([[0.0], ordered[inside], [limit_m]])
    height = np.concatenate([recall[inside], recall[inside][-1:]])
    return float(100 * (np.diff(at) * height).sum() / limit_m)


def surface_points(mesh: trimesh.Trimesh, count: int) -> Float[Array, "n 3"]:
    """Area-uniform samples of a surface, the same ones every time."""
    import trimesh

    return np.asarray(trimesh.sample.sample_surface(mesh, count, seed=0)[0], dtype=np.float64)


def distance_to_surface_m(mesh: trimesh.Trimesh, points_m: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """Distance of each point to the nearest triangle."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    tensor = open3d.core.Tensor
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    return scene.compute_distance(tensor(points_m.astype(np.float32))).numpy().astype(np.float64)


@dataclass(frozen=True)
class Chamfer:
    """Mean distances of two surfaces in metres, either way, and the share of points within 5 mm as an F-score."""

    estimate_to_truth_m: float
    truth_to_estimate_m: float
    f_score_5mm: float

    @property
    def cm(self) -> float:
        """Half the sum of both directions, in centimetres."""
        return 50 * (self.estimate_to_truth_m + self.truth_to_estimate_m)


def chamfer(estimate: trimesh.Trimesh, truth: trimesh.Trimesh, count: int = SURFACE_POINTS) -> Chamfer:
    """Distances of surface samples of either mesh to the other's surface."""
    there = distance_to_surface_m(truth, surface_points(estimate, count))
    back = distance_to_surface_m(estimate, surface_points(truth, count))
    precision, recall = float((there < 0.005).mean()), float((back < 0.005).mean())
    f_score = 2 * precision * recall / max(precision + recall, 1e-12)
    return Chamfer(float(there.mean()), float(back.mean()), f_score)


def icp_align(
    source_m: Float[Array, "n 3"], target_m: Float[Array, "m 3"], steps: int = 60, share: float = 0.95
) -> Float[Array, "4 4"]:
    """Rigid motion that lays source points on target points: point to point, the best `share` of the pairs.

    The first FEW source points find the way in at most `steps` steps, all of them the place in at most LAST_STEPS; the
    points' order must be random, as that of `surface_points` is.
    """
    from scipy.spatial import cKDTree

    tree, total = cKDTree(target_m), np.eye(4)
    for points, most in ((source_m[:FEW], steps), (source_m, LAST_STEPS)):
        moved = points @ total[:3, :3].T + total[:3, 3]
        for _ in range(most):
            distance, nearest = tree.query(moved)
            use = distance <= np.quantile(distance, share)
            total = rigid_fit(moved[use], target_m[nearest[use]]) @ total
            after = points @ total[:3, :3].T + total[:3, 3]
            way_m, moved = float(np.abs(after - moved).max()), after
            if way_m < 1e-7:
                break
    return total


def biggest_component(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The connected part with the largest area: what a person would keep when cleaning the mesh."""
    parts = mesh.split(only_watertight=False)
    return max(parts, key=lambda p: float(p.area)) if len(parts) > 1 else mesh


def volume_error_percent(estimate: trimesh.Trimesh, truth: trimesh.Trimesh) -> float | None:
    """Volume of the repaired estimate against the truth's, signed; None where the estimate cannot be closed."""
    closed = repaired(estimate)
    if closed is None or not truth.is_watertight:
        return None
    return float(100 * (closed.volume / truth.volume - 1))


def repaired(mesh: trimesh.Trimesh) -> trimesh.Trimesh | None:
    """The mesh with merged vertices, consistent winding and filled holes (trimesh); None where it stays open."""
    import trimesh

    out = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    trimesh.repair.fill_holes(out)
    trimesh.repair.fix_normals(out)
    return out if out.is_watertight else None


def rollout_errors(
    rolled: Float[Array, "t 4 4"],
    rolled_s: Float[Array, " t"],
    true: Float[Array, "n 4 4"],
    true_s: Float[Array, " n"],
    center_m: Float[Array, "3"],
) -> tuple[Float[Array, " u"], Float[Array, " u"]] | None:
    """Position (m, of the point `center_m` of the estimated object) and rotation (rad) error of each step after the
    first, NaN where the truth has ended. True poses are interpolated, and moved on the object's side so that they meet
    the rollout at its first pose. None where the truth does not reach the start."""
    from scipy.spatial.transform import Rotation

    from processing.motion.interpolate import straight_between

    known = np.isfinite(true[:, 0, 0])
    if known.sum() < 2 or not true_s[known][0] <= rolled_s[0] + 1e-6 <= true_s[known][-1] + 1e-6:
        return None
    times = true_s[known]
    met = straight_between(times, true[known], np.clip(rolled_s, times[0], times[-1]))
    met = met @ (np.linalg.inv(met[0]) @ rolled[0])
    place = [p[:, :3, :3] @ center_m + p[:, :3, 3] for p in (rolled, met)]
    position = np.linalg.norm(place[0] - place[1], axis=1)
    rotation = Rotation.from_matrix(np.swapaxes(met[:, :3, :3], 1, 2) @ rolled[:, :3, :3]).magnitude()
    over = rolled_s > times[-1] + 0.1 * (rolled_s[1] - rolled_s[0])
    position[over] = rotation[over] = np.nan
    return position[1:], rotation[1:]
