"""A learned shape as the tracker's model: the shape drawn from all sides, and the object located in it anew.

The tracker's model is a set of views at their poses; a shape becomes such views by ray casting, so that everything that
aligns a frame to other frames aligns it to the shape as well. What no camera saw of the shape has neither depth nor
colour in them, and a shape without colours has none anywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.features.sift import relative_motions
from processing.motion import se3_kernels as se3
from processing.motion.rotation_grid import all_turns
from processing.sensor import view_layout as lay
from processing.sensor.rectification import Rectification
from processing.sensor.view import Crop
from processing.track import kernels as k
from processing.track.beam import BeamConfig, Candidate, Hypothesis, Scene, merged
from processing.track.keyframes import Sides
from processing.track.schedule import Schedule, rows
from processing.track.windows import WindowConfig, change_costs, pair_costs
from recordings.errors import BadInput
from recordings.tracks import ObjectShape


@dataclass(frozen=True)
class ShapeConfig:
    """How a shape is drawn and sought."""

    directions: int = 42
    """Views of the shape, spread evenly over all directions."""
    turns: int = 480
    """Orientations tried in a frame."""
    tried: int = 32
    """The best of them that are aligned coarsely ..."""
    starts: int = 10
    """... and of those, the ones that tracking may start from and paths may pass through."""
    spread: float = 0.12
    """One that fits worse than the best by more than this is none."""
    seek: Schedule = ((1, 6, 0.015, 0.6, 0.012, 0.12),)
    searched: int = 12
    """Frames of a toss (stretches in which nothing moves count as one) in which all orientations are tried, spread
    evenly; to the others the poses of those beside them are carried. With 32, five tosses of choose-002, 003 and 034
    come out within .2 degrees of where they do with 12, in a fifth to a half more time."""
    unseen: float = 0.1
    """Cost of a point of one frame that the next one does not see: else a body would rather show a new face each time
    than one that has to agree. About what a point costs that fits; from .07 to .2 the paths are alike."""


@dataclass(frozen=True, eq=False)
class ShapeViews:
    """Drawn views of a shape and their poses, camera_from_object (m, 4, 4)."""

    crops: tuple[Crop, ...]
    poses: Float[Array, "m 4 4"]


def center_of(shape: ObjectShape) -> Float[Array, "3"]:
    """Center of the shape's box, object frame."""
    return np.asarray(0.5 * (shape.vertices_m.min(0) + shape.vertices_m.max(0)))


def shape_views(
    shape: ObjectShape, crops: list[Crop | None], rectified: Rectification, config: ShapeConfig
) -> ShapeViews:
    """The shape drawn from all sides at the distance that the frames' crops show the object at."""
    if len(shape.faces) == 0:
        raise BadInput("the given shape has no faces; wanted a triangle mesh")
    seen = [
        float(np.median(c.depth_m[c.mask & (c.depth_m > 0)])) for c in crops if c and (c.mask & (c.depth_m > 0)).any()
    ]
    size_m = float(np.linalg.norm(np.ptp(shape.vertices_m, axis=0)))
    distance_m = max(float(np.median(seen)) if seen else 0.8, 1.2 * size_m)
    poses = _around(center_of(shape), distance_m, config.directions)
    draw = _Painter(shape, rectified)
    return ShapeViews(tuple(draw.crop(pose, len(crops) + i) for i, pose in enumerate(poses)), poses)


def _around(center_m: Float[Array, "3"], distance_m: float, count: int) -> Float[Array, "m 4 4"]:
    """Poses that show the object from `count` directions, its center on the optical axis."""
    n = np.arange(count) + 0.5
    z, phi = 1 - 2 * n / count, np.pi * (1 + 5**0.5) * n
    r = np.sqrt(1 - z * z)
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, direction in zip(poses, np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)):
        right = np.cross(direction, [0.0, 0.0, 1.0] if abs(direction[2]) < 0.9 else [1.0, 0.0, 0.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(-direction, right), -direction])
        pose[:3, 3] = np.array([0.0, 0.0, distance_m]) - pose[:3, :3] @ center_m
    return poses


