"""Geometry without pictures: a rig of cameras, a board, views of it with known noise. And one real set of pictures."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.cameras.targets import Tags, TargetView
from recordings.geometry import CameraModel

CAMERAS = ("d455", "mono0", "mono1", "mono2")


def pose(turn, at):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), at
    return out


@dataclass(frozen=True)
class Geometry:
    """A board and cameras around it; `view` is what a camera sees of points on a body."""

    board: Tags

    @staticmethod
    def pose(turn, at):
        return pose(np.asarray(turn, dtype=float), np.asarray(at, dtype=float))

    @staticmethod
    def camera(name="cam", focal=600.0, size=(640, 480), **lens):
        K = np.array([[focal, 0, size[0] / 2 + 3], [0, focal * 1.002, size[1] / 2 - 4], [0, 0, 1.0]])
        return CameraModel(name, *size, K, **lens)

    def points(self):
        ids = np.concatenate([4 * i + np.arange(4) for i in self.board.size_m])
        return ids, np.concatenate([self.board.corners_m(i) for i in self.board.size_m])

    def view(self, model, camera_from_board, rng, sigma_px=0.1):
        ids, points = self.points()
        pixels = model.project(points @ camera_from_board[:3, :3].T + camera_from_board[:3, 3])
        seen = np.isfinite(pixels).all(axis=1) & model.sees(pixels)
        pixels = pixels[seen] + sigma_px * rng.normal(size=(int(seen.sum()), 2))
        covariance = np.tile(sigma_px**2 * np.eye(2), (int(seen.sum()), 1, 1))
        return TargetView(ids[seen], points[seen], pixels, covariance)

    @staticmethod
    def tilted(rng, distance=(0.5, 0.8), reach=0.12, tilt_deg=45.0):
        """camera_from_board: facing the camera, tilted any way."""
        axis = rng.uniform(0, 2 * np.pi)
        tilt = np.radians(rng.uniform(5, tilt_deg)) * np.array([np.cos(axis), np.sin(axis), 0])
        turn = Rotation.from_rotvec(tilt) * Rotation.from_euler("xz", [np.pi, rng.uniform(-np.pi, np.pi)])
        return pose(turn.as_rotvec(), [*rng.uniform(-reach, reach, 2), rng.uniform(*distance)])


@pytest.fixture(scope="session")
def geometry():
    places = {}
    for row in range(4):
        for column in range(5):
            place = np.diag([-1.0, 1.0, -1.0, 1.0])
            place[:3, 3] = [(column - 2) * 0.065, (1.5 - row) * 0.065, 0.003]
            places[100 + 5 * row + column] = place
    return Geometry(Tags("tag36h11", dict.fromkeys(places, 0.0508), places))


@pytest.fixture(scope="session")
def cube_session(data, tmp_path_factory):
    """cube_dev's first toss, its mono cameras and its calibration views as a session."""
    from calibration.cli import main
    from recordings.importers.folder import import_folder

    source, folder = data("cube_dev"), tmp_path_factory.mktemp("cube")
    layout = folder / "layout"
    (layout / "mono").mkdir(parents=True)
    for name in ("session.json", "toss_00", "calibration", "mono/cameras.json", "mono/toss_00"):
        (layout / name).symlink_to(source / name)
    import_folder(layout, folder / "cube")
    main(["cameras", str(folder / "cube"), "--dry-run", "--json"])  # finds the board's tags once for all tests
    return folder / "cube"


@pytest.fixture
def cube_copy(cube_session, tmp_path):
    """A session to change; what was already found in its pictures comes along."""
    shutil.copytree(cube_session, tmp_path / "cube")
    return tmp_path / "cube"


@pytest.fixture(scope="session")
def cube_truth(data):
    """d455_from_<camera> as rendered."""
    document = json.loads((Path(data("cube_dev_truth")) / "calibration.json").read_text())
    return {name: np.array(matrix) for name, matrix in document["T_d455_mono"].items()}
