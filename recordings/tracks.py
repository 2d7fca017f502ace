"""What is learned or calibrated: tracks, shapes, the rig's calibration, contact models, scores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Int64, UInt8
from numpy import ndarray as Array

from recordings.bounded.documents import read_json
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform

CALIBRATION_FORMAT = 1
Status = Literal["tracked", "interpolated", "lost"]


@dataclass(frozen=True, eq=False)
class ObjectTrack:
    """The object's pose in every colour frame of one toss: 4x4 `camera_from_object`.

    A lost frame's pose is NaN: it never carries a silent pose. `covariance` is 6x6 per frame of
    (rotation vector in the camera frame in rad, translation in m), NaN where it is not known.
    """

    toss: int
    camera: str
    object_frame: str
    time_ns: Int64[Array, " n"]
    camera_from_object: Float[Array, "n 4 4"]
    status: tuple[Status, ...]
    covariance: Float[Array, "n 6 6"]

    def __post_init__(self) -> None:
        lost = np.array([s == "lost" for s in self.status], dtype=bool)
        finite = np.isfinite(self.camera_from_object).all(axis=(1, 2))
        if len(self.status) != len(self.time_ns) or bool((lost & finite).any()) or bool((~lost & ~finite).any()):
            raise BadInput(
                f"track of toss {self.toss}: status and poses disagree; a pose must be NaN exactly where it is lost"
            )

    @staticmethod
    def nowhere(toss: int, camera: str, time_ns: Int64[Array, " n"]) -> ObjectTrack:
        """A track of these times without a pose: every frame is lost."""
        n = len(time_ns)
        status: tuple[Status, ...] = tuple("lost" for _ in range(n))
        poses, covariance = np.full((n, 4, 4), np.nan), np.full((n, 6, 6), np.nan)
        return ObjectTrack(toss, camera, "object", time_ns, poses, status, covariance)

    @property
    def lost(self) -> Bool[Array, " n"]:
        return np.array([s == "lost" for s in self.status], dtype=bool)

    def pose(self, frame: int) -> Transform | None:
        """`camera_from_object` of one frame; None where it is lost."""
        if self.status[frame] == "lost":
            return None
        return Transform.from_matrix(self.camera, self.object_frame, self.camera_from_object[frame])


@dataclass(frozen=True, eq=False)
class ObjectShape:
    """A triangle mesh in the object frame, metres. `observed` marks the vertices that some camera ray supports."""

    object_frame: str
    source: str
    vertices_m: Float[Array, "v 3"]
    faces: Int[Array, "f 3"]
    vertex_rgb: UInt8[Array, "v 3"] | None = None
    observed: Bool[Array, " v"] | None = None


@dataclass(frozen=True)
class TagPlacement:
    """An AprilTag fixed to the table: `world_from_tag` with the tag frame x right, y down, z into the paper."""

    tag_id: int
    size_m: float
    world_from_tag: Transform


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """Where everything is: camera models by name, and transforms between named frames.

    Camera names: `d455` (colour), `d455_depth` (only where depth is not aligned to colour), `mono0` and so on.
    `transforms` hold `world_from_d455`, `world_from_base`, `d455_from_d455_depth`, ... each under its own name.
    `created_unix_s` and `residuals` say how old and how good; a plane that is not given is z = 0 of `world`.
    """

    cameras: Mapping[str, CameraModel]
    transforms: tuple[Transform, ...] = ()
    table_tags: tuple[TagPlacement, ...] = ()
    tag_family: str = "tag36h11"
    created_unix_s: float | None = None
    residuals: Mapping[str, Any] = field(default_factory=dict)

    def camera(self, name: str) -> CameraModel:
        if name not in self.cameras:
            raise BadInput(f"the calibration has no camera '{name}'; it has {sorted(self.cameras) or 'none'}")
        return self.cameras[name]

    def find(self, target: str, source: str) -> Transform | None:
        """`target_from_source`, chained over the stored transforms and their inverses; None if not connected."""
        edges: dict[str, list[Transform]] = {}
        for t in self.transforms:
            edges.setdefault(t.target, []).append(t)
            edges.setdefault(t.source, []).append(t.inverse())
        reached = {target: Transform.identity(target, target)}
        queue = [target]
        while queue:
            here = queue.pop(0)
            if here == source:
                return reached[here]
            for step in edges.get(here, []):
                if step.source not in reached:
                    reached[step.source] = reached[here] @ step
                    queue.append(step.source)
        return None

    def transform(self, target: str, source: str) -> Transform:
        found = self.find(target, source)
        if found is None:
            known = sorted(str(t) for t in self.transforms)
            raise BadInput(
                f"the calibration does not connect '{target}' and '{source}'; it has {known or 'no transforms'}"
            )
        return found

    def to_json(self) -> dict[str, Any]:
        return {
            "format_version": CALIBRATION_FORMAT,
            "created_unix_s": self.created_unix_s,
            "cameras": {name: _camera_to_json(c) for name, c in self.cameras.items()},
            "transforms": [
                {"target": t.target, "source": t.source, "matrix": t.matrix.tolist()} for t in self.transforms
            ],
            "tag_family": self.tag_family,
            "table_tags": [
                {"id": t.tag_id, "size_m": t.size_m, "world_from_tag": t.world_from_tag.matrix.tolist()}
                for t in self.table_tags
            ],
            "residuals": dict(self.residuals),
        }

    @staticmethod
    def from_json(data: Mapping[str, Any]) -> RigCalibration:
        version = data.get("format_version")
        if version != CALIBRATION_FORMAT:
            raise BadInput(f"calibration: format_version {version!r}; this tosslab reads {CALIBRATION_FORMAT}")
        try:
            return RigCalibration(
                cameras={name: _camera_from_json(c) for name, c in data["cameras"].items()},
                transforms=tuple(
                    Transform.from_matrix(t["target"], t["source"], np.array(t["matrix"], dtype=np.float64))
                    for t in data["transforms"]
                ),
                table_tags=tuple(
                    TagPlacement(
                        int(t["id"]),
                        float(t["size_m"]),
                        Transform.from_matrix(
                            "world", f"tag_{t['id']}", np.array(t["world_from_tag"], dtype=np.float64)
                        ),
                    )
                    for t in data.get("table_tags", [])
                ),
                tag_family=data.get("tag_family", "tag36h11"),
                created_unix_s=None if data.get("created_unix_s") is None else float(data["created_unix_s"]),
                residuals=dict(data.get("residuals") or {}),
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as wrong:
            raise BadInput(
                f"calibration: {type(wrong).__name__}: {wrong}; see ARCHITECTURE.md for the format"
            ) from wrong

    @staticmethod
    def read(path: Path) -> RigCalibration:
        data = read_json(path)
        if not isinstance(data, dict):
            raise BadInput(f"{path}: cannot be read as a calibration (wanted a JSON object, found {str(data)[:40]})")
        return RigCalibration.from_json(data)


def _camera_to_json(camera: CameraModel) -> dict[str, Any]:
    return {
        "frame": camera.frame,
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "distortion_model": camera.distortion_model,
        "distortion": list(camera.distortion),
    }


def _camera_from_json(data: Mapping[str, Any]) -> CameraModel:
    return CameraModel(
        frame=str(data["frame"]),
        width=int(data["width"]),
        height=int(data["height"]),
        K=np.array(data["K"], dtype=np.float64),
        distortion_model=data["distortion_model"],
        distortion=tuple(data["distortion"]),
    )


@dataclass(frozen=True, eq=False)
class ContactModel:
    """Learned contact dynamics of the object against the ground plane.

    `support_vertices_m`: the candidate contact points in the object frame; `pieces` groups them into convex pieces
    (one piece for a convex body). `friction` is the effective coefficient against the plane with its 95 % interval.
    `inertia_kgm2` is about the centre of mass, in object axes. The plane: n . x = offset in `world`.
    """

    object_frame: str
    support_vertices_m: Float[Array, "v 3"]
    pieces: tuple[tuple[int, ...], ...]
    friction: float
    friction_low: float
    friction_high: float
    mass_kg: float
    inertia_kgm2: Float[Array, "3 3"]
    center_of_mass_m: Float[Array, "3"]
    physics_source: str
    plane_normal_world: Float[Array, "3"]
    plane_offset_m: float


def runs(chosen: Bool[Array, " n"]) -> list[tuple[int, int]]:
    """Where runs of True begin, and the position after each."""
    edges = np.flatnonzero(np.diff(np.r_[False, chosen, False].astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2])]