class _Painter:
    """Draws a shape's depth and colours as the ideal pinhole sees them, by one ray a pixel."""

    def __init__(self, shape: ObjectShape, rectified: Rectification) -> None:
        import open3d as o3d

        self._shape, self._rectified, self._core = shape, rectified, o3d.core
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices, faces = shape.vertices_m.astype(np.float32), shape.faces.astype(np.uint32)
        self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces))

    def crop(self, pose: Float[Array, "4 4"], position: int, margin_px: int = 14) -> Crop:
        c = self._rectified.camera
        points = self._shape.vertices_m @ pose[:3, :3].T + pose[:3, 3]
        pixels = points[:, :2] / points[:, 2:] * self._rectified.focal + self._rectified.center
        low = np.floor(pixels.min(0)).astype(int) - margin_px
        high = np.ceil(pixels.max(0)).astype(int) + margin_px + 1
        u, v = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
        rays = np.stack([(u - c.cx) / c.fx, (v - c.cy) / c.fy, np.ones(u.shape)], -1) @ pose[:3, :3]
        origin = np.broadcast_to(-pose[:3, :3].T @ pose[:3, 3], rays.shape)
        hit = self._scene.cast_rays(self._core.Tensor(np.concatenate([origin, rays], -1).astype(np.float32)))
        depth = hit["t_hit"].numpy()
        mask = np.isfinite(depth)
        color, known = self._painted(hit["primitive_ids"].numpy(), hit["primitive_uvs"].numpy(), mask)
        depth = np.where(mask & known, depth, 0).astype(np.float32)
        foreign = mask & (np.ones_like(mask) if self._shape.vertex_rgb is None else ~known)
        corner = (int(low[0]), int(low[1]))
        hidden = np.zeros_like(mask)
        return Crop(position, corner, mask, depth, color, hidden, None, 0.0, foreign if foreign.any() else None)

    def _painted(self, triangle: Array, uv: Array, mask: Array) -> tuple[Array, Array]:
        """Colour 0..1 of each pixel, and whether a camera saw the surface there."""
        corners, uv = self._shape.faces[triangle[mask]], uv[mask]
        color, known = np.zeros((*mask.shape, 3), dtype=np.float32), mask.copy()
        if self._shape.vertex_rgb is None:
            color[mask] = 128 / 255
        else:
            share = np.stack([1 - uv.sum(-1), uv[:, 0], uv[:, 1]], -1)
            color[mask] = np.einsum("pcr,pc->pr", self._shape.vertex_rgb[corners] / 255.0, share)
        if self._shape.observed is not None:
            known[mask] = self._shape.observed[corners].all(-1)
        return color, known


def located(scene: Scene, view: int, model: ShapeViews, beam: BeamConfig, config: ShapeConfig) -> list[Candidate]:
    """Poses at which the shape fits what one frame shows, best first: from feature matches with the drawn views, and
    from a grid over all orientations. Several, where the shape looks alike from several sides."""
    drawn = _Drawn(scene, model, beam)
    tried = drawn.fitted(view, _grid(scene, view, config), config.seek)
    tried += drawn.fitted(view, drawn.by_features(view), beam.coarse)
    rough = merged(sorted(tried, key=lambda c: c.cost)[: 4 * config.tried], beam)[: config.tried]
    coarse = merged(drawn.fitted(view, [c.pose for c in rough], beam.coarse), beam)
    fine = merged(drawn.fitted(view, [c.pose for c in coarse[: 2 * config.starts]], beam.fine), beam)
    good = [c for c in fine if c.fit < beam.lost and c.fit < fine[0].fit + config.spread]
    return good[: config.starts]


