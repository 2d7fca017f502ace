"""A rigid body with tags whose layout is not known, seen by calibrated or uncalibrated cameras: layout, poses, cameras.

    solved = solve_tagged_object(models, detections, size_m, camera_from_rig)

Tags that are seen together give their relative pose (of each tag's two possible poses the pair that many images agree
on), and the layout tag by tag. From it follow the body's poses, from these the cameras where they are not known; one
bundle adjustment refines everything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from calibration.cameras.bundle import Observations, Scene, Solved, adjust
from calibration.cameras.extrinsics import whitening
from calibration.cameras.pnp import connected, most_agreed, poses_of_points, rms_px
from calibration.cameras.poses import inverse_poses
from calibration.cameras.targets import CORNERS
from calibration.tags.detect import TagDetection
from recordings.errors import BadInput
from recordings.geometry import CameraModel

Candidates = list[Float[Array, "4 4"]]
LEAST_VIEWS = 3
WRONG_TAG_PX = 4.0
"""Detections that fit no better than this are left out and counted."""


@dataclass(frozen=True, eq=False)
class TaggedObject:
    """`tag_ids[g]` is piece g of `solved.scene` (its first one is the body's frame); view k is instant `instants[k]`.

    `left_out`: detections that fit no pose. `undetermined_tags`: seen, but never together with the others.
    """

    cameras: tuple[str, ...]
    tag_ids: tuple[int, ...]
    instants: Int64[Array, " v"]
    rig_from_body: Float[Array, "v 4 4"]
    body_from_tag: Mapping[int, Float[Array, "4 4"]]
    solved: Solved
    seen: Observations
    left_out: int
    undetermined_tags: tuple[int, ...]


def solve_tagged_object(
    models: Mapping[str, CameraModel],
    detections: Mapping[str, Sequence[Sequence[TagDetection]]],
    size_m: Mapping[int, float],
    camera_from_rig: Mapping[str, Float[Array, "4 4"]] | None = None,
) -> TaggedObject:
    """`detections[camera][k]`: the body's tags at instant k (all cameras exposed together). `size_m` by tag id.

    Without `camera_from_rig` the first camera by name is the rig and the others are solved too. Raises BadInput where
    nothing can be solved.
    """
    names = sorted(models)
    candidates = {n: [_candidates(models[n], tags, size_m) for tags in detections[n]] for n in names}
    layout, undetermined = _layout_tag_by_tag([of_view for n in names for of_view in candidates[n]])
    poses = {
        n: [
            _body_poses(models[n], of_view, tags, layout, size_m) for of_view, tags in zip(candidates[n], detections[n])
        ]
        for n in names
    }
    fixed = camera_from_rig is not None
    cameras = np.array([camera_from_rig[n] for n in names]) if camera_from_rig else connected(names, poses)
    views, known = _views(names, cameras, poses)
    ids = tuple(layout)
    scene = Scene(
        tuple(models[n] for n in names),
        cameras,
        views,
        np.array([layout[i] for i in ids]),
        np.arange(len(names)) > (len(names) if fixed else 0),
        known,
        np.arange(len(ids)) > 0,
        np.zeros(len(names), dtype=bool),
        np.ones(len(ids)),
        np.zeros(len(ids), dtype=bool),
    )
    seen = _observations(names, ids, detections, size_m, known)
    solved, seen, left_out = _without_outliers(scene, seen)
    instants = np.flatnonzero(solved.scene.free_views)
    return TaggedObject(
        tuple(names),
        ids,
        instants,
        solved.scene.rig_from_body[instants],
        {i: solved.scene.body_from_piece[g] for g, i in enumerate(ids)},
        solved,
        seen,
        left_out,
        undetermined,
    )


def _candidates(model: CameraModel, tags: Sequence[TagDetection], size_m: Mapping[int, float]) -> dict[int, Candidates]:
    """camera_from_tag by id; both solutions where the second explains the corners about as well."""
    out = {}
    for tag in tags:
        if tag.tag_id not in size_m:
            continue
        found = poses_of_points(model, size_m[tag.tag_id] * CORNERS, tag.corners_px)
        if found:
            out[tag.tag_id] = [pose for pose, error in found if error < 3 * found[0][1] + 0.5]
    return out


def _layout_tag_by_tag(
    candidates: Sequence[Mapping[int, Candidates]],
) -> tuple[dict[int, Float[Array, "4 4"]], tuple[int, ...]]:
    """body_from_tag, the body being the tag seen most often; and the tags that nothing connects to it."""
    counts: dict[int, int] = {}
    for of_view in candidates:
        for tag in of_view:
            counts[tag] = counts.get(tag, 0) + 1
    if not counts:
        raise BadInput(
            "no tags of the object in any image: wanted tags of the stated family and ids; see `toss-calibrate`"
        )
    layout = {max(counts, key=lambda t: counts[t]): np.eye(4)}
    while True:
        best: tuple[int, int, Array] | None = None
        for new in counts:
            if new in layout:
                continue
            relative = [_relative(of_view, layout, new) for of_view in candidates if new in of_view]
            agreed = most_agreed([r for r in relative if r], 6.0, 0.012)
            if agreed is not None and (best is None or agreed[1] > best[0]):
                best = (agreed[1], new, agreed[0])
        if best is None or best[0] < LEAST_VIEWS:
            return layout, tuple(sorted(set(counts) - set(layout)))
        layout[best[1]] = best[2]


def _relative(of_view: Mapping[int, Candidates], layout: Mapping[int, Array], new: int) -> Candidates:
    """body_from_new as one image has it, by every tag already placed."""
    out = []
    for old, place in layout.items():
        for camera_from_old in of_view.get(old, ()):
            back = place @ inverse_poses(camera_from_old)
            out += [back @ pose for pose in of_view[new]]
    return out


def _body_poses(
    model: CameraModel,
    of_view: Mapping[int, Candidates],
    tags: Sequence[TagDetection],
    layout: Mapping[int, Array],
    size_m: Mapping[int, float],
) -> Candidates:
    """camera_from_body of one image: of all tags' candidates those that explain all tags seen about best."""
    mine = [t for t in tags if t.tag_id in layout and t.tag_id in of_view]
    if not mine:
        return []
    points = np.concatenate([_corners_m(layout[t.tag_id], size_m[t.tag_id]) for t in mine])
    pixels = np.concatenate([t.corners_px for t in mine])
    tried = [pose @ inverse_poses(layout[t.tag_id]) for t in mine for pose in of_view[t.tag_id]]
    errors = np.array([rms_px(model, pose, points, pixels) for pose in tried])
    errors = np.where(np.isfinite(errors), errors, np.inf)
    limit = 2 * errors.min() + 0.5
    return [tried[k] for k in np.argsort(errors) if errors[k] <= limit][:4]


def _corners_m(place: Float[Array, "4 4"], size_m: float) -> Float[Array, "4 3"]:
    return size_m * CORNERS @ place[:3, :3].T + place[:3, 3]


def _views(
    names: Sequence[str], cameras: Float[Array, "c 4 4"], poses: Mapping[str, Sequence[Candidates]]
) -> tuple[Float[Array, "v 4 4"], Array]:
    """rig_from_body per instant: what most cameras agree on, else the best candidate of one of them."""
    count = max(len(p) for p in poses.values())
    views, known = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, dtype=bool)
    back = inverse_poses(cameras)
    for k in range(count):
        groups = [[back[c] @ pose for pose in poses[n][k]] for c, n in enumerate(names) if poses[n][k]]
        agreed = most_agreed(groups, 12.0, 0.04)
        if agreed is not None:
            views[k], known[k] = (agreed[0] if agreed[1] > 1 else groups[0][0]), True
    return views, known


