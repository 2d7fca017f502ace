"""What one toss looks like in rerun: images, point cloud, bodies, plots. Every function logs one layer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import rerun as rr
from jaxtyping import Float, Float32, Int64, UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput, DamagedFile
from recordings.geometry import CameraModel, Transform, quaternion_from_rotation
from recordings.mcap.codec import decode_image
from recordings.progress import Progress
from recordings.records import DepthImage, EncodedImage, RgbdFrame
from recordings.session import Toss
from recordings.view.scene import Scene

TIME, TOSS = "time", "toss"
CAMERA, FLAT, DEPTH, CLOUD = "world/cameras/{}", "flat/{}", "depth/{}", "world/seen_by/{}"
ARM, FRAMES, MOTION, EVENTS, HEALTH = "arm", "frames", "object", "events", "health"
JPEG_QUALITY = 90
CLOUD_POINTS = 20_000
"""Largest number of points of one point cloud; the pixel grid is thinned evenly to stay below."""
CLOUD_REACH_M = 2.5
"""Depth beyond this is not drawn: walls would hide the table."""
CLOUD_FILL = 0.7
"""Drawn radius of a point in half distances to its neighbour: 1 closes a wall that faces the camera."""
FRUSTUM_M = 0.12
"""Length of a drawn camera frustum."""
LEVELS = {"info": rr.TextLogLevel.INFO, "warning": rr.TextLogLevel.WARN, "error": rr.TextLogLevel.ERROR}


class Clock:
    """Sets rerun's timelines for one toss: `time` (session clock, plus the scene's shift) and `toss`."""

    def __init__(self, recording: rr.RecordingStream, toss: int, shift_ns: int) -> None:
        self._recording = recording
        self.toss = toss
        self._shift_ns = shift_ns

    def at(self, time_ns: int) -> rr.RecordingStream:
        """The recording, set to a time of this toss."""
        self._recording.set_time(TIME, duration=self.shown(time_ns))
        self._recording.set_time(TOSS, sequence=self.toss)
        return self._recording

    def shown(self, time_ns: int) -> np.timedelta64:
        """Where a time of this toss lies on the timeline `time`."""
        return np.timedelta64(int(time_ns) + self._shift_ns, "ns")

    def columns(self, entity: str, times_ns: Array, columns: rr.ComponentColumnList) -> None:
        """Many values of one entity at once."""
        shown = (np.asarray(times_ns, dtype=np.int64) + self._shift_ns).astype("timedelta64[ns]")
        tosses = np.full(len(shown), self.toss)
        indexes = [rr.TimeColumn(TIME, duration=shown), rr.TimeColumn(TOSS, sequence=tosses)]
        self._recording.send_columns(entity, indexes, columns)


class Steps:
    """One progress over all tosses: a step for each cloud and one for each toss."""

    def __init__(self, progress: Progress, scene: Scene, tosses: tuple[int, ...]) -> None:
        recorded = [scene.toss(toss) for toss in tosses]
        self._total = len(tosses) + sum(len(toss.color()) for toss in recorded if toss is not None)
        self._progress = progress
        self._done = 0

    def next(self, note: str) -> None:
        self._done = min(self._done + 1, self._total)
        self._progress.step(self._done, self._total, note)


def log_toss(recording: rr.RecordingStream, scene: Scene, toss: int, steps: Steps) -> None:
    """Everything that was recorded in one toss."""
    recorded = scene.toss(toss)
    if recorded is None:
        return
    clock = Clock(recording, toss, scene.shift_ns[toss])
    for camera in recorded.cameras():
        log_images(clock, scene, recorded, camera)
    if len(recorded.color()) and len(recorded.depth()):
        log_depth(clock, recorded)
        log_cloud(clock, scene, recorded, steps)
    log_arm(clock, recorded)
    log_frame_times(clock, recorded)
    log_words(clock, recorded)


def image_entity(scene: Scene, camera: str) -> str:
    """Where a camera's images are logged: on its frustum in the world, or apart where its place is not known."""
    model = scene.calibration.cameras.get(camera)
    if model is None or scene.root_from(model.frame) is None:
        return FLAT.format(camera)
    return f"{CAMERA.format(camera)}/image"


