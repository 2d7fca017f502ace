"""The neural field: how fast it reaches which surface, at the true poses and masks, so that nothing but the field
differs; and without a network (fused views alone: the floor of the other figures).

python tools/bench_field.py                                   # cube_dev, CPU
python tools/bench_field.py --device cuda --steps 50,150 DIR   # sessions in the folder layout, truth in DIR_truth

One thread; CPU seconds (on a GPU also wall seconds, which include waiting for it).
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import torch
import trimesh

from processing.evaluate.metrics import chamfer, icp_align, surface_points
from processing.field.fuse import fuse
from processing.field.learn import LearnConfig
from processing.field.mesh import extract_mesh, grid_mesh
from processing.field.train import FieldConfig, train_field
from processing.field.views import FieldView, make_view
from recordings.geometry import CameraModel
from recordings.importers.folder import import_folder
from recordings.session import Session
from recordings.tracks import ObjectShape

CAMERA = "d455"
DATA = Path(os.environ.get("TOSSLAB_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="*", type=Path, default=[DATA / "cube_dev"])
    parser.add_argument("--steps", default="0,50,150", help="optimiser steps, comma separated")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--pose-rounds", type=int, default=0, help="rounds of pose refinement (timed with the rest)")
    given = parser.parse_args()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    steps = [int(s) for s in given.steps.split(",")]
    with tempfile.TemporaryDirectory() as place:
        for folder in given.folders:
            import_folder(folder, Path(place) / folder.name, None, None)
            views = look(Session.open(Path(place) / folder.name), truth_of(folder))
            bench(folder, views, steps, given.pose_rounds, given.device)
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.2f} GB")
    return 0


def truth_of(folder: Path) -> Path:
    return folder.with_name(folder.name + "_truth")


def look(session: Session, truth: Path) -> list[FieldView]:
    """As many views as the pipeline takes, at true poses and with true masks."""
    camera, places = session.calibration.camera(CAMERA), []
    for n in session.tosses:
        with np.load(truth / f"toss_{n:02d}" / "poses_camera_object.npz", allow_pickle=False) as stored:
            poses = stored["T_camera_object"].reshape(-1, 4, 4)
        masks = sorted((truth / f"toss_{n:02d}" / "masks").glob("*.png"))
        places += [(n, i, poses[i], masks[i]) for i in range(len(poses)) if np.isfinite(poses[i]).all()]
    chosen = np.unique(np.linspace(0, len(places) - 1, LearnConfig().most_views).astype(int))
    views = [seen(session, camera, *places[i]) for i in chosen]
    return [v for v in views if v is not None]


def seen(session: Session, camera: CameraModel, toss: int, i: int, pose: np.ndarray, mask: Path) -> FieldView | None:
    inside = np.asarray(cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)) > 0
    return make_view(session.toss(toss).rgbd(CAMERA)[i], inside, camera, pose, pose)


def bench(folder: Path, views: list[FieldView], steps: list[int], pose_rounds: int, device: str) -> None:
    truth = trimesh.load(truth_of(folder) / "mesh.obj", force="mesh", process=False)
    config = FieldConfig(pose_rounds=pose_rounds)
    start = time.process_time()
    shape = grid_mesh(fuse(views, config.fuse))
    fused_s = time.process_time() - start
    print(f"{folder.name}, {len(views)} views, fused only: {surface(shape, truth)}, {fused_s:.1f} CPU-s")
    for count in steps:
        cpu, wall = time.process_time(), time.monotonic()
        trained = train_field(views, replace(config, steps=count), device)
        shape = extract_mesh(trained.field, trained.grid)
        cpu, wall = time.process_time() - cpu, time.monotonic() - wall
        spent = f"{cpu:.1f} CPU-s" + (f", {wall:.1f} s" if device != "cpu" else "")
        print(f"{folder.name} {count} steps on {device}: {surface(shape, truth)}, {spent}", flush=True)


def surface(shape: ObjectShape, truth: trimesh.Trimesh) -> str:
    """Chamfer distance after a rigid ICP."""
    mesh = trimesh.Trimesh(shape.vertices_m, shape.faces, process=False)
    mesh.apply_transform(icp_align(surface_points(mesh, 6000), surface_points(truth, 30000)))
    found = chamfer(mesh, truth)
    return f"CD {found.cm:.4f} cm ({1000 * found.estimate_to_truth_m:.2f} / {1000 * found.truth_to_estimate_m:.2f} mm)"


if __name__ == "__main__":
    sys.exit(main())
