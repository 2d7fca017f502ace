"""Pictures in linear light: the still room once per camera, moving bodies and their shadows on top of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int8
from numpy import ndarray as Array

from acquisition.synthetic.config import LightConfig
from acquisition.synthetic.render.rays import Placed, Standing, Surface, cast, joined, occluded, surface
from recordings.geometry import CameraModel, Transform

BEHIND_SLACK_M = 0.003
"""A moving body hides the room unless it lies this much behind it (it may dip into the table at an impact)."""
TABLE_REGION_M = 0.3
"""Shadows of moving bodies fall on what is this near to the table's height."""
TABLE_REACH_M = 1.2
RAYS_AT_ONCE = 200_000
GROUND_RGB = np.array([0.5, 0.38, 0.28], np.float32)
SKY_RGB = np.array([0.95, 0.98, 1.05], np.float32)
FAR = np.float32(np.inf)

Placement = Callable[[float], Sequence[Placed]]


class View:
    """A camera at its place: rays of every pixel, and their change from pixel to pixel."""

    def __init__(self, camera: CameraModel, world_from_camera: Transform) -> None:
        self.camera = camera
        self.world_from_camera = world_from_camera
        self.camera_from_world = world_from_camera.inverse()
        self.origin_m = world_from_camera.translation_m.astype(np.float32)
        self.rays = (camera.pixel_rays() @ world_from_camera.rotation.T).astype(np.float32)
        self.step_x = np.gradient(self.rays, axis=1)
        self.step_y = np.gradient(self.rays, axis=0)

    def jittered(self, box: Box, dx: float, dy: float) -> Float32[Array, "n 3"]:
        """Rays through points `dx`, `dy` pixels beside the pixels' centres; their length per unit of depth is kept."""
        part = box.slices
        return (self.rays[part] + np.float32(dx) * self.step_x[part] + np.float32(dy) * self.step_y[part]).reshape(
            -1, 3
        )

    def around(self, points_world_m: Float[Array, "n 3"], margin_px: int = 2) -> Box:
        """The pixels that may see something inside the hull of these points."""
        points = self.camera_from_world.points(points_world_m)
        whole = Box(0, 0, self.camera.width, self.camera.height)
        if (points[:, 2] < 0.05).any():
            return whole
        pixels = self.camera.project(points)
        low, high = np.floor(pixels.min(axis=0)) - margin_px, np.ceil(pixels.max(axis=0)) + margin_px + 1
        return Box(*(int(np.clip(v, -1, 1e6)) for v in (*low, *high))).cut(whole)


@dataclass(frozen=True)
class Box:
    """A rectangle of pixels x0 <= x < x1, y0 <= y < y1."""

    x0: int
    y0: int
    x1: int
    y1: int

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.y0, self.y1), slice(self.x0, self.x1)

    @property
    def empty(self) -> bool:
        return self.x1 <= self.x0 or self.y1 <= self.y0

    def cut(self, other: Box) -> Box:
        x0, y0 = max(self.x0, other.x0), max(self.y0, other.y0)
        return Box(x0, y0, max(x0, min(self.x1, other.x1)), max(y0, min(self.y1, other.y1)))

    def join(self, other: Box) -> Box:
        if self.empty:
            return other
        if other.empty:
            return self
        return Box(min(self.x0, other.x0), min(self.y0, other.y0), max(self.x1, other.x1), max(self.y1, other.y1))


@dataclass(frozen=True, eq=False)
class Lamps:
    """Positions of both lights for one sub-frame: a point of each area light."""

    key_m: Float[Array, "3"]
    fill_m: Float[Array, "3"]


