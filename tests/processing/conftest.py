"""A tiny session, rendered here: a coloured box thrown over a grey table, seen by a small noiseless depth camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from processing.segment.background.static_scene import SceneSettings, StaticScene, calibrated_table_depth, learn_scene
from recordings.geometry import CameraModel, Transform, rotation_exp
from recordings.records import ArmStates, DepthImage, EncodedImage, RgbdFrame, StampedPose
from recordings.session_writer import SessionWriter, write_truth
from recordings.tracks import RigCalibration

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
BOX_M = np.array([0.10, 0.08, 0.06])
OTHER_M = np.array([0.05, 0.05, 0.14])
FRAME_NS = 33_333_333
CAMERA_HEIGHT_M = 0.6
FACES_RGB = np.array([[200, 40, 40], [40, 200, 40], [40, 40, 200], [200, 200, 40], [200, 40, 200], [40, 200, 200]])


@dataclass(frozen=True)
class TinyWorld:
    """The camera, where it stands, and what it sees of a box at a pose."""

    camera: CameraModel
    world_from_camera: Transform
    calibration: RigCalibration

    def poses(self, count: int, toss: int = 0) -> list[Transform]:
        """world_from_object of a box that waits, flies over the table, turns, and lies there."""
        out = []
        for i in range(count):
            s = min(max((i - 1) / max(count - 3, 1), 0.0), 1.0)
            turn = rotation_exp(np.array([0.7, 0.5, 0.3 + 0.2 * toss]) + s * np.array([0.25, -0.1, 0.5]))
            place = np.array([-0.14 + 0.26 * s, -0.05 + 0.03 * toss + 0.06 * s, 0.16 - 0.08 * s])
            out.append(Transform("world", "object", turn, place))
        return out

    def see(
        self,
        world_from_object: Transform | None,
        index: int = 0,
        hand: bool = False,
        box_m: np.ndarray = BOX_M,
        faces_rgb: np.ndarray = FACES_RGB,
    ) -> tuple[RgbdFrame, np.ndarray]:
        """The frame and the box's true mask; `hand` puts a brown bar in front of a part of it."""
        import open3d

        scene = open3d.t.geometry.RaycastingScene()
        table = open3d.t.geometry.TriangleMesh.create_box(4, 4, 0.1).translate([-2, -2, -0.1])
        scene.add_triangles(table)
        if world_from_object is not None:
            box = open3d.t.geometry.TriangleMesh.create_box(*box_m).translate(-box_m / 2)
            scene.add_triangles(box.transform(world_from_object.matrix))
        if hand and world_from_object is not None:
            bar = open3d.t.geometry.TriangleMesh.create_box(0.5, 0.02, 0.02)
            scene.add_triangles(bar.translate(world_from_object.translation_m + np.array([0.02, -0.01, 0.07])))
        rays = self.camera.pixel_rays()
        origin = np.broadcast_to(self.world_from_camera.translation_m, rays.shape)
        directions = self.world_from_camera.vectors(rays)
        hit = scene.cast_rays(open3d.core.Tensor(np.concatenate([origin, directions], -1).astype(np.float32)))
        depth = hit["t_hit"].numpy()
        what = hit["geometry_ids"].numpy().astype(np.int64)
        color = np.full((HEIGHT, WIDTH, 3), 120, dtype=np.int64)
        u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        color += (8 * np.sin(u / 5) * np.cos(v / 7)).astype(np.int64)[..., None]
        face = hit["primitive_ids"].numpy().astype(np.int64) // 2 % 6
        color[what == 1] = faces_rgb[face[what == 1]]
        color[what == 2] = (90, 60, 30)
        depth = np.where(np.isfinite(depth), np.round(depth, 3), 0).astype(np.float32)
        frame = RgbdFrame("d455", index, index * FRAME_NS, index * FRAME_NS, color.astype(np.uint8), depth)
        return frame, what == 1

    def record(
        self,
        folder: Path,
        tosses: Sequence[int] = (0, 1),
        frames: int = 8,
        first_mask: bool = True,
        others: Sequence[int] = (),
        gone: Callable[[int, int], bool] = lambda toss, frame: False,
        seen_again: Callable[[list[RgbdFrame]], list[RgbdFrame]] = lambda frames: frames,
        arm: ArmStates | None = None,
    ) -> Path:
        """A session of these tosses on disk. In `others` another object is thrown; `gone(toss, frame)`: unseen;
        `seen_again`: what the camera makes of the frames of a toss."""
        with SessionWriter(folder, {"name": folder.name, "object": {"name": "box"}}, self.calibration) as session:
            for toss in tosses:
                with session.toss(toss) as writer:
                    look = {"box_m": OTHER_M, "faces_rgb": 255 - FACES_RGB[::-1]} if toss in others else {}
                    poses = enumerate(self.poses(frames, toss))
                    seen = [self.see(None if gone(toss, i) else pose, i, **look) for i, pose in poses]
                    if arm is not None:
                        writer.arm(arm)
                    if first_mask and seen[0][1].any():
                        writer.mask(0, seen[0][1])
                    for i, frame in enumerate(seen_again([f for f, _ in seen])):
                        at = replace(frame, index=i, time_ns=i * FRAME_NS, depth_time_ns=i * FRAME_NS)
                        writer.color(self._encoded(at))
                        raw = np.round(frame.depth_m * 1000).astype(np.uint16)
                        writer.depth(DepthImage("d455", i, at.time_ns, at.time_ns, 0.001, raw))
            session.finish("complete")
        return folder

    def _encoded(self, frame: RgbdFrame) -> EncodedImage:
        _, png = cv2.imencode(".png", frame.color_rgb[..., ::-1])
        return EncodedImage("d455", frame.index, frame.time_ns, frame.time_ns, "png", WIDTH, HEIGHT, png.tobytes())

    def truth_poses(self, frames: int, toss: int) -> list[StampedPose]:
        return [
            StampedPose(i * FRAME_NS, "world", "object", pose.matrix) for i, pose in enumerate(self.poses(frames, toss))
        ]

    def add_truth(self, session: Path, tosses: Sequence[int] = (0, 1), frames: int = 8) -> Path:
        """The session's own truth/."""
        import trimesh

        mesh = trimesh.creation.box(BOX_M).export(file_type="obj").encode()
        return write_truth(session, {t: self.truth_poses(frames, t) for t in tosses}, {"source": "test"}, mesh)

    def truth_folder(self, folder: Path, tosses: Sequence[int] = (0, 1), frames: int = 8) -> Path:
        """The same truth in the `*_truth` folder layout."""
        import trimesh

        camera_from_world = self.world_from_camera.inverse()
        for toss in tosses:
            (folder / f"toss_{toss:02d}").mkdir(parents=True)
            poses = np.stack([(camera_from_world @ p).matrix for p in self.poses(frames, toss)])
            times_s = np.arange(frames) * FRAME_NS * 1e-9
            np.savez(folder / f"toss_{toss:02d}" / "poses_camera_object.npz", t=times_s, T_camera_object=poses)
        trimesh.creation.box(BOX_M).export(folder / "mesh.obj")
        return folder


