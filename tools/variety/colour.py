"""Linear pictures of a session's colour camera: the room once, what moves (and its shadows) in crops on top.

Blender runs in a process of its own: its package pins another numpy, and its licence (GPL) stays beside ours.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32
from numpy import ndarray as Array

from acquisition.synthetic.render.sensors import color_image
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from variety.furniture import Item
from variety.scene import Scene
from variety.spec import Spec
from variety.throws import moving_items

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = Path(__file__).with_name("render_blender.py")
OWN_PYTHON = ROOT / ".venv-blender" / "bin" / "python"
HOW = "make blender (a virtual environment of its own with bpy 4.5, about 1.5 GB), or set VARIETY_BLENDER=PYTHON"
STILL = "still.npy"
STILL_SAMPLES = 20
CROP_SAMPLES = (4, 10)
PIXELS = 640 * 480
FEATHER_PX = 5
SHADOWS_WITHIN_M = 0.35
Box = tuple[int, int, int, int]
Shot = dict[str, tuple[Transform, Transform]]
"""By name, where a body is at the begin and the end of the shutter."""


def blender() -> Path:
    """The Python that has bpy. Raises BadInput where there is none."""
    told = os.environ.get("VARIETY_BLENDER")
    found = Path(told) if told else OWN_PYTHON
    if not found.exists():
        raise BadInput(f"path tracing needs Blender's bpy: no {found}; wanted: {HOW}")
    return found


@dataclass(frozen=True, eq=False)
class Canvas:
    """A pinhole picture that covers all that the lens sees, and where each of the lens's pixels lies in it."""

    width: int
    height: int
    focal_px: float
    cx: float
    cy: float
    map_x: Float32[Array, "h w"]
    map_y: Float32[Array, "h w"]

    @staticmethod
    def of(camera: CameraModel, margin_px: int = 4) -> Canvas:
        rays = camera.pixel_rays()
        x, y = (rays[..., k] / rays[..., 2] * camera.fx for k in (0, 1))
        left, top = np.floor(x.min()) - margin_px, np.floor(y.min()) - margin_px
        width, height = (int(np.ceil(q.max() - low) + margin_px) for q, low in ((x, left), (y, top)))
        return Canvas(
            width, height, camera.fx, -left, -top, (x - left).astype(np.float32), (y - top).astype(np.float32)
        )

    def box_of(self, points_m: Array, margin_px: int = 6) -> Box | None:
        """Around camera points; None where they are out of the picture or behind."""
        front = points_m[points_m[:, 2] > 0.05]
        if len(front) == 0:
            return None
        u, v = self.focal_px * front[:, 0] / front[:, 2] + self.cx, self.focal_px * front[:, 1] / front[:, 2] + self.cy
        x0, x1 = (int(np.clip(q, 0, self.width)) for q in (u.min() - margin_px, u.max() + margin_px))
        y0, y1 = (int(np.clip(q, 0, self.height)) for q in (v.min() - margin_px, v.max() + margin_px))
        return (x0, y0, x1, y1) if x1 - x0 > 3 and y1 - y0 > 3 else None


def together(boxes: Sequence[Box]) -> list[Box]:
    """Boxes that overlap become one."""
    left = list(boxes)
    merged = True
    while merged:
        merged = False
        for i in range(len(left)):
            for j in range(i + 1, len(left)):
                a, b = left[i], left[j]
                if a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]:
                    left[i] = (min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3]))
                    del left[j]
                    merged = True
                    break
            if merged:
                break
    return left