def log_images(clock: Clock, scene: Scene, toss: Toss, camera: str) -> None:
    """Every image of a camera, compressed as the device did it; the given masks over the colour camera's."""
    frames = toss.color(camera) if len(toss.color(camera)) else toss.mono(camera)
    for image in frames:
        clock.at(image.time_ns).log(image_entity(scene, camera), drawn_image(image))
    if f"/{camera}/color" not in toss.file.channels:
        return
    entity = f"{image_entity(scene, camera)}/mask"
    for position, mask in toss.masks().items():
        if not 0 <= position < len(frames):
            continue
        clock.at(int(frames.times_ns[position])).log(entity, rr.SegmentationImage(mask.astype(np.uint8), opacity=0.35))
        after = frames.times_ns[position + 1] if position + 1 < len(frames) else frames.times_ns[position] + 1
        clock.at(int(after)).log(entity, rr.Clear(recursive=False))


def drawn_image(image: EncodedImage) -> rr.EncodedImage | rr.Image:
    """JPEG and PNG as they are; raw pixels as JPEG, or a recording would grow by megabytes a frame."""
    if image.encoding in ("jpeg", "png"):
        return rr.EncodedImage(contents=image.data, media_type=f"image/{image.encoding}")
    return rr.Image(decode_image(image)).compress(jpeg_quality=JPEG_QUALITY)


def log_depth(clock: Clock, toss: Toss, camera: str = "d455") -> None:
    """Depth as the device gave it, in its own unit and its own optical frame."""
    for image in toss.depth(camera):
        clock.at(image.time_ns).log(DEPTH.format(camera), drawn_depth(image))


def drawn_depth(image: DepthImage) -> rr.DepthImage:
    return rr.DepthImage(image.raw, meter=1.0 / image.unit_m, depth_range=(0.2 / image.unit_m, 2.0 / image.unit_m))


def log_cloud(clock: Clock, scene: Scene, toss: Toss, steps: Steps, camera: str = "d455") -> None:
    """The coloured point cloud of every frame at the time its depth was exposed, in the root frame.

    Computed here through the lens model: rerun's pinhole knows no distortion. Left out where the camera's model or
    place is not known, or depth does not fit colour (a line among the events says so).
    """
    model = scene.calibration.cameras.get(camera)
    root_from_camera = scene.root_from(model.frame) if model is not None else None
    if model is None or root_from_camera is None:
        return
    thin = Thinned.of(model, CLOUD_POINTS)
    frames = toss.rgbd(camera)
    try:
        for frame in frames:
            clock.at(frame.depth_time_ns).log(CLOUD.format(camera), thin.cloud(frame, root_from_camera))
            steps.next(f"toss {clock.toss}")
    except DamagedFile:
        raise
    except BadInput as wrong:  # depth that cannot be laid over colour: all else is shown, and this is said
        text = f"toss {clock.toss}: no point cloud: {wrong}"
        clock.at(int(frames.times_ns[0])).log(EVENTS, rr.TextLog(text, level=rr.TextLogLevel.WARN))


@dataclass(frozen=True, eq=False)
class Thinned:
    """An evenly thinned pixel grid: the ray (x, y, 1) of each kept pixel in the optical frame, `spread` between two."""

    step: int
    spread: float
    rays: Float[Array, "h w 3"]

    @staticmethod
    def of(model: CameraModel, most: int) -> Thinned:
        step = max(1, int(np.ceil(np.sqrt(model.width * model.height / most))))
        u, v = np.meshgrid(np.arange(0, model.width, step), np.arange(0, model.height, step))
        return Thinned(step, step / model.fx, model.rays(np.stack([u, v], -1).astype(np.float64)))

    def points(self, frame: RgbdFrame) -> tuple[Float[Array, "n 3"], UInt8[Array, "n 3"]]:
        """Points in the optical frame and colours; without pixels that have no depth, no ray, or lie beyond reach."""
        depth_m = frame.depth_m[:: self.step, :: self.step]
        keep = (depth_m > 0) & (depth_m < CLOUD_REACH_M) & np.isfinite(self.rays).all(axis=-1)
        points = self.rays[keep] * depth_m[keep][:, None].astype(np.float64)
        return points, frame.color_rgb[:: self.step, :: self.step][keep]

    def cloud(self, frame: RgbdFrame, root_from_camera: Transform) -> rr.Points3D:
        """The frame's point cloud in the root frame; points grow with their distance to their neighbours."""
        points, colors = self.points(frame)
        radii = 0.5 * CLOUD_FILL * self.spread * points[:, 2]
        return rr.Points3D(short(root_from_camera.points(points)), colors=colors, radii=short(radii))


