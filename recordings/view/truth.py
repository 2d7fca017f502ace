"""How the ground truth was found, in rerun: tags with what is left of their corners, cameras and path with uncertainty.

The layers are what `toss-truth` leaves in truth/tags/: cameras.json, and toss_XX.npz with every tag that was used.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.bounded.documents import read_json
from recordings.bounded.limits import open_npz
from recordings.errors import DamagedFile
from recordings.view.layers import Clock, image_entity, quaternions_xyzw
from recordings.view.scene import Scene

SEEN_COLOR, LEFT_COLOR, SIGMA_COLOR = (70, 230, 120), (255, 70, 70), (255, 160, 40)
LEFT_GAIN = 200.0
"""Arrows of what is left are drawn this many times longer."""
SIGMAS = 30.0
"""Ellipsoids are drawn at this many standard deviations: three would not be seen."""
SAID_ABOVE_M = 0.09
TAGS, CAMERAS, PATH = "truth_tags", "world/path/truth_cameras", "world/path/truth_sigma"


def log_truth(clock: Clock, scene: Scene) -> None:
    """Nothing where the session's truth was not made by toss-truth. Raises DamagedFile for unreadable files."""
    folder = scene.session.truth_folder if scene.session is not None else None
    file = None if folder is None else folder / "tags" / f"toss_{clock.toss:02d}.npz"
    if folder is None or file is None or not file.exists() or scene.root != "world":
        return
    try:
        with open_npz(file) as stored:
            data = {name: stored[name] for name in stored.files}
        cameras = read_json(folder / "tags" / "cameras.json")
        log_tags(clock, scene, data, cameras["names"])
        log_cameras(clock, scene, cameras["cameras"])
        log_path_sigma(clock, scene, data)
    except (OSError, ValueError, KeyError, IndexError) as wrong:
        raise DamagedFile(f"{file} cannot be shown ({type(wrong).__name__}: {wrong}); run toss-truth again") from wrong


def log_tags(clock: Clock, scene: Scene, data: dict[str, Array], names: list[str]) -> None:
    """Every tag's outline as seen, and arrows from its corners to where they should be, LEFT_GAIN times as long."""
    for number, name in enumerate(names):
        entity = f"{image_entity(scene, name)}/{TAGS}"
        for time_ns in np.unique(data["time_ns"][data["camera"] == number]).tolist():
            mine = (data["camera"] == number) & (data["time_ns"] == time_ns)
            seen, left = data["seen_px"][mine], data["left_px"][mine]
            loops = np.concatenate([seen, seen[:, :1]], axis=1)
            labels = [f"{i}" for i in data["tag_id"][mine]]
            at = clock.at(int(time_ns))
            at.log(f"{entity}/seen", rr.LineStrips2D(loops, colors=[SEEN_COLOR], labels=labels, radii=-1.0))
            arrows = rr.Arrows2D(
                origins=seen.reshape(-1, 2),
                vectors=-LEFT_GAIN * left.reshape(-1, 2),
                colors=[LEFT_COLOR],
                radii=-1.5,
            )
            at.log(f"{entity}/left_x{LEFT_GAIN:.0f}", arrows)


def log_cameras(clock: Clock, scene: Scene, cameras: dict[str, Any]) -> None:
    """Where the solution has the cameras, as ellipsoids of their uncertainty."""
    poses = np.array([c["world_from_camera"] for c in cameras.values()], dtype=np.float64).reshape(-1, 4, 4)
    covariances = np.array([c["covariance"] for c in cameras.values()], dtype=np.float64).reshape(-1, 6, 6)
    labels = [f"+-{1000 * np.sqrt(np.trace(C[3:, 3:])):.2f} mm" for C in covariances]
    at = clock.at(scene.spans_ns[clock.toss][0])
    at.log(CAMERAS, ellipsoids(poses, covariances))
    # above the camera: its name stands beside it already
    above = poses[:, :3, 3] + np.array([0.0, 0.0, SAID_ABOVE_M])
    at.log(f"{CAMERAS}/said", rr.Points3D(above, labels=labels, colors=[SIGMA_COLOR], radii=0.0005))


def log_path_sigma(clock: Clock, scene: Scene, data: dict[str, Array]) -> None:
    """Uncertainty of the tagged frame's origin at every instant of the ground-truth cameras."""
    if len(data["track_time_ns"]) == 0:
        return
    start_ns = scene.spans_ns[clock.toss][0]
    drawn = ellipsoids(data["track_world_from_tagged"], data["track_covariance"])
    clock.at(start_ns).log(PATH, drawn)


def ellipsoids(poses: Float[Array, "n 4 4"], covariances: Float[Array, "n 6 6"]) -> rr.Ellipsoids3D:
    """SIGMAS standard deviations of the translation part (each covariance is in its pose's own frame)."""
    values, vectors = np.linalg.eigh(covariances[:, 3:, 3:])
    turns = poses[:, :3, :3] @ vectors
    turns[np.linalg.det(turns) < 0, :, 0] *= -1
    return rr.Ellipsoids3D(
        centers=poses[:, :3, 3],
        half_sizes=SIGMAS * np.sqrt(np.maximum(values, 0.0)),
        quaternions=quaternions_xyzw(turns),
        colors=[SIGMA_COLOR],
        line_radii=-0.7,
    )
