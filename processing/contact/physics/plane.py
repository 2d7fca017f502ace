"""The ground plane that tosses end on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.tracks import RigCalibration


@dataclass(frozen=True, eq=False)
class Plane:
    """The ground in `world`: normal . x = offset."""

    normal_world: Float[Array, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    offset_m: float = 0.0
    source: str = "z = 0 of world"
    std_m: float | None = None
    """Standard deviation of the height, where the calibration says it."""

    def level_from_world(self) -> Float[Array, "3 3"]:
        """The rotation that turns the normal to z by the shortest way."""
        n = np.asarray(self.normal_world, dtype=np.float64) / np.linalg.norm(self.normal_world)
        axis, cosine = np.cross(n, [0.0, 0.0, 1.0]), float(n[2])
        if cosine < -0.99:
            raise BadInput(f"the plane's normal {n.tolist()} points down; wanted up, against gravity")
        K = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
        return np.eye(3) + K + K @ K / (1 + cosine)


def calibrated_plane(calibration: RigCalibration) -> Plane:
    """`residuals["table"]` of a calibration: {normal_world, offset_m, std_m, source}; z = 0 of `world` where it is not
    there. Raises BadInput for a table that is no plane."""
    given = (calibration.residuals or {}).get("table")
    if not isinstance(given, Mapping) or "normal_world" not in given or "offset_m" not in given:
        return Plane(source="z = 0 of world (the calibration has no table)")
    normal = np.array(given["normal_world"], dtype=np.float64)
    if normal.shape != (3,) or not np.isfinite(normal).all() or not np.linalg.norm(normal) > 0.5:
        raise BadInput(f"calibration: residuals.table.normal_world is {given['normal_world']}; wanted a unit vector")
    length = float(np.linalg.norm(normal))
    std = given.get("std_m")
    source = f"calibration.json: table ({given.get('source', 'no source given')})"
    return Plane(normal / length, float(given["offset_m"]) / length, source, None if std is None else float(std))
