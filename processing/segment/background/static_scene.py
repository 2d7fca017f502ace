"""The scene without the object: what a camera that stands still sees behind everything that moves."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray as Array

from processing.engine.parts import in_parts
from processing.segment.background.channels import most_of_channels
from processing.segment.background.moving_camera import refuse_moving_camera
from processing.sensor.noise import stereo_sigma_m
from recordings.constants import MAD_TO_SIGMA_SHORT
from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.records import RgbdFrame
from recordings.results.stage_files import stage_arrays
from recordings.tracks import RigCalibration

TABLE_M = 0.008
"""What lies so near to the calibrated table (or 4 standard deviations of depth) is the table."""


@dataclass(frozen=True)
class SceneSettings:
    """How the static scene is learned."""

    frames: int = 48
    """Frames sampled evenly over the session."""
    far_share: float = 0.85
    """The scene lies at this quantile of the depths seen by a pixel: things in front of it come and go."""
    seen_share: float = 0.4
    """A pixel whose depth agrees with the scene in fewer frames has no scene depth."""
    table_observations: int = 3
    """What stands in front of the table is not the scene where the table was seen in so many frames."""
    stands_m: float = TABLE_M
    """What is higher above the table (or 4 standard deviations of depth) stands on it."""
    always_share: float = 0.97
    """What returned a pixel's depth more often than this was always there."""
    arrived_share: float = 0.1
    """A thing came to where it stands when the table was seen at other times beneath so much of it."""
    left_share: float = 0.8
    """It has left where so much of that table is seen."""
    object_m: float = 0.1
    """Nearer and farther than that part the thing reaches no more than this."""
    returns_share: float = 0.3
    """A pixel without scene depth that gave a return in more frames than this is unknown: something was often there."""
    no_return_share: float = 0.2
    no_return_color: float = 10.0
    """It is known all the same where it gave none in so many frames and then showed one colour (sigma, 0..255)."""
    least_observations: int = 2
    """A pixel that was free of the robot in fewer frames is learned as it is: the robot's base never leaves it."""
    robot_margin_px: int = 14
    """Around the robot as calibrated: its place may be off by some millimetres and tenths of a degree."""
    held_m: float = 0.18
    """What the gripper holds lies within this distance of the tool."""
    still_share: float = 0.5
    """The camera moved when the scene is known in a smaller share of the pixels."""


@dataclass(frozen=True, eq=False)
class StaticScene:
    """Depth (0 where the scene gives no return) and colour of the empty scene, with their noise.

    `known` marks pixels whose colour is the scene's; `table_depth_m` is the depth of the table plane along each pixel's
    ray (0 where the ray does not meet it, or no plane is known).
    """

    depth_m: Float32[Array, "h w"]
    depth_sigma_m: Float32[Array, "h w"]
    color_rgb: Float32[Array, "h w 3"]
    color_sigma: Float32[Array, "h w"]
    known: Bool[Array, "h w"]
    table_depth_m: Float32[Array, "h w"]

    @property
    def unknown(self) -> Bool[Array, "h w"]:
        """Where neither its colour is known nor where it lies: before a table that is, depth decides."""
        return ~self.known & (self.depth_m == 0)

    def write(self, folder: Path) -> None:
        """Into a stage's folder, as scene.npz."""
        np.savez(folder / "scene.npz", **vars(self))

    @staticmethod
    def read(folder: Path) -> StaticScene:
        """From a stage's folder."""
        with stage_arrays(folder / "scene.npz") as stored:
            return StaticScene(**stored)


