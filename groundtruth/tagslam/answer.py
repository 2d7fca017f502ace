"""TagSLAM's answer as a JSON document: every body's poses by stamp.

{"bodies": {name: [[stamp_ns, x, y, z, qx, qy, qz, qw], ...]},     world_from_body of what moves
 "static": {name: [x, y, z, qx, qy, qz, qw]},                      world_from_body of what does not
 "tags": {id: {"body": name, "pose": [...]}},                      body_from_tag, in TagSLAM's tag frame
 "cameras": {name: [...]},                                         rig_from_camera
 "reprojection_px": {"median", "rms", "corners"},                  distances of all corners
 "unplaced": [...]}                                                what was seen, but nothing connects it
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array
from scipy.spatial.transform import Rotation

from groundtruth.tagslam.solve import TagSlamResult


def answer_document(result: TagSlamResult) -> dict[str, Any]:
    """The document of a result. Quaternions are xyzw with w >= 0, lengths are metres."""
    return {
        "bodies": {
            name: [[stamp, *row] for stamp, row in zip(stamps, pose_rows(poses), strict=True)]
            for name, (stamps, poses) in result.bodies.items()
        },
        "static": {name: pose_rows(pose[None])[0] for name, pose in result.static.items()},
        "tags": {
            str(tag): {"body": result.owner[tag], "pose": pose_rows(pose[None])[0]}
            for tag, pose in sorted(result.tags.items())
        },
        "cameras": {name: pose_rows(pose[None])[0] for name, pose in result.cameras.items()},
        "reprojection_px": reprojection(result.reprojection_px),
        "unplaced": list(result.unplaced),
    }


def reprojection(distances_px: Float[Array, " m"]) -> dict[str, float | int | None]:
    """Median and root mean square of corner distances."""
    if len(distances_px) == 0:
        return {"median": None, "rms": None, "corners": 0}
    rms = float(np.sqrt((distances_px**2).mean()))
    return {"median": float(np.median(distances_px)), "rms": rms, "corners": len(distances_px)}


def pose_rows(poses: Float[Array, "n 4 4"]) -> list[list[float]]:
    """x y z qx qy qz qw of each pose, w >= 0."""
    if len(poses) == 0:
        return []
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    return np.concatenate([poses[:, :3, 3], quaternions], axis=1).tolist()


def answer_text(document: Mapping[str, Any]) -> str:
    """The answer in some lines: bodies, stamps, residuals, what was not placed."""
    px = document["reprojection_px"]
    lines = [f"{name}: {len(rows)} poses" for name, rows in document["bodies"].items()]
    lines += [f"{name}: static" for name in document["static"]]
    lines.append(f"{len(document['tags'])} tags, {len(document['cameras'])} cameras")
    lines.append(f"reprojection: median {px['median']:.3f} px, rms {px['rms']:.3f} px of {px['corners']} corners")
    if document["unplaced"]:
        some = ", ".join(document["unplaced"][:3])
        lines.append(f"not placed, nothing connects them: {len(document['unplaced'])} ({some}, …)")
    return "\n".join(lines)
