"""The infrared pair's pictures: albedo, a projector's dots with their shadows, ambient light, exposure, noise.

What stands is cast once a session (2x2 rays a pixel); what moves, and the shadows that it throws in the projector's
light, anew in every sub-frame of the exposure.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8
from numpy import ndarray as Array

from acquisition.synthetic.render.rays import Body, Placed, Standing, cast, occluded, surface
from recordings.geometry import Transform
from variety.furniture import Item
from variety.spec import DepthSpec
from variety.stereo_depth import BASELINE_M, COLOR_FROM_LEFT_M, FOCAL_PX, HEIGHT, WIDTH

OVER = 2
"""Rays along either side of a pixel."""
DOTS = 12000
"""Over a picture wider than what the imagers see. With DOT_PX, LENS_PX and the noise they give a matched wall the
sub-pixel error that the maker says of the device (see `depth_check`)."""
DOT_PX, LENS_PX = 2.6, 0.7
"""Sigmas: of a dot in the pattern's pixels, of the imagers' lenses in theirs."""
READ_VARIANCE, SHOT_VARIANCE = 0.4, 0.012
"""Of a grey level, and of each grey level of signal."""
PATTERN_PX, PATTERN_FOCAL = 2600, 1150.0
PROJECTOR_M = 0.027
"""To the right of the left imager."""
INSTANTS = 2
"""Sub-frames of an exposure in which something moves."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What n rays meet: points, normals towards the viewer, infrared albedo, gloss (roughness), whether anything."""

    points_m: Float32[Array, "n 3"]
    normals: Float32[Array, "n 3"]
    albedo: Float32[Array, " n"]
    roughness: Float32[Array, " n"]
    hit: Bool[Array, " n"]

    def at(self, rows: Array) -> Seen:
        return Seen(self.points_m[rows], self.normals[rows], self.albedo[rows], self.roughness[rows], self.hit[rows])


@dataclass(frozen=True, eq=False)
class Eye:
    """One imager: where it is and its rays (OVER x OVER a pixel, length 1 along the axis)."""

    world_from_eye: Transform

    @cached_property
    def rays(self) -> Float32[Array, "n 3"]:
        y, x = np.mgrid[: HEIGHT * OVER, : WIDTH * OVER].astype(np.float64)
        u, v = ((q + 0.5) / OVER - 0.5 for q in (x, y))
        local = np.stack([(u - (WIDTH - 1) / 2) / FOCAL_PX, (v - (HEIGHT - 1) / 2) / FOCAL_PX, np.ones_like(u)], -1)
        return self.world_from_eye.vectors(local.reshape(-1, 3)).astype(np.float32)

    @property
    def origin_m(self) -> Float32[Array, "3"]:
        return self.world_from_eye.translation_m.astype(np.float32)

    def rows_near(self, center_m: Array, radius_m: float) -> Array:
        """Rays that may meet a sphere."""
        local = self.world_from_eye.inverse().points(center_m)
        if local[2] < radius_m + 0.05:
            return np.zeros(0, np.int64)
        reach = FOCAL_PX * radius_m / (local[2] - radius_m) * 1.1 + 2
        u, v = FOCAL_PX * local[0] / local[2] + WIDTH / 2, FOCAL_PX * local[1] / local[2] + HEIGHT / 2
        x0, x1 = (int(np.clip((u + s * reach) * OVER, 0, WIDTH * OVER)) for s in (-1, 1))
        y0, y1 = (int(np.clip((v + s * reach) * OVER, 0, HEIGHT * OVER)) for s in (-1, 1))
        y, x = np.mgrid[y0:y1, x0:x1]
        return (y * WIDTH * OVER + x).reshape(-1)