class Painter:
    """Renders a session's shots. Those with equal poses are rendered once."""

    def __init__(self, spec: Spec, scene: Scene, folder: Path, threads: int = 2) -> None:
        self.spec, self.scene, self.folder, self.threads = spec, scene, folder, threads
        self.canvas = Canvas.of(scene.camera)
        self._items = moving_items(scene)
        self._python = blender()
        self._crops: dict[tuple[Any, ...], list[tuple[str, Box]]] = {}
        folder.mkdir(parents=True, exist_ok=True)

    def render(self, shots: Sequence[Shot]) -> None:
        """Everything that the shots need, in one run of Blender; `picture` then puts it together."""
        samples = int(np.clip(CROP_SAMPLES[1] * PIXELS / (self.canvas.width * self.canvas.height), *CROP_SAMPLES))
        whole: Box = (0, 0, self.canvas.width, self.canvas.height)
        wanted: list[tuple[str, Box, int, Shot]] = [(STILL, whole, STILL_SAMPLES, {})]
        for shot in shots:
            if _key(shot) not in self._crops:
                boxes = self._boxes(shot)
                names = [f"crop{len(wanted) + k:05d}.npy" for k in range(len(boxes))]
                self._crops[_key(shot)] = list(zip(names, boxes))
                wanted += [(name, box, samples, shot) for name, box in zip(names, boxes)]
        self._run(wanted)

    @cached_property
    def still(self) -> Float32[Array, "h w 3"]:
        """The room on the canvas."""
        return np.load(self.folder / STILL).astype(np.float32)

    def picture(self, shot: Shot) -> Float32[Array, "h w 3"]:
        """What the lens sees of a shot that was rendered, in linear light, before exposure."""
        canvas = self.still.copy()
        for name, (x0, y0, x1, y1) in self._crops[_key(shot)]:
            weight, crop = _feather((y1 - y0, x1 - x0))[..., None], np.load(self.folder / name).astype(np.float32)
            canvas[y0:y1, x0:x1] = weight * crop + (1 - weight) * canvas[y0:y1, x0:x1]
        return cv2.remap(
            canvas, self.canvas.map_x, self.canvas.map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )

    def _boxes(self, shot: Shot) -> list[Box]:
        """Around what moves and the shadows it throws near by."""
        found = []
        from_world = self.scene.world_from_camera.inverse()
        for name, ends in shot.items():
            corners = _corners(self._items[name])
            for pose in ends:
                points = pose.points(corners)
                found.append(self.canvas.box_of(from_world.points(points)))
                if name == "object":
                    found += [self.canvas.box_of(from_world.points(s)) for s in self._shadows(points)]
        return together([b for b in found if b is not None])

    def _shadows(self, points_m: Array) -> list[Array]:
        middle = points_m.mean(axis=0)
        found = [points_m * [1, 1, 0]] if points_m[:, 2].min() < 0.15 else []
        for lamp in self.scene.lamps:
            at = np.array(lamp.position_m)
            share = at[2] / np.maximum(at[2] - points_m[:, 2], 0.1)
            spots = at + share[:, None] * (points_m - at)
            if np.linalg.norm((spots.mean(axis=0) - middle)[:2]) < SHADOWS_WITHIN_M:
                found.append(spots * [1, 1, 0])
        return found

    def _run(self, wanted: Sequence[tuple[str, Box, int, Shot]]) -> None:
        """Runs Blender on a job. Raises BadInput with the end of its log where it fails."""
        (self.folder / "job.json").write_text(json.dumps(self._job(wanted)))
        log, command = self.folder / "blender.log", [str(self._python), "-I", str(PROGRAM), str(self.folder)]
        with log.open("w") as out:
            code = subprocess.run(command, stdout=out, stderr=out).returncode
        if code:
            raise BadInput(f"Blender ended with {code}: {log.read_text()[-400:]}")

    def _job(self, wanted: Sequence[tuple[str, Box, int, Shot]]) -> dict[str, Any]:
        moving = [(name, item, True) for name, item in self._items.items()]
        standing = [(f"standing{k}", item, False) for k, item in enumerate(self.scene.standing)]
        np.save(self.folder / "surroundings.npy", self.scene.surroundings)
        c = self.canvas
        return {
            "seed": self.spec.seed, "threads": self.threads,
            "exposure_s": self.spec.camera.exposure_s, "readout_s": self.spec.camera.readout_s,
            "camera": {"width": c.width, "height": c.height, "focal_px": c.focal_px, "cx": c.cx, "cy": c.cy,
                       "world_from_camera": self.scene.world_from_camera.matrix.tolist()},
            "bodies": [self._stored(name, item, moves) for name, item, moves in (*standing, *moving)],
            "lamps": [asdict(lamp) for lamp in self.scene.lamps],
            "pictures": [
                {"out": name, "crop": box, "samples": samples,
                 "at": {k: [a.matrix.tolist(), b.matrix.tolist()] for k, (a, b) in shot.items()}}
                for name, box, samples, shot in wanted
            ],
        }  # fmt: skip

    def _stored(self, name: str, item: Item, moves: bool) -> dict[str, Any]:
        """A body's files, written once."""
        mesh = item.mesh
        if not (self.folder / f"{name}.npz").exists():
            height, width = mesh.atlas.shape[:2]
            uv = (mesh.corner_uv_px + 0.5) / [width, height]
            uv[..., 1] = 1 - uv[..., 1]
            np.savez(self.folder / f"{name}.npz", vertices=mesh.vertices_m.astype(np.float32), faces=mesh.faces,
                     uv=uv.astype(np.float32), normals=mesh.corner_normals.astype(np.float32))  # fmt: skip
            cv2.imwrite(str(self.folder / f"{name}.png"), color_image(mesh.atlas)[..., ::-1])
        finish = item.finish
        return {"name": name, "mesh": f"{name}.npz", "texture": f"{name}.png", "roughness": finish.roughness,
                "coat": finish.coat, "metallic": finish.metallic, "moving": moves}  # fmt: skip

    def close(self) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)


def _corners(item: Item) -> Array:
    low, high = item.mesh.vertices_m.min(axis=0), item.mesh.vertices_m.max(axis=0)
    return np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)])


def _key(shot: Shot) -> tuple[Any, ...]:
    """Equal for poses that agree to 10 micrometres."""
    return tuple(
        (name, *(tuple(np.round(p.matrix, 5).ravel() + 0.0) for p in ends)) for name, ends in sorted(shot.items())
    )


def _feather(shape: tuple[int, int]) -> Float32[Array, "h w"]:
    """1 inside, falling to 0 at the rim of a crop, so that no seam shows."""
    y, x = (np.minimum(np.arange(n) + 0.5, n - np.arange(n) - 0.5) for n in shape)
    return np.clip(np.minimum(y[:, None], x[None]) / FEATHER_PX, 0, 1).astype(np.float32)
