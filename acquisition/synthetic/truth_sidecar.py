"""What is true of a session of the simulated lab, beside it: OUT_truth in the `*_truth` layout, never inside."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.bounded.documents import read_json
from recordings.session import Session, Toss
from recordings.sync import clock_offset_ns

if TYPE_CHECKING:
    from acquisition.synthetic.lab_state import LabState

SUFFIX = "_truth"


def write_sidecar(lab: LabState, session: Path) -> Path | None:
    """True poses at the frames of every toss that this lab played, exposure times, shape and physics."""
    if not lab.show.rendered:
        return None
    from acquisition.synthetic.folder import write_truth_of_lab

    truth = session.with_name(session.name + SUFFIX)
    truth.mkdir(parents=True, exist_ok=True)
    if not (truth / "mesh.obj").exists():
        write_truth_of_lab(lab.show.lab, truth, [])
    opened = Session.open(session)
    for number in opened.tosses:
        folder = truth / f"toss_{number:02d}"
        if not folder.exists():
            _write_toss(lab, opened.toss(number), folder)
    return truth


def _write_toss(lab: LabState, toss: Toss, folder: Path) -> None:
    stage = lab.stage
    color = toss.color("d455")
    frames = _frames(toss, "/d455/color")
    poses = [stage.world_from_object("d455/color", frame) for frame in frames]
    shown = [stage.shown_at(frame) for frame in frames]
    played = next((s for s in shown if s is not None), None)
    if played is None:
        return  # another run of toss-record played it
    folder.mkdir(parents=True)
    held = played.performance.motion.object.at(0.0).matrix
    world = np.array([held if pose is None else pose for pose in poses])
    camera_from_world = lab.show.lab.world_from_d455.inverse().matrix
    exposed_ns = np.array([stage.exposed_ns("d455/color", frame) for frame in frames], dtype=np.int64)
    np.savez_compressed(
        folder / "poses_camera_object.npz",
        t=(exposed_ns - exposed_ns[0]) / 1e9,
        T_camera_object=camera_from_world @ world,
        T_world_object=world,
        frame=np.array(frames),
    )
    start_ns = stage.grid_ns(played.first_frame)
    instants = played.performance.motion.instants
    stamps = {
        name: {str(frame): stage.exposed_ns(stream, frame) - int(exposed_ns[0]) for frame in _frames(toss, name)}
        for name, stream in _streams(toss).items()
    }
    document = {
        "release_time_s": start_ns / 1e9 + instants.release_s - exposed_ns[0] / 1e9,
        "first_contact_time_s": start_ns / 1e9 + instants.first_impact_s - exposed_ns[0] / 1e9,
        "rest_time_s": start_ns / 1e9 + instants.rest_s - exposed_ns[0] / 1e9,
        "first_color_stamp_ns": int(color.times_ns[0]),
        "first_color_exposed_host_ns": int(exposed_ns[0]),
        "times_count_from": "the true mid-exposure of the toss's first colour frame",
    }
    (folder / "toss_gt.json").write_text(json.dumps(document, indent=1) + "\n")
    (folder / "exposures_ns.json").write_text(json.dumps(stamps) + "\n")


def stamp_errors_ms(session: Path, truth: Path) -> dict[str, Float[Array, " n"]]:
    """By topic and over all tosses: stamps, with the offsets that `toss-calibrate time` found, less true mid-exposures.

    Of a session that one run of toss-record wrote; `truth` is what `write_sidecar` wrote.
    """
    opened = Session.open(session)
    anchor = opened.start["clock"]["anchor"]
    began_host_ns = anchor["host_monotonic_ns"] - anchor["session_ns"]
    errors: dict[str, list[float]] = {}
    for number in opened.tosses:
        folder = truth / f"toss_{number:02d}"
        first_host_ns = read_json(folder / "toss_gt.json")["first_color_exposed_host_ns"]
        exposures = read_json(folder / "exposures_ns.json")
        for topic, exposed_ns in exposures.items():
            stream = "mono" if topic.startswith("/mono") else "d455"
            offset_ns = clock_offset_ns(opened.calibration.residuals, stream)
            for message in opened.toss(number).file.messages(topic):
                true_ns = first_host_ns + exposed_ns[str(message.sequence)] - began_host_ns
                errors.setdefault(topic, []).append((message.publish_time_ns + offset_ns - true_ns) / 1e6)
    return {topic: np.array(values) for topic, values in errors.items()}


def _streams(toss: Toss) -> dict[str, str]:
    """The session's topics and the lab's names for them."""
    found = {"/d455/color": "d455/color", "/d455/depth": "d455/depth"}
    return found | {f"/{name}/image": name for name in toss.cameras() if name.startswith("mono")}


def _frames(toss: Toss, topic: str) -> list[int]:
    return [message.sequence for message in toss.file.messages(topic)]
