"""Makes one session of the variety: the folder layout at OUT, its truth at OUT_truth."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array
from synthetic.folder import PIXEL_CONVENTION, STATES_HZ

from acquisition.synthetic.random_draws import small_error
from acquisition.synthetic.render.rays import Body, Placed, Standing, cast
from acquisition.synthetic.render.sensors import color_image
from acquisition.synthetic.truth_sidecar import SUFFIX
from recordings.errors import BadInput
from recordings.geometry import CameraModel, Transform
from recordings.progress import Progress, Silent
from variety import stereo_depth
from variety.camera import ColorCamera, jpeg
from variety.colour import Painter, Shot
from variety.infrared import INSTANTS, Pair
from variety.physics import Ground
from variety.physics_mujoco import bounced, damping_of
from variety.scene import SENSOR, WRONG, Scene, build, generator
from variety.spec import Spec
from variety.throws import Throw, Thrower, moving_items

FPS, JITTER_S = 30.0, 0.0002
BEHIND_M = 0.002


@dataclass(frozen=True, eq=False)
class Made:
    """What one session's tosses have in common while it is made."""

    spec: Spec
    scene: Scene
    painter: Painter
    pair: Pair
    sight: Sight
    out: Path
    truth: Path


def make(
    spec: Spec, out: Path, objects: Path | None = None, progress: Progress | None = None, threads: int = 2
) -> Path:
    """Write the session; returns its truth. Raises BadInput by name where the spec cannot be shown; nothing is left."""
    truth = out.with_name(out.name + SUFFIX)
    for folder in (out, truth):
        if folder.exists():
            raise BadInput(f"{folder} exists; wanted a new folder: choose another name, or remove it")
    scene = build(spec, objects)
    thrower = Thrower(spec, scene)
    throws = [
        thrower.throw(k) for k in range(len(spec.tosses))
    ]  # what cannot be shown is known before anything is drawn
    painter = Painter(spec, scene, out.with_name(out.name + ".render"), threads)
    try:
        for folder in (out, truth):
            folder.mkdir(parents=True)
        pair = Pair(scene.world_from_camera, spec.depth, scene.standing, moving_items(scene), generator(spec, SENSOR))
        made = Made(spec, scene, painter, pair, Sight(scene), out, truth)
        _session_files(made, thrower.ground)
        times = [_frame_times(spec, throw) for throw in throws]
        painter.render([shot_of(spec, throw, t) for throw, of in zip(throws, times) for t in of])
        for throw, of in zip(throws, times):
            _toss(made, throw, of)
            (progress or Silent()).step(throw.number + 1, len(throws), f"{spec.name} toss {throw.number}")
    except BaseException:
        for folder in (out, truth):
            shutil.rmtree(folder, ignore_errors=True)
        raise
    finally:
        painter.close()
    return truth


class Sight:
    """Whose each pixel of the colour camera is."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._bodies = {name: Body(name, item.mesh) for name, item in moving_items(scene).items()}
        self._rays = scene.world_from_camera.vectors(scene.camera.pixel_rays().reshape(-1, 3)).astype(np.float32)
        self._eye = scene.world_from_camera.translation_m.astype(np.float32)
        _, hits = Standing([Body(i.name, i.mesh) for i in scene.standing]).cast(self._eye, self._rays)
        self._still = hits["t_hit"]

    def masks(self, placed: Sequence[tuple[str, Transform]]) -> tuple[Bool[Array, "h w"], Bool[Array, "h w"], float]:
        """The object's visible pixels, those of the hand, and the share of the object that is not hidden."""
        shape = (self.scene.camera.height, self.scene.camera.width)
        nearest, owner, whole = self._still + BEHIND_M, np.zeros(len(self._rays), np.int8), 0
        for name, pose in placed:
            found = cast(Placed(self._bodies[name], pose), np.broadcast_to(self._eye, self._rays.shape), self._rays)[
                "t_hit"
            ]
            front = found < nearest
            owner[front], nearest[front] = (
                (1 if name == "object" else 3 if name == "person" else 2),
                found[front],
            )
            whole = int(np.isfinite(found).sum()) if name == "object" else whole
        seen = (owner == 1).reshape(shape)
        return seen, (owner == 2).reshape(shape), float(seen.sum()) / max(whole, 1)


