"""What a TagSLAM configuration may say: entries that nobody reads, and answers that it must not leave open.

TagSLAM stops at most of these with an assertion, or reads past them in silence; here each is refused or noted by name.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from recordings.errors import BadInput

CAMERA_NAME = re.compile(r"(cam|camera_)\d{1,2}")
MODES = ("fast", "slow", "full")


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


READ: Mapping[str, frozenset[str]] = {
    "tagslam.yaml": _words(
        "tagslam_parameters body_defaults default_body bodies max_hamming_distance amnesia tag_id_remap squash "
        "plane_measurements distance_measurements coordinate_measurements warn_ignore_tags"
    ),
    "tagslam_parameters": _words(
        "optimizer_mode minimum_viewing_angle max_num_incremental_opt pixel_noise max_subgraph_error minimum_tag_area "
        "subgraph_abs_prior_position_noise subgraph_abs_prior_rotation_noise use_approximate_sync sync_queue_size "
        "ambiguity_angle_threshold max_ambiguity_ratio"
    ),
    "body": _words(
        "type is_static default_tag_size max_hamming_distance override_tag_position_noise override_tag_rotation_noise "
        "T_body_odom odom_frame_id odom_topic odom_translation_noise odom_rotation_noise publish_covariance "
        "odom_acceleration odom_acceleration_noise_min odom_acceleration_noise_max odom_angular_acceleration "
        "odom_angular_acceleration_noise_min odom_angular_acceleration_noise_max ignore_tags pose "
        "fake_odom_translation_noise fake_odom_rotation_noise tags board staggered_board"
    ),
    "camera": _words(
        "camera_model distortion_model distortion_coeffs intrinsics resolution rostopic tagtopic rig_body frameId "
        "wiggle_rotation wiggle_translation"
    ),
}
"""The entries that TagSLAM reads, by where they stand."""
FIELDS: Mapping[str, Sequence[str]] = {
    "plane_measurements": ("tags", "distance", "noise", "direction"),
    "distance_measurements": ("tag1", "tag2", "corner1", "corner2", "distance", "noise"),
    "coordinate_measurements": ("tag", "corner", "length", "noise", "direction"),
}


def entry(what: str, read: Callable[[], Any]) -> Any:
    """The result of reading one entry; what is wrong in it becomes a refusal that names it."""
    try:
        return read()
    except KeyError as missing:
        raise BadInput(f"{what} lacks {missing}") from missing
    except (TypeError, ValueError, AttributeError, IndexError) as wrong:
        raise BadInput(f"{what} is malformed ({wrong})") from wrong


def camera_names(cameras: Mapping[str, Any]) -> list[str]:
    """The cameras in TagSLAM's order: cam0 … cam99, or camera_0 …; other entries are none. Raises BadInput."""
    names = [n for n in cameras if CAMERA_NAME.fullmatch(str(n))]
    if not names:
        raise BadInput(f"cameras.yaml names no camera that TagSLAM reads: found {list(cameras)}; wanted cam0, cam1, …")
    return sorted(names, key=lambda n: int(re.sub(r"\D", "", n)))


def measurements(main: Mapping[str, Any], kind: str) -> tuple[Mapping[str, Any], ...]:
    """Distances, coordinates or planes, each whole. Raises BadInput naming what one lacks."""
    found = []
    for item in main.get(kind) or []:
        for name, values in item.items():
            what = f"tagslam.yaml: {kind} '{name}'"
            entry(what, partial(_check_measurement, values, FIELDS[kind], what))
            found.append({"name": name, **values})
    return tuple(found)


def _check_measurement(values: Mapping[str, Any], fields: Sequence[str], what: str) -> None:
    if lacking := [f for f in fields if f not in values]:
        raise BadInput(f"{what} lacks {', '.join(lacking)}")
    if not float(values["noise"]) > 0:
        raise BadInput(f"{what} has noise {values['noise']}; wanted metres above 0")
    for corner in (values[c] for c in ("corner", "corner1", "corner2") if c in values):
        if int(corner) not in (-1, 0, 1, 2, 3):
            raise BadInput(f"{what} has corner {corner}; wanted 0, 1, 2 or 3 (-1: the tag's centre)")
    if "direction" in values:
        length = float(np.linalg.norm(np.array(values["direction"], dtype=np.float64).reshape(3)))
        if abs(length - 1) > 1e-5:
            raise BadInput(f"{what} has a direction of length {length:g}; wanted a unit vector")


def unread(cameras: Mapping[str, Any], main: Mapping[str, Any]) -> list[str]:
    """Entries that TagSLAM does not know where they stand: a slip, or a setting of another version."""
    places: list[tuple[str, str, Mapping[str, Any]]] = [("tagslam.yaml", "tagslam.yaml", main)]
    places.append(("tagslam.yaml: tagslam_parameters", "tagslam_parameters", main.get("tagslam_parameters") or {}))
    places += [(f"tagslam.yaml: body '{n}'", "body", b) for item in main["bodies"] for n, b in item.items()]
    places += [(f"cameras.yaml: {n}", "camera", c) for n, c in cameras.items() if CAMERA_NAME.fullmatch(str(n))]
    notes = [
        f"{place} has {', '.join(sorted(map(repr, others)))}, which TagSLAM does not read there"
        for place, kind, entries in places
        if (others := set(entries) - READ[kind])
    ]
    if len(main.get("plane_measurements") or []) > 1:
        notes.append("tagslam.yaml: of several plane_measurements TagSLAM uses the last one")
    no_cameras = [str(n) for n in cameras if not CAMERA_NAME.fullmatch(str(n))]
    return [*notes, *(f"cameras.yaml: '{n}' is no camera to TagSLAM" for n in no_cameras)]


def check_mode(parameters: Mapping[str, Any]) -> None:
    mode = str(parameters.get("optimizer_mode", "slow"))
    if mode not in MODES:
        raise BadInput(
            f"tagslam.yaml: tagslam_parameters has optimizer_mode '{mode}'; wanted one of {', '.join(MODES)}"
        )
    if not float(parameters.get("pixel_noise", 1.0)) > 0:
        raise BadInput(f"tagslam.yaml: pixel_noise is {parameters['pixel_noise']}; wanted pixels above 0")