def sample_positions(counts: Sequence[int], wanted: int) -> list[tuple[int, int]]:
    """(position in `counts`, frame position), spread evenly over all tosses, each with its first and last frame."""
    each = max(2, wanted // max(1, len(counts)))
    chosen: list[tuple[int, int]] = []
    for i, count in enumerate(counts):
        if count:
            chosen += [(i, int(p)) for p in np.unique(np.linspace(0, count - 1, min(each, count)).round())]
    return chosen


def learn_scene(
    frames: Iterable[RgbdFrame],
    table_depth_m: Float32[Array, "h w"] | None,
    settings: SceneSettings,
    hidden: Sequence[Bool[Array, "h w"]] | None = None,
    tosses: Sequence[int] | None = None,
) -> StaticScene:
    """Learn the scene from frames spread over the session. Raises BadInput where the camera moved between them.

    `hidden`: pixels of each of these frames at which something known (the robot) may stand in front of the scene;
    `tosses`: which toss each frame belongs to, in time order within a toss (None: all are of one).
    """
    colors, depths = [], []
    for frame in frames:
        colors.append(frame.color_rgb)
        depths.append(frame.depth_m)
    if not colors:
        raise BadInput("no frame to learn the static scene from; wanted a session with colour and depth of d455")
    if len({c.shape for c in colors}) > 1:
        raise BadInput(f"the images change their size within the session: {sorted({c.shape for c in colors})}")
    height, width = depths[0].shape
    table = np.zeros((height, width), dtype=np.float32) if table_depth_m is None else table_depth_m
    refuse_moving_camera(colors, hidden)

    def learn_rows(part: slice) -> Any:
        covered = np.zeros((len(depths), len(depths[0][part]), width), dtype=bool)
        if hidden is not None:
            covered = np.stack([h[part] for h in hidden])
        return _learn_rows([c[part] for c in colors], [d[part] for d in depths], covered, table[part], settings)

    rows = in_parts(learn_rows, height, 40)
    depth, sigma, color, color_sigma, known, share = (np.concatenate(part) for part in zip(*rows))
    never_bare = np.zeros_like(known)
    ends = [depths[i] for i in sorted({i for pair in _ends(tosses, len(depths)) for i in pair})]
    shown = [_shows(end, depth) for end in ends]
    for end, itself in zip(ends, shown):
        never_bare |= _always_covered(end, itself, shown, depth, share, table, settings)
    known = ~_without_thin_lines(~known | never_bare)
    if known.mean() < settings.still_share:
        raise BadInput(
            f"only {100 * known.mean():.0f} % of the pixels show a static scene; this camera seems to move. "
            "Masks need a camera that stands still: record from a fixed one"
        )
    depth = np.where(known & ~never_bare, depth, table)
    return StaticScene(depth, sigma, color, color_sigma, known, table)


def _ends(tosses: Sequence[int] | None, count: int) -> list[tuple[int, int]]:
    """The first and the last frame of every toss."""
    whose = np.zeros(count, dtype=np.int64) if tosses is None else np.asarray(tosses)
    starts = np.flatnonzero(np.diff(whose, prepend=whose[0] - 1))
    return list(zip(starts.tolist(), [*(starts[1:] - 1).tolist(), count - 1]))


def _shows(depth_m: Float32[Array, "h w"], scene_m: Float32[Array, "h w"]) -> Bool[Array, "h w"]:
    """Pixels at which a frame shows the learned scene."""
    return (depth_m > 0) & (np.abs(depth_m - scene_m) < np.maximum(0.006, 5 * stereo_sigma_m(scene_m)))


def _always_covered(
    depth_m: Float32[Array, "h w"],
    itself: Bool[Array, "h w"],
    shown: Sequence[Bool[Array, "h w"]],
    scene_m: Float32[Array, "h w"],
    share: Float32[Array, "h w"],
    table_m: Float32[Array, "h w"],
    settings: SceneSettings,
) -> Bool[Array, "h w"]:
    """Pixels whose learned scene is the object itself, as it stands above the table in a toss's first or last frame:
    something else was in front of them at all other times, so what is beneath was never seen.

    What stands there in that frame is no part of the scene where the table was seen beneath much of it at other times;
    the rest of it, which was not always there, isn't either: but for what stays once the thing has left (a can behind
    it). `itself`, `shown`: where this frame and each end of a toss show the learned scene.
    """
    import cv2

    lift = np.maximum(settings.stands_m, 4 * stereo_sigma_m(table_m))
    stands = (depth_m > 0) & (table_m - depth_m > lift)
    above = (scene_m > 0) & (table_m - scene_m > lift)
    uncertain = stands & above & (share < settings.always_share) & itself
    out = np.zeros_like(stands)
    if not uncertain.any():
        return out
    arrived = cv2.morphologyEx((stands & (scene_m > 0) & ~above).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3))) > 0
    _, labels = cv2.connectedComponents(stands.astype(np.uint8), connectivity=4)
    for k in np.unique(labels[uncertain]):
        thing = np.asarray(labels == k)
        came = thing & arrived
        if came.sum() < max(settings.arrived_share * thing.sum(), 1):
            continue
        near, far = np.quantile(depth_m[came], (0.02, 0.98))
        inside = (depth_m > near - settings.object_m) & (depth_m < far + settings.object_m)
        stays = sum((end for end in shown if end[came].mean() > settings.left_share), np.zeros_like(thing))
        out |= thing & uncertain & inside & ~stays
    solid = cv2.morphologyEx(out.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))  # no flickering edges
    grown = cv2.dilate(solid, np.ones((5, 5), np.uint8)) > 0
    return grown & (above | (scene_m == 0))


