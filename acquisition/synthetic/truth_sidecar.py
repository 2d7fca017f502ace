"""What is true of a session of the simulated lab, beside it: OUT_truth in the `*_truth` layout, never inside."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray as Array

from acquisition.synthetic import physics
from acquisition.synthetic.lab import Lab
from acquisition.synthetic.objects.paint import PaintedMesh
from recordings.errors import WriteFailed
from recordings.geometry import Transform
from recordings.session import Session, Toss

if TYPE_CHECKING:
    from acquisition.synthetic.lab_state import LabState

SUFFIX = "_truth"
TAG_FAMILY = "tag36h11"


def write_sidecar(lab: LabState, session: Path) -> Path | None:
    """True poses at the frames of every toss that this lab played, exposure times, shape and physics."""
    if not lab.show.rendered:
        return None
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


def write_truth_of_lab(lab: Lab, truth: Path, boards: Sequence[Transform]) -> None:
    """mesh.obj with its texture, physics.json, object_tags.json, calibration.json, sensor_truth.json."""
    _write_mesh(lab.object.mesh, truth)
    config = lab.config
    write_document(
        truth / "physics.json",
        {
            "mass_kg": lab.mass.mass_kg,
            "inertia_body_kgm2": lab.mass.inertia_kgm2.tolist(),
            "com_in_mesh_frame": lab.mass.center_m.tolist(),
            "friction_mu": config.contact.friction,
            "torsional_friction_m": config.contact.torsional_friction_m,
            "contact_time_constant_s": config.contact.time_constant_s,
            "contact_damping_ratio": config.contact.damping_ratio,
            "gravity": config.contact.gravity_m_s2,
            "source": physics.SOURCE,
        },
    )
    if lab.object_tags:
        tags = [
            {"id": t.tag_id, "size_m": t.size_m, "face": t.face, "T_object_tag": t.object_from_tag.matrix.tolist()}
            for t in lab.object_tags
        ]
        convention = "T_object_tag: frame as pupil-apriltags reports it (x right, y down, z into the face)"
        write_document(truth / "object_tags.json", {"family": TAG_FAMILY, "convention": convention, "tags": tags})
    d455_from_world = lab.world_from_d455.inverse()
    monos = {v.camera.frame: v.world_from_camera for v in lab.mono_views}
    calibration: dict[str, Any] = {
        "T_world_mono": {name: pose.matrix.tolist() for name, pose in monos.items()},
        "T_d455_mono": {name: (d455_from_world @ pose).matrix.tolist() for name, pose in monos.items()},
        "T_world_d455": lab.world_from_d455.matrix.tolist(),
        "T_world_board": [pose.matrix.tolist() for pose in boards],
    }
    if lab.arm is not None:
        calibration["T_world_base"] = lab.arm.world_from_base.matrix.tolist()
    write_document(truth / "calibration.json", calibration)
    write_document(
        truth / "sensor_truth.json",
        {
            "depth_scale": config.depth.scale,
            "depth_delay_s": config.depth.delay_s,
            "exposure_s": config.color.exposure_s,
            "T_world_camera": lab.world_from_d455.matrix.tolist(),
            "arm_clock_offset_s": config.arm.clock_offset_s if config.arm else 0.0,
        },
    )


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
    write_document(folder / "toss_gt.json", document)
    (folder / "exposures_ns.json").write_text(json.dumps(stamps) + "\n")


def _streams(toss: Toss) -> dict[str, str]:
    """The session's topics and the lab's names for them."""
    found = {"/d455/color": "d455/color", "/d455/depth": "d455/depth"}
    return found | {f"/{name}/image": name for name in toss.cameras() if name.startswith("mono")}


def _frames(toss: Toss, topic: str) -> list[int]:
    return [message.sequence for message in toss.file.messages(topic)]


def _write_mesh(mesh: PaintedMesh, folder: Path) -> None:
    """Wavefront OBJ with an sRGB texture (v axis up, as OBJ wants it)."""
    from acquisition.synthetic.render.sensors import color_image

    write_png(folder / "texture.png", color_image(mesh.atlas)[..., ::-1])
    (folder / "texture.mtl").write_text("newmtl texture\nKd 1 1 1\nmap_Kd texture.png\n")
    height, width = mesh.atlas.shape[:2]
    uv = (mesh.corner_uv_px.reshape(-1, 2) + 0.5) / [width, height]
    lines = ["mtllib texture.mtl", "usemtl texture"]
    lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices_m]
    lines += [f"vt {u:.6f} {1 - v:.6f}" for u, v in uv]
    for k, face in enumerate(mesh.faces):
        lines.append("f " + " ".join(f"{vertex + 1}/{3 * k + i + 1}" for i, vertex in enumerate(face)))
    (folder / "mesh.obj").write_text("\n".join(lines) + "\n")


def write_png(path: Path, image: UInt8[Array, "..."] | UInt16[Array, "..."]) -> None:
    """Raises WriteFailed."""
    if not cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 6]):
        raise WriteFailed(f"{path}: cannot be written; is there space on the disk?")


def write_document(path: Path, document: dict[str, Any]) -> None:
    """As the folder layouts have it."""
    path.write_text(json.dumps(document, indent=1) + "\n")