class Pair:
    """The device in the scene."""

    def __init__(
        self, world_from_color: Transform, spec: DepthSpec, standing: tuple[Item, ...], moving: dict[str, Item],
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        self.spec, self._finishes = spec, {n: i.finish for n, i in moving.items()}
        self.bodies = {name: Body(name, item.mesh) for name, item in moving.items()}
        left = Transform("d455", "left", np.eye(3), np.array([-COLOR_FROM_LEFT_M, 0.0, 0.0]))
        right = Transform("d455", "right", np.eye(3), np.array([BASELINE_M - COLOR_FROM_LEFT_M, 0.0, 0.0]))
        dots = Transform("d455", "projector", np.eye(3), np.array([PROJECTOR_M - COLOR_FROM_LEFT_M, 0.0, 0.0]))
        self.color_from_left = left
        self.eyes = (Eye(world_from_color @ left), Eye(world_from_color @ right))
        self.projector = world_from_color @ dots
        self._pattern = _dots(rng)
        self._room = Standing([Body(i.name, i.mesh) for i in standing])
        self._stands = tuple(self._looked(eye, standing) for eye in self.eyes)
        self._still = tuple(self._lit(s, self._dark(s)) for s in self._stands)
        self._gain = self._exposed_well()

    def pictures(
        self, instants: list[list[tuple[str, Transform]]], rng: np.random.Generator
    ) -> list[UInt8[Array, "h w"]]:
        """Left and right picture of an exposure; `instants`: what is where in each of its sub-frames."""
        found = []
        for k in range(2):
            light = sum(self._with(k, placed) for placed in instants) / len(instants)
            found.append(self._developed(light, rng))
        return found

    def still(self, eye: int) -> Float32[Array, "h w"]:
        """The light of the room without what moves, a pixel."""
        return _binned(self._still[eye])

    def _with(self, k: int, placed: list[tuple[str, Transform]]) -> Float32[Array, "h w"]:
        """Radiance a pixel with the moving bodies at an instant."""
        eye, light = self.eyes[k], self._still[k].copy()
        bodies = [(name, Placed(self.bodies[name], pose)) for name, pose in placed]
        self._shade(light, self._stands[k], [b for _, b in bodies])
        nearest = (self._stands[k].points_m - eye.origin_m) @ eye.world_from_eye.rotation[:, 2].astype(np.float32)
        nearest[~self._stands[k].hit] = np.inf
        for name, body in bodies:
            rows = eye.rows_near(body.world_from_body.points(body.body.center_m), body.body.radius_m)
            if len(rows) == 0:
                continue
            origins = np.broadcast_to(eye.origin_m, (len(rows), 3))
            hits = cast(body, origins, eye.rays[rows])
            front = np.flatnonzero(hits["t_hit"] < nearest[rows])
            if len(front) == 0:
                continue
            seen = self._of_body(name, body, hits, front, origins[front], eye.rays[rows[front]])
            dark = self._dark(seen) | occluded(
                [b for _, b in bodies], seen.points_m, self.projector.translation_m, seen.normals
            )
            nearest[rows[front]] = hits["t_hit"][front]
            light[rows[front]] = self._lit(seen, dark)
        return _binned(light)

    def _of_body(
        self, name: str, body: Placed, hits: dict[str, Array], rows: Array, origins: Array, rays: Array
    ) -> Seen:
        texels = body.body.mesh.texels_per_m * float(np.median(hits["t_hit"][rows])) / (FOCAL_PX * OVER)
        spot = surface(body, hits, rows, origins, rays, texels)
        return _seen(spot.points_m, spot.normals, spot.albedo, self._finishes[name])

    def _shade(self, light: Array, stands: Seen, bodies: list[Placed]) -> None:
        """What a moving body hides from the projector."""
        lamp = self.projector.translation_m
        towards = stands.points_m - lamp.astype(np.float32)
        far = np.linalg.norm(towards, axis=1)
        for body in bodies:
            center = body.world_from_body.points(body.body.center_m) - lamp
            distance, radius = float(np.linalg.norm(center)), body.body.radius_m
            if distance <= radius * 1.05:
                continue
            cosine = np.sqrt(1 - (radius / distance) ** 2)
            near = (
                stands.hit
                & (towards @ (center / distance).astype(np.float32) > cosine * far)
                & (far > distance - radius)
            )
            rows = np.flatnonzero(near)
            dark = rows[occluded([body], stands.points_m[rows], lamp, stands.normals[rows])]
            light[dark] = self._lit(stands.at(dark), np.ones(len(dark), bool))

    def _looked(self, eye: Eye, standing: tuple[Item, ...]) -> Seen:
        owner, hits = self._room.cast(eye.origin_m, eye.rays)
        count = len(owner)
        out = Seen(np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32), np.zeros(count, np.float32),
                   np.ones(count, np.float32), owner >= 0)  # fmt: skip
        for number in np.unique(owner[owner >= 0]):
            rows = np.flatnonzero(owner == number)
            one, rays = self._room.placed[number], eye.rays[rows]
            texels = one.body.mesh.texels_per_m * float(np.median(hits["t_hit"][rows])) / (FOCAL_PX * OVER)
            spot = surface(one, hits, rows, np.broadcast_to(eye.origin_m, rays.shape), rays, texels)
            seen = _seen(spot.points_m, spot.normals, spot.albedo, standing[number].finish)
            for name in ("points_m", "normals", "albedo", "roughness"):
                getattr(out, name)[rows] = getattr(seen, name)
        return out

    def _dark(self, seen: Seen) -> Bool[Array, " n"]:
        """Whether the room hides a point from the projector."""
        dark = ~seen.hit
        rows = np.flatnonzero(seen.hit)
        dark[rows] = self._room.occluded(seen.points_m[rows], self.projector.translation_m, seen.normals[rows])
        return dark

    def _lit(self, seen: Seen, dark: Bool[Array, " n"]) -> Float32[Array, " n"]:
        """Light sent back: Lambert under ambient light and dots; what a glossy surface mirrors away is missing, and
        what it mirrors of the dots straight back is added."""
        lamp = self.projector.translation_m.astype(np.float32)
        towards = lamp - seen.points_m
        distance = np.maximum(np.linalg.norm(towards, axis=1), 0.05)
        cosine = np.clip(np.einsum("ij,ij->i", towards, seen.normals) / distance, 0, 1)
        local = self.projector.inverse().points(seen.points_m)
        at = (local[:, :2] / np.maximum(local[:, 2:], 1e-3) * PATTERN_FOCAL + PATTERN_PX / 2).astype(np.float32)
        dots = _looked_up(self._pattern, at) * self.spec.projector / distance**2
        gloss = 1 - seen.roughness
        shine = gloss**2 * 6.0 * cosine ** (2 + 120 * gloss**2)
        diffuse = seen.albedo * (1 - 0.5 * gloss)
        up = 0.6 + 0.4 * seen.normals[:, 2]
        light = diffuse * self.spec.ambient * up + np.where(dark, 0, dots * (diffuse * cosine + shine * 0.2))
        return np.where(seen.hit, light, 0.02 * self.spec.ambient).astype(np.float32)

    def _exposed_well(self) -> float:
        middle = _binned(self._still[0])[HEIGHT // 4 : 3 * HEIGHT // 4, WIDTH // 4 : 3 * WIDTH // 4]
        return 90.0 / max(float(np.mean(middle)), 1e-3)

    def _developed(self, light: Float32[Array, "h w"], rng: np.random.Generator) -> UInt8[Array, "h w"]:
        """Lens blur, vignetting, shot and read noise, eight bits."""
        y, x = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
        off = ((x - WIDTH / 2) ** 2 + (y - HEIGHT / 2) ** 2) / FOCAL_PX**2
        grey = self._gain * cv2.GaussianBlur(light, (0, 0), LENS_PX) / (1 + off)
        sigma = self.spec.noise * np.sqrt(READ_VARIANCE + SHOT_VARIANCE * np.clip(grey, 0, 255))
        grey = grey + sigma * rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def _seen(points: Array, normals: Array, albedo_rgb: Array, finish: object) -> Seen:
    from variety.appearance import Finish

    assert isinstance(finish, Finish)
    grey = albedo_rgb @ np.array([0.45, 0.4, 0.15], np.float32)
    mixed = np.clip(finish.infrared * ((1 - finish.infrared_flat) * grey + finish.infrared_flat * 0.5), 0.02, 1.0)
    roughness = np.full(len(points), min(finish.roughness, 1 - 0.8 * finish.coat), np.float32)
    return Seen(points, normals, mixed.astype(np.float32), roughness, np.ones(len(points), bool))


def _dots(rng: np.random.Generator) -> Float32[Array, "p p"]:
    """The projector's picture: dots of uneven brightness, none on top of another more than by chance."""
    picture = np.zeros((PATTERN_PX, PATTERN_PX), np.float32)
    side = int(np.sqrt(DOTS * 1.0))
    cell = PATTERN_PX / side
    y, x = np.mgrid[:side, :side].reshape(2, -1)
    at = ((np.stack([x, y], 1) + rng.uniform(0.0, 1.0, (len(x), 2))) * cell).astype(np.int64)
    picture[at[:, 1], at[:, 0]] += rng.uniform(0.5, 1.3, len(at)).astype(np.float32)
    soft = cv2.GaussianBlur(picture, (0, 0), DOT_PX)
    return soft / float(soft.max()) * 4.0


def _looked_up(picture: Array, at: Float32[Array, "n 2"]) -> Float32[Array, " n"]:
    rows = 16384
    parts = [
        cv2.remap(picture, at[i : i + rows, None, 0], at[i : i + rows, None, 1], cv2.INTER_LINEAR, borderValue=0)
        for i in range(0, len(at), rows)
    ]
    return np.concatenate(parts)[:, 0] if parts else np.zeros(0, np.float32)


def _binned(light: Float32[Array, " n"]) -> Float32[Array, "h w"]:
    return light.reshape(HEIGHT, OVER, WIDTH, OVER).mean(axis=(1, 3))