def path_through(
    scene: Scene, model: ShapeViews, beam: BeamConfig, windows: WindowConfig, config: ShapeConfig,
    report: Callable[[float], None] = lambda _: None,
) -> Float[Array, "n 4 4"]:  # fmt: skip
    """camera_from_object of a toss's frames on a shape: some are located by themselves, what is found is carried to
    those beside them, and the cheapest path through all of it taken (Viterbi) by how the frames fit the shape, what
    pairs of them say of the motion between them, and its changes. No pose rests on that of the frame before, so that no
    error is carried on. NaN where nothing fits. `report` is told the share of the work that is done."""
    n = len(scene.times_s)
    runs = scene.store.still_runs(np.array([scene.store.usable(i) for i in range(n)]))
    found = _everywhere(scene, [run[len(run) // 2] for run in runs], model, beam, config, report)
    runs = [run for run, here in zip(runs, found, strict=True) if here]
    found = [here for here in found if here]
    poses = np.full((n, 4, 4), np.nan)
    for run, pose in zip(runs, _cheapest(scene, runs, found, windows, config), strict=True):
        poses[run] = pose
    return poses


def _everywhere(
    scene: Scene, views: list[int], model: ShapeViews, beam: BeamConfig, config: ShapeConfig,
    report: Callable[[float], None],
) -> list[list[Candidate]]:  # fmt: skip
    """Poses of each of these frames at which it fits the shape: found there, or beside it and carried on, forward and
    then backward."""
    drawn = _Drawn(scene, model, beam)
    searched = np.linspace(0, len(views) - 1, min(config.searched, len(views))).astype(int)
    found: list[list[Candidate]] = [[] for _ in views]
    for done, place in enumerate(searched):
        report(done / len(searched))
        found[place] = located(scene, views[place], model, beam, config)

    def carry(one: int, other: int) -> None:
        shift = scene.store.center_m[views[other]] - scene.store.center_m[views[one]]
        moved = [_moved(c.pose, shift) for c in found[one]]
        rough = merged(drawn.fitted(views[other], moved, beam.coarse), beam)
        fine = drawn.fitted(views[other], [c.pose for c in rough], beam.fine)
        every = merged([*found[other], *fine], beam)
        found[other] = [c for c in every if c.fit < min(beam.lost, every[0].fit + config.spread)][: config.starts]

    for one, other in pairwise(range(len(views))):
        carry(one, other)
    for one, other in pairwise(range(len(views) - 1, -1, -1)):
        carry(one, other)
    return found


def _moved(pose: Float[Array, "4 4"], shift: Float[Array, "3"]) -> Float[Array, "4 4"]:
    out = pose.copy()
    out[:3, 3] += shift
    return out


def _cheapest(
    scene: Scene, runs: list[list[int]], found: list[list[Candidate]], windows: WindowConfig, config: ShapeConfig
) -> list[Float[Array, "4 4"]]:
    """One pose of each run of frames."""
    if len(runs) < 2:
        return [here[0].pose for here in found]
    distance_m = float(np.median(np.linalg.norm(scene.store.center_m[[run[0] for run in runs]], axis=1)))
    row = rows(windows.compared, distance_m)[0]
    fits = [len(run) * np.array([c.fit for c in here]) for run, here in zip(runs, found, strict=True)]
    steps = [[[two.pose @ se3.inverse(one.pose) for two in after] for one in here] for here, after in pairwise(found)]
    spans_s = np.array([scene.times_s[after[0]] - scene.times_s[run[-1]] for run, after in pairwise(runs)])

    def pairs(step: int) -> Float[Array, "a b"]:
        every = [motion for motions in steps[step] for motion in motions]
        costs = pair_costs(scene, runs[step][-1], runs[step + 1][0], every, row, config.unseen)
        return costs.reshape(len(found[step]), -1)

    total, back = fits[0][:, None] + fits[1][None] + pairs(0), []
    for step in range(1, len(steps)):
        changes = np.zeros((len(found[step - 1]), len(found[step]), len(found[step + 1])))
        if len(runs[step]) == 1:  # where it stood still the motions before and after have nothing to do with each other
            free = scene.free([runs[step - 1][-1], *runs[step], runs[step + 1][0]])
            for m, twos in enumerate(steps[step]):
                ones = [motions[m] for motions in steps[step - 1]]
                changes[:, m] = change_costs(ones, twos, spans_s[step - 1 : step + 1], windows, free)
        paths = total[:, :, None] + changes
        back.append(paths.argmin(axis=0))
        total = paths.min(axis=0) + fits[step + 1][None] + pairs(step)
    before, last = (int(c) for c in np.unravel_index(int(total.argmin()), total.shape))
    chosen = [last, before]
    for came_from in back[::-1]:
        chosen.append(int(came_from[chosen[-1], chosen[-2]]))
    return [here[c].pose for here, c in zip(found, chosen[::-1], strict=True)]


def with_model(h: Hypothesis, model: ShapeViews) -> Hypothesis:
    """The hypothesis with the model's views (after the frames') among its keyframes."""
    n, m = len(h.costs), len(model.poses)
    keys = (*range(n, n + m), *h.keyframes)
    return replace(h, poses=np.concatenate([h.poses, model.poses]), keyframes=keys)


def _grid(scene: Scene, view: int, config: ShapeConfig) -> list[Float[Array, "4 4"]]:
    """All orientations, the shape's center somewhat behind what is seen."""
    row = scene.store.table[view]
    points = scene.store.samples[row[lay.FIRST] : row[lay.FIRST] + row[lay.COUNT], :3].astype(np.float64)
    seen = points.mean(0)
    behind = seen * (1 + 0.3 * float(np.ptp(points[:, :2], axis=0).mean()) / float(np.linalg.norm(seen)))
    out = []
    for turn in all_turns(config.turns):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, behind - turn @ scene.center_m
        out.append(pose)
    return out


class _Drawn:
    """The drawn views, for single frames' poses to be aligned to those that look from their side."""

    def __init__(self, scene: Scene, model: ShapeViews, beam: BeamConfig) -> None:
        n = len(scene.times_s)
        self._scene, self._beam, self._views = scene, beam, range(n, n + len(model.poses))
        self._poses = np.concatenate([np.full((n, 4, 4), np.nan), model.poses])
        self._sides = Sides(self._poses, tuple(self._views), n, scene.center_m)

    def by_features(self, view: int) -> list[Float[Array, "4 4"]]:
        """Poses that matches of a frame's features with theirs speak for."""
        scene, here = self._scene, self._scene.described(view)
        return [
            motion.other_from_one @ self._poses[j]
            for j in self._views
            for motion in relative_motions(scene.matcher, scene.described(j), here, self._beam.ransac, seed=j, most=1)
        ]

    def fitted(self, view: int, poses: Iterable[Float[Array, "4 4"]], schedule: Schedule) -> list[Candidate]:
        """Each pose of a frame aligned to the drawn views."""
        store = self._scene.store
        row = rows(schedule, float(np.linalg.norm(store.center_m[view])))
        free, out = (np.zeros(6), np.eye(4)), []
        for pose in poses:
            refs = self._sides.references(pose, self._beam.keyframes)
            aligned, _, fit, on, _ = k.align_view(
                np.ascontiguousarray(pose), view, refs, np.ascontiguousarray(self._poses[refs]), store.maps,
                store.samples, store.table, store.rectified.focal, store.rectified.center, row, *free,
            )  # fmt: skip
            good = bool(np.isfinite(aligned).all())
            out.append(Candidate(aligned if good else pose, float(fit) if good else 1.0, 0.0, float(on), "located"))
        return out