def _observations(
    names: Sequence[str],
    ids: Sequence[int],
    detections: Mapping[str, Sequence[Sequence[TagDetection]]],
    size_m: Mapping[int, float],
    known: Array,
) -> Observations:
    rows = [
        (c, k, ids.index(tag.tag_id), tag)
        for c, n in enumerate(names)
        for k, tags in enumerate(detections[n])
        for tag in tags
        if tag.tag_id in ids and known[k]
    ]
    if not rows:
        raise BadInput("the object's tags are in no two images that agree; nothing can be solved")
    return Observations(
        np.repeat([r[0] for r in rows], 4),
        np.repeat([r[1] for r in rows], 4),
        np.repeat([r[2] for r in rows], 4),
        np.concatenate([size_m[r[3].tag_id] * CORNERS for r in rows]),
        np.concatenate([r[3].corners_px for r in rows]),
        whitening(np.concatenate([r[3].covariance_px2 for r in rows])),
    )


def _without_outliers(scene: Scene, seen: Observations) -> tuple[Solved, Observations, int]:
    """Solve, drop detections that fit nothing, solve again."""
    solved = adjust(scene, seen)
    worst = np.sqrt((solved.residual_px**2).sum(axis=1).reshape(-1, 4).mean(axis=1))
    keep = np.repeat(worst < WRONG_TAG_PX, 4)
    if not keep.all():
        seen = seen.chosen(keep)
        free_views = np.isin(np.arange(len(scene.free_views)), seen.view)
        free_pieces = solved.scene.free_pieces & np.isin(np.arange(len(scene.free_pieces)), seen.piece)
        solved = adjust(replace(solved.scene, free_views=free_views, free_pieces=free_pieces), seen)
    return solved, seen, int((~keep).sum() // 4)