def _toss(made: Made, throw: Throw, times: Float[Array, " n"]) -> None:
    spec, name = made.spec, f"toss_{throw.number:02d}"
    here, there = made.out / name, made.truth / name
    for folder in (here / "rgb", here / "depth", there / "masks", there / "robot_masks"):
        folder.mkdir(parents=True)
    rng = generator(spec, SENSOR, 1, throw.number)
    camera = ColorCamera(spec.camera, made.painter.still, times, rng)
    delay = spec.wrong.depth_delay_s
    shares = []
    for k, t in enumerate(times):
        picture = camera.develop(made.painter.picture(shot_of(spec, throw, t)), k, rng)
        (here / "rgb" / f"{k:06d}.jpg").write_bytes(jpeg(picture, spec.camera.jpeg))
        _png(here / "depth" / f"{k:06d}.png", depth_at(made, throw, t + delay, rng))
        mask, hand, visible = made.sight.masks(_placed(throw, t + _row_delay(made, throw, t)))
        shares.append(visible)
        _png(there / "masks" / f"{k:06d}.png", 255 * mask.astype(np.uint8))
        if throw.others.keys() - {"person"}:
            _png(there / "robot_masks" / f"{k:06d}.png", 255 * hand.astype(np.uint8))
        if k == 0:
            if mask.sum() < 30:
                raise BadInput(
                    f"{spec.name}, {name}: {int(mask.sum())} px of the object are in view in the first frame"
                )
            _png(here / "mask_first.png", 255 * mask.astype(np.uint8))
    _times(here / "timestamps.txt", times)
    if spec.wrong.delay_known:
        _times(here / "depth_timestamps.txt", times + delay)
    if throw.swing is not None and made.scene.arm is not None:
        _arm(here / "arm.csv", made.scene.arm.states(throw.swing, float(times[-1]) + 0.02, rng))
    told = {"frames": len(times)} | ({"release_time_s": throw.instants.release_s} if spec.say_release else {})
    _json(here / "toss.json", told)
    _truth_of(made, throw, there, times, shares)


def _frame_times(spec: Spec, throw: Throw) -> Float[Array, " n"]:
    """Mid-exposure times, the first 0; some frames are missing."""
    rng, count = generator(spec, SENSOR, 2, throw.number), max(4, int(throw.instants.end_s * FPS))
    times = np.arange(count) / FPS + JITTER_S * rng.standard_normal(count)
    times[0] = 0.0
    kept = rng.random(count) >= spec.camera.dropped
    kept[0] = kept[-1] = True
    return times[kept]


def _placed(throw: Throw, time_s: float) -> list[tuple[str, Transform]]:
    places = [(name, place(time_s)) for name, place in throw.others.items()]
    return [("object", throw.object.at(time_s)), *((n, p) for n, p in places if p is not None)]


def shot_of(spec: Spec, throw: Throw, time_s: float) -> Shot:
    """Where what moves is when the first row opens and when the last one closes."""
    half = 0.5 * (spec.camera.exposure_s + spec.camera.readout_s)
    begin, end = dict(_placed(throw, time_s - half)), dict(_placed(throw, time_s + half))
    return {name: (begin[name], end[name]) for name in begin if name in end}


def _row_delay(made: Made, throw: Throw, time_s: float) -> float:
    """How much later than mid-frame the object's rows are exposed."""
    if made.spec.camera.readout_s == 0:
        return 0.0
    at = made.scene.world_from_camera.inverse().points(throw.object.at(time_s).translation_m[None])
    row = float(made.scene.camera.project(at)[0, 1])
    return made.spec.camera.readout_s * (np.clip(row / made.scene.camera.height, 0, 1) - 0.5)


