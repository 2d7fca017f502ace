"""calibration.json of a session: read, changed in one place, written whole, signed anew."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.report import Report
from recordings.geometry import CameraModel, Transform
from recordings.session import Session
from recordings.session_writer import renew_manifest
from recordings.tracks import RigCalibration
from recordings.whole_file import write_json

WORK_FOLDER = "calibration"
"""Of a session: pictures of its calibrations, and the tags found in its images."""


def updated(
    calibration: RigCalibration,
    *,
    cameras: Mapping[str, CameraModel] | None = None,
    transforms: Sequence[Transform] = (),
    replaces: Sequence[str] = (),
) -> RigCalibration:
    """With these lenses, and with these transforms instead of every one that ends or begins at a frame in `replaces`
    (the robot's base apart from its camera would otherwise be connected twice)."""
    kept = [t for t in calibration.transforms if t.target not in replaces and t.source not in replaces]
    return replace(
        calibration,
        cameras={**calibration.cameras, **(cameras or {})},
        transforms=(*kept, *transforms),
        created_unix_s=time.time(),
    )


def write(session: Session, calibration: RigCalibration, kind: str, report: Report, **more: Any) -> Path:
    """calibration.json with the report under `residuals[kind]`."""
    return write_entry(session, calibration, kind, {**report.to_json(), "created_unix_s": time.time(), **more})


def write_entry(session: Session, calibration: RigCalibration, kind: str, entry: Mapping[str, Any]) -> Path:
    """Whole or not at all; the manifest is renewed."""
    path = session.path / "calibration.json"
    residuals = {**calibration.residuals, kind: dict(entry)}
    write_json(path, replace(calibration, residuals=residuals).to_json())
    renew_manifest(session.path, path.name)
    return path


def work_folder(session: Session) -> Path:
    folder = session.path / WORK_FOLDER
    folder.mkdir(exist_ok=True)
    return folder