def quaternions_xyzw(rotations: Float[Array, "n 3 3"]) -> Float[Array, "n 4"]:
    """As rerun has them."""
    return np.array([quaternion_from_rotation(R) for R in rotations]).reshape(-1, 4)[:, [1, 2, 3, 0]]


def short(values: Float[Array, "*n"]) -> Float32[Array, "*n"]:
    """Rounded to 1/2048 m, half a millimetre: with zeros at their end, floats compress to two thirds in an .rrd."""
    return (np.round(values * 2048) / 2048).astype(np.float32)


def plotted(
    times_ns: Int64[Array, " n"], values: Float[Array, "n ..."]
) -> tuple[Int64[Array, " m"], rr.ComponentColumnList]:
    """Times and columns of a plot, with NaN just after the last value: no line leads to the next toss."""
    rows = np.vstack([values.reshape(len(values), -1), np.full((1, values[:1].size), np.nan)])
    columns = rr.Scalars.columns(scalars=rows.ravel()).partition([rows.shape[1]] * len(rows))
    return np.append(times_ns, times_ns[-1] + 1), columns


def log_arm(clock: Clock, toss: Toss) -> None:
    """Joint angles, joint speeds and the gripper's width as plots."""
    states = toss.arm_states()
    if states is None or len(states.time_ns) == 0:
        return
    for name, values in (("angles_rad", states.q_rad), ("speeds_rad_s", states.dq_rad_s)):
        clock.at(int(states.time_ns[0])).log(
            f"{ARM}/{name}", rr.SeriesLines(names=list(states.joint_names)), static=True
        )
        clock.columns(f"{ARM}/{name}", *plotted(states.time_ns, values))
    finite = np.isfinite(states.finger_width_m)
    if finite.any():
        clock.columns(f"{ARM}/finger_width_m", *plotted(states.time_ns[finite], states.finger_width_m[finite]))


def log_frame_times(clock: Clock, toss: Toss) -> None:
    """The health of the streams as plots: milliseconds since the frame before, and from colour to its depth."""
    for camera in toss.cameras():
        frames = toss.color(camera) if len(toss.color(camera)) else toss.mono(camera)
        if len(frames) > 1:
            gaps_ms = np.diff(frames.times_ns) / 1e6
            clock.columns(f"{FRAMES}/{camera}_gap_ms", *plotted(frames.times_ns[1:], gaps_ms))
    if len(toss.color()) and len(toss.depth()):
        rgbd = toss.rgbd()
        late_ms = (rgbd.depth_times_ns - rgbd.times_ns) / 1e6
        clock.columns(f"{FRAMES}/d455_depth_after_color_ms", *plotted(rgbd.times_ns, late_ms))


def log_words(clock: Clock, toss: Toss) -> None:
    """Events, the arm's command and the rig's health lines as text on the timeline."""
    for event in toss.events():
        text = f"toss {clock.toss}: {event.kind.replace('_', ' ')} ({event.source}) {event.text}".rstrip()
        clock.at(event.time_ns).log(EVENTS, rr.TextLog(text, level=rr.TextLogLevel.INFO))
    command = toss.command()
    if command is not None:
        speed = float(np.linalg.norm(command.linear_velocity_world_m_s))
        text = f"toss {clock.toss}: the arm is told to release at {speed:.2f} m/s"
        clock.at(command.time_ns).log(EVENTS, rr.TextLog(text, level=rr.TextLogLevel.INFO))
    for line in toss.health():
        clock.at(line.time_ns).log(HEALTH, rr.TextLog(f"{line.name}: {line.message}", level=LEVELS[line.level]))
