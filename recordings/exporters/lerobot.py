"""`export lerobot`: a LeRobot v3 dataset, one episode per toss.

```
data/chunk-000/file-000.parquet          one row per grid frame: states, poses, real times, depth as 16-bit PNG
videos/<camera>/chunk-000/file-000.mp4   colour of all episodes one after the other (H.264, lossy)
meta/info.json, stats.json, tasks.parquet, episodes/chunk-000/file-000.parquet
```
The format asks for a regular grid: grid frame k of an episode is at k / fps, holds the colour image nearest to it, and
`observation.time_s` is when that image was really taken, counted from the toss's first one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings import sync
from recordings.errors import BadInput
from recordings.exporters.common import ExportReport, count_files, new_files, open_recording, write_document
from recordings.exporters.images import depth_png
from recordings.exporters.lerobot_files import Column, Statistics, Video, write_data, write_episodes, write_tasks
from recordings.geometry import quaternion_from_rotation
from recordings.mcap.codec import decode_image
from recordings.progress import Progress
from recordings.records import ArmStates
from recordings.results.folder import Results
from recordings.session import Session, Toss
from recordings.tracks import ObjectTrack

CAMERA = "d455"
VIDEO = f"observation.images.{CAMERA}"
DEPTH = f"observation.depth.{CAMERA}"
POSE = "observation.object_pose"
POSE_NAMES = ("x", "y", "z", "qx", "qy", "qz", "qw")
CHUNK_FILES, DATA_MB, VIDEO_MB = 1000, 100, 200


@dataclass
class _Dataset:
    """What is gathered while the episodes are written."""

    fps: int
    columns: dict[str, Column] = field(default_factory=dict)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0
    repeated: int = 0

    def add(self, name: str, dtype: str, names: tuple[Any, ...], values: Any) -> None:
        self.columns.setdefault(name, Column(dtype, names)).values.extend(values)


def export_lerobot(source: Path, out: Path, variant: str | None, scope: str | None, progress: Progress) -> ExportReport:
    """Write a LeRobot v3 dataset of a session; of results, with its pose (d455_from_object, NaN where lost)."""
    session = open_recording(source, variant, scope)
    tracks = Results.open(source).tracks(variant, scope) if Results.is_results(source) else {}
    numbers = tuple(tracks) or session.tosses
    dataset = _Dataset(_fps(session, numbers))
    task = f"toss the {session.object_name}"
    with new_files(out) as made:
        statistics = Statistics()
        camera = session.toss(numbers[0]).color(CAMERA)[0]
        with Video(_video_path(made), dataset.fps, camera.width, camera.height) as video:
            for done, number in enumerate(numbers):
                progress.step(done, len(numbers), f"toss {number}")
                _write_episode(dataset, session.toss(number), tracks.get(number), video, statistics)
        write_data(made / _path("data", "parquet"), dataset.columns)
        write_tasks(made / "meta" / "tasks.parquet", [task])
        write_episodes(made / "meta" / _path("episodes", "parquet"), dataset.episodes, task)
        for name, column in dataset.columns.items():
            statistics.add_column(name, column)
        write_document(made / "meta" / "stats.json", statistics.to_json(), 4)
        write_document(made / "meta" / "info.json", _info(session, dataset, (camera.height, camera.width)), 4)
        files = count_files(made)
    progress.step(len(numbers), len(numbers))
    session.close()
    return ExportReport("lerobot", out, files, _notes(dataset))


def _notes(dataset: _Dataset) -> tuple[str, ...]:
    notes = ["colour is video (H.264, lossy); depth is kept without loss; there is no `action`: none was recorded"]
    if dataset.repeated:
        notes.append(
            f"{dataset.repeated} of {dataset.frames} grid frames repeat an image: one was missing in the recording"
        )
    return tuple(notes)


def _path(kind: str, suffix: str) -> str:
    return f"{kind}/chunk-000/file-000.{suffix}"


def _video_path(made: Path) -> Path:
    return made / "videos" / VIDEO / "chunk-000" / "file-000.mp4"


def _fps(session: Session, numbers: tuple[int, ...]) -> int:
    """The nearest whole rate to the median frame step over all tosses."""
    steps = [np.diff(session.toss(n).color(CAMERA).times_ns) for n in numbers]
    joined = np.concatenate(steps) if steps else np.zeros(0)
    if len(joined) == 0:
        raise BadInput(f"{session.path} has no toss with two colour images; a dataset is made of them")
    return max(1, round(1e9 / float(np.median(joined))))


def grid(times_ns: Int64[Array, " n"], fps: int) -> Int64[Array, " k"]:
    """Which frame stands at k / fps after the first, up to the last: the nearest in time."""
    count = round((int(times_ns[-1]) - int(times_ns[0])) * fps / 1e9) + 1
    wanted_ns = times_ns[0] + np.rint(np.arange(count) * (1e9 / fps)).astype(np.int64)
    return np.abs(wanted_ns[:, None] - times_ns[None, :]).argmin(axis=1)


def _write_episode(
    dataset: _Dataset, toss: Toss, track: ObjectTrack | None, video: Video, statistics: Statistics
) -> None:
    colors = toss.color(CAMERA)
    if len(colors) == 0:
        raise BadInput(f"{toss.path.name} has no images of {CAMERA}; an episode is made of them")
    chosen = grid(colors.times_ns, dataset.fps)
    dataset.repeated += len(chosen) - len(set(chosen.tolist()))
    start = dataset.frames / dataset.fps
    for i in chosen.tolist():
        pixels = decode_image(colors[i])
        video.add(pixels)
        statistics.add_image(VIDEO, pixels)
    _add_counts(dataset, len(chosen))
    times_ns = colors.times_ns[chosen]
    dataset.add("observation.time_s", "float64", ("time_s",), ((times_ns - colors.times_ns[0]) / 1e9)[:, None].tolist())
    _add_depth(dataset, toss, chosen)
    arm = toss.arm_states()
    if arm is not None:
        names, states = arm_at(arm, times_ns)
        dataset.add("observation.state", "float32", names, states.astype(np.float32).tolist())
    if track is not None:
        dataset.add(POSE, "float32", POSE_NAMES, _poses(track, chosen).astype(np.float32).tolist())
    dataset.frames += len(chosen)
    dataset.episodes.append(_episode(dataset, len(chosen), start))


def _episode(dataset: _Dataset, length: int, start_s: float) -> dict[str, Any]:
    return {
        "episode_index": len(dataset.episodes),
        "length": length,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "dataset_from_index": dataset.frames - length,
        "dataset_to_index": dataset.frames,
        f"videos/{VIDEO}/chunk_index": 0,
        f"videos/{VIDEO}/file_index": 0,
        f"videos/{VIDEO}/from_timestamp": start_s,
        f"videos/{VIDEO}/to_timestamp": start_s + length / dataset.fps,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _add_counts(dataset: _Dataset, length: int) -> None:
    """The columns that every LeRobot dataset has."""
    k = np.arange(length)
    dataset.add("timestamp", "float32", (), (k / dataset.fps).astype(np.float32).tolist())
    dataset.add("frame_index", "int64", (), k.tolist())
    dataset.add("episode_index", "int64", (), [len(dataset.episodes)] * length)
    dataset.add("index", "int64", (), (dataset.frames + k).tolist())
    dataset.add("task_index", "int64", (), [0] * length)


def _add_depth(dataset: _Dataset, toss: Toss, chosen: Int64[Array, " k"]) -> None:
    """Depth as it was recorded, nearest in time to each colour image."""
    depths, colors = toss.depth(CAMERA), toss.color(CAMERA)
    if len(depths) == 0:
        return
    period_ns = sync.frame_period_ns(colors.times_ns) or 33_333_333
    pairs = sync.pair_nearest(colors.times_ns, depths.times_ns, int(0.75 * period_ns))
    empty = depth_png(np.zeros_like(depths[0].raw))
    images = {
        i: empty if pairs[i] == sync.UNPAIRED else depth_png(depths[int(pairs[i])].raw) for i in set(chosen.tolist())
    }
    dataset.add(DEPTH, "image", depths[0].raw.shape, [images[i] for i in chosen.tolist()])


def arm_at(arm: ArmStates, times_ns: Int64[Array, " n"]) -> tuple[tuple[str, ...], Float[Array, "n d"]]:
    """Joint positions and velocities and the finger width, interpolated to these times (held beyond the ends)."""
    since_s = (arm.time_ns - arm.time_ns[0]) / 1e9
    at_s = (times_ns - arm.time_ns[0]) / 1e9
    columns = [arm.q_rad, arm.dq_rad_s]
    names = tuple(f"{n}.{kind}" for kind in ("pos", "vel") for n in arm.joint_names)
    if np.isfinite(arm.finger_width_m).all():
        columns.append(arm.finger_width_m[:, None])
        names += ("finger_width_m",)
    table = np.hstack(columns)
    return names, np.stack([np.interp(at_s, since_s, column) for column in table.T], axis=1)


def _poses(track: ObjectTrack, chosen: Int64[Array, " k"]) -> Float[Array, "k 7"]:
    out = np.full((len(chosen), 7), np.nan)
    for row, i in enumerate(chosen.tolist()):
        pose = track.pose(i)
        if pose is not None:
            w, x, y, z = quaternion_from_rotation(pose.rotation)
            out[row] = [*pose.translation_m, x, y, z, w]
    return out


def _info(session: Session, dataset: _Dataset, size: tuple[int, int]) -> dict[str, Any]:
    features: dict[str, Any] = {VIDEO: _video_feature(dataset.fps, size)}
    unit_m = {n: session.toss(n).depth(CAMERA)[0].unit_m for n in session.tosses if len(session.toss(n).depth(CAMERA))}
    for name, column in dataset.columns.items():
        features[name] = column.feature()
        if name == DEPTH:
            features[name]["info"] = {"is_depth_map": True, "unit_m": min(unit_m.values())}
    return {
        "codebase_version": "v3.0",
        "robot_type": (session.start.get("rig") or {}).get("arm"),
        "total_episodes": len(dataset.episodes),
        "total_frames": dataset.frames,
        "total_tasks": 1,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": dataset.fps,
        "splits": {"train": f"0:{len(dataset.episodes)}"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        "features": features,
    }


def _video_feature(fps: int, size: tuple[int, int]) -> dict[str, Any]:
    height, width = size
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": fps,
            "video.channels": 3,
            "has_audio": False,
        },
    }
