"""session.json and mono/cameras.json of the folder layout: cameras, transforms, tags and the rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import CameraModel, DistortionModel, Transform
from recordings.importers.common import Warnings, read_json_object
from recordings.tracks import RigCalibration, TagPlacement


@dataclass(frozen=True, eq=False)
class Layout:
    """session.json of the folder layout, understood. `document` is the file as it is, `mono_document`
    mono/cameras.json."""

    source: Path
    document: Mapping[str, Any]
    calibration: RigCalibration
    depth_unit_m: float
    object: Mapping[str, Any]
    mono: tuple[str, ...]
    mono_document: Mapping[str, Any]

    @property
    def color(self) -> CameraModel:
        return self.calibration.camera("d455")

    @property
    def depth(self) -> CameraModel:
        """The camera that depth images are seen by: the colour camera where they are aligned to it."""
        return self.calibration.cameras.get("d455_depth", self.color)


def read_layout(source: Path, warnings: Warnings) -> Layout:
    """Read DIR/session.json and DIR/mono/cameras.json. Raises BadInput with what was found and wanted."""
    path = source / "session.json"
    if not source.is_dir():
        raise BadInput(f"{source} is no folder; wanted one with session.json and toss_00/rgb, toss_00/depth, ...")
    if not path.exists():
        raise BadInput(
            f"{source} has no session.json; wanted the folder layout (session.json, toss_00/rgb, toss_00/depth, ...)"
        )
    document = read_json_object(path)
    if "format_version" in document and "start" in document:
        raise BadInput(f"{source} is a tosslab session already; look at it with `toss-session info {source}`")
    camera = document.get("camera")
    if not isinstance(camera, dict):
        raise BadInput(f"{path}: no 'camera'; wanted {{K, width, height, distortion, depth_unit_m}}")
    cameras = {"d455": camera_model(camera, "d455", str(path))}
    transforms = _transforms(document, path)
    if not camera.get("depth_aligned_to_color", True):
        cameras["d455_depth"], d455_from_depth = _depth_camera(document, path)
        transforms.append(d455_from_depth)
        warnings.add("depth is not aligned to colour: it is kept as it is and aligned with its calibration when read")
    if not any(t.source == "d455" for t in transforms):
        warnings.add(f"{path.name} has no T_world_camera: the camera's place in the world is not known")
    mono, mono_document = _mono_cameras(source / "mono" / "cameras.json")
    family, tags = _table_tags(document, path)
    return Layout(
        source=source,
        document=document,
        calibration=RigCalibration({**cameras, **mono}, tuple(transforms), tags, family),
        depth_unit_m=_depth_unit(camera, path),
        object=_object(document.get("object"), path),
        mono=tuple(mono),
        mono_document=mono_document,
    )


def camera_model(given: Mapping[str, Any], frame: str, where: str) -> CameraModel:
    """A camera of the layout: K 3x3, `distortion` (none, 4, 5 or 8 numbers in OpenCV's order), width and height."""
    try:
        K = np.array(given["K"], dtype=np.float64)
        width, height = int(given["width"]), int(given["height"])
        numbers = tuple(float(k) for k in given.get("distortion") or ())
    except (KeyError, TypeError, ValueError) as wrong:
        raise BadInput(
            f"{where}: camera '{frame}': {type(wrong).__name__} {wrong}; wanted K 3x3, width, height"
        ) from wrong
    model, coefficients = _lens(numbers, str(given.get("distortion_model", "")), f"{where}: camera '{frame}'")
    return CameraModel(frame, width, height, K, model, coefficients)


def _lens(numbers: tuple[float, ...], named: str, where: str) -> tuple[DistortionModel, tuple[float, ...]]:
    if not any(numbers):
        return "none", ()
    if len(numbers) == 4 and any(word in named.lower() for word in ("fisheye", "kannala", "equidistant")):
        return "fisheye", numbers
    if len(numbers) in (4, 5):
        return "brown-conrady", (*numbers, 0.0)[:5]
    if len(numbers) == 8:
        return "rational", numbers
    raise BadInput(f"{where}: {len(numbers)} distortion numbers; wanted 4 or 5 (k1 k2 p1 p2 k3) or 8 (k4 k5 k6 more)")


def matrix(given: Any, where: str) -> Float[Array, "4 4"]:
    """A 4x4 matrix of JSON. Raises BadInput."""
    try:
        found = np.array(given, dtype=np.float64)
    except (TypeError, ValueError) as wrong:
        raise BadInput(f"{where}: {wrong}; wanted a 4x4 matrix of numbers") from wrong
    if found.shape != (4, 4):
        raise BadInput(f"{where}: shape {found.shape}; wanted a 4x4 matrix")
    return found


def _transforms(document: Mapping[str, Any], path: Path) -> list[Transform]:
    named = {"T_world_camera": ("world", "d455"), "T_world_base": ("world", "base")}
    return [
        Transform.from_matrix(target, source, matrix(document[key], f"{path}: {key}"))
        for key, (target, source) in named.items()
        if document.get(key) is not None
    ]


def _depth_camera(document: Mapping[str, Any], path: Path) -> tuple[CameraModel, Transform]:
    """Not in the shared data: `depth_camera` {K, distortion, width, height} and `T_camera_depth`
    (d455_from_d455_depth)."""
    given = document.get("depth_camera")
    if not isinstance(given, dict) or document.get("T_camera_depth") is None:
        raise BadInput(
            f"{path}: depth_aligned_to_color is false, so aligning needs `depth_camera` "
            f"{{K, distortion, width, height}} "
            "and `T_camera_depth` (4x4, colour from depth); add both, or give depth aligned to colour"
        )
    camera = camera_model(given, "d455_depth", str(path))
    place = matrix(document["T_camera_depth"], f"{path}: T_camera_depth")
    return camera, Transform.from_matrix("d455", "d455_depth", place)


def _depth_unit(camera: Mapping[str, Any], path: Path) -> float:
    unit = camera.get("depth_unit_m")
    if not isinstance(unit, (int, float)) or not 1e-6 <= unit <= 0.1:
        raise BadInput(
            f"{path}: depth_unit_m {unit!r}; wanted the metres of one step of the depth images "
            "(0.001 for millimetres; RealSense cameras also use 0.00025 and 0.0001)"
        )
    return float(unit)


def _object(given: Any, path: Path) -> Mapping[str, Any]:
    if isinstance(given, str):
        return {"name": given}
    if isinstance(given, dict) and isinstance(given.get("name"), str):
        return dict(given)
    if given is None:
        return {"name": "object"}
    raise BadInput(f"{path}: object {given!r}; wanted its name, or {{name, physics}}")


def _table_tags(document: Mapping[str, Any], path: Path) -> tuple[str, tuple[TagPlacement, ...]]:
    given = document.get("table_tags") or {}
    try:
        tags = tuple(
            TagPlacement(
                int(t["id"]),
                float(t["size_m"]),
                Transform.from_matrix("world", f"tag_{t['id']}", matrix(t["T_world_tag"], f"{path}: tag {t['id']}")),
            )
            for t in given.get("tags", ())
        )
    except (KeyError, TypeError, ValueError, AttributeError) as wrong:
        raise BadInput(
            f"{path}: table_tags: {type(wrong).__name__} {wrong}; wanted tags of {{id, size_m, T_world_tag}}"
        ) from wrong
    return str(given.get("family", "tag36h11")), tags


def _mono_cameras(path: Path) -> tuple[dict[str, CameraModel], Mapping[str, Any]]:
    if not path.exists():
        return {}, {}
    document = read_json_object(path)
    given = document.get("cameras")
    if not isinstance(given, list) or not all(isinstance(c, dict) and isinstance(c.get("name"), str) for c in given):
        raise BadInput(f"{path}: no 'cameras'; wanted a list of {{name, K, distortion, width, height}}")
    return {c["name"]: camera_model(c, c["name"], str(path)) for c in given}, document