def _without_thin_lines(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """Depth flickers along edges; what was often hidden is a region."""
    import cv2

    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8)) > 0


def _learn_rows(
    colors: Sequence[Array],
    depths: Sequence[Array],
    hidden: Bool[Array, "n h w"],
    table_m: Float32[Array, "h w"],
    settings: SceneSettings,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Scene depth, its noise, colour, its noise, whether known, and the share of returns that were the scene, for some
    rows, from what is not hidden."""
    never = (~hidden).sum(0) < settings.least_observations
    hidden = hidden & ~never  # what stands there for the whole session is a part of the scene
    z = np.where(hidden, np.float32(0), np.stack(depths))
    observations = np.maximum((~hidden).sum(0), 1)
    seen = z > 0
    without = (~seen & ~hidden).sum(0) / observations
    far = _farthest(z, seen, settings)
    agrees = seen & (np.abs(z - far) < np.maximum(0.006, 5 * stereo_sigma_m(far)))
    near_table_m = np.maximum(0.006, 3 * stereo_sigma_m(table_m))
    on_table = seen & (np.abs(z - table_m) < near_table_m)
    # where the table was seen it is the scene, however long an object stood before it or its shadow hid the depth
    beneath = (on_table.sum(0) >= settings.table_observations) & (far < table_m + near_table_m)
    agrees = np.where(beneath, on_table, agrees)
    share = agrees.sum(0) / observations
    # what stands above the table for a while only may be the object at rest
    seldom = (share > 1 - settings.far_share) & (without < settings.no_return_share) & (far > table_m - near_table_m)
    valid = beneath | (share >= settings.seen_share) | seldom
    depth = _masked_median(z, agrees)
    sigma = MAD_TO_SIGMA_SHORT * _masked_median(np.abs(z - depth), agrees)
    empty = (agrees | (~seen & ~valid[None])) & ~hidden
    color, color_sigma = _color_median(np.stack(colors), empty)
    depth, sigma = np.where(valid, depth, 0), np.where(valid, sigma, 0)
    empty_alike = ~valid & (without >= settings.no_return_share) & (color_sigma < settings.no_return_color)
    known = valid | (seen.sum(0) / observations < settings.returns_share) | empty_alike
    share = agrees.sum(0) / np.maximum(seen.sum(0), 1)
    return depth.astype(np.float32), sigma.astype(np.float32), color, color_sigma, known, share.astype(np.float32)


def _farthest(z: Float32[Array, "n h w"], seen: Bool[Array, "n h w"], settings: SceneSettings) -> Float32[Array, "h w"]:
    """The quantile `far_share` of the depths that each pixel saw; 0 where it saw none."""
    count = seen.sum(0)
    ordered = np.sort(z, axis=0)  # zeros come first
    at = np.clip(len(z) - count + (settings.far_share * (count - 1)).astype(int), 0, len(z) - 1)
    return np.asarray(np.take_along_axis(ordered, at[None], 0)[0])


def _color_median(colors: Array, empty: Bool[Array, "n h w"]) -> tuple[Float32[Array, "h w 3"], Float32[Array, "h w"]]:
    """Median colour over the frames in which a pixel shows the scene (over all, where it never does), and its noise."""
    use = empty | ~empty.any(0, keepdims=True)
    color = np.stack([_masked_median(colors[..., k].astype(np.float32), use) for k in range(3)], -1)
    spread = most_of_channels(np.abs(colors.astype(np.float32) - color))
    return color, (MAD_TO_SIGMA_SHORT * _masked_median(spread, use)).astype(np.float32)


def _masked_median(values: Array, use: Bool[Array, "n h w"]) -> Float32[Array, "h w"]:
    """Lower median over the first axis of the values in use; 0 where none is."""
    ordered = np.sort(np.where(use, values, np.inf).astype(np.float32), axis=0)
    middle = np.maximum(use.sum(0) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[None], 0)[0]
    return np.where(np.isfinite(median), median, 0).astype(np.float32)


def calibrated_table_depth(calibration: RigCalibration, camera: str) -> Float32[Array, "h w"] | None:
    """Depth of the plane z = 0 of the world along every pixel's ray; None where the camera's place is not known."""
    model = calibration.cameras.get(camera)
    world_from_camera = calibration.find("world", model.frame) if model is not None else None
    if model is None or world_from_camera is None:
        return None
    return plane_depth(model, world_from_camera.rotation[2], -float(world_from_camera.translation_m[2]))


def plane_depth(camera: CameraModel, normal: Float[Array, "3"], offset_m: float) -> Float32[Array, "h w"]:
    """Depth at which each pixel's ray meets the plane n . x = offset; 0 where it does not within 10 m."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = offset_m / (camera.pixel_rays() @ normal)
    return np.where(np.isfinite(depth) & (depth > 0) & (depth < 10), depth, 0).astype(np.float32)


def fit_plane(
    points_m: Float[Array, "n 3"], tolerance_m: float, tries: int = 200
) -> tuple[Float[Array, "3"], float] | None:
    """The plane n . x = offset that most points lie on (RANSAC, then least squares); None without a clear one."""
    if len(points_m) < 50:
        return None
    rng = np.random.default_rng(0)
    best = np.zeros(0, dtype=np.int64)
    for _ in range(tries):
        a, b, c = points_m[rng.choice(len(points_m), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9:
            continue
        inside = np.flatnonzero(np.abs((points_m - a) @ (normal / length)) < tolerance_m)
        best = inside if len(inside) > len(best) else best
    if len(best) < 0.3 * len(points_m):
        return None
    center = points_m[best].mean(0)
    normal = np.linalg.svd(points_m[best] - center, full_matrices=False)[2][2]
    return normal, float(normal @ center)


def seen_table_depth(depths_m: Sequence[Float32[Array, "h w"]], camera: CameraModel) -> Float32[Array, "h w"] | None:
    """Depth of the plane that most of what stood still lies on; None without a clear one."""
    stack = np.stack([d[::8, ::8] for d in depths_m])
    median_m = _masked_median(stack, stack > 0)
    points = camera.pixel_rays()[::8, ::8][median_m > 0] * median_m[median_m > 0][:, None].astype(np.float64)
    plane = fit_plane(points, 0.008)
    return None if plane is None else plane_depth(camera, *plane)


def with_object_removed(
    scene: StaticScene,
    frame: RgbdFrame,
    mask: Bool[Array, "h w"],
    moved: Bool[Array, "h w"],
    camera: CameraModel | None,
) -> StaticScene:
    """The scene where the object hardly moves, so that it was learned as a part of it (`moved` is what stood out).

    Around the mask, what stands above the table is no longer scene: its depth becomes the table's, its colour unknown.
    Without a calibrated table, the plane that the mask's surroundings lie on serves.
    """
    import cv2

    around = surroundings(mask)
    table = scene.table_depth_m
    if not table.any() and camera is not None:
        ring = around & ~mask & (frame.depth_m > 0)
        v, u = np.nonzero(ring)
        points = camera.back_project(np.stack([u, v], -1).astype(np.float64), frame.depth_m[ring])
        plane = fit_plane(points[:: max(1, len(points) // 4000)], 0.008)
        table = table if plane is None else plane_depth(camera, *plane)
    stands = around & (table > 0) & (table - scene.depth_m > np.maximum(TABLE_M, 4 * stereo_sigma_m(table)))
    stands = cv2.dilate((stands | (mask & ~moved)).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    depth = np.where(stands | ~scene.known, table, scene.depth_m).astype(np.float32)
    return replace(scene, depth_m=depth, known=scene.known & ~stands, table_depth_m=table)


def bare_table(scene: StaticScene) -> Bool[Array, "h w"]:
    """Pixels whose learned scene is the table itself: no object was learned there, whatever depth now shows."""
    table = scene.table_depth_m
    off = np.abs(table - scene.depth_m)
    return np.asarray(scene.known & (table > 0) & (off < np.maximum(TABLE_M, 4 * stereo_sigma_m(table))))


def exposure_gain(frame: RgbdFrame, scene: StaticScene) -> tuple[float, float]:
    """How bright the frame is against the scene (median over known pixels that are not clipped), and the share of the
    scene's mid-bright pixels that are clipped in the frame."""
    color, base = np.ascontiguousarray(frame.color_rgb[::4, ::4]), np.ascontiguousarray(scene.color_rgb[::4, ::4])
    brightest = most_of_channels(base)
    level = scene.known[::4, ::4] & (brightest > 20) & (brightest < 230)
    if not level.any():
        return 1.0, 0.0
    clipped = most_of_channels(color)[level] >= 250
    usable = ~clipped if not clipped.all() else clipped
    seen, usual = color[level][usable].astype(np.float32), base[level][usable]
    ratio = seen @ np.ones(3, np.float32) / np.maximum(usual @ np.ones(3, np.float32), 1.0)
    return float(np.median(ratio)), float(clipped.mean())


def leveled(
    frame: RgbdFrame, scene: StaticScene, darkest: float = 0.12, most_clipped: float = 0.5, least_gain: float = 0.02
) -> tuple[RgbdFrame, bool]:
    """The frame as bright as the scene, and whether its colours are accepted at all.

    They cannot in a frame `darkest` times as bright as the scene, in one brighter by the inverse, and where more than
    `most_clipped` of the scene is overexposed. A gain within `least_gain` of 1 is left as it is.
    """
    gain, clipped = exposure_gain(frame, scene)
    if not (darkest < gain < 1 / darkest and clipped < most_clipped):
        return frame, False
    if abs(gain - 1) < least_gain:
        return frame, True
    table = np.clip(np.arange(256) / gain, 0, 255).round().astype(np.uint8)
    return replace(frame, color_rgb=table[frame.color_rgb]), True


def colorless(scene: StaticScene) -> StaticScene:
    """The scene for a frame whose colours are of no use: only its depth is known."""
    return replace(scene, color_sigma=np.full_like(scene.color_sigma, 1e4))


def surroundings(mask: Bool[Array, "h w"]) -> Bool[Array, "h w"]:
    """The mask and what lies within its own size around it."""
    import cv2

    side = int(np.ceil(np.sqrt(mask.sum())))
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * side + 1, 2 * side + 1), np.uint8)) > 0
