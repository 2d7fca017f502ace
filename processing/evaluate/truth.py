"""The one door to ground truth. It is opened for scores only, after every track and shape is written.

Two layouts: a session's `truth/` (toss_XX.mcap with `/groundtruth/pose`, truth.json, mesh.obj) and the `*_truth`
folder of the folder layout (toss_XX/poses_camera_object.npz, mesh.obj). Nothing looks for folders beside the input.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from processing.run import StartPose
from recordings.bounded.documents import json_object
from recordings.bounded.limits import open_npz
from recordings.errors import BadInput, DamagedFile
from recordings.geometry import Transform
from recordings.session import Session, Toss
from recordings.tracks import ObjectTrack, RigCalibration

MEETS_S = 0.005
"""A truth pose belongs to a frame when it is this near in time."""


@dataclass(frozen=True, eq=False)
class Truth:
    """An opened truth folder."""

    folder: Path
    calibration: RigCalibration
    mesh_path: Path | None

    @property
    def friction(self) -> float | None:
        """The true coefficient of friction, where the folder knows it."""
        known = _read_document(self.folder / "physics.json") or _read_document(self.folder / "truth.json").get(
            "physics"
        )
        value = known.get("friction_mu") if isinstance(known, dict) else None
        return float(value) if isinstance(value, int | float) else None

    def camera_from_object(self, track: ObjectTrack) -> Float[Array, "n 4 4"] | None:
        """True poses in the frames of a track, NaN where the truth has none there; None where it has no such toss."""
        name = f"toss_{track.toss:02d}"
        if (self.folder / name / "poses_camera_object.npz").exists():
            times_ns, poses = _folder_poses(self.folder / name / "poses_camera_object.npz", int(track.time_ns[0]))
        elif (self.folder / f"{name}.mcap").exists():
            times_ns, poses = self._session_poses(self.folder / f"{name}.mcap", track.camera)
        else:
            return None
        return _at_frames(track.time_ns, times_ns, poses)

    def _session_poses(self, path: Path, camera: str) -> tuple[Int64[Array, " m"], Float[Array, "m 4 4"]]:
        # next to impacts the truth itself is less sure ("interpolated"); leaving those frames out would flatter
        stamped = [p for p in Toss(path).poses("/groundtruth/pose") if p.status != "lost"]
        object_from_tagged = self._object_from_tagged()
        poses = np.full((len(stamped), 4, 4), np.nan)
        for i, p in enumerate(stamped):
            pose = Transform.from_matrix(p.target, p.source, p.matrix)
            if pose.source == "tagged" and object_from_tagged is not None:
                pose = pose @ object_from_tagged.inverse()
            if pose.target != camera:
                pose = self.calibration.transform(camera, pose.target) @ pose
            poses[i] = pose.matrix
        return np.array([p.time_ns for p in stamped], dtype=np.int64), poses

    def _object_from_tagged(self) -> Transform | None:
        stored = _read_document(self.folder / "truth.json").get("object_from_tagged")
        if stored is None:
            return None
        matrix = stored["matrix"] if isinstance(stored, dict) else stored
        return Transform.from_matrix("object", "tagged", np.array(matrix, dtype=np.float64))


def start_poses(given: Path | None, session: Session, tosses: Sequence[int], camera: str) -> dict[int, StartPose]:
    """`--start truth`: the first true pose of every toss, the one exception to the door's rule. Raises BadInput where
    there is no truth, or none of a toss."""
    truth = open_truth(given, session, session.calibration)
    if truth is None:
        raise BadInput(f"--start truth: {session.path} has no truth/; give one by --truth DIR")
    found = {}
    for toss in tosses:
        times_ns = session.toss(toss).rgbd(camera).times_ns
        poses = truth.camera_from_object(ObjectTrack.nowhere(toss, camera, times_ns))
        known = np.flatnonzero(np.isfinite(poses[:, 0, 0])) if poses is not None else np.zeros(0, dtype=np.int64)
        if poses is None or len(known) == 0:
            raise BadInput(f"--start truth: {truth.folder} has no true pose in toss {toss}")
        first = int(known[0])
        found[toss] = StartPose(first, Transform.from_matrix(camera, "object", poses[first]))
    return found


def open_truth(given: Path | None, session: Session, calibration: RigCalibration) -> Truth | None:
    """`--truth DIR` where it is given, else the session's own truth/, else None. Raises BadInput for a wrong DIR."""
    folder = given if given is not None else session.truth_folder
    if folder is None:
        return None
    has_poses = bool(list(folder.glob("toss_*/poses_camera_object.npz")) or list(folder.glob("toss_*.mcap")))
    if not has_poses:
        raise BadInput(
            f"{folder} is no truth: wanted toss_XX.mcap (a session's truth/) or toss_XX/poses_camera_object.npz "
            "(a *_truth folder)"
        )
    mesh = folder / "mesh.obj"
    return Truth(folder, calibration, mesh if mesh.exists() else None)


def _folder_poses(path: Path, first_frame_ns: int) -> tuple[Int64[Array, " m"], Float[Array, "m 4 4"]]:
    """Poses of the folder layout; its times count from the toss's first colour frame."""
    try:
        with open_npz(path) as stored:
            times_s, poses = stored["t"].reshape(-1), stored["T_camera_object"].reshape(-1, 4, 4)
    except (OSError, KeyError, ValueError) as wrong:
        raise DamagedFile(f"{path} cannot be read as true poses ({wrong})") from wrong
    return np.rint(times_s * 1e9).astype(np.int64) + first_frame_ns, poses.astype(np.float64)


def _at_frames(
    frame_times_ns: Int64[Array, " n"], times_ns: Int64[Array, " m"], poses: Float[Array, "m 4 4"]
) -> Float[Array, "n 4 4"]:
    out = np.full((len(frame_times_ns), 4, 4), np.nan)
    if len(times_ns) == 0:
        return out
    for i, time_ns in enumerate(frame_times_ns):
        nearest = int(np.abs(times_ns - time_ns).argmin())
        if abs(int(times_ns[nearest]) - int(time_ns)) <= MEETS_S * 1e9:
            out[i] = poses[nearest]
    return out


def _read_document(path: Path) -> dict[str, object]:
    try:
        return json_object(path.read_bytes())
    except OSError:
        return {}