@pytest.fixture(autouse=True, scope="session")
def stages_in_turn() -> Iterator[None]:
    """Commands compute their stages in the test's own process, where a test can look into them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("processing.engine.jobs.cores", lambda: 1)
        yield


@pytest.fixture(scope="session")
def tiny_world() -> TinyWorld:
    K = np.array([[FOCAL, 0, (WIDTH - 1) / 2], [0, FOCAL, (HEIGHT - 1) / 2], [0, 0, 1.0]])
    camera = CameraModel("d455", WIDTH, HEIGHT, K)
    tilt = rotation_exp(np.array([np.pi + 0.35, 0, 0]))  # looks down at the table
    world_from_camera = Transform("world", "d455", tilt, np.array([0.0, -0.2, CAMERA_HEIGHT_M]))
    return TinyWorld(camera, world_from_camera, RigCalibration({"d455": camera}, (world_from_camera,)))


@pytest.fixture
def record_tiny(tiny_world: TinyWorld, tmp_path: Path) -> Callable[..., Path]:
    """`record_tiny(name="tiny", **options)` writes a session into the test's own folder."""

    def record(name: str = "tiny", **options: object) -> Path:
        return tiny_world.record(tmp_path / name, **options)  # type: ignore[arg-type]

    return record


@pytest.fixture(scope="module")
def toss(tiny_world: TinyWorld) -> tuple[list[RgbdFrame], list[np.ndarray]]:
    """Twelve frames of the box and its true masks."""
    seen = [tiny_world.see(pose, i) for i, pose in enumerate(tiny_world.poses(12))]
    return [f for f, _ in seen], [m for _, m in seen]


@pytest.fixture(scope="module")
def scene(tiny_world: TinyWorld, toss: tuple[list[RgbdFrame], list[np.ndarray]]) -> StaticScene:
    """What stands behind those frames."""
    return learn_scene(toss[0], calibrated_table_depth(tiny_world.calibration, "d455"), SceneSettings())