def depth_at(made: Made, throw: Throw, time_s: float, rng: np.random.Generator) -> Array:
    """One depth image aligned to colour, in the device's unit."""
    spec = made.spec.depth
    spread = spec.exposure_s * ((np.arange(INSTANTS) + 0.5) / INSTANTS - 0.5)
    left, right = made.pair.pictures([_placed(throw, time_s + s) for s in spread.tolist()], rng)
    disparity = stereo_depth.match(left, right, stereo_depth.PRESETS[spec.preset])
    if spec.spatial_filter:
        disparity = stereo_depth.spatial_filtered(disparity.astype(np.float32), np.float32(0.5), np.float32(1.0))
    depth = stereo_depth.depth_of(disparity)
    aligned = stereo_depth.aligned(depth, stereo_depth.infrared_camera(), made.scene.camera, made.pair.color_from_left)
    return stereo_depth.in_units(aligned * np.float32(made.spec.wrong.depth_scale), spec.unit_m)


def believed(spec: Spec, scene: Scene) -> tuple[CameraModel, Transform]:
    """Intrinsics and place of the camera as the session says them."""
    rng, wrong = generator(spec, WRONG), spec.wrong
    K = scene.camera.K.copy()
    K[0, 0] *= 1 + wrong.focal_share
    K[1, 1] *= 1 + wrong.focal_share
    turn = rng.uniform(0, 2 * np.pi)
    K[:2, 2] += wrong.center_px * np.array([np.cos(turn), np.sin(turn)])
    camera = CameraModel("d455", scene.camera.width, scene.camera.height, K, "brown-conrady", scene.camera.distortion)
    return camera, scene.world_from_camera @ small_error("d455", wrong.camera_m, wrong.camera_deg, rng)


def calibrated_base(spec: Spec, scene: Scene) -> Transform:
    """world_from_base as the session says it: the hand-eye calibration is off."""
    assert scene.arm is not None
    wrong, rng = spec.wrong, generator(spec, WRONG, 1)
    return scene.arm.world_from_base @ small_error(scene.arm.robot.root, wrong.hand_eye_m, wrong.hand_eye_deg, rng)


def _session_files(made: Made, ground: Ground) -> None:
    spec, scene = made.spec, made.scene
    camera, place = believed(spec, scene)
    arm = {}
    if scene.arm is not None:
        arm = {"arm": "franka_panda", "T_world_base": calibrated_base(spec, scene).matrix.tolist()}
        _json(made.truth / "calibration.json", {
            "T_world_base": scene.arm.world_from_base.matrix.tolist(),
            "T_world_d455": scene.world_from_camera.matrix.tolist(), "arm_clock_offset_s": spec.wrong.arm_clock_s,
        })  # fmt: skip
    _json(made.out / "session.json", arm | {
        "object": spec.name,
        "camera": {
            "model": "D455-like", "K": camera.K.tolist(), "distortion": list(camera.distortion), "fps": FPS,
            "distortion_model": "Brown-Conrady, OpenCV order k1 k2 p1 p2 k3; applies to rgb and to the aligned depth",
            "width": camera.width, "height": camera.height, "depth_unit_m": spec.depth.unit_m, "depth_invalid": 0,
            "depth_aligned_to_color": True, "pixel_convention": PIXEL_CONVENTION,
        },
        "T_world_camera": place.matrix.tolist(),
        "world": "z up, table top is the plane z = 0, metres",
        "camera_frame": "OpenCV (x right, y down, z forward)",
        "table_tags": {"family": "tag36h11", "note": "none", "tags": []},
        "notes": "simulated",
    })  # fmt: skip
    _write_mesh(made)
    mass = scene.tossed.mass
    soft = spec.engine == "mujoco"
    _json(made.truth / "physics.json", {
        "mass_kg": mass.mass_kg, "inertia_body_kgm2": mass.inertia_kgm2.tolist(),
        "com_in_mesh_frame": mass.center_m.tolist(), "friction_mu": ground.friction,
        "restitution": bounced(damping_of(ground.restitution)) if soft else ground.restitution,
        "rolling_resistance_m": ground.rolling_m, "gravity_world_m_s2": ground.gravity_m_s2.tolist(), "gravity": 9.81,
        "source": spec.engine,
    })  # fmt: skip
    _json(made.truth / "sensor_truth.json", {
        "depth_scale": spec.wrong.depth_scale, "depth_delay_s": spec.wrong.depth_delay_s,
        "exposure_s": spec.camera.exposure_s, "readout_s": spec.camera.readout_s,
        "T_world_camera": scene.world_from_camera.matrix.tolist(), "K": scene.camera.K.tolist(),
    })  # fmt: skip
    _json(made.truth / "spec.json", spec.to_json())


