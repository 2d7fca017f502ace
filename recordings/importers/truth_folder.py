"""The `*_truth` layout: what a real lab would not know, read into a session's truth/. Only for scoring."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings.bounded.limits import open_npz
from recordings.errors import BadInput, WriteFailed
from recordings.importers.common import Warnings, read_bytes, read_json_object
from recordings.records import StampedPose
from recordings.session_writer import toss_name, write_truth

SAME_FRAME_NS = 1_000_000
"""A true pose belongs to the colour frame this near: the layout rounds its times to microseconds."""
KEPT_FOLDERS = ("masks", "robot_masks")
KEPT_FILES = ("toss_gt.json", "states_148hz.npz", "poses_at_mono_times.npz")
DOCUMENTS = ("physics", "object_tags", "calibration", "sensor_truth")


@dataclass(frozen=True, eq=False)
class TrueToss:
    """True poses of one toss, times in seconds on the toss's own clock. `phase` per pose, where the layout tells."""

    number: int
    folder: Path
    time_s: Float[Array, " n"]
    world_from_object: Float[Array, "n 4 4"]
    phase: tuple[str, ...]
    about: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class TruthFolder:
    """A `*_truth` folder. `documents`: physics, object_tags, calibration, sensor_truth as they are there."""

    path: Path
    tosses: Mapping[int, TrueToss]
    mesh_obj: bytes | None
    documents: Mapping[str, Any]


def read_truth_folder(path: Path) -> TruthFolder:
    """Read a `*_truth` folder. Raises BadInput."""
    folders = sorted(p for p in path.glob("toss_*") if p.is_dir() and p.name[5:].isdigit())
    if not folders:
        raise BadInput(f"{path} has no tosses; wanted a truth folder: toss_00/poses_camera_object.npz, mesh.obj, ...")
    mesh = path / "mesh.obj"
    documents = {n: read_json_object(path / f"{n}.json") for n in DOCUMENTS if (path / f"{n}.json").exists()}
    tosses = {int(f.name[5:]): _read_toss(f) for f in folders}
    return TruthFolder(path, tosses, read_bytes(mesh) if mesh.exists() else None, documents)


def _read_toss(folder: Path) -> TrueToss:
    path = folder / "poses_camera_object.npz"
    read_bytes(path)  # says plainly when it is missing, empty or not to be read
    try:
        with open_npz(path) as stored:
            time_s = stored["t"].reshape(-1).astype(np.float64)
            world, d455 = (stored[k].astype(np.float64) for k in ("T_world_object", "T_camera_object"))
            phase = tuple(str(p) for p in stored["phase"]) if "phase" in stored else ()
    except (OSError, ValueError, KeyError) as wrong:
        raise BadInput(f"{path}: {wrong}; wanted t, T_camera_object and T_world_object") from wrong
    if world.shape != (len(time_s), 4, 4) or d455.shape != world.shape:
        raise BadInput(
            f"{path}: {len(time_s)} times, poses of shape {world.shape} and {d455.shape}; wanted as many 4x4"
        )
    about = read_json_object(folder / "toss_gt.json") if (folder / "toss_gt.json").exists() else {}
    return TrueToss(int(folder.name[5:]), folder, time_s, world, phase, about)


def import_truth(
    true: TruthFolder,
    session: Path,
    color_ns: Mapping[int, Int64[Array, " n"]],
    offsets_ns: Mapping[int, int],
    warnings: Warnings,
) -> Path:
    """Write truth/ of a session from a truth folder: poses at the colour frames' own times, masks and states beside."""
    missing, without = sorted(set(color_ns) - set(true.tosses)), sorted(set(true.tosses) - set(color_ns))
    if missing:
        warnings.add(f"the truth has nothing about tosses {missing}")
    if without:
        warnings.add(f"the truth tells of tosses {without}, which the recording does not have: left out")
    kept = {n: t for n, t in true.tosses.items() if n in color_ns}
    if not kept:
        raise BadInput(
            f"{true.path} has tosses {without}, the recording {sorted(color_ns)}; wanted the truth of this recording"
        )
    poses = {n: _stamped(t, color_ns[n], offsets_ns[n]) for n, t in kept.items()}
    folder = write_truth(session, poses, _info(true, kept, offsets_ns), true.mesh_obj)
    for number, toss in kept.items():
        _copy(toss.folder, folder / toss_name(number))
    for extra in ("texture.mtl", "texture.png"):
        if true.mesh_obj is not None and (true.path / extra).exists():
            _copy_file(true.path / extra, folder / extra)
    return folder


def _stamped(toss: TrueToss, color_ns: Int64[Array, " n"], offset_ns: int) -> list[StampedPose]:
    own_ns = np.rint(toss.time_s * 1e9).astype(np.int64) + offset_ns
    nearest = color_ns[np.abs(own_ns[:, None] - color_ns[None, :]).argmin(1)]
    same = np.abs(nearest - own_ns) <= SAME_FRAME_NS
    if not same.any():
        raise BadInput(
            f"{toss.folder}: none of its {len(own_ns)} times is that of a colour frame; wanted the truth of this toss"
        )
    times_ns = np.where(same, nearest, own_ns)
    return [StampedPose(int(t), "world", "object", m) for t, m in zip(times_ns, toss.world_from_object, strict=True)]


def _info(true: TruthFolder, kept: Mapping[int, TrueToss], offsets_ns: Mapping[int, int]) -> dict[str, Any]:
    tosses = {
        toss_name(n): {"clock_offset_ns": offsets_ns[n], "phase": list(t.phase), **t.about} for n, t in kept.items()
    }
    info = {
        "source": f"import folder --truth {true.path.resolve().name}",
        "accuracy": None,
        "tosses": tosses,
        **true.documents,
    }
    if "object_tags" in true.documents:  # its tags are placed in the object's own frame
        info["object_from_tagged"] = np.eye(4).tolist()
    return info


def _copy(source: Path, target: Path) -> None:
    for name in KEPT_FILES:
        if (source / name).exists():
            _copy_file(source / name, target / name)
    for name in KEPT_FOLDERS:
        for file in sorted((source / name).glob("*.png")):
            _copy_file(file, target / name / file.name)


def _copy_file(source: Path, target: Path) -> None:
    data = read_bytes(source)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    except OSError as refused:
        raise WriteFailed(f"{target} could not be written: {refused.strerror}") from refused
