"""`export bop`: BOP's layout (models in mm, scene_camera.json, scene_gt.json) and a results file for its toolkit.

scene_gt.json holds the ESTIMATED poses: the layout has no other place for them. Whoever scores uses the results file.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.exporters.common import ExportReport, count_files, new_files, open_results, write_document
from recordings.exporters.images import depth_png, image_file
from recordings.exporters.mesh import shapes
from recordings.geometry import CameraModel
from recordings.progress import Progress
from recordings.session import Session, Toss
from recordings.tracks import ObjectShape, ObjectTrack

CAMERA = "d455"
MM = 1000.0
RESULTS_HEAD = "scene_id,im_id,obj_id,score,R,t,time\n"
TARGET_KEYS = ("scene_id", "im_id", "obj_id", "inst_count")


def export_bop(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write models/, test/<toss>/{rgb,depth,scene_camera.json,scene_gt.json} and tosslab_<object>-test.csv."""
    results = open_results(source)
    record = results.find(variant, scope)
    path = results.session_path(record.name, record.scope)
    if path is None:
        raise BadInput(f"the session that {source} was made from is not there any more; BOP's layout needs its images")
    session, tracks = Session.open(path), results.tracks(record.name, record.scope)
    object_ids = {toss: (i + 1 if record.scope == "one" else 1) for i, toss in enumerate(tracks)}
    lines = [RESULTS_HEAD]
    with new_files(out) as made:
        _write_models(made / "models", list(shapes(results, record).values()))
        write_document(made / "camera.json", _camera_json(session.calibration.camera(CAMERA)))
        for done, (toss, track) in enumerate(tracks.items()):
            progress.step(done, len(tracks), f"toss {toss}")
            lines += _write_scene(made / "test", session, session.toss(toss), track, object_ids[toss])
        _write_targets(made / "test_targets_bop19.json", tracks, object_ids)
        (made / f"tosslab_{_word(record.object_name)}-test.csv").write_text("".join(lines))
        files = count_files(made)
    progress.step(len(tracks), len(tracks))
    session.close()
    return ExportReport("bop", out, files, ("scene_gt.json holds estimated poses, not truth",))


def _word(name: str) -> str:
    return "".join(c for c in name.lower() if c.isalnum()) or "object"


def _camera_json(camera: CameraModel) -> dict[str, Any]:
    return {
        "cx": camera.cx,
        "cy": camera.cy,
        "depth_scale": 1.0,
        "fx": camera.fx,
        "fy": camera.fy,
        "height": camera.height,
        "width": camera.width,
    }


def _write_models(folder: Path, models: list[ObjectShape]) -> None:
    import trimesh

    folder.mkdir(parents=True)
    info = {}
    for i, shape in enumerate(models, 1):
        mesh = trimesh.Trimesh(shape.vertices_m * MM, shape.faces, vertex_colors=shape.vertex_rgb, process=False)
        (folder / f"obj_{i:06d}.ply").write_bytes(mesh.export(file_type="ply"))
        low, high = mesh.bounds
        size = dict(zip(("size_x", "size_y", "size_z"), (high - low).tolist(), strict=True))
        start = dict(zip(("min_x", "min_y", "min_z"), low.tolist(), strict=True))
        info[str(i)] = {"diameter": diameter(mesh.convex_hull.vertices), **start, **size}
    write_document(folder / "models_info.json", info)


def diameter(hull: Array) -> float:
    """The largest distance between two vertices of a convex hull."""
    from scipy.spatial.distance import pdist

    return float(pdist(np.asarray(hull)).max())


def _write_scene(folder: Path, session: Session, toss: Toss, track: ObjectTrack, object_id: int) -> list[str]:
    scene = folder / f"{toss.index:06d}"
    for name in ("rgb", "depth"):
        (scene / name).mkdir(parents=True)
    camera, colors = session.calibration.camera(CAMERA), toss.color(CAMERA)
    if len(colors) != len(track.time_ns):
        raise BadInput(
            f"toss {toss.index}: {len(colors)} images, {len(track.time_ns)} poses; the session was changed since"
        )
    cameras: dict[str, Any] = {}
    poses: dict[str, list[dict[str, Any]]] = {}
    lines = []
    for i, (image, (raw, scale)) in enumerate(zip(colors, _depths(toss), strict=True)):
        suffix, data = image_file(image)
        (scene / "rgb" / f"{i:06d}{suffix}").write_bytes(data)
        (scene / "depth" / f"{i:06d}.png").write_bytes(depth_png(raw))
        cameras[str(i)] = {"cam_K": camera.K.reshape(-1).tolist(), "depth_scale": scale}
        pose = track.pose(i)
        poses[str(i)] = []
        if pose is not None:
            R, t = pose.rotation.reshape(-1).tolist(), (pose.translation_m * MM).tolist()
            poses[str(i)] = [{"cam_R_m2c": R, "cam_t_m2c": t, "obj_id": object_id}]
            lines.append(f"{toss.index},{i},{object_id},1,{' '.join(map(repr, R))},{' '.join(map(repr, t))},-1\n")
    write_document(scene / "scene_camera.json", cameras)
    write_document(scene / "scene_gt.json", poses)
    return lines


def _depths(toss: Toss) -> Iterator[tuple[UInt16[Array, "h w"], float]]:
    """Depth of every colour frame and its scale to mm: as recorded where it is aligned already, else in 0.1 mm."""
    frames, depths = toss.rgbd(CAMERA), toss.depth(CAMERA)
    aligned = f"{CAMERA}_depth" not in toss.calibration.cameras
    position = {t: k for k, t in enumerate(depths.times_ns.tolist())}
    for i in range(len(frames)):
        if aligned and i not in frames.without_depth:
            image = depths[position[int(frames.depth_times_ns[i])]]
            yield image.raw, float(f"{image.unit_m * MM:.9g}")
        else:
            yield _tenths(frames[i].depth_m), 0.1


def _tenths(depth_m: Array) -> UInt16[Array, "h w"]:
    steps = np.rint(depth_m.astype(np.float64) * MM * 10)
    return np.where(steps > np.iinfo(np.uint16).max, 0, steps).astype(np.uint16)


def _write_targets(path: Path, tracks: dict[int, ObjectTrack], object_ids: dict[int, int]) -> None:
    """Every frame is asked for: a lost one then counts as not found."""
    rows = [(toss, i, object_ids[toss], 1) for toss, track in tracks.items() for i in range(len(track.status))]
    write_document(path, [dict(zip(TARGET_KEYS, row, strict=True)) for row in rows])