def _write_mesh(made: Made) -> None:
    """Wavefront OBJ with its texture, in the frame of the poses."""
    mesh = made.scene.tossed.item.mesh
    _png(made.truth / "texture.png", color_image(mesh.atlas)[..., ::-1])
    (made.truth / "texture.mtl").write_text("newmtl texture\nKd 1 1 1\nmap_Kd texture.png\n")
    height, width = mesh.atlas.shape[:2]
    uv = (mesh.corner_uv_px.reshape(-1, 2) + 0.5) / [width, height]
    lines = ["mtllib texture.mtl", "usemtl texture", *(f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in mesh.vertices_m)]
    lines += [f"vt {u:.6f} {1 - v:.6f}" for u, v in uv]
    lines += [
        "f " + " ".join(f"{v + 1}/{3 * k + i + 1}" for i, v in enumerate(face)) for k, face in enumerate(mesh.faces)
    ]
    (made.truth / "mesh.obj").write_text("\n".join(lines) + "\n")


def _arm(path: Path, states: Float[Array, "n 16"]) -> None:
    """As the folder layout wants it: seconds, radians, radians a second, metres."""
    names = ["time_s", *(f"q{k}" for k in range(1, 8)), *(f"dq{k}" for k in range(1, 8)), "finger_width_m"]
    np.savetxt(path, states, fmt="%.6f", delimiter=",", header=",".join(names), comments="")


def _truth_of(made: Made, throw: Throw, there: Path, times: Float[Array, " n"], visible: Sequence[float]) -> None:
    world = np.array([throw.object.at(t).matrix for t in times])
    instants = throw.instants
    np.savez_compressed(
        there / "poses_camera_object.npz", t=times,
        T_camera_object=made.scene.world_from_camera.inverse().matrix @ world, T_world_object=world,
        phase=np.array([instants.phase(t) for t in times]), visible_share=np.array(visible),
    )  # fmt: skip
    np.savez_compressed(there / "states_148hz.npz", **_states(throw))
    _json(there / "toss_gt.json", {
        "source_toss": "simulated", "kind": throw.kind, "release_time_s": instants.release_s,
        "first_contact_time_s": instants.first_impact_s, "rest_time_s": instants.rest_s,
    })  # fmt: skip


def _states(throw: Throw) -> dict[str, Any]:
    path, start = throw.object, throw.instants.release_s
    times = start + np.arange(int((throw.instants.rest_s - start) * STATES_HZ) + 1) / STATES_HZ
    rows = np.clip(np.searchsorted(path.times_s, times - 1e-9), 0, len(path.times_s) - 1)
    poses = [path.at(t) for t in times]
    spin = path.angular_velocity_object_rad_s[rows]
    return {
        "t": times, "position": np.array([p.translation_m for p in poses]),
        "quaternion_wxyz": np.array([p.quaternion_wxyz for p in poses]),
        "linear_velocity_world": path.velocity_world_m_s[rows], "angular_velocity_body": spin,
        "angular_velocity_world": np.array([p.rotation @ w for p, w in zip(poses, spin)]),
        "note": "SI, true world; position and velocity of the mesh origin; dt = 1/148 s, from the release",
    }  # fmt: skip


def _times(path: Path, times_s: Float[Array, " n"]) -> None:
    path.write_text("".join(f"{t:.6f}\n" for t in times_s))


def _png(path: Path, picture: Array) -> None:
    if not cv2.imwrite(str(path), picture, [cv2.IMWRITE_PNG_COMPRESSION, 4]):
        raise BadInput(f"{path}: cannot be written; is there space on the disk?")


def _json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, indent=1, allow_nan=False, default=float) + "\n")
