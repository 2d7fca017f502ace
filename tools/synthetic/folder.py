"""Writes simulated tosses as the folder layout, and their truth as the `*_truth` layout beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray as Array

from acquisition.synthetic.board import board_pose, board_tags
from acquisition.synthetic.lab import Lab
from acquisition.synthetic.random_draws import BOARD, generator
from acquisition.synthetic.truth_sidecar import SUFFIX, TAG_FAMILY, write_document, write_png, write_truth_of_lab
from recordings.errors import BadInput, WriteFailed
from recordings.geometry import CameraModel, Transform
from recordings.progress import Progress, Silent
from synthetic.scene import SyntheticToss, simulate

TRUTH_DEPTH_UNIT_M = 0.0001
STATES_HZ = 148.0
PIXEL_CONVENTION = "OpenCV: centre of pixel (0,0) is at (0,0)"


def write_session(lab: Lab, tosses: Sequence[int], out: Path, progress: Progress | None = None) -> Path:
    """Simulate `tosses` into the new folder `out`, truth into `out` + '_truth' (returned)."""
    progress = progress or Silent()
    truth = out.with_name(out.name + SUFFIX)
    for folder in (out, truth):
        if folder.exists():
            raise BadInput(f"{folder} exists; wanted a new folder: choose another name, or remove it")
    for folder in (out, truth):
        folder.mkdir(parents=True)
    write_document(out / "session.json", session_document(lab))
    boards = write_mono_cameras(lab, out) if lab.config.mono else []
    write_truth_of_lab(lab, truth, boards)
    for done, number in enumerate(tosses):
        write_toss(lab, simulate(lab.config, number, lab), out, truth)
        progress.step(done + 1, len(tosses), f"toss {number}")
    return truth


def session_document(lab: Lab) -> dict[str, Any]:
    """session.json of the folder layout: what the lab believes, calibration errors included."""
    camera = lab.d455.camera
    document: dict[str, Any] = {
        "object": lab.config.object.shape,
        "camera": {
            "model": "D455-like",
            **_intrinsics(camera),
            "fps": lab.config.camera.fps,
            "depth_unit_m": lab.config.depth.unit_m,
            "depth_invalid": 0,
            "depth_aligned_to_color": True,
            "pixel_convention": PIXEL_CONVENTION,
        },
        "T_world_camera": lab.calibrated_world_from_d455.matrix.tolist(),
        "world": "z up, table top is the plane z = 0, metres",
        "camera_frame": "OpenCV (x right, y down, z forward)",
        "table_tags": {
            "family": TAG_FAMILY,
            "note": "printed on the table; tag frame as pupil-apriltags reports it (x right, y down, z into the "
            "paper); size_m is the side of the black square",
            "tags": [
                {"id": t.tag_id, "size_m": t.size_m, "T_world_tag": t.world_from_tag.matrix.tolist()}
                for t in lab.table_tags
            ],
        },
        "notes": f"simulated, seed {lab.config.seed}",
    }
    if lab.calibrated_world_from_base is not None:
        document["arm"] = "franka_panda"
        document["T_world_base"] = lab.calibrated_world_from_base.matrix.tolist()
    return document


def write_mono_cameras(lab: Lab, out: Path) -> list[Transform]:
    """mono/cameras.json (intrinsics only) and calibration/view_XX; returns the board's true poses in the world."""
    (out / "mono").mkdir()
    document: dict[str, Any] = {
        "cameras": [{"name": v.camera.frame, **_intrinsics(v.camera)} for v in lab.mono_views],
        "pixel_convention": PIXEL_CONVENTION,
        "response": f"linear mono8, {1000 * lab.mono_config.exposure_s:g} ms exposure, cameras triggered together; "
        "same clock as the colour timestamps of the toss",
    }
    if lab.mono_config.board_views:
        tags = [
            {"id": t.tag_id, "size_m": t.size_m, "T_board_tag": t.world_from_tag.matrix.tolist()} for t in board_tags()
        ]
        document["calibration_board"] = {
            "family": TAG_FAMILY,
            "frame": "board centre, z out of the printed side; tag frame as pupil-apriltags reports it",
            "tags": tags,
        }
    write_document(out / "mono" / "cameras.json", document)
    rng = generator(lab.config.seed, BOARD)
    poses = [board_pose(rng) for _ in range(lab.mono_config.board_views)]
    for number, pose in enumerate(poses):
        view = out / "calibration" / f"view_{number:02d}"
        view.mkdir(parents=True)
        color, depth, monos = lab.board_view(number, pose)
        write_png(view / "rgb.png", color[..., ::-1])
        write_png(view / "depth.png", depth)
        for camera, image in zip(lab.mono_views, monos):
            write_png(view / f"{camera.camera.frame}.png", image)
    return poses