class Light:
    """The lamps and how a surface answers them."""

    def __init__(self, config: LightConfig) -> None:
        self.config = config
        self.key_rgb = np.float32(config.key) * np.array(config.key_rgb, np.float32)
        self.fill_rgb = np.float32(config.fill) * np.ones(3, np.float32)

    @property
    def discs(self) -> tuple[tuple[tuple[float, float, float], float], ...]:
        """Centre and radius of the key and the fill light."""
        config = self.config
        return (config.key_position_m, config.key_radius_m), (config.fill_position_m, config.fill_radius_m)

    def lamps(self, rng: np.random.Generator, count: int) -> list[Lamps]:
        """Points spread evenly over the two discs (golden angle, turned at random)."""
        config, turn = self.config, rng.uniform(0, 2 * np.pi)
        angle = turn + np.arange(count) * np.pi * (3 - np.sqrt(5))
        radius = np.sqrt((np.arange(count) + 0.5) / count)
        disc = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], -1)[rng.permutation(count)]
        key = np.array(config.key_position_m) + config.key_radius_m * disc
        fill = np.array(config.fill_position_m) + config.fill_radius_m * disc
        return [Lamps(k, f) for k, f in zip(key, fill)]

    def parts(
        self, hit: Surface, viewer_m: Float32[Array, "3"], lamps: Lamps
    ) -> tuple[Float32[Array, "n 3"], Float32[Array, "n 3"], Float32[Array, "n 3"]]:
        """Radiance from ambient light, from the key lamp and from the fill lamp when nothing is in the way."""
        up = 0.5 + 0.5 * hit.normals[:, 2:]
        around = np.float32(self.config.ambient) * (up * SKY_RGB + (1 - up) * 0.6 * GROUND_RGB)
        towards = viewer_m - hit.points_m
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        facing = np.clip(np.einsum("ij,ij->i", hit.normals, towards), 0, 1)
        fresnel = (hit.reflectance + (1 - hit.reflectance) * (1 - facing) ** 5)[:, None]
        mirrored = (2 * facing[:, None] * hit.normals - towards)[:, 2:]
        seen = np.where(mirrored > 0, 0.35 + 0.65 * mirrored, 0.25) * np.float32(self.config.ambient + 0.3)
        ambient = hit.albedo * around + fresnel * hit.mirror[:, None] * seen
        key = self._lamp(hit, towards, lamps.key_m, np.array(self.config.key_position_m)) * self.key_rgb
        fill = self._lamp(hit, towards, lamps.fill_m, np.array(self.config.fill_position_m)) * self.fill_rgb
        return ambient, key, fill

    @staticmethod
    def _lamp(hit: Surface, towards: Array, lamp_m: Array, nominal_m: Array) -> Float32[Array, "n 3"]:
        """Lambert and a normalised Blinn-Phong highlight; the lamp's strength is 1 at the table's centre."""
        to_lamp = lamp_m.astype(np.float32) - hit.points_m
        square = np.einsum("ij,ij->i", to_lamp, to_lamp)
        to_lamp /= np.sqrt(square)[:, None]
        falling = (
            np.clip(np.einsum("ij,ij->i", hit.normals, to_lamp), 0, None) * np.float32(nominal_m @ nominal_m) / square
        )
        half = to_lamp + towards
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-6)
        shine = np.clip(np.einsum("ij,ij->i", hit.normals, half), 0, 1) ** hit.exponent
        shine *= hit.reflectance * (hit.exponent + 8) / 8
        return (hit.albedo + shine[:, None]) * falling[:, None]


@dataclass(frozen=True, eq=False)
class StillPicture:
    """The room as one camera sees it: radiance by source (so that shadows can be cast later), points, depth."""

    ambient: Float32[Array, "h w 3"]
    key: Float32[Array, "h w 3"]
    fill: Float32[Array, "h w 3"]
    points_m: Float32[Array, "h w 3"]
    depth_m: Float32[Array, "h w"]
    facing: Float32[Array, "h w"]
    """Cosine between the ray and the surface's normal."""

    @cached_property
    def radiance(self) -> Float32[Array, "h w 3"]:
        return self.ambient + self.key + self.fill


