"""Small recordings of other layouts, written as their makers write them, independently of tosslab's exporters."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT, FRAMES = 64, 48, 5
K = [[60.0, 0.0, 31.0], [0.0, 61.0, 24.5], [0.0, 0.0, 1.0]]
WORLD_FROM_CAMERA = [[1.0, 0, 0, 0.1], [0, -1.0, 0, 0.2], [0, 0, -1.0, 0.8], [0, 0, 0, 1]]


def smooth_image(seed: int, grey: bool = False) -> np.ndarray:
    small = np.random.default_rng(seed).integers(0, 255, (6, 8) if grey else (6, 8, 3), dtype=np.uint8)
    return cv2.resize(small, (WIDTH, HEIGHT))


def depth_image(seed: int) -> np.ndarray:
    raw = np.random.default_rng(seed).integers(0, 2000, (HEIGHT, WIDTH)).astype(np.uint16)
    raw[0, :4] = [0, 1, 65535, 32768]
    return raw


@dataclass(frozen=True)
class Layout:
    """A folder layout on disk, to be spoilt by a test."""

    path: Path

    @property
    def toss(self) -> Path:
        return self.path / "toss_00"

    def edit(self, name: str, change: Callable[[dict[str, Any]], None]) -> None:
        document = json.loads((self.path / name).read_text())
        change(document)
        (self.path / name).write_text(json.dumps(document))

    def lines(self, name: str, change: Callable[[list[str]], list[str]]) -> None:
        lines = (self.toss / name).read_text().splitlines()
        (self.toss / name).write_text("\n".join(change(lines)) + "\n")


def _write_toss(folder: Path, seed: int) -> None:
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(FRAMES):
        cv2.imwrite(str(folder / "rgb" / f"{i:06d}.jpg"), smooth_image(seed + i))
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), depth_image(seed + i))
    times_s = [0.0, 0.033001, 0.066657, 0.133321, 0.166654]
    (folder / "timestamps.txt").write_text("".join(f"{t:.6f}\n" for t in times_s))
    (folder / "toss.json").write_text(json.dumps({"release_time_s": 0.1, "frames": FRAMES}))
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[10:20, 20:30] = 255
    cv2.imwrite(str(folder / "mask_first.png"), mask)
    rows = [",".join(["time_s", *(f"q{j}" for j in range(1, 8)), *(f"dq{j}" for j in range(1, 8)), "finger_width_m"])]
    values = np.random.default_rng(seed).normal(size=(200, 15))
    rows += [",".join([f"{k / 1000:.3f}", *(f"{v:.6f}" for v in row)]) for k, row in enumerate(values)]
    (folder / "arm.csv").write_text("\n".join(rows) + "\n")


def _write_mono(folder: Path) -> None:
    cameras = [{"name": f"mono{i}", "K": K, "distortion": [0] * 5, "width": WIDTH, "height": HEIGHT} for i in range(2)]
    board = {"family": "tag36h11", "tags": [{"id": 100, "size_m": 0.05, "T_board_tag": np.eye(4).tolist()}]}
    (folder / "mono").mkdir()
    document = {"cameras": cameras, "response": "linear", "calibration_board": board}
    (folder / "mono" / "cameras.json").write_text(json.dumps(document))
    for camera in cameras:
        images = folder / "mono" / "toss_00" / str(camera["name"])
        images.mkdir(parents=True)
        for i in range(FRAMES):
            cv2.imwrite(str(images / f"{i:06d}.jpg"), smooth_image(i, grey=True))
        for view in range(2):
            place = folder / "calibration" / f"view_{view:02d}"
            place.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(place / f"{camera['name']}.png"), smooth_image(view, grey=True))
            cv2.imwrite(str(place / "rgb.png"), smooth_image(view))
            cv2.imwrite(str(place / "depth.png"), depth_image(view))
    times = "".join(f"{0.0061 + i / 30:.6f}\n" for i in range(FRAMES))
    (folder / "mono" / "toss_00" / "timestamps.txt").write_text(times)


@pytest.fixture
def layout(tmp_path: Path) -> Layout:
    """Tosses 0 and 3 of the folder layout, with an arm, mono cameras of toss 0 and a calibration board."""
    folder = tmp_path / "recording"
    for number in (0, 3):
        _write_toss(folder / f"toss_{number:02d}", seed=10 * number)
    _write_mono(folder)
    camera = {"K": K, "distortion": [-0.05, 0.06, 6e-4, -4e-4, -0.02], "width": WIDTH, "height": HEIGHT, "fps": 30.0}
    tags = {"family": "tag36h11", "tags": [{"id": 30, "size_m": 0.08, "T_world_tag": np.eye(4).tolist()}]}
    document = {
        "object": "prism",
        "arm": "franka_panda",
        "camera": {**camera, "depth_unit_m": 0.001, "depth_invalid": 0, "depth_aligned_to_color": True},
        "T_world_camera": WORLD_FROM_CAMERA,
        "T_world_base": [[0.0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
        "table_tags": tags,
        "notes": "made by a test",
    }
    (folder / "session.json").write_text(json.dumps(document))
    return Layout(folder)


@pytest.fixture
def layout_truth(layout: Layout, tmp_path: Path) -> Path:
    """The truth of `layout`, times rounded to microseconds as the real ones are."""
    folder = tmp_path / "recording_truth"
    world_from_camera = np.array(WORLD_FROM_CAMERA, dtype=np.float64)
    for number in (0, 3):
        toss = folder / f"toss_{number:02d}"
        (toss / "masks").mkdir(parents=True)
        times_s = np.loadtxt(layout.path / toss.name / "timestamps.txt") + 4e-7
        world = np.tile(np.eye(4), (FRAMES, 1, 1))
        world[:, 2, 3] = 0.05 * np.arange(FRAMES)
        np.savez(
            toss / "poses_camera_object.npz",
            t=times_s,
            T_world_object=world,
            T_camera_object=np.linalg.inv(world_from_camera) @ world,
            phase=np.array(["hold", "free", "free", "free", "rest"]),
        )
        (toss / "toss_gt.json").write_text(json.dumps({"rest_time_s": 0.15}))
        for i in range(FRAMES):
            cv2.imwrite(str(toss / "masks" / f"{i:06d}.png"), np.full((HEIGHT, WIDTH), 255 * (i % 2), dtype=np.uint8))
    (folder / "physics.json").write_text(json.dumps({"mass_kg": 0.37}))
    (folder / "object_tags.json").write_text(json.dumps({"family": "tag36h11", "tags": []}))
    (folder / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    return folder


@pytest.fixture
def bundlesdf_folder(tmp_path: Path) -> Path:
    """A BundleSDF folder: five frames, one mask, poses of all."""
    folder = tmp_path / "milk"
    for name in ("rgb", "depth", "masks", "annotated_poses"):
        (folder / name).mkdir(parents=True)
    for i in range(FRAMES):
        cv2.imwrite(str(folder / "rgb" / f"{i:06d}.png"), smooth_image(i))
        cv2.imwrite(str(folder / "depth" / f"{i:06d}.png"), depth_image(i))
        pose = np.eye(4)
        pose[2, 3] = 0.5 + 0.01 * i
        np.savetxt(folder / "annotated_poses" / f"{i:06d}.txt", pose)
    mask = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    mask[10:20, 20:30] = 255
    cv2.imwrite(str(folder / "masks" / "000000.png"), mask)
    np.savetxt(folder / "cam_K.txt", np.array(K))
    return folder