def write_toss(lab: Lab, toss: SyntheticToss, out: Path, truth: Path) -> None:
    """One toss into toss_XX of both folders."""
    name = f"toss_{toss.motion.toss:02d}"
    here, there = out / name, truth / name
    for folder in (here / "rgb", here / "depth", there / "masks", there / "depth_exact_object"):
        folder.mkdir(parents=True)
    for k, frame in enumerate(toss.frames):
        _write_jpeg(here / "rgb" / f"{k:06d}.jpg", frame.color_rgb, lab.config.color.jpeg_quality)
        write_png(here / "depth" / f"{k:06d}.png", frame.depth_raw)
        write_png(there / "masks" / f"{k:06d}.png", _mask_picture(frame.mask))
        exact = np.round(frame.depth_exact_object_m / TRUTH_DEPTH_UNIT_M).astype(np.uint16)
        write_png(there / "depth_exact_object" / f"{k:06d}.png", exact)
        if frame.robot_mask is not None:
            (there / "robot_masks").mkdir(exist_ok=True)
            write_png(there / "robot_masks" / f"{k:06d}.png", _mask_picture(frame.robot_mask))
    write_png(here / "mask_first.png", _mask_picture(toss.frames[0].mask))
    _write_times(here / "timestamps.txt", [f.time_s for f in toss.frames])
    if lab.config.depth.delay_s != 0:
        _write_times(here / "depth_timestamps.txt", [f.depth_time_s for f in toss.frames])
    document: dict[str, Any] = {"frames": len(toss.frames)}
    if lab.config.say_release:
        document["release_time_s"] = toss.motion.instants.release_s
    write_document(here / "toss.json", document)
    if toss.arm_states is not None:
        _write_arm(here / "arm.csv", toss.arm_states)
    if toss.mono:
        _write_mono(lab, toss, out / "mono" / name, there)
    _write_truth_poses(lab, toss, there)


def _write_arm(path: Path, states: Float[Array, "n 16"]) -> None:
    names = ["time_s", *(f"q{k}" for k in range(1, 8)), *(f"dq{k}" for k in range(1, 8)), "finger_width_m"]
    formats = ["%.6f", *["%.6f"] * 7, *["%.5f"] * 7, "%.5f"]
    np.savetxt(path, states, fmt=formats, delimiter=",", header=",".join(names), comments="")


def _write_mono(lab: Lab, toss: SyntheticToss, folder: Path, there: Path) -> None:
    for camera in lab.mono_views:
        (folder / camera.camera.frame).mkdir(parents=True)
    for k, shot in enumerate(toss.mono):
        for camera, image in zip(lab.mono_views, shot.images):
            _write_jpeg(folder / camera.camera.frame / f"{k:06d}.jpg", image, lab.mono_config.jpeg_quality)
    _write_times(folder / "timestamps.txt", [shot.time_s for shot in toss.mono])
    np.savez_compressed(
        there / "poses_at_mono_times.npz",
        t=np.array([shot.time_s for shot in toss.mono]),
        T_world_object=np.array([shot.world_from_object.matrix for shot in toss.mono]),
    )


