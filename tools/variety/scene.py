"""The room of a session: everything that stands, what moves, lamps and surroundings, where the camera is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray as Array

from acquisition.synthetic.arm import Arm
from acquisition.synthetic.config import CameraConfig
from acquisition.synthetic.objects.shapes import MassProperties
from acquisition.synthetic.render.cameras import look_at
from recordings.geometry import CameraModel, Transform
from variety import appearance, arms, furniture, masses, shapes
from variety.furniture import Item
from variety.spec import CameraSpec, Spec

AIM_HEIGHT_M = 0.1
USUAL_M = 0.12
OBJECT, SCENE, LIGHT, WRONG, MOTION, SENSOR, ARM = range(7)


def generator(spec: Spec, *purpose: int) -> np.random.Generator:
    """The random numbers of one purpose of a session."""
    return np.random.default_rng(np.random.SeedSequence([spec.seed, *purpose]))


@dataclass(frozen=True)
class Lamp:
    """A square area light that looks at the table; `power_w` as Blender counts it."""

    position_m: tuple[float, float, float]
    size_m: float
    power_w: float
    rgb: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Tossed:
    """The object: looks, hull, mass."""

    item: Item
    hull_m: Float[Array, "n 3"]
    mass: MassProperties


@dataclass(frozen=True, eq=False)
class Scene:
    """All of it. `surroundings` is a picture of the whole sphere in linear light (equirectangular, z up)."""

    tossed: Tossed
    standing: tuple[Item, ...]
    holder: Item | None
    arm: Arm | None
    person: Item | None
    lamps: tuple[Lamp, ...]
    surroundings: Float32[Array, "h w 3"]
    world_from_camera: Transform
    camera: CameraModel


def build(spec: Spec, objects: Path | None = None) -> Scene:
    """The scene of a session; `objects`: a folder of meshes to draw the object from, instead of a family."""
    rng = generator(spec, SCENE)
    tossed = draw_object(spec, objects)
    place = world_from_camera(spec.camera, float(np.ptp(tossed.hull_m, axis=0).max()))
    eye = place.translation_m
    standing = furniture.table(spec.table, spec.wrong.table_wave_m, rng)
    standing += furniture.walls(-eye[:2], spec.wall, rng)
    standing += [furniture.clutter(k, eye[:2], rng) for k in range(spec.clutter)]
    if spec.occluder == "standing":
        standing.append(furniture.pole(eye, rng))
    width = 0.5 * float(np.ptp(tossed.hull_m, axis=0).min())
    holders = {"hand": furniture.hand, "gripper": furniture.gripper}
    needs_hand = spec.holder == "none" and (spec.occluder == "passing" or "hand stays" in spec.tosses)
    holder = "hand" if needs_hand else spec.holder
    held = holders[holder](min(width, 0.06), rng) if holder in holders else None
    arm = None
    if spec.arm:
        arm = arms.arm_of(tossed.hull_m, -eye[:2], spec.wrong.arm_clock_s, generator(spec, ARM))
    walking = furniture.person(rng) if spec.person else None
    lamps, around = light(spec.lamps, generator(spec, LIGHT))
    return Scene(
        tossed, tuple(standing), None if arm else held, arm, walking, lamps, around, place, camera_model(spec.camera)
    )


def draw_object(spec: Spec, objects: Path | None) -> Tossed:
    """What is tossed."""
    rng = generator(spec, OBJECT)
    if objects is not None:
        from variety.mesh_files import textured_mesh

        mesh = textured_mesh(objects, rng)
    else:
        mesh = appearance.paint(shapes.make(spec.family, rng), spec.surface, rng)
    mass = masses.draw(mesh.vertices_m, mesh.faces, spec.mass_manner, rng)
    return Tossed(Item("object", mesh, appearance.draw_finish(rng)), shapes.supports(mesh.vertices_m), mass)


def world_from_camera(camera: CameraSpec, longest_m: float) -> Transform:
    """Looks at a point above the table's middle, from nearer where the object is small, as people do."""
    distance = max(0.42, camera.distance_m * float(np.clip((longest_m / USUAL_M) ** 0.4, 0.6, 1.2)))
    return look_at(
        CameraConfig(
            distance_m=distance, elevation_deg=camera.elevation_deg, azimuth_deg=camera.azimuth_deg,
            aim_height_m=AIM_HEIGHT_M,
        )
    )  # fmt: skip


def camera_model(camera: CameraSpec) -> CameraModel:
    """The true colour camera."""
    x, y = (camera.width - 1) / 2 + camera.center_off_px[0], (camera.height - 1) / 2 + camera.center_off_px[1]
    K = np.array([[camera.focal_px, 0, x], [0, camera.focal_px, y], [0, 0, 1.0]])
    return CameraModel("d455", camera.width, camera.height, K, "brown-conrady", camera.distortion)


def light(count: int, rng: np.random.Generator) -> tuple[tuple[Lamp, ...], Float32[Array, "h w 3"]]:
    """Lamps of 5 to 100 cm and 2700 to 6500 K about the table, and a blurred room around."""
    lamps = []
    for _ in range(count):
        angle, reach, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.6), rng.uniform(0.8, 2.2)
        warm = rng.uniform(0, 1)
        rgb = (1.0, 0.97 - 0.22 * warm, 0.95 - 0.5 * warm)
        power = float(rng.uniform(4, 30) * (reach**2 + height**2) / count)
        lamps.append(
            Lamp((reach * np.cos(angle), reach * np.sin(angle), height), float(rng.uniform(0.05, 1.0)), power, rgb)
        )
    around = np.full((64, 128, 3), 0.25, np.float32) * rng.uniform(0.3, 1.2, 3)
    around += 0.5 * rng.random((64, 128, 3)) * rng.uniform(0.0, 1.0)
    for _ in range(int(rng.integers(0, 4))):
        y, x = int(rng.integers(4, 34)), int(rng.integers(0, 116))
        around[y : y + int(rng.integers(4, 14)), x : x + int(rng.integers(4, 24))] += rng.uniform(1.0, 6.0)
    return tuple(lamps), cv2.GaussianBlur(around.astype(np.float32), (0, 0), 2.0)