def still_picture(view: View, room: Standing, light: Light, rng: np.random.Generator, samples: int) -> StillPicture:
    """Render the room with `samples` jittered rays a pixel."""
    shape = view.rays.shape
    parts = np.zeros((3, *shape), np.float32)
    for (dx, dy), lamps in zip(jitters(samples), light.lamps(rng, samples)):
        for band in _bands(shape[1], shape[0]):
            for total, part in zip(parts, _still_band(view, room, light, lamps, view.jittered(band, dx, dy))):
                total[band.slices] += part.reshape(total[band.slices].shape) / np.float32(samples)
    points, z, facing = _geometry(view, room)
    return StillPicture(parts[0], parts[1], parts[2], points, z, facing)


def _bands(width: int, height: int) -> Iterator[Box]:
    """The image in strips, so that memory stays small."""
    rows = max(1, RAYS_AT_ONCE // width)
    for top in range(0, height, rows):
        yield Box(0, top, width, min(height, top + rows))


def _still_band(
    view: View, room: Standing, light: Light, lamps: Lamps, rays: Float32[Array, "n 3"]
) -> Float32[Array, "3 n 3"]:
    """Radiance of the room along rays, from ambient, key and fill light."""
    parts = np.zeros((3, len(rays), 3), np.float32)
    owner, hits = room.cast(view.origin_m, rays)
    for number in np.unique(owner[owner >= 0]):
        one, rows = room.placed[number], np.flatnonzero(owner == number)
        footprint = _footprint(one, view, hits["t_hit"][rows])
        spot = surface(one, hits, rows, *_rays_of(view, rays, rows), footprint)
        ambient, key, fill = light.parts(spot, view.origin_m, lamps)
        key[room.occluded(spot.points_m, lamps.key_m, spot.normals)] = 0
        fill[room.occluded(spot.points_m, lamps.fill_m, spot.normals)] = 0
        parts[:, rows] = ambient, key, fill
    return parts


def _geometry(view: View, room: Standing) -> tuple[Array, Array, Array]:
    """Points, depth and facing at the pixels' centres."""
    shape = view.rays.shape
    z, facing = np.zeros(shape[:2], np.float32), np.zeros(shape[:2], np.float32)
    for band in _bands(shape[1], shape[0]):
        rays = view.rays[band.slices].reshape(-1, 3)
        owner, hits = room.cast(view.origin_m, rays)
        cosine = np.zeros(len(rays), np.float32)
        for number in np.unique(owner[owner >= 0]):
            rows = np.flatnonzero(owner == number)
            cosine[rows] = _facing(room.placed[number], hits, rows, rays[rows])
        size = facing[band.slices].shape
        z[band.slices], facing[band.slices] = hits["t_hit"].reshape(size), cosine.reshape(size)
    points = view.origin_m + view.rays * np.where(np.isfinite(z), z, 0)[..., None]
    return points, z, facing


def _facing(one: Placed, hits: dict[str, Array], rows: Array, rays: Array) -> Float32[Array, " n"]:
    mesh = one.body.mesh
    faces = hits["primitive_ids"][rows].astype(np.int64)
    a, b, c = (mesh.vertices_m[mesh.faces[faces, k]] for k in range(3))
    normals = np.cross(b - a, c - a) @ one.world_from_body.rotation.T
    lengths = np.linalg.norm(normals, axis=1) * np.linalg.norm(rays, axis=1)
    return np.abs(np.einsum("ij,ij->i", normals, rays) / np.maximum(lengths, 1e-12)).astype(np.float32)


def nearest(
    placed: Sequence[Placed], view: View, rays: Float32[Array, "n 3"], rows_of: Sequence[Array]
) -> tuple[Float32[Array, " n"], Int8[Array, " n"], list[dict[str, Array]]]:
    """Depth along the axis of the first hit of each ray, whose it is (-1: none), and each body's own answers.

    Body k is asked for the rays `rows_of[k]` only; its answers are spread over all n rows.
    """
    z = np.full(len(rays), FAR, np.float32)
    owner = np.full(len(rays), -1, np.int8)
    answers = []
    for number, (one, rows) in enumerate(zip(placed, rows_of)):
        found = cast(one, np.broadcast_to(view.origin_m, (len(rows), 3)), rays[rows])
        nearer = found["t_hit"] < z[rows]
        z[rows[nearer]], owner[rows[nearer]] = found["t_hit"][nearer], number
        answers.append(_at_rows(found, rows, len(rays)))
    return z, owner, answers


def _at_rows(found: dict[str, Array], rows: Array, count: int) -> dict[str, Array]:
    if len(rows) == count:
        return found
    spread = {}
    for name, values in found.items():
        spread[name] = np.zeros((count, *values.shape[1:]), values.dtype)
        spread[name][rows] = values
    return spread


def _rays_of(view: View, rays: Array, rows: Array) -> tuple[Array, Array]:
    return np.broadcast_to(view.origin_m, (len(rows), 3)), rays[rows]


def _footprint(one: Placed, view: View, z: Float32[Array, " n"]) -> float:
    """Texels under one pixel, at the middle distance of what is seen."""
    return one.body.mesh.texels_per_m * float(np.median(z)) / view.camera.fx


def jitters(count: int) -> list[tuple[float, float]]:
    """Sub-pixel offsets that fill the pixel evenly (R2 sequence, centred)."""
    k = np.arange(1, count + 1)
    x, y = (0.5 + 0.7548776662466927 * k) % 1.0, (0.5 + 0.5698402909980532 * k) % 1.0
    return list(zip((x - x.mean()).tolist(), (y - y.mean()).tolist()))


def picture(
    view: View, still: StillPicture, light: Light, moving: Placement, times_s: Sequence[float], rng: np.random.Generator
) -> Float32[Array, "h w 3"]:
    """Linear radiance averaged over the instants of an exposure, with moving bodies, their blur and their shadows."""
    out = still.radiance.copy()
    instants = [list(moving(t)) for t in times_s]
    box = Box(0, 0, 0, 0)
    for placed in instants:
        for one in placed:
            box = box.join(_box_of(view, one))
            for disc in light.discs:
                box = box.join(_shadow_box(view, one, *disc))
    if box.empty:
        return out
    total = np.zeros((box.y1 - box.y0, box.x1 - box.x0, 3), np.float32)
    for placed, jitter, lamps in zip(instants, jitters(len(instants)), light.lamps(rng, len(instants))):
        total += _instant(view, still, light, placed, box, jitter, lamps)
    out[box.slices] = total / np.float32(len(instants))
    return out


def _instant(
    view: View,
    still: StillPicture,
    light: Light,
    placed: list[Placed],
    box: Box,
    jitter: tuple[float, float],
    lamps: Lamps,
) -> Float32[Array, "h w 3"]:
    seen = still.radiance[box.slices].reshape(-1, 3).copy()
    _cast_shadows(seen, view, still, light, placed, box, lamps)
    rays = view.jittered(box, *jitter)
    z, owner, hits = nearest(placed, view, rays, [_rows_in(_box_of(view, one).cut(box), box) for one in placed])
    hidden = z > still.depth_m[box.slices].reshape(-1) + BEHIND_SLACK_M
    owner[hidden] = -1
    rows_of = [np.flatnonzero(owner == number) for number in range(len(placed))]
    spots = [
        surface(one, found, rows, *_rays_of(view, rays, rows), _footprint(one, view, z[rows]))
        for one, found, rows in zip(placed, hits, rows_of)
        if len(rows)
    ]
    if spots:
        spot = joined(spots)
        ambient, key, fill = light.parts(spot, view.origin_m, lamps)
        key[occluded(placed, spot.points_m, lamps.key_m, spot.normals)] = 0
        fill[occluded(placed, spot.points_m, lamps.fill_m, spot.normals)] = 0
        seen[np.concatenate(rows_of)] = ambient + key + fill
    return seen.reshape(box.y1 - box.y0, box.x1 - box.x0, 3)


def _cast_shadows(
    seen: Array, view: View, still: StillPicture, light: Light, placed: list[Placed], box: Box, lamps: Lamps
) -> None:
    """Take each lamp's light away from the room's pixels that a moving body hides it from."""
    points = still.points_m[box.slices].reshape(-1, 3)
    for part, lamp_m, disc in zip((still.key, still.fill), (lamps.key_m, lamps.fill_m), light.discs):
        dark = np.zeros(len(points), dtype=bool)
        for one in placed:
            rows = _rows_in(_shadow_box(view, one, *disc).cut(box), box)
            rows = rows[~dark[rows] & (np.abs(points[rows, 2]) < TABLE_REGION_M)]
            dark[rows] = occluded([one], points[rows], lamp_m, None)
        seen[dark] -= part[box.slices].reshape(-1, 3)[dark]


def _rows_in(inner: Box, outer: Box) -> Array:
    """Row numbers of the pixels of `inner` among the flattened pixels of `outer`."""
    if inner.empty:
        return np.zeros(0, np.int64)
    y, x = np.mgrid[inner.y0 : inner.y1, inner.x0 : inner.x1]
    return ((y - outer.y0) * (outer.x1 - outer.x0) + (x - outer.x0)).ravel()


def _box_of(view: View, one: Placed) -> Box:
    return view.around(one.world_from_body.points(one.body.corners_m))


def _shadow_box(view: View, one: Placed, center_m: tuple[float, float, float], radius_m: float) -> Box:
    """Where the body's shadow of one lamp falls on the table: its box seen from the lamp's rim, on the plane z = 0."""
    corners = one.world_from_body.points(one.body.corners_m)
    spots = [corners * [1, 1, 0]]
    for dx, dy in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        lamp = np.array(center_m) + radius_m * np.array([dx, dy, 0.0])
        share = lamp[2] / np.maximum(lamp[2] - np.minimum(corners[:, 2], 0.9 * lamp[2]), 1e-3)
        spots.append(lamp + share[:, None] * (corners - lamp))
    on_table = np.clip(np.vstack(spots), -TABLE_REACH_M, TABLE_REACH_M)
    return view.around(on_table * [1, 1, 0])


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What a camera's pixel centres see at an instant: depth along the axis, whose it is, facing.

    `owner`: -1 the room, otherwise the place in the list of moving bodies.
    """

    depth_m: Float32[Array, "h w"]
    owner: Int8[Array, "h w"]
    facing: Float32[Array, "h w"]

    def mask(self, numbers: Sequence[int]) -> Bool[Array, "h w"]:
        return np.isin(self.owner, np.array(numbers, dtype=np.int8))


def render_g_buffer(view: View, still: StillPicture, placed: Sequence[Placed]) -> GBuffer:
    """Exact depth of the room and the moving bodies."""
    depth, facing = still.depth_m.copy(), still.facing.copy()
    owner = np.full(depth.shape, -1, np.int8)
    for number, one in enumerate(placed):
        box = _box_of(view, one)
        if box.empty:
            continue
        rays = view.rays[box.slices].reshape(-1, 3)
        found = cast(one, np.broadcast_to(view.origin_m, rays.shape), rays)
        behind = depth[box.slices].reshape(-1) + np.where(owner[box.slices].reshape(-1) < 0, BEHIND_SLACK_M, 0.0)
        rows = np.flatnonzero(found["t_hit"] < behind)
        where = (box.y0 + rows // (box.x1 - box.x0), box.x0 + rows % (box.x1 - box.x0))
        depth[where], owner[where] = found["t_hit"][rows], number
        facing[where] = _facing(one, found, rows, rays[rows])
    return GBuffer(depth, owner, facing)