def _write_truth_poses(lab: Lab, toss: SyntheticToss, there: Path) -> None:
    instants, motion = toss.motion.instants, toss.motion.object
    times = np.array([f.time_s for f in toss.frames])
    released = int(np.searchsorted(motion.times_s, toss.motion.free_s - 1e-9))
    world = np.array([f.world_from_object.matrix for f in toss.frames])
    swing = toss.motion.swing
    tool: dict[str, Any] = {}
    if lab.arm is not None and swing is not None:
        tool["T_world_tcp"] = np.array([lab.arm.world_from_tool(swing.q_rad(t)).matrix for t in times])
    np.savez_compressed(
        there / "poses_camera_object.npz",
        t=times,
        **tool,
        T_camera_object=lab.world_from_d455.inverse().matrix @ world,
        T_world_object=world,
        phase=np.array([instants.phase(t) for t in times]),
        nominal_frame=np.array([f.nominal for f in toss.frames]),
    )
    np.savez_compressed(there / "states_148hz.npz", **_states(toss))
    write_document(
        there / "toss_gt.json",
        {
            "source_toss": "simulated",
            "release_time_s": instants.release_s,
            "fingers_open_s": toss.motion.free_s,
            "first_contact_time_s": instants.first_impact_s,
            "rest_time_s": instants.rest_s,
            "dropped_nominal_frames": list(toss.dropped),
            "exposure_gain": [f.brightness for f in toss.frames],
            "release_velocity_world_m_s": motion.velocity_world_m_s[released].tolist(),
            "release_spin_object_rad_s": motion.angular_velocity_object_rad_s[released].tolist(),
        },
    )


def _states(toss: SyntheticToss) -> dict[str, Any]:
    instants, motion = toss.motion.instants, toss.motion.object
    start_s = toss.motion.free_s
    times = start_s + np.arange(int((instants.rest_s - start_s) * STATES_HZ) + 1) / STATES_HZ
    rows = np.clip(np.searchsorted(motion.times_s, times - 1e-9), 0, len(motion.times_s) - 1)
    poses = [motion.at(t) for t in times]
    spin_object = motion.angular_velocity_object_rad_s[rows]
    return {
        "t": times,
        "position": np.array([p.translation_m for p in poses]),
        "quaternion_wxyz": np.array([p.quaternion_wxyz for p in poses]),
        "linear_velocity_world": motion.velocity_world_m_s[rows],
        "angular_velocity_body": spin_object,
        "angular_velocity_world": np.array([p.rotation @ w for p, w in zip(poses, spin_object)]),
        "note": "SI, true world (z up, table z=0); quaternion world_from_body; position and velocity of the mesh "
        "origin; t on the toss's clock, dt = 1/148 s, from the instant at which the object is free",
    }


def _intrinsics(camera: CameraModel) -> dict[str, Any]:
    return {
        "K": camera.K.tolist(),
        "distortion": list(camera.distortion) or [0.0] * 5,
        "distortion_model": "Brown-Conrady, OpenCV order k1 k2 p1 p2 k3; applies to rgb and to the aligned depth",
        "width": camera.width,
        "height": camera.height,
    }


def _mask_picture(mask: Bool[Array, "h w"]) -> UInt8[Array, "h w"]:
    return np.where(mask, 255, 0).astype(np.uint8)


def _write_times(path: Path, times_s: Sequence[float]) -> None:
    path.write_text("".join(f"{t:.6f}\n" for t in times_s))


def _write_jpeg(path: Path, image: UInt8[Array, "..."], quality: int) -> None:
    bgr = image[..., ::-1] if image.ndim == 3 else image
    if not cv2.imwrite(str(path), bgr, [cv2.IMWRITE_JPEG_QUALITY, quality]):
        raise WriteFailed(f"{path}: cannot be written; is there space on the disk?")
